"""Faults of the cache and of processes that use it: no wrong value, no broken run, no lost simulation."""

import logging
import multiprocessing
import os
import pickle
import signal
import sqlite3
import tempfile
import time
import traceback
from pathlib import Path

import h5py
import numpy as np
import pytest

from fe_likelihoods.cache import file as cache_file
from fe_likelihoods.cache.file import SCHEMA_VERSION, CacheFile
from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from tests.cache.stored import look_up, store

ROOT = Path(__file__).parents[2]
MODEL = LinearOscillator(Record("sine", 0.02, np.sin(np.arange(20.0))))
FINGERPRINT = "model and data"

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM: processes are killed here")
FORK = multiprocessing.get_context("fork") if hasattr(os, "fork") else None


def likelihood_of(cache=None, **kwargs):
    return FELikelihood(MODEL, Measurements(MODEL.channels, MODEL.dt, np.ones((2, 20))), cache=cache, **kwargs)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache.sqlite"


@pytest.fixture
def thetas(rng):
    """Points, some of which fail because their stiffness is negative."""
    return np.column_stack([rng.uniform(-0.1, 2.0, size=400), rng.uniform(0.5, 2.0, size=400)])


@pytest.fixture
def expected(thetas):
    return likelihood_of().misfit(thetas)


@pytest.fixture
def filled(path, thetas):
    """A cache of all points, closed."""
    likelihood = likelihood_of(path)
    likelihood.misfit(thetas)
    likelihood.simulator.cache.close()
    return path


def sums_of(thetas):
    return np.column_stack([thetas.sum(axis=1), 1.0 / (1.0 + thetas[:, 0] ** 2)])


def at_once(function, arguments):
    """Exit codes of processes, one per argument, that are started at the same moment."""
    barrier = FORK.Barrier(len(arguments))

    def start(*args):
        barrier.wait(30)
        function(*args)

    processes = [FORK.Process(target=start, args=args) for args in arguments]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    return [process.exitcode for process in processes]


def integrity(path):
    with sqlite3.connect(path) as connection:
        answer = connection.execute("PRAGMA integrity_check").fetchall()
    connection.close()
    return answer


# killed ---------------------------------------------------------------------------------------------------------------


def batch_of(kill, number):
    rng = np.random.default_rng([kill, number])
    return rng.normal(size=(int(rng.integers(1, 300)), 3))


def write_until_killed(path, kill, pipe):
    cache = SimulationCache(path)
    for number in range(10_000):
        thetas = batch_of(kill, number)
        store(cache, FINGERPRINT, thetas, sums_of(thetas), [""] * len(thetas))
        pipe.send_bytes(number.to_bytes(4, "little"))


@pytest.mark.parametrize("kills", [5, pytest.param(40, marks=pytest.mark.slow)])
def test_killed_while_writing(path, rng, kills):
    """SIGKILL at random moments: acknowledged batches are stored, others are complete or absent."""
    acknowledged = []
    for kill in range(kills):
        receiver, sender = FORK.Pipe(duplex=False)
        process = FORK.Process(target=write_until_killed, args=(path, kill, sender))
        process.start()
        sender.close()
        for _ in range(6):  # also on a busy machine
            assert receiver.poll(30)
            acknowledged.append((kill, int.from_bytes(receiver.recv_bytes(), "little")))
        time.sleep(rng.uniform(0.0, 0.02))
        process.kill()
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
        try:
            while True:
                acknowledged.append((kill, int.from_bytes(receiver.recv_bytes(), "little")))
        except EOFError:
            pass
        assert integrity(path) == [("ok",)]
    cache = SimulationCache(path)
    known = []
    for kill, number in acknowledged:
        thetas = batch_of(kill, number)
        found = look_up(cache, FINGERPRINT, thetas, 2)
        known += (is_known := [each is not None for each in found])
        np.testing.assert_array_equal([each for each in found if each is not None], sums_of(thetas)[is_known])
    # the batch that a killed process may have stored without acknowledging it
    for kill in range(kills):
        thetas = batch_of(kill, 1 + max((n for k, n in acknowledged if k == kill), default=-1))
        assert len({each is None for each in look_up(cache, FINGERPRINT, thetas, 2)}) == 1
    assert cache.damaged == 0 and all(known)


# several at once ------------------------------------------------------------------------------------------------------


def test_programs_that_create_a_cache_at_the_same_moment(tmp_path):
    for attempt in range(5):
        path = tmp_path / f"{attempt}.sqlite"

        def begin(number, path=path):
            thetas = batch_of(1, number)
            store(SimulationCache(path), FINGERPRINT, thetas, sums_of(thetas), [""] * len(thetas))

        assert at_once(begin, [(number,) for number in range(6)]) == [0] * 6
        assert integrity(path) == [("ok",)]
        cache = SimulationCache(path)
        for number in range(6):
            thetas = batch_of(1, number)
            np.testing.assert_array_equal(look_up(cache, FINGERPRINT, thetas, 2), sums_of(thetas))


def test_two_programs_on_one_cache(path, thetas, expected):
    """Both get the right values and together store every simulation, so a third one runs none."""

    def run(order):
        likelihood = likelihood_of(path, memory_rows=0)
        for start in range(0, len(thetas), 10):
            rows = order[start : start + 10]
            np.testing.assert_array_equal(likelihood.misfit(thetas[rows]), expected[rows])

    forward = np.arange(len(thetas))
    assert at_once(run, [(forward,), (forward[::-1],)]) == [0, 0]
    third = likelihood_of(path)
    np.testing.assert_array_equal(third.misfit(thetas), expected)
    assert third.simulations == 0
    assert third.simulator.cache.info().simulations == len(thetas)


# damaged --------------------------------------------------------------------------------------------------------------


def test_another_program_that_holds_a_lock_on_the_file(path, thetas, expected, caplog, monkeypatch):
    cache = SimulationCache(path)
    cache.file.timeout = 0.05
    cache.close()  # the next connection has this limit
    blocker = sqlite3.connect(path, isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    likelihood = likelihood_of(cache)
    np.testing.assert_array_equal(likelihood.misfit(thetas[:200]), expected[:200])
    assert warnings_of(caplog, "cannot be written") == 1
    blocker.execute("ROLLBACK")
    blocker.close()
    cache.close()  # stores the waiting rows
    assert cache.info().simulations == 200


def warnings_of(caplog, text):
    """Number of warnings with this text."""
    return sum(text in record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING)


DAMAGES = {
    "no database": lambda data: b"what is this?\n" * 500,
    "zeros": lambda data: bytes(4096) + data[4096:],
    "cut off": lambda data: data[: len(data) // 2 // 4096 * 4096],
    "cut to its header": lambda data: data[:50],
    "overwritten": lambda data: data[:8192] + b"\xa5" * (len(data) // 2 - 8192) + data[len(data) // 2 :],
    "another column": lambda data: data.replace(b"theta BLOB", b"thete BLOB"),
    "without a table": None,
}


def spoil(path, damage):
    if DAMAGES[damage] is not None:
        path.write_bytes(DAMAGES[damage](path.read_bytes()))
        return
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE rows")
    connection.close()


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("when", ["before", "during the run"])
def test_a_damaged_file_is_set_aside(filled, thetas, expected, caplog, damage, when):
    likelihood = likelihood_of(filled)
    likelihood.misfit(thetas[: 50 * (when != "before")])
    likelihood.simulator.cache.close()  # as it happens before a fork
    filled.with_name(f"{filled.name}.damaged-1").write_text("an earlier one")
    spoil(filled, damage)
    data = filled.read_bytes()
    if when == "before" and damage == "no database":
        with pytest.raises(ValueError, match="is not a cache of simulations"):
            likelihood_of(filled)
        return
    likelihood = likelihood if when != "before" else likelihood_of(filled)
    np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
    aside = filled.with_name(f"{filled.name}.damaged-2")
    assert aside.read_bytes() == data
    assert warnings_of(caplog, f"set aside as {aside.name}") == 1
    again = likelihood_of(filled)
    np.testing.assert_array_equal(again.misfit(thetas), expected)
    assert again.simulations == 0 or when != "before"


def test_another_file_that_takes_the_place_of_the_cache_during_the_run(filled, thetas, expected, caplog, tmp_path):
    """It is not changed, and the run continues without a cache."""
    likelihood = likelihood_of(filled, memory_rows=0)
    likelihood.misfit(thetas[:50])
    likelihood.simulator.cache.close()
    table_of_the_user(tmp_path / "floors.csv")
    data = (tmp_path / "floors.csv").read_bytes()
    (tmp_path / "floors.csv").replace(filled)
    np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
    assert filled.read_bytes() == data
    assert not list(filled.parent.glob("*.damaged-*"))
    assert warnings_of(caplog, "is not a cache of simulations, and is not changed") > 0


@pytest.mark.parametrize("attempts", [4, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", ["bytes", "page", "cut"])
def test_damage_anywhere_is_never_a_wrong_value(filled, thetas, expected, rng, how, attempts):
    """Damage at random places, also while the file is open."""
    data = filled.read_bytes()
    served = 0
    for attempt in range(attempts):
        path = filled.with_name(f"{attempt}.sqlite")
        path.write_bytes(data)
        likelihood = likelihood_of(path)
        if attempt % 2:
            likelihood.simulator.cache.close()
        damaged = bytearray(data)
        place = int(rng.integers(100, len(data)))  # the first 100 bytes identify the file
        if how == "bytes":
            for where in rng.integers(100, len(data), size=2):
                damaged[where] ^= 1 << rng.integers(8)
        elif how == "page":
            damaged[place : place + 3000] = rng.bytes(len(damaged[place : place + 3000]))
        else:
            del damaged[place:]
        with open(path, "r+b") as file:
            file.write(damaged)
            file.truncate()
        np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
        served += likelihood.simulator.disk_hits
        again = likelihood_of(path)
        np.testing.assert_array_equal(again.misfit(thetas), expected)
    assert how != "bytes" or served > 0


@pytest.mark.parametrize(
    "change",
    [
        "value = (SELECT value FROM rows WHERE id = 9)",
        "value = zeroblob(8)",
        "value = 17",
        "reason = CAST('it failed' AS BLOB)",
        "generation = generation + 1",
        "session = 'soon'",
        "crc = crc + 1",
        "size = 0",
    ],
)
def test_a_damaged_row_is_missing(filled, thetas, expected, caplog, change):
    with sqlite3.connect(filled) as connection:
        connection.execute(f"UPDATE rows SET {change} WHERE id = 5")
    connection.close()
    likelihood = likelihood_of(filled)
    np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
    assert (likelihood.simulations, likelihood.simulator.cache.damaged) == (1, 1)
    assert warnings_of(caplog, "damaged rows") == 1
    again = likelihood_of(filled)
    np.testing.assert_array_equal(again.misfit(thetas), expected)
    assert (again.simulations, again.simulator.cache.damaged) == (0, 0)
    assert not list(filled.parent.glob("*.damaged-*"))


def test_rows_under_each_others_key_are_missing(filled, thetas, expected):
    with sqlite3.connect(filled) as connection:
        keys = dict(connection.execute("SELECT id, key FROM rows WHERE id IN (5, 9)").fetchall())
        for row, key in ((5, b"aside"), (9, keys[5]), (5, keys[9])):
            connection.execute("UPDATE rows SET key = ? WHERE id = ?", (key, row))
    connection.close()
    likelihood = likelihood_of(filled)
    np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
    assert (likelihood.simulations, likelihood.simulator.cache.damaged) == (2, 2)


def test_programs_that_find_a_damaged_file_at_once(filled):
    """It is set aside once, and all use the new one."""
    spoil(filled, "zeros")
    data = filled.read_bytes()

    def begin(number):
        thetas = batch_of(2, number)
        store(SimulationCache(filled), FINGERPRINT, thetas, sums_of(thetas), [""] * len(thetas))

    assert at_once(begin, [(number,) for number in range(6)]) == [0] * 6
    (aside,) = filled.parent.glob("*.damaged-*")
    assert aside.read_bytes() == data
    cache = SimulationCache(filled)
    assert not any(each is None for n in range(6) for each in look_up(cache, FINGERPRINT, batch_of(2, n), 2))


def test_a_log_left_behind_is_not_taken_for_that_of_a_new_file(filled, thetas):
    """The log is renamed together with the damaged file."""
    keep = sqlite3.connect(filled)  # an open connection keeps the log
    keep.execute("SELECT count(*) FROM rows").fetchall()
    cache = SimulationCache(filled)
    store(cache, FINGERPRINT, thetas, sums_of(thetas), [""] * len(thetas))
    log = filled.with_name(filled.name + "-wal")
    assert log.stat().st_size > 0
    cache.file.set_aside("for a test")
    assert not log.exists()
    assert SimulationCache(filled).info().simulations == 0
    keep.close()


# nothing can be written -----------------------------------------------------------------------------------------------


@pytest.fixture
def full(monkeypatch):
    """A context in which SQLite refuses to let the file grow."""
    switch = {"full": True}
    normal = CacheFile._open

    def limited(self):
        connection = normal(self)
        if switch["full"]:
            connection.execute("PRAGMA max_page_count = 1")  # limits the file to its present size
        return connection

    monkeypatch.setattr(CacheFile, "_open", limited)
    return switch


def test_a_full_disk_does_not_stop_the_run(path, thetas, expected, caplog, full, monkeypatch):
    full["full"] = False
    likelihood = likelihood_of(path)
    likelihood.misfit(thetas[:20])
    full["full"] = True
    likelihood.simulator.cache.file.close()
    for start in range(0, 300, 20):
        rows = slice(start, start + 20)
        np.testing.assert_array_equal(likelihood.misfit(thetas[rows]), expected[rows])
    assert warnings_of(caplog, "cannot be written (database or disk is full)") == 1
    likelihood.misfit(thetas[:300])
    assert likelihood.simulations == 300
    stored = likelihood.simulator.cache.info().simulations
    assert 20 <= stored < 300
    assert not list(path.parent.glob("*damaged*"))  # a full disk is no damage
    # space becomes available: the waiting rows are stored with the next ones
    full["full"] = False
    likelihood.simulator.cache.file.close()
    likelihood.misfit(thetas[300:310])
    assert likelihood.simulator.cache.info().simulations == stored  # writing is not tried again before the pause ends
    monkeypatch.setattr(cache_file, "RETRY_SECONDS", 0.0)
    likelihood.simulator.cache.file.retry_times["written"] = time.monotonic()
    likelihood.misfit(thetas[310:320])
    again = likelihood_of(path)
    np.testing.assert_array_equal(again.misfit(thetas[:320]), expected[:320])
    assert again.simulations == 0
    assert integrity(path) == [("ok",)]


@pytest.fixture
def open_folder():
    """A folder that another user can enter, unlike the folders of pytest."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        yield Path(folder)
        os.chmod(folder, 0o755)


def as_somebody(function):
    """Run a function as a user to whom permissions apply (root ignores them), and raise its exceptions."""
    receiver, sender = FORK.Pipe(duplex=False)

    def run():
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(65534)
                os.setuid(65534)
            function()
            sender.send("")
        except BaseException:
            sender.send(traceback.format_exc())

    process = FORK.Process(target=run)
    process.start()
    sender.close()
    assert receiver.poll(60)
    problem = receiver.recv()
    process.join(60)
    assert not problem, problem


def test_paths_without_permission_are_refused(open_folder):
    closed = open_folder / "closed"
    closed.mkdir()
    secret = open_folder / "secret.sqlite"
    SimulationCache(secret).close()
    SimulationCache(closed / "filled.sqlite").close()
    (closed / "filled.sqlite").chmod(0o444)
    secret.chmod(0o000 if os.geteuid() else 0o600)
    closed.chmod(0o555)

    def run():
        for path in (secret, closed / "filled.sqlite", closed / "cache.sqlite"):
            with pytest.raises(ValueError, match="cannot be opened as a cache"):
                SimulationCache(path)

    as_somebody(run)


# files of other programs ----------------------------------------------------------------------------------------------


def foreign_tables(path):
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE simulations (id INTEGER PRIMARY KEY, anything TEXT)")
        connection.execute("INSERT INTO simulations VALUES (1, 'precious')")


def later_layout(path):
    SimulationCache(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    connection.close()


def hdf5_file(path):
    with h5py.File(path, "w") as file:
        file["chain"] = np.arange(3)


def table_of_the_user(path):
    path.write_text("time_s,floor1_g,roof_g\n" + "".join(f"{0.01 * k:.2f},0.1,0.2\n" for k in range(1000)))


def damaged_database(path):
    """A database of another program, damaged where SQLite detects it before the application id is read."""
    foreign_tables(path)
    data = path.read_bytes()
    path.write_bytes(data[:100] + b"\xa5" * 300 + data[400:])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (table_of_the_user, "is not a cache of simulations, and is not changed; give another path"),
        (damaged_database, "is not a cache of simulations"),
        (foreign_tables, "another program's SQLite file"),
        (later_layout, rf"layout {SCHEMA_VERSION + 1}\); this release reads and writes layout {SCHEMA_VERSION}"),
        (hdf5_file, "is not a cache of simulations"),
        (Path.mkdir, "in an existing folder"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_other_files_are_refused_and_not_changed(path, make, message):
    make(path)
    before = path.read_bytes() if path.is_file() else None
    for _ in range(2):
        with pytest.raises(ValueError, match=message):
            likelihood_of(path)
    assert before == (path.read_bytes() if path.is_file() else None)
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("path", [17, None, b"cache.sqlite", ["cache.sqlite"], "nowhere/cache.sqlite"])
def test_values_that_are_not_paths(path):
    with pytest.raises(ValueError, match="expected the path of a file"):
        SimulationCache(path)


def test_file_names_with_special_characters_of_uris(tmp_path, thetas, expected):
    path = tmp_path / "a b?mode=memory#c%20d\N{GREEK SMALL LETTER THETA}.sqlite"
    likelihood_of(path).misfit(thetas)
    assert path.exists()
    assert SimulationCache(path).info().simulations == len(thetas)


def test_a_link_leads_to_one_cache(tmp_path, thetas):
    real = tmp_path / "real" / "cache.sqlite"
    real.parent.mkdir()
    link = tmp_path / "link.sqlite"
    link.symlink_to(real)
    likelihood_of(link).misfit(thetas)
    assert real.exists()
    likelihood = likelihood_of(real)
    likelihood.misfit(thetas)
    assert likelihood.simulations == 0
    likelihood.simulator.cache.close()
    spoil(real, "zeros")
    SimulationCache(link)
    assert link.is_symlink() and list(real.parent.glob("*.damaged-1"))


def test_a_file_that_is_not_accessible_after_unpickling(path, thetas, expected, caplog):
    """A worker on another machine continues without the file."""
    likelihood = likelihood_of(path)
    data = pickle.dumps(likelihood)
    likelihood.simulator.cache.close()
    path.unlink()
    path.mkdir()
    copy = pickle.loads(data)
    for _ in range(2):
        np.testing.assert_array_equal(copy.misfit(thetas), expected)
    assert warnings_of(caplog, "cannot be read") == 1
