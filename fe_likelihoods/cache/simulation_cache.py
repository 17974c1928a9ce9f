"""Cache of simulations on disk, shared by runs, samplers, processes and programs.

For each simulation, the sum of squared residuals is stored, one number per channel. It depends neither on the noise nor
on the prior, so one simulation serves every noise level, every tempering stage and every sampler. The key of a
simulation is a digest of the declared identity (fingerprints of model and measurements), the generation, and the
structural parameters to the last bit, so hits are exact. A generation contains the simulations of one state of the
model's code (`fe_likelihoods.cache.adoption`); rows of other generations stay in the file and are not used.

Responses, which depend on the model alone, are stored in double precision if they are requested, for example by a
guide, or for every simulation. Failures of the model are stored under a key of the model, so that they are valid for
any measurements. Faults of the infrastructure (`fe_likelihoods.simulation.faults`) are not stored: a later run
simulates the point again. A simulation that was stopped at a time limit is stored together with this limit. A later run
with a longer limit repeats it; a run with the same or a shorter limit repeats it once, because a busy machine may have
been the cause.

A cache never makes a run fail. A row that does not match its checksum is simulated again, a damaged file is moved
aside, and while the file cannot be written, rows wait in memory.
"""

import contextlib
import logging
import math
import os
import sqlite3
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..simulation.faults import TransientReason
from ..simulation.model import Model
from .file import CacheFile
from .rows import (
    COLUMNS,
    LABEL_COLUMNS,
    MIN_STOPS,
    RESPONSE_COLUMNS,
    STORE,
    STORE_FAILURE,
    STORE_RESPONSE,
    CachedRows,
    StoredSimulation,
    insert_rows,
    is_undamaged,
    pack_failure,
    pack_response,
    pack_row,
    select_rows,
    simulation_keys,
    source_number,
    transaction,
    unpack_failure,
    unpack_row,
)

__all__ = ["MAX_CANDIDATES", "CacheInfo", "SimulationCache", "rows_to_compare"]

logger = logging.getLogger(__name__)

MAX_WAITING_ROWS = 100_000  # rows kept in memory while the file cannot be written
MAX_CANDIDATES = 5000  # rows from which the rows to compare are chosen
CONFIDENCE = 0.95
STORE_REMARK = "INSERT OR IGNORE INTO remarks (key, source, text) VALUES (?, ?, ?)"
TABLES = ("simulations", "responses", "failures", "remarks")

_repeated: set[tuple[str, str]] = set()  # remarks by file and model, in this process


class CacheInfo(NamedTuple):
    """State of a cache; the last five numbers as for `SimulationCache`."""

    path: Path
    simulations: int
    failures: int  # among the stored simulations
    responses: int
    response_bytes: int  # of the stored responses [bytes]
    seconds: float  # wall time of the stored simulations [s]
    file_bytes: int  # without its write-ahead log [bytes]
    hits: int
    misses: int
    evictions: int
    damaged: int
    verified: int


def rows_to_compare(verify: bool | int | str) -> int:
    """Number of rows that are simulated again before rows of an unknown label are used.

    `verify` is as for `SimulationCache`. A share such as "5 %" stands for the number of rows that detect a change in
    5 % of the parameter space with a probability of 95 %. ValueError for anything else.
    """
    if isinstance(verify, bool):
        return rows_to_compare("5 %") if verify else 0
    if isinstance(verify, int | np.integer) and verify >= 1:
        return int(verify)
    if isinstance(verify, str) and verify.rstrip().endswith("%"):
        with contextlib.suppress(ValueError):
            share = float(verify.rstrip()[:-1]) / 100.0
            if 0.0 < share < 1.0:
                return math.ceil(math.log(1.0 - CONFIDENCE) / math.log(1.0 - share))
    raise ValueError(
        "SimulationCache: verify must be True, False, a number of rows of 1 or more, or a share of the space like "
        f"'5 %'; got {verify!r}"
    )


class SimulationCache:
    """Cache of simulations (sums of squared residuals, responses and failures) in one SQLite file.

    Any number of threads, processes and programs may use a file at the same time, each process through its own
    connection. The object may be forked and pickled: another process opens the file by its path. The file must be on a
    local disk, because SQLite's shared memory does not work on network file systems. On a cluster, let the parent
    process own the cache (``FELikelihood(..., pool=...)``); its workers return sums.

    Stored rows survive if the process is killed, even by ``kill -9``; a power failure may lose the last seconds.

    Parameters
    ----------
    path : path
        The file; created if it does not exist. A read-only file is used for reading, with a warning.
    max_rows : int
        Largest number of stored simulations, of about 160 bytes each. Every write evicts the oldest beyond this number.
    retry_failures : bool
        Run failed simulations again, after a change that no fingerprint contains (an external program, a licence).
    responses : bool
        Store the response of every simulation. By default, only requested responses are stored
        (`FELikelihood.simulate`, guides).
    max_response_bytes : int
        Largest size of all stored responses [bytes], at 8 bytes per channel and sample. The oldest are evicted; the
        first time, a message at level INFO.
    timeout : float
        How long to wait for another writer [s].
    verify : bool, int or str
        How many stored rows are simulated again before other rows are used (`fe_likelihoods.cache.verification`). If
        the model's label is known: two rows per process, and one of every 100. If it is unknown, because code, a file
        or a package has changed: enough rows to detect a change in 5 % of the parameter space with a probability of
        95 % (59 rows, or all rows). Give another share, such as "2 %", or a number of rows; False for no rows.
    tolerance : float, optional
        Accepted difference between a stored and a new response, relative to the response norm. By default the model's
        attribute ``response_tolerance``: 0 for the compiled models of this library on the same processor, 1e-9 on
        another processor and for other models.

    Attributes
    ----------
    hits, misses, evictions, damaged, verified : int
        Rows that this object has found, not found, evicted, found damaged and deleted, and simulated again without a
        difference, in this process.
    file : CacheFile
        The SQLite file and its connection.

    Raises
    ------
    ValueError
        If a bound is not positive, if the tolerance is negative, if the path is a folder or in no existing folder, or
        if the file cannot be read or created, is not a cache, belongs to another program, or has the layout of another
        release. Such a file is not changed.

    Notes
    -----
    Methods for rows have the arguments `fingerprint`, the declared identity (`FELikelihood.simulation_key` for
    statistics, the model's fingerprint for responses and failures); `thetas`, the structural parameters
    (n, n_structural); and `generation` and `label` of a `StoredLabel`, by default the latest generation.

    Examples
    --------
    >>> likelihood = FELikelihood(model, measurements, cache="column.sqlite")
    >>> likelihood.simulator.cache.info().simulations
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
        verify: bool | int | str = True,
        tolerance: float | None = None,
    ) -> None:
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"SimulationCache: expected the path of a file; got {path!r}")
        for name, value in (("max_rows", max_rows), ("max_response_bytes", max_response_bytes)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"SimulationCache: {name} must be a whole number of 1 or more; got {value!r}")
        if tolerance is not None and not 0.0 <= tolerance < np.inf:
            raise ValueError(f"SimulationCache: tolerance must be a number of 0 or more, or None; got {tolerance!r}")
        rows_to_compare(verify)  # refuses an impossible value
        self.max_rows, self.max_response_bytes = int(max_rows), int(max_response_bytes)
        self.retry_failures, self.responses = bool(retry_failures), bool(responses)
        self.verify, self.tolerance = verify, tolerance
        self._begin(CacheFile(path, timeout))
        self.file.check()
        if not self.file.writable:
            self._warn_read_only()

    def _begin(self, file: CacheFile) -> None:
        self.file = file
        self.hits = self.misses = self.evictions = self.damaged = self.verified = 0
        self._waiting: list[tuple] = []
        self._remark = ""  # that was stored last
        self._warned_read_only = self._said_evicted = False

    def __getstate__(self) -> tuple:
        settings = ("max_rows", "max_response_bytes", "retry_failures", "responses", "verify", "tolerance")
        return self.path, self.file.timeout, {name: getattr(self, name) for name in settings}

    def __setstate__(self, state: tuple) -> None:
        path, timeout, settings = state
        vars(self).update(settings)
        self._begin(CacheFile(path, timeout))  # opened when it is needed; if that fails, a run continues without it

    def __repr__(self) -> str:
        return f"SimulationCache({str(self.path)!r})"

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.file.path

    # simulations --------------------------------------------------------------------------------------------------

    def look_up(
        self, fingerprint: str, thetas: np.ndarray, n_channels: int, n_steps: int, generation: int | None = None
    ) -> CachedRows:
        """Look up simulations, with few queries for the whole batch; rows of another shape count as damaged."""
        keys = self._keys(fingerprint, thetas, generation)
        misfit, reasons, known = np.full((len(keys), n_channels), np.nan), [""] * len(keys), np.zeros(len(keys), bool)
        with self.file.lock:
            found, bad = {}, []
            for row in self._rows(keys):
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
        generation: int | None = None,
        label: int = 0,
    ) -> None:
        """Store simulations and evict the oldest, in one transaction; a `TransientReason` is not stored.

        Parameters
        ----------
        fingerprint, thetas, generation, label
            See the notes of the class.
        n_steps : int
            Number of measured samples.
        misfit : (n, n_channels) float
            Sums of squared residuals [SI unit of the channel, squared].
        reasons : sequence of n str
            Reasons of failures; empty where the simulation succeeded.
        seconds : float
            Wall time of all simulations together [s].
        """
        generation = self._given_or_latest(fingerprint, generation)
        keys, source = simulation_keys(fingerprint, thetas, generation), source_number(fingerprint)
        rows = [
            pack_row(key, source, theta, sums, n_steps, reason, seconds / len(keys), generation, label)
            for key, theta, sums, reason in zip(keys, thetas, misfit, reasons, strict=True)
            if not isinstance(reason, TransientReason)
        ]
        self._write(STORE, rows)

    def store_responses(
        self, model: Model, thetas: np.ndarray, responses: np.ndarray, generation: int | None = None, label: int = 0
    ) -> None:
        """Store finite responses (n, n_channels, n_steps) [SI] and evict the oldest, in one transaction."""
        generation = self._given_or_latest(model.fingerprint, generation)
        keys, source = simulation_keys(model.fingerprint, thetas, generation), source_number(model.fingerprint)
        rows = [
            pack_response(key, source, theta, response, generation, label)
            for key, theta, response in zip(keys, thetas, responses, strict=True)
            if np.isfinite(response).all()
        ]
        self._write(STORE_RESPONSE, rows)

    def look_up_responses(
        self, model: Model, thetas: np.ndarray, generation: int | None = None
    ) -> list[np.ndarray | None]:
        """Responses (n_channels, n_steps) [SI] of a model; None for a response that is not stored."""
        shape = len(model.channels), model.n_steps
        size = 8 * shape[0] * shape[1]
        keys = self._keys(model.fingerprint, thetas, generation)
        found, bad = {}, []
        with self.file.lock:
            for key, crc, data in self._rows(keys, "key, crc, response FROM responses"):
                if not isinstance(data, bytes) or crc != zlib.crc32(key + data) or len(data) != size:
                    bad.append(key)
                else:
                    found[key] = np.frombuffer(data, dtype="<f8").reshape(shape)
            self._drop("responses", bad)
        return [found.get(key) for key in keys]

    def are_stored(self, fingerprints: Sequence[str], thetas: np.ndarray, generation: int | None = None) -> np.ndarray:
        """Whether a simulation, a response or a failure is stored (n,), under one of several fingerprints.

        Rows are not verified, not checked for damage, and not counted as hits.
        """
        stored = np.zeros(len(thetas), dtype=bool)
        for fingerprint in fingerprints:
            keys = self._keys(fingerprint, thetas, generation)
            found = {key for table in TABLES[:3] for (key,) in self._rows(keys, f"key FROM {table}")}
            stored |= [key in found for key in keys]
        return stored

    # failures and remarks --------------------------------------------------------------------------------------------

    def store_failures(
        self, model: Model, thetas: np.ndarray, reasons: Sequence[str], generation: int | None = None
    ) -> None:
        """Store failures of a model for any measurements, and simulations that were stopped at a time limit.

        Reasons are empty where the simulation succeeded. Not stored are a `MisfitReason`, and a `TransientReason`
        without a time limit.
        """
        generation = self._given_or_latest(model.fingerprint, generation)
        keys, source = simulation_keys(model.fingerprint, thetas, generation), source_number(model.fingerprint)
        rows = [pack_failure(key, source, reason) for key, reason in zip(keys, reasons, strict=True)]
        self._write(STORE_FAILURE, [row for row in rows if row is not None])

    def look_up_failures(self, model: Model, thetas: np.ndarray, generation: int | None = None) -> list[str]:
        """Reasons of stored failures that are valid for any measurements; empty where the simulation must be run.

        The model's ``time_limit`` [s], if there is one, is compared with the time limits of stored failures.
        """
        if self.retry_failures:
            return [""] * len(thetas)
        limit = getattr(model, "time_limit", None) or np.inf
        keys = self._keys(model.fingerprint, thetas, generation)
        found, bad = {}, []
        with self.file.lock:
            for *row, stops in self._rows(keys, "key, source, reason, time_limit, crc, stops FROM failures"):
                reason = unpack_failure(*row)
                if reason is None:
                    bad.append(row[0])
                elif not isinstance(reason, TransientReason) or (limit <= reason.time_limit and stops >= MIN_STOPS):
                    found[row[0]] = reason
            self._drop("failures", bad)
        return [found.get(key, "") for key in keys]

    def store_remark(self, model: Model) -> None:
        """Store a model's `range_remark` (a law was used beyond its range), unless it is empty or one is stored."""
        text = getattr(model, "range_remark", "")
        if text and text != self._remark:
            source = source_number(model.fingerprint)
            key = source.to_bytes(8, "little", signed=True)
            if self.file.write(STORE_REMARK, [(key, source, text.encode("utf-8", "backslashreplace"))]):
                self._remark = text

    def look_up_remark(self, model: Model) -> str:
        """Remark of a model; empty if there is none."""
        rows = self.file.select("SELECT text FROM remarks WHERE source = ?", (source_number(model.fingerprint),))
        return bytes(rows[0][0]).decode("utf-8", "replace") if rows else ""

    def repeat_remark(self, model: Model) -> None:
        """Log a model's stored remark, once per process, unless the model has just made a remark itself.

        A built-in model warns once if a simulation was beyond the range of its laws. Without the stored remark, a later
        process that uses cached simulations would give no warning.
        """
        place = str(self.path), model.fingerprint
        if not hasattr(model, "range_remark") or place in _repeated:
            return
        _repeated.add(place)
        text = self.look_up_remark(model)
        if text and not model.range_remark:
            logger.warning("simulations of this model in %s: %s", self.path, text)

    # generations ------------------------------------------------------------------------------------------------------

    def generations_of(self, fingerprint: str, table: str = "simulations") -> list[int]:
        """Generations of one identity's simulations or responses, the latest first."""
        query = f"SELECT generation FROM {table} WHERE source = ? GROUP BY generation ORDER BY max(id) DESC"
        return [generation for (generation,) in self.file.select(query, (source_number(fingerprint),))]

    def stored_rows(
        self, fingerprint: str, generation: int, n_channels: int, n_steps: int, most: int = MAX_CANDIDATES
    ) -> list[StoredSimulation]:
        """Undamaged simulations of one identity and generation, the latest first, evenly chosen if there are many.

        `n_channels` and `n_steps` are the shape of the measurements, `most` is about the largest number of rows.
        """
        values = source_number(fingerprint), generation
        where = "FROM simulations WHERE source = ? AND generation = ?"
        latest = f"SELECT {COLUMNS} {where} ORDER BY id DESC LIMIT ?"
        ((n,),) = self.file.select(f"SELECT count(*) {where}", values) or [(0,)]
        n = n if most > 1 else most
        rows = self.file.select(latest, (*values, most if n <= most else 10))
        if n > most:
            some = f"SELECT {COLUMNS} {where} AND id % ? = 0 ORDER BY id DESC"
            rows += self.file.select(some, (*values, n // most + 1))
        good = {row[0]: row for row in rows if is_undamaged(*row) and len(row[3]) == 8 * n_channels}
        return [unpack_row(row) for row in good.values() if row[4] == n_steps]

    def response_points(self, model: Model, generation: int, most: int = MAX_CANDIDATES) -> list[tuple]:
        """Parameters (n_structural,) and label of stored responses of a model, the latest first."""
        query = "SELECT theta, label FROM responses WHERE source = ? AND generation = ? ORDER BY id DESC LIMIT ?"
        rows = self.file.select(query, (source_number(model.fingerprint), generation, most))
        return [(np.frombuffer(theta, dtype="<f8"), label) for theta, label in rows if isinstance(theta, bytes)]

    def label_of(self, fingerprint: str, theta: np.ndarray, generation: int) -> int:
        """Id of the label under which a simulation or a response was stored; 0 if unknown."""
        keys = simulation_keys(fingerprint, theta[None], generation)
        found = [row for table in TABLES[:2] for row in self._rows(keys, f"label FROM {table}")]
        return found[0][0] if found else 0

    # the file ---------------------------------------------------------------------------------------------------------

    def copy(self, path: str | os.PathLike) -> int:
        """Copy the cache with all rows to a new file, for an archive or another machine; returns the number of
        simulations.

        ValueError if the file exists, or its folder does not; OSError if either file cannot be used.
        """
        target = Path(path).resolve()
        if target.exists() or not target.parent.is_dir():
            raise ValueError(f"{path}: expected the path of a new file in an existing folder")
        self.file.insist(lambda connection: connection.execute("VACUUM INTO ?", (str(target),)))
        return self.info().simulations

    def add(self, path: str | os.PathLike) -> int:
        """Add the rows of another cache, which no other process uses; rows that are stored already are not changed.

        Returns the number of simulations added. ValueError if the other file is not a cache, OSError if either file
        cannot be used.
        """
        other = SimulationCache(path)
        if other.path == self.path:
            raise ValueError(f"{path} is the cache itself; give another file")
        other.close()
        columns = {"simulations": COLUMNS, "responses": RESPONSE_COLUMNS, "labels": LABEL_COLUMNS}

        def insert(connection: sqlite3.Connection) -> int:
            connection.execute("ATTACH ? AS other", (str(other.path),))
            try:
                with transaction(connection):
                    statements = [
                        f"INSERT OR IGNORE INTO {t} ({c}) SELECT {c} FROM other.{t}" for t, c in columns.items()
                    ]
                    return [connection.execute(statement).rowcount for statement in statements][0]
            finally:
                connection.execute("DETACH other")

        return self.file.insist(insert)

    def info(self) -> CacheInfo:
        """State of the cache, and counts of this object."""

        def ask(connection: sqlite3.Connection) -> tuple:
            ((n, failures, seconds),) = connection.execute(
                "SELECT count(*), total(length(reason) > 0), total(seconds) FROM simulations"
            )
            ((responses, response_bytes),) = connection.execute("SELECT count(*), total(size) FROM responses")
            return n, int(failures), responses, int(response_bytes), seconds

        with self.file.lock:
            counted = self.file.attempt("read", ask, (0, 0, 0, 0, 0.0))
            size = self.path.stat().st_size if self.path.exists() else 0
            counts = self.hits, self.misses, self.evictions, self.damaged, self.verified
            return CacheInfo(self.path, *counted, size, *counts)

    def check_rows(self) -> tuple[int, int]:
        """Compare all simulations with their checksums; no row is changed. OSError if the file cannot be read.

        Returns the number of simulations, and how many do not match their checksums.
        """
        rows = good = last = 0
        query = f"SELECT id, {COLUMNS} FROM simulations WHERE id > ? ORDER BY id LIMIT 10000"
        while page := self.file.insist(lambda connection, last=last: connection.execute(query, (last,)).fetchall()):
            last = page[-1][0]
            rows, good = rows + len(page), good + sum(is_undamaged(*row[1:]) for row in page)
        return rows, rows - good

    def clear(self) -> None:
        """Delete all rows, for all users of the file; caches in memory are not affected. OSError if that fails."""

        with self.file.lock:
            self.file.insist(lambda connection: _delete_rows(connection, "?", [(True,)]))
            self._waiting.clear()
            self._remark = ""
            # returns the space to the disk; may fail while others read
            self.file.attempt("vacuumed", lambda connection: connection.execute("VACUUM"), None)

    def forget(self, *fingerprints: str) -> int:
        """Delete all rows with these fingerprints, in all generations, for all users of the file; returns their number.

        ``cache.forget(*likelihood.simulator.cache_keys)`` deletes the rows that a likelihood uses. Likelihoods keep
        their caches in memory: make a new likelihood. OSError if the file cannot be written.
        """
        sources = {source_number(fingerprint) for fingerprint in fingerprints}
        with self.file.lock:
            self._waiting = [row for row in self._waiting if row[1] not in sources]
            self._remark = ""
            rows = [(source,) for source in sources]
            return self.file.insist(lambda connection: _delete_rows(connection, "source = ?", rows))

    def discard(self, thetas: np.ndarray, *fingerprints: str, generation: int | None = None) -> None:
        """Delete the rows of some simulations, if possible."""
        keys = {key for fingerprint in fingerprints for key in self._keys(fingerprint, thetas, generation)}
        with self.file.lock:
            self._waiting = [row for row in self._waiting if row[0] not in keys]
            if self.file.writable:
                rows = [(key,) for key in keys]
                self.file.attempt("repaired", lambda connection: _delete_rows(connection, "key = ?", rows), None)

    def close(self) -> None:
        """Store waiting rows, if possible, and close this process's connection; the next use opens a new connection."""
        with self.file.lock:
            self.file.retry_times.clear()
            if self._waiting:
                self._write(STORE, [])
            self.file.close()

    def _given_or_latest(self, fingerprint: str, generation: int | None) -> int:
        if generation is not None:
            return generation
        tables = ("simulations", "responses", "labels")
        return next((found[0] for table in tables if (found := self.generations_of(fingerprint, table))), 1)

    def _keys(self, fingerprint: str, thetas: np.ndarray, generation: int | None) -> list[bytes]:
        return simulation_keys(fingerprint, thetas, self._given_or_latest(fingerprint, generation))

    def _rows(self, keys: list[bytes], *columns: str) -> list[tuple]:
        """Stored rows with given keys."""
        return self.file.attempt("read", lambda connection: select_rows(connection, keys, *columns), [])

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
        if not rows and statement is not STORE:  # `STORE` also writes waiting rows
            return
        with self.file.lock:
            if not self.file.writable:
                self._warn_read_only()
                return
            if statement is STORE:  # only simulations wait; responses can be computed again
                rows = self._waiting = (self._waiting + rows)[-MAX_WAITING_ROWS:]
            written = self.file.attempt("written", lambda found: self._insert(found, statement, rows) or True, False)
            if written and statement is STORE:
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
        self.file.write(f"DELETE FROM {table} WHERE key = ?", [(key,) for key in keys], "repaired")


def _delete_rows(connection: sqlite3.Connection, condition: str, rows: Collection[tuple]) -> int:
    """Delete rows from all tables in one transaction; return their number."""
    with transaction(connection):
        statements = [f"DELETE FROM {table} WHERE {condition}" for table in TABLES]
        return sum(connection.executemany(statement, rows).rowcount for statement in statements)
