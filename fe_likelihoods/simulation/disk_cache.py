"""Simulations on disk, so that none is ever repeated or lost: not by another run, sampler, process or program.

What is kept of a simulation are the sums of squared residuals, one number a channel. They do not depend on the noise
nor on the prior, so one simulation serves every noise level, every rung of a ladder and every sampler. Its key is a
digest of all that the sums do depend on: fingerprint of model, record and measurements, sources of the models, and the
structural parameters bit for bit. Whatever changes has another key; nothing has to be declared invalid. What is not
asked for any more is evicted in the end, the oldest first.

Promise no more than exact hits: they come from changes of the noise alone, resumed runs, repeated runs, duplicates,
and comparisons from the same start.

A run never fails because of its cache. A row that does not match its checksum is simulated again, a damaged file is set
aside, and while nothing can be written the rows wait in memory.
"""

import logging
import os
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .cache_exchange import read_rows, write_rows
from .cache_rows import COLUMNS, checksum, is_whole, packed, simulation_keys
from .model import Model
from .source_digest import simulation_fingerprint
from .sqlite_file import CacheFile, is_damage

__all__ = ["CacheInfo", "Remembered", "SimulationCache"]

logger = logging.getLogger(__name__)

PER_QUERY = 500  # keys asked for by one SELECT
RETRY_SECONDS = 60.0  # after a write that failed
MOST_WAITING = 100_000  # rows kept for when writing works again

_STORE = (
    "INSERT INTO simulations (key, misfit, n_steps, reason, seconds, crc) VALUES (?, ?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET misfit = excluded.misfit, n_steps = excluded.n_steps, reason = excluded.reason, "
    "seconds = excluded.seconds, crc = excluded.crc WHERE length(reason) > 0"  # a success is never overwritten
)
_STORE_RESPONSE = (
    "INSERT INTO responses (key, n_channels, size, crc, response) VALUES (?, ?, ?, ?, ?) ON CONFLICT (key) DO NOTHING"
)


class Remembered(NamedTuple):
    """What a cache knows of n simulations.

    Attributes
    ----------
    misfit : (n, n_channels) float — NaN where the simulation failed, and where nothing is known
    reasons : n strings, empty where the simulation succeeded or nothing is known
    known : (n,) bool
    """

    misfit: np.ndarray
    reasons: list[str]
    known: np.ndarray


class CacheInfo(NamedTuple):
    """State of a cache.

    path : where it is
    simulations, failures : how many are kept, and how many of them had failed
    responses, response_bytes : how many full responses are kept, and their size
    seconds : wall time that was spent on what is kept [s]
    file_bytes : size of the file, without the log of what was written last
    hits, misses, evictions, damaged : rows, by this object in this process
    """

    path: Path
    simulations: int
    failures: int
    responses: int
    response_bytes: int
    seconds: float
    file_bytes: int
    hits: int
    misses: int
    evictions: int
    damaged: int


class SimulationCache:
    """Sums of squared residuals of simulations, in one SQLite file.

    Any number of threads, processes and programs may use a file at once, each process through a connection of its own.
    The object may be forked and pickled: another process opens the file by its path. The file must lie on a disk of the
    machine, not on a network file system, where SQLite's shared memory does not work; on a cluster let the parent own
    the cache (``FELikelihood(..., pool=...)``), its workers return sums.

    What is stored survives the death of the process, by ``kill -9`` too; a power failure may take the last seconds.

    Parameters
    ----------
    path : path
        The file; made if it is not there. One that may only be read is read from, with a warning.
    max_rows : int
        The most simulations that are kept, of some 120 bytes each; whoever writes evicts the oldest beyond this bound.
    retry_failures : bool
        Run simulations that had failed again: after a change of something that no fingerprint tells (an external
        program, memory, a time limit).
    responses : bool
        Keep full responses too, in single precision, for predictive work.
    max_response_bytes : int
        The most bytes of responses that are kept; the oldest are evicted.
    timeout : float
        How long to wait for another writer [s].

    Attributes
    ----------
    hits, misses : int
        Rows that were known, or not, by this object in this process.
    evictions : int
        Rows evicted by this object.
    damaged : int
        Rows found to be damaged, and deleted.

    Raises
    ------
    ValueError
        If a bound is not positive, the path is a folder or lies in none, the file may not be read or made, belongs to
        another program, or has another layout than this release writes. Such a file is left as it is.

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
    ) -> None:
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"SimulationCache: expected the path of a file; got {path!r}")
        for name, value in (("max_rows", max_rows), ("max_response_bytes", max_response_bytes)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"SimulationCache: {name} must be a whole number of 1 or more; got {value!r}")
        self._set_up(path, int(max_rows), bool(retry_failures), bool(responses), int(max_response_bytes), timeout)
        self._file.check()
        if not self._file.writable:
            self._warn_that_it_is_only_read()

    def _set_up(self, path, max_rows, retry_failures, responses, max_response_bytes, timeout) -> None:
        self._file = CacheFile(path, timeout)
        self.max_rows = max_rows
        self.retry_failures = retry_failures
        self.responses = responses
        self.max_response_bytes = max_response_bytes
        self.hits = self.misses = self.evictions = self.damaged = 0
        self._waiting: list[tuple] = []
        self._only_read = False  # and has been said to be
        self._pauses: dict[str, float] = {}  # until when what failed is not tried again

    def __getstate__(self) -> tuple:
        return (
            self.path,
            self.max_rows,
            self.retry_failures,
            self.responses,
            self.max_response_bytes,
            self._file.timeout,
        )

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)  # the file is opened when it is needed, and may be out of reach: a run goes on without

    def __repr__(self) -> str:
        return f"SimulationCache({str(self.path)!r})"

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    def look_up(self, fingerprint: str, thetas: np.ndarray, n_channels: int, n_steps: int) -> Remembered:
        """What is known of simulations; one question for the whole batch.

        Parameters
        ----------
        fingerprint : str
            Of model and measurements.
        thetas : (n, n_structural) float
            Structural parameters.
        n_channels, n_steps : int
            Of the measurements.

        Returns
        -------
        Remembered
        """
        keys = simulation_keys(fingerprint, thetas)
        misfit, reasons, known = np.full((len(keys), n_channels), np.nan), [""] * len(keys), np.zeros(len(keys), bool)
        with self._file.lock:
            found, bad = {}, []
            for row in self._try("read", lambda connection: self._select(connection, keys), []):
                key, sums, steps, reason = row[:4]
                if not is_whole(*row) or len(sums) != 8 * n_channels or steps != n_steps:
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
        return Remembered(misfit, reasons, known)

    def store(
        self,
        fingerprint: str,
        thetas: np.ndarray,
        n_steps: int,
        misfit: np.ndarray,
        reasons: Sequence[str],
        seconds: float,
    ) -> None:
        """Keep simulations, failures too, in one transaction that also evicts.

        Parameters
        ----------
        fingerprint : str
            Of model and measurements.
        thetas : (n, n_structural) float
        n_steps : int
            Number of samples of the measurements.
        misfit : (n, n_channels) float
            Sums of squared residuals.
        reasons : n strings
            Why simulations failed; empty where they did not.
        seconds : float
            Wall time of all of them [s].
        """
        keys = simulation_keys(fingerprint, thetas)
        self._write(
            _STORE,
            [
                packed(key, sums, n_steps, reason, seconds / len(keys))
                for key, sums, reason in zip(keys, misfit, reasons, strict=True)
            ],
        )

    def store_responses(self, model: Model, thetas: np.ndarray, responses: np.ndarray) -> None:
        """Keep full responses in single precision, in one transaction that also evicts.

        Parameters
        ----------
        model : Model
            The responses do not depend on the measurements.
        thetas : (n, n_structural) float
        responses : (n, n_channels, n_steps) float
            Those that are not finite, also in single precision, are left out.
        """
        rows = []
        keys = simulation_keys(simulation_fingerprint(model), thetas)
        for key, response in zip(keys, responses, strict=True):
            with np.errstate(over="ignore"):
                single = np.asarray(response, dtype="<f4")
            if np.isfinite(single).all():
                data = single.tobytes()
                rows.append((key, len(single), len(data), zlib.crc32(key + data), data))
        self._write(_STORE_RESPONSE, rows)

    def response(self, model: Model, theta: np.ndarray) -> np.ndarray | None:
        """The response (n_channels, n_steps) kept for a model and its parameters (n_structural,), or None."""
        (key,) = simulation_keys(simulation_fingerprint(model), np.atleast_2d(np.asarray(theta, dtype=float)))
        query = "SELECT n_channels, crc, response FROM responses WHERE key = ?"
        with self._file.lock:
            found = self._try("read", lambda connection: connection.execute(query, (key,)).fetchall(), [])
            for n_channels, crc, data in found:
                if isinstance(data, bytes) and crc == zlib.crc32(key + data):
                    return np.frombuffer(data, dtype="<f4").reshape(n_channels, -1).copy()
                self._drop("responses", [key])
        return None

    def info(self) -> CacheInfo:
        """What is kept, and what this object did so far."""

        def ask(connection: sqlite3.Connection) -> tuple:
            ((n, failures, seconds),) = connection.execute(
                "SELECT count(*), total(length(reason) > 0), total(seconds) FROM simulations"
            )
            ((responses, response_bytes),) = connection.execute("SELECT count(*), total(size) FROM responses")
            return n, int(failures), responses, int(response_bytes), seconds

        with self._file.lock:
            counted = self._try("read", ask, (0, 0, 0, 0, 0.0))
            size = self.path.stat().st_size if self.path.exists() else 0
            return CacheInfo(self.path, *counted, size, self.hits, self.misses, self.evictions, self.damaged)

    def clear(self) -> None:
        """Forget everything, for all who use the file; what likelihoods remember in memory stays.

        Raises
        ------
        OSError
            If the file cannot be written.
        """

        def forget(connection: sqlite3.Connection) -> None:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("DELETE FROM simulations")
            connection.execute("DELETE FROM responses")
            connection.execute("COMMIT")

        with self._file.lock:
            self._insist(forget)
            self._waiting.clear()
            # gives the space back to the disk; not worth an error while others are reading
            self._try("vacuumed", lambda connection: connection.execute("VACUUM"), None)

    def export_hdf5(self, path: str | os.PathLike) -> int:
        """Write all simulations to an HDF5 file, replaced at once; responses stay.

        Returns
        -------
        int : how many

        Raises
        ------
        ValueError
            If the file is the cache itself, or its folder does not exist.
        OSError
            If either file cannot be used.
        """
        if Path(path).resolve() == self.path:
            raise ValueError(f"{path} is the cache itself: export it to another file")
        return write_rows(path, self._pages())

    def import_hdf5(self, path: str | os.PathLike) -> int:
        """Take in what `export_hdf5` wrote; simulations that are known stay as they are.

        Returns
        -------
        int : how many rows the file has

        Raises
        ------
        ValueError
            If it is not such a file, or damaged.
        OSError
            If either file cannot be used.
        """
        rows = [(*row, checksum(*row)) for row in read_rows(path)]
        self._insist(lambda connection: self._insert(connection, _STORE, rows))
        return len(rows)

    def close(self) -> None:
        """Store what waits, if that can be done, and close this process's connection; the next use opens one."""
        with self._file.lock:
            self._pauses.clear()
            if self._waiting:
                self._write(_STORE, [])
            self._file.close()

    def _pages(self) -> Iterator[list[tuple]]:
        """All whole rows, without their checksums, oldest first."""
        last = 0
        while True:
            query = f"SELECT id, {COLUMNS} FROM simulations WHERE id > ? ORDER BY id LIMIT 10000"
            page = self._insist(lambda connection, q=query, i=last: connection.execute(q, (i,)).fetchall())
            if not page:
                return
            last = page[-1][0]
            yield [row[1:-1] for row in page if is_whole(*row[1:])]

    @staticmethod
    def _select(connection: sqlite3.Connection, keys: list[bytes]) -> list[tuple]:
        found = []
        for start in range(0, len(keys), PER_QUERY):
            part = keys[start : start + PER_QUERY]
            marks = ",".join("?" * len(part))
            found += connection.execute(f"SELECT {COLUMNS} FROM simulations WHERE key IN ({marks})", part).fetchall()
        return found

    def _insert(self, connection: sqlite3.Connection, statement: str, rows: list[tuple]) -> None:
        connection.execute("BEGIN IMMEDIATE")
        connection.executemany(statement, rows)
        evicted = connection.execute(
            "DELETE FROM simulations WHERE id <= (SELECT max(id) FROM simulations) - ?", (self.max_rows,)
        ).rowcount
        if statement is _STORE_RESPONSE:
            ((excess,),) = connection.execute("SELECT total(size) - ? FROM responses", (self.max_response_bytes,))
            for age, size in connection.execute("SELECT id, size FROM responses ORDER BY id").fetchall():
                if excess <= 0:
                    break
                connection.execute("DELETE FROM responses WHERE id = ?", (age,))
                excess -= size
                evicted += 1
        connection.execute("COMMIT")
        self.evictions += evicted

    def _write(self, statement: str, rows: list[tuple]) -> None:
        with self._file.lock:
            if not self._file.writable:
                self._warn_that_it_is_only_read()
                return
            if statement is _STORE:  # responses are no loss
                rows = self._waiting = (self._waiting + rows)[-MOST_WAITING:]
            if self._try("written", lambda connection: self._insert(connection, statement, rows) or True, False):
                if statement is _STORE:
                    self._waiting = []

    def _warn_that_it_is_only_read(self) -> None:
        if not self._only_read:
            logger.warning("%s may only be read: what is simulated now is not stored", self.path)
        self._only_read = True

    def _drop(self, table: str, keys: list[bytes]) -> None:
        """Delete rows that do not match their checksum."""
        if not keys:
            return
        if not self.damaged:
            logger.warning("%s has damaged rows: they count as missing, see SimulationCache.damaged", self.path)
        self.damaged += len(keys)
        if not self._file.writable:
            return
        delete = f"DELETE FROM {table} WHERE key = ?"
        self._try("mended", lambda connection: connection.executemany(delete, [(key,) for key in keys]), None)

    def _try(self, what: str, action: Callable[[sqlite3.Connection], Any], otherwise: Any) -> Any:
        """Result of an action on the connection; whatever goes wrong is a warning, and not tried again for a while."""
        with self._file.lock:
            if time.monotonic() < self._pauses.get(what, -np.inf):
                return otherwise
            for attempt in range(2):
                try:
                    result = action(self._file.connection())
                    self._pauses.pop(what, None)
                    return result
                except (sqlite3.Error, OSError, ValueError, MemoryError) as error:  # damage may ask for any size
                    self._file.close()  # and with it a transaction
                    failure = error
                except BaseException:
                    self._file.close()
                    raise
                if attempt or not self._file.writable or not is_damage(failure):
                    break
                try:
                    self._file.set_aside(str(failure))
                except OSError as error:
                    failure = error
                    break
            if what not in self._pauses:
                logger.warning(
                    "%s cannot be %s (%s): the run goes on without, and tries again every %g s",
                    self.path,
                    what,
                    failure,
                    RETRY_SECONDS,
                )
            self._pauses[what] = time.monotonic() + RETRY_SECONDS
            return otherwise

    def _insist(self, action: Callable[[sqlite3.Connection], Any]) -> Any:
        """Result of what the user asked for by name: whatever goes wrong is an error."""
        with self._file.lock:
            try:
                return action(self._file.connection())
            except (sqlite3.Error, ValueError) as error:
                self._file.close()
                raise OSError(f"{self.path} cannot be used: {error}") from error
            except BaseException:
                self._file.close()
                raise
