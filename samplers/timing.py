"""Timed evaluations of a posterior before a run, without the start of its workers and without cached points."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Draws", "TimedEvaluations", "time_evaluations"]

FIRST_POINTS = 8  # most points that start the workers, as long as it is not known that a point is cheap
LONG = 60.0  # [s], from which a point is not cheap
SECONDS_OF_CACHED = 10.0  # for points that need no simulation, before the search for others ends [s]


class Draws:
    """Draws of the prior that are taken one after the other: those of the sampler, then others.

    Parameters
    ----------
    draws : (n, ndim) float
        Those of the sampler.
    draw_others : callable
        Returns further draws (m, ndim).

    Attributes
    ----------
    size : int
        Number of those of the sampler.
    left : int
        Number of those that were not taken.
    further : int
        Number of others that were taken.
    """

    def __init__(self, draws: np.ndarray, draw_others: Callable[[], np.ndarray]) -> None:
        self._draws, self._draw_others, self._taken = draws, draw_others, 0
        self.size = len(draws)

    @property
    def left(self) -> int:
        """See above."""
        return max(self.size - self._taken, 0)

    @property
    def further(self) -> int:
        """See above."""
        return max(self._taken - self.size, 0)

    def take(self, number: int) -> np.ndarray:
        """The next points (number, ndim)."""
        while len(self._draws) < self._taken + number:
            self._draws = np.concatenate([self._draws, np.asarray(self._draw_others(), dtype=float)])
        self._taken += number
        return self._draws[self._taken - number : self._taken]


class TimedEvaluations(NamedTuple):
    """Evaluations that were made.

    Attributes
    ----------
    points : (n, ndim) float
        The points, in the order of their evaluation.
    values : (n,) float
        Their log-probabilities.
    cached : int
        How many of them needed no new simulation.
    seconds : (runs,) float
        Durations of the timed ones [s].
    workers : int or None
        Number of workers after their start, if it is known.
    """

    points: np.ndarray
    values: np.ndarray
    cached: int
    seconds: np.ndarray
    workers: int | None


class _Timer:
    """Evaluates points, and tells those that are simulated from those that are cached.

    Parameters
    ----------
    posterior : callable
        Its ``report()``, if it has one, counts ``simulations``.
    draws : callable
        Returns a number of further points (n, ndim).
    """

    def __init__(self, posterior: Any, draws: Callable[[int], np.ndarray]) -> None:
        self._posterior, self._draws = posterior, draws
        self._queue = posterior.evaluation_queue() if callable(getattr(posterior, "evaluation_queue", None)) else None
        self._report = getattr(posterior, "report", None)
        self.points: list[np.ndarray] = []
        self.values: list[float] = []
        self.cached: list[float] = []  # durations [s]
        self.searched = 0.0  # time in which nothing was simulated [s]

    @property
    def workers(self) -> int | None:
        """Number of evaluations at once, if it is known."""
        return None if self._queue is None else self._queue.workers

    def evaluate(self, number: int) -> list[float]:
        """Durations [s] of the simulated ones of a number of points, which are evaluated at the same time."""
        points, before = self._draws(number), self._counts()
        evaluated = [_timed_call(self._posterior, x) for x in points] if self._queue is None else self._collect(points)
        simulations, verifications = (now - then for now, then in zip(self._counts(), before, strict=True))
        self.points += list(points)
        self.values += [value for _, value in evaluated]
        seconds = [duration for duration, _ in evaluated]
        # of some that are cached and some that are not, those that took longest were simulated
        longest = sorted(range(number), key=seconds.__getitem__, reverse=True)
        simulated = set(longest if self._report is None else longest[: int(simulations)])
        self.cached += [duration for row, duration in enumerate(seconds) if row not in simulated]
        self.searched += max(seconds) if not simulated and not verifications else 0.0
        return [duration for row, duration in enumerate(seconds) if row in simulated]

    def _counts(self) -> tuple[int, int]:
        """Simulations of the posterior so far, and rows of its cache that were compared with another simulation."""
        reported = {} if self._report is None else self._report()
        if "simulations" not in reported:
            self._report = None
        return reported.get("simulations", 0), reported.get("verifications", 0)

    def _collect(self, points: np.ndarray) -> list[tuple[float, float]]:
        """Times [s] from the submission of points (n, ndim) to their arrival, and their log-probabilities."""
        start, arrived = time.perf_counter(), {}
        tickets = self._queue.submit(points)
        while len(arrived) < len(tickets):
            finished = self._queue.collect()
            now = time.perf_counter() - start
            arrived.update({ticket: (now, value) for ticket, value in finished})
        return [arrived[ticket] for ticket in tickets]

    def close(self) -> None:
        """Close the queue."""
        if self._queue is not None:
            self._queue.close()


def time_evaluations(posterior: Any, draws: Draws, runs: int) -> TimedEvaluations:
    """Time a number of evaluations after the start of the workers.

    First, one point for each worker is evaluated at the same time, at most `FIRST_POINTS`. This is repeated where more
    workers are there afterwards, and for all workers where no point took longer than `LONG`. Then `runs` points are
    timed, one after the other, or at the same time where they are longer. Points whose simulations are cached start no
    worker and are not timed; if there are no others, the durations are theirs.

    Parameters
    ----------
    posterior : callable
        Log-posterior of a point, with a method ``evaluation_queue`` where it has a pool.
    draws : Draws
        Where the points are taken from.
    runs : int
        Number of durations, at least 2.

    Returns
    -------
    TimedEvaluations
    """
    timer = _Timer(posterior, draws.take)
    try:
        started, most, waited = 0, FIRST_POINTS, []
        while started < min(timer.workers or 1, most) and timer.searched < SECONDS_OF_CACHED:
            room = draws.left - runs if draws.left > runs else 0
            if waited and not room or draws.further >= draws.size:
                break
            size = min(timer.workers or 1, most, room or FIRST_POINTS)
            if new := timer.evaluate(size):
                waited, started = new, size
                most = FIRST_POINTS if max(waited) > LONG else draws.size
        seconds: list[float] = []
        at_once = bool(waited) and min(waited) > LONG and started >= runs
        while len(seconds) < runs and timer.searched < SECONDS_OF_CACHED and draws.further < draws.size:
            seconds += timer.evaluate(runs - len(seconds) if at_once else 1)
        if len(seconds) < 2:
            seconds = (timer.cached + seconds)[-runs:]
        return TimedEvaluations(
            np.array(timer.points), np.array(timer.values), len(timer.cached), np.array(seconds), timer.workers
        )
    finally:
        timer.close()


def _timed_call(posterior: Callable, point: np.ndarray) -> tuple[float, float]:
    start = time.perf_counter()
    value = float(np.ravel(posterior(point))[0])
    return time.perf_counter() - start, value
