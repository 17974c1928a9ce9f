"""Damage to the two files of a run: nothing in the record is evaluated again, and the results keep their bits."""

import contextlib
import copy
import os
import pickle
import resource
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import emcee
import h5py
import numpy as np
import pytest

from samplers import SMCSampler
from samplers.evaluation import evaluator
from tests.contract.targets import Gaussian
from tests.covering import covering
from tests.faults.kills import end, evaluated_again, fork
from tests.faults.records import points_of as recorded_points
from tests.faults.records import record_of
from tests.faults.resumable_run import NDIM, STEPS, N, go_on, make, outcome, points_of

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


@pytest.fixture(scope="module", params=["smc", "guided"])
def whole(request, tmp_path_factory):
    """Kind, file and outcome of a finished run."""
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sampler = go_on(make(path, request.param, log=path.with_name("log")))
    sampler._record.close()
    return request.param, path, outcome(sampler)


def copied(path, folder):
    """A copy of the files of a run."""
    folder.mkdir(exist_ok=True)
    for name in (path, record_of(path)):
        shutil.copy(name, folder / name.name)
    return folder / path.name


def garble(data):
    return np.random.default_rng(len(data)).bytes(len(data))


CHAINS = {
    "kept": lambda path: None,
    "deleted": os.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "halved": lambda path: os.truncate(path, path.stat().st_size // 2),
    "garbled": lambda path: path.write_bytes(garble(path.read_bytes())),
    "a bit": lambda path: path.write_bytes(flipped(path.read_bytes(), 0.6)),
}


def flipped(data, share):
    """Bytes of which one bit differs."""
    changed = bytearray(data)
    changed[int(share * (len(data) - 1))] ^= 4
    return bytes(changed)


@pytest.mark.parametrize(
    ("chain", "share"), covering([name for name in CHAINS if name != "a bit"], [0.02, 0.2, 0.5, 0.9, 1.0], strength=1)
)
def test_a_record_that_is_cut_anywhere(whole, chain, share, tmp_path):
    kind, path, expected = whole
    path = copied(path, tmp_path)
    data = record_of(path).read_bytes()
    place = int(share * len(data))
    record_of(path).write_bytes(data[:place])
    known = set(recorded_points(path))
    CHAINS[chain](path)
    if share == 0.02 and chain in ("halved", "garbled"):  # before the start of the run
        with pytest.raises(ValueError, match="is damaged, and has no record"):
            make(path, kind)
        return
    sampler = make(path, kind, log=tmp_path / "log")
    if sampler.iteration == STEPS:  # the chain is whole, and the record has lost some of its points
        go_on(sampler)
        assert sampler.iteration == STEPS
        return
    go_on(sampler)
    assert outcome(sampler) == expected
    sampler._record.close()
    assert not set(points_of(tmp_path / "log")) - set(points_of(whole[1].with_name("log")))
    again = set(points_of(tmp_path / "log"))
    assert len(again & known) <= 2  # a comparison


@pytest.mark.parametrize("chain", ["kept", pytest.param("deleted", marks=pytest.mark.slow)])
def test_a_record_with_a_changed_byte(whole, chain, tmp_path, caplog):
    """In the name of the format: refused. Elsewhere: what is behind the byte is evaluated again."""
    kind, source, expected = whole
    for share in np.linspace(0.001, 0.999, 7):
        path = copied(source, tmp_path)
        record_of(path).write_bytes(flipped(record_of(path).read_bytes(), share))
        CHAINS[chain](path)
        caplog.clear()
        sampler = go_on(make(path, kind))
        assert "damaged after" in caplog.text and Path(f"{record_of(path)}.damaged").exists()
        assert sampler.iteration == STEPS
        if chain == "deleted":
            assert outcome(sampler) == expected
        sampler._record.close()
        for name in tmp_path.iterdir():
            name.unlink()
    path = copied(source, tmp_path)
    record_of(path).write_bytes(b"x" + record_of(path).read_bytes()[1:])
    with pytest.raises(ValueError, match="is not the record of a run"):
        make(path, kind)


@pytest.mark.parametrize(
    "change",
    [
        "group['accepted'][0] += 1",
        "group.attrs['iteration'] -= 1",
        "group.attrs['random_state_2'] += 1",
        "group['blobs'][-1, 3] += 1.0",
        "group['chain'][0, 3] += 1.0",
        "group['tempering'][3:] = 0",
        "del group.attrs['has_blobs']",
    ],
)
def test_a_chain_that_something_else_has_changed_is_made_again(whole, change, tmp_path):
    """Nothing is evaluated but a comparison."""
    kind, path, expected = whole
    path = copied(path, tmp_path)
    with h5py.File(path, "a") as file:
        exec(change, {"group": file["mcmc"]})
    sampler = go_on(make(path, kind, log=tmp_path / "log"))
    assert outcome(sampler) == expected and Path(f"{path}.damaged").exists()
    assert len(points_of(tmp_path / "log")) <= 2
    sampler._record.close()


def test_a_lost_record_leaves_the_chain(whole, tmp_path):
    """The chain goes on as with emcee, where its last step is of the same posterior."""
    kind, path, _ = whole
    path = copied(path, tmp_path)
    record_of(path).unlink()
    with pytest.raises(ValueError, match="contains another run"):
        make(path, kind, sd=0.02).run_mcmc(None, 1)
    sampler = make(path, kind)
    ladder = sampler.ladder
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == STEPS + 2 and sampler.ladder == ladder


def test_another_run_is_refused_and_nothing_is_changed(whole, tmp_path):
    kind, path, _ = whole
    path = copied(path, tmp_path)
    before = record_of(path).read_bytes(), path.read_bytes()
    for change, message in (({"max_failure_share": 0.2}, "max_failure_share was"), ({"sd": 0.02}, "log_prob_fn was")):
        with pytest.raises(ValueError, match=message):
            make(path, kind, **change).run_mcmc(None, 1)
        assert (record_of(path).read_bytes(), path.read_bytes()) == before


def test_the_chain_of_another_run_begins_a_new_record(whole, tmp_path, caplog):
    kind, path, _ = whole
    path = copied(path, tmp_path)
    other = make(tmp_path / "other.h5", kind, seed=6)
    other.run_mcmc(None, 1)
    other._record.close()
    shutil.copy(tmp_path / "other.h5", path)
    earlier = record_of(path).read_bytes()
    sampler = make(path, kind)
    assert "replaced by the chain of another run" in caplog.text
    sampler.run_mcmc(None, 1)
    assert record_of(path).read_bytes().startswith(earlier)
    assert np.array_equal(sampler.get_chain()[:1], other.get_chain())


HOLDER = """
import h5py, sys
with h5py.File(sys.argv[1], sys.argv[2]) as file:
    if sys.argv[2] != "r":
        file.require_group("of another program").attrs["kept"] = True
    print("open", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def held(path, mode):
    """Another process holds a file open."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(path), mode], **pipes) as process:
        assert process.stdout.readline() == "open\n"
        yield
        process.stdin.close()


@pytest.fixture(scope="module")
def whole_smc(tmp_path_factory):
    return outcome(go_on(make(tmp_path_factory.mktemp("smc") / "run.h5", "smc")))


@pytest.mark.parametrize("begins", ["before", "in the run"])
def test_a_program_that_reads_the_file_is_no_obstacle(begins, whole_smc, tmp_path):
    path = tmp_path / "run.h5"
    sampler = make(path, "smc")
    sampler.run_mcmc(None, 1)
    with contextlib.ExitStack() as stack:
        if begins == "before":
            stack.enter_context(held(path, "r"))
            stack.enter_context(h5py.File(path, "r"))  # and this process
        for _ in sampler.sample(None, iterations=STEPS - 1):
            if begins == "in the run" and sampler.iteration == 2:
                stack.enter_context(held(path, "r"))
        assert emcee.backends.HDFBackend(str(path)).iteration == STEPS
    assert outcome(sampler) == whole_smc


def test_a_program_that_changes_the_file(whole_smc, tmp_path):
    """Its changes are not overwritten; steps stay in the sampler, and the next call writes them elsewhere."""
    path, log = tmp_path / "run.h5", tmp_path / "log"
    sampler = make(path, "smc", log=log)
    sampler.run_mcmc(None, 1)
    with contextlib.ExitStack() as stack, pytest.raises(OSError, match="changed by another program .*: move it away"):
        for _ in sampler.sample(None, iterations=STEPS - 1):
            if sampler.iteration == 2:
                stack.enter_context(held(path, "a"))
    assert outcome(sampler) == whole_smc
    assert copy.deepcopy(sampler).iteration == pickle.loads(pickle.dumps(sampler)).iteration == STEPS
    with h5py.File(path) as file:
        assert file["of another program"].attrs["kept"] and file["mcmc"].attrs["iteration"] == 1
    path.rename(tmp_path / "changed.h5")
    sampler.run_mcmc(None, 0)
    sampler._record.close()
    again = make(path, "smc", log=log)
    assert again.iteration == STEPS and outcome(go_on(again)) == whole_smc
    assert evaluated_again(log) == 0 and not list(tmp_path.rglob("*.damaged"))


def test_a_sampler_that_does_not_know_the_chain_of_another_one_leaves_it_alone(tmp_path):
    """Made before the other one ran, or before the other one went on: it is refused, and nothing is changed."""
    path = tmp_path / "run.h5"
    first, second = make(path, "smc"), make(path, "smc")
    first.run_mcmc(None, 2)
    chain = first.get_chain()
    with pytest.raises(ValueError, match="another sampler has written to .* make the sampler again"):
        second.run_mcmc(None, 1)
    third = make(path, "smc")
    third.run_mcmc(None, 1)
    with pytest.raises(ValueError, match="another sampler has written to"):
        first.run_mcmc(None, 1)
    assert third.iteration == make(path, "smc").iteration == 3 and np.array_equal(third.get_chain()[:2], chain)


def limit_files(size):
    """Limit the size of files of this process [bytes]; None: no limit."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard if size is None else size, hard))


@pytest.mark.parametrize(
    ("size", "ballast"),
    [
        *((10_000, 0), (20_000, 300_000)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1_000, 0), (30_000, 0), (9_000, 300_000))),
    ],
)
def test_a_full_disk(size, ballast, tmp_path):
    """Files may not grow: an OSError; a new process goes on when there is space again, and evaluates nothing twice."""
    path, log = tmp_path / "run.h5", tmp_path / "log"
    expected = outcome(go_on(make(tmp_path / "whole.h5", "smc")))
    if ballast:  # another group, so that the file of the chain reaches the limit before the record
        with h5py.File(path, "w") as file:
            file["other"] = np.arange(ballast // 8)

    def limited():
        limit_files(size + ballast)
        go_on(make(path, "smc", log=log))

    def unlimited():
        return pickle.dumps(outcome(go_on(make(path, "smc", log=log))))

    for _ in range(2):
        status, said = end(*fork(limited))
        assert status != 0 and b"rror" in said
    status, said = end(*fork(unlimited))
    assert status == 0, said.decode()
    assert pickle.loads(said) == expected
    assert evaluated_again(log) == 0


# ---------------------------------------------------------------------- half-opened records, names, earlier steps


def test_names_of_groups_and_files_that_are_alike(tmp_path):
    """Groups "a.b" and "a/b" have a record each; two names of one file have one record, and one lock."""

    def sampler(file, name, seed):
        backend = emcee.backends.HDFBackend(str(file), name=name)
        return SMCSampler(N, NDIM, Gaussian(NDIM), vectorize=True, seed=seed, backend=backend)

    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.create_group("a/other").attrs["kept"] = True
        file.attrs["note"] = "kept"
    one, two = sampler(path, "a.b", 1), sampler(path, "a/b", 2)
    one.run_mcmc(None, 1)
    two.run_mcmc(None, 1)
    assert not np.array_equal(one.get_chain(), two.get_chain())
    with h5py.File(path) as file:
        assert file["a/other"].attrs["kept"] and file.attrs["note"] == "kept"
    link = tmp_path / "link.h5"
    link.symlink_to(path)
    again = sampler(link, "a.b", 1)
    assert again._record.path == one._record.path and again.iteration == 1 and link.is_symlink()


def test_a_second_process_that_finds_a_live_run_does_not_touch_its_files(tmp_path):
    """Between two writes, the file of a live run looks damaged."""
    path = tmp_path / "run.h5"
    first = make(path, "smc")
    first.run_mcmc(None, 1)
    with h5py.File(path, "a") as file:
        file["mcmc/blobs"][0, 3] += 1.0
    before = path.read_bytes()

    def second():
        make(path, "smc")

    status, said = end(*fork(second))
    assert status != 0 and b"another run is writing" in said
    assert path.read_bytes() == before


@pytest.mark.parametrize("in_file", [True, False])
def test_a_copy_goes_on_by_itself(in_file, tmp_path):
    """What a copy evaluates is in its own record, in its file and in its limit."""
    path = tmp_path / "run.h5" if in_file else None
    sampler = make(path, "moves")
    sampler.run_mcmc(None, 1)
    copied_sampler = copy.deepcopy(sampler)
    assert copied_sampler._evaluator.record is copied_sampler._record
    made = sampler.evaluations
    copied_sampler.max_simulations = made + N
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        copied_sampler.run_mcmc(None, 50)
    assert made < copied_sampler.evaluations <= made + N and sampler.evaluations == made
    if in_file:
        copied_sampler._record.close()
        assert make(path, "moves").evaluations == copied_sampler.evaluations


def test_parts_of_a_batch_that_fail_do_not_end_a_run_that_goes_on(tmp_path):
    """Values that were stored before Ctrl-C are successes; those left of their batch may all be failures."""

    class Fails(Gaussian):
        stop = None

        def __call__(self, x):
            self.calls += 1
            if self.calls == self.stop:
                raise KeyboardInterrupt
            if x[0] < -0.5:
                raise RuntimeError("no convergence")
            return super().__call__(x)

    def sampler(posterior):
        backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
        return SMCSampler(N, 1, posterior, seed=3, backend=backend)

    posterior = Fails(1)
    posterior.stop = N // 2
    evaluator.SECONDS_BETWEEN_NOTES, before = 1e9, evaluator.SECONDS_BETWEEN_NOTES  # successes are stored at Ctrl-C
    try:
        with pytest.raises(KeyboardInterrupt):
            sampler(posterior).run_mcmc(None, 1)
    finally:
        evaluator.SECONDS_BETWEEN_NOTES = before
    posterior.stop = None
    again = sampler(posterior)
    again.run_mcmc(None, 1)
    assert again.failure_count > 0


ATTRIBUTES = ("version", "nwalkers", "ndim", "has_blobs", "iteration")


@pytest.mark.parametrize("made", range(len(ATTRIBUTES) + 3))
def test_a_half_made_file_of_emcee_is_made_again(made, whole_smc, tmp_path):
    """A script was killed in `reset` of the backend, which makes five attributes, and then three datasets."""
    path = tmp_path / "run.h5"
    emcee.backends.HDFBackend(str(path)).reset(N, NDIM)
    with h5py.File(path, "a") as file:
        for name in ATTRIBUTES[made:]:
            del file["mcmc"].attrs[name]
        for name in ("accepted", "chain", "log_prob")[max(made - len(ATTRIBUTES), 0) :]:
            del file["mcmc"][name]
    assert outcome(go_on(make(path, "smc"))) == whole_smc


def test_damaged_files_are_kept_under_different_names(whole, tmp_path):
    kind, path, _ = whole
    path = copied(path, tmp_path)
    for number in ("", ".2"):
        os.truncate(path, path.stat().st_size // 2)
        halved = path.read_bytes()
        make(path, kind)
        assert Path(f"{path}.damaged{number}").read_bytes() == halved
