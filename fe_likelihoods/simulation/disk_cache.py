"""Cache of simulations on disk, shared by runs, samplers, processes and programs.

The sums of squared residuals of a simulation are stored, one number per channel. They depend neither on the noise nor
on the prior, so one simulation serves every noise level, every tempering stage and every sampler. The key of a
simulation is a digest of everything its sums depend on: fingerprints of model, record and measurements, the source
files of the model, and the structural parameters to the last bit. After any change the key is another one, so stored
results never have to be invalidated. Results that are no longer used are evicted in the end, oldest first.

Hits are exact. They occur when only the noise parameters change, in resumed and repeated runs, for duplicates, and when
samplers are compared from the same start.

Responses are stored where they were requested, as a guide does, or for every simulation. They depend on the model alone
and are stored as computed, in double precision. In single precision, a response with an offset of a million times its
noise would lose its digits, and the cache knows neither noise nor measurements. Compression without loss would save 10
to 25 % of their size and is not used.

Failures are stored as well if they are answers of the model (`fe_likelihoods.simulation.failure_table`).

A cache never makes a run fail. A row that does not match its checksum is simulated again, a damaged file is moved
aside, and while the file cannot be written, rows wait in memory.
"""

import logging
import os
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from .cache_exchange import read_rows, write_rows
from .cache_rows import (
    COLUMNS,
    STORE,
    STORE_RESPONSE,
    CachedRows,
    CacheInfo,
    StoredSimulation,
    checksum,
    insert_rows,
    is_undamaged,
    pack_row,
    select_rows,
    simulation_keys,
    source_number,
)
from .faults import TransientReason
from .fingerprint import simulation_fingerprint
from .model import Model
from .row_deletion import RowDeletion
from .sqlite_file import CacheFile

__all__ = ["SimulationCache"]

logger = logging.getLogger(__name__)

MAX_WAITING_ROWS = 100_000  # rows kept in memory while the file cannot be written


class SimulationCache(RowDeletion):
    """Cache of the sums of squared residuals of simulations, in one SQLite file.

    Any number of threads, processes and programs may use a file at the same time, each process through its own
    connection. The object may be forked and pickled: another process opens the file by its path. The file must be on a
    local disk, because SQLite's shared memory does not work on network file systems. On a cluster let the parent
    process own the cache (``FELikelihood(..., pool=...)``); its workers return sums.

    Stored rows survive the death of the process, also by ``kill -9``; a power failure may lose the last seconds.

    Parameters
    ----------
    path : path
        The file; created if it does not exist. A read-only file is used for reading, with a warning.
    max_rows : int
        Largest number of stored simulations, of about 160 bytes each. Every write evicts the oldest beyond it.
    retry_failures : bool
        Run failed simulations again, after a change that no fingerprint contains (an external program, a licence).
    responses : bool
        Store the response of every simulation. By default only the responses that are requested are stored
        (`FELikelihood.simulate`, guides).
    max_response_bytes : int
        Largest size of the stored responses [bytes], at 8 bytes per channel and sample. The oldest are evicted, with a
        message at level INFO at the first one.
    timeout : float
        How long to wait for another writer [s].
    verify : bool
        Whether likelihoods simulate some of the stored rows again before they use the others (see
        `fe_likelihoods.simulation.verification`): two rows per process, and one of every 1000.
    tolerance : float, optional
        Accepted difference of a response that is simulated again, relative to the norm of the response. By default 0
        for the compiled models of this library and 1e-9 for other models, or their attribute ``response_tolerance``.

    Attributes
    ----------
    hits, misses : int
        Rows found and not found by this object in this process.
    evictions : int
        Rows evicted by this object.
    damaged : int
        Rows that were damaged and deleted.
    verified : int
        Rows that were simulated again by likelihoods in this process and did not differ.
    file : CacheFile
        The SQLite file and its connection.
    retry_times : dict of str to float
        Actions on the file that failed, and the monotonic time [s] before which they are not tried again.

    Raises
    ------
    ValueError
        If a bound is not positive, if the tolerance is negative, if the path is a folder or in no existing folder, or
        if the file cannot be read or created, is not a cache, belongs to another program, or has the layout of another
        release. Such a file is not changed.

    Examples
    --------
    >>> likelihood = FELikelihood(model, measurements, cache="column.sqlite")
    >>> likelihood.cache.info().simulations
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        max_rows: int = 1_000_000,
        retry_failures: bool = False,
        responses: bool = False,
        max_response_bytes: int = 2**30,
        timeout: float = 30.0,
        verify: bool = True,
        tolerance: float | None = None,
    ) -> None:
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"SimulationCache: expected the path of a file; got {path!r}")
        for name, value in (("max_rows", max_rows), ("max_response_bytes", max_response_bytes)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"SimulationCache: {name} must be a whole number of 1 or more; got {value!r}")
        if tolerance is not None and not 0.0 <= tolerance < np.inf:
            raise ValueError(f"SimulationCache: tolerance must be a number of 0 or more, or None; got {tolerance!r}")
        bounds = int(max_rows), bool(retry_failures), bool(responses), int(max_response_bytes)
        self._set_up(path, *bounds, timeout, bool(verify), tolerance)
        self.file.check()
        if not self.file.writable:
            self._warn_read_only()

    def _set_up(
        self, path, max_rows, retry_failures, responses, max_response_bytes, timeout, verify, tolerance
    ) -> None:
        """Set all attributes without opening the file."""
        super().__init__(CacheFile(path, timeout))
        self.max_rows = max_rows
        self.retry_failures = retry_failures
        self.responses = responses
        self.max_response_bytes = max_response_bytes
        self.verify, self.tolerance = verify, tolerance
        self.hits = self.misses = self.evictions = self.damaged = self.verified = 0
        self._waiting: list[tuple] = []
        self._warned_read_only = self._said_evicted = False

    def __getstate__(self) -> tuple:
        return (
            self.path,
            self.max_rows,
            self.retry_failures,
            self.responses,
            self.max_response_bytes,
            self.file.timeout,
            self.verify,
            self.tolerance,
        )

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)  # opens the file when it is needed; a run continues without it if that fails

    def __repr__(self) -> str:
        return f"SimulationCache({str(self.path)!r})"

    def look_up(self, fingerprint: str, thetas: np.ndarray, n_channels: int, n_steps: int) -> CachedRows:
        """Look up simulations, with few queries for the whole batch.

        Parameters
        ----------
        fingerprint : str
            Everything but the parameters that the sums depend on, such as `FELikelihood.simulation_key`.
        thetas : (n, n_structural) float
            Structural parameters.
        n_channels, n_steps : int
            Shape of the measurements; rows of another shape count as damaged.

        Returns
        -------
        CachedRows
        """
        keys = simulation_keys(fingerprint, thetas)
        misfit, reasons, known = np.full((len(keys), n_channels), np.nan), [""] * len(keys), np.zeros(len(keys), bool)
        with self.file.lock:
            found, bad = {}, []
            for row in self._try("read", lambda connection: select_rows(connection, keys), []):
                key, _, _, sums, steps, reason = row[:6]
                if not is_undamaged(*row) or len(sums) != 8 * n_channels or steps != n_steps:
                    bad.append(key)
                elif not (reason and self.retry_failures):
                    found[key] = sums, reason
            for place, key in enumerate(keys):
                if key in found:
                    sums, reason = found[key]
                    misfit[place] = np.frombuffer(sums, dtype="<f8")
                    reasons[place] = reason.decode("utf-8", "replace")
                    known[place] = True
            self.hits += int(known.sum())
            self.misses += int((~known).sum())
            self._drop("simulations", bad)
        return CachedRows(misfit, reasons, known)

    def store(
        self,
        fingerprint: str,
        thetas: np.ndarray,
        n_steps: int,
        misfit: np.ndarray,
        reasons: Sequence[str],
        seconds: float,
    ) -> None:
        """Store simulations in one transaction that also evicts; failed ones unless the reason is a `TransientReason`.

        Parameters
        ----------
        fingerprint : str
            As for `look_up`.
        thetas : (n, n_structural) float
            Structural parameters.
        n_steps : int
            Number of samples of the measurements.
        misfit : (n, n_channels) float
            Sums of squared residuals [SI unit of the channel, squared].
        reasons : sequence of n str
            Reasons of failures; empty where the simulation succeeded.
        seconds : float
            Wall time of all simulations together [s].
        """
        keys, source = simulation_keys(fingerprint, thetas), source_number(fingerprint)
        rows = [
            pack_row(key, source, theta, sums, n_steps, reason, seconds / len(keys))
            for key, theta, sums, reason in zip(keys, thetas, misfit, reasons, strict=True)
            if not isinstance(reason, TransientReason)
        ]
        self._write(STORE, rows)

    def store_responses(self, model: Model, thetas: np.ndarray, responses: np.ndarray) -> None:
        """Store responses in double precision, in one transaction that also evicts.

        Parameters
        ----------
        model : Model
            The responses do not depend on the measurements.
        thetas : (n, n_structural) float
            Structural parameters.
        responses : (n, n_channels, n_steps) float
            [SI]. Responses that are not finite are not stored.
        """
        rows = []
        fingerprint = simulation_fingerprint(model)
        keys, source = simulation_keys(fingerprint, thetas), source_number(fingerprint)
        for key, theta, response in zip(keys, thetas, responses, strict=True):
            if np.isfinite(response).all():
                data = np.asarray(response, dtype="<f8").tobytes()
                point = np.asarray(theta, dtype="<f8").tobytes()
                rows.append((key, source, point, len(response), len(data), zlib.crc32(key + data), data))
        if rows:
            self._write(STORE_RESPONSE, rows)

    def look_up_responses(self, model: Model, thetas: np.ndarray) -> list[np.ndarray | None]:
        """Look up responses of a model.

        Parameters
        ----------
        model : Model
        thetas : (n, n_structural) float
            Structural parameters.

        Returns
        -------
        list of n (n_channels, n_steps) float, or None
            [SI]; None where the response is not stored, or in single precision, by an earlier version.
        """
        shape = len(model.channels), model.n_steps
        size = 8 * shape[0] * shape[1]
        keys = simulation_keys(simulation_fingerprint(model), thetas)
        query = "key, crc, response FROM responses"
        found, bad = {}, []
        with self.file.lock:
            for key, crc, data in self._try("read", lambda connection: select_rows(connection, keys, query), []):
                if not isinstance(data, bytes) or crc != zlib.crc32(key + data) or len(data) not in (size, size // 2):
                    bad.append(key)
                elif len(data) == size:
                    found[key] = np.frombuffer(data, dtype="<f8").reshape(shape)
            self._drop("responses", bad)
        return [found.get(key) for key in keys]

    def latest_success(self, fingerprint: str, n_channels: int, n_steps: int) -> StoredSimulation | None:
        """The undamaged successful simulation that was stored last.

        Parameters
        ----------
        fingerprint : str
            As for `look_up`.
        n_channels, n_steps : int
            Shape of the measurements.

        Returns
        -------
        StoredSimulation or None
            None if no successful simulation of this fingerprint is stored.
        """
        query = f"SELECT {COLUMNS} FROM simulations WHERE source = ? AND length(reason) = 0 ORDER BY id DESC LIMIT 1"
        source = source_number(fingerprint)
        for row in self._try("read", lambda connection: connection.execute(query, (source,)).fetchall(), []):
            if is_undamaged(*row) and len(row[3]) == 8 * n_channels and row[4] == n_steps:
                theta, misfit = (np.frombuffer(data, dtype="<f8") for data in row[2:4])
                return StoredSimulation(theta, misfit, row[5].decode("utf-8", "replace"))
        return None

    def are_stored(self, fingerprints: Sequence[str], thetas: np.ndarray) -> np.ndarray:
        """Whether a simulation, a response or a failure is stored, under one of several fingerprints.

        Parameters
        ----------
        fingerprints : sequence of str
            As for `look_up`.
        thetas : (n, n_structural) float
            Structural parameters.

        Returns
        -------
        (n,) bool
            The rows are neither verified nor checked for damage, and not counted.
        """
        tables, stored = ("simulations", "responses", "failures"), np.zeros(len(thetas), dtype=bool)
        for fingerprint in fingerprints:
            keys = simulation_keys(fingerprint, thetas)

            def find(connection: sqlite3.Connection, keys: list[bytes] = keys) -> set:
                return {row for table in tables for (row,) in select_rows(connection, keys, f"key FROM {table}")}

            found = self._try("read", find, set())
            stored |= [key in found for key in keys]
        return stored

    def info(self) -> CacheInfo:
        """State of the cache, and counts of this object."""

        def ask(connection: sqlite3.Connection) -> tuple:
            ((n, failures, seconds),) = connection.execute(
                "SELECT count(*), total(length(reason) > 0), total(seconds) FROM simulations"
            )
            ((responses, response_bytes),) = connection.execute("SELECT count(*), total(size) FROM responses")
            return n, int(failures), responses, int(response_bytes), seconds

        with self.file.lock:
            counted = self._try("read", ask, (0, 0, 0, 0, 0.0))
            size = self.path.stat().st_size if self.path.exists() else 0
            counts = self.hits, self.misses, self.evictions, self.damaged, self.verified
            return CacheInfo(self.path, *counted, size, *counts)

    def export_hdf5(self, path: str | os.PathLike) -> int:
        """Write all simulations, without responses, to an HDF5 file; an existing file is replaced atomically.

        Parameters
        ----------
        path : path
            The HDF5 file.

        Returns
        -------
        int
            Number of simulations.

        Raises
        ------
        ValueError
            If the file is the cache itself, or its folder does not exist.
        OSError
            If either file cannot be used.
        """
        if Path(path).resolve() == self.path:
            raise ValueError(f"{path} is the cache itself; export to another file")
        return write_rows(path, self._pages())

    def import_hdf5(self, path: str | os.PathLike) -> int:
        """Add the simulations of a file that `export_hdf5` wrote; simulations that are already stored are not changed.

        Parameters
        ----------
        path : path
            The HDF5 file.

        Returns
        -------
        int
            Number of simulations in the file.

        Raises
        ------
        ValueError
            If it is not such a file, or is damaged.
        OSError
            If either file cannot be used.
        """
        rows = [(*row, checksum(*row)) for row in read_rows(path)]
        self._insist(lambda connection: self._insert(connection, STORE, rows))
        return len(rows)

    def check_rows(self) -> tuple[int, int]:
        """Compare all simulations with their checksums; no row is changed.

        Returns
        -------
        rows, damaged : int
            Numbers of simulations, and of those that do not match their checksums.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        count = "SELECT count(*) FROM simulations"
        (rows,) = self._insist(lambda connection: connection.execute(count).fetchone())
        return rows, rows - sum(len(page) for page in self._pages())

    def close(self) -> None:
        """Store waiting rows, if possible, and close the connection of this process; the next use opens a new one."""
        with self.file.lock:
            self.retry_times.clear()
            if self._waiting:
                self._write(STORE, [])
            self.file.close()

    def _pages(self) -> Iterator[list[tuple]]:
        """All undamaged rows, without their checksums, oldest first."""
        last = 0
        while True:
            query = f"SELECT id, {COLUMNS} FROM simulations WHERE id > ? ORDER BY id LIMIT 10000"
            page = self._insist(lambda connection, q=query, i=last: connection.execute(q, (i,)).fetchall())
            if not page:
                return
            last = page[-1][0]
            yield [row[1:-1] for row in page if is_undamaged(*row[1:])]

    def _insert(self, connection: sqlite3.Connection, statement: str, rows: list[tuple]) -> None:
        evicted, responses = insert_rows(connection, statement, rows, self.max_rows, self.max_response_bytes)
        self.evictions += evicted + responses
        if responses and not self._said_evicted:
            self._said_evicted = True
            logger.info(
                "%s: the oldest responses are evicted, because all have more than %d bytes (max_response_bytes)",
                self.path,
                self.max_response_bytes,
            )

    def _write(self, statement: str, rows: list[tuple]) -> None:
        with self.file.lock:
            if not self.file.writable:
                self._warn_read_only()
                return
            if statement is STORE:  # responses can be computed again and do not wait
                rows = self._waiting = (self._waiting + rows)[-MAX_WAITING_ROWS:]
            if self._try("written", lambda connection: self._insert(connection, statement, rows) or True, False):
                if statement is STORE:
                    self._waiting = []

    def _warn_read_only(self) -> None:
        if not self._warned_read_only:
            logger.warning("%s is read-only: new simulations are not stored. Change its permissions or path", self.path)
        self._warned_read_only = True

    def _drop(self, table: str, keys: list[bytes]) -> None:
        """Delete rows that do not match their checksum."""
        if not keys:
            return
        if not self.damaged:
            logger.warning("%s has damaged rows; they are simulated again, see SimulationCache.damaged", self.path)
        self.damaged += len(keys)
        if not self.file.writable:
            return
        delete = f"DELETE FROM {table} WHERE key = ?"
        self._try("repaired", lambda connection: connection.executemany(delete, [(key,) for key in keys]), None)
