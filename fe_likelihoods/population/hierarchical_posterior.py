r"""Hierarchical model of several tests, from the stored posteriors of the single tests, without simulations.

Some parameters vary between the tests (specimens, events) as independent draws of normal populations. Their means and
standard deviations are the hyper-parameters. Other parameters are common to all tests, and the rest belongs to
each test alone. The likelihood of the hyper-parameters is the product over the tests of

.. math::

   m_k(\varphi) = Z_k\, E\left[\frac{p(\theta \mid \varphi)}{p_k(\theta)}\right],

the expectation over the posterior of test k, with its prior density :math:`p_k` and its evidence :math:`Z_k`.
`HierarchicalPosterior` is the posterior density of the hyper-parameters, for any sampler. See
``docs/theory/hierarchy.rst``.
"""

import copy
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from ..likelihood.function_likelihood import FunctionLikelihood
from ..likelihood.posterior import Posterior
from ..priors.distributions import Distribution
from ..priors.multivariate import as_distribution
from ..priors.points import as_points, complete_repr
from ..priors.priors import Prior
from ..priors.scales import Scales
from .population_marginal import population_marginal
from .stored_posterior import StoredPosterior, describe

__all__ = ["HierarchicalPosterior", "Varying"]

_HYPER_NAMES = {"log": ("median", "sd_log"), "linear": ("mean", "sd")}
_LARGEST = 1e100  # of a mean or a standard deviation, and its inverse the smallest: their squares are numbers


@dataclass(frozen=True)
class Varying:
    """Population prior of a parameter that varies between tests.

    Parameters
    ----------
    location : Distribution
        Prior of the population median (scale "log") or mean (scale "linear"), in the parameter's unit.
    sd : Distribution
        Prior of the population's standard deviation, for the parameter's natural logarithm (scale "log") or for the
        parameter, in its unit (scale "linear").
    scale : {"log", "linear"}
        Whether the logarithm of the parameter or the parameter itself has a normal distribution.
    slopes : mapping of str to Distribution
        Prior of the change of the center, on this scale, per unit of a covariate that all tests state
        (`StoredPosterior.covariates`): a temperature, or the logarithm of an amplitude.

    Raises
    ------
    ValueError
        If a standard deviation or a median could be negative, or the scale is unknown.

    Examples
    --------
    >>> stiffness = Varying(LogNormal(1.0, 0.5), HalfNormal(0.3))  # median, standard deviation of the logarithm
    >>> stiffness.scale
    'log'
    """

    location: Distribution
    sd: Distribution
    scale: str = "log"
    slopes: Mapping[str, Distribution] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.scale not in _HYPER_NAMES:
            raise ValueError(f"Varying: scale must be one of {', '.join(map(repr, _HYPER_NAMES))}; got {self.scale!r}")
        for name in ("location", "sd"):
            object.__setattr__(self, name, as_distribution(name, getattr(self, name)))
        object.__setattr__(self, "slopes", {name: as_distribution(name, each) for name, each in self.slopes.items()})
        if self.sd.bounds[0] < 0.0:
            raise ValueError(
                f"Varying: sd must have a prior of positive values, such as HalfNormal(0.3); got {self.sd}"
            )
        if self.scale == "log" and self.location.bounds[0] < 0.0:
            raise ValueError(
                "Varying: with scale='log' the location is a median, which needs a prior of positive values such as "
                f"LogNormal(1.0, 0.5); got {self.location}"
            )


class HierarchicalPosterior(Posterior):
    """Posterior density of the hyper-parameters, given several tests: a `Posterior` that runs no simulation.

    Parameters
    ----------
    tests : mapping of str to StoredPosterior
        The posterior of each test, under its name.
    varying : mapping of str to Varying
        The parameters that vary between the tests, and their population priors.
    common : mapping of str to Distribution, optional
        Parameters with one value for all tests, and their priors. All parameters that are neither varying nor common
        belong to each test alone, with the prior of its stored posterior.

    Attributes
    ----------
    tests, varying : dict
        As given.
    prior : Prior
        Prior of the hyper-parameters.
    scales : Scales
        Scales of the varying and the common parameters.
    described : dict of str to DescribedPosterior
        The samples of each test as they are used.
    covariates : dict of str to float
        Mean of each covariate over the tests, at which the medians and means of the population hold.

    Raises
    ------
    ValueError
        If a test lacks a parameter or a covariate, a parameter is both varying and common, the prior of a test joins
        one of these parameters with others, or an argument is out of range.

    Notes
    -----
    The hyper-parameters are ``median_NAME`` and ``sd_log_NAME`` (scale "log"), or ``mean_NAME`` and ``sd_NAME`` (scale
    "linear"), then ``slope_COVARIATE_NAME``, then the names of the common parameters.

    The likelihood is taken as zero outside the prior bounds of a test.

    The posterior of each test is described by a mixture of normal distributions that is fitted to its samples:
    correlations are kept, and shapes that the mixture cannot describe are lost. `Hierarchy` states the errors.

    Examples
    --------
    >>> varying = {"stiffness": Varying(LogNormal(1.0, 0.5), HalfNormal(0.3))}
    >>> population = HierarchicalPosterior(tests, varying)
    >>> population.parameter_names
    ['median_stiffness', 'sd_log_stiffness']
    >>> run = SMCSampler(100, population.ndim, population, vectorize=True)
    """

    def __init__(
        self,
        tests: Mapping[str, StoredPosterior],
        varying: Mapping[str, Varying],
        *,
        common: Mapping[str, Distribution] | None = None,
    ) -> None:
        common = {} if common is None else common
        _check(tests, varying, common)
        self.tests, self.varying, self.common = dict(tests), dict(varying), tuple(common)
        distributions: dict[str, Any] = {}
        for name, each in varying.items():
            location, sd = _HYPER_NAMES[each.scale]
            distributions |= {f"{location}_{name}": each.location, f"{sd}_{name}": each.sd}
        slopes = [(k, *each) for k, (_, of) in enumerate(varying.items()) for each in of.slopes.items()]
        self._slopes = [(k, covariate) for k, covariate, _ in slopes]
        distributions |= {f"slope_{covariate}_{[*varying][k]}": each for k, covariate, each in slopes}
        names = [*distributions, *common]
        super().__init__(FunctionLikelihood(self.marginal_likelihood, names, True), Prior(distributions | dict(common)))
        self.covariates = {
            name: float(np.mean([test.covariates[name] for test in tests.values()]))
            for name in dict.fromkeys(covariate for _, covariate in self._slopes)
        }
        self.scales = Scales(np.array([each.scale != "log" for each in varying.values()] + [True] * len(common)))
        self.described = {}
        for name, test in self.tests.items():
            try:
                self.described[name] = describe(test, [*varying, *common], self.scales)
            except ValueError as error:
                raise ValueError(f"test {name!r}: {error}") from None

    def without(self, test: str) -> "HierarchicalPosterior":
        """The same posterior density without the data of one test; ValueError for the only test, or an unknown one."""
        if test not in self.tests or len(self.tests) < 2:
            raise ValueError(f"expected one of two tests or more, {', '.join(map(repr, self.tests))}; got {test!r}")
        other = copy.copy(self)
        other.likelihood = FunctionLikelihood(other.marginal_likelihood, self.parameter_names, True)
        other.tests = {name: each for name, each in self.tests.items() if name != test}
        other.described = {name: each for name, each in self.described.items() if name != test}
        return other

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of everything the density depends on."""
        state = hashlib.blake2b(digest_size=16)
        state.update(repr([list(self.varying), self.common]).encode())
        state.update(complete_repr(self.prior).encode())
        for name, each in self.described.items():
            state.update(f"{name} {self.tests[name].log_evidence} {complete_repr(each.prior)}".encode())
            state.update(repr([self.tests[name].covariates[covariate] for covariate in self.covariates]).encode())
            for array in (each.log_shares, each.means, each.covariances):
                state.update(np.ascontiguousarray(array).tobytes())
        return state.hexdigest()

    def marginal_likelihood(self, points: np.ndarray) -> np.ndarray:
        """Logarithm (n,) of the marginal likelihood of all tests at hyper-parameters (n, ndim) inside their prior."""
        total = np.zeros(len(points))
        for name, each in self.described.items():
            population = self.population(points, self.tests[name].covariates)
            total += population_marginal(each, *population) + (self.tests[name].log_evidence or 0.0)
        return total

    def population(self, x: Any, covariates: Mapping[str, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Centers (n, n_varying + n_common) and standard deviations (n, n_varying) on the scales of the parameters.

        Of hyper-parameters (n, ndim), for a test with these covariates (default: their means over the tests). The
        center of a common parameter is its value. ValueError for a covariate without a finite number.
        """
        points, n = np.atleast_2d(as_points(x, self.prior.names)), len(self.varying)
        end = points.shape[1] - len(self.common)
        center = np.concatenate([points[:, 0 : 2 * n : 2], points[:, end:]], axis=1)
        center = self.scales.to_scale(center)
        for column, (k, name) in enumerate(self._slopes, start=2 * n):
            center[:, k] += points[:, column] * self._beyond(name, covariates)
        deviations = np.clip(points[:, 1 : 2 * n : 2], 1.0 / _LARGEST, _LARGEST)
        return np.clip(center, -_LARGEST, _LARGEST), deviations

    def slope_spread(self, x: Any, covariates: Mapping[str, float]) -> dict[str, float]:
        """Standard deviations of the centers at these covariates, of hyper-parameters (n, ndim), by their slopes."""
        points, n, found = np.atleast_2d(as_points(x, self.prior.names)), len(self.varying), {}
        for column, (k, name) in enumerate(self._slopes, start=2 * n):
            found[k] = found.get(k, 0.0) + points[:, column] * self._beyond(name, covariates)
        return {[*self.varying][k]: float(np.std(each)) for k, each in found.items()}

    def _beyond(self, name: str, covariates: Mapping[str, float] | None) -> float:
        """A covariate less its mean over the tests."""
        value = (self.covariates if covariates is None else covariates).get(name)
        if not isinstance(value, Real) or not np.isfinite(value):
            raise ValueError(
                f"the population depends on {', '.join(self.covariates)}: expected a number for each of them, such as "
                f"covariates={self.covariates}; got {dict(covariates or {})}"
            )
        return float(value) - self.covariates[name]


def _check(tests: Any, varying: Any, common: Any) -> None:
    """Raise ValueError for arguments of `HierarchicalPosterior` that cannot be used."""
    for what, values, kind in (("tests", tests, StoredPosterior), ("varying", varying, Varying)):
        if (
            not isinstance(values, Mapping)
            or not values
            or not all(isinstance(name, str) and isinstance(each, kind) for name, each in values.items())
        ):
            raise ValueError(
                f"HierarchicalPosterior: {what} must be a non-empty mapping of names to {kind.__name__}; got {values!r}"
            )
    if not isinstance(common, Mapping):
        raise ValueError(f"HierarchicalPosterior: common must be a mapping of names to distributions; got {common!r}")
    for name in dict.fromkeys(covariate for each in varying.values() for covariate in each.slopes):
        if missing := [test for test, each in tests.items() if name not in each.covariates]:
            raise ValueError(
                f"HierarchicalPosterior: expected the covariate {name} in every test, StoredPosterior(..., covariates="
                f'{{"{name}": 12.0}}); {", ".join(map(repr, missing))} lack it'
            )
    if both := sorted(set(varying) & set(common)):
        raise ValueError(f"HierarchicalPosterior: {', '.join(both)} cannot be both varying and common")
