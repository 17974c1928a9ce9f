"""Posterior samples of one test, as input of a hierarchical model, and a description of them by a mixture.

`StoredPosterior` holds what a sampler has stored: samples, the prior with which they were drawn, and the evidence.
`DescribedPosterior` is the part of it that a hierarchical model needs: the samples of some parameters on the scale of
the population, the prior density at them, and a mixture of normal distributions fitted to them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

from samplers.estimates.weights import effective_sample_size
from samplers.proposals.mixture import POINTS_PER_DIMENSION
from samplers.resampling import systematic

from ..checks.finding import NOTE, Finding
from ..priors.distributions import TruncatedNormal
from ..priors.mixture_prior import MixtureDistribution, fit_mixture
from ..priors.points import as_points
from ..priors.priors import Prior
from ..priors.scales import Scales

if TYPE_CHECKING:
    from ..emulation.modes import ModeSearch

__all__ = [
    "DescribedPosterior",
    "NormalLikelihood",
    "StoredPosterior",
    "describe",
    "log_density_on_scale",
    "normal_likelihood",
    "on_scale",
    "resampled_description",
]


_LEAST_INFORMATION = 1.0  # of the data about a direction, relative to the prior, below which it is left to the prior
_UNSEEN = 1e-6  # information about such a direction
_PRIOR_DRAWS = 20_000  # for the moments of a prior
_MOST = 1000  # samples of a test in a hierarchical model; the time of an evaluation is proportional to them


@dataclass(frozen=True, eq=False)
class StoredPosterior:
    """Posterior samples of one test, with the prior and the evidence.

    Parameters
    ----------
    samples : (n, dim) array_like, or mapping of str to (n,) array_like
        Posterior samples with all parameters of `prior`, in its order, such as ``sampler.get_chain(flat=True)``, or
        ``emcee.backends.HDFBackend("run.h5").get_chain(flat=True)`` for a stored run.
    prior : Prior
        Prior with which the samples were drawn (``posterior.prior``).
    log_weights : (n,) array_like, optional
        Logarithms of the importance weights of the samples, up to a constant. Default: equal weights.
    log_evidence : float, optional
        Log-evidence of the test. It adds a constant to the log-likelihood of the hyper-parameters. Without it the
        evidence of the hierarchical model lacks this constant; nothing else changes.
    log_evidence_error : float
        Standard error of `log_evidence`.
    effective_sample_size : float, optional
        Effective number of independent samples, for the statistical errors. Default: the number of distinct samples,
        or for weighted samples the effective sample size of the weights.
    findings : sequence of Finding
        What speaks against the samples, which `stiffness_loss` passes on.
    covariates : mapping of str to float
        Conditions of the test on which parameters depend, such as ``{"temperature": 12.0}`` [°C] or the logarithm of
        an amplitude (`Varying.slopes`, `stiffness_loss`).

    Raises
    ------
    ValueError
        If the samples have another dimension than the prior or are not finite, a sample has no prior density, or an
        argument has another shape or is out of range.

    Examples
    --------
    >>> stored = StoredPosterior(samples, posterior.prior, log_evidence=sampler.log_evidence)
    >>> stored.samples.shape
    (300, 4)
    """

    samples: Any
    prior: Prior
    log_weights: Any = None
    log_evidence: float | None = None
    log_evidence_error: float = 0.0
    effective_sample_size: float | None = None
    findings: Sequence[Finding] = ()
    covariates: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def from_run(cls, sampler: Any, posterior: Any, covariates: Mapping[str, float] | None = None) -> "StoredPosterior":
        """Posterior of a finished run of `samplers.SMCSampler` or `samplers.TMCMCSampler`, with its evidence.

        After a run with a guide that has an emulator, the samples are the many draws of the emulated posterior, whose
        covariances are more accurate than covariances of the chain. What the verdict found is kept, but for notes.

        Parameters
        ----------
        sampler : SMCSampler or TMCMCSampler
        posterior : Posterior
            The sampled posterior.
        covariates : mapping of str to float, optional
            As above.

        Returns
        -------
        StoredPosterior

        Examples
        --------
        >>> StoredPosterior.from_run(sampler, posterior).samples.shape
        (300, 4)
        """
        verdict, signed = sampler.verdict, sampler.signed_sample
        findings = [each for each in verdict.findings if each.severity != NOTE]
        evidence = float(sampler.log_evidence), float(sampler.log_evidence_error)
        if signed is None or verdict.status == "not usable":
            samples, weights = sampler.get_chain(flat=True), None
            size = min(verdict.effective_sample_size, len(samples))
        else:
            known = (signed.rounds == 0) & (signed.weights > 0.0)
            samples, weights = signed.coords[known], np.log(signed.weights[known])
            size = None
        return cls(samples, posterior.prior, weights, *evidence, size, findings, covariates or {})

    @classmethod
    def from_search(
        cls,
        search: "ModeSearch",
        posterior: Any,
        n: int = 5000,
        seed: int = 0,
        covariates: Mapping[str, float] | None = None,
    ) -> "StoredPosterior":
        """Draws of the Laplace approximation at the highest mode of a search: few simulations, and no check of it.

        Variances along a curved ridge are too small, and nothing in the search shows it (``docs/stiffness_loss.rst``).

        Parameters
        ----------
        search : ModeSearch
            Result of `Posterior.mode`. What it says against one mode is a finding.
        posterior : Posterior
            The posterior that was searched.
        n, seed : int
            Number of draws, and their seed.
        covariates : mapping of str to float, optional
            As above.

        Returns
        -------
        StoredPosterior

        Raises
        ------
        ValueError
            If the search found no mode, several ones, or ended early.
        """
        if len(search.modes) != 1 or not search.finished or not search.modes[0].converged:
            raise ValueError(
                f"the search found {len(search.modes)} modes, or ended early: use more starts or a larger limit of "
                "simulations, or sample the posterior"
            )
        mode = search.modes[0]
        coords = np.random.default_rng(seed).multivariate_normal(mode.coords, mode.covariance, n, method="cholesky")
        return cls(posterior.prior.from_normal(coords), posterior.prior, covariates=covariates or {})

    def __post_init__(self) -> None:
        if not isinstance(self.prior, Prior):
            raise ValueError(
                f"StoredPosterior: prior must be the Prior with which the samples were drawn (posterior.prior); got "
                f"{self.prior!r}"
            )
        points = as_points(self.samples, self.prior.names)
        if points.ndim != 2 or not len(points):
            raise ValueError(f"StoredPosterior: expected samples of shape (n, {self.prior.dim}); got {points.shape}")
        if not np.isfinite(points).all():
            raise ValueError("StoredPosterior: the samples must be finite; leave the others out")
        if (impossible := np.flatnonzero(np.isneginf(self.prior.logpdf(points)))).size:
            raise ValueError(
                f"StoredPosterior: {impossible.size} of {len(points)} samples have no prior density, the first is "
                f"{points[impossible[0]]}; give the prior with which the samples were drawn"
            )
        weights = np.zeros(len(points)) if self.log_weights is None else np.array(self.log_weights, dtype=float)
        if weights.shape != (len(points),) or not (weights < np.inf).all() or not np.isfinite(weights).any():
            raise ValueError(
                f"StoredPosterior: log_weights needs one number below infinity for each of the {len(points)} samples; "
                f"got shape {weights.shape}"
            )
        weights = weights - weights.max()
        weights -= np.log(np.exp(weights).sum())
        effective = self.effective_sample_size
        if effective is None:
            distinct = len(np.unique(points, axis=0))
            effective = distinct if self.log_weights is None else min(effective_sample_size(weights), len(points))
        values = [0.0 if self.log_evidence is None else self.log_evidence, self.log_evidence_error, effective]
        if not np.isfinite(values).all() or values[1] < 0.0 or not 1.0 <= values[2] <= len(points):
            raise ValueError(
                "StoredPosterior: expected a finite log_evidence, a log_evidence_error of 0 or more, and an "
                f"effective_sample_size between 1 and the {len(points)} samples; got {values}"
            )
        for name, value in (
            ("samples", points),
            ("log_weights", weights),
            ("effective_sample_size", float(effective)),
            ("findings", tuple(self.findings)),
            ("covariates", {name: float(each) for name, each in self.covariates.items()}),
        ):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        n, names = len(self.samples), ", ".join(self.prior.names)
        return f"<StoredPosterior: {n} samples of {names}; effective sample size {self.effective_sample_size:.0f}>"


class DescribedPosterior(NamedTuple):
    """Posterior samples of some parameters on the scale of a population, and a mixture fitted to them."""

    points: np.ndarray  # (n, dim)
    log_weights: np.ndarray  # (n,), of weights with sum 1
    lowest: float  # logarithm of the smallest prior density of the points
    prior: Prior  # before the change of scale
    scales: Scales
    log_shares: np.ndarray  # (n_components,)
    means: np.ndarray  # (n_components, dim)
    covariances: np.ndarray  # (n_components, dim, dim)
    mixture: MixtureDistribution  # in standardised coordinates
    effective_sample_size: float  # number of independent samples

    def log_prior_at(self, points: np.ndarray) -> np.ndarray:
        """Logarithm of the prior density (...) of points (..., dim) on the scale of the population."""
        return log_density_on_scale(self.prior, self.scales, points)


def on_scale(stored: StoredPosterior, names: Sequence[str], scales: Scales) -> tuple[Prior, np.ndarray]:
    """Prior of some parameters, and their samples (n, dim) on their scales; ValueError as `describe`."""
    if missing := [name for name in names if name not in stored.prior.names]:
        raise ValueError(
            f"the stored samples have no parameters {', '.join(missing)}; they have {', '.join(stored.prior.names)}"
        )
    prior = stored.prior.subset(names)
    values = stored.samples[:, [stored.prior.names.index(name) for name in names]]
    if not (values > 0.0)[:, scales.is_log].all():
        wrong = [
            name
            for name, is_log, each in zip(names, scales.is_log, values.T, strict=True)
            if is_log and min(each) <= 0.0
        ]
        raise ValueError(f"a logarithmic scale needs positive samples of {', '.join(wrong)}; use scale='linear'")
    return prior, scales.to_scale(values)


class NormalLikelihood(NamedTuple):
    """Likelihood of a stored posterior, normal in the logarithms x (d,) of some parameters, and their prior."""

    peak: np.ndarray
    errors: np.ndarray  # covariance (d, d) of the peak
    unseen: int  # number of directions about which the data say less than the prior; their errors are vast
    center: np.ndarray
    prior: np.ndarray  # covariance (d, d)


def normal_likelihood(stored: StoredPosterior, names: Sequence[str]) -> NormalLikelihood:
    """The posterior of positive parameters over their prior; ValueError as `on_scale`, and for too few samples."""
    prior, points = on_scale(stored, names, Scales(np.zeros(len(names))))
    weights, n, d = np.exp(stored.log_weights), stored.effective_sample_size, len(names)
    mean, covariance = weights @ points, np.cov(points.T, aweights=weights, ddof=0)
    if n < (fewest := POINTS_PER_DIMENSION * d) or not (np.diag(covariance) > 0.0).all():
        raise ValueError(
            f"the likelihood of {d} parameters needs at least {fewest:.0f} effective samples; got {n:.0f}, with the "
            f"standard deviations {np.sqrt(np.diag(covariance)).tolist()} of the logarithms"
        )
    covariance *= (n - 1.0) / (n - d - 2.0)  # so that its inverse is right on average
    z = np.random.default_rng(0).standard_normal((_PRIOR_DRAWS, prior.dim))
    z -= z.mean(axis=0)
    logs = np.log(prior.from_normal(np.linalg.solve(np.linalg.cholesky(z.T @ z / len(z)), z.T).T))
    center, prior_covariance = logs.mean(axis=0), np.cov(logs.T, bias=True)  # exact for lognormal priors
    variances, directions = linalg.eigh(covariance, prior_covariance)
    axes = prior_covariance @ directions  # in which the prior has the covariance one, and the posterior is diagonal
    information = 1.0 / np.maximum(variances, np.finfo(float).tiny) - 1.0  # of the data, relative to the prior
    seen = information > _LEAST_INFORMATION
    information = np.where(seen, information, _UNSEEN)
    offset = directions.T @ (mean - center) * seen
    peak, errors = center + axes @ (offset * (1.0 + 1.0 / information)), axes / information @ axes.T
    return NormalLikelihood(peak, errors, int((~seen).sum()), center, prior_covariance)


def log_density_on_scale(prior: Prior, scales: Scales, points: np.ndarray) -> np.ndarray:
    """Logarithm of the density (...) of a prior at points (..., dim) on the scales of `on_scale`."""
    rows = points.reshape(-1, points.shape[-1])
    log_density = prior.logpdf(scales.from_scale(rows)) + scales.log_jacobian(rows).sum(axis=1)
    return log_density.reshape(points.shape[:-1])


def describe(stored: StoredPosterior, names: Sequence[str], scales: Scales) -> DescribedPosterior:
    """Describe the stored samples of some parameters.

    More than 1000 are thinned: evenly, or by systematic resampling if they have weights. ValueError if a parameter is
    unknown, has a joint prior with parameters that are not described, or has samples that its scale does not permit;
    and as `fit_mixture`.
    """
    prior, points = on_scale(stored, names, scales)
    rng, weights = np.random.default_rng(0), np.exp(stored.log_weights)
    equal = np.ptp(stored.log_weights) == 0.0
    rows = systematic(weights, rng, min(len(points), _MOST))  # evenly spaced rows for equal weights
    mixture = _fit(points[rows], names, stored.effective_sample_size)
    log_weights = stored.log_weights
    if len(points) > _MOST:
        points, log_weights = points[rows], np.full(len(rows), -np.log(len(rows)))
    size = min(stored.effective_sample_size, _MOST)
    if len(stored.samples) > _MOST and not equal:  # resampling adds the error of as many samples
        size = 1.0 / (1.0 / stored.effective_sample_size + 1.0 / _MOST)
    lowest = float(log_density_on_scale(prior, scales, points).min())
    return DescribedPosterior(points, log_weights, lowest, prior, scales, *_components(mixture), mixture, size)


def resampled_description(described: DescribedPosterior, rng: np.random.Generator) -> DescribedPosterior:
    """A description of samples drawn with replacement from the described ones, to estimate statistical errors.

    The number of draws is the effective sample size. The points stay the same; their weights are the counts of the
    draws, and the mixture is fitted to the draws, starting from the given one.
    """
    size = max(round(described.effective_sample_size), 1)
    counts = rng.multinomial(size, np.exp(described.log_weights) / np.exp(described.log_weights).sum())
    with np.errstate(divide="ignore"):
        log_weights = np.log(counts / size)
    mixture = described.mixture.refitted(np.repeat(described.points, counts, axis=0))
    shares, means, covariances = _components(mixture)
    return described._replace(
        log_weights=log_weights,
        log_shares=shares,
        means=means,
        covariances=covariances,
        mixture=mixture,
    )


def _fit(points: np.ndarray, names: Sequence[str], effective: float) -> MixtureDistribution:
    """Mixture fitted to points of equal weight, in coordinates of mean zero and standard deviation one."""
    deviations = points.std(axis=0)
    if constant := [name for name, each in zip(names, deviations, strict=True) if not each > 0.0]:
        raise ValueError(f"all samples have the same value of {', '.join(constant)}: a posterior density is needed")
    coordinates = Prior(
        {
            name: TruncatedNormal(mean, sd, -np.inf, np.inf)
            for name, mean, sd in zip(names, points.mean(axis=0), deviations, strict=True)
        }
    )
    return fit_mixture(points, coordinates, effective_sample_size=effective, seed=0)


def _components(mixture: MixtureDistribution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithms of the shares, means and covariances of the components, without the standardisation."""
    normals = list(mixture.prior.distributions.values())
    center, scale = np.array([each.mean for each in normals]), np.array([each.sd for each in normals])
    return np.log(mixture.weights), center + scale * mixture.means, mixture.covariances * np.outer(scale, scale)
