r"""What the data tell of each parameter, and of which combinations of parameters.

In standard normal coordinates z of the prior (`Prior.to_normal`) the prior covariance is the identity. The posterior
covariance C in these coordinates therefore shows what the data have added:

.. math:: \sqrt{C_{ii}}, \qquad C = V \Lambda V^T,

the square root of a diagonal element is the share of the prior's standard deviation that is left of a parameter, and
the square root of an eigenvalue is the share that is left of a direction. A direction that is known much better than
its parameters is a combination of parameters: the data determine it, but not its parts. For parameters that the prior
keeps away from zero the combination is expressed in logarithms, in which a product is a sum.

Before a run C is the Laplace approximation at the best fit, after a run the covariance of the samples. Eigenvalues of
a posterior covariance relative to the prior covariance are the standard measure of what data add: A. Spantini et al.
(2015), Optimal low-rank approximations of Bayesian linear inverse problems, SIAM Journal on Scientific Computing 37(6),
A2451-A2487, doi:10.1137/140977308, section 2.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh

from samplers.estimates.genealogy import FEWEST_FOR_VARIANCE as FEWEST

from ..emulation.modes import Mode, find_modes
from ..emulation.target import LARGEST_FACTOR
from ..likelihood.posterior import Posterior
from ..priors.points import as_rows
from ..priors.priors import Prior
from ..text_tables import listed

DETERMINED = 0.3  # share of the prior's standard deviation up to which a parameter is determined
MUCH_BETTER = 0.5  # share left of a combination, over the smallest one of its parameters
MOST_NAMED = 4  # parameters of a combination whose exponents are given
MAP_STEP = 1e-4  # of coordinates, for the slopes of the parameters
FARTHEST = 4.0  # coordinate up to which slopes are taken: beyond, parameters may be rounded to a bound
AT_BOUND = 8.5  # coordinate of a parameter that is rounded to a bound of its prior
ENDED_EARLY = "The search ended before the best fit, so these shares are rough."


class Combination(NamedTuple):
    """A combination of parameters that the data determine better than the parameters.

    Attributes
    ----------
    names : tuple of str
        Names of its parameters.
    exponents : (n,) float
        Exponents of a product, or coefficients of a sum, the first one 1.
    kind : str
        "product"; "sum"; or "combination" of factors and other parameters, or of many parameters, whose `exponents`
        are weights of prior standard deviations.
    left : float
        Share of its prior standard deviation that is left [-].
    """

    names: tuple[str, ...]
    exponents: np.ndarray
    kind: str
    left: float

    def __str__(self) -> str:
        if self.kind == "combination":
            return f"a combination of {listed(self.names)}"
        numbers = [f"{each:#.2g}".rstrip(".") for each in self.exponents]
        if self.kind == "product":
            powers = [name + ("" if x == "1.0" else f"^{x}") for name, x in zip(self.names, numbers, strict=True)]
            return f"the product {' '.join(powers)}"
        terms = [
            f"{x[0] if x[0] == '-' else '+'} {x.lstrip('-')} {name}"
            for name, x in zip(self.names, numbers, strict=True)
        ]
        return f"the sum {' '.join([self.names[0], *terms[1:]])}"


class Identifiability(NamedTuple):
    """What data tell of the structural parameters; ``str`` gives plain sentences.

    Attributes
    ----------
    names : tuple of str
        Names of the n parameters.
    left : (n,) float
        Share of the prior's standard deviation that is left of each parameter, in standard normal coordinates [-]: 1
        where the data say nothing.
    directions : (n, n) float
        Directions in rows, the best known first, as weights of the coordinates: deviations in standard deviations of
        the prior. A direction has a prior variance of 1.
    left_of_directions : (n,) float
        Share of the prior's standard deviation that is left of each direction [-], ascending.
    slopes : (n,) float
        Change of each parameter per standard deviation of the prior, of the logarithm where `logarithmic` says so.
    logarithmic : (n,) bool
        Parameters that the prior keeps away from zero: combinations of them are products.
    simulations : float
        Simulations that were made for this result.
    remarks : tuple of str
        What limits the result, in sentences.
    """

    names: tuple[str, ...]
    left: np.ndarray
    directions: np.ndarray
    left_of_directions: np.ndarray
    slopes: np.ndarray
    logarithmic: np.ndarray
    simulations: float = 0.0
    remarks: tuple[str, ...] = ()

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Directions that are determined, and known at least twice as well as each of their parameters.

        A parameter belongs to a direction if the direction would be less certain without it: its weight times its
        share is larger than the share of the direction.
        """
        found = []
        for weights, left in zip(self.directions, self.left_of_directions, strict=True):
            members = np.flatnonzero(np.abs(weights) * self.left > left)
            alone = self.left[members].min(initial=np.inf)
            if len(members) < 2 or left > min(DETERMINED, MUCH_BETTER * alone) or self.left[members].max() < DETERMINED:
                continue
            factors = self.logarithmic[members]
            several = len(members) > MOST_NAMED or factors.any() != factors.all()
            kind = "combination" if several else "product" if factors.all() else "sum"
            exponents = weights[members] / (1.0 if several else self.slopes[members])
            names = tuple(self.names[i] for i in members)
            found.append(Combination(names, exponents / exponents[0], kind, float(left)))
        return tuple(found)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is determined, which combinations are, of what the data tell less, and remarks."""
        combinations = self.combinations
        combined = {name for each in combinations for name in each.names}
        known, less = [], []
        for name, left in zip(self.names, self.left, strict=True):
            if left <= DETERMINED:
                known.append((name, left))
            elif name not in combined:
                less.append((name, left))
        lines = [
            f"These data determine {_with_shares(known)}." if known else "These data determine no parameter alone."
        ]
        for each in combinations:
            alone = [(name, self.left[self.names.index(name)]) for name in each.names]
            alone = [f"{name} alone keeps {_percent(left)} %" for name, left in alone]
            lines.append(f"They determine {each} ({_percent(each.left)} % is left), although {listed(alone)}.")
        lines += [f"They tell less of {_with_shares(less)}."] if less else []
        return (*lines, *self.remarks)

    def __str__(self) -> str:
        return " ".join(self.sentences)

    __repr__ = __str__


def _percent(share: float) -> str:
    return f"{100.0 * min(share, 1.0):.2g}" if share < 0.995 else "100"


def _with_shares(parameters: Sequence[tuple[str, float]]) -> str:
    """Names with the shares that are left of them."""
    names, shares = zip(*parameters, strict=True)
    verb = "is" if len(names) == 1 else "are"
    left = f"{listed([_percent(each) for each in shares])} % of the prior's standard deviation {verb} left"
    return f"{listed(names)} ({left})"


def compare_covariances(
    posterior: np.ndarray,
    names: Sequence[str],
    prior: np.ndarray | None = None,
    slopes: np.ndarray | None = None,
    logarithmic: np.ndarray | None = None,
) -> Identifiability:
    """Compare a posterior covariance (n, n) of coordinates of variance 1 with the prior correlation (the identity).

    `slopes` and `logarithmic` (n,) are as in `Identifiability`; by default parameters are the coordinates themselves.
    """
    n = len(names)
    values, vectors = eigh(posterior, np.eye(n) if prior is None else prior)
    if not values[0] > 0.0:
        raise ValueError(
            f"expected a positive definite posterior covariance of {', '.join(names)}; got an eigenvalue of "
            f"{values[0]:.3g}: give more samples that differ"
        )
    return Identifiability(
        tuple(names),
        np.sqrt(np.diag(posterior)),
        vectors.T,
        np.sqrt(values),
        np.ones(n) if slopes is None else np.asarray(slopes, dtype=float),
        np.zeros(n, dtype=bool) if logarithmic is None else np.asarray(logarithmic, dtype=bool),
    )


def _of_covariance(prior: Prior, centre: np.ndarray, covariance: np.ndarray, chosen: np.ndarray) -> Identifiability:
    """What a posterior covariance (ndim, ndim) of standard normal coordinates says of the `chosen` parameters.

    Slopes of the parameters are taken at the coordinates `centre` (ndim,). The coordinates of parameters with a joint
    prior are combinations of these parameters: each parameter is linearised there and divided by its prior deviation.
    """
    centre = np.clip(centre, -FARTHEST, FARTHEST)
    unit = MAP_STEP * np.eye(prior.dim)
    ahead, behind = prior.from_normal(centre + unit), prior.from_normal(centre - unit)
    gradient = ((ahead - behind) / (2.0 * MAP_STEP)).T[chosen]
    slopes = np.linalg.norm(gradient, axis=1)
    if (slopes == 0.0).any():
        raise ValueError(
            f"expected a prior whose parameters vary; {prior.names[chosen[np.argmin(slopes)]]} does not: leave it out"
        )
    mixing = gradient / slopes[:, None]
    low, high = prior.from_normal(np.array([[-2.0], [2.0]]) * np.ones(prior.dim))[:, chosen]
    factors = np.array(prior.logarithmic)[chosen] | (low > 0.0) & (high < LARGEST_FACTOR * low)
    at = prior.from_normal(centre)[chosen]
    names = [prior.names[i] for i in chosen]
    slopes = slopes / np.where(factors, np.maximum(at, np.finfo(float).tiny), 1.0)
    return compare_covariances(mixing @ covariance @ mixing.T, names, mixing @ mixing.T, slopes, factors)


def of_mode(posterior: Posterior, mode: Mode) -> Identifiability:
    """What the Laplace approximation at a mode says of the structural parameters; ValueError as `identifiability`."""
    found = _of_covariance(posterior.prior, mode.coords, mode.covariance, _structural(posterior))
    return found if mode.converged else found._replace(remarks=(ENDED_EARLY,))


def _structural(posterior: Any) -> np.ndarray:
    return np.setdiff1d(np.arange(posterior.prior.dim), getattr(posterior, "fast_parameters", ()))


def of_samples(posterior: Any, samples: Any) -> Identifiability:
    """What samples (n, ndim) of a posterior say of its structural parameters; ValueError as `identifiability`."""
    prior = posterior.prior
    samples = as_rows(samples, prior.names)
    if len(samples) < FEWEST * prior.dim:
        raise ValueError(
            f"expected {FEWEST} samples for each of the {prior.dim} parameters; got {len(samples)}: give all samples "
            "of the run, sampler.get_chain(flat=True), or none for a search"
        )
    coords = np.clip(prior.to_normal(samples), -AT_BOUND, AT_BOUND)
    covariance = np.atleast_2d(np.cov(coords, rowvar=False))
    return _of_covariance(prior, coords.mean(axis=0), covariance, _structural(posterior))


def identifiability(
    posterior: Posterior, samples: Any = None, *, max_simulations: float | None = None
) -> Identifiability:
    """Say which parameters and which combinations of parameters the data determine.

    Parameters
    ----------
    posterior : Posterior
    samples : (n, ndim) array_like, or named values of shape (n,), optional
        Samples of the posterior with equal weights, ``sampler.get_chain(flat=True)``; nothing is simulated then.
        Default: the Laplace approximation at the best fit that a search from the median of the prior finds.
    max_simulations : float, optional
        Largest number of simulations of this search, which takes about ten for each parameter.

    Returns
    -------
    Identifiability
        Of the structural parameters; noise parameters are integrated out.

    Raises
    ------
    ValueError
        If there are fewer than ten samples for each parameter, or no fit is found, or the noise level depends on the
        response, so that there is no search (give samples), or a joint distribution of the prior has no standard normal
        coordinates.

    Notes
    -----
    A search describes the mode that it ends in; of a posterior with several modes or with curved ridges, samples tell
    more. The share of a standard deviation has a standard error of about 1 / sqrt(2 n) from n independent samples.

    Examples
    --------
    >>> print(identifiability(posterior, samples))  # doctest: +SAMPLED
    These data determine stiffness and damping (1.1 and 2.5 % of the prior's standard deviation are left).
    """
    if samples is not None:
        return of_samples(posterior, samples)
    search = find_modes(posterior, starts=1, max_simulations=max_simulations)
    if not search.modes:
        raise ValueError(
            f"expected a fit to the data; {search.simulations:.0f} simulations found none: allow more "
            "(max_simulations), check the model (check_model), or give samples"
        )
    return of_mode(posterior, search.modes[0])._replace(simulations=search.simulations)
