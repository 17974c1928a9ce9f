"""Levenberg-Marquardt on the responses: ascents to modes, run side by side, with derivatives from all their runs.

Gradient, Gauss-Newton Hessian and step in standard normal coordinates are on the page ``docs/theory/guided``.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from samplers.judgement.guides import HIGHER

from .target import NoiseFit, ResponseTarget, Runs

_FIRST_DAMPING = 1e-2
FIRST_DIFFERENCE = 3e-3  # prior standard deviations
_DIFFERENCE_SHARE, _DIFFERENCE_LIMITS = 0.1, (3e-4, 2e-2)  # of a posterior standard deviation; prior ones
_CHECKED_CHANGE = 1e-3  # of the residuals by a step, relative, where the model's derivatives are first used
_CHECKED_ERROR = 0.05  # of the norm of this change, by which derivatives may differ from it (not measured)
_NEAREST_RUNS = 3, 10  # that secants are fitted to, per dimension and in addition; with all, searches took 7 % more
_TOO_CLOSE = 1e-8  # squared distance of runs that tell nothing about derivatives: residuals have seven digits
TOLERANCE = 0.5  # log-density still to gain, according to the quadratic approximation
_MAX_ITERATIONS = 40
_STALLED = 0.1  # gain below which a step counts as failed; with 0, searches of an aliased frequency took 20 % more
# Share of the promised gain below which an ascent that is alone makes new differences: 0.7 took 246 simulations in a
# search of a column (of 12), 0.4 took 177, and 0 took 181, but only one start ended at a mode in two of them. Where
# ascents share all runs, this costs more than it saves (20 and 30 parameters: 202 and 300 simulations, or 126 and 172).
_MISLED = 0.4
# on a part of the record, an ascent is given up after so many iterations, if it is so far below the best one, and needs
# so many more like the last; on the whole record, where this saves nothing, it may lead to another mode. Without this,
# searches of the isolated bridge took 509 and 387 simulations instead of 94 and 218
_PATIENCE, _HOPELESS, _LEFT = 4, 200.0, 6.0
# Log-density that the error of a prediction which shows the same mode costs. As a share of all that the parameters
# change, which hides one of them that has two modes, starts joined the other mode in 7 of 12 searches.
_EXPLAINED = 1.0
_ALONG = np.array([0.207, 0.414, 0.732])  # points of this line, unequal so that equally spaced modes are not all hit
# prior standard deviations in one coordinate that part ends on a part of the record: only a later one may tell them
_APART = 0.25
_SAME_MODE = 4.0  # squared distance up to which no line is needed; 4 d joined two modes of 15 parameters
_DIP = 3.0  # depth of a valley in log-density that separates modes
_DESIGN_FROM = 0.25  # log-density per dimension still to gain at which the steps of a standard deviation are made
# Prior standard deviations of the largest step, and of the runs along directions that are left to the prior, of which
# there are at most so many. Without these runs, the evidence of one of two ridges was wrong by six stated errors.
_FAR, _LONGEST = 2.0, 4
_FREE = 2.0  # curvatures of the Hessian below this are the prior's, which is 1, with little of the data's
_SHARPEST = 1e18  # curvature at which a step of a standard deviation, 1e-9 of the prior's, is lost in rounding
_EXACT = (
    "the model reproduces the measurements exactly at {}, so the likelihood grows without bound as the standard "
    "deviation of the noise goes to zero, and there is no posterior: add noise to synthetic measurements, or give the "
    "standard deviation a prior that excludes zero (such as LogNormal), or a number"
)


# points (n, n_structural) to simulate, for which `Runs` are sent; or one (n_structural,), for which the model's own
# derivatives are sent, as numbers (n_structural,) in the archive
Requests = Generator[np.ndarray, Any, Any]


class Ascent(NamedTuple):
    """Where an ascent from one start has arrived, with the log-density around it in standard normal coordinates."""

    coords: np.ndarray  # structural coordinates (n_structural,)
    run: int  # its number in the archive of the target
    statistics: np.ndarray  # of the residuals (n_numbers,)
    noise: NoiseFit  # the best noise parameters
    value: float  # log-density at the best noise parameters
    slopes: Any = None  # d residuals / d coords, numbers (n_structural,) or weights (n_structural, n) in the archive
    weights: Any = None  # derivatives of the log-likelihood by the statistics (n_numbers,)
    gradient: Any = None  # of the log-density (n_structural,)
    hessian: Any = None  # Gauss-Newton, of minus the log-density (n_structural, n_structural)
    ended: bool = False  # whether the ascent goes no further

    @property
    def gain_left(self) -> float:
        """Log-density still to gain according to the quadratic approximation."""
        return 0.5 * float(self.gradient @ np.linalg.solve(self.hessian, self.gradient))


@dataclass
class Climb:
    """Levenberg-Marquardt from one start on a part of the record, where the prior is centred at `centre`.

    `known` has where every ascent on this part has arrived, by its number. On a shorter record, where runs are cheap,
    it is `alone`: its derivatives are its own. Where no shorter part came before the `whole` record, a step of a
    standard deviation is simulated along every axis of the Laplace approximation at the end.
    """

    target: ResponseTarget
    derivatives: list[tuple[np.ndarray, np.ndarray]]  # coordinates (d,), and derivatives there as `Ascent.slopes`
    number: int
    centre: np.ndarray
    known: dict[int, Ascent]
    whole: bool
    alone: bool

    def run(self, start: np.ndarray, steps: np.ndarray | None, tolerance: float) -> Requests:
        """Returns the number of the ascent that it joins, its own at an end of its own, -1 if it fails or is given up.
        `steps` from the start give the first derivatives; less than `tolerance` of log-density is left to gain.
        """
        found = self._heights(start[None], (yield start[None]), None)
        if not found:
            return -1
        self._here = found[0]
        joined = self._explained()
        if joined is None:
            if steps is not None and self.whole:
                yield from self._difference(steps)
            elif steps is not None or not self.derivatives:
                yield from self._derive(FIRST_DIFFERENCE * np.eye(len(start)))
            elif self.target.data.differentiable:
                yield from self._derive(np.empty((0, len(start))))
            first = max(tolerance, _DESIGN_FROM * len(start)) if steps is None else tolerance
            joined = yield from self._climb(True, first)
        if joined is None:
            joined = yield from self._connected()
        if joined is None and self.whole:
            if steps is None:
                yield from self._design(tolerance)
            end = self._quadratic()
            # where the data leave a direction to the prior, the emulator must reach as far as the prior
            free = axes_of(end)[np.linalg.eigvalsh(end.hessian) < _FREE][:_LONGEST]
            if len(free):
                yield end.coords + np.concatenate([_FAR * free, -_FAR * free])
            joined = yield from self._connected()
        if joined is None:
            self.known[self.number] = self.known[self.number]._replace(ended=True)
            return self.number
        self.known.pop(self.number, None)
        return joined

    def _heights(self, points: np.ndarray, runs: Runs, noise: np.ndarray | None) -> list[Ascent]:
        """The points that did not fail, with their log-densities."""
        found = []
        for k in np.flatnonzero(~runs.failed):
            fit = self.target.fit_noise(runs.statistics[k], noise)
            value = fit.log_density + float(self.target.log_prior(points[k] - self.centre))
            found.append(Ascent(points[k], int(runs.numbers[k]), runs.statistics[k], fit, value))
        return found

    def _difference(self, steps: np.ndarray, runs: Runs | None = None) -> Requests:
        """Derivatives at the present point from steps (n, d) of it, `runs` if they have been made, the nearest known
        ones in other directions; none along a step that fails: shorter ones saved nothing where a third of the prior
        fails.
        """
        if runs is None:
            runs = yield self._here.coords + steps
        ends = np.where(runs.failed, self._here.run, runs.numbers)
        slopes = np.zeros((len(self._here.coords), len(self.target.archive)))
        if self.derivatives:
            slopes = self.target.archive.weights(self._nearest()[1])
        changes = _differences(ends, self._here.run, slopes.shape[1]) - steps @ slopes
        self.derivatives.append((self._here.coords, slopes + np.linalg.pinv(steps) @ changes))

    def _derive(self, steps: np.ndarray) -> Requests:
        """Derivatives at the present point: the model's own, or by differences with steps (n, d); unless known."""
        if any(np.array_equal(self._here.coords, point) for point, _ in self.derivatives):
            return
        if self.target.data.differentiable:
            slopes = yield self._here.coords
            if self.target.unchecked:  # the first derivatives are compared with a difference
                self.target.unchecked.clear()
                yield from self._check(slopes)
            self.derivatives.append((self._here.coords, slopes))
        else:
            yield from self._difference(steps)

    def _nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """The nearest coordinates (d,) at which derivatives are known, and these."""
        return min(reversed(self.derivatives), key=lambda each: float(np.square(each[0] - self._here.coords).sum()))

    def _check(self, slopes: np.ndarray) -> Requests:
        """ValueError if derivatives, numbers (d,), deny the residuals at a step along all coordinates, which is
        small beside the residuals, and at a smaller one. Where that fails or changes nothing, others are compared.
        """
        target, here = self.target, self._here
        metric = target.slopes(here.statistics, here.noise.coords)

        def norms(combinations: np.ndarray) -> np.ndarray:
            return np.sqrt(np.maximum(-np.einsum("iin,n->i", target.archive.forms(combinations), metric), 0.0))

        of_residuals, *sizes = norms(target.archive.weights([here.run, *slopes]))
        # of both signs and different lengths: a row in the place of another one shows
        steps = (-1.0) ** np.arange(len(slopes)) * np.linspace(0.5, 1.0, len(slopes))
        steps *= np.minimum(_CHECKED_CHANGE * of_residuals / np.maximum(sizes, 1e-300), _DIFFERENCE_LIMITS[1])
        linear = steps @ target.archive.weights(slopes)
        for share in (1.0, 0.1):  # an error from curvature, 5 to 7 % at 50 stiffnesses, is a tenth at the second step
            runs = yield (here.coords + share * steps)[None]
            change, predicted = target.archive.weights([runs.numbers[0], share * linear])
            change[here.run] -= 1.0
            *sizes, error = norms(np.array([change, predicted, change - predicted]))
            rounding = np.finfo(np.float32).eps * of_residuals  # of residuals in single precision
            if runs.failed[0] or (share == 1.0 and _CHECKED_ERROR * max(sizes) <= rounding):
                return target.unchecked.append(True)
            if error < _CHECKED_ERROR * max(sizes) + rounding:
                return
        raise ValueError(
            f"the derivatives of {target.data.kinds}.jacobian differ from a difference of two simulations by "
            f"{100.0 * error / max(sizes):.0f} % of the norm; expected at most {100.0 * _CHECKED_ERROR:.0f} %: "
            "return the derivatives of the response, in the units of the response [SI], by "
            f"{', '.join(target.data.parameter_names)}, or leave jacobian out"
        )

    def _slopes(self) -> np.ndarray:
        """Derivatives (d, n) of the residuals here, from differences at few points and all lower runs: secants to
        higher ones lead ascents into the modes of others (two storeys in 8 and 15 parameters: one lost in 15 of 16).

        At a point z, with the derivatives J_0 of the nearest point z_0 at which they are known, and runs at z + s_i
        whose residuals differ by y_i from those at z, they are J_0 + D with the least sum_i |y_i - (J_0 + D) s_i|^2 /
        |s_i|^4 + |D|^2 / |z - z_0|^2: secants (Broyden 1965, Mathematics of Computation 19, 577-593) with errors from
        curvature.
        """
        here, archive = self._here, self.target.archive
        origin, slopes = self._nearest()
        far, d = float(np.square(origin - here.coords).sum()), len(origin)
        steps = archive.coords - here.coords
        squared = np.square(steps).sum(axis=1)
        noise = np.repeat(here.noise.coords[None], len(steps) + 1, axis=0)
        heights = self.target.log_likelihood(np.concatenate([archive.statistics, here.statistics[None]]), noise)
        heights += self.target.log_prior(np.concatenate([archive.coords, here.coords[None]]) - self.centre)
        rows = np.flatnonzero((squared > _TOO_CLOSE) & (heights[:-1] < heights[-1]))
        rows = rows[np.argsort(squared[rows])[: _NEAREST_RUNS[0] * d + _NEAREST_RUNS[1]]]
        if far < _TOO_CLOSE or not len(rows):
            return slopes
        steps, weighted = steps[rows], steps[rows] / np.square(squared[rows])[:, None]
        solved = np.linalg.solve(weighted.T @ steps + np.eye(d) / far, weighted.T)
        slopes = archive.weights(slopes)
        return slopes + solved @ (_differences(archive.numbers[rows], here.run, len(archive)) - steps @ slopes)

    def _quadratic(self) -> Ascent:
        """The log-density around the present point."""
        archive = self.target.archive
        slopes = self._slopes()
        weights = self.target.slopes(self._here.statistics, self._here.noise.coords)
        forms = archive.forms(archive.weights([*slopes, self._here.run])) @ weights
        gradient = 2.0 * forms[:-1, -1] - (self._here.coords - self.centre)
        values, vectors = np.linalg.eigh(np.eye(len(slopes)) - 2.0 * forms[:-1, :-1])
        if not values[-1] < _SHARPEST:
            raise ValueError(_EXACT.format(self.target.parameters(self._here.coords[None])[0]))
        hessian = (vectors * np.maximum(values, 1.0)) @ vectors.T  # rounding can make it less than the prior's
        self.known[self.number] = self._here._replace(
            slopes=slopes, weights=weights, gradient=gradient, hessian=hessian
        )
        return self.known[self.number]

    def _climb(self, merging: bool, tolerance: float) -> Requests:
        """Steps to the top; returns the number of the ascent that this joins, -1 if given up, None at a top."""
        damping, failures, gain = _FIRST_DAMPING, 0, np.inf
        for iteration in range(_MAX_ITERATIONS):
            at = self._quadratic()
            if merging and (joined := self._explained()) is not None:
                return joined
            behind = max(other.value for other in self.known.values()) - at.value
            if not self.whole and iteration >= _PATIENCE and behind > max(_HOPELESS, _LEFT * gain):
                return -1
            if at.gain_left < tolerance or failures > 3:
                return None
            move = np.linalg.solve(at.hessian + damping * np.diag(np.diag(at.hessian)), at.gradient)
            move *= min(1.0, _FAR / np.abs(move).max())
            point = (at.coords + move)[None]
            runs = yield point
            reached = self._heights(point, runs, at.noise.coords)
            gain = reached[0].value - at.value if reached else -np.inf
            promised = float(at.gradient @ move - 0.5 * move @ at.hessian @ move)
            if gain > 0.0:
                self._here = reached[0]
            if gain > _STALLED:
                failures = 0
                damping *= 0.1 if gain > 0.5 * promised else 1.0
                # a model is asked everywhere: by secants 13 of 16 searches in 8 and 15 parameters lost one of two modes
                if self.target.data.differentiable or gain < _MISLED * promised and self.alone:
                    yield from self._own_differences(at, 1.0)
                continue
            failures += 1
            damping = max(30.0 * damping, _FIRST_DAMPING)
            # the first time, the run that gained nothing has corrected the secants
            if failures > 1:
                yield from self._own_differences(at, failures)
        return None

    def _own_differences(self, at: Ascent, factor: float) -> Requests:
        """Derivatives by differences with steps of a share of the standard deviations, times a factor."""
        spread = factor * _DIFFERENCE_SHARE * np.sqrt(np.diag(np.linalg.inv(at.hessian)))
        yield from self._derive(np.diag(np.clip(spread, *_DIFFERENCE_LIMITS)))

    def _explained(self) -> int | None:
        """Number of another ascent whose derivatives, at a higher point, predict the residuals here; None if none.

        The same mode then lies uphill of both.
        """
        archive, here = self.target.archive, self._here
        for number, other in self.known.items():
            move = here.coords - other.coords
            if (self.whole or np.abs(move).max() < _APART) and here.value < other.value:
                ours, theirs, predicted = archive.weights([here.run, other.run, move @ archive.weights(other.slopes)])
                error = archive.forms((ours - theirs - predicted)[None])[0, 0]
                if -error @ other.weights < _EXPLAINED:
                    return number
        return None

    def _connected(self) -> Requests:
        """Number of the ascent that a line without a valley leads to from nearly the same height; None if none. Without
        lines, searches on ridges find three to eight modes where one is; a lower ascent that goes on is no end.
        """
        here = self._here
        for number, end in list(self.known.items()):
            move = here.coords - end.coords
            near = abs(end.value - here.value) < HIGHER and (self.whole or np.abs(move).max() < _APART)
            if number == self.number or not near or (end.value < here.value - _DIP and not end.ended):
                continue
            close = min(move @ each.hessian @ move for each in (end, self.known[self.number])) <= _SAME_MODE
            if (close or (yield from self._level(end))) and number in self.known:  # it may have joined another one
                self.known[number] = max(end, self.known[self.number], key=lambda each: each.value)
                return number
        return None

    def _level(self, end: Ascent) -> Requests:
        """Whether one of the lines from the present point to an end has no valley."""
        for line in self.target.lines(self._here.coords, end.coords, _ALONG):
            for points in (line[1:2], line):  # most valleys show in the middle
                runs = yield points
                between = self._heights(points, runs, self._here.noise.coords)
                values = [self._here.value, *(each.value for each in between), end.value]
                lower = np.minimum(np.maximum.accumulate(values), np.maximum.accumulate(values[::-1])[::-1])
                if runs.failed.any() or (lower - values).max() >= _DIP:
                    break
            else:
                return True
        return False

    def _design(self, tolerance: float) -> Requests:
        """Steps of a standard deviation along all axes of the Laplace approximation, and a climb from there."""
        end = self.known[self.number]
        points = end.coords + axes_of(end)
        runs = yield points
        found = self._heights(points, runs, end.noise.coords)
        if not self.target.data.differentiable:
            yield from self._difference(points - end.coords, runs)
        # at a saddle, such as the axis of symmetry of an even response, a point of the design is higher
        higher = max(found, key=lambda each: each.value, default=end)
        if higher.value > end.value + tolerance:
            self._here = higher
        yield from self._climb(False, tolerance)


def axes_of(end: Ascent, free: float = 1.0) -> np.ndarray:
    """Steps (d, d) of a standard deviation along the axes of the Laplace approximation, in both directions in turn.

    Along directions that the data leave to the prior, steps have the length `free`.
    """
    values, vectors = np.linalg.eigh(end.hessian)
    lengths = np.where(values < _FREE, free, 1.0 / np.sqrt(np.maximum(values, 1.0)))
    return (vectors * ((-1.0) ** np.arange(len(values)) * lengths)).T


def _differences(runs: np.ndarray, run: int, n: int) -> np.ndarray:
    """Differences of the residuals of runs (m,) from a run, as weights (m, n) of the first n histories."""
    return 1.0 * (np.arange(n) == runs[:, None]) - (np.arange(n) == run)
