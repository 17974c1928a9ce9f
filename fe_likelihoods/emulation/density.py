"""The emulated posterior: its density, its evidence and independent draws, without simulations.

Each mode has a region with an emulator of its own. A point belongs to the region whose centre is nearest, in the
whitened coordinates of the region; the density there is the prior times the likelihood of the emulated statistics, also
far from all simulations: a density that ends near them would grow along a ridge by a part in each round. A t
distribution per region is fitted to this density by adaptive importance sampling in memory (Cornuet, Marin, Mira &
Robert, 2012, Scand. J. Stat. 39(4), doi:10.1111/j.1467-9469.2011.00756.x), and a mixture by expectation-maximisation
where these do not cover it; a large sample of weighted points (the pool) gives the evidence of the emulated posterior,
and draws after a few independence Metropolis steps.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from samplers.estimates.importance import KnownDensity
from samplers.estimates.weights import effective_sample_size, log_mean_weight, normalised_weights
from samplers.proposals.mixture import Mixture, draw, fit_mixture, invert_roots, log_density

from .emulator import ResponseEmulator
from .target import ResponseTarget

__all__ = ["EmulatedPosterior", "Region", "factor_of", "student_mixture", "tempered"]

_FREEDOM = 6.0  # at least, else as many as parameters: 50 keep 86 % of draws of a normal density in 50, 6 keep 44 %
_BLOCK = 2000  # points for which densities are computed together
_ROUNDS = 6
_DRAWS = 3000  # per round of the adaptation
_SETTLED = 0.3  # share of effective draws in a round after which none follows
_POOL, _NUMBERS = 20_000, 300_000  # points of the pool, and numbers that they have at most, whatever the dimension
_ENOUGH_PER_DIMENSION = 6.0  # effective points per dimension for a covariance
_WIDENED = 1.1  # variances of a fitted component, as multiples of its points' variances
_CURVED = 0.15  # share of effective points in the pool below which several components per region are fitted
_COMPONENTS, _FITTED = 12, 4000  # of them, and points of the pool that they are fitted to
_MOST_BENT = 10  # parameters; in more, the points are too few for several components
_FITTED_SHARE = 0.7  # of these components; the rest are the regions
_REFITS = 3  # of them
_PLAUSIBLE = 8.0  # log-density below the best, besides 1 per dimension, of runs that the pool must reach
_RUNS_SHARE = 0.1  # of a component around them
_STEPS = 6  # independence Metropolis steps of a draw
_RIDGE = 1e-9


class Region(NamedTuple):
    """A part of the posterior around one mode."""

    centre: np.ndarray  # (ndim,) mean, or the mode while the mean is not known
    covariance: np.ndarray  # (ndim, ndim) of the part
    emulator: ResponseEmulator | None  # None before there are enough runs
    log_evidence: float  # from the Laplace approximation before there is an emulator


def _moments(coords: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (d,) and covariance (d, d) of points (n, d) with normalised weights."""
    mean = weights @ coords
    apart = coords - mean
    return mean, (apart * weights[:, None]).T @ apart


def tempered(log_weights: np.ndarray, least: float) -> np.ndarray:
    """Log-weights (n,), with a smaller power where they have fewer effective points than `least`."""
    power = 1.0
    while power > 1e-4 and effective_sample_size(power * log_weights) < least:
        power *= 0.7
    return power * log_weights


def student_mixture(weights: np.ndarray, means: Any, roots: Any, dof: float) -> Mixture:
    """Mixture of t distributions with weights (k,), means (k, d) and lower Cholesky factors (k, d, d)."""
    return Mixture(weights, np.array(means), np.array(roots), invert_roots(np.array(roots)), dof)


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor (d, d) of a covariance; variances that rounding made negative become small ones."""
    sd = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    lower = np.linalg.qr(root.T, mode="r").T
    return sd[:, None] * lower * np.sign(np.diag(lower))


class EmulatedPosterior:
    """Density of the emulated posterior, from regions with emulators, and a weighted sample of it, the pool.

    `log_evidence` is the log of the integral over the emulated density, with an error from the importance sampling in
    memory; `effective_share` is the effective sample size of the pool divided by its size, and `largest_weight` the
    largest normalised weight in it; `of_runs` are log-densities (n,) of the simulations by their responses, and by the
    emulators; `regions` are those given, with their moments.
    """

    def __init__(self, target: ResponseTarget, regions: Sequence[Region], random: np.random.RandomState) -> None:
        self._target, self._regions = target, tuple(regions)
        self._adapt(random)
        self.regions = self._moments()
        del self._scaled  # each round of draws keeps its density

    def log_density(self, coords: np.ndarray) -> np.ndarray:
        """Logarithm of prior times emulated likelihood (n,) at coordinates (n, ndim); not normalised."""
        return self._log_likelihood(self._target.scaled(coords)) + self._target.log_prior(coords)

    def _log_likelihood(self, scaled: np.ndarray) -> np.ndarray:
        nearest, result = self._nearest(scaled), np.full(len(scaled), -np.inf)
        for k, region in enumerate(self._regions):
            rows = np.flatnonzero(nearest == k)
            if len(rows):
                result[rows] = region.emulator.log_likelihood(scaled[rows])
        return np.where(np.isnan(result), -np.inf, result)

    @cached_property
    def known_density(self) -> KnownDensity:
        """This density of the parameters, with the pool."""
        parameters = self._target.parameters(self._pool)
        used = self._weights > 0.0  # points far away, whose numbers may be infinite, have none
        return KnownDensity(self._log_density_of, parameters[used], self._weights[used], self.log_evidence_error)

    def _log_density_of(self, parameters: np.ndarray) -> np.ndarray:
        """Normalised log-density (n,) of parameters (n, ndim)."""
        return self._target.density_of_parameters(self.log_density, parameters) - self.log_evidence

    def _nearest(self, scaled: np.ndarray) -> np.ndarray:
        """Region (n,) that scaled parameters belong to."""
        return np.argmin([region.emulator.squared_distance(scaled) for region in self._regions], axis=0)

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim) of the emulated posterior that are practically independent."""
        rows = random.choice(len(self._pool), n, p=self._weights)
        coords, ratio = self._pool[rows], self._log_weights[rows]
        for _ in range(_STEPS):
            _, proposed, other = self._propose(self._parts, n, random)
            accepted = np.log(random.random_sample(n)) < other - ratio
            coords[accepted], ratio[accepted] = proposed[accepted], other[accepted]
        return coords

    def _propose(
        self, parts: Sequence[tuple[Mixture, float]], n: int, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws (n, ndim) of mixtures with shares, in scaled parameters, their coordinates and log-weights (n,)."""
        counts = random.multinomial(n, [share for _, share in parts])
        scaled = np.concatenate([draw(each, k, random) for (each, _), k in zip(parts, counts, strict=True)])
        scaled = scaled if len(parts) == 1 else random.permutation(scaled)
        coords, log_weights = np.empty_like(scaled), np.full(n, -np.inf)
        for begin in range(0, n, _BLOCK):
            some = scaled[begin : begin + _BLOCK]
            coords[begin : begin + _BLOCK], log_volume = self._target.unscaled(some)
            inside = np.flatnonzero(log_volume > -np.inf)
            density = self._log_likelihood(some[inside]) + log_volume[inside]
            density += self._target.log_prior(coords[begin + inside])
            drawn = [np.log(share) + log_density(each, some[inside]) for each, share in parts]
            log_weights[begin + inside] = density - np.logaddexp.reduce(drawn)
        return scaled, coords, log_weights

    def _moments(self) -> list[Region]:
        """The regions with the mean, covariance and evidence that the pool gives them, where it suffices."""
        nearest, updated = self._nearest(self._scaled), []
        for k, region in enumerate(self._regions):
            rows = nearest == k
            share = self._weights[rows].sum()
            if share > 0.0:
                region = region._replace(log_evidence=self.log_evidence + float(np.log(share)))
            fitted = self._fit(self._pool[rows], np.log(self._weights[rows] + 1e-300))
            if fitted is not None:
                region = region._replace(centre=fitted[0], covariance=fitted[1])
            updated.append(region)
        return updated

    def _fit(self, coords: np.ndarray, log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Weighted mean and covariance, or None with too few effective points."""
        if effective_sample_size(log_weights) < _ENOUGH_PER_DIMENSION * coords.shape[1]:
            return None
        mean, covariance = _moments(coords, normalised_weights(log_weights))
        return mean, covariance + _RIDGE * np.diag(np.diag(covariance))

    def _mixture_of(self, regions: Sequence[Region], log_shares: np.ndarray) -> Mixture:
        weights = 0.9 * normalised_weights(log_shares) + 0.1 / len(regions)
        factors = [factor_of(_WIDENED * region.covariance) for region in regions]
        freedom = max(_FREEDOM, self._target.ndim)
        return student_mixture(weights, [region.centre for region in regions], factors, freedom)

    def _adapt(self, random: np.random.RandomState) -> None:
        scaled = [self._target.region_in_scaled(region.centre, region.covariance) for region in self._regions]
        regions = [r._replace(centre=c, covariance=v) for r, (c, v) in zip(self._regions, scaled, strict=True)]
        shares = np.array([region.log_evidence for region in regions])
        mixture = self._mixture_of(regions, shares)
        enough = _ENOUGH_PER_DIMENSION * self._target.ndim
        for _ in range(_ROUNDS):
            scaled, _, log_weights = self._propose([(mixture, 1.0)], _DRAWS, random)
            nearest = self._nearest(scaled)
            for k, region in enumerate(regions):
                rows = np.flatnonzero((nearest == k) & (log_weights > -np.inf))
                if len(rows) <= enough:
                    continue
                own = log_weights[rows]
                shares[k] = np.logaddexp.reduce(own)
                fitted = self._fit(scaled[rows], tempered(own, 1.5 * enough))
                if fitted is not None:
                    regions[k] = region._replace(centre=fitted[0], covariance=fitted[1])
            mixture = self._mixture_of(regions, shares)
            if effective_sample_size(log_weights) > _SETTLED * _DRAWS:
                break
        base = self._with_runs(mixture)
        self._fill(base, random)
        for _ in range(_REFITS):
            if self.effective_share >= _CURVED or self._target.ndim > _MOST_BENT:
                break
            rows = np.argsort(-self._log_weights)[:_FITTED]
            weights = normalised_weights(tempered(self._log_weights[rows], 1.5 * enough))
            fitted = fit_mixture(self._scaled[rows], weights, _COMPONENTS)
            rest = [(each, (1.0 - _FITTED_SHARE) * part) for each, part in base]
            self._fill([(fitted, _FITTED_SHARE), *rest], random)

    def _with_runs(self, mixture: Mixture) -> list[tuple[Mixture, float]]:
        """A mixture, and a wide component around the probable simulations, which are all along a curved posterior."""
        structural, ndim = self._target.archive.coords, self._target.ndim
        noise = np.array([region.centre[structural.shape[1] :] for region in self._regions])
        scaled = self._target.scaled(np.column_stack([structural, np.zeros((len(structural), noise.shape[1]))]))
        scaled[:, structural.shape[1] :] = noise[self._nearest(scaled)]
        density = self._log_likelihood(scaled) + self._target.log_prior(structural)
        simulated = self._target.log_likelihood(self._target.archive.statistics, scaled[:, structural.shape[1] :])
        self.of_runs = simulated + self._target.log_prior(structural), density
        probable = scaled[density > density.max() - _PLAUSIBLE - ndim]
        if len(probable) < 2 * ndim or not np.all(np.ptp(probable, axis=0) > 0.0):
            return [(mixture, 1.0)]
        factor = factor_of(np.cov(probable, rowvar=False).reshape(ndim, ndim))
        wide = student_mixture(np.ones(1), [probable.mean(axis=0)], [factor], _FREEDOM)
        return [(mixture, 1.0 - _RUNS_SHARE), (wide, _RUNS_SHARE)]

    def _fill(self, parts: Sequence[tuple[Mixture, float]], random: np.random.RandomState) -> None:
        """Draw the pool from mixtures with shares."""
        self._parts = parts
        size = min(_POOL, _NUMBERS // self._target.ndim)
        self._scaled, self._pool, self._log_weights = self._propose(parts, size, random)
        if not np.any(self._log_weights > -np.inf):
            raise np.linalg.LinAlgError("none is inside the support of the prior")
        # outside the support of the prior, coordinates are infinite
        self._pool[self._log_weights == -np.inf] = 0.0
        self._weights = normalised_weights(self._log_weights)
        self.log_evidence = log_mean_weight(self._log_weights)
        effective = effective_sample_size(self._log_weights)
        self.log_evidence_error = float(np.sqrt(max(1.0 / effective - 1.0 / size, 0.0)))
        self.effective_share = effective / size
        self.largest_weight = float(self._weights.max())
