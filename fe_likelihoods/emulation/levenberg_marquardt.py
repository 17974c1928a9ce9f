"""Levenberg-Marquardt on the responses: ascents to modes, run side by side.

The log-density in the coordinates of `fe_likelihoods.emulation.target` is log L(S(r)) - z.z / 2 with residuals r that
enter the log-likelihood through quadratic statistics S. With J = dr/dz by finite differences and
f = d log L / dS at the noise parameters that fit best, its gradient and its Gauss-Newton Hessian are::

    g = 2 sum_a f_a B_a(J, r) - z,        H = -2 sum_a f_a B_a(J, J) + 1,

where B_a is the bilinear form of S_a. A step solves (H + lambda diag H) dz = g. Several lambda are simulated at once:
they cost one parallel batch, and the largest improvement is taken. That reaches modes at the end of narrow curved
valleys, where one lambda at a time does not. Steps of the differences are a small part of a posterior standard
deviation: larger ones average over the valley, much smaller ones follow the roughness of the likelihood.

References
----------
K. Levenberg (1944), Quarterly of Applied Mathematics 2, 164-168; D. W. Marquardt (1963), Journal of the Society for
Industrial and Applied Mathematics 11, 431-441.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .quadratic import bilinear_form
from .target import NoiseFit, Remember, ResponseTarget, Runs

__all__ = ["POINTS_PER_STEP", "TOLERANCE", "Ascent", "Batches", "ascend", "distinct_ends"]

_DAMPINGS = 10.0 ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
POINTS_PER_STEP = len(_DAMPINGS)
_FIRST_DAMPING = 1e-2
_LARGEST_DAMPING = 1e8
_LARGEST_STEP = 2.0  # prior standard deviations
_FIRST_DIFFERENCE = 3e-3  # prior standard deviations
_DIFFERENCE_SHARE = 0.1  # of a posterior standard deviation
_DIFFERENCE_LIMITS = 3e-4, 2e-2
_RETRIES = -1.0, 0.3, -0.3, 0.05  # steps tried where the simulation of a difference fails, as multiples
TOLERANCE = 0.5  # log-density still to gain, according to the quadratic approximation
_MAX_ITERATIONS = 40
_PATIENCE = 3  # iterations after which an ascent that is far below a known end and slow is given up
_LEFT = 6.0  # iterations like the last one that would be needed to reach the known end
_ROUGH = 5.0  # gain that the quadratic approximation may promise where no step gains anything
_STALLED = 0.1  # gain in log-density below which a step counts as failed
_HOPELESS = 200.0  # log-density below the best end at which another one is given up
_SAME_MODE = 4.0  # squared distance per dimension, in units of the Laplace approximation
_NEAR = 20.0  # largest log-density below a known end at which the straight line to it is examined
_ALONG = np.array([0.25, 0.5, 0.75])  # points of this line
_PRIOR_ALONE = 2.0  # curvatures of the Hessian below this are the prior's, which is 1, with little of the data's
_DIP = 3.0  # depth of a valley in log-density that separates modes


class Ascent(NamedTuple):
    """Where an ascent from one start ended.

    Attributes
    ----------
    coords : (n_structural,) float
        Structural coordinates.
    log_density : float
        Log-density there, in standard normal coordinates, at the best noise parameters.
    hessian : (n_structural, n_structural) float
        Gauss-Newton Hessian of minus the log-density.
    noise : NoiseFit
        The best noise parameters.
    residuals : (n_channels, n_steps) float
        Residuals.
    slopes : (n_structural, n_channels, n_steps) float
        Their derivatives by the coordinates.
    gain_left : float
        Log-density still to gain according to the quadratic approximation.
    iterations : int
        Number of steps.
    merged : int
        Index of the ascent in whose mode this ascent would have ended, -1 if it ran to the end.
    starts : tuple of int
        Starts that ended here.
    """

    coords: np.ndarray
    log_density: float
    hessian: np.ndarray
    noise: NoiseFit
    residuals: np.ndarray
    slopes: np.ndarray
    gain_left: float
    iterations: int
    merged: int = -1
    starts: tuple[int, ...] = ()

    @property
    def converged(self) -> bool:
        """Whether little is left to gain; differences of a rough likelihood promise a few units at its top as well."""
        return self.gain_left < _ROUGH or self.merged >= 0


def ascend(
    target: ResponseTarget,
    start: np.ndarray,
    centre: np.ndarray,
    known: Sequence[Ascent] = (),
    tolerance: float = TOLERANCE,
    apart: float = np.inf,
) -> Generator[np.ndarray, Runs, Ascent | None]:
    """Levenberg-Marquardt from one start.

    Parameters
    ----------
    target : ResponseTarget
        The posterior.
    start : (n_structural,) float
        Start.
    centre : (n_structural,) float
        Where the prior is centred.
    known : sequence of Ascent
        Ends of other ascents so far (the sequence grows): an ascent that would end in one of them stops.
    tolerance : float
        Log-density still to gain at which to stop.
    apart : float
        Distance of one coordinate, in prior standard deviations, from which ends are different (`_is_same_mode`).

    Yields
    ------
    (n, n_structural) float
        Points to simulate; the generator is sent their `Runs`.

    Returns
    -------
    Ascent or None
        None if the simulation of the start fails, or if the ascent is slow and far below a known end.
    """
    d = target.n_structural
    runs = yield start[None]
    if runs.failed[0]:
        return None
    coords, residuals, statistics = start, runs.residuals[0], runs.statistics[0]
    noise = target.fit_noise(statistics)
    value = noise.log_density + target.log_prior(coords - centre)
    differences, damping, failures, slopes = np.full(d, _FIRST_DIFFERENCE), _FIRST_DAMPING, 0, None
    gain_left, merged, iteration, earlier = np.inf, -1, 0, -np.inf
    for iteration in range(_MAX_ITERATIONS):  # noqa: B007  the number of iterations is part of the result
        if slopes is None:
            merged = yield from _connected(target, coords, value, noise, centre, known, apart)
            if merged >= 0:
                unknown = np.zeros((d, *residuals.shape))
                return Ascent(coords, float(value), np.eye(d), noise, residuals, unknown, 0.0, iteration, merged)
            slopes = yield from _difference(target, coords, residuals, differences)
            weights = target.slopes(statistics, noise.coords)
            gradient = 2.0 * bilinear_form(target.statistic, slopes, residuals[None])[:, 0] @ weights - (
                coords - centre
            )
            hessian = -2.0 * bilinear_form(target.statistic, slopes) @ weights + np.eye(d)
            scale = np.diag(np.diag(hessian))
            whole = np.linalg.solve(hessian, gradient)
            gain_left = 0.5 * float(gradient @ whole)
            merged = next((k for k, end in enumerate(known) if _is_same_mode(coords + whole, end, apart)), -1)
            if merged >= 0:
                break
            if gain_left < tolerance:
                higher = yield from _leave_saddle(target, coords, value, hessian, noise, centre, tolerance)
                if higher is None:
                    break
                coords, residuals, statistics, noise, value = higher
                slopes, damping, earlier = None, _FIRST_DAMPING, -np.inf
                continue
            behind = max((end.log_density for end in known), default=-np.inf) - value
            if iteration >= _PATIENCE and behind > max(_HOPELESS, _LEFT * (value - earlier)):
                return None
            earlier = value
        dampings = damping * _DAMPINGS
        steps = np.array([np.linalg.solve(hessian + each * scale, gradient) for each in dampings])
        steps *= np.minimum(1.0, _LARGEST_STEP / np.abs(steps).max(axis=1, keepdims=True))
        runs = yield coords + steps
        best = _highest(target, coords + steps, runs, noise, centre, value)
        stalled = best is None or best[0] < value + _STALLED
        if best is not None:
            value, k, noise = best
            coords, residuals, statistics = coords + steps[k], runs.residuals[k], runs.statistics[k]
            damping = float(np.clip(dampings[k], 1e-8, _LARGEST_DAMPING))
            spread = np.sqrt(np.diag(np.linalg.inv(hessian)))
            differences, slopes = np.clip(_DIFFERENCE_SHARE * spread, *_DIFFERENCE_LIMITS), None
        if not stalled:
            failures = 0
        elif best is None and failures == 0:
            failures, damping = 1, min(damping * 1e5, _LARGEST_DAMPING)
        elif failures < 2:  # the differences may have met roughness: take larger ones
            failures, differences, slopes, damping = 2, 3.0 * differences, None, 0.1
        else:
            break
    if slopes is None:  # stopped after a step
        slopes = yield from _difference(target, coords, residuals, differences)
        weights = target.slopes(statistics, noise.coords)
        hessian = -2.0 * bilinear_form(target.statistic, slopes) @ weights + np.eye(d)
    return Ascent(coords, float(value), hessian, noise, residuals, slopes, gain_left, iteration, merged)


def _connected(
    target: ResponseTarget,
    coords: np.ndarray,
    value: float,
    noise: NoiseFit,
    centre: np.ndarray,
    known: Sequence[Ascent],
    apart: float,
) -> Generator[np.ndarray, Runs, int]:
    """Number of the known end that a straight line without a valley leads to from nearly the same height; -1 if none.

    On a rough or curved likelihood, the Laplace approximation of an end does not contain the other points of its mode.
    """
    for number, end in enumerate(known):
        difference = end.coords - coords
        level = end.log_density - _NEAR <= value <= end.log_density + _DIP
        if not level or np.abs(difference).max() >= apart:
            continue
        points = coords + _ALONG[:, None] * difference
        runs = yield points
        if runs.failed.any():
            continue
        fits = [target.fit_noise(statistics, noise.coords).log_density for statistics in runs.statistics]
        if not _has_valley(np.array([value, *(fits + target.log_prior(points - centre)), end.log_density])):
            return number
    return -1


def _leave_saddle(
    target: ResponseTarget,
    coords: np.ndarray,
    value: float,
    hessian: np.ndarray,
    noise: NoiseFit,
    centre: np.ndarray,
    tolerance: float,
) -> Generator[np.ndarray, Runs, tuple | None]:
    """A higher point near an end of zero gradient that is a saddle or a minimum; None at a top.

    Where a response is an even function of a parameter, its derivative is zero on the axis of symmetry and the
    Gauss-Newton Hessian has the curvature of the prior alone, also where the likelihood increases on both sides. One
    simulation in every direction of such a curvature, one standard deviation of the prior away, shows it.
    """
    values, vectors = np.linalg.eigh(hessian)
    flat = vectors[:, values < _PRIOR_ALONE].T
    if not len(flat):
        return None
    points = coords + flat
    runs = yield points
    best = _highest(target, points, runs, noise, centre, value + tolerance)
    if best is None:
        return None
    reached, k, fit = best
    return points[k], runs.residuals[k], runs.statistics[k], fit, reached


def _highest(
    target: ResponseTarget, points: np.ndarray, runs: Runs, noise: NoiseFit, centre: np.ndarray, least: float
) -> tuple[float, int, NoiseFit] | None:
    """Log-density, number and noise parameters of the highest simulated point; None if none is above `least`."""
    best = None
    for k in np.flatnonzero(~runs.failed):
        fit = target.fit_noise(runs.statistics[k], noise.coords)
        reached = fit.log_density + target.log_prior(points[k] - centre)
        if reached > (least if best is None else best[0]):
            best = reached, k, fit
    return best


def _has_valley(values: np.ndarray) -> bool:
    """Whether one of the values lies deeper than `_DIP` below values on both sides of it."""
    before = np.maximum.accumulate(values)[:-2]
    after = np.maximum.accumulate(values[::-1])[::-1][2:]
    return bool((np.minimum(before, after) - values[1:-1]).max() >= _DIP)


def _is_same_mode(coords: np.ndarray, end: Ascent, apart: float) -> bool:
    """Whether coordinates (n_structural,) belong to the mode at the end of an ascent.

    Their distance is measured in units of the Laplace approximation. A part of the record does not determine all
    coordinates: in undetermined coordinates this distance is small, although a longer part may lead to different modes.
    On a part of the record, no coordinate may therefore differ by `apart` or more.
    """
    difference = coords - end.coords
    near = float(difference @ end.hessian @ difference) < _SAME_MODE * len(coords)
    return near and float(np.abs(difference).max()) < apart


def _difference(
    target: ResponseTarget, coords: np.ndarray, residuals: np.ndarray, steps: np.ndarray
) -> Generator[np.ndarray, Runs, np.ndarray]:
    """Derivatives (d, n_channels, n_steps) of the residuals; zero for a parameter whose differences all fail."""
    runs = yield coords + np.diag(steps)
    slopes = (runs.residuals - residuals) / steps[:, None, None]
    for k in np.flatnonzero(runs.failed):
        slopes[k] = 0.0
        for factor in _RETRIES:
            point = coords.copy()
            point[k] += factor * steps[k]
            again = yield point[None]
            if not again.failed[0]:
                slopes[k] = (again.residuals[0] - residuals) / (factor * steps[k])
                break
    return slopes


class Batches:
    """Runs generators of points side by side.

    Parameters
    ----------
    target : ResponseTarget
        Simulates points.
    remember, fits : callable
        As for `fe_likelihoods.emulation.modes.search_modes`.
    overlap : bool
        Whether each generator goes on as soon as its own points have been simulated. By default all requests are
        simulated as one batch. The order in which requests end is stored with `remember`.
    """

    def __init__(
        self, target: ResponseTarget, remember: Remember, fits: Callable[[float], bool], overlap: bool = False
    ) -> None:
        self._target, self._remember, self._fits = target, remember, fits
        self._running = target.running_requests() if overlap else None

    def complete(
        self, ascents: Sequence[Generator[np.ndarray, Runs, Any]], finished: Callable[[int, Any], None]
    ) -> Iterator[int]:
        """Advance all generators to their ends; yields the number of points in each batch.

        Stops early, with `interrupted` set, when a batch does not fit in what remains of the budget; what runs by then
        is kept by the target.
        """
        self.interrupted = False
        waiting: dict[int, np.ndarray] = {}
        begun: set[int] = set()

        def advance(index: int, runs: Runs | None) -> None:
            try:
                waiting[index] = ascents[index].send(runs)
            except StopIteration as end:
                finished(index, end.value)

        for index in range(len(ascents)):
            advance(index, None)
        try:
            while waiting:
                if not self.interrupted and not self._fits(sum(len(points) for points in waiting.values())):
                    self.interrupted = True
                    for index in waiting.keys() - begun:
                        del waiting[index]
                    continue
                begun.update(waiting)
                ended = self._wait(waiting)
                runs = self._target.run(np.concatenate([waiting[index] for index in ended]), self._remember)
                yield len(runs.failed)
                place = 0
                for index in ended:
                    rows = slice(place, place + len(waiting.pop(index)))
                    place = rows.stop
                    begun.discard(index)
                    if not self.interrupted:
                        advance(index, Runs(*(column[rows] for column in runs)))
        finally:
            if self._running is not None:
                self._running.close()

    def _wait(self, waiting: dict[int, np.ndarray]) -> list[int]:
        """Numbers of the generators whose points are simulated: in lock-step all of them."""
        running = self._running
        if running is None:
            return list(waiting)

        def wait() -> list[np.ndarray]:
            for index, coords in waiting.items():
                if index not in running:
                    running.begin(index, self._target.structural_parameters(coords))
            return [np.array(running.wait())]

        return self._remember("ascents", wait)[0].tolist()


def distinct_ends(ends: Sequence[Ascent], apart: float = np.inf) -> list[Ascent]:
    """Ends that are different modes, the highest first; each carries the starts of all ends in its mode.

    `apart`: as in `_is_same_mode`.
    """
    kept: list[Ascent] = []
    for end in sorted(ends, key=lambda end: -end.log_density):
        same = next((k for k, other in enumerate(kept) if _is_same_mode(end.coords, other, apart)), None)
        if same is None:
            kept.append(end)
        else:
            kept[same] = kept[same]._replace(starts=(*kept[same].starts, *end.starts))
    return kept
