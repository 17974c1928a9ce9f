"""One fault has several findings: the judgement says which to fix first, and which may follow from it."""

import numpy as np
import pytest

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    check_data,
)
from fe_likelihoods.checks.finding import judge, labelled
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.problems import table_motion
from fe_likelihoods.units import UNITS
from tests.checks.fitted import check_fit

MOTION = table_motion().trim(0.0, 10.0).resample(0.02)
MODEL = LinearOscillator(MOTION, 0.8)
RIGHT = MODEL.simulate([1.1, 0.9])
LEVEL = np.sqrt(np.mean(RIGHT**2, axis=1, keepdims=True))
NOISE = 0.1 * LEVEL * np.random.default_rng(3).standard_normal(RIGHT.shape)
LATE = 10  # steps of 0.02 s


def with_output(change):
    """The first channel is changed."""
    return lambda y: np.vstack([change(y[0]), y[1:]])


def swapped(y):
    """Each column is read with the unit of the other one."""
    one, other = (UNITS[channel.unit].factor for channel in MODEL.channels)
    return np.stack([y[1] * one / other, y[0] * other / one])


def held(y):
    y = y.copy()
    y[np.argmax(np.abs(y)) :][:25] = y[np.argmax(np.abs(y))]
    return y


def with_spikes(y):
    y = y.copy()
    y[[50, 170, 300, 390]] += 4.0 * np.abs(y).max()
    return y


FAULTS = {
    "unit": ({"A unit may be wrong"}, with_output(lambda y: y / 9.80665)),
    "gain": ({"A gain may be wrong"}, with_output(lambda y: 1.8 * y)),
    "sign": ({"A sign may be wrong"}, with_output(lambda y: -y)),
    "lag": ({"Clocks may differ"}, with_output(lambda y: np.r_[np.zeros(LATE), y[:-LATE]])),
    "swapped columns": ({"Channels may be swapped"}, swapped),
    "stuck": ({"A sensor was stuck", "A sensor is clipped"}, with_output(held)),
    "clipped": ({"A sensor is clipped"}, with_output(lambda y: np.clip(y, -0.3 * y.max(), 0.3 * y.max()))),
    "spikes": ({"A channel has spikes"}, with_output(with_spikes)),
    "offset": ({"A channel has an offset"}, with_output(lambda y: y + 1.0 * np.abs(y).max())),
    "unit of all": ({"A unit may be wrong"}, lambda y: 1e3 * y),
    "other motion": ({"The prior does not reach the measurements"}, lambda y: y[:, ::-1]),
}


def found_in(change):
    measured = Measurements(MODEL.channels, MODEL.dt, change(RIGHT + NOISE))
    prior = {"stiffness": LogNormal(1.0, 0.3), "damping": LogNormal(1.0, 0.3)}
    likelihood = FELikelihood(MODEL, measured)
    rms = zip(likelihood.noise.parameter_names, measured.root_mean_squares, strict=True)
    posterior = Posterior(likelihood, prior | {name: HalfNormal(float(each)) for name, each in rms})
    mode = find_modes(posterior, starts=1, seed=1).modes[0]
    samples = np.random.default_rng(1).multivariate_normal(mode.coords, mode.covariance, 200)
    return [*check_fit(posterior, posterior.prior.from_normal(samples)), *check_data(measured, MOTION)]


@pytest.mark.parametrize("fault", FAULTS)
def test_the_fault_is_first_and_what_it_does_to_the_fit_follows(fault):
    wanted, change = FAULTS[fault]
    judgement = judge(found_in(change))
    kinds = list(dict.fromkeys(each.kind for each in judgement.findings if each.severity != "note"))
    assert kinds[0] in wanted and kinds[0][1:] in str(judgement).split(";")[0]
    assert (len(kinds) > 1) == ("fix this first" in str(judgement))
    assert labelled(judgement.findings)[0].startswith(f"CAUTION: {kinds[0]}: ")


def test_some_faults_have_others_that_follow():
    found = [judge(found_in(FAULTS[fault][1])).findings for fault in ("stuck", "spikes", "clipped")]
    assert max(len({each.kind for each in one if each.severity != "note"}) for one in found) > 1
