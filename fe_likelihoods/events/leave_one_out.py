r"""A hierarchical model without one of its tests, for all tests in turn.

The population without test k is where its data may have kept no hyper-sample, so it is sampled anew. The predictive
density of the test's data is the ratio of both normalising constants,

.. math::

   p(D_k \mid D_{-k}) = \frac{p(D)}{p(D_{-k})}, \qquad
   p(\varphi \mid D) \propto p(\varphi \mid D_{-k})\, m_k(\varphi),

by bridge sampling between the samples of both, with the marginal likelihood :math:`m_k` of the test. No model is
simulated. See ``docs/theory/hierarchy.rst``.
"""

import warnings
from typing import NamedTuple

import numpy as np

from samplers.estimates.bridge import log_ratio

from ..text_tables import number, text_table
from .hierarchical_posterior import HierarchicalPosterior
from .hierarchy_result import Hierarchy

__all__ = ["LeftOut", "without_each"]

_WALKERS, _STEPS = 500, 4  # of a new run: a test that 1 % of 500 samples permit has a density with an error of 0.7


class LeftOut(NamedTuple):
    """The population without one test.

    The log predictive density of all the test's data given the other tests is a proper score: larger is better. It is
    NaN if its `StoredPosterior` has no `log_evidence`, and where no sample of the population without the test is within
    the test's prior. Its error is from the number of hyper-samples (taken as independent), the number of new samples,
    and the error of the evidence.
    """

    hierarchy: Hierarchy  # population of the other tests
    log_density: float
    log_density_error: float

    @property
    def cells(self) -> dict[str, str]:
        """The numbers as texts by headings, for `leave_one_out`."""
        return {"log density": number(self.log_density, 5), "its error": number(self.log_density_error, 2)}

    def __str__(self) -> str:
        return text_table([list(self.cells), list(self.cells.values())])


def without_each(hierarchy: Hierarchy, seed: int) -> dict[str, LeftOut]:
    """The population without each test in turn, see `fe_likelihoods.leave_one_out`."""
    posterior = hierarchy.posterior
    if len(posterior.tests) < 2:
        raise ValueError(f"leave_one_out needs two tests or more; got {', '.join(map(repr, posterior.tests))}")
    different = len(np.unique(hierarchy.samples, axis=0))
    if different < 2 * posterior.ndim:
        raise ValueError(
            f"leave_one_out: expected {2 * posterior.ndim} different hyper-samples or more, twice the number of "
            f"hyper-parameters; got {different}: sample the population with more walkers or steps"
        )
    log_marginals = posterior.log_marginals(hierarchy.samples)
    for name, column in zip(posterior.tests, log_marginals.T, strict=True):
        if impossible := int((~np.isfinite(column)).sum()):
            raise ValueError(
                f"leave_one_out: expected samples of the posterior of all tests; {impossible} of {len(column)} "
                f"hyper-samples are impossible under test {name!r}, such as common parameters beyond the bounds of its "
                "prior: start the walkers where HierarchicalPosterior.log_prob is finite"
            )
    rng, found = np.random.default_rng(seed), {}
    for k, name in enumerate(posterior.tests):
        rest, own = posterior.without(name), log_marginals[:, k]
        samples = _sample(rest, int(rng.integers(2**31)))
        log_density, error = log_ratio(own, posterior.log_marginals(samples)[:, k])
        if np.isnan(log_density):
            warnings.warn(
                f"leave_one_out: no sample of the population without test {name!r} is possible under this test, whose "
                f"prior of {', '.join(posterior.common)} ends beside that population: its predictive density is not "
                "known. Sample this test again with the prior of the hierarchical model",
                stacklevel=2,
            )
        stored = posterior.tests[name]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what limits the tests was said of all of them; checks have the rest
            population = Hierarchy(rest, samples, seed)
        found[name] = LeftOut(
            population,
            np.nan if stored.log_evidence is None else log_density,
            float(np.hypot(error, stored.log_evidence_error)),
        )
    return found


def _sample(posterior: HierarchicalPosterior, seed: int) -> np.ndarray:
    """Samples (n, ndim) of a posterior of hyper-parameters."""
    from samplers import SMCSampler

    run = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed)
    run.run_mcmc(None, _STEPS)
    return run.get_chain(flat=True)
