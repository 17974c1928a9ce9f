"""Executors: the same ``map`` and ``submit`` for all pools, which run simulations in other processes or machines.

The rule for ``pool=``: None is this process, a whole number a `LocalPool` of that many processes. Any other object with
``map`` gets ``list(pool.map(function, items))``, and single items if it has ``submit``: executors of
concurrent.futures, loky, mpi4py.futures and dask, pools of multiprocessing and schwimmbad.

The function (model and measurements) is sent by value (`fe_likelihoods.simulation.by_value`): by a `LocalPool` to each
worker once, and again when anything that it uses has changed; by others with each item. Results are equal to the bit.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. A `LocalPool` has a
thread for each worker, which sends it one item at a time through a pipe, again if it dies. Workers are started with
`subprocess`: pool processes, in which they must also work, often may not use `multiprocessing`.
"""

import json
import math
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.pool import Pool, ThreadPool
from numbers import Integral
from queue import SimpleQueue
from typing import Any

from samplers.evaluation.pools import submit_all, was_cancelled, workers_of
from samplers.interrupts import Ended, SentFunction, become_worker

from .by_value import Pickled, load
from .failure_reasons import ClosedPool, SimulationFailed, TransientReason, describe_exit, is_transient, text_of
from .files import PLACE, Group, working_folder

__all__ = ["Job", "LocalPool", "PoolExecutor", "Sandbox", "Submitting", "Threads", "as_executor", "result_of", "serve"]

_CHECK = 0.5  # [s] between checks that a process lives, while waiting for its answer
_ONE_THREAD = {f"{each}_NUM_THREADS": "1" for each in ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")}
_BOOT = (
    "import json, sys; sys.path[:], sys.argv, fileno = json.loads(sys.argv[1]); "
    "from fe_likelihoods.simulation.executors import serve; serve(fileno)"
)


class Submitting:
    """Base class of executors, which have `submit_all` and `give_up`; `submits` if items are not run at once."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in order; ``(None, reason)`` for one that kills all its processes.

        ValueError for what cannot be sent or loaded. The first exception of the function gives up the other items.
        """
        found: dict[int, Any] = {}
        for each in self.as_they_end(function, list(items)):
            found |= each
        return [found[number] for number in range(len(found))]

    def as_they_end(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[dict[int, Any]]:
        """Results as from `map` by the number of their item, all that have ended meanwhile together.

        After an exception of the function, or an interrupt, the results of items that have ended precede it.
        """
        left, arrived, error = {}, SimpleQueue(), None
        try:
            left |= {each: number for number, each in enumerate(self.submit_all(function, items))}
            for future in list(left):
                future.add_done_callback(arrived.put)
            while left and error is None:
                found, error = _results(left, [arrived.get() for _ in range(max(1, arrived.qsize()))])
                yield found
        except (Exception, KeyboardInterrupt, SystemExit) as raised:
            closed = self.submits and isinstance(raised, RuntimeError) and not is_transient(raised)  # of `submit`
            error = ClosedPool() if closed else raised
        finally:
            self.give_up(list(left))
        if error is not None:
            yield _results(left, [each for each in left if each.done() and not each.cancelled()])[0]
            raise error

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future:
        """Future with the result of a function for one item, which can be cancelled until a process has it."""
        return self.submit_all(function, [item])[0]


def _results(left: dict[Any, int], ended: Sequence[Any]) -> tuple[dict[int, Any], BaseException | None]:
    """Results of futures that have ended, which are taken from those that are `left`, and the first exception."""
    found, error = {}, None
    for future in ended:
        number = left.pop(future)
        try:
            found[number] = result_of(future)
        except BaseException as raised:
            error = error or (ClosedPool() if was_cancelled(raised) else raised)
    return found, error


def result_of(future: Any, is_last: bool = False) -> Any:
    """The result of an item; raises what has ended the function in a pool, KeyboardInterrupt or SystemExit.

    Dask also gives up items that ran beside one that killed their worker: they are run once more, apart from it.
    """
    try:
        result = future.result()
    except Exception as error:
        if type(error).__name__ != "KilledWorker":
            raise
        if is_last:
            return None, TransientReason("the worker process died in every attempt of dask")
        future.retry()
        return result_of(future, True)
    if isinstance(result, Ended):
        raise result.error
    return result


class Job(Future):
    """An item with its function; the future of its result. `worker` is the one that has it."""

    def __init__(self, function: Any, item: Any) -> None:
        super().__init__()
        self.function, self.item, self.worker, self.given_up = function, item, None, False

    def settle(self, run: Callable[["Job"], Any]) -> None:
        """Set the result of a function for this job, or its error, unless the job was cancelled."""
        if self.set_running_or_notify_cancel():
            try:
                self.set_result(run(self))
            except BaseException as error:
                self.set_exception(error)


class Threads:
    """Daemon threads, for which Python does not wait at its end; each runs jobs by a function from ``make()``.

    They end with `close`, or when this object is garbage-collected.
    """

    def __init__(self, make: Callable[[], Callable[[Job], Any]]) -> None:
        self._make, self._jobs, self._lock = make, SimpleQueue(), threading.Lock()
        self._threads: list[threading.Thread] = []
        self.pending: weakref.WeakSet[Job] = weakref.WeakSet()  # and some that have ended
        weakref.finalize(self, self._jobs.put, None)

    def submit_all(self, jobs: Sequence[Job], most: int) -> None:
        """Run jobs in at most `most` threads; their `cancel` prevents it before."""
        with self._lock:
            self.pending.update(jobs)
            while len(self._threads) < min(most, len(self.pending)):
                thread = threading.Thread(target=_work, args=(self._jobs, self._make()), daemon=True)
                thread.start()
                self._threads.append(thread)
        for job in jobs:
            self._jobs.put(job)

    def close(self) -> None:
        """End the threads after the jobs that wait."""
        self._jobs.put(None)
        for thread in self._threads:
            thread.join()


def _work(jobs: SimpleQueue, run: Callable[[Job], Any]) -> None:
    while (job := jobs.get()) is not None:
        job.settle(run)
        job = None  # which must not be kept while this thread waits
    jobs.put(None)  # for the other threads


class Died(SimulationFailed):
    """A worker process that died, or was stopped, before it answered."""


class Worker:
    """Calls functions in one process after the other, from one thread; only `kill` may be called from others.

    A process that has died, or has had `most_calls`, is replaced at the next call. With `alone`, its output is not
    shown, and it has as many threads as this process.
    """

    def __init__(self, alone: bool = False, most_calls: float = math.inf) -> None:
        self._alone, self._most_calls = alone, most_calls
        self._process: subprocess.Popen | None = None

    def run(self, job: Job, seconds: float = math.inf) -> Any:
        """Result of a function for an item, or its exception; CancelledError if the job was given up before.

        Died if the process dies, or does not answer within `seconds` after it was given the item and is killed.
        """
        message = b"\0" + pickle.dumps(job.item, protocol=5)
        is_own = self._process is not None and self._owner == os.getpid()  # not of the process that has forked this one
        is_ready = is_own and self._process.poll() is None and self._calls < self._most_calls
        if not is_ready and not job.given_up:
            self._renew()
        if job.given_up:  # before, there was no process to kill
            raise CancelledError
        if self._function != job.function.payload:
            self._ask(b"\1" + job.function.payload, math.inf)
            self._function = job.function.payload
        self._calls += 1
        return self._ask(message, seconds)

    def run_until_it_ends(self, job: Job) -> Any:
        """Result as from `run`, from another process if one dies; ``(None, reason)`` after the third death."""
        job.worker = self
        try:
            for _ in range(3):
                try:
                    return self.run(job)
                except Died as error:
                    reason = error.reason
            return None, reason
        finally:
            job.worker = None

    def _renew(self) -> None:
        self.kill()
        self._connection, theirs = Pipe()
        output, self._group = subprocess.DEVNULL if self._alone else None, Group()
        texts = [[str(text) for text in texts] for texts in (sys.path, sys.argv)]
        with theirs:
            self._process = self._group.start(
                [sys.executable, "-c", _BOOT, json.dumps([*texts, theirs.fileno()])],
                env=({} if self._alone else _ONE_THREAD) | os.environ | {PLACE: self._group.place},
                pass_fds=(theirs.fileno(),),
                stdout=output,
                stderr=output,
                cwd=working_folder() or None,
            )
        readable = select.poll()  # kept, since Connection.poll makes one for each call
        readable.register(self._connection, select.POLLIN)
        self._poll = readable.poll
        self._function, self._calls, self._owner = None, 0, os.getpid()

    def _ask(self, message: bytes, seconds: float) -> Any:
        """Answer to a message, a value or an exception; raises `Died` without one, and the process is killed."""
        stop = time.monotonic() + seconds
        try:
            self._connection.send_bytes(message)
            # a program that the function has started may hold the connection open
            while not self._poll(1000.0 * max(0.0, min(_CHECK, stop - time.monotonic()))):
                if self._process.poll() is not None and not self._poll(0):
                    raise EOFError
                if time.monotonic() >= stop:
                    raise Died(TransientReason(f"stopped at the time limit of {seconds:g} s"))
            value, error = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5.0)  # it may end by itself, with its exit code
            self.kill()
            raise Died(TransientReason(describe_exit(self._process.wait(), "the worker process"))) from None
        except BaseException:
            self.kill()
            raise
        if error is not None:
            raise error
        return value

    def kill(self) -> None:
        """Kill the process and its group."""
        if self._process is not None and self._owner == os.getpid():
            self._group.end()


class LocalPool(Submitting, AbstractContextManager):
    """Pool of local processes.

    The processes start with the first items, and end with `close` or this process. One that dies is replaced and its
    item run again, given up after the third death. Linear algebra and numba use one thread per process, unless
    environment variables such as OMP_NUM_THREADS are set. Lambdas and functions of a script or notebook can be used.
    Likelihoods and samplers can share a pool, also in several threads.

    Parameters
    ----------
    workers : int
        Number of processes; ValueError if it is not a positive whole number.
    """

    other_processes = True
    submits = True

    def __init__(self, workers: int) -> None:
        if not isinstance(workers, Integral) or isinstance(workers, bool) or workers < 1:
            raise ValueError(
                "pool must be None, a positive number of processes, or an object with map(function, items); "
                f"got {workers!r}"
            )
        self.n_workers = int(workers)  # items that run at once
        self._threads: dict[int, Threads] = {}  # by the process, since a fork copies it

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> tuple:
        return type(self), (self.n_workers,)

    def close(self) -> None:
        """Give up all items and end the processes; a later item starts new processes."""
        if threads := self._threads.pop(os.getpid(), None):
            self.give_up(list(threads.pending))
            threads.close()

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the function cannot be sent to the processes."""
        pickled = Pickled.of(function)  # each time: the values that it uses may have changed
        jobs = [Job(pickled, item) for item in items]
        threads = self._threads.setdefault(os.getpid(), Threads(lambda: Worker().run_until_it_ends))
        threads.submit_all(jobs, self.n_workers)
        return jobs

    def give_up(self, futures: Sequence[Future]) -> None:
        """Cancel items, and kill the processes that run them. Items with results keep them."""
        started = [job for job in futures if not job.cancel() and not job.done()]
        for job in started:
            job.given_up = True  # before the question for its process: one of the two threads sees what the other did
            if (worker := job.worker) is not None:
                worker.kill()
        wait(started)


def as_executor(pool: Any, model: Any = None) -> "LocalPool | PoolExecutor | None":
    """Executor for a pool, by the rule above; None for None.

    ValueError if `pool` is of no such kind, or its workers are other processes and the model cannot be sent to them.
    """
    if pool is not None and not isinstance(pool, Submitting):
        pool = PoolExecutor(pool) if hasattr(pool, "map") else LocalPool(pool)
    if pool is not None and pool.other_processes:
        Pickled.of(model)
    return pool


class PoolExecutor(Submitting):
    """Executor for any object with ``map(function, items)``.

    A `multiprocessing.Pool` replaces a process that dies but does not run its item again, so the call never returns.
    """

    def __init__(self, pool: Any) -> None:
        self.pool, self.submits = pool, hasattr(pool, "submit")
        is_known = isinstance(pool, Executor | Pool) and not isinstance(pool, ThreadPoolExecutor | ThreadPool)
        self.other_processes = is_known or hasattr(pool, "gather")  # as far as that is known

    @property
    def n_workers(self) -> int | None:
        """Number of items that run at once; None if the pool does not say."""
        return workers_of(self.pool)

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; they have ended if the pool only has ``map``."""
        by_value = Pickled.of(function) if self.other_processes else Pickled(function)
        if self.submits and len(items):
            return submit_all(self.pool, by_value, items)
        futures = [Future() for _ in items]
        for future, result in zip(futures, self.pool.map(SentFunction(by_value), list(items)), strict=True):
            future.set_result(result)
        return futures

    def give_up(self, futures: Sequence[Future]) -> None:
        """Cancel items that the pool has not started."""
        for future in futures:
            future.cancel()


class Sandbox(threading.local):
    """Callable that runs a function of one argument in another process, whose output is not shown.

    Each thread has a process of its own, replaced after a call that did not end by itself, and after `runs_per_process`
    calls. The function is sent in its state at the call. `time_limit` [s] is without the start of the process.
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        time_limit: float | None = None,
        runs_per_process: int | None = None,
    ) -> None:
        Pickled.of(function)  # an error is raised here instead of in the first call
        self._arguments = function, time_limit, runs_per_process
        self._worker = Worker(True, runs_per_process or math.inf)

    def __reduce__(self) -> tuple:
        return Sandbox, self._arguments

    def __call__(self, item: Any) -> Any:
        """Result of the function for an item, or its exception; SimulationFailed if the process died or was stopped."""
        function, limit, _ = self._arguments
        return self._worker.run(Job(Pickled.of(function), item), limit or math.inf)


# in the worker ------------------------------------------------------------------------------------------------------


def serve(fileno: int) -> None:
    """Main loop of a worker process: answer functions to load, and items for them, until the connection closes."""
    os.set_inheritable(fileno, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which ends this process
    become_worker()
    function, me = None, os.getpid()
    with Connection(fileno) as connection:
        while True:
            try:
                message = memoryview(connection.recv_bytes())
            except (EOFError, OSError):
                return
            try:
                if message[0]:
                    function = load(bytes(message[1:]))
                answer = _packed(None if message[0] else function(pickle.loads(message[1:])))
            except BaseException as error:
                answer = _packed(None, error)
            if os.getpid() != me:  # the function has forked, and its copy has returned as well
                os._exit(0)
            connection.send_bytes(answer)


def _packed(value: Any, error: BaseException | None = None) -> bytes:
    """Pickled value and error; if they cannot be pickled, a `SimulationFailed` with the text of the error, or why."""
    try:
        data = pickle.dumps((value, error), protocol=5)
        if error is not None:
            pickle.loads(data)  # exceptions with custom constructors can often be pickled but not unpickled
        if error is None or isinstance(error, Exception | KeyboardInterrupt):  # which ends the run
            return data
    except Exception as failure:
        error = error or failure
    text = text_of(error)
    return pickle.dumps((None, SimulationFailed(TransientReason(text) if is_transient(error) else text)), protocol=5)
