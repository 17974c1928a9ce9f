"""Gains, signs and clocks are known where no parameter changes the response, whatever a fit makes of them."""

import numpy as np
import pytest

from fe_likelihoods import (
    BridgeDeck,
    LinearOscillator,
    LinearStructure,
    LogNormal,
    Measurements,
    Record,
    SensedModel,
    Sensor,
    ShearFrame,
    Uniform,
)
from fe_likelihoods.checks.faults import _spectra, slow_motion
from fe_likelihoods.checks.finding import in_order
from fe_likelihoods.checks.model import check_responses, check_supports
from fe_likelihoods.likelihood.fits import Fit

STEP, TIME = 0.01, 0.01 * np.arange(2000)
PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}


def motions(rng, n=3):
    """Motions that are alike where they are slow, as the supports of a short bridge have them."""
    envelope = np.exp(-(((TIME - 8.0) / 4.0) ** 2))
    kernel = np.hanning(30)
    common = np.convolve(rng.standard_normal(len(TIME)), kernel, "same")
    own = [np.convolve(rng.standard_normal(len(TIME)), np.diff(kernel, 2), "same") for _ in range(n)]
    return [Record(f"support {k}", STEP, envelope * (common + 30.0 * each)) for k, each in enumerate(own)]


def deck(rng):
    return LinearStructure(BridgeDeck("deck"), motions(rng))


def draws_of(model, rng, n=40):
    low, high = np.array([0.5, 0.005, 0.0]), np.array([10.0, 0.8, 1.0])
    return np.stack([model.simulate(low + (high - low) * rng.random(3))[0] for _ in range(n)])


def slow(values, draws):
    there = np.isfinite(values)
    return slow_motion(_spectra(values, there), _spectra(draws, there), STEP, len(values))


def later(values, steps):
    return np.concatenate([np.zeros(steps), values[: len(values) - steps]])


@pytest.mark.parametrize(
    ("seed", "gain", "steps"),
    [(0, 1.0, 0), (1, 0.5, 0), (2, 2.0, 0), (3, -1.0, 0), (4, 9.80665, 0), (5, 1.0, 5), (6, 0.5, 40)],
)
def test_gain_and_lag_of_a_damped_deck_are_found_without_a_fit(seed, gain, steps):
    rng = np.random.default_rng(seed)
    model = deck(rng)
    draws, true = draws_of(model, rng), model.simulate([4.5, 0.1, 0.7])[0]
    noise = np.convolve(rng.standard_normal(len(true)), np.ones(4) / 2.0, "same")
    measured = gain * later(true, steps) + 0.05 * abs(gain) * true.std() * noise
    gappy = np.where(np.abs(TIME - 7.3) < 0.2, np.nan, measured)
    for values in (measured, gappy):
        found = slow(values, draws)
        # draws and truth agree to a tenth
        assert np.sign(found.gain) == np.sign(gain) and abs(np.log(found.gain / gain)) < 0.2
        assert abs(found.lag - STEP * steps) < 0.021  # from 0.025 on it is named
        assert found.after**2 < 0.1 and found.band[1] < 4.5


def test_nothing_is_known_where_the_draws_disagree_or_are_few():
    rng = np.random.default_rng(2)
    model = LinearOscillator(motions(rng, 1)[0], 0.3)
    relative = np.stack([model.simulate(theta)[1] for theta in rng.uniform(0.3, 2.0, (40, 2))])
    assert slow(relative[0], relative[1:]) is None  # a = omega^2 x depends on the stiffness
    assert slow(TIME, np.zeros((10, len(TIME)))) is None
    assert slow(TIME, np.ones((4, len(TIME)))) is None


def findings(values, fit, draws):
    model = deck(np.random.default_rng(3))
    measured = Measurements(model.channels, STEP, values[None])
    return {each.kind: each for each in check_responses([Fit("", measured, draws[:, None], fit[None])])}


def test_what_a_fit_makes_up_for_is_wrong_and_a_right_fit_is_left_alone():
    rng = np.random.default_rng(3)
    model = deck(rng)
    draws, true = draws_of(model, rng), model.simulate([4.5, 0.1, 0.7])[0]
    assert findings(true, model.simulate([4.4, 0.11, 0.7])[0], draws) == {}
    gain = findings(0.5 * true, model.simulate([9.9, 0.78, 0.6])[0], draws)["A gain may be wrong"]
    assert gain.severity == "wrong" and gain.numbers["factor"] == pytest.approx(0.5, rel=0.1)
    late = findings(later(true, 5), model.simulate([3.4, 0.4, 0.9])[0], draws)["Clocks may differ"]
    assert late.severity == "wrong" and late.numbers["lag"] == pytest.approx(0.05, abs=0.01)
    other = findings(np.convolve(rng.standard_normal(len(true)), np.ones(9), "same"), true, draws)
    first, second = in_order(other.values())  # the first one is found before a run, too
    assert (first.kind, first.severity, second.severity) == (
        "The prior does not reach the measurements",
        "wrong",
        "wrong",
    )


def test_white_noise_is_no_fault_of_a_fit_but_spikes_are():
    rng = np.random.default_rng(4)
    model = deck(rng)
    draws, true = draws_of(model, rng), model.simulate([4.5, 0.1, 0.7])[0]
    noise = true.std() * rng.standard_normal(len(true))
    assert findings(true + 0.8 * noise, true, draws) == findings(true + 2.0 * noise, true, draws) == {}
    spikes = np.where(np.arange(len(true)) % 200 == 150, 20.0 * true.std(), 0.0)
    assert findings(true + spikes, true, draws)["The model does not follow the measurements"].severity == "wrong"


def test_a_support_with_another_gain_sign_or_clock_is_named():
    """Its share in the response makes up for it, so that no fit shows it; the other supports do."""
    first, second, third = motions(np.random.default_rng(7))

    def deck_of(*motions):
        return LinearStructure(BridgeDeck("deck"), motions)

    def found(factor):
        return check_supports(deck_of(first, second.scale(factor), third))

    assert found(1.0) == found(1.3) == found(0.0) == []
    for factor, kind in ((1.8, "gain"), (0.6, "gain"), (-1.0, "sign"), (1.0 / 9.80665, "unit")):
        (each,) = found(factor)
        assert (each.kind, each.severity) == (f"A {kind} may be wrong", "wrong"), factor
        assert each.text.startswith('motion "support 1": ')
        assert factor < 0.0 or each.numbers == {"factor": pytest.approx(factor, rel=0.2)}
    (each,) = check_supports(deck_of(first, Record(second.name, STEP, later(second.acceleration, 10)), third))
    assert (each.kind, each.severity) == ("Clocks may differ", "care") and 'support 1": its slow motions' in each.text
    own = [motions(np.random.default_rng(800 + k))[k].acceleration for k in range(3)]
    noisy = [Record(x.name, STEP, x.acceleration + 0.3 * own[k]) for k, x in enumerate((first, second, third))]
    assert check_supports(deck_of(*noisy)) == []  # clocks are not known so well
    halved = deck_of(first, second.scale(0.5), third)
    assert check_supports(SensedModel(halved, inputs={1: Sensor(gain=LogNormal(1.0, 0.5))})) == []
    other = motions(np.random.default_rng(8))[0]  # of another site: nothing is known
    assert check_supports(deck_of(first, other, other.scale(2.0))) != []
    assert check_supports(deck_of(first, other.scale(2.0), third)) == []
    assert check_supports(LinearStructure(ShearFrame({"roof": 1}, [1.0], [900.0]), first)) == []
    assert check_supports(LinearOscillator(first)) == []
