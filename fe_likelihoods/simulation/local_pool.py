"""Pool of processes of this machine that survives the death of its workers.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. Here each worker
has a pipe of its own, so it is known which item every process was running. Only that item is run again, and it is given
up after the third time.

A thread of this process sends the items and receives the results, so that workers get their next item while the main
thread computes. It lives as long as there are items.
"""

import math
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, Future
from concurrent.futures import wait as wait_for
from multiprocessing import Pipe
from multiprocessing.connection import wait
from typing import Any

from .faults import ChangedModel, raise_if_refused
from .processes import PickledFunction, RunFailed, Worker, WorkerReply

__all__ = ["LocalPool", "Outcome"]

MAX_ATTEMPTS = 3
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure; mapped functions return this."""


class _Job(Future):
    """An item with its function; the future of its result."""

    def __init__(self, function: PickledFunction, source: Any, item: Any) -> None:
        super().__init__()
        self.function, self.source, self.item = function, source, item
        self.deaths = 0
        self.given_up = False


def _is_positive_whole(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and int(value) == value and value >= 1
    except (TypeError, ValueError, OverflowError):
        return False


class LocalPool:
    """Pool of processes of this machine.

    The processes start with the first item. They end with `close`, when this object is garbage-collected, or when this
    process exits, even if it is killed. A process that dies is replaced and its item run again; the other items are not
    affected. Linear algebra and numba use one thread per process, unless environment variables such as
    OMP_NUM_THREADS say otherwise.

    A pool can be shared by several likelihoods, and can be the ``pool=`` of samplers. Its methods may be called from
    several threads.

    Parameters
    ----------
    workers : int
        Number of processes.
    runs_per_process : int, optional
        Number of items after which a process is replaced by a new one, which limits the memory that leaks in compiled
        code of a model; never by default.

    Raises
    ------
    ValueError
        If `workers` or `runs_per_process` is not a positive whole number.
    """

    other_processes = True
    submits = True

    def __init__(self, workers: int, runs_per_process: int | None = None) -> None:
        if not _is_positive_whole(workers):
            raise ValueError(
                "pool must be None, a positive number of processes, or an object with map(function, items); "
                f"got {workers!r}"
            )
        if runs_per_process is not None and not _is_positive_whole(runs_per_process):
            raise ValueError(
                f"LocalPool: runs_per_process must be None or a positive whole number; got {runs_per_process!r}"
            )
        self.workers = int(workers)
        self.runs_per_process = None if runs_per_process is None else int(runs_per_process)
        self._environment = {
            f"{library}_NUM_THREADS": "1" for library in _THREADS if f"{library}_NUM_THREADS" not in os.environ
        }
        self._set_up()

    def _set_up(self) -> None:
        self._owner, self._lock = os.getpid(), threading.RLock()
        self._waiting: deque[_Job] = deque()
        self._running: dict[Worker, _Job | None] = {}  # each worker's job, None while it loads a function
        self._free: list[Worker] = []
        self._deaths_loading: Counter[bytes] = Counter()  # in succession, by function
        self._thread: threading.Thread | None = None
        self._woken, self._wake = Pipe(duplex=False)
        self._finished: list[tuple[_Job, Any, BaseException | None]] = []  # with a result or an error, not yet set
        self._is_woken = self._gives_up = (
            False  # the thread has been sent a message; jobs that were started are given up
        )
        self._idle_ended: threading.Event | None = None  # the thread is to end processes without an item, and to set it
        self._last: tuple[Any, PickledFunction | None] = None, None  # the function that was submitted last

    def __enter__(self) -> "LocalPool":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> tuple:
        return type(self), (self.workers, self.runs_per_process)

    @property
    def n_workers(self) -> int:
        """Number of items that run at once."""
        return self.workers

    def close(self) -> None:
        """Give up all items and end the processes; another item starts new ones."""
        self._notice_fork()
        with self._lock:
            left = [*self._waiting, *filter(None, self._running.values())]
        self.give_up(left)
        with self._lock:
            if self._thread is None or threading.current_thread() is self._thread:
                self._end_idle()
                return
            ended = self._idle_ended = self._idle_ended or threading.Event()
            self._wake_thread()
        ended.wait()

    def _end_idle(self) -> None:
        """End the processes that have no item: those that are free, and those that load a function."""
        for worker in [worker for worker, job in self._running.items() if job is None]:
            self._end(worker)
        while self._free:
            self._free.pop().kill()
        if self._idle_ended is not None:
            self._idle_ended.set()
            self._idle_ended = None

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in their order; they run before items that were submitted.

        An item whose process died three times gets the `Outcome` ``(None, reason)``.

        Raises
        ------
        ValueError
            If the function or an item cannot be sent to the processes, or the function cannot be loaded there.
        RuntimeError
            If three processes in succession die before they are given an item.
        Exception
            The first exception that `function` raises; no further items are started.
        """
        jobs = self._enqueue(PickledFunction.of(function), function, list(items), first=True)
        try:
            for job in wait_for(jobs, return_when=FIRST_EXCEPTION).done:
                job.result()
            return [job.result() for job in jobs]
        except BaseException:
            self.give_up(jobs)
            raise

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future:
        """Future of the result of a function for one item, as `map` gives it.

        ``cancel()`` of the future has an effect until the item is sent to a process.
        """
        return self.submit_all(function, [item])[0]

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as of `submit` for several items.

        The function is pickled again if it is another object than in the last call.

        Raises
        ------
        ValueError
            If the function cannot be sent to the processes.
        """
        last, pickled = self._last
        if pickled is None or last is not function:
            pickled = PickledFunction.of(function)
            self._last = function, pickled
        return self._enqueue(pickled, function, items)

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, the processes of those that run are killed. Results that are there are kept."""
        self._notice_fork()
        for job in futures:
            if not job.cancel() and running:
                job.given_up = True
        with self._lock:
            if self._thread is None:
                return
            self._gives_up = True
            self._wake_thread()
        if threading.current_thread() is not self._thread:
            wait_for([job for job in futures if job.given_up])

    def _notice_fork(self) -> None:
        """In a forked process: forget the parent's workers and thread."""
        if self._owner != os.getpid():
            self._set_up()

    def _enqueue(
        self, pickled: PickledFunction, function: Any, items: Sequence[Any], first: bool = False
    ) -> list[_Job]:
        self._notice_fork()
        pickled.script()  # raises here what would be raised in the thread
        jobs = [_Job(pickled, function, item) for item in items]
        if not jobs:
            return jobs
        with self._lock:
            if first:
                self._waiting.extendleft(reversed(jobs))
            else:
                self._waiting.extend(jobs)
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="LocalPool", daemon=True)
                self._thread.start()
            else:
                self._wake_thread()
        return jobs

    def _wake_thread(self) -> None:
        """End the thread's wait for replies; one message at a time, so that the pipe cannot be full."""
        if not self._is_woken:
            self._is_woken = True
            self._wake.send_bytes(b"")

    # in the thread ------------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        """Send items and receive results until there are none."""
        try:
            while True:
                with self._lock:
                    if self._idle_ended is not None:
                        self._end_idle()
                    self._start_jobs()
                    finished, self._finished = self._finished, []
                    ends = not self._running
                    if ends:
                        self._thread = None
                    connections = [self._woken, *(worker.connection for worker in self._running)]
                for job, result, error in finished:
                    _fail(job, error) if error is not None else job.set_result(result)
                if ends:
                    return
                woken = self._woken in wait(connections, timeout=1.0)
                with self._lock:
                    if woken:
                        self._woken.recv_bytes()
                        self._is_woken = False
                    self._receive()
        except BaseException as error:  # such as an operating system that starts no process
            with self._lock:
                self._thread = None
                left = [job for job, _, _ in self._finished]
                left += [*self._waiting, *filter(None, self._running.values())]
                for worker in self._running:
                    worker.kill()
                self._finished = []
                self._waiting.clear()
                self._running.clear()
                self._end_idle()
            for job in left:
                _fail(job, error)

    def _start_jobs(self) -> None:
        """Give free workers their next items, and start as many workers as there are items for."""
        loading = sum(job is None for job in self._running.values())
        while self._waiting and len(self._running) < self.workers:
            if self._waiting[0].cancelled():
                self._waiting.popleft()
                continue
            function = self._waiting[0].function
            is_loaded = any(worker.key == function.key and worker.alive for worker in self._free)
            if loading >= len(self._waiting) and not is_loaded:  # else an item would wait although a worker is free
                return
            worker = self._take(function.key)
            if worker.key == function.key:
                self._next(worker)
            else:
                self._running[worker] = None
                worker.load(function)
                loading += 1

    def _take(self, key: bytes) -> Worker:
        """An idle process, preferably with the function of a key, or a new one."""
        self._free.sort(key=lambda worker: worker.key == key)
        while self._free:
            worker = self._free.pop()
            if worker.alive:
                return worker
        return Worker(self._environment)

    def _next(self, worker: Worker) -> None:
        """Send the next item to a worker that has loaded its function, or make the worker idle."""
        self._running.pop(worker, None)
        if worker.runs >= (self.runs_per_process or math.inf):
            worker.kill()  # another one is started if items are waiting
            return
        for place, job in enumerate(self._waiting):
            if job.function.key != worker.key or job.cancelled():
                continue
            if job.running() or job.set_running_or_notify_cancel():
                del self._waiting[place]
                try:
                    worker.submit(job.item)
                except Exception as error:  # the item cannot be pickled
                    self._finished.append((job, None, error))
                    worker.kill()
                else:
                    self._running[worker] = job
                return
        self._free.append(worker)

    def _receive(self) -> None:
        """Take what the workers have answered, and the results of those that have died."""
        if self._gives_up:  # jobs that wait for another attempt cannot be cancelled
            self._gives_up = False
            self._finished += [(job, None, CancelledError()) for job in self._waiting if job.given_up]
            self._waiting = deque(job for job in self._waiting if not job.given_up)
        for worker, job in list(self._running.items()):
            if job is not None and job.given_up:
                self._end(worker)
                self._finished.append((job, None, CancelledError()))
                continue
            try:
                reply = worker.receive()
            except RunFailed as error:
                del self._running[worker]
                self._died(worker.key, job, error.reason)
                continue
            except BaseException as error:  # a reply whose unpickling raises
                reply = WorkerReply("raised", error)
            if reply is None:
                continue
            if job is not None:
                failed = reply.kind == "raised"
                self._finished.append((job, None, reply.value) if failed else (job, reply.value, None))
            elif reply.kind == "loaded":
                self._deaths_loading[worker.key] = 0
            else:
                self._end(worker)
                self._drop(worker.key, lambda job, reply=reply: _unusable(job.source, reply))
                continue
            self._next(worker)

    def _end(self, worker: Worker) -> None:
        del self._running[worker]
        worker.kill()

    def _died(self, key: bytes, job: _Job | None, reason: str) -> None:
        """Count the death of a worker: put its item first in the queue, or give it up."""
        if job is None:
            self._deaths_loading[key] += 1
            if self._deaths_loading[key] == MAX_ATTEMPTS:
                del self._deaths_loading[key]
                text = f"{reason} while loading the model; see its output on stderr"
                self._drop(key, lambda _: RuntimeError(text))
            return
        job.deaths += 1
        if job.deaths == MAX_ATTEMPTS:
            self._finished.append((job, (None, reason), None))
        elif job.given_up:
            self._finished.append((job, None, CancelledError()))
        else:
            self._waiting.appendleft(job)

    def _drop(self, key: bytes, error: Callable[[_Job], Exception]) -> None:
        """Remove the waiting items of a function that cannot be used."""
        self._finished += [(job, None, error(job)) for job in self._waiting if job.function.key == key]
        self._waiting = deque(job for job in self._waiting if job.function.key != key)


def _fail(job: _Job, error: BaseException) -> None:
    """Set the exception of a job, whether it was started or not."""
    if job.running() or (not job.cancelled() and job.set_running_or_notify_cancel()):
        job.set_exception(error)


def _unusable(function: Any, reply: WorkerReply) -> Exception:
    """The error for a function that cannot be loaded in a worker."""
    try:
        raise_if_refused(str(reply.value))
    except ChangedModel as error:
        return error
    return ValueError(f"{function!r} cannot be loaded in a worker process: {reply.value}")
