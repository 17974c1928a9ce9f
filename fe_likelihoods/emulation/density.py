"""The emulated posterior: its density, its evidence and independent draws, without simulations.

Each mode has a region with an emulator of its own. A point belongs to the region whose centre is nearest, in the
whitened coordinates of the region; the density there is the prior times the likelihood of the emulated statistics, and
zero beyond the reach of the emulator. A mixture of t distributions is fitted to this density by adaptive importance
sampling in memory (Cornuet, Marin, Mira & Robert, 2012, Scand. J. Stat. 39(4), doi:10.1111/j.1467-9469.2011.00756.x); a
large sample of weighted points (the pool) from it gives the evidence of the emulated posterior, and draws after a few
independence Metropolis steps.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from samplers.estimates.importance import KnownDensity
from samplers.estimates.weights import effective_sample_size, log_mean_weight, normalised_weights
from samplers.proposals.mixture import Mixture, draw, invert_roots, log_density

from .emulator import ResponseEmulator
from .target import ResponseTarget

__all__ = ["EmulatedPosterior", "Region", "factor_of", "student_mixture"]

_FREEDOM = 6.0
_LARGEST_BLOCK = 100_000  # points times components for which densities are computed together
_ROUNDS = 6
_DRAWS = 3000  # per round of the adaptation
_POOL = 20_000
_ENOUGH_PER_DIMENSION = 6.0  # effective points per dimension for a covariance
_WIDENED = 1.1  # variances of a fitted component, as multiples of its points' variances
_CURVED = 0.15  # share of effective points in the pool below which kernels are used
_KERNELS = 300
_KERNEL_SHARE = 0.7
_NEIGHBOURS = 20  # points from which the covariance of a kernel comes
_THINNEST = 1e-5  # standard deviation of a kernel, as a share of the pool's
_THIN = 0.3  # of the ratio that the local variances of a Gaussian have at least, smallest over largest
_REFITS, _GAIN = 6, 1.2  # of the kernels, while the effective share grows by this factor
_PLAUSIBLE = 8.0  # log-density below the top, besides 1 per dimension, of runs that the pool must reach
_UNREACHED = 2.0  # log-weight of such a run above the largest in the pool
_STEPS = 6  # independence Metropolis steps of a draw
_RIDGE = 1e-9
_SMALLEST_SLOPE = 1e-9
_COMPARED = 1000  # points of the pool among which ends are found
_ONE_SIDED = 0.4  # distance to the mean of the nearest points, as a share of theirs, from which a point is an end
_STRIDE, _APART = 0.5, 0.5  # prior standard deviations beyond an end; as a share, away from all runs


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
    memory; `top` is the largest log-density in the pool, `effective_share` its effective sample size divided by its
    size, and `largest_weight` the largest normalised weight in it.
    """

    def __init__(self, target: ResponseTarget, regions: Sequence[Region], random: np.random.RandomState) -> None:
        self._target, self._regions = target, tuple(regions)
        self._adapt(random)

    def log_density(self, coords: np.ndarray) -> np.ndarray:
        """Logarithm of prior times emulated likelihood (n,) at coordinates (n, ndim); not normalised."""
        nearest, squared = self._nearest(coords)
        result = np.full(len(coords), -np.inf)
        for k, region in enumerate(self._regions):
            rows = np.flatnonzero((nearest == k) & (squared[k] <= region.emulator.reach))
            if len(rows):
                result[rows] = region.emulator.log_likelihood(coords[rows])
        return np.where(np.isnan(result), -np.inf, result) + self._target.log_prior(coords)

    @cached_property
    def known_density(self) -> KnownDensity:
        """This density of the parameters, with the pool."""
        parameters = self._target.parameters(self._pool)
        return KnownDensity(self._log_density_of, parameters, self._weights, self.log_evidence_error)

    def _log_density_of(self, parameters: np.ndarray) -> np.ndarray:
        """Normalised log-density (n,) of parameters (n, ndim)."""
        return self._target.density_of_parameters(self.log_density, parameters) - self.log_evidence

    def _nearest(self, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Region (n,) that coordinates (n, ndim) belong to, and squared distances (n_regions, n) from all of them."""
        structural = coords[:, : self._target.n_structural]
        squared = np.stack([region.emulator.squared_distance(structural) for region in self._regions])
        return np.argmin(squared, axis=0), squared

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim) of the emulated posterior that are practically independent."""
        rows = random.choice(len(self._pool), n, p=self._weights)
        coords, ratio = self._pool[rows], self._log_weights[rows]
        for _ in range(_STEPS):
            _, proposed, other = self._propose(self._mixture, n, random)
            accepted = np.log(random.random_sample(n)) < other - ratio
            coords[accepted], ratio[accepted] = proposed[accepted], other[accepted]
        return coords

    def _propose(
        self, mixture: Mixture, n: int, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws (n, ndim) of a mixture in scaled parameters, their coordinates and their log-weights (n,)."""
        scaled = draw(mixture, n, random)
        return scaled, *self._log_weights_of(mixture, scaled)

    def _log_weights_of(self, mixture: Mixture, scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (n, ndim) of scaled parameters, and log-weights (n,) over the density of a mixture."""
        coords, log_volume = self._target.unscaled(scaled)
        log_weights = np.full(len(scaled), -np.inf)
        inside = np.flatnonzero(log_volume > -np.inf)
        log_weights[inside] = self.log_density(coords[inside]) + log_volume[inside]
        for rows in np.array_split(inside, len(scaled) * len(mixture.weights) // _LARGEST_BLOCK + 1):
            log_weights[rows] -= log_density(mixture, scaled[rows])
        return coords, log_weights

    def _in_scaled(self, region: Region) -> Region:
        """A region with its centre and covariance in scaled parameters."""
        sd = np.sqrt(np.diag(region.covariance))
        low, at, high = self._target.scaled(np.stack([region.centre - sd, region.centre, region.centre + sd]))
        slopes = np.maximum((high - low) / (2.0 * sd), _SMALLEST_SLOPE)
        return region._replace(centre=at, covariance=region.covariance * np.outer(slopes, slopes))

    @property
    def curved(self) -> bool:
        """Whether no ellipsoids cover the posterior, since it is thin in directions that change along it."""
        return self._mixture is not self._ellipsoids and self._thinness < _THIN

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (ndim, ndim) of the coordinates."""
        return _moments(self._pool, self._weights)[1]

    def extremes(self, directions: np.ndarray) -> np.ndarray:
        """Points (2 n, ndim) of the pool at the 1 and 99 % quantiles along directions (n, ndim)."""
        rows = []
        for along in (self._pool @ directions.T).T:
            order = np.argsort(along)
            rows += list(order[np.searchsorted(np.cumsum(self._weights[order]), [0.01, 0.99])])
        return self._pool[rows]

    def beyond(self, n: int, runs: np.ndarray) -> np.ndarray:
        """At most n points (k, d) beyond the ends of a curved posterior, away from runs (m, d)."""
        d = runs.shape[1]
        levels = (np.arange(_COMPARED) + 0.5) / _COMPARED
        points = np.unique(self._pool[np.searchsorted(np.cumsum(self._weights), levels)][:, :d], axis=0)
        if len(points) < 2:
            return points[:0]
        distances, near = cKDTree(points).query(points, min(len(points), 2 * _NEIGHBOURS))
        inwards = points[near].mean(axis=1) - points  # at an end, all near points are on one side
        length = np.maximum(np.linalg.norm(inwards, axis=1), 1e-300)
        onesided = length / np.maximum(np.sqrt(np.square(distances).mean(axis=1)), 1e-300)
        outside = points - inwards * (_STRIDE / length)[:, None]
        open_ = (onesided > _ONE_SIDED) & (cdist(outside, runs).min(axis=1) > _APART * _STRIDE)
        found: list[int] = []
        for row in np.flatnonzero(open_)[np.argsort(-onesided[open_])]:
            if len(found) < n and all(np.linalg.norm(outside[row] - outside[k]) > _STRIDE for k in found):
                found.append(int(row))
        return outside[found]

    def moments(self) -> list[Region]:
        """The regions with the mean, covariance and evidence that the pool gives them, where it suffices."""
        (nearest, _), updated = self._nearest(self._pool), []
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
        return student_mixture(weights, [region.centre for region in regions], factors, _FREEDOM)

    def _adapt(self, random: np.random.RandomState) -> None:
        regions = [self._in_scaled(region) for region in self._regions]
        shares = np.array([region.log_evidence for region in regions])
        mixture = self._mixture_of(regions, shares)
        enough = _ENOUGH_PER_DIMENSION * self._target.ndim
        for _ in range(_ROUNDS):
            scaled, coords, log_weights = self._propose(mixture, _DRAWS, random)
            nearest, _ = self._nearest(coords)
            for k, region in enumerate(regions):
                rows = np.flatnonzero((nearest == k) & (log_weights > -np.inf))
                if len(rows) <= enough:
                    continue
                own = log_weights[rows]
                shares[k] = np.logaddexp.reduce(own)
                power = 1.0
                while power > 1e-4 and effective_sample_size(power * own) < 1.5 * enough:
                    power *= 0.7  # too few effective points: a smaller step towards the target
                fitted = self._fit(scaled[rows], power * own)
                if fitted is not None:
                    regions[k] = region._replace(centre=fitted[0], covariance=fitted[1])
            mixture = self._mixture_of(regions, shares)
        self._ellipsoids = mixture
        self._fill(mixture, random)
        runs = self._runs()
        for _ in range(_REFITS):
            missed, share = self._missed(runs), self.effective_share
            if not len(missed) and share >= _CURVED:
                break
            self._fill(self._kernels(missed, random), random)
            if not len(missed) and self.effective_share < _GAIN * share:
                if self.effective_share < share:  # as with many parameters
                    self._fill(mixture, random)
                break

    def _runs(self) -> np.ndarray:
        """Coordinates (m, ndim) of the simulations, with the noise of the nearest region."""
        structural = self._target.archive.coords
        nearest, _ = self._nearest(structural)
        noise = np.array([region.centre[structural.shape[1] :] for region in self._regions])
        return np.column_stack([structural, noise[nearest]])

    def _missed(self, runs: np.ndarray) -> np.ndarray:
        """Scaled parameters (n, ndim) of the most probable simulations that the pool does not reach."""
        density = self.log_density(runs)
        runs = runs[np.argsort(-density)[: np.sum(density > self.top - _PLAUSIBLE - self._target.ndim)]]
        scaled = self._target.scaled(runs)
        apart = self._log_weights_of(self._mixture, scaled)[1] - self._log_weights.max()
        return scaled[apart > _UNREACHED][:_KERNELS]

    def _kernels(self, missed: np.ndarray, random: np.random.RandomState) -> Mixture:
        """The mixture with narrow components around weighted points and missed runs (n, ndim), in scaled parameters.

        It covers a posterior that no ellipsoid covers. The covariance of a component comes from its nearest points.
        """
        ndim = self._target.ndim
        rows = random.choice(len(self._pool), _KERNELS, p=self._weights)
        centres = np.concatenate([self._target.scaled(self._pool[np.unique(rows)]), missed])
        count = np.concatenate(
            [np.unique(rows, return_counts=True)[1], np.full(len(missed), _KERNELS / max(len(missed), 1))]
        )
        if len(centres) < ndim + 2 or not np.all(np.ptp(centres, axis=0) > 0.0):  # they span no volume
            return self._ellipsoids
        # in whitened coordinates
        factor = factor_of(np.cov(centres, rowvar=False).reshape(ndim, ndim))
        white = np.linalg.solve(factor, (centres - centres.mean(axis=0)).T).T
        near = cKDTree(white).query(white, min(len(white), max(_NEIGHBOURS, 3 * ndim)))[1]
        apart = white[near] - white[:, None]
        local = np.einsum("nki,nkj->nij", apart, apart) / near.shape[1] + _THINNEST**2 * np.eye(ndim)
        values, noise = np.linalg.eigvalsh(local), np.sqrt(ndim / near.shape[1])
        self._thinness = float(np.median(values[:, 0] / values[:, -1])) / ((1.0 - noise) / (1.0 + noise)) ** 2
        factors = factor @ np.linalg.cholesky(local)
        base = self._ellipsoids
        weights = np.concatenate([(1.0 - _KERNEL_SHARE) * base.weights, _KERNEL_SHARE * count / count.sum()])
        means, roots = np.concatenate([base.means, centres]), np.concatenate([base.roots, factors])
        return student_mixture(weights, means, roots, _FREEDOM)

    def _fill(self, mixture: Mixture, random: np.random.RandomState) -> None:
        """Draw the pool."""
        self._mixture = mixture
        _, self._pool, self._log_weights = self._propose(mixture, _POOL, random)
        # outside the support of the prior, coordinates are infinite
        self._pool[self._log_weights == -np.inf] = 0.0
        self.top = float(self.log_density(self._pool[np.argsort(-self._log_weights)[:1000]]).max())
        self._weights = normalised_weights(self._log_weights)
        self.log_evidence = log_mean_weight(self._log_weights)
        effective = effective_sample_size(self._log_weights)
        self.log_evidence_error = float(np.sqrt(max(1.0 / effective - 1.0 / _POOL, 0.0)))
        self.effective_share = effective / _POOL
        self.largest_weight = float(self._weights.max())
