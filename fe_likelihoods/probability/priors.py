"""Prior densities: normalised, in closed form, finite or -inf everywhere.

A distribution is a frozen dataclass that gives three things: the logarithm of its density inside its support, its
quantile function, and its bounds. Everything else follows: the density is -inf outside the bounds and at NaN, and
draws are quantiles of uniform numbers, so the unit cube of nested samplers and `rvs` are the same map.

`Prior` joins independent distributions under the names of the parameters. It has the attributes that clients ask of a
prior object (``logpdf``, ``rvs``, ``bounds``, ``dim``) and ``transform`` from the unit cube. Normalising constants are
computed once, when a distribution is made: the frozen distributions of `scipy.stats` are equal to these to round-off
and cost tens of times more a call, which is felt where the simulation is cheap.
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
        # as scipy.stats does: clients that are seeded through np.random.seed (pocomc, zeus, emcee) stay reproducible
        return np.random.random(size)  # noqa: NPY002
    if isinstance(random_state, int | np.integer):
        random_state = np.random.default_rng(random_state)
    return random_state.random(size)


def _unit_interval(u: np.ndarray) -> np.ndarray:
    u = np.asarray(u, dtype=float)
    if not ((u >= 0.0) & (u <= 1.0)).all():
        raise ValueError(f"quantiles are defined for probabilities in [0, 1]; got {u[~((u >= 0.0) & (u <= 1.0))][:3]}")
    return u


class Distribution(ABC):
    """A univariate distribution of one parameter, in the parameter's own unit.

    A new one is a frozen dataclass with `bounds`, `moments`, `_log_density` and `_quantile`.
    """

    @property
    @abstractmethod
    def bounds(self) -> tuple[float, float]:
        """Closed interval outside which the density is zero."""

    @property
    @abstractmethod
    def moments(self) -> tuple[float, float]:
        """Mean and standard deviation of the distribution itself (as truncated, where it is truncated)."""

    @abstractmethod
    def _log_density(self, x: np.ndarray) -> np.ndarray:
        """Logarithm of the density inside the bounds; anything outside them."""

    @abstractmethod
    def _quantile(self, u: np.ndarray) -> np.ndarray:
        """Inverse of the distribution function for u in [0, 1]."""

    def logpdf(self, x: np.ndarray | float) -> np.ndarray | float:
        """Logarithm of the density.

        Parameters
        ----------
        x : array_like, any shape

        Returns
        -------
        ndarray of the same shape, or float : -inf outside the bounds and at NaN, never NaN.
        """
        x = np.asarray(x, dtype=float)
        low, high = self.bounds
        with np.errstate(all="ignore"):
            return np.where((x >= low) & (x <= high), self._log_density(x), -np.inf)[()]

    def ppf(self, u: np.ndarray | float) -> np.ndarray | float:
        """Quantile function: probabilities in [0, 1] to values within the bounds, shape kept.

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
        """Inverse of the survival function, ``ppf(1 - q)``: what a `nautilus.Prior` asks of a distribution."""
        return self.ppf(1.0 - np.asarray(q, dtype=float))

    def rvs(self, size: int | tuple[int, ...] = 1, rng: RandomState = None) -> np.ndarray:
        """Independent draws of shape `size`.

        `rng` is a seed, a NumPy ``Generator`` or ``RandomState``, or None for NumPy's global stream.
        """
        return np.asarray(self.ppf(_uniform_numbers(size, rng)))


def _set_finite(distribution: Distribution, **values: float) -> None:
    """Store finite floats in the fields of a frozen dataclass."""
    for name, value in values.items():
        value = float(value)
        if not math.isfinite(value):
            raise ValueError(f"{type(distribution).__name__}: {name} must be finite; got {value}")
        object.__setattr__(distribution, name, value)


def _set_positive(distribution: Distribution, **values: float) -> None:
    """Store finite floats greater than zero in the fields of a frozen dataclass."""
    _set_finite(distribution, **values)
    for name in values:
        if getattr(distribution, name) <= 0.0:
            raise ValueError(f"{type(distribution).__name__}: {name} must be > 0; got {getattr(distribution, name)}")


def _standard_truncated_normal(a: float, b: float) -> tuple[float, float, float]:
    """Mass of a standard normal on [a, b]; mean and variance of the normal truncated there."""
    from scipy.special import erf, ndtr  # scipy starts slowly, and whoever only evaluates densities needs none of it

    if (b - a) * max(abs(a), abs(b), 1.0) < 1.0:
        # differences of tail probabilities cancel on a narrow interval; the density is smooth there, so integrate it
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
        Of the normal before truncation (sd > 0), in the unit of the parameter.
    lower, upper : float
        Bounds, lower < upper, infinite allowed; by default positive values only.

    Raises
    ------
    ValueError
        Also when the bounds leave less probability than a float can hold (some 37 sd from the mean).

    Notes
    -----
    Quantiles are computed from the nearer tail, so both tails are resolved; their error is a few units of round-off
    of max(abs(mean), sd).
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
                f"TruncatedNormal: a normal of mean {self.mean} and sd {self.sd} has no probability that a float can "
                f"hold in [{self.lower}, {self.upper}]; move the mean towards the bounds or raise the sd"
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
    """Absolute value of a normal of mean zero: the usual prior of a noise's standard deviation.

    With another lower bound, write ``TruncatedNormal(0.0, sd, lower=...)``.

    Parameters
    ----------
    sd : float
        Standard deviation of the normal before folding (> 0), in the unit of the parameter.
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
    """Constant density on [low, high], both finite and included."""

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

    Given by its median, which carries the unit of the parameter, rather than by the mean of the logarithm, which has
    none.

    Parameters
    ----------
    median : float
        Median (> 0), in the unit of the parameter: the exponential of the mean of its logarithm.
    log_sd : float
        Standard deviation of the natural logarithm (> 0); near the coefficient of variation when it is small.
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
        # one product instead of a difference of two infinities at x = 0
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
        In the order of the parameters.

    Attributes
    ----------
    names : tuple of str
    dim : int
    bounds : ndarray[dim, 2]
        Lower and upper bound of every parameter.
    distributions : dict of str to Distribution

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
                raise ValueError(f"Prior: {name!r} must be a Distribution of this module; got {distribution!r}")
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
        float or ndarray[n] : -inf outside the bounds and where a value is NaN, never NaN.
        """
        x = self._checked(x, "x")
        inside = ((x >= self.bounds[:, 0]) & (x <= self.bounds[:, 1])).all(axis=-1)
        with np.errstate(all="ignore"):
            total = sum(d._log_density(column) for d, column in zip(self.distributions.values(), x.T, strict=True))
        log_density = np.where(inside, total, -np.inf)
        return log_density if x.ndim == 2 else float(log_density)

    def transform(self, u: np.ndarray) -> np.ndarray:
        """From the unit cube to the parameters, for nested samplers.

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
        """Independent draws: ndarray[size, dim].

        Parameters
        ----------
        size : int
        random_state : int, numpy.random.Generator, numpy.random.RandomState or None
            A seed, a generator, or None for NumPy's global stream (``np.random.seed``).
        """
        return self.transform(_uniform_numbers((size, self.dim), random_state))

    def reorder(self, names: Iterable[str]) -> "Prior":
        """The same prior with its parameters in the order of `names`, which must be the same set."""
        names = tuple(names)
        if sorted(names) != sorted(self.names):
            raise ValueError(
                f"the prior and the parameters must have the same names; the prior has {list(self.names)}, "
                f"the parameters are {list(names)}; without a prior: {sorted(set(names) - set(self.names))}; "
                f"unknown: {sorted(set(self.names) - set(names))}"
            )
        return Prior({name: self.distributions[name] for name in names})
