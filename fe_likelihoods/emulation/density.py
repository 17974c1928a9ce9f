"""The emulated posterior: its density, its evidence and independent draws, without simulations.

Each mode has a region with an emulator of its own. A point belongs to the region whose centre is nearest, in the
whitened parameters of its emulator; the density there is the prior times the emulated likelihood, also far from all
simulations: a density that ends near them would grow along a ridge by a part in each round. A mixture is fitted to it
by adaptive importance sampling in memory (Cornuet, Marin, Mira & Robert, 2012, Scand. J. Stat. 39(4),
doi:10.1111/j.1467-9469.2011.00756.x), from a t distribution per region. A large sample of weighted points (the pool)
gives the evidence of the emulated posterior, and draws.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from samplers.estimates.importance import KnownDensity
from samplers.estimates.weights import effective_sample_size, log_mean_weight, normalised_weights
from samplers.judgement.rounds import RELIABLE_SHARE
from samplers.proposals.mixture import DOF, POINTS_PER_DIMENSION, Mixture, draw, fit_mixture, invert_roots, log_density

from .emulator import ResponseEmulator
from .target import ResponseTarget

_FREEDOM = DOF  # at least, else as many as parameters: 50 keep 86 % of draws of a normal density in 50, 6 keep 44 %
_ROUNDS, _DRAWS = 6, 3000  # of the adaptation, and draws of each
_POOL, _NUMBERS = 20_000, 300_000  # points of the pool, and numbers that they have at most, whatever the dimension
_CURVED = 0.15  # share of effective points in the pool below which several components per region are fitted
_FITTED = 4000  # points of the pool that they are fitted to
_RIDGE = 1e-9  # added to variances, relative, since rounding may make one negative
_PLAUSIBLE = 8.0  # log-density below the best, besides 1 per dimension, of runs that the pool must reach


class Region(NamedTuple):
    """A part of the posterior around one mode."""

    centre: np.ndarray  # (ndim,) mean, or the mode while the mean is not known
    covariance: np.ndarray  # (ndim, ndim) of the part
    emulator: ResponseEmulator | None  # None before there are enough runs
    log_evidence: float  # from the Laplace approximation before there is an emulator


def tempered(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Log-weights (n,), with a smaller power where they have fewer effective points than `least`."""
    power = 1.0
    while power > 1e-4 and effective_sample_size(power * log_weights) < least:
        power *= 0.7
    return power * log_weights


def student_mixture(weights: np.ndarray, means: Any, covariances: Any, dof: float) -> Mixture:
    """Mixture of t distributions with weights (k,), means (k, d) and scale matrices (k, d, d)."""
    covariances = np.array(covariances)
    roots = np.linalg.cholesky(covariances * (1.0 + _RIDGE * np.eye(covariances.shape[-1])))
    return Mixture(weights, np.array(means), roots, invert_roots(roots), dof)


def around(regions: Sequence[Region], widened: float, dof: float) -> Mixture:
    """Mixture of t distributions around regions, with covariances times `widened`; small regions keep a share."""
    shares = normalised_weights(np.array([region.log_evidence for region in regions]))
    centres, covariances = zip(*((each.centre, widened * each.covariance) for each in regions), strict=True)
    return student_mixture(0.9 * shares + 0.1 / len(shares), centres, covariances, dof)


class EmulatedPosterior:
    """Density of the emulated posterior, from regions with emulators, and a weighted sample of it, the pool.

    `log_evidence` is the log of the integral over the emulated density; `known_density` is this of the parameters, with
    the pool and the error of the importance sampling in memory; `effective_share` is the share of effective points in
    the pool; `of_runs` are log-densities (n,) of the simulations by their responses, and by the emulators; `regions`
    are those given, with their moments.
    """

    def __init__(self, target: ResponseTarget, regions: Sequence[Region], random: np.random.RandomState) -> None:
        self._target, self.regions, self._scales = target, list(regions), regions[0].emulator.scales
        wide, size = self._around_runs(), min(_POOL, _NUMBERS // target.ndim)
        scaled = []
        for region in self.regions:
            roots = around([region], 1.0, np.inf).roots[0].T
            moved = target.scaled(region.centre + np.concatenate([roots, -roots]), self._scales)
            steps = 0.5 * (moved[: target.ndim] - moved[target.ndim :])
            centre = target.scaled(region.centre[None], self._scales)[0]
            scaled.append(region._replace(centre=centre, covariance=steps.T @ steps))
        own = 1.0 - sum(share for _, share in wide)

        freedom = max(_FREEDOM, target.ndim)
        for _ in range(_ROUNDS):
            points, coords, log_weights = self._propose([(around(scaled, 1.1, freedom), own), *wide], _DRAWS, random)
            scaled = self._moments(scaled, points, coords, log_weights, 1.5)
            if effective_sample_size(log_weights) > RELIABLE_SHARE * _DRAWS:
                break
        parts = [(around(scaled, 1.1, freedom), own), *wide]
        points, self._pool, log_weights = self._propose(parts, size, random)
        effective = effective_sample_size(log_weights)
        for _ in range(3):
            if effective >= _CURVED * size:
                break
            rows = np.argsort(-log_weights)[:_FITTED]
            weights = tempered(log_weights[rows], 1.5 * POINTS_PER_DIMENSION * target.ndim)
            fitted = fit_mixture(points[rows], normalised_weights(weights))
            both = [(fitted, 0.7), *((each, 0.3 * share) for each, share in parts)]
            proposed = self._propose(both, size, random)
            if effective_sample_size(proposed[2]) <= effective:
                break
            points, self._pool, log_weights = proposed
            effective = effective_sample_size(log_weights)
        if not np.any(log_weights > -np.inf):
            raise np.linalg.LinAlgError("the emulated posterior has no density")
        self._pool[log_weights == -np.inf] = 0.0  # outside the support of the prior, coordinates are infinite
        self.regions = self._moments(self.regions, self._pool, self._pool, log_weights, 0.0)
        self._weights = normalised_weights(log_weights)
        self.log_evidence, self.effective_share = log_mean_weight(log_weights), effective / size
        error = float(np.sqrt(max(1.0 / effective - 1.0 / size, 0.0)))
        density = partial(target.density_of_parameters, self.normalised)
        self.known_density = KnownDensity(density, target.parameters(self._pool), self._weights, error)

    def log_density(self, coords: np.ndarray) -> np.ndarray:
        """Logarithm of prior times emulated likelihood (n,) at coordinates (n, ndim); not normalised."""
        nearest, result = self._nearest(coords), np.full(len(coords), -np.inf)
        for k, region in enumerate(self.regions):
            rows = np.flatnonzero(nearest == k)
            if len(rows):
                result[rows] = region.emulator.log_likelihood(coords[rows])
        return np.where(np.isnan(result), -np.inf, result) + self._target.log_prior(coords)

    def normalised(self, coords: np.ndarray) -> np.ndarray:
        """Normalised log-density (n,) of coordinates (n, ndim)."""
        return self.log_density(coords) - self.log_evidence

    def _nearest(self, coords: np.ndarray) -> np.ndarray:
        """Region (n,) that coordinates belong to."""
        return np.argmin([region.emulator.squared_distance(coords) for region in self.regions], axis=0)

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim) of the emulated posterior that are practically independent."""
        return self._pool[random.choice(len(self._pool), n, p=self._weights)]

    def _moments(
        self, regions: Sequence[Region], points: np.ndarray, coords: np.ndarray, log_weights: np.ndarray, least: float
    ) -> list[Region]:
        """Regions with the moments of weighted points (n, ndim), at coordinates, where these suffice."""
        enough, nearest, updated = POINTS_PER_DIMENSION * self._target.ndim, self._nearest(coords), []
        for k, region in enumerate(regions):
            rows = (nearest == k) & (log_weights > -np.inf)
            if rows.any():
                evidence = np.logaddexp.reduce(log_weights[rows]) - np.log(len(points))
                region = region._replace(log_evidence=float(evidence))
            own = tempered(log_weights[rows], least * enough)
            if effective_sample_size(own) >= enough:
                weights = normalised_weights(own)
                centre = weights @ points[rows]
                apart = points[rows] - centre
                region = region._replace(centre=centre, covariance=(apart * weights[:, None]).T @ apart)
            updated.append(region)
        return updated

    def _propose(
        self, parts: Sequence[tuple[Mixture, float]], n: int, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws (n, ndim) of mixtures with shares, in scaled parameters, their coordinates and log-weights (n,)."""
        counts = random.multinomial(n, [share for _, share in parts])
        points = np.concatenate([draw(each, k, random) for (each, _), k in zip(parts, counts, strict=True)])
        coords, volume = self._target.unscaled(points, self._scales)
        inside = np.flatnonzero(volume > -np.inf)
        for some in np.array_split(inside, 1 + len(inside) // 2000):
            volume[some] += self.log_density(coords[some])
            drawn = [np.log(share) + log_density(each, points[some]) for each, share in parts]
            volume[some] -= np.logaddexp.reduce(drawn)
        return points, coords, volume

    def _around_runs(self) -> list[tuple[Mixture, float]]:
        """A wide component around the probable simulations, which are all along a curved posterior."""
        structural, ndim = self._target.archive.coords, self._target.ndim
        centres = np.array([region.centre for region in self.regions])[:, structural.shape[1] :]
        coords = np.column_stack([structural, centres[self._nearest(structural)]])
        simulated = self._target.log_likelihood(self._target.archive.statistics, coords[:, structural.shape[1] :])
        emulated, log_prior = self.log_density(coords), self._target.log_prior(structural)
        self.of_runs = simulated + log_prior, emulated - self._target.log_prior(coords) + log_prior
        probable = coords[emulated > emulated.max() - _PLAUSIBLE - ndim]
        if len(probable) < 2 * ndim or not np.all(np.ptp(probable, axis=0) > 0.0):
            return []
        probable = self._target.scaled(probable, self._scales)
        covariance = np.cov(probable, rowvar=False).reshape(ndim, ndim)
        return [(student_mixture(np.ones(1), [probable.mean(axis=0)], [covariance], _FREEDOM), 0.1)]
