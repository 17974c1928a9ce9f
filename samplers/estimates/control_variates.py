"""Expectations from few weighted draws and a known density close to the posterior (control variates).

The known density, such as the posterior of an emulator, has expectations that cost nothing; a poor one costs accuracy,
but no bias. The estimate is an expectation over a *signed sample*: points of the known density with positive weights,
and the draws with weights of both signs. The equations are in ``docs/theory/guided``.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..resampling import systematic
from .importance import KnownDensity, PooledRounds, Round

# Variances from n draws are multiplied by 1 + FEW / n. Two errors from 30 and 60 draws then contain means, standard
# deviations, tail probabilities and log-evidences in 92 to 100 % of 1200 trials, and without it in as little as 85 %.
FEW = 10.0
# A density hardly reaches a point where another one is more than this many times larger. Emulators of a rough response
# differ by factors of 10 to 100 from fit to fit.
HARDLY = 10.0
# Points of a known density on which another one is evaluated.
COMPARED = 2000


class Expectation(NamedTuple):
    """An expectation under the posterior and its standard error: one number, or one per component of the function."""

    value: np.ndarray
    error: np.ndarray


class SignedSample(NamedTuple):
    """Points with weights of both signs, whose weighted sums are expectations under the posterior."""

    coords: np.ndarray  # (m, ndim), points of the known densities, and evaluated draws
    weights: np.ndarray  # (m,), with sum 1; weights of draws may be negative
    rounds: np.ndarray  # (m,) int, round of a draw, from 1; 0 for a point of a known density
    log_evidence: float
    log_evidence_error: float

    def draw(self, n: int = 4000, seed: int = 0) -> np.ndarray:
        """Draws (n, ndim) of the known densities for figures: smooth, since they are many, and not simulated."""
        known = (self.rounds == 0) & (self.weights > 0.0)
        rng = np.random.default_rng(seed)
        return self.coords[known][systematic(self.weights[known] / self.weights[known].sum(), rng, n)]

    def expectation(self, function: Callable[[np.ndarray], np.ndarray] | None = None) -> Expectation:
        """Expectation of a function of points (m, ndim), which returns (m,) or (m, k); by default of the parameters."""
        values = self.coords if function is None else np.asarray(function(self.coords), dtype=float)
        if values.shape[:1] != (len(self.coords),):
            raise ValueError(
                f"function must return one row for each of the {len(self.coords)} points, whose array it gets: "
                f"lambda x: x[:, 0] < 1.1, not x[0] < 1.1; got an array of shape {values.shape}"
            )
        if not np.all(np.isfinite(values)):
            raise ValueError(f"function must return finite numbers; {np.sum(~np.isfinite(values))} are not")
        # one component after the other: the points of 50 parameters have up to 100 MB, and so have all their copies
        found = np.array([self._of_component(column) for column in values.reshape(len(values), -1).T])
        return Expectation(*found.T.reshape(2, *values.shape[1:]))

    def _of_component(self, values: np.ndarray) -> tuple[float, float]:
        """Expectation and standard error of numbers (m,) at the points."""
        value = self.weights @ values
        apart = values - value
        parts = self.weights * apart
        known = self.rounds == 0
        spread, fourth = (self.weights[known] @ apart[known] ** power for power in (2, 4))
        kurtosis = fourth / (spread if spread > 0.0 else 1.0) ** 2
        variance = np.square(parts[known]).sum()
        for number in np.unique(self.rounds[~known]):
            rows = self.rounds == number
            # few draws may miss the tails of the function: at least the variance for differences independent of it
            least = (1.0 + FEW / rows.sum()) * np.square(self.weights[rows]).sum() * spread
            least = least * (1.0 + kurtosis / rows.sum())
            variance = variance + max(_variance_of_sum(parts[rows]), least)
        return value, np.sqrt(variance)

    def standard_deviation(self) -> Expectation:
        """Standard deviations (ndim,) of the parameters.

        Both numbers are NaN where the variance, a sum with weights of both signs, is not above its own standard error:
        the draws do not determine it, as with a tail of the posterior that the known density does not have.
        """
        mean = self.weights @ self.coords
        variance, error = self.expectation(lambda coords: np.square(coords - mean))
        value = np.sqrt(np.where(variance > error, variance, np.nan))
        return Expectation(value, 0.5 * error / value)


def signed_sample(rounds: Sequence[Round], pooled: PooledRounds) -> SignedSample | None:
    """The signed sample of all rounds with a known density, from all draws `pooled`; None if there is none.

    Each round, as `add_round` returns it, counts by the square of its effective share, which the draws of all rounds
    give: few draws may have a large share by chance.
    """
    used = [k for k, r in enumerate(rounds) if r.known is not None and _meets_known(r)]
    if not used:
        return None
    found = [(rounds[k], *_differences(rounds[k])) for k in used]
    shares = pooled.shares[used] ** 2 / [len(r.coords) for r, *_ in found]
    shares = shares / shares.sum()
    log_evidence, error = _evidence(found, shares)
    coords, weights, numbers, known = [], [], [], {}
    for number, ((r, differences, _), share) in enumerate(zip(found, shares, strict=True), start=1):
        coords.append(r.coords)
        weights.append(share * differences / len(differences))
        numbers.append(np.full(len(differences), number))
        known[id(r.known)] = r.known, share + known.get(id(r.known), (None, 0.0))[1]
    for density, share in known.values():  # rounds may share their known density
        coords.append(density.coords)
        weights.append(share * density.weights)
        numbers.append(np.zeros(len(density.weights), dtype=int))
    return SignedSample(np.concatenate(coords), np.concatenate(weights), np.concatenate(numbers), log_evidence, error)


def unreached_share(log_density: Callable[[np.ndarray], np.ndarray], latest: KnownDensity | None) -> float:
    """Probability under a known density, if there is one, of the points that draws of an earlier one hardly reach: a
    guide may learn late that the posterior is larger, and the weights of its draws do not show it.
    """
    if latest is None:
        return 0.0
    every = max(1, len(latest.weights) // COMPARED)
    coords, weights = latest.coords[::every], latest.weights[::every]
    hardly = log_density(coords) < latest.log_density(coords) - np.log(HARDLY)
    return float(weights[hardly].sum() / weights.sum())


def _meets_known(r: Round) -> bool:
    """Whether a round has a possible draw, and the known density there is a positive number of its own density."""
    with np.errstate(over="ignore"):
        return bool(np.max(r.log_weights) > -np.inf and 0.0 < np.exp(np.max(r.log_known)) < np.inf)


def _differences(r: Round) -> tuple[np.ndarray, float]:
    """The differences c (n,) of a round, and the logarithm of its estimate of the evidence."""
    top = np.max(r.log_weights)
    posterior, known = np.exp(r.log_weights - top), np.exp(r.log_known)
    ratio = posterior.mean() / known.mean()
    return posterior / ratio - known, float(np.log(ratio) + top)


def _evidence(found: Sequence[tuple[Round, np.ndarray, float]], shares: np.ndarray) -> tuple[float, float]:
    """Log-evidence and its standard error: the weighted mean of the rounds' estimates."""
    values = np.array([value for _, _, value in found])
    top = values.max()
    parts = shares * np.exp(values - top)
    total, parts = parts.sum(), parts / parts.sum()
    of_known = parts @ [r.known.log_density_error for r, _, _ in found]
    variances = [_variance_of_sum(differences / len(differences)) for _, differences, _ in found]
    return float(top + np.log(total)), float(np.hypot(np.sqrt(parts**2 @ variances), of_known))


def _variance_of_sum(parts: np.ndarray) -> np.ndarray:
    """Variance (...) of the sum of independent contributions (n, ...), enlarged for few of them."""
    return (1.0 + FEW / len(parts)) * np.square(parts - parts.mean(axis=0)).sum(axis=0)
