"""A disk that is full: one OSError that says what is kept, and the same process goes on when there is space again.

The size of files is limited (RLIMIT_FSIZE) in a forked process, in place of the disk.
"""

import resource
import shutil
import warnings

import h5py
import numpy as np
import pytest

from tests.faults.interrupted import make, state_of
from tests.faults.kills import fork

STEPS = 12
BALLAST = 300_000  # size of another group in the file [bytes], so that it reaches the limit before the journal

KEPT = (
    "Everything stored before is intact",
    "are kept in run.h5.mcmc.journal. Free some disk space, and make the same call or run the same script again",
    "Free some disk space and run again",  # before the start of the run
)

pytestmark = [
    pytest.mark.filterwarnings("ignore::samplers.SamplingWarning"),
    pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning"),
]


def limit_files(size):
    """Limit the size of files of this process [bytes]; None: no limit."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard if size is None else size, hard))


def prepare(path, ballast):
    """The file, with or without another group."""
    if ballast:
        with h5py.File(path, "w") as file:
            file["other"] = np.arange(BALLAST // 8)


def full_disk(path, size):
    """Run a script against the limit, twice, and once more without it: messages, and whether all is as it should be."""
    limit_files(size)
    messages, sampler, done = [], None, False
    for attempt in range(3):
        if attempt == 2:
            limit_files(None)
        if not done:  # a file that was rebuilt may be small enough
            try:
                sampler = make(path) if sampler is None else sampler
                sampler.run_mcmc(None, STEPS)
                done = True
            except OSError as error:
                messages.append(str(error))
    state = state_of(sampler)
    sampler.backend.close()
    again = make(path)  # the same script, in this process
    again.run_mcmc(None, STEPS)
    return "\n".join([str(state == state_of(again)), str(hash(state)), *messages])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    sampler = make(path)
    sampler.run_mcmc(None, STEPS)
    sampler.backend.close()
    return sampler, path.stat().st_size, sampler.backend.journal_path.stat().st_size


def check(folder, whole, size, ballast, fewest=2):
    """A run against a limit; its messages, of which there should be so many."""
    path = folder / "run.h5"
    prepare(path, ballast)

    def child(_):
        warnings.simplefilter("ignore")
        return full_disk(path, size).encode()

    status, said = fork(child)
    same, state, *messages = said.decode().split("\n")
    assert status == 0, said.decode()
    assert same == "True" and state == str(hash(state_of(whole[0])))
    assert fewest <= len(messages) <= 2, "the limit was not reached"
    for message in messages:
        assert any(part in message for part in KEPT), message
    later = make(path)  # in a new process
    assert state_of(later) == state_of(whole[0])
    later.backend.close()
    if ballast:
        with h5py.File(path) as file:
            assert np.array_equal(file["other"], np.arange(BALLAST // 8))
    return messages


@pytest.mark.parametrize("size", [1_000, 30_000])
def test_no_room_for_the_first_bytes_or_the_next_ones(tmp_path, whole, size):
    for message in check(tmp_path, whole, size, False):
        assert "could not be written (File too large)" in message


@pytest.mark.parametrize("room", [9_000, 30_000])
def test_no_room_for_the_chain(tmp_path, whole, room):
    """The library keeps a file that it could not write: it is rebuilt under its name."""
    for message in check(tmp_path, whole, BALLAST + room, True):
        assert "the chain could not be written (File too large)" in message


@pytest.mark.slow
def test_no_room_anywhere(tmp_path, whole):
    """Every size of the files in steps of 1 kB."""
    for ballast in (False, True):
        for size in range(1000, max(whole[1], whole[2]), 1000):
            folder = tmp_path / f"{ballast}_{size}"
            folder.mkdir()
            check(folder, whole, size + ballast * BALLAST, ballast, fewest=0)
            shutil.rmtree(folder)
