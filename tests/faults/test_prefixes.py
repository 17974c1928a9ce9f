"""Every state that a kill can leave in journal and file: the same script goes on from it, and then adds nothing.

A small run with failures, blobs, a reset and two calls is recorded. The journal is appended to, so that its prefixes
are its earlier states; the HDF5 file is copied whenever it has changed. In the order in which they were written, the
pairs of journal and file are what a kill can leave. The other pairs, with a journal behind its file, are what a
truncated journal leaves.
"""

import logging
import os
import pickle
import struct

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler
from samplers.storage.journal import BEFORE_CONTENT, MAGIC, Journal
from samplers.storage.journal_contents import read_journal
from tests.contract.targets import WithBlobs

N, NDIM, STEPS = 6, 1, 3

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


class Fragile(WithBlobs):
    """Raises an exception for some points."""

    def __call__(self, x):
        if x[0] < 0.2:
            raise ArithmeticError("no equilibrium")
        return super().__call__(x)


def make(path, **settings):
    settings = {"seed": 5, "min_moves": 1, "max_moves": 1, "check_draws": 3, "max_failure_share": 0.95, **settings}
    backend = emcee.backends.HDFBackend(str(path))
    posterior = Fragile(ndim=NDIM, sd=0.2)
    return SMCSampler(N, NDIM, posterior, backend=backend, recycle=False, **settings)


def script(path):
    """Burn-in, reset, and the steps that count."""
    sampler = make(path)
    state = sampler.run_mcmc(None, 2)
    sampler.reset()
    sampler.run_mcmc(state, STEPS)
    sampler.backend.close()
    return sampler


def journal_of(path):
    return path.with_name(path.name + ".mcmc.journal")


def state_of(sampler):
    """Everything that two runs are compared by."""
    backend = sampler.backend
    return (
        sampler.get_chain().tobytes(),
        sampler.get_log_prob().tobytes(),
        sampler.get_blobs().tobytes(),
        backend.accepted.tobytes(),
        sampler.random_state[1].tobytes(),
        [stage._replace(seconds=0) for stage in sampler.ladder],
        sampler.log_evidence_check,
    )


def counts_of(sampler):
    failures = [(f["parameters"].tobytes(), f["reason"]) for f in sampler.failures]
    return sampler.evaluations, failures, sampler.verdict


def ends(data):
    """Ends of the blocks of a journal; the journal appears with the first two."""
    places, place = [], len(MAGIC)
    while place < len(data):
        place += BEFORE_CONTENT + struct.unpack_from("<4sQI", data, place)[1]
        places.append(place)
    return places[1:]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The finished run, its journal, and (size of the journal, file) in the order of writing."""
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    states, append = [], Journal._write

    def note():
        size = journal_of(path).stat().st_size
        state = (size, path.read_bytes() if path.exists() else None)
        if not states or state != states[-1]:
            states.append(state)

    def noted(self, data):
        note()
        append(self, data)
        note()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "_write", noted)
        patch.setattr("samplers.storage.backends.SECONDS_BETWEEN_WRITES", 0.0)
        whole = script(path)
        states.append((journal_of(path).stat().st_size, path.read_bytes()))
    return whole, journal_of(path).read_bytes(), states


def goes_on(folder, journal, file, recorded, same=True, counts=True, twice=True):
    """The script, started with a journal and a file, ends like the whole run; started again, it adds nothing."""
    whole = recorded[0]
    path = folder / "run.h5"
    for written, data in ((path, file), (journal_of(path), journal)):
        written.unlink(missing_ok=True)
        if data is not None:
            written.write_bytes(data)
    sampler = script(path)
    assert sampler.iteration == STEPS
    if same:
        assert state_of(sampler) == state_of(whole)
    if counts:
        assert counts_of(sampler) == counts_of(whole)
    if twice:
        adds_nothing(path, sampler, counts)
    for left in folder.iterdir():
        if left not in (path, journal_of(path)):
            left.unlink()


def adds_nothing(path, sampler, counts):
    before = journal_of(path).read_bytes() if journal_of(path).exists() else None, path.read_bytes()
    again = script(path)
    after = journal_of(path).read_bytes() if journal_of(path).exists() else None, path.read_bytes()
    assert before == after and state_of(again)[:5] == state_of(sampler)[:5]
    if counts:
        assert counts_of(again) == counts_of(sampler)


def test_every_state_that_a_kill_can_leave(recorded, tmp_path):
    """Every block of the journal, with the file as it was before and after the block."""
    _, data, states = recorded
    assert len(ends(data)) >= 25 and len({file for _, file in states}) > 10
    for number, (size, file) in enumerate(states):
        goes_on(tmp_path, data[:size], file, recorded, twice=number % 8 == 0)


def test_before_the_journal(recorded, tmp_path):
    """No file; the empty chain without the journal; a journal that is being written under another name."""
    _, data, states = recorded
    make(tmp_path / "run.h5")
    empty = (tmp_path / "run.h5").read_bytes()
    for file in (None, empty):
        goes_on(tmp_path, None, file, recorded)
        journal_of(tmp_path / "run.h5").with_suffix(".journal.new").write_bytes(data[:100])
        (tmp_path / "run.h5.new").write_bytes(empty[:1000])
        goes_on(tmp_path, None, file, recorded)


def test_every_incomplete_block(recorded, tmp_path):
    """A journal that ends within a block is read as if it ended before it."""
    _, data, _ = recorded
    path = tmp_path / "journal"
    places = ends(data)
    for place, following in zip(places, places[1:], strict=False):
        path.write_bytes(data[:place])
        contents = read_journal(path)
        inner = {place + n for n in (1, BEFORE_CONTENT - 1, BEFORE_CONTENT, BEFORE_CONTENT + 1)}
        for cut in inner | {(place + following) // 2, following - 1}:
            if place < cut < following:
                path.write_bytes(data[:cut])
                rest = read_journal(path)
                assert rest.whole == place
                assert pickle.dumps(rest._replace(size=0)) == pickle.dumps(contents._replace(size=0))


def test_a_start_that_is_cut(recorded, tmp_path):
    """The journal appears as a whole; cut by anything else, the same script goes on as well."""
    _, data, states = recorded
    empty = states[0][1]
    for size in (0, 1, len(MAGIC), 40, 1000, ends(data)[0] - 1):
        goes_on(tmp_path, data[:size], empty, recorded)


@pytest.mark.slow
def test_every_order_of_flushes(recorded, tmp_path, caplog):
    """Every block of the journal with every state of the file."""
    caplog.set_level(logging.ERROR)
    _, data, states = recorded
    files = list(dict.fromkeys(file for _, file in states))
    oldest = {file: min(size for size, other in states if other == file) for file in files}
    for size in ends(data):
        for file in files:
            behind = size < oldest[file]
            goes_on(tmp_path, data[:size], file, recorded, counts=not behind)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_lost_file_is_rebuilt_from_the_journal(recorded, tmp_path, share, caplog):
    _, data, _ = recorded
    places = ends(data)
    goes_on(tmp_path, data[: places[int(share * len(places))]], None, recorded)
    assert "is missing or has no group mcmc: rebuilt from" in caplog.text


def test_a_truncated_journal_never_shortens_the_chain(recorded, tmp_path, caplog):
    """Not by making a sampler, nor by running it."""
    whole, data, states = recorded
    path = tmp_path / "run.h5"
    for place in ends(data):
        path.write_bytes(states[-1][1])
        journal_of(path).write_bytes(data[:place])
        sampler = make(path)
        assert path.read_bytes() == states[-1][1] and journal_of(path).read_bytes() == data[:place]
        assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert "since the journal was truncated" in caplog.text


def test_between_blobs_and_has_blobs(recorded, tmp_path):
    """emcee enters both one after the other."""
    import h5py

    _, data, states = recorded
    path = tmp_path / "run.h5"
    size = next(size for size, _ in states if b"CALL" in data[:size])
    path.write_bytes(next(file for other, file in states if other == size))
    with h5py.File(path, "a") as file:
        if "blobs" not in file["mcmc"]:
            file["mcmc"].create_dataset("blobs", (2, N, 2), maxshape=(None, N, 2), dtype=float)
        file["mcmc"].attrs["has_blobs"] = False
    goes_on(tmp_path, data[:size], path.read_bytes(), recorded)


@pytest.mark.parametrize("damage", ["ladder", "check", "blobs", "longer ladder"])
def test_ladder_and_blobs_are_compared_with_the_journal(recorded, tmp_path, damage, caplog):
    import h5py

    whole, data, states = recorded
    path = tmp_path / "run.h5"
    path.write_bytes(states[-1][1])
    journal_of(path).write_bytes(data)
    with h5py.File(path, "a") as file:
        ladder = file["mcmc/ladder"]
        if damage == "ladder":
            rows = ladder[...]
            rows["log_evidence_increment"][1] += 1.0
            ladder[...] = rows
        elif damage == "longer ladder":
            ladder.resize(len(ladder) + 1, axis=0)
        elif damage == "check":
            ladder.attrs["evidence_check"] = ladder.attrs["evidence_check"] + 1.0
        else:
            file["mcmc/blobs"][1, 2] += 1.0
    sampler = make(path)
    assert sampler.ladder == whole.ladder and sampler.log_evidence == whole.log_evidence
    assert np.array_equal(sampler.get_blobs(), whole.get_blobs())
    assert ("differs from its journal: kept as" in caplog.text) == (damage != "check")
    assert os.path.exists(f"{path}.damaged") == (damage != "check")


def test_without_a_journal_a_damaged_chain_is_refused(recorded, tmp_path):
    import h5py

    _, _, states = recorded
    path = tmp_path / "run.h5"
    path.write_bytes(states[-1][1])
    assert make(path).iteration == STEPS
    with h5py.File(path, "a") as file:
        file["mcmc/blobs"][1, 2] += 1.0
    with pytest.raises(ValueError, match="does not agree with its checksum"):
        make(path)


def test_warnings_are_those_of_the_run(recorded, tmp_path):
    """A repeated call warns like the call itself."""
    _, data, states = recorded
    path = tmp_path / "run.h5"
    path.write_bytes(states[-1][1])
    journal_of(path).write_bytes(data)
    with pytest.warns(SamplingWarning, match="no equilibrium"):
        make(path).run_mcmc(None, 2)
