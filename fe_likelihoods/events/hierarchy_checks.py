"""Whether stored posteriors of single tests suffice for a hierarchical model: weights, tails, bounds and errors."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from samplers.estimates.pareto import LARGEST_SHAPE, pareto_shape

from ..text_tables import number, text_table
from .population_marginal import draw_products, inverse_prior, population_marginal, sample_weights
from .stored_posterior import resampled_description

if TYPE_CHECKING:
    from .hierarchical_posterior import HierarchicalPosterior

__all__ = ["HierarchyChecks", "ReweightingCheck", "check_hierarchy", "ends_within"]

_HYPER_SAMPLES = 100
_RESAMPLINGS = 12
_DRAWS = 500
# Limits of the warnings, chosen with study `hierarchy_warnings` of docs/results.rst, where the exact result is known.
_LARGEST_ERROR = 0.2  # of the mean of a hyper-parameter, in posterior standard deviations
_FEWEST_EFFECTIVE = ((20.0, 0.15), (1.0, 0.0))  # if the error of a mean is above the second number
_LARGEST_SHAPES = ((LARGEST_SHAPE, 0.1), (0.8, 0.0))  # Pareto shape, if the error of a mean is above the second number
_LARGEST_SHARE = 0.1  # of the hyper-samples at which weights may be unusable
_LARGEST_OUTSIDE = 0.05  # of a population beyond bounds that a test's samples reach
_LARGEST_OUTSIDE_SUM = 0.06  # sum over the tests, without the bounds at zero that positive parameters have
_OUTER = 0.02  # probability of the prior next to a bound
_PILED = 0.09  # posterior probability there, above which one bound alone is an alarm
_NEAR = 2.0  # standard deviations from the mean to a bound that is reached; 1.95 if 5 % of a normal density are cut off
_ROUND_OFF = 1e-9  # of the width of a prior, by which equal bounds may differ
_NORMAL = 0.5  # largest skewness and excess kurtosis of a prior that a normal density describes


class ReweightingCheck(NamedTuple):
    """How well the stored samples of one test serve the hierarchical model.

    Effective samples are NaN with common parameters, whose exact value is not among the samples. The Pareto shape
    belongs to the upper tail of the inverse prior density over the posterior of the test in the hierarchy. Above 0.7
    this posterior reaches values that the prior of the test, and therefore its samples, leave out; up to 0.8 this does
    no harm if the error of the means is small.
    """

    effective_samples: float  # of the weights, median over the hyper-samples
    sample_share: float  # of the marginal likelihood, mean; the rest is from the fitted mixture
    pareto_shape: float  # 90 % quantile over the hyper-samples
    outside: float  # mean probability of the population beyond prior bounds that the samples reach
    cut_off: float  # the same without the bounds at zero that positive parameters have
    error: float  # standard, of the log marginal likelihood: root mean square, from resampled samples
    shift: float  # largest standard error that this test causes in a hyper-parameter's mean [posterior sd]


class HierarchyChecks(NamedTuple):
    """Reliability of a hierarchical result; errors from sampling the hyper-parameters are not included."""

    tests: dict[str, ReweightingCheck]
    mean_errors: dict[str, float]  # standard, from the finite samples of all tests [posterior sd]
    log_evidence_error: float  # standard, from the finite samples and the errors of the tests' evidences
    messages: tuple[str, ...]  # what is not reliable and what to do

    def __str__(self) -> str:
        rows = [("test", "effective", "of samples", "Pareto", "outside", "error", "shift")]
        for name, each in self.tests.items():
            effective, share = number(each.effective_samples, 4), f"{each.sample_share:.0%}"
            others = f"{each.pareto_shape:.2f}", f"{each.outside:.1%}", f"{each.error:.2f}", f"{each.shift:.2f}"
            rows.append((name, effective, share, *others))
        lines = [text_table(rows)]
        worst = max(self.mean_errors, key=lambda name: self.mean_errors[name])
        lines.append(f"largest error of a mean: {self.mean_errors[worst]:.2f} posterior sd ({worst})")
        lines.append(f"error of the log-evidence: {self.log_evidence_error:.2f}")
        return "\n".join([*lines, *self.messages])


def check_hierarchy(posterior: "HierarchicalPosterior", samples: np.ndarray, seed: int = 0) -> HierarchyChecks:
    """Check the stored samples of every test at 100 evenly spaced samples of the hyper-parameters (n, ndim)."""
    rng = np.random.default_rng(seed)
    used = samples[np.linspace(0, len(samples) - 1, min(len(samples), _HYPER_SAMPLES)).astype(int)]
    center, factor = posterior.population(used)
    weighted = not posterior.common
    found, changes = {}, []
    for name, described in posterior.described.items():
        marginal = population_marginal(described, center, factor)
        change = np.empty((_RESAMPLINGS, len(used)))
        for row in change:
            row[:] = population_marginal(resampled_description(described, rng), center, factor).log_value
        change -= marginal.log_value
        changes.append(change)
        sizes = np.full(2, np.nan)
        drawn = draw_products(described, center, factor, _DRAWS, rng)
        with np.errstate(divide="ignore"):
            shapes = [pareto_shape(row) for row in np.log(inverse_prior(described, drawn))]
        if weighted:
            weights = sample_weights(described, center, factor)
            square = np.square(weights).sum(axis=1)
            independent = described.effective_sample_size * np.exp(2.0 * described.log_weights).sum()
            sizes = np.where(square > 0.0, min(independent, 1.0) / np.where(square > 0.0, square, 1.0), 0.0)
        found[name] = ReweightingCheck(
            float(np.median(sizes)),
            float(marginal.sample_share.mean()),
            float(np.sort(shapes)[int((1.0 - _LARGEST_SHARE) * (len(shapes) - 1))]),
            *_outside(posterior, name, center, factor, rng),
            float(np.sqrt(np.mean(np.var(change, axis=0, ddof=1)))),
            float(_mean_errors(used, change)[0].max()),
        )
    errors, evidence = _mean_errors(used, np.sum(changes, axis=0))
    evidences = sum(test.log_evidence_error**2 for test in posterior.tests.values())
    return HierarchyChecks(
        found,
        dict(zip(posterior.parameter_names, errors.tolist(), strict=True)),
        float(np.sqrt(evidence**2 + evidences)),
        (*_messages(posterior, found, errors), *_common_messages(posterior, samples)),
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


def _outside(
    posterior: "HierarchicalPosterior", name: str, center: np.ndarray, factor: np.ndarray, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean probability of the populations beyond bounds of a test's prior that its samples reach; and not at zero."""
    described, varying = posterior.described[name], len(posterior.varying)
    if not np.isfinite(described.prior.bounds[:varying]).any():
        return 0.0, 0.0
    reached = _reached(posterior, name)
    z = rng.standard_normal((len(center), 20, varying))
    draws = center[:, None, :varying] + np.einsum("nij,nkj->nki", factor, z)
    values = posterior.from_scale(np.concatenate([draws, np.zeros((*draws.shape[:2], len(posterior.common)))], axis=-1))
    beyond, cut_off = np.zeros((2, *draws.shape[:2]), dtype=bool)
    for i, (low, high) in enumerate(described.prior.bounds[:varying]):
        outside = (values[..., i] < low) & reached[i, 0], (values[..., i] > high) & reached[i, 1]
        beyond |= outside[0] | outside[1]
        cut_off |= (outside[0] & (low != 0.0)) | (outside[1] & (high != 0.0))
    return float(beyond.mean()), float(cut_off.mean())


def _reached(posterior: "HierarchicalPosterior", name: str) -> np.ndarray:
    """Whether a test's samples reach the lower and the upper end of each varying parameter's prior."""
    return _probability_at_bounds(posterior, name) > 0.5 * _OUTER


def _probability_at_bounds(posterior: "HierarchicalPosterior", name: str) -> np.ndarray:
    """Share (n_varying, 2) of a test's samples in the outer 2 % of the prior at its lower and upper end."""
    samples = posterior.from_scale(posterior.described[name].points)[:, : len(posterior.varying)]
    weights, prior = np.exp(posterior.described[name].log_weights), _prior_draws(posterior, name)
    low, high = np.quantile(prior, [_OUTER, 1.0 - _OUTER], axis=0)
    return np.stack([weights @ (samples < low), weights @ (samples > high)], axis=1)


def _flat(posterior: "HierarchicalPosterior", name: str) -> list[str]:
    """Varying parameters that reach both bounds, or pile up at one, of a prior that is not normal on their scale."""
    bounds = posterior.described[name].prior.bounds[: len(posterior.varying)]
    at_bounds = np.where(np.isfinite(bounds), _probability_at_bounds(posterior, name), 0.0)
    flat = (at_bounds > 0.5 * _OUTER).all(axis=1) | (at_bounds > _PILED).any(axis=1)
    draws = posterior.scales.first(len(posterior.varying)).to_scale(_prior_draws(posterior, name))
    return [each for each, is_flat, row in zip(posterior.varying, flat, draws.T, strict=True) if is_flat and _far(row)]


def _far(draws: np.ndarray) -> bool:
    """Whether draws of a prior are far from normal on their scale; draws beyond its bounds do not count."""
    known = draws[np.isfinite(draws)]
    z = (known - known.mean()) / known.std()
    return not max(abs((z**3).mean()), abs((z**4).mean() - 3.0)) <= _NORMAL  # too few draws: NaN


def _prior_draws(posterior: "HierarchicalPosterior", name: str) -> np.ndarray:
    """Prior draws (n, n_varying) of the varying parameters in a test."""
    prior = posterior.tests[name].prior
    return prior.rvs(20_000, 0)[:, [prior.names.index(each) for each in posterior.varying]]


def _messages(posterior: "HierarchicalPosterior", found: dict[str, ReweightingCheck], errors: np.ndarray) -> list[str]:
    """Sentences about what is not reliable."""
    messages = []
    parameters = ", ".join(posterior.varying)
    error, cut_off = errors.max(), np.array([each.cut_off for each in found.values()])
    # summed over the tests, small losses matter: those with the largest ones are named
    named = 0.5 * cut_off.max() if cut_off.sum() > _LARGEST_OUTSIDE_SUM else np.inf
    for name, each in found.items():
        if any(each.pareto_shape > shape and error > smallest for shape, smallest in _LARGEST_SHAPES):
            messages.append(
                f"test {name!r}: the population reaches values that the prior of this test, and therefore its samples, "
                f"leave out (Pareto shape {each.pareto_shape:.2f}, above {_LARGEST_SHAPES[0][0]}): the spread between "
                f"tests is not reliable. Sample this test again with a wider prior of {parameters}"
            )
        elif each.outside > _LARGEST_OUTSIDE or each.cut_off > named:
            messages.append(
                f"test {name!r}: its samples reach a bound of its prior, and {each.outside:.1%} of the population is "
                f"beyond that bound, where the likelihood is taken as zero. Unless the bound is physical, sample this "
                f"test again with a wider prior of {parameters}"
            )
        elif any(each.effective_samples < fewest and error > smallest for fewest, smallest in _FEWEST_EFFECTIVE):
            messages.append(
                f"test {name!r}: the population is narrower than its posterior, or beside it: the weights have an "
                f"effective sample size of {each.effective_samples:.0f} (median), and "
                f"{1.0 - each.sample_share:.0%} of its marginal likelihood is from the fitted mixture. Give more "
                "samples of this test, or draw fresh samples with the population as its prior"
            )
    # the mixture, which alone serves common parameters, does not describe a density that ends at a bound
    flat = {name: _flat(posterior, name) for name in found} if posterior.common else {}
    if named := ", ".join(f"{each} in {test!r}" for test, names in flat.items() for each in names):
        messages.append(
            f"{named}: the samples reach both bounds of the prior, or pile up at one, and with common parameters "
            f"({', '.join(posterior.common)}) the likelihood is from a fitted mixture, which is not reliable at a "
            "bound. Sample these tests again with a prior that is normal on the scale of the population, such as "
            "LogNormal for scale='log' and scipy.stats.johnsonsb(0.0, 0.6, low, high - low) for scale='logit', or, "
            "where they say little about the parameter, leave them out"
        )
    if error > _LARGEST_ERROR:
        worst = max(found, key=lambda name: found[name].shift)
        messages.append(
            f"the finite samples of the tests give the mean of {posterior.parameter_names[int(errors.argmax())]} an "
            f"error of {error:.1f} posterior standard deviations, mostly from test {worst!r}: give more samples "
            "of the tests"
        )
    return messages


def ends_within(posterior: "HierarchicalPosterior", name: str, others: Iterable[str] = ()) -> dict[str, list[float]]:
    """Prior bounds of a test that leave out values of common parameters which the other tests' priors permit.

    Bounds [unit of the parameter] by the name of the common parameter; no entry where nothing is left out.
    """
    first = posterior.ndim - len(posterior.common)
    permitted = [posterior.prior.bounds[first:], *(_common_bounds(posterior, other) for other in others)]
    low, high = np.max(permitted, axis=0)[:, 0], np.min(permitted, axis=0)[:, 1]
    own = _common_bounds(posterior, name)
    widths = np.diff(own)
    # of the width, and of the bound itself where the other one is infinite
    round_off = _ROUND_OFF * np.where(np.isfinite(widths), widths, np.where(np.isfinite(own), np.abs(own), 0.0))
    left_out = np.stack([own[:, 0] - round_off[:, 0] > low, own[:, 1] + round_off[:, 1] < high], axis=1)
    return {
        common: bounds[is_within].tolist()
        for common, bounds, is_within in zip(posterior.common, own, left_out, strict=True)
        if is_within.any()
    }


def _common_bounds(posterior: "HierarchicalPosterior", name: str) -> np.ndarray:
    """Prior bounds (n_common, 2) of the common parameters in a test."""
    return posterior.described[name].prior.bounds[len(posterior.varying) :]


def _common_messages(posterior: "HierarchicalPosterior", samples: np.ndarray) -> list[str]:
    """Sentences about tests whose priors end within the population of a common parameter."""
    column = posterior.parameter_names.index
    return [
        f"test {name!r}: its prior of the common parameter {common} ends at {bound:g}, which the hyper-samples reach, "
        f"and beyond which the likelihood is taken as zero. The prior of {common} in the hierarchical model does not "
        f"end there: sample this test again with a wider prior of {common}, or, if the bound is physical, give it to "
        "the prior in common= too"
        for name in posterior.tests
        for common, bounds in ends_within(posterior, name).items()
        for bound in bounds
        if abs(bound - samples[:, column(common)].mean()) < _NEAR * samples[:, column(common)].std()
    ]
