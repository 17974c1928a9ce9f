"""Distributions of one parameter: normalised densities in closed form, finite or -inf everywhere.

A distribution is a frozen dataclass with its log-density inside its support, its quantile function and its bounds; the
base class derives the rest. Draws are quantiles of uniform numbers, so `rvs` and the unit cube of nested samplers use
the same map. `from_normal` maps a standard normal z to x by F(x) = Phi(z), and `to_normal` maps it back; where z > 0
both use the probabilities above, because probabilities near one are rounded to one. Normalising constants are computed
once; `scipy.stats` agrees to round-off but takes tens of times longer per call. Densities:
``docs/theory/likelihood.rst``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from .truncated_normal_integrals import HALF_LOG_TWO_PI, quantile_of_normal, score_of_quantile, standard_moments

RandomState = int | np.random.Generator | np.random.RandomState | None

_LARGEST_SCORE = 38.0  # Phi(-38) is close to the smallest float


def as_generator(random_state: RandomState) -> Any:
    """An object with ``standard_normal`` and ``random``: from a seed, a generator, or NumPy's global stream."""
    if random_state is None:
        # as in scipy.stats: clients that are seeded with np.random.seed (pocomc, zeus, emcee) stay reproducible
        return np.random
    return np.random.default_rng(random_state) if isinstance(random_state, int | np.integer) else random_state


def probabilities_of(u: np.ndarray) -> np.ndarray:
    """Probabilities as an array; ValueError for one outside [0, 1]."""
    u = np.asarray(u, dtype=float)
    if not ((u >= 0.0) & (u <= 1.0)).all():
        raise ValueError(f"quantiles are defined for probabilities in [0, 1]; got {u[~((u >= 0.0) & (u <= 1.0))][:3]}")
    return u


class Distribution(ABC):
    """Univariate distribution of one parameter, in the unit of the parameter.

    A subclass is a frozen dataclass with `bounds`, `moments`, `_log_density` and `_quantile`. For accuracy in the upper
    tail it may add `_upper_quantile`, and for closed forms `_from_normal` and `_to_normal`.

    Attributes
    ----------
    logarithmic : bool
        Whether the parameter varies by factors rather than by differences: an emulator of the response is then a
        function of its logarithm. The parameter must be positive. False by default.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from fe_likelihoods.priors.distributions import Distribution
    >>> @dataclass(frozen=True)
    ... class Exponential(Distribution):
    ...     mean: float
    ...     bounds = (0.0, np.inf)
    ...     moments = property(lambda self: (self.mean, self.mean))
    ...     def _log_density(self, x):
    ...         return -x / self.mean - np.log(self.mean)
    ...     def _quantile(self, u):
    ...         return -self.mean * np.log1p(-u)
    >>> round(float(Exponential(2.0).ppf(0.5)), 3)
    1.386
    """

    logarithmic: ClassVar[bool] = False

    @property
    @abstractmethod
    def bounds(self) -> tuple[float, float]:
        """Closed interval outside which the density is zero."""

    @property
    @abstractmethod
    def moments(self) -> tuple[float, float]:
        """Mean and standard deviation of the distribution (after truncation, where it is truncated)."""

    @abstractmethod
    def _log_density(self, x: np.ndarray) -> np.ndarray:
        """Logarithm of the density inside the bounds; the value outside them is not used."""

    @abstractmethod
    def _quantile(self, u: np.ndarray) -> np.ndarray:
        """Inverse of the distribution function for u in [0, 1]."""

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        """Inverse of the survival function for q in [0, 1]."""
        return self._quantile(1.0 - q)

    def _from_normal(self, z: np.ndarray) -> np.ndarray:
        """x with F(x) = Phi(z), for z (n,) that may be infinite but not NaN."""
        from scipy.special import ndtr  # slow to import, and not needed for densities

        return np.where(z < 0.0, self._quantile(ndtr(z)), self._upper_quantile(ndtr(-z)))

    def _to_normal(self, x: np.ndarray) -> np.ndarray:
        """z with F(x) = Phi(z), for x (n,) strictly inside the bounds; by bisection of `from_normal`."""
        low, high = np.full(x.shape, -_LARGEST_SCORE), np.full(x.shape, _LARGEST_SCORE)
        for _ in range(60):  # 76 / 2**60 is below the round-off of z, except close to zero
            middle = 0.5 * (low + high)
            below = self.from_normal(middle) < x
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)

    def logpdf(self, x: np.ndarray | float) -> np.ndarray | float:
        """Logarithm of the density at x of any shape: -inf outside the bounds and at NaN; never NaN."""
        x = np.asarray(x, dtype=float)
        low, high = self.bounds
        with np.errstate(all="ignore"):
            return np.where((x >= low) & (x <= high), self._log_density(x), -np.inf)[()]

    def ppf(self, u: np.ndarray | float) -> np.ndarray | float:
        """Quantiles, within the bounds, at probabilities u of any shape; ValueError for one outside [0, 1]."""
        u = probabilities_of(u)
        low, high = self.bounds
        with np.errstate(all="ignore"):
            return np.clip(self._quantile(u), low, high)[()]

    def isf(self, q: np.ndarray | float) -> np.ndarray | float:
        """Inverse survival function: values that are exceeded with probabilities q of any shape; errors as for `ppf`.

        It equals ``ppf(1 - q)``, but a small q is not lost in the rounding of 1 - q. `nautilus.Prior` expects it of a
        distribution.
        """
        q = probabilities_of(q)
        with np.errstate(all="ignore"):
            return np.clip(self._upper_quantile(q), *self.bounds)[()]

    def from_normal(self, z: np.ndarray | float) -> np.ndarray | float:
        """Map from standard normal variables z of any shape to the parameter, increasing.

        If z is standard normal, the result has this distribution. It is within the bounds, to which infinite z are
        mapped; NaN where z is NaN.
        """
        return self._mapped(self._from_normal, z, (-np.inf, np.inf), self.bounds)

    def to_normal(self, x: np.ndarray | float) -> np.ndarray | float:
        """Map from the parameter x, of any shape, to a standard normal variable, the inverse of `from_normal`.

        The log density at x is the standard normal log density at z minus log(dx / dz). -inf at and below the lower
        bound, inf at and above the upper one; NaN where x is NaN.
        """
        return self._mapped(self._to_normal, x, self.bounds, (-np.inf, np.inf))

    @staticmethod
    def _mapped(function: Callable, values: np.ndarray | float, domain: tuple, ends: tuple) -> np.ndarray | float:
        """An increasing function of values inside `domain`; `ends`, which are also its bounds, beyond it."""
        values, (low, high) = np.asarray(values, dtype=float), domain
        result = np.where(values <= low, ends[0], np.where(values >= high, ends[1], np.nan))
        inside = (values > low) & (values < high)
        with np.errstate(all="ignore"):
            result[inside] = np.clip(function(values[inside]), *ends)
        return result[()]

    def rvs(self, size: int | tuple[int, ...] = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws of shape `size`, from a seed, a generator, or NumPy's global stream (None)."""
        return np.asarray(self.ppf(as_generator(random_state).random(size)))


def _set_finite(distribution: Distribution, **values: float) -> None:
    """Set fields of a frozen dataclass to finite floats; ValueError for others."""
    for name, value in values.items():
        value = float(value)
        if not math.isfinite(value):
            raise ValueError(f"{type(distribution).__name__}: {name} must be finite; got {value}")
        object.__setattr__(distribution, name, value)


def _set_positive(distribution: Distribution, **values: float) -> None:
    """Set fields of a frozen dataclass to finite floats greater than zero; ValueError for others."""
    _set_finite(distribution, **values)
    for name in values:
        if getattr(distribution, name) <= 0.0:
            raise ValueError(f"{type(distribution).__name__}: {name} must be > 0; got {getattr(distribution, name)}")


@dataclass(frozen=True)
class TruncatedNormal(Distribution):
    """Normal distribution restricted to [lower, upper] and normalised there.

    Parameters
    ----------
    mean, sd : float
        Mean and standard deviation (sd > 0) of the normal before truncation, in the unit of the parameter.
    lower, upper : float
        Bounds, lower < upper; may be infinite. The default is positive values only.

    Raises
    ------
    ValueError
        For impossible values, and if the probability within the bounds is below the smallest float (bounds about 37 sd
        from the mean).

    Notes
    -----
    Quantiles are computed from the nearer tail, which resolves both tails; their error is a few round-off units at the
    magnitude max(abs(mean), sd).

    Examples
    --------
    >>> stiffness = TruncatedNormal(1.0, 0.5)  # positive
    >>> [round(float(stiffness.ppf(p)), 3) for p in (0.05, 0.5, 0.95)]
    [0.268, 1.014, 1.828]
    """

    mean: float
    sd: float
    lower: float = 0.0
    upper: float = math.inf
    _mass: float = field(init=False, repr=False, compare=False)
    _log_constant: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _set_finite(self, mean=self.mean)
        _set_positive(self, sd=self.sd)
        for name in ("lower", "upper"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if not self.lower < self.upper:
            raise ValueError(f"TruncatedNormal: lower must be < upper; got lower={self.lower}, upper={self.upper}")
        mass = standard_moments(*self._standard_bounds)[0]
        if not mass >= np.finfo(float).tiny:
            raise ValueError(
                f"TruncatedNormal: the probability of [{self.lower}, {self.upper}] under a normal of mean {self.mean} "
                f"and sd {self.sd} is smaller than a float can hold; move the mean towards the bounds or raise the sd"
            )
        object.__setattr__(self, "_mass", float(mass))
        object.__setattr__(self, "_log_constant", -math.log(self.sd) - HALF_LOG_TWO_PI - math.log(mass))

    @property
    def _standard_bounds(self) -> tuple[float, float]:
        return (self.lower - self.mean) / self.sd, (self.upper - self.mean) / self.sd

    @property
    def bounds(self) -> tuple[float, float]:
        return self.lower, self.upper

    @property
    def moments(self) -> tuple[float, float]:
        _, mean, variance = standard_moments(*self._standard_bounds)
        return float(self.mean + self.sd * mean), float(self.sd * math.sqrt(variance))

    def _log_density(self, x: np.ndarray) -> np.ndarray:
        z = (x - self.mean) / self.sd
        return self._log_constant - 0.5 * z * z

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        from scipy.special import ndtr, ndtri

        a, b = self._standard_bounds
        below = ndtr(a) + u * self._mass
        above = ndtr(-b) + (1.0 - u) * self._mass
        return self.mean + self.sd * np.where(below < above, ndtri(below), -ndtri(above))

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        return self._from_normal(-ndtri(q))

    def _from_normal(self, z: np.ndarray) -> np.ndarray:
        return quantile_of_normal(z, self.mean, self.sd, self.lower, self.upper, math.log(self._mass))

    def _to_normal(self, x: np.ndarray) -> np.ndarray:
        return score_of_quantile(x, self.mean, self.sd, self.lower, self.upper, math.log(self._mass))


@dataclass(frozen=True)
class HalfNormal(Distribution):
    """Distribution of the absolute value of a normal with mean zero: a usual prior of standard deviations of noise.

    For another lower bound use ``TruncatedNormal(0.0, sd, lower=...)``.

    Parameters
    ----------
    sd : float
        Standard deviation (> 0) of the normal before taking the absolute value, in the unit of the parameter: ``scale``
        of `scipy.stats.halfnorm`. The standard deviation of the half-normal distribution itself is 0.603 times as
        large, its mean 0.798 times (`moments`).

    Examples
    --------
    >>> sigma = HalfNormal(0.01)
    >>> round(float(sigma.ppf(0.5)), 5)
    0.00674
    """

    sd: float
    _log_constant: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _set_positive(self, sd=self.sd)
        object.__setattr__(self, "_log_constant", math.log(2.0) - math.log(self.sd) - HALF_LOG_TWO_PI)

    @property
    def bounds(self) -> tuple[float, float]:
        return 0.0, math.inf

    @property
    def moments(self) -> tuple[float, float]:
        return self.sd * math.sqrt(2.0 / math.pi), self.sd * math.sqrt(1.0 - 2.0 / math.pi)

    def _log_density(self, x: np.ndarray) -> np.ndarray:
        z = x / self.sd
        return self._log_constant - 0.5 * z * z

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        from scipy.special import erfinv

        return self.sd * math.sqrt(2.0) * erfinv(u)

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        return -self.sd * ndtri(0.5 * q)

    def _from_normal(self, z: np.ndarray) -> np.ndarray:
        return quantile_of_normal(z, 0.0, self.sd, 0.0, math.inf, -math.log(2.0))

    def _to_normal(self, x: np.ndarray) -> np.ndarray:
        return score_of_quantile(x, 0.0, self.sd, 0.0, math.inf, -math.log(2.0))


@dataclass(frozen=True)
class Uniform(Distribution):
    """Constant density on [low, high].

    Parameters
    ----------
    low, high : float
        Finite bounds, low < high, both included, in the unit of the parameter.

    Examples
    --------
    >>> share = Uniform(0.2, 0.8)
    >>> float(share.ppf(0.5))
    0.5
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        _set_finite(self, low=self.low, high=self.high)
        if not self.low < self.high:
            raise ValueError(f"Uniform: low must be < high; got low={self.low}, high={self.high}")
        if not math.isfinite(self.high - self.low):
            raise ValueError(f"Uniform: the width high - low must be finite; got low={self.low}, high={self.high}")

    @property
    def bounds(self) -> tuple[float, float]:
        return self.low, self.high

    @property
    def moments(self) -> tuple[float, float]:
        return 0.5 * self.low + 0.5 * self.high, (self.high - self.low) / math.sqrt(12.0)

    def _log_density(self, x: np.ndarray) -> np.ndarray:
        return np.full(x.shape, -math.log(self.high - self.low))

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        return self.low + (self.high - self.low) * u

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        return self.high - (self.high - self.low) * q

    def _to_normal(self, x: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        width = self.high - self.low
        u, q = (x - self.low) / width, (self.high - x) / width
        return np.where(u < q, ndtri(u), -ndtri(q))


@dataclass(frozen=True)
class LogNormal(Distribution):
    """Distribution of a positive parameter whose logarithm is normal.

    It is defined by its median, which has the parameter's unit, instead of the logarithmic mean.

    Parameters
    ----------
    median : float
        Median (> 0), in the unit of the parameter; its logarithm is the mean of log x.
    log_sd : float
        Standard deviation of the natural logarithm (> 0); if small, about the coefficient of variation.

    Examples
    --------
    >>> stiffness = LogNormal(1.0, 0.2)
    >>> [round(float(stiffness.ppf(p)), 3) for p in (0.05, 0.5, 0.95)]
    [0.72, 1.0, 1.39]
    """

    logarithmic: ClassVar[bool] = True

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        _set_positive(self, median=self.median, log_sd=self.log_sd)

    @property
    def bounds(self) -> tuple[float, float]:
        return 0.0, math.inf

    @property
    def moments(self) -> tuple[float, float]:
        with np.errstate(over="ignore"):
            mean = self.median * np.exp(0.5 * self.log_sd**2)
            return float(mean), float(mean * np.sqrt(np.expm1(self.log_sd**2)))

    def _log_density(self, x: np.ndarray) -> np.ndarray:
        log_median = math.log(self.median)
        log_ratio = np.log(x) - log_median
        # a product, because a sum would be a difference of two infinities at x = 0
        return (
            -log_ratio * (0.5 * log_ratio / self.log_sd**2 + 1.0) - math.log(self.log_sd) - HALF_LOG_TWO_PI - log_median
        )

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        return self.median * np.exp(self.log_sd * ndtri(u))

    def _upper_quantile(self, q: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        return self.median * np.exp(-self.log_sd * ndtri(q))

    def _from_normal(self, z: np.ndarray) -> np.ndarray:
        return self.median * np.exp(self.log_sd * z)

    def _to_normal(self, x: np.ndarray) -> np.ndarray:
        return (np.log(x) - math.log(self.median)) / self.log_sd
