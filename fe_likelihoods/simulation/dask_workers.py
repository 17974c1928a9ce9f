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
SECONDS_TO_START = 60.0  # before the same workers are asked for again
# How long a map waits for a first or another worker of a cluster that has none [s]
LONGEST_WITHOUT_WORKER = 3600.0


class WorkerWatch:
    """Keeps a cluster from losing its workers for good, and ends a wait without workers.

    A cluster of dask closes the nanny of a worker that is absent at the instant 15 s after it was lost
    (``distributed.deploy.lost-worker-timeout``), and never starts it again: on a busy machine the new process may need
    longer, or a simulation has killed it once more. A cluster that has lost all of its workers in this way makes its
    client wait for ever. So such workers are asked for again.

    Parameters
    ----------
    client : dask.distributed.Client
        The client.
    futures : callable
        Returns the futures that are waited for; they are cancelled after `LONGEST_WITHOUT_WORKER` without any worker.

    Attributes
    ----------
    gave_up : bool
        Whether the futures were cancelled for want of a worker.
    """

    def __init__(self, client: Any, futures: Callable[[], Sequence[Any]]):
        self._client, self._futures = client, futures
        self._ends, self.gave_up = threading.Event(), False
        self._asked: tuple[set, float] = (set(), 0.0)

    @property
    def error(self) -> RuntimeError:
        """The error where `gave_up`."""
        return RuntimeError(
            f"the dask cluster has had no worker for {LONGEST_WITHOUT_WORKER:g} s: start workers or scale the "
            "cluster, and run again. Evaluations that are stored are not repeated"
        )

    def start(self) -> None:
        """Begin to watch, in a thread."""
        threading.Thread(target=self._watch, name="watch of dask workers", daemon=True).start()

    def stop(self) -> None:
        """End the watch."""
        self._ends.set()

    def _watch(self) -> None:
        last_seen = time.monotonic()
        while not self._ends.wait(SECONDS_BETWEEN_CHECKS):
            with contextlib.suppress(Exception):  # the cluster or the client is closing
                self._restart_lost_workers(getattr(self._client, "cluster", None))
                if self._client.nthreads():
                    last_seen = time.monotonic()
            if time.monotonic() - last_seen > LONGEST_WITHOUT_WORKER:
                self.gave_up = True
                with contextlib.suppress(Exception):
                    self._client.cancel(self._futures(), force=True)
                return

    def _restart_lost_workers(self, cluster: Any) -> None:
        """Ask a cluster for the workers that it should have by its own specification, and has given up."""
        wanted, present = getattr(cluster, "worker_spec", None), getattr(cluster, "workers", None)
        if wanted is None or present is None:
            return
        lost, (asked, when) = set(wanted) - set(present), self._asked
        if not lost or (lost <= asked and time.monotonic() - when < SECONDS_TO_START):
            return
        self._asked = lost, time.monotonic()
        logger.warning(
            "The dask cluster has given up %d of its %d workers: starting them again", len(lost), len(wanted)
        )
        cluster.scale(len(wanted))
