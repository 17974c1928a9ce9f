"""Energies of responses: closed forms, dimensions and units in every place, parts of histories, errors before a run."""

import warnings

import numpy as np
import pytest

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.prediction.exceedance import exceedance
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import (
    arias_intensity,
    displacement_before_failure,
    dissipated_energy,
    final_value,
    find_failure,
    measured_quantity,
    peak,
    rms,
)
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.units import G0

CHANNELS = (
    Channel("deck", "absolute acceleration", "g"),
    Channel("force", "lateral force", "kip"),
    Channel("drift", "relative displacement", "mm"),
)
DT, STEPS, OMEGA = 0.01, 401, 2.0 * np.pi  # four periods of one second
TIME = DT * np.arange(STEPS)
STIFFNESS, DASHPOT, LENGTH = 3.0e6, 2.0e5, 0.02


def respond(theta):
    """A spring and a dashpot under an imposed motion, and an acceleration of amplitude theta g."""
    drift, velocity = LENGTH * np.sin(OMEGA * TIME), LENGTH * OMEGA * np.cos(OMEGA * TIME)
    force = theta[0] * (STIFFNESS * drift + DASHPOT * velocity)
    return [theta[0] * G0 * np.sin(OMEGA * TIME), force, drift]


MODEL = FunctionModel(respond, ["gain"], CHANNELS, DT, STEPS)
SAMPLES = np.array([[0.8], [1.0], [1.3], [1.1]])
DATA = Measurements(CHANNELS, DT, respond([1.0]))
WORK = dissipated_energy("force", "drift")


def test_arias_intensity_of_a_sine_and_the_work_of_a_dashpot_are_their_closed_forms():
    both = propagate(MODEL, SAMPLES, quantity=[arias_intensity("deck"), WORK], progress=False)
    periods, gain = 4, SAMPLES[:, 0]
    np.testing.assert_allclose(both.values[:, 0], np.pi / (2 * G0) * (gain * G0) ** 2 * periods / 2, rtol=1e-12)
    work = periods * np.pi * gain * DASHPOT * OMEGA * LENGTH**2  # the spring stores nothing over whole cycles
    np.testing.assert_allclose(both.values[:, 1], work, rtol=(OMEGA * DT) ** 2)
    measured = measured_quantity([arias_intensity("deck"), WORK], DATA)
    np.testing.assert_allclose(measured, both.values[1], rtol=1e-12)


def test_work_of_an_elastic_plastic_loop_is_the_area_of_its_parallelogram():
    drift, force = np.array([0.0, 1, 5, 3, -5, -3, 1]), np.array([0.0, 2, 2, -2, -2, 2, 2])
    (channel,) = CHANNELS[1:2]
    loop = Measurements([channel], 1.0, force[None])
    assert measured_quantity(dissipated_energy("force", drift), loop) == pytest.approx(1.0 + 8.0 + 16.0 + 8.0)
    closed = dissipated_energy("force", drift, part=slice(1, None))  # from (1, 2) round to (1, 2)
    assert measured_quantity(closed, loop) == pytest.approx(2 * 2 * 8.0)


def test_an_energy_has_its_own_name_dimension_and_unit():
    both = propagate(MODEL, SAMPLES, quantity=[arias_intensity("deck"), WORK, peak("deck")], progress=False)
    assert [(c.name, c.dimension, c.unit) for c in both.channels] == [
        ("Arias intensity of deck", "velocity", "m/s"),
        ("energy of force", "energy", "kJ"),
        ("deck", "acceleration", "g"),
    ]
    row = str(both.score(DATA, interval_probability=0.5)).splitlines()[2].split()
    assert row[:5] == ["energy", "of", "force", "kJ", f"{measured_quantity(WORK, DATA) / 1e3:.3g}"]
    narrow = str(propagate(MODEL, 1.0 + 1e-5 * SAMPLES, quantity=peak("deck"), progress=False)).splitlines()[-1].split()
    assert len(set(narrow[5:])) == 3, "quantiles of a narrow prediction are told apart"
    work = propagate(MODEL, SAMPLES, quantity=WORK, progress=False)
    assert exceedance(work, 7.5, unit="kJ").probability == 0.25
    with pytest.raises(ValueError, match="a unit of energy, got 'kip'"):
        exceedance(work, 2.0, unit="kip")


@pytest.mark.parametrize("make", (peak, rms, arias_intensity, lambda name, part: dissipated_energy(name, TIME, part)))
def test_a_part_of_the_samples_is_that_of_the_trimmed_history(make):
    name = "force" if make not in (peak, rms, arias_intensity) else "deck"
    half = slice(STEPS // 2, None)
    trimmed = DATA.trim(TIME[half][0], TIME[-1])
    expected = {peak: peak, rms: rms, arias_intensity: arias_intensity}.get(make, None)
    whole = expected(name) if expected else dissipated_energy(name, TIME[half])
    predicted = propagate(MODEL, [[1.0]] * 3, quantity=make(name, half), quantiles=(), progress=False).mean
    assert predicted == pytest.approx(measured_quantity(whole, trimmed), rel=1e-12)
    assert measured_quantity(make(name, half), DATA) == pytest.approx(predicted, rel=1e-12)


def test_samples_may_be_missing_outside_of_the_part_only():
    values = DATA.values.copy()
    values[0, 3] = np.nan
    gap = Measurements(CHANNELS, DT, values)
    assert measured_quantity(peak("deck", slice(10, None)), gap) == pytest.approx(G0)
    with pytest.raises(ValueError, match="samples of channel 'deck' are missing"):
        measured_quantity(arias_intensity("deck"), gap)


@pytest.mark.parametrize(
    ("quantity", "match"),
    (
        (arias_intensity("force"), "needs a channel of acceleration; channel 'force' is 'lateral force'"),
        (dissipated_energy("deck", "drift"), "needs a channel of force, moment, stress"),
        (dissipated_energy("force", "roof"), "no channel 'roof'"),
        (dissipated_energy("force", TIME[:-1]), "has 401 samples, the array that belongs to it 400"),
        ([peak("deck"), peak("deck", slice(900, None))], "no sample of the 401"),
    ),
)
def test_impossible_quantities_are_refused_before_a_simulation(quantity, match):
    def never(theta):
        raise AssertionError("simulated")

    with pytest.raises(ValueError, match=match):
        propagate(FunctionModel(never, ["gain"], CHANNELS, DT, STEPS), SAMPLES, quantity=quantity, progress=False)


def test_displacements_are_finite_and_one_history_and_pairs_are_measured_at_the_same_times():
    with pytest.raises(ValueError, match=r"finite displacements \(n_steps,\)"):
        dissipated_energy("force", [[0.0, 1.0]])
    late = Measurements(CHANNELS[1:], DT, DATA.values[1:], start=(0.0, 0.5))
    with pytest.raises(ValueError, match="force, drift are measured at different times"):
        measured_quantity(WORK, late)
    assert final_value("drift").channel_names == ["drift"]


def test_the_displacement_before_failure_is_the_largest_one_with_80_percent_of_the_force():
    """Cycles of 1, 2, 3 and 3 mm; the force of each excursion is known."""
    displacement = np.concatenate([a * np.sin(np.linspace(0.0, 2.0 * np.pi, 81)[:-1]) for a in (1.0, 2.0, 3.0, 3.0)])

    def forces(*excursions):
        return np.concatenate([f * np.abs(np.sin(np.linspace(0.0, np.pi, 41)[:-1])) for f in excursions])

    shape = np.sign(displacement + 1e-12)
    for excursions, expected in (
        ((8, 8, 10, 10, 9, 9, 9, 9), 3.0),  # no failure: the whole history
        ((8, 8, 10, 10, 7, 9, 9, 9), 2.0),
        ((8, 8, 10, 10, 9, 7, 7, 7), 3.0),
        ((7, 7, 10, 10, 9, 9, 9, 7), 3.0),  # less force before the largest one is no failure
        ((8, 8, 10, 10, 8.1, 9, 9, 9), 3.0),
    ):
        force = shape * forces(*excursions)
        for given in (displacement, "u"):
            quantity = displacement_before_failure("f", given)
            assert quantity.evaluate([force, displacement], 1.0) == pytest.approx(expected, rel=1e-2)
        assert find_failure(force, displacement) <= len(force)
    measured = Measurements([Channel("f", "lateral force", "kN")], 1.0, [force])
    assert measured_quantity(displacement_before_failure("f", displacement), measured) == pytest.approx(3.0)
    with pytest.raises(ValueError, match="needs a channel of force; channel 'f' is 'displacement'"):
        shown = Measurements([Channel("f", "displacement", "mm")], 1.0, [force])
        measured_quantity(displacement_before_failure("f", displacement), shown)
    with pytest.raises(ValueError, match="displacement_before_failure: expected the name of a channel, or finite"):
        displacement_before_failure("f", [[1.0]])


def test_a_final_value_during_a_vibration_is_said_and_after_rest_it_is_not(rng):
    record = Record("noise", 0.02, rng.standard_normal(500))
    rest = record.followed_by(Record("rest", 0.02, [0.0, 0.0]), rest=60.0)

    def drifting(record):
        """An oscillator of 1 Hz beside a displacement that stays."""
        wave = LinearOscillator(record).simulate([1.0, 1.0])[1]
        return wave + 0.2 * np.abs(wave).max()

    free = record.followed_by(Record("rest", 0.02, [0.0, 0.0]), rest=8.0)
    last, period = final_value("top"), final_value("top", samples=50)
    for motion, quantity, expected in ((record, last, 1), (rest, last, 0), (free, last, 1), (free, period, 0)):
        channels = [Channel("top", "displacement", "mm")]
        model = FunctionModel(
            lambda theta, motion=motion: [theta[0] * drifting(motion)], ["g"], channels, 0.02, motion.n_steps
        )
        model.record = motion
        for wanted in (quantity, {"end": [quantity, peak("top")]}):
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                propagate(model, np.ones((5, 1)), quantity=wanted, progress=False)
            said = [str(each.message) for each in found]
            assert sum("still moves in the last 2 s" in text and "top (+- " in text for text in said) == expected
        with warnings.catch_warnings():  # the peak of the same response has no such remark
            warnings.simplefilter("error")
            propagate(model, np.ones((5, 1)), quantity=peak("top"), progress=False)
