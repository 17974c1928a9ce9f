"""A model that costs nothing, with an exact response: for tests of what stands between a sampler and a model."""

from typing import NamedTuple

import numpy as np

from fe_likelihoods import Channel
from fe_likelihoods.simulation.model import SimulationBatch, SimulationFailed, misfit_of_responses, simulate_batch


class Misfits(NamedTuple):
    """Statistics of many parameter sets."""

    misfit: np.ndarray
    reasons: list[str]


def misfit_batch(model, thetas, measured, pool=None, statistic=None):
    """Statistics of many parameter sets."""
    return Misfits(*misfit_of_responses(model, simulate_batch(model, thetas, pool), measured, statistic))


class Line:
    """Response ``theta[0] + theta[1] t`` in two channels; fails for a slope above `steepest`; counts its runs."""

    parameter_names = ("offset", "slope")
    channels = (Channel("a", "acceleration", "m/s2"), Channel("b", "displacement", "m"))
    dt = 0.5
    n_steps = 8
    reason = "\N{GREEK SMALL LETTER THETA} too steep"

    def __init__(self, steepest=1.0, fingerprint="line"):
        self.steepest, self.fingerprint = steepest, fingerprint
        self.runs = 0

    def simulate(self, theta):
        self.runs += 1
        if theta[1] > self.steepest:
            raise SimulationFailed(self.reason)
        return self.response(theta)

    def response(self, theta):
        line = theta[0] + theta[1] * self.dt * np.arange(self.n_steps)
        return np.vstack([line, -line])


class Batched(Line):
    """The same model with a batch method, whose batches have `sizes`; a response that fails is not NaN in it."""

    def __init__(self, *args):
        super().__init__(*args)
        self.sizes = []

    def simulate_batch(self, thetas):
        self.sizes.append(len(thetas))
        self.runs += len(thetas)
        reasons = [self.reason if slope > self.steepest else "" for slope in thetas[:, 1]]
        return SimulationBatch(np.array([self.response(theta) for theta in thetas]), reasons)
