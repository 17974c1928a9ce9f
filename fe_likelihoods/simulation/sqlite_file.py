"""The SQLite file of the simulation cache: how it is made, known again, shared, and set aside when damaged.

The file is in WAL mode: readers never wait, writers take turns, and whoever is killed in the middle of a transaction
leaves the file as it was before it. It says by its application id that it is ours and by its user version which layout
it has; a file that says otherwise is somebody else's and is never written to.

SQLite must not be taken through a fork. So every process has a connection of its own, opened when it is first needed,
and those of a process are closed before it forks. WAL needs shared memory among all who use a file: keep it on a disk
of the machine, not on a network file system.
"""

import contextlib
import logging
import os
import sqlite3
import threading
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

try:
    from fcntl import LOCK_EX, LOCK_NB
    from fcntl import flock as lock_file
except ImportError:  # no such locks on this system: two programs must not find the same damage at once
    lock_file = None

__all__ = ["APPLICATION_ID", "SCHEMA_VERSION", "CacheFile", "is_damage"]

logger = logging.getLogger(__name__)

APPLICATION_ID = 0x46454C43  # "FELC"
SCHEMA_VERSION = 1
LAYOUT = (
    # the id tells the age, the unique key finds the row
    "CREATE TABLE simulations (id INTEGER PRIMARY KEY, key BLOB NOT NULL UNIQUE, misfit BLOB NOT NULL, "
    "n_steps INTEGER NOT NULL, reason BLOB NOT NULL, seconds REAL NOT NULL, crc INTEGER NOT NULL)",
    "CREATE TABLE responses (id INTEGER PRIMARY KEY, key BLOB NOT NULL UNIQUE, n_channels INTEGER NOT NULL, "
    "size INTEGER NOT NULL, crc INTEGER NOT NULL, response BLOB NOT NULL)",
    "CREATE INDEX response_sizes ON responses (size)",  # their sum without reading the responses
)
CHECK_SECONDS = 2.0  # for looking through the file when it is opened; rows have checksums of their own
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

_files: "weakref.WeakSet[CacheFile]" = weakref.WeakSet()
_files_lock = threading.Lock()
_held: "list[CacheFile]" = []


def _before_fork() -> None:
    _files_lock.acquire()
    for file in list(_files):
        file.lock.acquire()
        _held.append(file)
        file.close()


def _after_fork_in_parent() -> None:
    while _held:
        _held.pop().lock.release()
    _files_lock.release()


def _after_fork_in_child() -> None:
    while _held:
        _held.pop().lock = threading.RLock()
    _files_lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork_in_parent, after_in_child=_after_fork_in_child)


def _code(error: Exception) -> int:
    return (getattr(error, "sqlite_errorcode", None) or 0) & 0xFF


def is_damage(error: Exception) -> bool:
    """Whether an error says that the file itself is broken."""
    if isinstance(error, UnicodeDecodeError):  # SQLite's message quotes what it has found there
        return True
    return _code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class _Damaged(sqlite3.DatabaseError):
    """What we find broken ourselves."""

    sqlite_errorcode = sqlite3.SQLITE_CORRUPT


class CacheFile:
    """One file, and this process's connection to it; whoever uses the connection holds `lock`.

    Parameters
    ----------
    path : path
        The file; it is made if it is not there.
    timeout : float
        How long to wait for another writer [s].

    Attributes
    ----------
    path : Path
        Absolute, without links.
    lock : RLock
        Of this process's threads.
    writable : bool
        False for a file that can only be read.
    """

    def __init__(self, path: str | os.PathLike, timeout: float) -> None:
        self.path = Path(path).resolve()  # SQLite keeps the log beside the file that a link leads to
        self.timeout = float(timeout)
        self.lock = threading.RLock()
        self.writable = True
        self._connection: sqlite3.Connection | None = None
        self._inode: tuple[int, int] | None = None
        with _files_lock:
            _files.add(self)

    def __del__(self) -> None:
        if getattr(self, "_connection", None) is not None:
            self._connection.close()

    def check(self) -> None:
        """Open the file and look through it, before anything costly is done.

        A damaged file is set aside with a warning, and a new one begun.

        Raises
        ------
        ValueError
            If the path is a folder or lies in none, the file cannot be read or made, belongs to another program, or
            has another layout than this release writes.
        """
        folder = self.path.parent
        if self.path.is_dir():
            raise ValueError(f"{self.path} is a folder; a cache is a file: give a name in it, such as 'cache.sqlite'")
        if not folder.is_dir():
            raise ValueError(f"{self.path} cannot be made: there is no folder {folder}; make it first")
        if not self.path.exists() and not os.access(folder, os.W_OK | os.X_OK):
            raise ValueError(f"{self.path} cannot be made: nothing may be written to {folder}; give another path")
        try:
            open(self.path, "rb").close()
        except PermissionError:
            raise ValueError(
                f"{self.path} may not be read by this user; change its permissions or give another path"
            ) from None
        except OSError:  # not there, or SQLite says better what is wrong
            pass
        with self.lock:
            try:
                self._look_through(self.connection())
            except (sqlite3.Error, UnicodeDecodeError) as error:
                self.close()
                if not is_damage(error):
                    raise ValueError(f"{self.path} cannot be opened as a cache: {error}; give another path") from error
                if self._starts_with(HDF5_SIGNATURE):
                    raise ValueError(
                        f"{self.path} is an HDF5 file, not a cache: give another path; what SimulationCache."
                        "export_hdf5 wrote comes in with import_hdf5"
                    ) from None
                self._replace(error)

    def _replace(self, error: Exception) -> None:
        try:
            self.set_aside(str(error))
            self.connection()
        except (OSError, sqlite3.Error) as failure:
            raise ValueError(
                f"{self.path} is damaged ({error}) and could not be set aside ({failure}): remove it, or give another "
                "path"
            ) from failure

    def connection(self) -> sqlite3.Connection:
        """This process's connection; opened now if there is none.

        Raises
        ------
        ValueError
            If the file is another program's or of another layout.
        sqlite3.Error
            If it cannot be opened.
        """
        if self._connection is None:
            with self._alone():
                self._inode = self._inode_now()
                self.writable = self._inode is None or (
                    os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK | os.X_OK)
                )
                self._connection = self._open() if self.writable else self._open_to_read()
                self._inode = self._inode_now()
        return self._connection

    def close(self) -> None:
        """Close this process's connection; the next use opens one again."""
        with self.lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    def set_aside(self, why: str) -> None:
        """Rename a damaged file to ``<name>.damaged-<n>``, with a warning, unless another process has done so.

        Raises
        ------
        OSError
            If it cannot be renamed.
        """
        with self.lock, self._alone():
            self.close()
            if self._inode is None or self._inode_now() != self._inode:
                return
            n = 1
            while (aside := self.path.with_name(f"{self.path.name}.damaged-{n}")).exists():
                n += 1
            # the log first: beside a new file it would be taken for that one's
            for suffix in ("-wal", "-shm", ""):
                part = self.path.with_name(self.path.name + suffix)
                if part.exists():
                    os.rename(part, aside.with_name(aside.name + suffix))
            logger.warning("%s is damaged (%s): set aside as %s, a new cache is begun", self.path, why, aside.name)

    def _inode_now(self) -> tuple[int, int] | None:
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return None
        return status.st_dev, status.st_ino

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """No other process opens the file, or sets it aside, meanwhile: by a lock on the folder.

        SQLite finds the log by its name: who opened a damaged file while it is renamed would write into the log of the
        new one. A lock on the file itself would not do: to close a file takes all of SQLite's own locks from it.
        """
        if lock_file is None:
            yield
            return
        try:
            folder = os.open(self.path.parent, os.O_RDONLY)
        except OSError:  # a folder that may be used, not listed
            yield
            return
        try:
            give_up = time.monotonic() + self.timeout
            while True:
                try:
                    lock_file(folder, LOCK_EX | LOCK_NB)
                    break
                except OSError as error:  # a file system without such locks is no reason to stop
                    if not isinstance(error, BlockingIOError) or time.monotonic() > give_up:
                        break
                time.sleep(0.002)
            yield
        finally:
            os.close(folder)

    def _open(self) -> sqlite3.Connection:
        connection = self._connect("mode=rwc")
        try:
            if self._is_empty(connection):
                self._make(connection)
            self._identify(connection)
            self._patiently(connection, "PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
        except BaseException:
            connection.close()
            raise
        return connection

    def _open_to_read(self) -> sqlite3.Connection:
        """Without leave to write there may be no room for the shared memory: then the file is taken as unchanging."""
        for options in ("mode=ro", "mode=ro&immutable=1"):
            connection = self._connect(options)
            try:
                self._identify(connection)
                return connection
            except sqlite3.OperationalError as error:
                connection.close()
                last = error
            except BaseException:
                connection.close()
                raise
        raise last

    def _connect(self, options: str) -> sqlite3.Connection:
        return sqlite3.connect(
            f"{self.path.as_uri()}?{options}",
            uri=True,
            timeout=self.timeout,
            isolation_level=None,
            check_same_thread=False,
        )

    @staticmethod
    def _is_empty(connection: sqlite3.Connection) -> bool:
        ((identity,),) = connection.execute("PRAGMA application_id").fetchall()
        ((tables,),) = connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
        return identity == 0 and tables == 0

    def _make(self, connection: sqlite3.Connection) -> None:
        """All of the layout or nothing, by one process."""
        self._patiently(connection, "BEGIN IMMEDIATE")
        if self._is_empty(connection):
            for statement in LAYOUT:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        connection.execute("COMMIT")

    def _patiently(self, connection: sqlite3.Connection, statement: str) -> None:
        """Execute what SQLite does not wait for by itself while another process is at the same."""
        give_up = time.monotonic() + self.timeout
        while True:
            try:
                connection.execute(statement).fetchall()
                return
            except sqlite3.OperationalError as error:
                if _code(error) not in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED) or time.monotonic() > give_up:
                    raise
            time.sleep(0.005)

    def _identify(self, connection: sqlite3.Connection) -> None:
        ((identity,),) = connection.execute("PRAGMA application_id").fetchall()
        ((version,),) = connection.execute("PRAGMA user_version").fetchall()
        layout = dict(connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall())
        if identity != APPLICATION_ID:
            raise ValueError(
                f"{self.path} is another program's SQLite file (application id {identity:#x}, expected "
                f"{APPLICATION_ID:#x}; tables and indices {', '.join(sorted(layout)) or 'none'}): give another path"
            )
        if version != SCHEMA_VERSION:
            raise ValueError(
                f"{self.path} is a cache of layout {version}, this release reads and writes {SCHEMA_VERSION}: give "
                "another path, or remove the file"
            )
        if sorted(layout.values()) != sorted(LAYOUT):
            raise _Damaged("its tables are not those that were made")

    @staticmethod
    def _look_through(connection: sqlite3.Connection) -> None:
        """SQLite's own check, as far as it comes in a short time."""
        stop = time.monotonic() + CHECK_SECONDS
        connection.set_progress_handler(lambda: time.monotonic() > stop, 100_000)
        try:
            (answer,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        except sqlite3.OperationalError as error:
            if _code(error) != sqlite3.SQLITE_INTERRUPT:
                raise
            return
        finally:
            connection.set_progress_handler(None, 0)
        if answer != "ok":
            raise _Damaged(answer)

    def _starts_with(self, signature: bytes) -> bool:
        try:
            with open(self.path, "rb") as file:
                return file.read(len(signature)) == signature
        except FileNotFoundError:  # another process has set it aside meanwhile
            return False
