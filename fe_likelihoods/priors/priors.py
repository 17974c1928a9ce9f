"""Prior of all parameters: independent distributions of single parameters or of several correlated ones.

`Prior` has the attributes that clients expect of a prior (``logpdf``, ``rvs``, ``bounds``, ``dim``), ``transform`` from
the unit cube, and ``to_normal`` and ``from_normal``, the map between the parameters and standard normal variables.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from .distributions import Distribution, RandomState, as_generator, probabilities_of
from .multivariate import MultivariateDistribution, as_distribution, as_multivariate


class Prior:
    """Independent distributions under the names of the parameters.

    Parameters
    ----------
    distributions : mapping of str to Distribution, and tuple of str to MultivariateDistribution
        Parameter names and their distributions, in the order of the parameters. A tuple of names has a distribution of
        these parameters together: a frozen ``scipy.stats.multivariate_normal``, or the result of `fit_mixture`, which
        has names itself: the tuple must have the same names, in any order. Frozen continuous distributions of
        `scipy.stats` are accepted as well.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    dim : int
        Number of parameters.
    bounds : ndarray[dim, 2]
        Lower and upper bound of every parameter.
    distributions : dict
        As given; scipy's distributions as objects of this package.
    logarithmic : tuple of bool
        `Distribution.logarithmic` of every parameter; False for parameters with a joint distribution.

    Raises
    ------
    ValueError
        If `distributions` is not such a mapping, or empty, if names repeat, or a joint distribution has another number
        of parameters than names, or other names.

    Examples
    --------
    >>> independent = Prior({"stiffness": TruncatedNormal(1.0, 0.3), "sigma": HalfNormal(0.03)})
    >>> independent.rvs(1000, 42).shape
    (1000, 2)
    >>> from scipy.stats import multivariate_normal
    >>> correlated = multivariate_normal([1.0, 1.0], [[0.04, 0.01], [0.01, 0.09]])
    >>> Prior({("stiffness", "damping"): correlated, "sigma": HalfNormal(0.03)}).dim
    3
    """

    def __init__(self, distributions: Mapping[str | tuple[str, ...], Distribution | MultivariateDistribution]) -> None:
        if not isinstance(distributions, Mapping) or not distributions:
            raise ValueError(
                "Prior expects a non-empty mapping of parameter names to distributions, such as "
                f'{{"stiffness": TruncatedNormal(1.0, 0.3)}}; got {distributions!r}'
            )
        self.distributions = {
            key: as_multivariate(key, distribution) if isinstance(key, tuple) else as_distribution(key, distribution)
            for key, distribution in distributions.items()
        }
        names = [name for key in self.distributions for name in (key if isinstance(key, tuple) else (key,))]
        if len(set(names)) != len(names):
            raise ValueError(f"Prior: the names of the parameters must differ; got {', '.join(names)}")
        # a distribution with names gets its parameters in its own order, whatever the order of the key
        self.distributions = {
            distribution.names or key if isinstance(key, tuple) else key: distribution
            for key, distribution in self.distributions.items()
        }
        self._set_order(tuple(names))

    def _set_order(self, names: tuple[str, ...]) -> None:
        """Set the order of the parameters."""
        self.names, self.dim = names, len(names)
        single = {key: d for key, d in self.distributions.items() if not isinstance(key, tuple)}
        self._single = [(names.index(name), d) for name, d in single.items()]
        self._joint = [
            ([names.index(name) for name in key], d) for key, d in self.distributions.items() if isinstance(key, tuple)
        ]
        # equal distributions are mapped together: 50 stiffnesses one by one took ten times as long. A user's class may
        # compare arrays, or not all that it has: its objects are equal to themselves only
        alike: dict = {}
        for column, d in self._single:
            alike.setdefault(d if type(d).__module__ == Distribution.__module__ else id(d), (d, []))[1].append(column)
        self._maps = [(columns, d) for d, columns in alike.values()] + self._joint
        self.bounds = np.empty((self.dim, 2))
        for column, distribution in [*self._single, *self._joint]:
            self.bounds[column] = distribution.bounds
        self.logarithmic = tuple(name in single and single[name].logarithmic for name in names)

    def __repr__(self) -> str:
        return f"Prior({self.distributions!r})"

    def table(self) -> tuple[tuple[str, ...], list[tuple]]:
        """A header, and a row per parameter: name, distribution, mean, standard deviation, lower and upper bound."""
        rows: list[tuple] = [()] * self.dim
        for column, distribution in self._single:
            rows[column] = (repr(distribution), *distribution.moments, *distribution.bounds)
        for columns, distribution in self._joint:
            kind = f"{type(distribution).__name__} of {len(columns)}"
            moments = zip(*_moments(distribution), *np.asarray(distribution.bounds).T, strict=True)
            for column, numbers in zip(columns, moments, strict=True):
                rows[column] = (kind, *map(float, numbers))
        header = ("parameter", "distribution", "mean", "sd", "lower", "upper")
        return header, [(name, *row) for name, row in zip(self.names, rows, strict=True)]

    def _checked(self, values: np.ndarray, what: str) -> np.ndarray:
        values = np.asarray(values, dtype=float)
        if values.ndim not in (1, 2) or values.shape[-1] != self.dim:
            raise ValueError(
                f"{what} must have shape ({self.dim},) or (n, {self.dim}), in the order {', '.join(self.names)}; "
                f"got {values.shape}"
            )
        return values

    def logpdf(self, x: np.ndarray) -> np.ndarray | float:
        """Sum of the log densities (n,) at x (n, dim), a float at (dim,): -inf outside the bounds and at NaN."""
        x = self._checked(x, "x")
        inside = ((x >= self.bounds[:, 0]) & (x <= self.bounds[:, 1])).all(axis=-1)
        with np.errstate(all="ignore"):
            total = sum(d._log_density(x[..., column]) for column, d in self._single)
            total = total + sum(d.logpdf(x[..., columns]) for columns, d in self._joint) if self._joint else total
        log_density = np.where(inside, total, -np.inf)
        return log_density if x.ndim == 2 else float(log_density)

    def transform(self, u: np.ndarray) -> np.ndarray:
        """Map from the unit cube, u (dim,) or (n, dim) in [0, 1], to the parameters, for nested samplers."""
        from scipy.special import ndtri  # slow to import, and not needed for densities

        u = probabilities_of(self._checked(u, "u"))
        x = np.empty(u.shape)
        for column, distribution in self._single:
            x[..., column] = distribution.ppf(u[..., column])
        for columns, distribution in self._joint:
            # infinite scores would give NaN in a sum of correlated scores
            x[..., columns] = distribution.from_normal(ndtri(np.clip(u[..., columns], 1e-300, 1.0 - 1e-16)))
        return x

    def from_normal(self, z: np.ndarray) -> np.ndarray:
        """Map independent standard normal variables z, (dim,) or (n, dim), to parameters that have this prior.

        They are within the bounds, to which infinite z are mapped, and NaN where z is NaN. The map of each parameter is
        increasing and accurate in both tails (`Distribution.from_normal`). With z = z(x), the log prior density at x is
        the sum over the parameters of log phi(z) - log(dx / dz), with the standard normal density phi.
        """
        z = self._checked(z, "z")
        x = np.empty(z.shape)
        for columns, distribution in self._maps:
            x[..., columns] = distribution.from_normal(z[..., columns])
        return x

    def to_normal(self, x: np.ndarray) -> np.ndarray:
        """Map from parameters x, (dim,) or (n, dim), to standard normal variables, the inverse of `from_normal`."""
        x = self._checked(x, "x")
        z = np.empty(x.shape)
        for columns, distribution in self._maps:
            z[..., columns] = distribution.to_normal(x[..., columns])
        return z

    def rvs(self, size: int = 1, random_state: RandomState = None) -> np.ndarray:
        """Independent draws (size, dim), from a seed, a generator, or NumPy's global stream (None, ``np.random.seed``).

        Examples
        --------
        >>> posterior.prior.rvs(5, 1).shape
        (5, 4)
        """
        random_state = as_generator(random_state)
        u = random_state.random((size, self.dim))
        x = np.empty(u.shape)
        for column, distribution in self._single:
            x[:, column] = distribution.ppf(u[:, column])
        for columns, distribution in self._joint:
            x[:, columns] = distribution.rvs(size, random_state)
        return x

    def mean(self) -> np.ndarray:
        """Mean of every parameter, shape (dim,)."""
        mean = np.empty(self.dim)
        for column, distribution in self._single:
            mean[column] = distribution.moments[0]
        for columns, distribution in self._joint:
            mean[columns] = _moments(distribution)[0]
        return mean

    def reorder(self, names: Iterable[str]) -> "Prior":
        """The same prior with its parameters in the order of `names`; ValueError if the names are not the same."""
        names = tuple(names)
        if sorted(names) != sorted(self.names):
            raise ValueError(
                f"the prior and the parameters must have the same names; the prior has {list(self.names)}, "
                f"the parameters are {list(names)}; without a prior: {sorted(set(names) - set(self.names))}; "
                f"unknown: {sorted(set(self.names) - set(names))}"
            )
        if not self._joint:
            return Prior({name: self.distributions[name] for name in names})
        prior = Prior(self.distributions)
        prior._set_order(names)
        return prior

    def subset(self, names: Iterable[str]) -> "Prior":
        """The prior of some parameters, in the order of `names`: all or none of those with a joint distribution.

        ValueError if a name is unknown, or a joint distribution would be split.
        """
        names = tuple(names)
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(f"the prior has no parameters {', '.join(unknown)}; it has {', '.join(self.names)}")
        kept = {}
        for key, distribution in self.distributions.items():
            members = key if isinstance(key, tuple) else (key,)
            inside = [name for name in members if name in names]
            if 0 < len(inside) < len(members):
                raise ValueError(
                    f"the parameters {', '.join(members)} have a joint distribution and cannot be separated; got "
                    f"{', '.join(inside)} only"
                )
            if inside:
                kept[key] = distribution
        return Prior(kept).reorder(names)


def _moments(distribution: MultivariateDistribution) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations (dim,) of a joint distribution, by 10 000 draws with a fixed seed."""
    draws = distribution.rvs(10_000, 0)
    return draws.mean(axis=0), draws.std(axis=0)
