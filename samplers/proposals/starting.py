"""A distribution around the points of a finished run, from which another run can start.

A cheaper model of the same parameters often has nearly the same posterior. A first sampler finds the posterior of the
cheap model, and a second sampler starts there instead of from the prior. Its annealing ends at the posterior of the
full model, so no value of the cheap model enters the result.

Half the draws come from a mixture that is fitted to the points. The other half are spread evenly over the same mixture
at 3, 9 and 27 times its width, and the prior, to cover the space between two different posteriors. The prior as a
component also bounds the weights (defensive mixture).

Reference: Hesterberg, T. (1995), Weighted average importance sampling and defensive mixture distributions,
Technometrics 37(2), doi:10.1080/00401706.1995.10484303
"""

from collections.abc import Callable

import numpy as np

from .mixture import draw, fit_mixture, log_density
from .transforms import find_support_bounds

__all__ = ["StartingProposal"]

# Widths of the mixture, as multiples of the fitted width, and shares of their draws; the rest is drawn from the prior.
WIDTHS = (1.0, 3.0, 9.0, 27.0)
SHARES = (0.5, 0.125, 0.125, 0.125)
# Draws from which the mass inside the support of the prior is estimated: its logarithm has an error of at most 0.01 for
# a mass of half.
DRAWS_FOR_MASS = 10_000


class StartingProposal:
    """A normalised density around points, inside the support of the prior.

    Parameters
    ----------
    coords : (n, ndim) float
        Equally weighted points.
    log_prior : callable
        Function of points (m, ndim) that returns the normalised log-density (m,) of the prior; -inf outside.
    sample_prior : callable
        Function of (m, random) that returns m draws (m, ndim) of the prior.
    """

    def __init__(self, coords: np.ndarray, log_prior: Callable, sample_prior: Callable):
        self._log_prior, self._sample_prior = log_prior, sample_prior
        bounds = find_support_bounds(self._inside, coords)
        fitted = fit_mixture(coords, np.full(len(coords), 1.0 / len(coords)), bounds=bounds)
        self._mixtures = [fitted._replace(roots=w * fitted.roots, inverses=fitted.inverses / w) for w in WIDTHS]
        random = np.random.RandomState(0)
        sizes = random.multinomial(DRAWS_FOR_MASS, np.array(SHARES) / sum(SHARES))
        tried = np.concatenate([draw(mixture, n, random) for mixture, n in zip(self._mixtures, sizes, strict=True)])
        self._log_mass = np.log(np.mean(self._inside(tried)))

    def _inside(self, coords: np.ndarray) -> np.ndarray:
        return self._log_prior(coords) > -np.inf

    def logpdf(self, x: np.ndarray) -> np.ndarray | float:
        """Log-density at points: (n, ndim) -> (n,), (ndim,) -> float; -inf outside the support of the prior."""
        points = np.atleast_2d(x)
        log_prior = self._log_prior(points)
        total = np.log1p(-sum(SHARES)) + log_prior
        for share, mixture in zip(SHARES, self._mixtures, strict=True):
            log_share = np.log(share) - self._log_mass
            total = np.logaddexp(total, log_share + log_density(mixture, points))
        total = np.where(log_prior > -np.inf, total, -np.inf)
        return total if np.ndim(x) > 1 else float(total[0])

    def rvs(self, size: int, random_state: int | np.random.RandomState | None = None) -> np.ndarray:
        """Independent draws (size, ndim); `random_state`: a seed, or a source of random numbers."""
        random = (
            random_state if isinstance(random_state, np.random.RandomState) else np.random.RandomState(random_state)
        )
        of_prior = random.binomial(size, 1.0 - sum(SHARES))
        kept = [np.asarray(self._sample_prior(of_prior, random), dtype=float)]
        missing = size - of_prior
        while missing > 0:
            sizes = random.multinomial(missing, np.array(SHARES) / sum(SHARES))
            tried = [draw(mixture, n, random) for mixture, n in zip(self._mixtures, sizes, strict=True) if n > 0]
            inside = np.concatenate(tried)
            kept.append(inside[self._inside(inside)])
            missing -= len(kept[-1])
        return random.permutation(np.concatenate(kept))
