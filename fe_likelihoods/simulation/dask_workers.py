"""Watch over the workers of a dask cluster while simulations wait for them."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

__all__ = ["LONGEST_WITHOUT_WORKER", "WorkerWatch"]

logger = logging.getLogger(__name__)

SECONDS_BETWEEN_CHECKS = 5.0
SECONDS_TO_START = 60.0  # within which a worker of a cluster begins to run after it was asked for
SECONDS_TO_RETURN = 15.0  # within which a nanny starts the process of a worker again
# How long a map waits for a first or another worker of a cluster that has none [s]
LONGEST_WITHOUT_WORKER = 3600.0


class WorkerWatch:
    """Keeps a cluster from losing its workers for good, and ends a wait without workers.

    A cluster of dask closes the nanny of a worker that is absent at the instant 15 s after it was lost
    (``distributed.deploy.lost-worker-timeout``), and never starts it again: on a busy machine the new process may need
    longer, or a simulation has killed it once more. A cluster that has lost all of its workers in this way makes its
    client wait for ever. So such workers are asked for again. A worker that has never been here may still be starting,
    and is asked for again only after `SECONDS_TO_START`.

    A job of dask-jobqueue with several worker processes that has ended, as by its walltime or the lifetimes of its
    workers, is never noticed by the cluster, and adaptive scaling counts it as present. So jobs whose workers were here
    and are gone are submitted again. A job that waits in the queue of the machine is left alone.

    Parameters
    ----------
    client : dask.distributed.Client
        The client.
    futures : callable
        Returns the futures that are waited for; they are cancelled after `longest_wait` without any worker.
    longest_wait : float, optional
        How long a cluster may have no worker [s]; by default `LONGEST_WITHOUT_WORKER`.

    Attributes
    ----------
    gave_up : bool
        Whether the futures were cancelled for want of a worker.
    """

    def __init__(self, client: Any, futures: Callable[[], Sequence[Any]], longest_wait: float | None = None):
        self._client, self._futures, self._longest_wait = client, futures, longest_wait
        self._ends, self.gave_up = threading.Event(), False
        self._started: set = set()  # workers of the cluster that were here
        self._absent: dict[Any, float] = {}  # since when others were not
        self._seen: dict[Any, float] = {}  # when a worker of a job was last here

    @property
    def longest_wait(self) -> float:
        """How long a cluster may have no worker [s]."""
        return LONGEST_WITHOUT_WORKER if self._longest_wait is None else self._longest_wait

    @property
    def error(self) -> RuntimeError:
        """The error where `gave_up`."""
        return RuntimeError(
            f"the dask cluster has had no worker for {self.longest_wait:g} s: start workers or scale the cluster, or "
            "wait longer by DaskExecutor(client, longest_wait=...), and run again. Evaluations that are stored are not "
            "repeated"
        )

    def start(self) -> None:
        """Begin to watch, in a thread; what was seen before is known."""
        self._ends, self.gave_up = threading.Event(), False
        self._started |= set(getattr(getattr(self._client, "cluster", None), "workers", None) or ())
        arguments = (self._ends,)
        threading.Thread(target=self._watch, args=arguments, name="watch of dask workers", daemon=True).start()

    def stop(self) -> None:
        """End the watch."""
        self._ends.set()

    def _watch(self, ends: threading.Event) -> None:
        last_seen = time.monotonic()
        while not ends.wait(SECONDS_BETWEEN_CHECKS):
            with contextlib.suppress(Exception):  # the cluster or the client is closing
                self._restart_lost_workers(getattr(self._client, "cluster", None))
                if self._client.nthreads():
                    last_seen = time.monotonic()
            if time.monotonic() - last_seen > self.longest_wait:
                self.gave_up = True
                with contextlib.suppress(Exception):
                    self._client.cancel(self._futures(), force=True)
                return

    def _restart_lost_workers(self, cluster: Any) -> None:
        """Ask a cluster for the workers that it should have by its own specification, and has given up."""
        wanted, present = getattr(cluster, "worker_spec", None), getattr(cluster, "workers", None)
        if wanted is None or present is None:
            return
        groups = {name: spec["group"] for name, spec in wanted.items() if "group" in spec}
        ended = self._ended_jobs(cluster, groups) & set(present)
        given_up, late = self._missing(set(wanted) - set(groups), set(present))
        if not given_up and not late and not ended:
            return
        n_workers = sum(len(groups.get(name, " ")) for name in wanted)
        if given_up or ended:
            logger.warning(
                "The dask cluster has given up %d of its %d %s: starting them again",
                len(given_up) + len(ended),
                len(wanted),
                "jobs" if ended else "workers",
            )
        if late:
            logger.warning(
                "%d of %d workers of the dask cluster have not started within %g s: asking for them again",
                len(late),
                len(wanted),
                SECONDS_TO_START,
            )
        if ended:
            cluster.sync(cluster.scale_down, ended)
            for name in ended:
                del self._seen[name]
        cluster.scale(n_workers)

    def _missing(self, wanted: set, present: set) -> tuple[set, set]:
        """Workers that were here and are gone, and those that did not come within `SECONDS_TO_START`."""
        now, given_up = time.monotonic(), (self._started - present) & wanted
        self._started = present
        absent = {name: self._absent.get(name, now) for name in wanted - present}
        late = {name for name, since in absent.items() if now - since > SECONDS_TO_START}
        self._absent = absent | dict.fromkeys(given_up | late, now)  # they are asked for now
        return given_up, late

    def _ended_jobs(self, cluster: Any, groups: dict[Any, Sequence[str]]) -> set:
        """Jobs with several workers, by the suffixes of their names, of which none is left."""
        if not groups:
            return set()
        here, now = {worker["name"] for worker in cluster.scheduler_info["workers"].values()}, time.monotonic()
        for name, suffixes in groups.items():
            if any(f"{name}{suffix}" in here for suffix in suffixes):
                self._seen[name] = now
        return {name for name in groups if now - self._seen.get(name, now) > SECONDS_TO_RETURN}
