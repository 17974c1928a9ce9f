"""Failed simulations in the cache on disk: those that a later run need not repeat.

A failure that is an answer of the model is stored under a key of the model and the parameters, without the
measurements, so that it holds for any measurements. Faults of the infrastructure (see
`fe_likelihoods.simulation.faults`) are not stored: a later run simulates the point again.

A simulation that was stopped at a time limit is stored together with this limit. A later run with a longer limit
simulates it again. A run with the same or a shorter limit simulates it again once, because a busy machine may have been
the cause. After the second stop at one limit, it fails without a simulation in all runs with this limit or a shorter
one: a simulation that is too long costs every run its whole limit.
"""

from collections.abc import Callable, Sequence

import numpy as np

from .cache_rows import (
    MIN_STOPS,
    STORE_FAILURE,
    pack_failure,
    select_rows,
    simulation_keys,
    source_number,
    unpack_failure,
)
from .faults import TransientReason
from .fingerprint import simulation_fingerprint
from .model import Model
from .remarks import RemarkTable

__all__ = ["FailureTable"]


class FailureTable(RemarkTable):
    """Base of `SimulationCache`, which documents the attributes: the table of failures of its file."""

    retry_failures: bool
    _write: Callable[[str, list[tuple]], None]
    _drop: Callable[[str, list[bytes]], None]

    def store_failures(self, model: Model, thetas: np.ndarray, reasons: Sequence[str]) -> None:
        """Store failures of a model for any measurements, and simulations that were stopped at a time limit.

        Parameters
        ----------
        model : Model
        thetas : (n, n_structural) float
            Structural parameters.
        reasons : sequence of n str
            Reasons of failures; empty where the simulation succeeded. A `MisfitReason` is not stored, nor is a
            `TransientReason` without a time limit.
        """
        fingerprint = simulation_fingerprint(model)
        keys, source = simulation_keys(fingerprint, thetas), source_number(fingerprint)
        rows = [pack_failure(key, source, reason) for key, reason in zip(keys, reasons, strict=True)]
        if any(rows):
            self._write(STORE_FAILURE, [row for row in rows if row is not None])

    def look_up_failures(self, model: Model, thetas: np.ndarray) -> list[str]:
        """Look up failures of a model that are answers for any measurements.

        Parameters
        ----------
        model : Model
            Its attribute ``time_limit`` [s], if there is one, is compared with that of the stored failures.
        thetas : (n, n_structural) float
            Structural parameters.

        Returns
        -------
        list of n str
            Reasons; empty where the simulation has to be run.
        """
        if self.retry_failures:
            return [""] * len(thetas)
        limit = getattr(model, "time_limit", None) or np.inf
        keys = simulation_keys(simulation_fingerprint(model), thetas)
        query = "key, source, reason, time_limit, crc, stops FROM failures"
        found, bad = {}, []
        with self.file.lock:
            for *row, stops in self._try("read", lambda connection: select_rows(connection, keys, query), []):
                reason = unpack_failure(*row)
                if reason is None:
                    bad.append(row[0])
                elif not isinstance(reason, TransientReason) or (limit <= reason.time_limit and stops >= MIN_STOPS):
                    found[row[0]] = reason
            self._drop("failures", bad)
        return [found.get(key, "") for key in keys]
