"""Samples of a fit, without a run, and what is found in them."""

import numpy as np

from fe_likelihoods.checks.model import check_responses, check_stated_errors, check_supports
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.likelihood.fits import compare


def fitted(posterior, starts=1):
    """A hundred samples of the normal approximation at the mode of a posterior."""
    mode = find_modes(posterior, starts=starts, seed=1).modes[0]
    rng, factor = np.random.default_rng(1), np.linalg.cholesky(mode.covariance)
    return posterior.prior.from_normal(mode.coords + rng.standard_normal((100, len(factor))) @ factor.T)


def check_fit(posterior, samples=None):
    """Findings about the fit at the mean of samples (n, ndim); before a run, of draws of the prior alone."""
    fits = compare(posterior, samples, None if samples is None else samples.mean(axis=0))
    supports = [each for part, _ in posterior.likelihood.data_sets() for each in check_supports(part.model)]
    first = check_responses(fits)
    wrong = any(each.severity == "wrong" for each in first)
    return (*first, *([] if wrong else check_stated_errors(fits)), *supports)
