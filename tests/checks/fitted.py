"""Samples of a fit, without a run, and what is found in them."""

import numpy as np

from fe_likelihoods.checks.compared import compare, data_sets_of, draws_to_compare
from fe_likelihoods.checks.fit import check_parameters, check_responses, check_stated_errors, check_supports
from fe_likelihoods.checks.run import moments, rows_of
from fe_likelihoods.emulation.modes import find_modes


def fitted(posterior, starts=1):
    """A hundred samples of the normal approximation at the mode of a posterior."""
    mode = find_modes(posterior, starts=starts, seed=1).modes[0]
    rng, factor = np.random.default_rng(1), np.linalg.cholesky(mode.covariance)
    return posterior.prior.from_normal(mode.coords + rng.standard_normal((100, len(factor))) @ factor.T)


def check_fit(posterior, samples=None):
    """Findings about the fit at the mean of samples (n, ndim); before a run, of draws of the prior alone."""
    draws, found, fits = draws_to_compare(posterior), [], []
    if samples is not None:
        found += check_parameters(rows_of(posterior.parameters, posterior.prior, moments(samples)))
    for key, likelihood, columns in data_sets_of(posterior):
        own = None if samples is None else samples[:, columns]
        fits += compare(likelihood, draws[:, columns], key, None if own is None else own.mean(axis=0), samples=own)
        found += check_supports(likelihood.model)
    first = check_responses(fits)
    wrong = any(each.severity == "wrong" for each in first)
    return (*first, *([] if wrong else check_stated_errors(fits)), *found)
