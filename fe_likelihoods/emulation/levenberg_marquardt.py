"""Levenberg-Marquardt on the responses: ascents to modes, run side by side, with derivatives from all their runs.

The log-density in the coordinates of `fe_likelihoods.emulation.target` is log L(S(r)) - z.z / 2 with residuals r that
enter the log-likelihood through quadratic statistics S. With J = dr/dz and f = d log L / dS at the noise parameters
that fit best, its gradient and its Gauss-Newton Hessian are::

    g = 2 sum_a f_a B_a(J, r) - z,        H = -2 sum_a f_a B_a(J, J) + 1,

where B_a is the bilinear form of S_a. A step solves (H + lambda diag H) dz = g. Three lambda are simulated at once, and
the largest improvement is taken; after a step that gained what the quadratic promised, one is enough.

J is found by differences, or by the model's own derivatives, at few points only, and from there by regression over all
runs of all ascents (`Jacobians`). An ascent whose secants mislead makes differences of its own. It stops as soon as the
derivatives at the end of another ascent predict its residuals, or a line without a valley leads there: then it is in
the same mode. At the top of a mode, one step of a standard deviation is simulated along every axis of the Laplace
approximation. These runs make the derivatives sure, show whether the top is a saddle, and train the emulator.

References
----------
K. Levenberg (1944), Quarterly of Applied Mathematics 2, 164-168; D. W. Marquardt (1963), Journal of the Society for
Industrial and Applied Mathematics 11, 431-441; C. G. Broyden (1965), Mathematics of Computation 19, 577-593 (secants).
"""

from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import numpy as np

from .target import NoiseFit, Remember, ResponseTarget, Runs, Steps

__all__ = [
    "TOLERANCE",
    "Ascent",
    "Derivatives",
    "Jacobians",
    "ascend",
    "axes_of",
    "complete",
    "distinct_ends",
]

_DAMPINGS = 10.0 ** np.array([-1.5, 0.0, 1.5])
_FIRST_DAMPING = 1e-2
_DAMPING_LIMITS = 1e-8, 1e8
_LARGEST_STEP = 2.0  # prior standard deviations
FIRST_DIFFERENCE = 3e-3  # prior standard deviations
_DIFFERENCE_SHARE = 0.1  # of a posterior standard deviation
_DIFFERENCE_LIMITS = 3e-4, 2e-2
_CHECKED_CHANGES = 3e-3, 3e-4  # of the response by a step, relative, where the model's derivatives are first used
_CHECKED_ERROR = 0.05
_RETRIES = -1.0, 0.3, -0.3, 0.05  # steps tried where the simulation of a difference fails, as multiples
_NEAREST_RUNS = 3.0, 10.0  # runs that secants are fitted to: per dimension, and in addition
_TOO_CLOSE = 1e-8  # squared distance of runs that tell nothing about derivatives: residuals have seven digits
TOLERANCE = 0.5  # log-density still to gain, according to the quadratic approximation
_MAX_ITERATIONS = 40
_PATIENCE = 4  # iterations after which an ascent that is far below a known end and slow is given up
_LEFT = 6.0  # iterations like the last one that would be needed to reach the known end
_ROUGH = 5.0  # gain that the quadratic approximation may promise where no step gains anything
_STALLED = 0.1, 0.02  # gain in log-density below which a step counts as failed, and the same as a share of what is left
# Share of the promised gain below which an ascent with derivatives of its own makes new differences. Without them,
# searches need 10 to 30 % fewer simulations, but a column gets a false second mode with 1 of 5 seeds.
_MISLED = 0.7
_KEPT_PROMISE = 0.5  # share of the promised gain from which one damping is enough for the next step
_HOPELESS = 200.0  # log-density below the best end at which another one is given up
_SAME_MODE = 4.0  # squared distance per dimension, in units of the Laplace approximation
# loss by the error of a prediction that shows the same mode: share per dimension, at most, and constant
_EXPLAINED = 0.01, 0.1, 1.0
_NEAR = 20.0  # largest difference of log-densities at which the line between ends is examined
_ALONG = np.array([0.207, 0.414, 0.732])  # points of this line, unequal so that equally spaced modes are not all hit
_DIP = 3.0  # depth of a valley in log-density that separates modes
_ROUGHNESS = 4.0  # depth of a valley between points of one rough mode, as a multiple of the cost of a step
_DEEPEST = 9.0  # at most: along wrong axes, steps cost hundreds
_DESIGN_FROM = 0.25  # log-density per dimension still to gain at which the first one is made
_LONGEST = 4  # such directions along which steps are simulated
_FAR = 2.0  # standard deviations that are simulated along such directions
_FREE = 2.0  # curvatures of the Hessian below this are the prior's, which is 1, with little of the data's
_SHARPEST = 1e18  # curvature at which a step of a standard deviation, 1e-9 of the prior's, is lost in rounding
_EXACT = (
    "the model reproduces the measurements exactly at {}, so the likelihood grows without bound as the standard "
    "deviation of the noise goes to zero, and there is no posterior: add noise to synthetic measurements, or give the "
    "standard deviation a prior that excludes zero (such as LogNormal), or a number"
)


class Derivatives(NamedTuple):
    """A request of an ascent for the model's own derivatives at coordinates (n_structural,), in place of points."""

    coords: np.ndarray


Request = np.ndarray | Derivatives


class _Point(NamedTuple):
    """A simulated point, with the noise parameters that fit best."""

    coords: np.ndarray
    run: int
    statistics: np.ndarray
    noise: NoiseFit
    value: float


class Ascent(NamedTuple):
    """Where an ascent from one start has arrived, with the log-density around it in standard normal coordinates."""

    coords: np.ndarray  # structural coordinates (n_structural,)
    run: int  # its number in the archive of the target
    statistics: np.ndarray  # of the residuals (n_numbers,)
    noise: NoiseFit  # the best noise parameters
    value: float  # log-density at the best noise parameters
    slopes: np.ndarray  # d residuals / d coords (n_structural, n), as weights of the first n histories in the archive
    weights: np.ndarray  # derivatives of the log-likelihood by the statistics (n_numbers,)
    gradient: np.ndarray  # of the log-density (n_structural,)
    hessian: np.ndarray  # Gauss-Newton, of minus the log-density (n_structural, n_structural)
    ended: bool = False  # whether the ascent goes no further

    @property
    def gain_left(self) -> float:
        """Log-density still to gain according to the quadratic approximation."""
        return 0.5 * float(self.gradient @ np.linalg.solve(self.hessian, self.gradient))

    @property
    def converged(self) -> bool:
        """Whether little is left to gain; differences of a rough likelihood promise a few units at its top as well."""
        return self.gain_left < _ROUGH


class Jacobians:
    """Derivatives of the residuals on one part of the record, from differences at few points and all runs.

    At a point z, with the derivatives J_0 of the nearest point z_0 at which they are known, and runs at z + s_i whose
    residuals differ by y_i from those at z, the derivatives are J_0 + D. D minimises::

        sum_i |y_i - (J_0 + D) s_i|^2 / |s_i|^4 + |D|^2 / |z - z_0|^2 .

    A run at a distance s has an error of the second order, s^2, from curvature, whence the weights; and J_0 is as
    uncertain as a difference with a step of ``|z - z_0|``. Derivatives are weights of histories, as in `Ascent.slopes`.
    """

    def __init__(self) -> None:
        self._known: list[tuple[np.ndarray, np.ndarray]] = []
        self._coords: list[np.ndarray] = []
        self._runs: list[int] = []
        self._claimed = False

    def note(self, points: np.ndarray, runs: Runs) -> None:
        """Enter runs at points (n, d)."""
        for k in np.flatnonzero(~runs.failed):
            self._coords.append(points[k])
            self._runs.append(int(runs.numbers[k]))

    def claim(self) -> bool:
        """Whether the caller is the first, which makes the first differences."""
        claimed, self._claimed = self._claimed, True
        return not claimed

    def __bool__(self) -> bool:
        return bool(self._known)

    def add(self, coords: np.ndarray, slopes: np.ndarray) -> None:
        """Enter derivatives (d, n) that are known at coordinates (d,)."""
        self._known.append((coords, slopes))

    def known_at(self, coords: np.ndarray) -> bool:
        """Whether derivatives were entered for this very point."""
        return any(np.array_equal(coords, point) for point, _ in self._known)

    def at(self, coords: np.ndarray, run: int) -> np.ndarray:
        """Derivatives (d, n) at coordinates (d,), where a run was made."""
        origin, slopes = min(reversed(self._known), key=lambda each: float(np.square(each[0] - coords).sum()))
        far = float(np.square(origin - coords).sum())
        d = len(coords)
        steps = np.array(self._coords) - coords
        squared = np.square(steps).sum(axis=1)
        rows = np.flatnonzero(squared > _TOO_CLOSE)
        rows = rows[np.argsort(squared[rows])[: int(_NEAREST_RUNS[0] * d + _NEAREST_RUNS[1])]]
        if far < _TOO_CLOSE or not len(rows):
            return slopes
        steps, weighted = steps[rows], steps[rows] / np.square(squared[rows])[:, None]
        solved = np.linalg.solve(weighted.T @ steps + np.eye(d) / far, weighted.T)
        runs = np.array([self._runs[row] for row in rows])
        slopes = np.pad(slopes, ((0, 0), (0, max(0, max(run, *runs) + 1 - slopes.shape[1]))))
        changes = _differences(runs, run, slopes.shape[1]) - steps @ slopes
        return slopes + solved @ changes


class _Climb:
    """An ascent from a simulated point; see `ascend` for the parameters."""

    def __init__(
        self,
        target: ResponseTarget,
        jacobians: Jacobians,
        centre: np.ndarray,
        known: dict[int, Ascent],
        apart: float,
        number: int,
        designed: bool = True,
    ) -> None:
        self._number, self._shared, self._designed = number, np.isinf(apart), designed
        self._target, self._jacobians, self._centre, self._known = target, jacobians, centre, known
        self._apart = apart
        self.here: _Point
        self.values: list[float] = []  # at the points simulated last
        self.dip = _DIP

    def begin(self, start: np.ndarray, steps: np.ndarray | None) -> Generator[np.ndarray, Runs, int | None]:
        """Simulate the start, and points around it for derivatives, `steps` or small ones, where these are needed.

        The model's own derivatives replace small steps; steps of a standard deviation also train the emulator.
        Returns the number of the ascent that the start leads to, -1 if its simulation fails, else None.
        """
        small = FIRST_DIFFERENCE * np.eye(len(start))
        own = self._target.differentiable and (steps is None or not self._designed)
        # with the start, so that the others find derivatives
        first = steps is None and not own and self._jacobians.claim()
        runs = yield np.concatenate([start[None], start + small]) if first else start[None]
        higher = self.highest(start[None], Runs(*(column[:1] for column in runs)), -np.inf)
        if higher is None:
            return -1
        self.here = higher
        if first:
            rest = Runs(*(column[1:] for column in runs))
            self._jacobians.note(start + small, rest)
            yield from self.difference(small, rest)
            return None
        joined = self._explained()
        if joined is None and steps is not None:
            joined = yield from self.connected()
        if joined is None and not own and (steps is not None or not self._jacobians):
            yield from self.difference(small if steps is None else steps)
        return joined

    def highest(self, points: np.ndarray, runs: Runs, least: float) -> _Point | None:
        """The highest simulated point; None if none is above `least`."""
        found = None
        self._jacobians.note(points, runs)
        self.values = []
        for k in np.flatnonzero(~runs.failed):
            fit = self._target.fit_noise(runs.statistics[k], None if least == -np.inf else self.here.noise.coords)
            value = fit.log_density + float(self._target.log_prior(points[k] - self._centre))
            self.values.append(value)
            if value > (least if found is None else found.value):
                found = _Point(points[k], int(runs.numbers[k]), runs.statistics[k], fit, value)
        return found

    def difference(self, steps: np.ndarray, runs: Runs | None = None) -> Generator[np.ndarray, Runs, None]:
        """Derivatives at the present point from steps (d, d) of it; zero along a step that fails at every length."""
        here = self.here
        if runs is None:
            runs = yield here.coords + steps
            self._jacobians.note(here.coords + steps, runs)
        ends, used = np.where(runs.failed, here.run, runs.numbers), steps.copy()
        for k in np.flatnonzero(runs.failed):
            for factor in _RETRIES:
                again = yield here.coords + factor * steps[None, k]
                if not again.failed[0]:
                    ends[k], used[k] = again.numbers[0], factor * steps[k]
                    break
        changes = _differences(ends, here.run, max(here.run, *ends) + 1)
        self._jacobians.add(here.coords, np.linalg.solve(used, changes))

    def derivatives(self) -> Generator[Any, Any, None]:
        """The model's own derivatives at the present point; the first ones are compared with differences."""
        here, target = self.here, self._target
        numbers = yield Derivatives(here.coords)
        if target.unchecked:
            target.unchecked.clear()
            yield from self._check(numbers)
        self._jacobians.add(here.coords, target.archive.weights(numbers))

    def _check(self, numbers: np.ndarray) -> Generator[np.ndarray, Runs, None]:
        """ValueError if derivatives, numbers (d,) in the archive, deny the residuals at a step along all coordinates.

        A smaller step is tried. Without a change along it, or a simulation there, the next derivatives are compared.
        """
        here, target = self.here, self._target
        scales = 1.0 / np.square(target.scales) / target.measured.size
        sizes = np.sqrt(np.diag(target.archive.products(numbers, scales)))
        random = np.random.default_rng(0)  # a row in the place of another one shows, and so does a sign
        shares = random.uniform(0.5, 1.0, len(sizes)) * random.choice([-1.0, 1.0], len(sizes))
        worst = 0.0
        for change in _CHECKED_CHANGES:
            steps = shares * np.minimum(change / np.maximum(sizes, 1e-300), _DIFFERENCE_LIMITS[1])
            runs = yield (here.coords + steps)[None]
            size = 0.0
            if not runs.failed[0]:
                products = target.archive.products(np.array([runs.numbers[0], here.run, *numbers]), scales)
                changed, predicted = np.array([[1.0, -1.0, *np.zeros(len(steps))], [0.0, 0.0, *steps]])
                norms = [
                    np.sqrt(max(0.0, each @ products @ each)) for each in (changed, predicted, changed - predicted)
                ]
                size = max(norms[:2])
            if size == 0.0:
                target.unchecked.append(True)
                return
            worst = float(norms[2] / size)
            if worst < _CHECKED_ERROR:
                return
        raise ValueError(
            f"the derivatives of {target.kinds}.jacobian differ from a difference of two simulations by "
            f"{100.0 * worst:.0f} % of the norm; expected at most {100.0 * _CHECKED_ERROR:.0f} %: return the "
            "derivatives of the response, in the units of the response [SI], by "
            f"{', '.join(target.model.parameter_names)}, or leave jacobian out"
        )

    def quadratic(self) -> Ascent:
        """The log-density around the present point."""
        here = self.here
        slopes = self._jacobians.at(here.coords, here.run)
        weights = self._target.slopes(here.statistics, here.noise.coords)
        forms = self._target.archive.forms(self._target.archive.weights([*slopes, here.run]))
        gradient = 2.0 * forms[:-1, -1] @ weights - (here.coords - self._centre)
        hessian = _at_least_one(-2.0 * forms[:-1, :-1] @ weights + np.eye(len(slopes)))
        if not np.abs(hessian).max() < _SHARPEST:
            raise ValueError(_EXACT.format(self._target.at_median_noise(here.coords[None])[0, : len(slopes)]))
        self._known[self._number] = Ascent(*here, slopes, weights, gradient, hessian)
        return self._known[self._number]

    def climb(self, merging: bool, tolerance: float) -> Generator[np.ndarray, Runs, int | None]:
        """Steps to the top; returns the number of the ascent that this joins, -1 if it is given up, None at a top."""
        damping, good, failures, gain = _FIRST_DAMPING, False, 0, np.inf
        own = self._target.differentiable
        for iteration in range(_MAX_ITERATIONS):
            if own and not good and not self._jacobians.known_at(self.here.coords):
                yield from self.derivatives()
            at = self.quadratic()
            if merging and (joined := self._explained()) is not None:
                return joined
            behind = max(other.value for other in self._known.values()) - at.value
            if merging and iteration >= _PATIENCE and behind > max(_HOPELESS, _LEFT * gain):
                return -1
            if at.gain_left < tolerance or failures > 3:
                return None
            dampings = damping * _DAMPINGS[: 1 if good or (own and not failures) else None]
            scale = np.diag(np.diag(at.hessian))
            moves = np.array([np.linalg.solve(at.hessian + each * scale, at.gradient) for each in dampings])
            moves *= np.minimum(1.0, _LARGEST_STEP / np.abs(moves).max(axis=1, keepdims=True))
            points = self._target.moved(at.coords, moves)
            runs = yield points
            higher, misled = self.highest(points, runs, at.value), False
            gain = 0.0 if higher is None else higher.value - at.value
            if higher is not None:
                k = int(np.argmin(np.square(points - higher.coords).sum(axis=1)))
                promised = float(at.gradient @ moves[k] - 0.5 * moves[k] @ at.hessian @ moves[k])
                good, damping = gain > _KEPT_PROMISE * promised, float(np.clip(dampings[k], *_DAMPING_LIMITS))
                misled = gain < _MISLED * promised
                self.here = higher
            if gain > max(_STALLED[0], _STALLED[1] * at.gain_left):
                failures = 0
                if misled and not self._shared and not own:
                    yield from self._own_differences(at, 1.0)
                continue
            good, failures = False, failures + 1
            damping = max(damping, _FIRST_DAMPING)
            # the first time, the runs that gained nothing have corrected the secants
            if failures > 1 and not self._jacobians.known_at(self.here.coords):
                yield from self._own_differences(at, failures)
            elif failures > 1:
                damping = min(damping * 1e4, _DAMPING_LIMITS[1])
        return None

    def _own_differences(self, at: Ascent, factor: float) -> Generator[np.ndarray, Runs, None]:
        """Derivatives by differences with steps of a share of the standard deviations, times a factor."""
        spread = factor * _DIFFERENCE_SHARE * np.sqrt(np.diag(np.linalg.inv(at.hessian)))
        yield from self.difference(np.diag(np.clip(spread, *_DIFFERENCE_LIMITS)))

    def _explained(self) -> int | None:
        """Number of another ascent whose derivatives, at a higher point, predict the residuals here; None if none.

        The same mode then lies uphill of both. At another mode, residuals are as small as at the higher point, which
        its derivatives deny.
        """
        return next((number for number, other in self._known.items() if self._is_explained_by(other)), None)

    def _is_explained_by(self, other: Ascent) -> bool:
        move = self.here.coords - other.coords
        if np.abs(move).max() >= self._apart or self.here.value >= other.value:
            return False
        ours, theirs, predicted = self._target.archive.weights([self.here.run, other.run, move @ other.slopes])
        forms = self._target.archive.forms(np.stack([ours - theirs - predicted, predicted])) @ other.weights
        lost, whole = -np.diag(forms)
        return lost < max(min(_EXPLAINED[0] * len(move), _EXPLAINED[1]) * whole, _EXPLAINED[2])

    def connected(self) -> Generator[np.ndarray, Runs, int | None]:
        """Number of the ascent that a line without a valley leads to from nearly the same height; None if none.

        On a rough or curved likelihood, derivatives at one point do not describe the other points of its mode: without
        lines, searches on the bridge column find up to three modes where one is, in a third more simulations. The line
        is straight in scaled parameters, in which a ridge of equal products is straight. A lower ascent that goes on is
        no end: from a saddle, lines without a valley lead up to two modes.
        """
        here = self.here
        for number, end in list(self._known.items()):
            if number == self._number:
                continue
            if abs(end.value - here.value) > _NEAR or np.abs(end.coords - here.coords).max() >= self._apart:
                continue
            if end.value < here.value - self.dip and not end.ended:
                continue
            points = self._target.line(here.coords, end.coords, _ALONG)
            runs = yield points
            if runs.failed.any() or number not in self._known:
                continue  # it has joined another one meanwhile
            fits = [self._target.fit_noise(each, here.noise.coords).log_density for each in runs.statistics]
            heights = fits + self._target.log_prior(points - self._centre)
            if _valley(np.array([here.value, *heights, end.value])) < self.dip:
                if self._number in self._known:
                    self._known[number] = max(end, self._known[self._number], key=lambda each: each.value)
                return number
        return None


def ascend(
    target: ResponseTarget,
    jacobians: Jacobians,
    number: int,
    start: np.ndarray,
    centre: np.ndarray,
    known: dict[int, Ascent],
    tolerance: float = TOLERANCE,
    apart: float = np.inf,
    steps: np.ndarray | None = None,
    designed: bool = True,
) -> Generator[np.ndarray, Runs, int]:
    """Levenberg-Marquardt from one start (n_structural,), where the prior is centred at `centre`.

    Yields points (n, n_structural) to simulate and is sent their `Runs`, or `Derivatives` and is sent the model's
    derivatives. Returns the number of the ascent that it joins, its own at an end of its own; -1 if the start fails, or
    if the ascent is slow and far below another one. `known` has where every ascent on this part of the record has
    arrived; one that would end where a higher one goes stops and leaves the dict, and so does one that is given up. It
    stops when less than `tolerance` of log-density is still to gain. Ends are different where one coordinate differs by
    `apart` prior standard deviations. `steps` from the start are simulated with it, for the first derivatives; if
    `designed`, a step of a standard deviation is simulated along every axis of the Laplace approximation at the end.
    """
    climb = _Climb(target, jacobians, centre, known, apart, number, designed)
    joined = yield from climb.begin(start, steps)
    if joined is not None:
        return joined
    joined = yield from climb.climb(True, max(tolerance, _DESIGN_FROM * len(start)) if designed else tolerance)
    if joined is None:
        joined = yield from climb.connected()
    if joined is not None:
        del known[number]
        return joined
    end = known[number]
    if designed and (steps is None or _squared_distance(start, end) >= _SAME_MODE * len(start)):
        points = target.moved(end.coords, axes_of(end))
        runs = yield points
        # at a saddle, such as the axis of symmetry of an even response, a point of the design is higher
        higher = climb.highest(points, runs, end.value + tolerance)
        # a step of a standard deviation costs 0.5; on a rough likelihood it costs more, and so do points on a line
        cost = end.value - float(np.median(climb.values or end.value))
        climb.dip = float(np.clip(_ROUGHNESS * cost, _DIP, _DEEPEST))
        yield from climb.difference(points - end.coords, runs)
        climb.here = higher or climb.here
        yield from climb.climb(False, tolerance)
    end = climb.quadratic()
    if designed:  # where the data leave a direction to the prior, the emulator must reach as far as the prior
        free = axes_of(end)[np.linalg.eigvalsh(end.hessian) < _FREE][:_LONGEST]
        if len(free):
            yield target.moved(end.coords, np.concatenate([_FAR * free, -_FAR * free]))
    joined = (yield from climb.connected()) if designed else None
    if joined is None:
        known[number] = known[number]._replace(ended=True)
        return number
    del known[number]
    return joined


def axes_of(end: Ascent, free: float = 1.0) -> np.ndarray:
    """Steps (d, d) of a standard deviation along the axes of the Laplace approximation, in both directions in turn.

    Along directions that the data leave to the prior, steps have the length `free`.
    """
    values, vectors = np.linalg.eigh(end.hessian)
    lengths = np.where(values < _FREE, free, 1.0 / np.sqrt(np.maximum(values, 1.0)))
    return (vectors * ((-1.0) ** np.arange(len(values)) * lengths)).T


def _differences(runs: np.ndarray, run: int, n: int) -> np.ndarray:
    """Differences of the residuals of runs (m,) from a run, as weights (m, n) of the first n histories."""
    return np.eye(n)[runs] - np.eye(n)[run]


def _at_least_one(hessian: np.ndarray) -> np.ndarray:
    """A Hessian whose eigenvalues are not below those of the prior, which rounding can make them."""
    values, vectors = np.linalg.eigh(hessian)
    return hessian if values[0] >= 1.0 else (vectors * np.maximum(values, 1.0)) @ vectors.T


def _squared_distance(coords: np.ndarray, end: Ascent) -> float:
    """Squared distance in units of the Laplace approximation at an end."""
    move = coords - end.coords
    return float(move @ end.hessian @ move)


def _valley(values: np.ndarray) -> float:
    """Largest depth of one of the values below values on both sides of it; negative if there is none."""
    before = np.maximum.accumulate(values)[:-2]
    after = np.maximum.accumulate(values[::-1])[::-1][2:]
    return float((np.minimum(before, after) - values[1:-1]).max())


def complete(
    target: ResponseTarget,
    ascents: dict[int, Generator[Request, Any, Any]],
    finished: Callable[[int, Any], None],
    remember: Remember,
    fits: Callable[[float], bool],
    share: float = 1.0,
) -> Steps:
    """Run generators of requests, by their numbers, side by side to their ends: all requests together are one batch.

    Yields as `search_modes`; the cost is `share` for each new simulation. Returns False as soon as a batch does not fit
    in the budget; `remember` and `fits` are as for `search_modes`.
    """
    answers: dict[int, Any] = dict.fromkeys(ascents)
    while True:
        waiting: dict[int, Request] = {}
        for index, answer in answers.items():
            try:
                waiting[index] = ascents[index].send(answer)
            except StopIteration as end:
                finished(index, end.value)
        if not waiting:
            return True
        wanted = [index for index, each in waiting.items() if isinstance(each, Derivatives)]
        points = [waiting[index] for index in waiting if index not in wanted]
        coords = np.concatenate(points) if points else np.empty((0, target.n_structural))
        cost = share * (len(wanted) + target.new_points(coords))  # derivatives at a point count as one simulation
        if not fits(cost):
            return False
        at = np.array([waiting[index].coords for index in wanted])
        slopes = iter((yield from target.derivatives(at, remember)) if wanted else ())
        runs = (yield from target.run(coords, remember)) if points else None
        answers, end = {}, 0
        for index, each in waiting.items():
            if isinstance(each, Derivatives):
                answers[index] = next(slopes)
            else:
                answers[index] = Runs(*(column[end : end + len(each)] for column in runs))
                end += len(each)
        yield cost


def distinct_ends(ends: dict[int, Ascent], apart: float = np.inf) -> dict[int, int]:
    """For the number of every end, the number of the highest end of the same mode.

    Ends are in the same mode if their distance is small in units of one of their Laplace approximations, of which the
    differences of a rough likelihood make some too narrow. A part of the record does not determine all coordinates: in
    undetermined coordinates this distance is small, although a longer part may lead to different modes. On a part of
    the record, no coordinate may therefore differ by `apart` or more.
    """
    highest: dict[int, int] = {}
    for number in sorted(ends, key=lambda k: -ends[k].value):
        end = ends[number]
        near = (
            k
            for k in dict.fromkeys(highest.values())
            if min(_squared_distance(end.coords, ends[k]), _squared_distance(ends[k].coords, end))
            < _SAME_MODE * len(end.coords)
            and np.abs(end.coords - ends[k].coords).max() < apart
        )
        highest[number] = next(near, number)
    return highest
