"""Faults of sensors are named, placed and taken out; right channels of many kinds are left alone."""

import numpy as np
import pytest

from fe_likelihoods import Channel, Measurements, Record, check_data
from fe_likelihoods.checks.screening import find_sensor_faults, repair_lines, screen
from tests.checks.real_channels import real_channels

STEP, N = 0.01, 3000
TIME = STEP * np.arange(N)
FIRST = 700  # sample of a fault, in the strong part


def response(seed, dimension="acceleration"):
    """Measured response of an oscillator of 3 Hz to modulated white noise; a second of rest before, noise of 1 %."""
    rng = np.random.default_rng(seed)
    motion = rng.standard_normal(N) * np.where(TIME > 1.0, (TIME - 1.0) * np.exp(-0.25 * TIME), 0.0)
    history = np.zeros(N)
    w, z = 2.0 * np.pi * 3.0, 0.04
    a, b = 2.0 - (w * STEP) ** 2 - 2.0 * z * w * STEP, 1.0 - 2.0 * z * w * STEP
    for k in range(2, N):
        history[k] = a * history[k - 1] - b * history[k - 2] + STEP**2 * motion[k - 1]
    values = history if dimension == "displacement" else -(w**2) * history
    return values + 0.01 * values.std() * rng.standard_normal(N)


def spoil(values, fault):
    """Samples with a fault, and its first and last samples."""
    y, peak, first = values.copy(), np.abs(values).max(), FIRST
    match fault:
        case "clipped":
            y = np.clip(y, -0.6 * peak, 0.6 * peak)
            return y, tuple(np.flatnonzero(np.abs(values) > 0.6 * peak)[[0, -1]])
        case "stuck" | "dead" | "noisy":
            level = {"stuck": y[first], "dead": 0.0, "noisy": 1e-3 * peak * np.random.default_rng(0).normal(size=50)}
            y[first : first + 50] = level[fault]
            return y, (first, first + 49)
        case "spikes":
            y[[first, first + 300]] += [0.7 * peak, -1.5 * peak]
            return y, (first, first + 300)
        case "offset":
            return y + 0.1 * peak, (0, N - 1)
        case "drift":
            return y + 0.2 * peak * TIME / TIME[-1], (0, N - 1)


KINDS = {"dead": "stuck", "noisy": "stuck"}
FAULTS = ("clipped", "stuck", "dead", "noisy", "spikes", "offset", "drift")


@pytest.mark.parametrize("dimension", ["acceleration", "displacement"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_placed_in_any_unit(fault, dimension):
    if fault in ("offset", "drift"):  # a structure that yields has a displacement of its own
        dimension = "acceleration"
    for seed in range(3):
        right = response(seed, dimension)
        assert find_sensor_faults(right, dimension) == ()
        values, (first, last) = spoil(right, fault)
        for unit in (1.0, 1e-6, 9.80665e5):
            (found,) = find_sensor_faults(unit * values, dimension)
            assert found.kind == KINDS.get(fault, fault), seed
            assert found.spans[0][0] == pytest.approx(first, abs=2) and found.spans[-1][1] == pytest.approx(last, abs=2)


def test_the_spans_of_spikes_are_exact():
    for width in (1, 2, 3):
        values = response(5)
        values[1234 : 1234 + width] += 2.0 * np.abs(values).max()
        (found,) = find_sensor_faults(values, "acceleration")
        assert found.spans == ((1234, 1234 + width - 1),)


def test_right_channels_of_other_kinds_are_left_alone():
    x = response(1, "displacement")
    peak, rng = np.abs(x).max(), np.random.default_rng(3)
    padded = np.concatenate([np.zeros(500), response(2)[100:], np.zeros(800)])  # usual for a motion
    residual = x + 0.5 * peak / (1.0 + np.exp(-(TIME - 8.0) / 0.5))  # after yielding
    digits = np.round(x / peak * 100.0)  # a logger of eight bits
    gaps = np.where((TIME > 5.0) & (TIME < 6.0), np.nan, x)
    for values in (
        x,
        residual,
        digits,
        gaps,
        np.zeros(N),
        np.where(TIME < 3.0, 0.0, x),  # a quiet start
        np.full(N, np.nan),
        np.where(np.arange(N) % 2, x, np.nan),
        x[:40],
    ):
        assert find_sensor_faults(values, "displacement") == ()
    assert find_sensor_faults(5.0 * peak + x, "force") == ()  # a dead load
    assert [each.kind for each in find_sensor_faults(np.where(TIME > 8.0, 0.0, x), "displacement")] == ["stuck"]
    box, pulse = np.where((TIME > 2.0) & (TIME < 4.0), 1.0, 0.0), np.where(TIME == 2.0, 1.0, 0.0)
    for motion in (
        padded,
        box,
        pulse,
        np.sin(5.0 * TIME),
        rng.standard_normal(N),
        np.where(TIME < 15.0, rng.normal(size=N), 0),
    ):
        assert (
            check_data(
                Measurements([Channel("top", "displacement", "mm")], STEP, [0.01 * x]), Record("EQ", STEP, motion)
            )
            == ()
        )


def test_a_finding_says_when_and_has_a_line():
    values, _ = spoil(response(1), "dead")
    deck, top = Channel("deck@1", "acceleration", "g"), Channel("top", "acceleration", "mm/s2")
    drifting = spoil(response(2), "drift")[0]
    measured = Measurements([deck, top], STEP, [values, drifting], start=0.5)
    first, second = found = check_data(measured)
    assert repr(found) == f"CAUTION: {first}\nCAUTION: {second}", "lines at the prompt"
    assert first.kind == "A sensor was stuck" and "7.500 to 7.990 s" in first.text
    assert 'missing = [["deck@1", 7.500, 7.990]]' in first.action
    assert second.kind == "A channel drifts" and "top = [[0.500, " in second.action
    lines = repair_lines(screen(measured), [-999])
    assert lines[0] == 'missing = [-999, ["deck@1", 7.500, 7.990]]'
    assert lines[1].startswith("baseline = {top = [[0.500, ")
    (found,) = check_data(Measurements([top], STEP, [response(2)]), Record("EQ", STEP, values))
    assert found.text.startswith("The motion EQ stands still at 7.000") and "missing" not in found.action
    line, coarse = response(3, "acceleration"), np.interp(np.arange(20 * N) / 20, np.arange(N), response(3))
    line[700:731] = np.linspace(line[700], line[730], 31)
    padded, k = np.append(coarse, np.zeros(40 * N)), np.arange(4000)
    rounded = np.round(np.sin(np.pi * k / 4000) * np.sin(np.pi * k / 100), 2)  # straight parts, all at two digits
    for x, gap in ((line, True), (coarse, False), (padded, False), (rounded, False)):
        found = check_data(Measurements([top], STEP, [response(2)]), Record("EQ", STEP, x))
        assert ("A channel has gaps" in {each.kind for each in found}) == gap


@pytest.mark.slow
def test_real_records_and_measurements_are_left_alone(shared):
    named = {each.name for each in real_channels(shared) if find_sensor_faults(each.values, each.dimension)}
    # an accelerometer that is not level, and gravity
    assert all(name.startswith("Flexible_3_story") and name.endswith(("_y", "_z")) for name in named)
