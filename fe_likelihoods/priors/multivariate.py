"""Distributions of several correlated parameters, for `Prior`: the normal one, and those of one parameter of scipy.

A distribution has a normalised density, and a map between the parameters and independent standard normal variables.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .distributions import Distribution, RandomState, as_generator
from .truncated_normal_integrals import HALF_LOG_TWO_PI

_LARGEST_ASYMMETRY = 1e-8  # of a covariance, in standard deviations of the two parameters


class MultivariateDistribution(ABC):
    """Distribution of several parameters together.

    A subclass has `dim`, `logpdf`, `from_normal` and `to_normal`, and `bounds` if it is not defined for all real
    numbers. Its ``repr`` must show all values, because it is part of fingerprints.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters, in the order of the values; empty if the distribution has none. `Prior` checks its
        names against them.
    """

    names: tuple[str, ...] = ()

    @property
    @abstractmethod
    def dim(self) -> int:
        """Number of parameters."""

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper bound of every parameter, shape (dim, 2), outside which the density is zero."""
        return np.tile([-np.inf, np.inf], (self.dim, 1))

    @abstractmethod
    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Logarithm of the normalised density (...) at parameters x (..., dim); -inf where it is zero."""

    @abstractmethod
    def from_normal(self, z: np.ndarray) -> np.ndarray:
        """Map from independent standard normal variables (..., dim) to the parameters."""

    @abstractmethod
    def to_normal(self, x: np.ndarray) -> np.ndarray:
        """Map from the parameters (..., dim) to standard normal variables, the inverse of `from_normal`."""

    def rvs(self, size: int = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws, shape (size, dim); arguments as for `Prior.rvs`."""
        return self.from_normal(as_generator(random_state).standard_normal((size, self.dim)))


class MultivariateNormal(MultivariateDistribution):
    """Multivariate normal distribution.

    Parameters
    ----------
    mean : (dim,) array_like
        Mean.
    covariance : (dim, dim) array_like
        Covariance, positive definite, and symmetric to 1e-8 times the product of both standard deviations. It is made
        symmetric.

    Raises
    ------
    ValueError
        If the shapes do not match, a value is not finite, or the covariance is not symmetric and positive definite.

    Examples
    --------
    >>> stiffness_and_damping = MultivariateNormal([1.0, 1.0], [[0.04, 0.01], [0.01, 0.09]])
    >>> Prior({("stiffness", "damping"): stiffness_and_damping, "sigma": HalfNormal(0.1)}).names
    ('stiffness', 'damping', 'sigma')
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike) -> None:
        self.mean = np.array(mean, dtype=float)
        self.covariance = np.array(covariance, dtype=float)
        kind, n = type(self).__name__, self.mean.size
        if self.mean.ndim != 1 or not n or self.covariance.shape != (n, n):
            raise ValueError(
                f"{kind} expects a mean (dim,) and a covariance (dim, dim); got shapes {self.mean.shape} and "
                f"{self.covariance.shape}"
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise ValueError(f"{kind} expects finite numbers; got mean {self.mean} and covariance {self.covariance}")
        # round-off of a computed covariance is measured against the standard deviations, because an element may be zero
        deviations = np.sqrt(np.abs(np.diag(self.covariance)))
        difference = np.abs(self.covariance - self.covariance.T)
        if (difference > _LARGEST_ASYMMETRY * np.outer(deviations, deviations)).any():
            raise ValueError(f"{kind} expects a symmetric covariance; got {self.covariance}")
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        try:
            self._factor = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"{kind} expects a positive definite covariance; got eigenvalues {np.linalg.eigvalsh(self.covariance)}"
            ) from None
        self._inverse = np.linalg.inv(self._factor)
        self._constant = -n * HALF_LOG_TWO_PI - np.log(np.diag(self._factor)).sum()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.mean!r}, {self.covariance!r})"

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return self.mean.size

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Logarithm of the density (...) at x (..., dim); -inf where a value is not finite."""
        with np.errstate(all="ignore"):
            value = self._constant - 0.5 * np.square((np.asarray(x) - self.mean) @ self._inverse.T).sum(axis=-1)
        return np.where(np.isfinite(value), value, -np.inf)

    def from_normal(self, z: np.ndarray) -> np.ndarray:
        """Map from independent standard normal variables (..., dim): mean + L z, with the Cholesky factor L."""
        return self.mean + np.asarray(z) @ self._factor.T

    def to_normal(self, x: np.ndarray) -> np.ndarray:
        """Map to independent standard normal variables (..., dim)."""
        return (np.asarray(x) - self.mean) @ self._inverse.T


@dataclass(frozen=True, eq=False, repr=False)
class FrozenDistribution(Distribution):
    """A frozen continuous distribution of `scipy.stats`, such as ``scipy.stats.gamma(2.0)``, which `Prior` accepts
    itself; the distributions of this package are faster.
    """

    frozen: Any

    def __repr__(self) -> str:
        values = [repr(value) for value in self.frozen.args]
        values += [f"{name}={value!r}" for name, value in sorted(self.frozen.kwds.items())]
        return f"FrozenDistribution({self.frozen.dist.name}({', '.join(values)}))"

    @property
    def bounds(self) -> tuple[float, float]:
        """Support of the distribution."""
        low, high = self.frozen.support()
        return float(low), float(high)

    @property
    def moments(self) -> tuple[float, float]:
        """Mean and standard deviation."""
        return float(self.frozen.mean()), float(self.frozen.std())

    def _log_density(self, x: np.ndarray) -> np.ndarray:
        return self.frozen.logpdf(x)

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        return self.frozen.ppf(u)

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        return self.frozen.isf(q)


def as_distribution(name: str, distribution: Any) -> Distribution:
    """The distribution of one parameter; a frozen one of scipy is wrapped, anything else is a ValueError."""
    if isinstance(distribution, Distribution):
        return distribution
    # a foreign object: frozen distributions of scipy have no public base class
    advice = ""
    if all(hasattr(distribution, member) for member in ("logpdf", "ppf", "support", "dist")):
        if np.ndim(distribution.mean()) == 0:
            return FrozenDistribution(distribution)
        advice = ": this one has arrays as parameters; give each parameter of the posterior a distribution of its own"
    elif hasattr(distribution, "logpdf") and hasattr(distribution, "rvs"):
        advice = ": freeze it with its parameters, such as scipy.stats.gamma(2.0)"
        if not hasattr(distribution, "ppf"):
            advice = ": for a distribution of several parameters, give a tuple of their names as key"
    raise ValueError(
        f"Prior: {name!r} must be a Distribution of fe_likelihoods or a frozen continuous distribution of scipy.stats, "
        f"such as scipy.stats.gamma(2.0), or a number for a known noise level; got {distribution!r}{advice}"
    )


def as_multivariate(names: tuple[str, ...], distribution: Any) -> MultivariateDistribution:
    """The distribution of several parameters; ValueError if it is none, or has other parameters."""
    if type(distribution).__name__ == "multivariate_normal_frozen":  # of scipy
        distribution = MultivariateNormal(distribution.mean, distribution.cov)
    if not isinstance(distribution, MultivariateDistribution):
        raise ValueError(
            f"Prior: the parameters {', '.join(names)} need a distribution of {len(names)} parameters, such as "
            f"scipy.stats.multivariate_normal(mean, covariance); got {distribution!r}"
        )
    if distribution.dim != len(names):
        raise ValueError(
            f"Prior: {len(names)} names, {', '.join(names)}, for a distribution of {distribution.dim} parameters; give "
            "one name for each"
        )
    if distribution.names and sorted(distribution.names) != sorted(names):
        raise ValueError(
            f"Prior: the names {', '.join(names)} differ from the distribution's, "
            f"{', '.join(distribution.names)}; use its names, in any order"
        )
    return distribution
