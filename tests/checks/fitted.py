"""Samples of a fit, without a run."""

import numpy as np

from fe_likelihoods.emulation.modes import find_modes


def fitted(posterior, starts=1):
    """A hundred samples of the normal approximation at the mode of a posterior."""
    mode = find_modes(posterior, starts=starts, seed=1).modes[0]
    rng, factor = np.random.default_rng(1), np.linalg.cholesky(mode.covariance)
    return posterior.prior.from_normal(mode.coords + rng.standard_normal((100, len(factor))) @ factor.T)
