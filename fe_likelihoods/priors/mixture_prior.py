"""A posterior as the prior of the next step: a mixture of normal distributions fitted to posterior samples.

The samples are mapped to the coordinates in which the first prior is standard normal (`Prior.to_normal`), and a mixture
is fitted there (`samplers.proposals.mixture`). Bounds of the prior are therefore kept, and correlations are described.
See ``docs/events.rst``.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from samplers.proposals.mixture import POINTS_PER_DIMENSION, Mixture, fit_normals, invert_roots, log_density

from .distributions import RandomState, as_generator
from .multivariate import MultivariateDistribution
from .points import as_points
from .truncated_normal_integrals import HALF_LOG_TWO_PI

if TYPE_CHECKING:
    from .priors import Prior

_LARGEST_SCORE = 12.0  # samples at a bound of the prior have infinite scores
REFITS = 16  # to resampled samples: a standard deviation of 16 has an error of 18 %
_SMALLEST_EIGENVALUE = 1e-10  # of the correlations, below which the samples are linearly dependent


class MixtureDistribution(MultivariateDistribution):
    """Mixture of normal distributions in the coordinates of a prior; made by `fit_mixture`.

    Parameters
    ----------
    prior : Prior
        Prior whose map to standard normal variables defines the coordinates, with the parameters of the mixture.
    weights : (n_components,) array_like
        Shares of the components, which sum to one.
    means : (n_components, dim) array_like
        Means in the coordinates.
    covariances : (n_components, dim, dim) array_like
        Covariances in the coordinates.
    fit_error : float
        Standard error of the log density [-], root mean square over the samples, from fits to resampled samples. An
        evidence with this prior has this error in addition to the sampling error, as long as the next data move the
        posterior by up to about 1.5 standard deviations: the samples determine the tails poorly (docs/events.rst).
    misfit : float or None
        Standard deviation over the samples of the log density ratio of posterior and mixture [-], which is zero for a
        perfect fit. None if the posterior density was not given.
    """

    def __init__(
        self,
        prior: "Prior",
        weights: np.ndarray,
        means: np.ndarray,
        covariances: np.ndarray,
        fit_error: float = 0.0,
        misfit: float | None = None,
    ) -> None:
        self.prior, self.names = prior, prior.names
        self.weights, self.means, self.covariances = (
            np.array(each, dtype=float) for each in (weights, means, covariances)
        )
        self.fit_error, self.misfit = float(fit_error), misfit
        self._factors = np.linalg.cholesky(self.covariances)
        self._mixture = Mixture(self.weights, self.means, self._factors, invert_roots(self._factors), np.inf)

    def __repr__(self) -> str:
        return f"MixtureDistribution({self.prior!r}, {self.weights!r}, {self.means!r}, {self.covariances!r})"

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def bounds(self) -> np.ndarray:
        """Bounds of the first prior, shape (dim, 2)."""
        return self.prior.bounds

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Logarithm of the density (...) at x (..., dim); -inf outside the bounds."""
        x = np.asarray(x, dtype=float)
        rows = x.reshape(-1, self.dim)
        value = np.full(len(rows), -np.inf)
        base = np.atleast_1d(self.prior.logpdf(rows))
        inside = np.isfinite(base)
        if inside.any():
            z = self.prior.to_normal(rows[inside])
            finite = np.isfinite(z).all(axis=1)
            z = np.where(finite[:, None], z, 0.0)
            # the density of z, times dz / dx = p(x) / phi(z) of every parameter
            slope = base[inside] + 0.5 * np.square(z).sum(axis=1) + self.dim * HALF_LOG_TWO_PI
            value[inside] = np.where(finite, log_density(self._mixture, z) + slope, -np.inf)
        return value.reshape(x.shape[:-1])

    def from_normal(self, z: np.ndarray) -> np.ndarray:
        """Map from independent standard normal variables (..., dim), by conditional quantiles (Rosenblatt)."""
        z = np.asarray(z, dtype=float)
        rows, out = z.reshape(-1, self.dim), np.zeros((z.size // self.dim, self.dim))
        for i in range(self.dim):
            shares, means, deviations = self._conditional(out, i)
            low, high = (means + side * 40.0 * deviations for side in (-1.0, 1.0))
            low, high = low.min(axis=1), high.max(axis=1)
            for _ in range(70):
                middle = 0.5 * (low + high)
                below = _mixture_score(middle, shares, means, deviations) < rows[:, i]
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            out[:, i] = 0.5 * (low + high)
        return self.prior.from_normal(out).reshape(z.shape)

    def to_normal(self, x: np.ndarray) -> np.ndarray:
        """Map to independent standard normal variables (..., dim)."""
        x = np.asarray(x, dtype=float)
        z = self.prior.to_normal(x.reshape(-1, self.dim))
        scores = np.empty_like(z)
        for i in range(self.dim):
            scores[:, i] = _mixture_score(z[:, i], *self._conditional(z, i))
        return scores.reshape(x.shape)

    def rvs(self, size: int = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws, shape (size, dim); arguments as for `Prior.rvs`."""
        rng = as_generator(random_state)
        rows = np.searchsorted(np.cumsum(self.weights)[:-1], rng.random(size))
        z = self.means[rows] + np.einsum("nij,nj->ni", self._factors[rows], rng.standard_normal((size, self.dim)))
        return self.prior.from_normal(z)

    def refitted(self, samples: np.ndarray) -> "MixtureDistribution":
        """The mixture fitted to other samples (n, dim), with as many components, starting from this one."""
        z = np.clip(self.prior.to_normal(samples), -_LARGEST_SCORE, _LARGEST_SCORE)
        fitted = fit_normals(z, len(z), start=self._mixture)
        return MixtureDistribution(self.prior, fitted.weights, fitted.means, fitted.covariances, self.fit_error)

    def _conditional(self, z: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shares, means and standard deviations (n, n_components) of coordinate i, given the earlier ones in z."""
        log_shares = np.tile(np.log(self.weights), (len(z), 1))
        means = np.tile(self.means[:, i], (len(z), 1))
        deviations = np.tile(self._factors[:, i, i], (len(z), 1))
        for k, factor in enumerate(self._factors if i else ()):
            # the leading block of a Cholesky factor has the leading block of the inverse factor as its inverse
            y = np.linalg.solve(factor[:i, :i], (z[:, :i] - self.means[k, :i]).T)
            log_shares[:, k] -= 0.5 * np.square(y).sum(axis=0) + np.log(np.diag(factor)[:i]).sum()
            means[:, k] += factor[i, :i] @ y
        shares = np.exp(log_shares - log_shares.max(axis=1, keepdims=True))
        return shares / shares.sum(axis=1, keepdims=True), means, deviations


def fit_mixture(
    samples: Any,
    prior: "Prior",
    names: Sequence[str] | None = None,
    *,
    log_prob: np.ndarray | None = None,
    effective_sample_size: float | None = None,
    seed: int = 0,
) -> MixtureDistribution:
    """Fit a mixture of normal distributions to posterior samples, as a prior of the next step.

    Parameters
    ----------
    samples : (n, dim) array_like, or named values of shape (n,)
        Posterior samples of equal weight, with all parameters of `prior`.
    prior : Prior
        Prior of these samples. Its parameters are independent.
    names : sequence of str, optional
        The parameters that the mixture describes, such as the structural ones. Default: all.
    log_prob : (n,) array_like, optional
        Logarithm of the posterior density of the samples, up to a constant (``sampler.get_log_prob(flat=True)``), for
        `MixtureDistribution.misfit`; only with all parameters.
    effective_sample_size : float, optional
        Effective number of independent samples, for `MixtureDistribution.fit_error`. Default: the number of distinct
        samples.
    seed : int
        Seed of the resampling.

    Returns
    -------
    MixtureDistribution
        Its `fit_error` and `misfit` say how good the fit is.

    Raises
    ------
    ValueError
        If the samples have another dimension, are too few or linearly dependent, a sample is impossible under the
        prior, a name is unknown, or an argument is out of range.

    Examples
    --------
    >>> mixture = fit_mixture(samples, posterior.prior, model.parameter_names)
    >>> next_prior = Prior({mixture.names: mixture, "sigma_displacement": HalfNormal(0.01)})
    >>> next_prior.names
    ('stiffness', 'damping', 'sigma_displacement')
    """
    points = as_points(samples, prior.names)
    names = prior.names if names is None else tuple(names)
    part, dim = prior.subset(names), len(names)
    if points.ndim != 2 or len(np.unique(points, axis=0)) < POINTS_PER_DIMENSION * dim:
        raise ValueError(
            f"a fit of {dim} parameters needs {POINTS_PER_DIMENSION * dim:.0f} different samples or more, in an array "
            f"(n, {prior.dim}); got shape {points.shape}"
        )
    if not np.isfinite(np.atleast_1d(prior.logpdf(points))).all():
        raise ValueError("some samples are impossible under the prior; give the prior with which they were drawn")
    chosen = points[:, [prior.names.index(name) for name in names]]
    z = np.clip(part.to_normal(chosen), -_LARGEST_SCORE, _LARGEST_SCORE)
    _check_independent(z, names)
    rng = np.random.default_rng(seed)
    effective = float(len(np.unique(z, axis=0)) if effective_sample_size is None else effective_sample_size)
    if not 1.0 <= effective:
        raise ValueError(f"effective_sample_size must be 1 or more; got {effective_sample_size!r}")
    fitted = fit_normals(z, effective)
    density = log_density(fitted, z)
    refits = []
    for _ in range(REFITS):
        rows = rng.integers(len(z), size=max(round(effective), 2 * dim))
        refits.append(log_density(fit_normals(z[rows], effective, start=fitted), z))
    fit_error = np.sqrt(np.mean(np.var(refits, axis=0, ddof=1)))
    misfit = None
    if log_prob is not None:
        log_prob = np.asarray(log_prob, dtype=float)
        if log_prob.shape != (len(z),) or set(names) != set(prior.names):
            raise ValueError(
                f"log_prob must have one value for each of the {len(z)} samples, and the mixture all parameters; got "
                f"shape {log_prob.shape} and the parameters {', '.join(names)}"
            )
        slope = np.atleast_1d(part.logpdf(chosen)) + 0.5 * np.square(z).sum(axis=1)
        misfit = float(np.std(log_prob - density - slope))
    return MixtureDistribution(part, fitted.weights, fitted.means, fitted.covariances, fit_error, misfit)


def _check_independent(z: np.ndarray, names: Sequence[str]) -> None:
    """Raise ValueError if the samples z (n, dim) are constant or on a plane, where they have no density."""
    deviations = z.std(axis=0)
    if constant := [name for name, each in zip(names, deviations, strict=True) if each < 1e-12]:
        raise ValueError(f"all samples have the same value of {', '.join(constant)}; leave it out of names")
    values, vectors = np.linalg.eigh(np.atleast_2d(np.corrcoef(z.T)))
    if values[0] < _SMALLEST_EIGENVALUE:
        members = ", ".join(name for name, share in zip(names, vectors[:, 0], strict=True) if abs(share) > 0.1)
        raise ValueError(
            f"the samples of {members} are linearly dependent in the coordinates of the prior, so that they have no "
            "joint density; leave one of these parameters out of names"
        )


def _mixture_score(t: np.ndarray, shares: np.ndarray, means: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Standard normal score of t (n,) under mixtures of one coordinate, accurate in both tails."""
    from scipy.special import ndtr, ndtri  # slow to import, and not needed for densities

    scores = (t[:, None] - means) / deviations
    below, above = (shares * ndtr(scores)).sum(axis=1), (shares * ndtr(-scores)).sum(axis=1)
    return np.where(below < above, ndtri(below), -ndtri(above))
