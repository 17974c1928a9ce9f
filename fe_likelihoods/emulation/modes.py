"""Modes of a posterior by Levenberg-Marquardt on the responses, from several starts.

The log-density in the coordinates of `fe_likelihoods.emulation.target` is log L(S(r)) - |z|^2 / 2 with residuals r of
which the log-likelihood is a function through quadratic statistics S. With J = dr/dz by finite differences and
f = d log L / dS at the noise parameters that fit best, its gradient and its Gauss-Newton Hessian are

    g = 2 sum_a f_a B_a(J, r) - z,        H = -2 sum_a f_a B_a(J, J) + 1,

where B_a is the bilinear form of S_a. A step solves (H + lambda diag H) dz = g. Several lambda are simulated at once:
they cost one parallel batch, and the largest improvement is taken. That reaches modes at the end of narrow curved
valleys, where one lambda at a time does not. Steps of the differences are a small part of a posterior standard
deviation: larger ones average over the valley, much smaller ones follow the roughness of the likelihood.

A model that can be shortened (``first(seconds)``) is first fitted to the start of its record, from all starts, and then
to longer parts, from the distinct ends so far. The short runs are cheap and their misfit is smoother, because errors in
a period have had less time to add up to a phase. There the prior is centred on each start, so that starts keep their
differences in parameters that the early part does not depend on.

References
----------
K. Levenberg (1944), Quarterly of Applied Mathematics 2, 164-168; D. W. Marquardt (1963), Journal of the Society for
Industrial and Applied Mathematics 11, 431-441.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .quadratic import bilinear_form
from .target import NoiseFit, Remember, ResponseTarget, Runs, run_at_once

__all__ = [
    "Ascent",
    "Mode",
    "ModeSearch",
    "ascend",
    "distinct_ends",
    "draw_starts",
    "find_modes",
    "laplace",
    "search_from",
    "search_modes",
]

_DAMPINGS = 10.0 ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
_FIRST_DAMPING = 1e-2
_LARGEST_DAMPING = 1e8
_LARGEST_STEP = 2.0  # prior standard deviations
_FIRST_DIFFERENCE = 3e-3  # prior standard deviations
_DIFFERENCE_SHARE = 0.1  # of a posterior standard deviation
_DIFFERENCE_LIMITS = 3e-4, 2e-2
_RETRIES = -1.0, 0.3, -0.3, 0.05  # steps tried where the simulation of a difference fails, as multiples
_TOLERANCE = 0.5  # log-density still to gain, according to the quadratic approximation
_MAX_ITERATIONS = 40
_SAME_MODE = 4.0  # squared distance per dimension, in units of the Laplace approximation
_NEGLIGIBLE = 15.0  # a mode whose log-evidence is lower than the largest by more than this is dropped
_HOPELESS = 200.0  # an end of a short part whose log-density is lower than the largest by more than this is dropped
_LOOSEST = 5.0  # largest tolerance of a short part of the record
_THIRD = 1.0 / 3.0  # steps of second differences, in standard deviations
_ROUNDS_OF_STEPS = 4
_FLATTEST = 0.2  # smallest curvature of the Laplace approximation: five times the variance of the prior
_SHARES = 0.05, 0.3, 0.6  # of the Arias intensity, at which the parts of the record end


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
        Number of the ascent in whose mode this one would have ended, -1 if it went to its own end.
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
        """Whether little is left to gain."""
        return self.gain_left < _TOLERANCE or self.merged >= 0


class Mode(NamedTuple):
    """A mode of the posterior.

    Attributes
    ----------
    parameters : (ndim,) float
        All parameters at the mode of the density in standard normal coordinates.
    coords : (ndim,) float
        These coordinates.
    covariance : (ndim, ndim) float
        Covariance of the coordinates in the Laplace approximation.
    log_density : float
        Log-density of the coordinates at the mode, without the evidence's normalisation.
    log_evidence : float
        Evidence of the mode in the Laplace approximation, which can be wrong by several units.
    starts : tuple of int
        Starts that ended here.
    converged : bool
        False if the ascent stopped before the top.
    """

    parameters: np.ndarray
    coords: np.ndarray
    covariance: np.ndarray
    log_density: float
    log_evidence: float
    starts: tuple[int, ...]
    converged: bool


class ModeSearch(NamedTuple):
    """Result of a search for modes.

    Attributes
    ----------
    modes : tuple of Mode
        Distinct modes, the highest first.
    ends : tuple of int
        Mode in which each start ended, -1 where it ended in none (a start that failed, or a mode of no weight).
    simulations : float
        Simulations run, parts of a record counted as fractions.
    finished : bool
        False if `max_simulations` ended the search.
    """

    modes: tuple[Mode, ...]
    ends: tuple[int, ...]
    simulations: float
    finished: bool


def ascend(
    target: ResponseTarget,
    start: np.ndarray,
    centre: np.ndarray,
    known: Sequence[Ascent] = (),
    tolerance: float = _TOLERANCE,
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

    Yields
    ------
    (n, n_structural) float
        Points to simulate; the generator is sent their `Runs`.

    Returns
    -------
    Ascent or None
        None if the simulation of the start fails.
    """
    d = target.n_structural
    runs = yield start[None]
    if runs.failed[0]:
        return None
    coords, residuals, statistics = start, runs.residuals[0], runs.statistics[0]
    noise = target.fit_noise(statistics)
    value = noise.log_density + target.log_prior(coords - centre)
    differences, damping, failures, slopes = np.full(d, _FIRST_DIFFERENCE), _FIRST_DAMPING, 0, None
    gain_left, merged, iteration = np.inf, -1, 0
    for iteration in range(_MAX_ITERATIONS):  # noqa: B007  the number of iterations is part of the result
        if slopes is None:
            slopes = yield from _difference(target, coords, residuals, differences)
            weights = target.slopes(statistics, noise.coords)
            gradient = 2.0 * bilinear_form(target.statistic, slopes, residuals[None])[:, 0] @ weights - (
                coords - centre
            )
            hessian = -2.0 * bilinear_form(target.statistic, slopes) @ weights + np.eye(d)
            scale = np.diag(np.diag(hessian))
            whole = np.linalg.solve(hessian, gradient)
            gain_left = 0.5 * float(gradient @ whole)
            merged = next((k for k, end in enumerate(known) if _distance(coords + whole, end) < _SAME_MODE * d), -1)
            if gain_left < tolerance or merged >= 0:
                break
        dampings = damping * _DAMPINGS
        steps = np.array([np.linalg.solve(hessian + each * scale, gradient) for each in dampings])
        steps *= np.minimum(1.0, _LARGEST_STEP / np.abs(steps).max(axis=1, keepdims=True))
        runs = yield coords + steps
        best = None
        for k in np.flatnonzero(~runs.failed):
            fit = target.fit_noise(runs.statistics[k], noise.coords)
            reached = fit.log_density + target.log_prior(coords + steps[k] - centre)
            if reached > (value if best is None else best[0]):
                best = reached, k, fit
        if best is not None:
            value, k, noise = best
            coords, residuals, statistics = coords + steps[k], runs.residuals[k], runs.statistics[k]
            damping = float(np.clip(dampings[k], 1e-8, _LARGEST_DAMPING))
            spread = np.sqrt(np.diag(np.linalg.inv(hessian)))
            differences, slopes, failures = np.clip(_DIFFERENCE_SHARE * spread, *_DIFFERENCE_LIMITS), None, 0
        else:
            failures += 1
            if failures == 1:
                damping = min(damping * 1e5, _LARGEST_DAMPING)
            elif failures == 2:  # the differences may have met roughness: take larger ones
                differences, slopes, damping = 3.0 * differences, None, 0.1
            else:
                break
    if slopes is None:  # stopped after a step
        slopes = yield from _difference(target, coords, residuals, differences)
        weights = target.slopes(statistics, noise.coords)
        hessian = -2.0 * bilinear_form(target.statistic, slopes) @ weights + np.eye(d)
    return Ascent(coords, float(value), hessian, noise, residuals, slopes, gain_left, iteration, merged)


def _distance(coords: np.ndarray, end: Ascent) -> float:
    """Squared distance from the end of an ascent, in units of its Laplace approximation."""
    apart = coords - end.coords
    return float(apart @ end.hessian @ apart)


def _difference(
    target: ResponseTarget, coords: np.ndarray, residuals: np.ndarray, steps: np.ndarray
) -> Generator[np.ndarray, Runs, np.ndarray]:
    """Derivatives (d, n_channels, n_steps) of the residuals; zero for a parameter all of whose differences fail."""
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


class _Batches:
    """Runs generators of points side by side: their requests are simulated as one batch."""

    def __init__(self, target: ResponseTarget, remember: Remember, fits: Callable[[float], bool]) -> None:
        self._target, self._remember, self._fits = target, remember, fits

    def complete(
        self, ascents: Sequence[Generator[np.ndarray, Runs, Any]], finished: Callable[[int, Any], None]
    ) -> Iterator[int]:
        """Advance all generators to their ends; yields the number of points of each batch.

        Stops early, with `interrupted` set, when a batch does not fit in what remains of the budget.
        """
        self.interrupted = False
        waiting: dict[int, np.ndarray] = {}

        def advance(index: int, runs: Runs | None) -> None:
            try:
                waiting[index] = ascents[index].send(runs)
            except StopIteration as end:
                waiting.pop(index, None)
                finished(index, end.value)

        for index in range(len(ascents)):
            advance(index, None)
        while waiting:
            requests = list(waiting.items())
            points = np.concatenate([request for _, request in requests])
            if not self._fits(len(points)):
                self.interrupted = True
                return
            runs = self._target.run(points, self._remember)
            yield len(points)
            place = 0
            for index, request in requests:
                rows = slice(place, place + len(request))
                place += len(request)
                advance(index, Runs(*(column[rows] for column in runs)))


def distinct_ends(ends: Sequence[Ascent]) -> list[Ascent]:
    """Ends that are different modes, the highest first; each carries the starts of those that it stands for."""
    kept: list[Ascent] = []
    for end in sorted(ends, key=lambda end: -end.log_density):
        d = len(end.coords)
        same = next((k for k, other in enumerate(kept) if _distance(end.coords, other) < _SAME_MODE * d), None)
        if same is None:
            kept.append(end)
        else:
            kept[same] = kept[same]._replace(starts=(*kept[same].starts, *end.starts))
    return kept


def laplace(target: ResponseTarget, end: Ascent) -> Mode:
    """Laplace approximation at the end of an ascent, over structural and noise coordinates together.

    The residuals are taken as linear in the structural coordinates, so that nothing is simulated. The Hessian of the
    log-density is computed by central differences with steps of a third of a standard deviation.
    """
    d, at = target.n_structural, np.concatenate([end.coords, end.noise.coords])
    statistics = target.statistic(end.residuals)
    along = 2.0 * bilinear_form(target.statistic, end.slopes, end.residuals[None])[:, 0]
    curved = bilinear_form(target.statistic, end.slopes)

    def log_density(coords: np.ndarray) -> np.ndarray:
        step = coords[:, :d] - end.coords
        linear = statistics + step @ along + np.einsum("nk,nl,kla->na", step, step, curved)
        return target.log_likelihood(np.maximum(linear, 0.0), coords[:, d:]) + target.log_prior(coords)

    steps = _THIRD / np.sqrt(np.concatenate([np.diag(end.hessian), np.ones(target.n_noise)]))
    unit = np.eye(target.ndim)
    for _ in range(_ROUNDS_OF_STEPS):  # noise parameters: the steps follow from the curvature itself
        ahead, behind, here = (log_density(at + sign * np.diag(steps)) for sign in (1.0, -1.0, 0.0))
        curvature = np.maximum((2.0 * here - ahead - behind) / steps**2, 0.1)
        steps = _THIRD / np.sqrt(curvature)
    pairs = [(i, j) for i in range(target.ndim) for j in range(i + 1)]
    corners = [
        log_density(np.array([at + a * steps[i] * unit[i] + b * steps[j] * unit[j] for i, j in pairs]))
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    mixed = -(corners[0] - corners[1] - corners[2] + corners[3]) / 4.0
    hessian = np.empty((target.ndim, target.ndim))
    for (i, j), value in zip(pairs, mixed, strict=True):
        hessian[i, j] = hessian[j, i] = value / (steps[i] * steps[j])
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, _FLATTEST)
    covariance = (vectors / values) @ vectors.T
    top = float(log_density(at[None])[0])
    log_evidence = top + 0.5 * target.ndim * float(np.log(2.0 * np.pi)) - 0.5 * float(np.log(values).sum())
    parameters = target.parameters(at[None])[0]
    return Mode(parameters, at, covariance, top, log_evidence, end.starts, end.converged)


def search_modes(
    target: ResponseTarget,
    starts: np.ndarray,
    remember: Remember = run_at_once,
    fits: Callable[[float], bool] = lambda _: True,
) -> Generator[float, None, ModeSearch]:
    """Search from given starts, on growing parts of the record where the model offers them.

    Parameters
    ----------
    target : ResponseTarget
        The posterior.
    starts : (n, n_structural) float
        Starts, in standard normal coordinates.
    remember : callable, optional
        Stores responses for a resumed run.
    fits : callable, optional
        ``fits(n)``: whether n more simulations of the whole record fit into the budget.

    Yields
    ------
    float
        Cost of each batch, in simulations of the whole record.
    """
    spent, interrupted, mode_of = 0.0, False, {}
    parts = [*target.shortened(_SHARES), target]
    fronts = [(start, start, (k,)) for k, start in enumerate(starts)]
    for part in parts:
        share = part.n_steps / target.n_steps
        whole = part is target
        ends: list[Ascent] = []

        def finish(index: int, end: Ascent | None, fronts: list = fronts, ends: list = ends) -> None:
            if end is None:
                return
            if end.merged >= 0:
                joined = ends[end.merged]
                ends[end.merged] = joined._replace(starts=(*joined.starts, *fronts[index][2]))
            else:
                ends.append(end._replace(starts=fronts[index][2]))

        tolerance = _TOLERANCE if whole else min(_TOLERANCE / share, _LOOSEST)
        origin = np.zeros(target.n_structural)
        ascents = [ascend(part, start, origin if whole else centre, ends, tolerance) for start, centre, _ in fronts]
        batches = _Batches(part, remember, lambda points, share=share: fits(share * points))
        for points in batches.complete(ascents, finish):
            spent += share * points
            yield share * points
        interrupted = batches.interrupted
        if not ends or interrupted:
            break
        kept = [end for end in distinct_ends(ends) if end.log_density > max(e.log_density for e in ends) - _HOPELESS]
        fronts = [(end.coords, end.coords, end.starts) for end in kept]
    modes: list[Mode] = []
    if part is target and ends:
        modes = sorted((laplace(target, end) for end in distinct_ends(ends)), key=lambda mode: -mode.log_evidence)
        modes = [mode for mode in modes if mode.log_evidence > modes[0].log_evidence - _NEGLIGIBLE]
    for number, mode in enumerate(modes):
        mode_of.update(dict.fromkeys(mode.starts, number))
    return ModeSearch(tuple(modes), tuple(mode_of.get(k, -1) for k in range(len(starts))), spent, not interrupted)


def draw_starts(target: ResponseTarget, n: int, random: Any) -> np.ndarray:
    """Starts (n, n_structural) in standard normal coordinates: the median of the prior, then draws of it."""
    drawn = random.standard_normal((max(n - 1, 0), target.n_structural))
    return np.concatenate([np.zeros((1, target.n_structural)), drawn])[:n]


def find_modes(posterior: Any, starts: int = 8, seed: Any = None, max_simulations: float | None = None) -> ModeSearch:
    """Find the modes of a posterior from the responses of its model.

    Parameters
    ----------
    posterior : Posterior
        Any noise whose statistics are quadratic in the residuals, as all noises of this package are.
    starts : int
        Number of starts: the median of the prior, and draws of it.
    seed : int, optional
        Seed of the draws.
    max_simulations : float, optional
        Largest number of simulations; parts of a record count as fractions.

    Returns
    -------
    ModeSearch

    Raises
    ------
    ValueError
        If `starts` is not a whole number of at least one, or the noise is of another kind.

    Notes
    -----
    A mode that no start leads to is not found. The more starts, the better; two equally wide modes are both found from
    eight starts in 99 of 100 cases.

    Examples
    --------
    >>> search = find_modes(posterior, seed=1)
    >>> [(mode.parameters, mode.log_evidence) for mode in search.modes]
    """
    if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
        raise ValueError(f"starts must be a whole number of at least one; got {starts!r}")
    target = ResponseTarget(posterior)
    budget = np.inf if max_simulations is None else float(max_simulations)
    spent = 0.0

    def fits(simulations: float) -> bool:
        return spent + simulations <= budget

    search = search_modes(target, draw_starts(target, starts, np.random.default_rng(seed)), fits=fits)
    while True:
        try:
            spent += next(search)
        except StopIteration as end:
            return end.value


def search_from(
    target: ResponseTarget, start: np.ndarray, remember: Remember, fits: Callable[[float], bool]
) -> Generator[float, None, Mode | None]:
    """One ascent on the whole record from a point (n_structural,); returns the mode, or None if the budget ended it."""
    ends: list[Ascent] = []

    def finish(_: int, end: Ascent | None) -> None:
        if end is not None:
            ends.append(end)

    batches = _Batches(target, remember, fits)
    for points in batches.complete([ascend(target, start, np.zeros(target.n_structural))], finish):
        yield float(points)
    return laplace(target, ends[0]) if ends else None
