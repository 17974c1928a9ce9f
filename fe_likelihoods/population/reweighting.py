"""Whether stored posteriors of single tests suffice for a hierarchical model: weights, tails and errors."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from samplers.estimates.pareto import pareto_shape

from ..checks.finding import Finding
from ..checks.population import check_reweighting
from ..priors.mixture_prior import REFITS
from ..text_tables import text_table
from .population_marginal import draw_products, inverse_prior, population_marginal
from .stored_posterior import resampled_description

if TYPE_CHECKING:
    from .hierarchical_posterior import HierarchicalPosterior

__all__ = ["HierarchyChecks", "ReweightingCheck", "check_hierarchy"]

_HYPER_SAMPLES = 100
_DRAWS = 500
_QUANTILE = 0.9  # of the Pareto shapes over the hyper-samples


class ReweightingCheck(NamedTuple):
    """How well the stored samples of one test serve the hierarchical model.

    The Pareto shape belongs to the upper tail of the inverse prior density over the posterior of the test in the
    hierarchy: where it is large, this posterior reaches values that the prior of the test, and therefore its samples,
    leave out.
    """

    pareto_shape: float  # 90 % quantile over the hyper-samples
    shift: float  # largest standard error that this test causes in a hyper-parameter's mean [posterior sd]


class HierarchyChecks(NamedTuple):
    """Reliability of a hierarchical result; errors from sampling the hyper-parameters are not included."""

    tests: dict[str, ReweightingCheck]
    mean_errors: dict[str, float]  # standard, from the finite samples of all tests [posterior sd]
    log_evidence_error: float  # standard, from the finite samples and the errors of the tests' evidences
    findings: tuple[Finding, ...]  # what is not reliable and what to do

    def __str__(self) -> str:
        rows = [("test", "Pareto", "shift")]
        rows += [(name, f"{each.pareto_shape:.2f}", f"{each.shift:.2f}") for name, each in self.tests.items()]
        lines = [text_table(rows)]
        worst = max(self.mean_errors, key=lambda name: self.mean_errors[name])
        lines.append(f"largest error of a mean: {self.mean_errors[worst]:.2f} posterior sd ({worst})")
        lines.append(f"error of the log-evidence: {self.log_evidence_error:.2f}")
        return "\n".join([*lines, *map(str, self.findings)])

    __repr__ = __str__


def check_hierarchy(posterior: "HierarchicalPosterior", samples: np.ndarray, seed: int = 0) -> HierarchyChecks:
    """Check the stored samples of every test at 100 evenly spaced samples of the hyper-parameters (n, ndim)."""
    rng = np.random.default_rng(seed)
    used = samples[np.linspace(0, len(samples) - 1, min(len(samples), _HYPER_SAMPLES)).astype(int)]
    found, changes = {}, []
    for name, described in posterior.described.items():
        center, sd = posterior.population(used, posterior.tests[name].covariates)
        change = np.empty((REFITS, len(used)))
        for row in change:
            row[:] = population_marginal(resampled_description(described, rng), center, sd)
        change -= population_marginal(described, center, sd)
        changes.append(change)
        drawn = draw_products(described, center, sd, _DRAWS, rng)
        with np.errstate(divide="ignore"):
            shapes = [pareto_shape(row) for row in np.log(inverse_prior(described, drawn))]
        found[name] = ReweightingCheck(
            float(np.sort(shapes)[int(_QUANTILE * (len(shapes) - 1))]),
            float(_mean_errors(used, change)[0].max()),
        )
    errors, evidence = _mean_errors(used, np.sum(changes, axis=0))
    evidences = sum(test.log_evidence_error**2 for test in posterior.tests.values())
    shapes = {name: each.pareto_shape for name, each in found.items()}
    return HierarchyChecks(
        found,
        dict(zip(posterior.parameter_names, errors.tolist(), strict=True)),
        float(np.sqrt(evidence**2 + evidences)),
        tuple(check_reweighting(shapes, float(errors.max()), list(posterior.varying))),
    )


def _mean_errors(samples: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, float]:
    """Standard errors of the means, in standard deviations, and of the log-evidence, if log-likelihoods change.

    `change` (n_resamplings, n) is added to the log-likelihood of the samples (n, ndim).
    """
    largest = change.max(axis=1, keepdims=True)
    weights = np.exp(change - largest)
    evidence = largest[:, 0] + np.log(weights.mean(axis=1))
    means = (weights / weights.sum(axis=1, keepdims=True)) @ samples
    deviations = samples.std(axis=0)
    return np.std(means, axis=0, ddof=1) / np.where(deviations > 0.0, deviations, 1.0), float(np.std(evidence, ddof=1))
