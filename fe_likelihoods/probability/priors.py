"""Prior of all parameters: independent distributions under the names of the parameters.

`Prior` has the attributes that clients expect of a prior (``logpdf``, ``rvs``, ``bounds``, ``dim``), ``transform`` from
the unit cube, and ``to_normal`` and ``from_normal``, the map between the parameters and standard normal variables.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from .distributions import Distribution, RandomState, uniform_numbers

__all__ = ["Prior"]


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

    def from_normal(self, z: np.ndarray) -> np.ndarray:
        """Map from independent standard normal variables to the parameters, by which the prior is standard normal.

        Parameters
        ----------
        z : ndarray[dim] or ndarray[n, dim]
            Infinite values map to the bounds.

        Returns
        -------
        ndarray of the same shape
            Within the bounds; NaN where z is NaN.

        Notes
        -----
        The map of each parameter is increasing and accurate in both tails, see `Distribution.from_normal`. With z of x,
        the logarithm of the prior density at x is the sum over the parameters of log phi(z) - log(dx / dz), with the
        standard normal density phi.
        """
        z = self._checked(z, "z")
        columns = [d.from_normal(column) for d, column in zip(self.distributions.values(), z.T, strict=True)]
        return np.stack(columns, axis=-1)

    def to_normal(self, x: np.ndarray) -> np.ndarray:
        """Map from the parameters to independent standard normal variables, the inverse of `from_normal`.

        Parameters
        ----------
        x : ndarray[dim] or ndarray[n, dim]

        Returns
        -------
        ndarray of the same shape
            -inf at and below the lower bound, inf at and above the upper bound; NaN where x is NaN.
        """
        x = self._checked(x, "x")
        columns = [d.to_normal(column) for d, column in zip(self.distributions.values(), x.T, strict=True)]
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
        return self.transform(uniform_numbers((size, self.dim), random_state))

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
