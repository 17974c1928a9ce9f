"""Evaluation of a posterior without barriers: points go out when they are submitted, and come back when they are done.

A sampler that proposes points while others still run keeps all workers of a pool busy, however different the durations
of the simulations are. A point passes through the parts of a `JointLikelihood` one after the other, as in a call of the
posterior, and a part is not simulated where an earlier one is -inf.
"""

import logging
import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import as_completed
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..priors.points import as_points
from ..priors.priors import Prior
from ..simulation.model import has_batch_method
from .joint import JointLikelihood
from .likelihood import FELikelihood
from .simulator import Simulation, Simulator, take_all

__all__ = ["EvaluationQueue"]

logger = logging.getLogger(__name__)


class _Point:
    """A submitted point, and the sum of its log-likelihoods so far."""

    __slots__ = ("log_likelihood", "log_prior", "row", "ticket")

    def __init__(self, ticket: int, row: np.ndarray, log_prior: float) -> None:
        self.ticket, self.row, self.log_prior = ticket, row, log_prior
        self.log_likelihood = 0.0


class _Part:
    """One likelihood, whose parameters are `columns` of the points, and the points that wait for its simulations."""

    def __init__(self, likelihood: FELikelihood, columns: list[int]) -> None:
        self.likelihood, self.simulator, self.columns = likelihood, likelihood.simulator, columns
        self.waiting: dict[bytes, tuple[Simulation, list[_Point]]] = {}

    @property
    def running(self) -> list[Simulation]:
        """Simulations that are waited for."""
        return [simulation for simulation, _ in self.waiting.values()]


class EvaluationQueue:
    """Queue of points at which a posterior is evaluated, see `Posterior.evaluation_queue`.

    Its methods are called from one thread. With a pool of the likelihood, each simulation is sent to it when the point
    is submitted, and duplicates are simulated once. Without a pool, or with one that has ``map`` only, `submit` waits
    for the simulations. With `responses`, the likelihood caches these as well, for its `simulate`.
    """

    def __init__(self, likelihood: FELikelihood | JointLikelihood, prior: Prior, responses: bool = False) -> None:
        self._prior, self._responses = prior, responses
        self._parts = [_Part(part, columns) for part, columns in likelihood.parts()]
        self._arrived: SimpleQueue = SimpleQueue()
        self._taken: list[Simulation] = []  # from the queue of arrivals
        self._finished: list[tuple[int, float]] = []
        self._collected: list[tuple[int, float]] = []  # last; the caller may not have received them
        self._tickets = self._pending = 0
        self._error: Exception | None = None
        self._closed = False

    def __enter__(self) -> "EvaluationQueue":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def workers(self) -> int | None:
        """Number of evaluations that run at once; None if a pool does not say."""
        pools = {id(part.simulator.pool): part.simulator.pool for part in self._parts}
        sizes = [getattr(pool, "n_workers", None) for pool in pools.values() if pool is not None]
        if not sizes:
            return (os.cpu_count() or 1) if any(has_batch_method(part.likelihood.model) for part in self._parts) else 1
        return None if None in sizes else sum(sizes)

    def submit(self, coords: Any) -> list[int]:
        """Submit points (n, ndim); returns n tickets, each of which `collect` returns once.

        Points outside the support of the prior, with impossible noise parameters, or whose simulations are cached, are
        finished at once. ValueError for another shape, RuntimeError if the queue is closed.
        """
        self._require_open()
        names = self._prior.names
        rows = np.array(as_points(coords, names))
        if rows.ndim != 2:
            raise ValueError(f"submit: expected points of shape (n, {len(names)}); got shape {rows.shape}")
        # row by row, so that the values are the same as for single points to the last bit
        log_prior = np.array([float(np.atleast_1d(self._prior.logpdf(row[None]))[0]) for row in rows])
        first, self._tickets = self._tickets, self._tickets + len(rows)
        self._pending += len(rows)
        possible = log_prior > -np.inf
        for part in self._parts:
            possible[possible] = part.likelihood.possible(rows[possible][:, part.columns])
        self._finished += [(first + int(place), -np.inf) for place in np.flatnonzero(~possible)]
        points = [_Point(first + int(place), rows[place], log_prior[place]) for place in np.flatnonzero(possible)]
        try:
            self._advance(0, points)
        except Exception as error:  # raised by `collect`
            self._error = self._error or error
        return list(range(first, self._tickets))

    def collect(self) -> list[tuple[int, float]]:
        """Wait until a point is finished; tickets and log-probabilities in the order in which the points finished.

        They are what `log_prob` returns for each point alone, to the last bit. RuntimeError if no point is pending or
        the queue is closed. What ends a call of the posterior (`TooManyFailures`, `StaleCache`, `ChangedModel`) is
        raised after the points that were finished before have been returned; simulations that have ended are cached.
        """
        self._require_open()
        if not self._pending:
            raise RuntimeError("no point is pending: submit points before collect()")
        self._receive(wait=False)
        while not self._finished:
            if self._error is not None:
                raise self._error
            for part in self._parts:
                if part.waiting:
                    part.simulator.check_failures()
            self._receive(wait=True)
        self._collected, self._finished = self._finished, []
        self._pending -= len(self._collected)
        return self._collected

    def ended(self) -> list[tuple[int, float]]:
        """Tickets and log-probabilities of points that have ended, including the last collected ones, without waiting.

        For a run that Ctrl-C ends, before `close`, so that finished points are kept. Errors are raised by `collect`.
        """
        self._require_open()
        for part in self._parts:
            # not all of them may have announced their end
            self._taken += [each for each in part.running if each.received or each.future.done()]
        self._receive(wait=False)
        return self._collected + self._finished

    def close(self) -> None:
        """Cancel points that the pool has not started; running ones are cached when they end. May be called twice."""
        for part in () if self._closed else self._parts:
            left = part.simulator.leave(part.running, running=False)
            if left:
                threading.Thread(target=_cache_rest, args=(part.simulator, left), daemon=True).start()
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError("the queue is closed: make another one with posterior.evaluation_queue()")

    def _advance(self, stage: int, points: Sequence[_Point]) -> None:
        """Evaluate points in one of the parts: at once if their simulations are cached, or cannot be submitted."""
        if not points:
            return
        part, simulator = self._parts[stage], self._parts[stage].simulator
        thetas = np.array([point.row[part.columns] for point in points])[:, : simulator.n_structural] + 0.0
        if not simulator.streams:
            if self._responses:
                simulator.simulate(thetas)
            self._pass_on(stage, points, simulator.statistics(thetas))
            return
        keys = [theta.tobytes() for theta in thetas]
        new = [place for place, key in enumerate(keys) if key not in part.waiting]
        found = dict(zip(new, simulator.request(thetas[new], self._responses, self._arrived), strict=True))
        for place, (key, point) in enumerate(zip(keys, points, strict=True)):
            if isinstance(found.get(place), np.ndarray):
                self._pass_on(stage, [point], [found[place]])
            else:
                part.waiting.setdefault(key, (found.get(place), []))[1].append(point)

    @interrupts_end_the_run()
    def _receive(self, wait: bool) -> None:
        """Take simulations that have ended; with `wait`, at least one."""
        self._taken += take_all(self._arrived, wait=wait and not self._taken)
        for stage, part in enumerate(self._parts):
            running = set(part.running)
            ended = [each for each in dict.fromkeys(self._taken) if each in running]
            with suppress(Exception):  # which is the error of each simulation
                part.simulator.receive(ended)
            for simulation in ended:
                _, points = part.waiting.pop(simulation.key)
                try:
                    if simulation.error is not None:
                        raise simulation.error
                    self._pass_on(stage, points, [simulation.statistics] * len(points))
                except Exception as error:
                    self._error = self._error or error
        self._taken.clear()

    def _pass_on(self, stage: int, points: Sequence[_Point], statistics: Iterable[np.ndarray]) -> None:
        """Pass points on to the next part, from the statistics (n_numbers,) of their simulations."""
        part, left = self._parts[stage], []
        for point, row in zip(points, statistics, strict=True):
            value = part.likelihood.of_statistics(point.row[None, part.columns], row[None])
            point.log_likelihood += float(value[0])
            if point.log_likelihood == -np.inf or stage + 1 == len(self._parts):
                self._finished.append((point.ticket, float(point.log_prior + point.log_likelihood)))
            else:
                left.append(point)
        self._advance(stage + 1, left)


def _cache_rest(simulator: Simulator, left: list[Simulation]) -> None:
    """Cache simulations of a closed queue when they end; in a thread."""
    running = {each.future: each for each in left}
    try:
        for future in as_completed(running):
            simulator.receive([running[future]])
    except Exception as error:
        logger.warning("simulations of a closed queue are not stored: %s", error)
