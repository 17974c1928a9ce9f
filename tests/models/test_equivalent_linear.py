"""Equivalent-linear structures against the linear model, scipy's state-space solver, similarity, and a closed form."""

import math

import numpy as np
import pytest
from scipy import optimize, signal

from fe_likelihoods import (
    BridgeDeck,
    EquivalentLinear,
    FELikelihood,
    GaussianNoise,
    LinearStructure,
    Measurements,
    Record,
    ShearFrame,
    SimulationFailed,
    peak,
    propagate,
)
from fe_likelihoods.simulation.model import simulate_batch

DT, REFERENCE = 0.02, 0.004
FRAME = ShearFrame({"middle": 2, "roof": 3}, [1.0, 1.0, 0.8], [800.0, 700.0, 600.0])
FRAME_THETA = [1.0, 1.1, 0.9, 0.04, 0.05, 0.06]
DECK_THETA = [3.0, 0.06, 0.7]
NO_CHANGE, CHANGE = [0.0, 0.0], [0.3, 0.4]


@pytest.fixture
def three(rng) -> list[Record]:
    """Records of the base of a column and of two ends: noise of 0.4 s correlation, with a strong part."""
    time = DT * np.arange(600)
    envelope = 3.0 * np.exp(-(((time - 4.0) / 2.0) ** 2))
    return [
        Record(name, DT, envelope * signal.lfilter([0.4], [1.0, -0.8], rng.normal(size=600)))
        for name in ("base", "first", "second")
    ]


@pytest.fixture
def cases(three):
    """Linear parts, their supports, parameters, and the channel of the level."""
    return {"deck": (BridgeDeck("m"), three, DECK_THETA, None), "frame": (FRAME, three[:1], FRAME_THETA, "roof")}


def level(displacement: np.ndarray) -> float:
    return math.sqrt((displacement**4).sum() / (displacement**2).sum())


@pytest.mark.parametrize("name", ["deck", "frame"])
def test_without_softening_and_growth_it_is_the_linear_model_bit_for_bit(cases, name):
    parts, supports, theta, channel = cases[name]
    linear = LinearStructure(parts, supports)
    model = LinearStructure(EquivalentLinear(parts, REFERENCE, channel), supports)
    assert model.parameter_names == (*linear.parameter_names, "softening", "damping_growth")
    np.testing.assert_array_equal(model.simulate([*theta, *NO_CHANGE]), linear.simulate(theta))
    control = model.simulate([*theta, *CHANGE])
    assert np.abs(control - linear.simulate(theta)).max() > 0.05 * np.abs(control).max(), "control"


@pytest.mark.parametrize("scale", [0.03, 1.0, 10.0])
def test_the_fixed_point_holds_for_the_deck_by_scipy(three, scale):
    """Frequency and damping of the settled deck, put into scipy's solver, give a response of this level."""
    supports = [record.scale(scale) for record in three]
    parts = EquivalentLinear(BridgeDeck("m"), REFERENCE)
    model, (p, q) = LinearStructure(parts, supports), CHANGE
    base, first, second = (record.acceleration for record in supports)
    forcing = 0.3 * base + 0.35 * (first + second)
    found = parts.settle(np.array([*DECK_THETA, p, q]), np.stack([base, first, second]), DT)
    ratio = found.level / REFERENCE
    assert abs(math.log(ratio)) > 0.2, "control: not at the reference level"
    omega, zeta = 2 * math.pi * 3.0 * ratio ** (-p / 2), 0.06 * ratio**q
    matrices = [[0, 1], [-(omega**2), -2 * zeta * omega]], [[0], [-1]], [[1, 0]], [[0]]
    _, displacement, state = signal.lsim(matrices, forcing, DT * np.arange(600))
    assert level(displacement) == pytest.approx(found.level, rel=1e-9)
    (response,) = model.simulate([*DECK_THETA, p, q])
    absolute = -(omega**2) * state[:, 0] - 2 * zeta * omega * state[:, 1]
    np.testing.assert_allclose(response, absolute, rtol=0, atol=1e-9 * np.abs(absolute).max())


def test_the_level_of_a_long_sine_is_that_of_its_amplitude():
    """Steady state of amplitude A: l = A sqrt(3/4). The amplitude solves A = a / |dynamic stiffness(A)|."""
    forcing, strength, (p, q) = 5.0 * math.pi, 0.5, (0.2, 0.3)  # 80 samples per period
    parts = EquivalentLinear(ShearFrame({"top": 1}, [1.0], [1.0]), REFERENCE)

    # a sine with straight lines between its samples has this amplitude
    interpolated = strength * np.sinc(0.5 * forcing * 0.005 / np.pi) ** 2

    def excess(log_level):
        ratio = math.exp(log_level)
        omega, zeta = 20.0 * ratio ** (-p / 2), 0.1 * ratio**q
        amplitude = interpolated / abs(omega**2 - forcing**2 + 2j * zeta * omega * forcing)
        return math.sqrt(0.75) * amplitude / (REFERENCE * ratio) - 1.0

    expected = REFERENCE * math.exp(optimize.brentq(excess, -3.0, 3.0))
    levels = []
    for n_steps in (8000, 16000, 32000):
        motion = strength * np.sin(forcing * 0.005 * np.arange(n_steps))
        levels.append(parts.settle(np.array([400.0, 0.1, p, q]), motion[None], 0.005).level)
    errors = np.array(levels) / expected - 1.0  # of the transient, whose share of the record is halved twice
    np.testing.assert_allclose(errors[:-1] / errors[1:], 2.0, rtol=0.03)
    assert 2.0 * levels[2] - levels[1] == pytest.approx(expected, rel=1e-4)
    assert abs(math.log(expected / REFERENCE)) > 0.3, "control"


def test_the_log_likelihood_is_smooth(three):
    """Central differences of halved steps agree in second order, down to steps where only round-off is left."""
    model = LinearStructure(EquivalentLinear(BridgeDeck("m"), REFERENCE), three)
    theta = np.array([*DECK_THETA, *CHANGE])
    data = Measurements(model.channels, DT, model.simulate(theta * [1.02, 0.9, 1.05, 1.1, 0.9]))
    likelihood = FELikelihood(model, data, GaussianNoise(model.channels))

    def value(x):
        return likelihood.log_likelihood(np.append(x, 0.1))

    for i, name in enumerate(model.parameter_names):
        steps = 1e-2 * theta[i] * 0.25 ** np.arange(4)
        unit = np.eye(5)[i]
        slopes = np.array([(value(theta + h * unit) - value(theta - h * unit)) / (2 * h) for h in steps])
        errors = np.abs(np.diff(slopes))
        assert (errors[1:] < errors[:-1] / 8.0).all(), (name, errors)  # a sixteenth for a smooth function
        tiny = 1e-6 * theta[i]
        slope = (value(theta + tiny * unit) - value(theta - tiny * unit)) / (2 * tiny)
        assert slope == pytest.approx(slopes[-1], rel=1e-3), name


def test_impossible_parameters_fail_with_reasons_in_their_rows_only(three):
    model = LinearStructure(EquivalentLinear(BridgeDeck("m"), REFERENCE), three)
    good = [*DECK_THETA, *CHANGE]
    thetas = np.array([good, [-3.0, *good[1:]], [*DECK_THETA, 2.5, 0.0], [*DECK_THETA, 1e300, 0.0], [*good[:4], 1e300]])
    response, reasons = simulate_batch(model, thetas)
    assert [bool(reason) for reason in reasons] == [False, True, True, True, True]
    assert "frequency" in reasons[1] and "do not settle" in reasons[2] and "reference level of 0.004 m" in reasons[2]
    np.testing.assert_array_equal(response[0], model.simulate(good))
    with pytest.raises(SimulationFailed, match="above 1000 times the reference"):
        LinearStructure(EquivalentLinear(BridgeDeck("m"), 1e-9), three).simulate([*DECK_THETA, 0.0, 0.0])


def test_a_motion_of_zeros_has_a_response_of_zeros(three):
    silent = [record.scale(0.0) for record in three]
    parts = EquivalentLinear(BridgeDeck("m"), REFERENCE)
    assert parts.settle(np.array([*DECK_THETA, *CHANGE]), np.zeros((3, 600)), DT).level == 0.0
    assert not LinearStructure(parts, silent).simulate([*DECK_THETA, *CHANGE]).any()


def test_other_records_and_parts_of_records(three):
    """A later event has its own level; the first part of a response keeps the level of the whole record."""
    theta = [*DECK_THETA, *CHANGE]
    model = LinearStructure(EquivalentLinear(BridgeDeck("m"), REFERENCE), three, lead=1.0)
    weak = [record.scale(0.1) for record in three]
    other = model.with_record(weak)
    assert other.lead == 1.0 and other.fingerprint != model.fingerprint
    assert (
        np.abs(10.0 * other.simulate(theta) - model.simulate(theta)).max() > 0.1 * np.abs(model.simulate(theta)).max()
    )
    part = model.first(2.0)
    np.testing.assert_array_equal(part.simulate(theta), model.simulate(theta)[:, : part.n_steps])
    assert part.n_steps == 101 and part.with_record(three).fingerprint == model.fingerprint
    assert model.first(4.0).first(2.0).fingerprint == part.fingerprint != model.fingerprint
    with pytest.raises(ValueError, match="simulate each event alone"):
        model.followed_by(weak)
    with pytest.raises(ValueError, match="simulate each event alone"):
        propagate(model, [theta], record=weak, from_state="end", progress=False)
    predicted = propagate(model, [theta], record=weak, quantity=peak("m"), progress=False)
    assert predicted.values[0] == np.abs(other.simulate(theta)).max()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EquivalentLinear(FRAME, 0.0, "roof"), "positive reference of EquivalentLinear"),
        (lambda: EquivalentLinear(FRAME, math.nan, "roof"), "positive reference of EquivalentLinear"),
        (lambda: EquivalentLinear(FRAME, REFERENCE), "expected channel=, one of middle, roof"),
        (lambda: EquivalentLinear(FRAME, REFERENCE, "attic"), "got 'attic'"),
        (lambda: EquivalentLinear(EquivalentLinear(FRAME, REFERENCE, "roof"), REFERENCE, "roof"), "already"),
    ],
)
def test_wrong_arguments_are_rejected(make, words):
    with pytest.raises(ValueError, match=words):
        make()
