"""Prior densities: normalised, in closed form, finite or -inf everywhere.

A distribution is a frozen dataclass with the logarithm of its density inside its support, its quantile function, and
its bounds. The base class derives the rest: the density is zero outside the bounds and at NaN, and draws are quantiles
of uniform numbers, so `rvs` and the unit cube of nested samplers use the same map.

`Prior` joins independent distributions under the names of the parameters. It has the attributes that clients expect of
a prior (``logpdf``, ``rvs``, ``bounds``, ``dim``) and ``transform`` from the unit cube. Normalising constants are
computed once, when a distribution is made. The frozen distributions of `scipy.stats` agree with these to round-off but
take tens of times longer per call, which matters where the simulation is cheap. The densities are on the page
``docs/theory/likelihood.rst``.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

__all__ = ["Distribution", "HalfNormal", "LogNormal", "Prior", "RandomState", "TruncatedNormal", "Uniform"]

RandomState = int | np.random.Generator | np.random.RandomState | None

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


def _uniform_numbers(size: int | tuple[int, ...], random_state: RandomState) -> np.ndarray:
    """Numbers in [0, 1) from a seed, a generator, or NumPy's global stream."""
    if random_state is None:
        # as in scipy.stats: clients that are seeded with np.random.seed (pocomc, zeus, emcee) stay reproducible
        return np.random.random(size)  # noqa: NPY002
    if isinstance(random_state, int | np.integer):
        random_state = np.random.default_rng(random_state)
    return random_state.random(size)


def _unit_interval(u: np.ndarray) -> np.ndarray:
    """Probabilities as an array; ValueError for one outside [0, 1]."""
    u = np.asarray(u, dtype=float)
    if not ((u >= 0.0) & (u <= 1.0)).all():
        raise ValueError(f"quantiles are defined for probabilities in [0, 1]; got {u[~((u >= 0.0) & (u <= 1.0))][:3]}")
    return u


class Distribution(ABC):
    """Univariate distribution of one parameter, in the unit of the parameter.

    A subclass is a frozen dataclass with `bounds`, `moments`, `_log_density` and `_quantile`.
    """

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

    def logpdf(self, x: np.ndarray | float) -> np.ndarray | float:
        """Logarithm of the density.

        Parameters
        ----------
        x : array_like
            Any shape.

        Returns
        -------
        ndarray of the same shape, or float
            -inf outside the bounds and at NaN; never NaN.
        """
        x = np.asarray(x, dtype=float)
        low, high = self.bounds
        with np.errstate(all="ignore"):
            return np.where((x >= low) & (x <= high), self._log_density(x), -np.inf)[()]

    def ppf(self, u: np.ndarray | float) -> np.ndarray | float:
        """Quantile function.

        Parameters
        ----------
        u : array_like
            Probabilities in [0, 1], any shape.

        Returns
        -------
        ndarray of the same shape, or float
            Values within the bounds.

        Raises
        ------
        ValueError
            If a probability is outside [0, 1] or NaN.
        """
        u = _unit_interval(u)
        low, high = self.bounds
        with np.errstate(all="ignore"):
            return np.clip(self._quantile(u), low, high)[()]

    def isf(self, q: np.ndarray | float) -> np.ndarray | float:
        """Inverse survival function, ``ppf(1 - q)``, which `nautilus.Prior` expects of a distribution."""
        return self.ppf(1.0 - np.asarray(q, dtype=float))

    def rvs(self, size: int | tuple[int, ...] = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws.

        Parameters
        ----------
        size : int or tuple of int
            Shape of the result.
        random_state : int, numpy.random.Generator, numpy.random.RandomState or None
            A seed, a generator, or None for NumPy's global stream.

        Returns
        -------
        ndarray of shape `size`
        """
        return np.asarray(self.ppf(_uniform_numbers(size, random_state)))


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


def _standard_truncated_normal(a: float, b: float) -> tuple[float, float, float]:
    """Probability of [a, b] under a standard normal, and mean and variance of the normal truncated to it."""
    from scipy.special import erf, ndtr  # slow to import, and not needed for densities of other distributions

    if (b - a) * max(abs(a), abs(b), 1.0) < 1.0:
        # differences of tail probabilities cancel on a narrow interval; the smooth density is integrated instead
        half = 0.5 * (b - a)
        weights = _WEIGHTS * np.exp(-0.5 * (0.5 * (a + b) + half * _NODES) ** 2)
        total = weights.sum()
        if total == 0.0:
            return 0.0, math.nan, math.nan
        offset = weights @ _NODES / total
        variance = half**2 * (weights @ (_NODES - offset) ** 2 / total)
        return half * total * math.exp(-_HALF_LOG_TWO_PI), 0.5 * (a + b) + half * offset, variance
    if a > 0.0:
        mass = ndtr(-a) - ndtr(-b)
    elif b < 0.0:
        mass = ndtr(b) - ndtr(a)
    else:
        mass = 0.5 * (erf(b / math.sqrt(2.0)) - erf(a / math.sqrt(2.0)))
    if mass <= 0.0:
        return 0.0, math.nan, math.nan
    density_a, density_b = (math.exp(-0.5 * t * t - _HALF_LOG_TWO_PI) / mass for t in (a, b))
    mean = density_a - density_b
    slope = sum(t * density for t, density in ((a, density_a), (-b, density_b)) if density > 0.0)
    return mass, mean, 1.0 + slope - mean**2


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
    Quantiles are computed from the nearer tail, which resolves both tails; their error is a few units of round-off of
    max(abs(mean), sd).
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
        mass = _standard_truncated_normal(*self._standard_bounds)[0]
        if not mass >= np.finfo(float).tiny:
            raise ValueError(
                f"TruncatedNormal: the probability of [{self.lower}, {self.upper}] under a normal of mean {self.mean} "
                f"and sd {self.sd} is smaller than a float can hold; move the mean towards the bounds or raise the sd"
            )
        object.__setattr__(self, "_mass", float(mass))
        object.__setattr__(self, "_log_constant", -math.log(self.sd) - _HALF_LOG_TWO_PI - math.log(mass))

    @property
    def _standard_bounds(self) -> tuple[float, float]:
        return (self.lower - self.mean) / self.sd, (self.upper - self.mean) / self.sd

    @property
    def bounds(self) -> tuple[float, float]:
        return self.lower, self.upper

    @property
    def moments(self) -> tuple[float, float]:
        _, mean, variance = _standard_truncated_normal(*self._standard_bounds)
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


@dataclass(frozen=True)
class HalfNormal(Distribution):
    """Distribution of the absolute value of a normal with mean zero: a usual prior of standard deviations of noise.

    For another lower bound use ``TruncatedNormal(0.0, sd, lower=...)``.

    Parameters
    ----------
    sd : float
        Standard deviation (> 0) of the normal before taking the absolute value, in the unit of the parameter.
    """

    sd: float
    _log_constant: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _set_positive(self, sd=self.sd)
        object.__setattr__(self, "_log_constant", math.log(2.0) - math.log(self.sd) - _HALF_LOG_TWO_PI)

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


@dataclass(frozen=True)
class Uniform(Distribution):
    """Constant density on [low, high].

    Parameters
    ----------
    low, high : float
        Finite bounds, low < high, both included, in the unit of the parameter.
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


@dataclass(frozen=True)
class LogNormal(Distribution):
    """Distribution of a positive parameter whose logarithm is normal.

    It is defined by its median, which has the unit of the parameter, instead of the mean of the logarithm.

    Parameters
    ----------
    median : float
        Median (> 0), in the unit of the parameter: the exponential of the mean of its logarithm.
    log_sd : float
        Standard deviation of the natural logarithm (> 0); if small, about the coefficient of variation.
    """

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
            -log_ratio * (0.5 * log_ratio / self.log_sd**2 + 1.0)
            - math.log(self.log_sd)
            - _HALF_LOG_TWO_PI
            - log_median
        )

    def _quantile(self, u: np.ndarray) -> np.ndarray:
        from scipy.special import ndtri

        return self.median * np.exp(self.log_sd * ndtri(u))


class Prior:
    """Independent distributions under the names of the parameters.

    Parameters
    ----------
    distributions : mapping of str to Distribution
        Parameter names and their distributions, in the order of the parameters.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    dim : int
        Number of parameters.
    bounds : ndarray[dim, 2]
        Lower and upper bound of every parameter.
    distributions : dict of str to Distribution
        As given.

    Raises
    ------
    ValueError
        If `distributions` is not such a mapping, or empty.

    Examples
    --------
    >>> prior = Prior({"stiffness": TruncatedNormal(1.0, 0.3), "sigma_displacement": HalfNormal(0.03)})
    >>> prior.rvs(1000, 42).shape
    (1000, 2)
    """

    def __init__(self, distributions: Mapping[str, Distribution]) -> None:
        if not isinstance(distributions, Mapping) or not distributions:
            raise ValueError(
                "Prior expects a non-empty mapping of parameter names to distributions, such as "
                f'{{"stiffness": TruncatedNormal(1.0, 0.3)}}; got {distributions!r}'
            )
        for name, distribution in distributions.items():
            if not isinstance(distribution, Distribution):
                raise ValueError(f"Prior: {name!r} must be a Distribution of fe_likelihoods; got {distribution!r}")
        self.distributions = dict(distributions)
        self.names = tuple(distributions)
        self.dim = len(self.names)
        self.bounds = np.array([distribution.bounds for distribution in distributions.values()])

    def __repr__(self) -> str:
        return f"Prior({self.distributions!r})"

    def _checked(self, values: np.ndarray, what: str) -> np.ndarray:
        values = np.asarray(values, dtype=float)
        if values.ndim not in (1, 2) or values.shape[-1] != self.dim:
            raise ValueError(
                f"{what} must have shape ({self.dim},) or (n, {self.dim}), in the order {', '.join(self.names)}; "
                f"got {values.shape}"
            )
        return values

    def logpdf(self, x: np.ndarray) -> np.ndarray | float:
        """Sum of the logarithms of the densities.

        Parameters
        ----------
        x : ndarray[dim] or ndarray[n, dim]

        Returns
        -------
        float or ndarray[n]
            -inf outside the bounds and where a value is NaN; never NaN.
        """
        x = self._checked(x, "x")
        inside = ((x >= self.bounds[:, 0]) & (x <= self.bounds[:, 1])).all(axis=-1)
        with np.errstate(all="ignore"):
            total = sum(d._log_density(column) for d, column in zip(self.distributions.values(), x.T, strict=True))
        log_density = np.where(inside, total, -np.inf)
        return log_density if x.ndim == 2 else float(log_density)

    def transform(self, u: np.ndarray) -> np.ndarray:
        """Map from the unit cube to the parameters, for nested samplers.

        Parameters
        ----------
        u : ndarray[dim] or ndarray[n, dim]
            Independent uniform numbers in [0, 1].

        Returns
        -------
        ndarray of the same shape
        """
        u = self._checked(u, "u")
        columns = [d.ppf(column) for d, column in zip(self.distributions.values(), u.T, strict=True)]
        return np.stack(columns, axis=-1)

    def rvs(self, size: int = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws.

        Parameters
        ----------
        size : int
            Number of draws.
        random_state : int, numpy.random.Generator, numpy.random.RandomState or None
            A seed, a generator, or None for NumPy's global stream (``np.random.seed``).

        Returns
        -------
        ndarray[size, dim]
        """
        return self.transform(_uniform_numbers((size, self.dim), random_state))

    def reorder(self, names: Iterable[str]) -> "Prior":
        """The same prior with its parameters in the order of `names`; ValueError if the names are not the same."""
        names = tuple(names)
        if sorted(names) != sorted(self.names):
            raise ValueError(
                f"the prior and the parameters must have the same names; the prior has {list(self.names)}, "
                f"the parameters are {list(names)}; without a prior: {sorted(set(names) - set(self.names))}; "
                f"unknown: {sorted(set(self.names) - set(names))}"
            )
        return Prior({name: self.distributions[name] for name in names})
