"""SQLite file of the simulation cache: how it is created, recognised, shared, and moved aside when damaged.

In write-ahead-log (WAL) mode readers never wait, writers take turns, and a transaction whose process is killed has no
effect. SQLite's application id identifies a cache, the user version its layout; a file with others is never written to.
Every process has its own connection, closed before the process forks, since SQLite connections must not be used after
it. A cache never makes a run fail: `CacheFile.attempt` logs file errors, and returns a value to continue with.
"""

import contextlib
import logging
import math
import os
import sqlite3
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from samplers.record import lock_now

__all__ = ["APPLICATION_ID", "SCHEMA_VERSION", "CacheFile", "transaction"]

logger = logging.getLogger(__name__)

APPLICATION_ID = 0x46454C43  # "FELC"
SCHEMA_VERSION = 6
SECONDS_BETWEEN_TRIALS = 0.002  # to lock a folder
LAYOUT = (
    # the id orders rows by age; the size of a response [bytes] is 0 for failures of a model and empty for statistics
    "CREATE TABLE rows (id INTEGER PRIMARY KEY, key BLOB NOT NULL UNIQUE, source INTEGER NOT NULL, "
    "generation INTEGER NOT NULL, theta BLOB NOT NULL, value BLOB NOT NULL, reason BLOB NOT NULL, "
    "session INTEGER NOT NULL, crc INTEGER NOT NULL, size INTEGER)",
    "CREATE INDEX row_generations ON rows (source, generation)",
    "CREATE INDEX response_sizes ON rows (size) WHERE size > 0",  # for their sum without reading the responses
    # labels of models, and the generation of each label
    "CREATE TABLE labels (source INTEGER NOT NULL, code BLOB NOT NULL, files BLOB NOT NULL, "
    "generation INTEGER NOT NULL, crc INTEGER NOT NULL, UNIQUE (source, code, files))",
)
SQLITE_SIGNATURE = b"SQLite format 3\0"
ID_START = 68  # place of the application id in SQLite's header [bytes]
PAGE_SIZE = 4096  # SQLite's default [bytes]
TIMEOUT = 30.0  # how long to wait for another writer [s]
RETRY_SECONDS = 60.0  # wait after a failed access to the file
# results of SQLite whose cause is outside of the file: locks, rights, the disk, memory, wrong use
OUTSIDE = {
    getattr(sqlite3, f"SQLITE_{name}")
    for name in "OK PERM BUSY LOCKED NOMEM READONLY INTERRUPT IOERR FULL CANTOPEN PROTOCOL AUTH NOLFS".split()
}

_files: "weakref.WeakSet[CacheFile]" = weakref.WeakSet()
_lock = threading.RLock()  # held while a file is used, and while this process forks


def _before_fork() -> None:
    _lock.acquire()
    for file in list(_files):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_lock.release, after_in_child=_lock.release)


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """A write transaction; an error inside rolls it back."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # SQLite itself may have ended it
            connection.execute("ROLLBACK")
        raise


def _is_damage(error: Exception) -> bool:
    """Whether an error means that the file itself is damaged."""
    if isinstance(error, UnicodeDecodeError):  # SQLite's message quotes damaged contents
        return True
    return ((getattr(error, "sqlite_errorcode", None) or 0) & 0xFF) not in OUTSIDE


class CacheFile:
    """A file (absolute `path` without links) and this process's connection to it. Hold `lock` while using it.

    `timeout` [s] is how long to wait for another writer. A copy in another process opens the file when it is needed; if
    that fails, a run continues without it. `retry_times` has the actions that failed, with the monotonic
    time [s] before which they are not tried again.
    """

    lock = _lock

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path).resolve()  # SQLite keeps the log next to the target of a link
        self.timeout = TIMEOUT
        self.retry_times: dict[str, float] = {}
        self._connection: sqlite3.Connection | None = None
        self._inode: tuple[int, int] | None = None
        self._inode_of_cache: tuple[int, int] | None = None  # of the last file that was identified as a cache
        with _lock:
            _files.add(self)

    def __reduce__(self) -> tuple:
        return type(self), (self.path,)

    def __del__(self) -> None:
        if getattr(self, "_connection", None) is not None:
            self._connection.close()

    def check(self) -> None:
        """Open the file, before any costly work; see `SimulationCache` for the errors."""
        if self.path.is_dir() or not self.path.parent.is_dir():
            raise ValueError(f"{self.path}: expected the path of a file in an existing folder, as 'cache.sqlite'")
        try:
            with _lock, transaction(self._use(lambda connection: connection)):  # whether it can be written
                pass
        except (OSError, sqlite3.Error) as error:
            raise ValueError(f"{self.path} cannot be opened as a cache: {error}; give another path") from error

    def _use(self, action: Callable[[sqlite3.Connection], Any]) -> Any:
        """Result of an action on the connection; a file that turns out to be damaged is set aside before."""
        with _lock:
            try:
                try:
                    return action(self.connection())
                except (sqlite3.Error, UnicodeDecodeError) as error:
                    self.close()
                    if not _is_damage(error):
                        raise
                    self.set_aside(str(error))
                    return action(self.connection())
            except BaseException:
                self.close()  # also ends a transaction
                raise

    def attempt(self, what: str, action: Callable[[sqlite3.Connection], Any], otherwise: Any) -> Any:
        """Result of an action on the connection; `otherwise`, with a warning, if the action fails.

        All actions with the same name `what`, a participle such as "read" for the warning, then pause for a while.
        """
        with _lock:
            if time.monotonic() < self.retry_times.get(what, -math.inf):
                return otherwise
            try:
                result = self._use(action)
            except (sqlite3.Error, OSError, ValueError, MemoryError) as failure:  # a damaged size may need much memory
                if what not in self.retry_times:
                    text = "%s cannot be %s (%s); the run continues without it and tries again after %g s"
                    logger.warning(text, self.path, what, failure, RETRY_SECONDS)
                self.retry_times[what] = time.monotonic() + RETRY_SECONDS
                return otherwise
            self.retry_times.pop(what, None)
            return result

    def select(self, query: str, values: tuple = ()) -> list[tuple]:
        """Rows of a query; none if the file cannot be read."""
        return self.attempt("read", lambda connection: connection.execute(query, values).fetchall(), [])

    def write(self, *statements: tuple[str, list[tuple]]) -> bool:
        """Execute statements, each for some rows, in one transaction; False if the file cannot be written."""

        def execute(connection: sqlite3.Connection) -> bool:
            with transaction(connection):
                for statement, rows in statements:
                    connection.executemany(statement, rows)
            return True

        return self.attempt("written", execute, False)

    def connection(self) -> sqlite3.Connection:
        """Connection of this process, opened if there is none.

        ValueError if the file belongs to another program or a later release, sqlite3.Error if it cannot be opened.
        """
        if self._connection is None:
            with self._exclusive():
                self._inode = self.identity
                self._connection = self._open()
                self._inode = self._inode_of_cache = self.identity
        return self._connection

    def close(self) -> None:
        """Close the connection of this process; the next use opens a new one."""
        with _lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def set_aside(self, why: str) -> None:
        """Rename a damaged file to ``<name>.damaged-<n>`` with a warning, unless another process has already done so.

        ValueError if the file is not known to be a cache (it is not changed), OSError if it cannot be renamed.
        """
        with _lock, self._exclusive():
            self.close()
            if self._inode is None or self.identity != self._inode:
                return
            if self._inode != self._inode_of_cache:
                self._refuse_other_files()
            n = 1
            while (aside := self.path.with_name(f"{self.path.name}.damaged-{n}")).exists():
                n += 1
            # the log first, because SQLite would use it for a new file with the same name; the last process that closes
            # the file removes it
            for suffix in ("-wal", "-shm"):
                with contextlib.suppress(FileNotFoundError):
                    os.rename(f"{self.path}{suffix}", f"{aside}{suffix}")
            os.rename(self.path, aside)
            text = "%s is damaged (%s): set aside as %s, and a new cache created, so that all is simulated again"
            logger.warning(text, self.path, why, aside.name)

    @property
    def identity(self) -> tuple[int, int] | None:
        """Device and inode of the file, None if it does not exist."""
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return None
        return status.st_dev, status.st_ino

    @contextlib.contextmanager
    def _exclusive(self) -> Iterator[None]:
        """Lock the folder, so that no other process opens the file or moves it aside meanwhile; go on after a time, and
        where there are no locks.

        SQLite finds the log by its name: a process that opens a damaged file while it is renamed would write to the
        new file's log. The file itself cannot be locked instead, because closing it releases SQLite's locks.
        """
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):  # a folder with search permission only, a file system without locks
                descriptor = os.open(self.path.parent, os.O_RDONLY)
                stack.callback(os.close, descriptor)
                stop = time.monotonic() + self.timeout
                while time.monotonic() <= stop:
                    try:
                        lock_now(descriptor)
                        break
                    except BlockingIOError:
                        time.sleep(SECONDS_BETWEEN_TRIALS)
            yield

    def _open(self) -> sqlite3.Connection:
        uri = f"{self.path.as_uri()}?mode=rwc"
        connection = sqlite3.connect(uri, uri=True, timeout=self.timeout, isolation_level=None, check_same_thread=False)
        connection.text_factory = bytes  # damaged texts cannot be decoded
        try:
            if self._is_empty(connection):
                with transaction(connection):
                    identity = f"PRAGMA application_id = {APPLICATION_ID}", f"PRAGMA user_version = {SCHEMA_VERSION}"
                    # another process may have been first
                    for statement in (*LAYOUT, *identity) if self._is_empty(connection) else ():
                        connection.execute(statement)
            self._identify(connection)
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
        except BaseException:
            connection.close()
            raise
        return connection

    @staticmethod
    def _is_empty(connection: sqlite3.Connection) -> bool:
        ((identity,),) = connection.execute("PRAGMA application_id").fetchall()
        return not identity and not connection.execute("SELECT 1 FROM sqlite_master").fetchall()

    def _identify(self, connection: sqlite3.Connection) -> None:
        """ValueError for a file of another program or another release."""
        ((identity,),) = connection.execute("PRAGMA application_id").fetchall()
        ((version,),) = connection.execute("PRAGMA user_version").fetchall()
        if identity != APPLICATION_ID:
            raise ValueError(
                f"{self.path} is another program's SQLite file (application id {identity:#x}, expected "
                f"{APPLICATION_ID:#x}); give another path"
            )
        if version != SCHEMA_VERSION:
            raise ValueError(
                f"{self.path} is a cache of another release (layout {version}); this release reads and writes layout "
                f"{SCHEMA_VERSION}: give another path, or remove the file"
            )

    def _refuse_other_files(self) -> None:
        """ValueError if a damaged file may be a user's file, such as a table, and not a cache.

        The first page identifies a cache: it has SQLite's header with the application id, or the beginning of this
        header in a truncated file. A first page of zeros, in a file of whole pages, was never written.
        """
        with open(self.path, "rb") as file:
            page = file.read(PAGE_SIZE)
        identity = page[ID_START : ID_START + 4]
        if page.startswith(SQLITE_SIGNATURE) and APPLICATION_ID.to_bytes(4).startswith(identity):
            return
        if self.path.stat().st_size % PAGE_SIZE == 0 and not any(page):
            return
        raise ValueError(
            f"{self.path} is not a cache of simulations, and is not changed; give another path, such as "
            "'cache.sqlite'. If it is a cache with a damaged header, remove it"
        ) from None
