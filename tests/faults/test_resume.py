"""A killed run continues from its file, with results equal to the last bit to those of a run that was not killed."""

import contextlib
import os
import shutil
import subprocess
import sys
import time
import warnings
from multiprocessing import get_context

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning
from samplers.storage.journal_contents import read_journal
from tests.contract.targets import Gaussian
from tests.faults.resumable_run import NDIM, SAMPLERS, N, make
from tests.tempering.guides import SearchingGuide

STEPS = 12


@contextlib.contextmanager
def spawn(path, name, steps=STEPS, seconds=0.004):
    """The run in a process of its own."""
    process = get_context("fork").Process(target=run, args=(path, name, steps, seconds))
    process.start()
    yield process
    process.join(60)


def run(path, name, steps, seconds):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make(path, name, seconds).run_mcmc(None, steps)


def journal_of(path):
    return path.with_name(path.name + ".mcmc.journal")


def same(sampler, whole):
    """Whether everything but the wall time is equal."""
    assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert np.array_equal(sampler.get_log_prob(), whole.get_log_prob())
    assert np.array_equal(sampler.get_blobs(), whole.get_blobs())
    assert np.array_equal(sampler.backend.accepted, whole.backend.accepted)
    for ours, theirs in zip(sampler.backend.random_state, whole.backend.random_state, strict=True):
        assert np.all(ours == theirs)
    assert [s._replace(seconds=0) for s in sampler.ladder] == [s._replace(seconds=0) for s in whole.ladder]
    assert sampler.log_evidence_check == whole.log_evidence_check
    assert (sampler.log_evidence, sampler.log_evidence_error) == (whole.log_evidence, whole.log_evidence_error)
    return True


QUICK = ["smc", "moves", "guided"]
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in SAMPLERS if name not in QUICK]


@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_killed_again_and_again(name, tmp_path, rng):
    """The same script is started until it ends, and killed by signal 9 at random places."""
    whole = make(tmp_path / "whole.h5", name)
    whole.run_mcmc(None, STEPS)
    size = journal_of(tmp_path / "whole.h5").stat().st_size
    path = tmp_path / "killed.h5"
    for place in np.sort(rng.uniform(0.01, 0.95, size=3)) * size:
        with spawn(path, name) as process:
            while not journal_of(path).exists() or journal_of(path).stat().st_size < place:
                assert process.is_alive()
                time.sleep(0.001)
            process.kill()
        assert process.exitcode < 0
    with spawn(path, name, seconds=0) as process:
        pass
    assert process.exitcode == 0
    sampler = make(path, name)
    assert sampler.iteration == STEPS
    assert same(sampler, whole)
    for s in (sampler, whole):  # and so do later steps
        s.run_mcmc(None, 3)
    assert np.array_equal(sampler.get_chain(), whole.get_chain())


@pytest.mark.parametrize("kind", [b"MEMO", b"EVAL"])
def test_killed_while_a_guide_searches_or_draws(kind, tmp_path):
    """Nothing that the journal holds is evaluated again, and the draws after it are the same."""
    whole = make(tmp_path / "whole.h5", "guided")
    whole.run_mcmc(None, 2)
    path = tmp_path / "killed.h5"
    with spawn(path, "guided", 2, seconds=0.3) as process:
        while not journal_of(path).exists() or kind not in journal_of(path).read_bytes():
            assert process.is_alive()
            time.sleep(0.001)
        process.kill()
    contents = read_journal(journal_of(path))
    assert contents.remembered and bool(contents.evaluated) == (kind == b"EVAL")
    known = sum(len(batch.coords) for batch in contents.evaluated)
    known += sum(SearchingGuide.batch for key, _ in contents.remembered if key.startswith("search"))
    sampler = make(path, "guided", seed=99)
    sampler.run_mcmc(None, 2)
    assert same(sampler, whole)
    assert sampler.simulations == whole.simulations
    calls = [s.log_prob_fn.f.calls for s in (sampler, whole)]
    assert calls[0] == calls[1] - known + compared(contents)


@pytest.fixture
def finished(tmp_path):
    """The file of a run of SMC, and the run."""
    path = tmp_path / "run.h5"
    sampler = make(path, "smc")
    sampler.run_mcmc(None, STEPS)
    sampler.backend.close()
    return path, sampler


def compared(contents):
    """How many points a continued run evaluates to check that the posterior is the same: the first N and the best."""
    log_prob = [value for batch in contents.evaluated for value in batch.log_prob]
    return min(N, len(log_prob)) + (bool(log_prob) and int(np.argmax(log_prob)) >= N)


def cut(path, share):
    """Leave that share of the journal, and no chain: it is rebuilt."""
    data = journal_of(path).read_bytes()
    journal_of(path).write_bytes(data[: int(share * len(data))])
    path.unlink()


@pytest.mark.parametrize("fingerprint", [None, "the posterior of this test"])
def test_a_comparison_beyond_the_limit_is_said(fingerprint, tmp_path, caplog):
    """A posterior without a fingerprint is evaluated again, which max_simulations does not contain."""
    path = tmp_path / "run.h5"
    sampler = make(path, "smc", max_simulations=100)
    with pytest.warns(SamplingWarning, match="max_simulations"):
        set_fingerprint(sampler, fingerprint).run_mcmc(None, 2)
    contents = read_journal(journal_of(path))
    caplog.clear()
    again = set_fingerprint(make(path, "smc", max_simulations=150), fingerprint)
    with pytest.warns(SamplingWarning, match="max_simulations"):
        again.run_mcmc(None, 2)
    # Ten of the first points are evaluated again to look for values that depend on the batch, whatever the limit is.
    beyond = again.log_prob_fn.f.calls - 50
    if fingerprint is None:
        assert f"evaluated again at {compared(contents)} points" in caplog.text and beyond >= compared(contents)
    else:
        assert "evaluated again" not in caplog.text and beyond <= 0


def set_fingerprint(sampler, fingerprint):
    if fingerprint is not None:
        sampler.log_prob_fn.f.fingerprint = fingerprint
    return sampler


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.97, 0.999])
def test_cut_off_anywhere(finished, share):
    """Nothing that the journal holds is evaluated again."""
    path, whole = finished
    points = [row.tobytes() for batch in read_journal(journal_of(path)).evaluated for row in batch.coords]
    cut(path, share)
    contents = read_journal(journal_of(path))
    known = sum(len(batch.coords) for batch in contents.evaluated)
    proposed_again = sum(point in points[:known] for point in points[known:])  # moves between copies return to a point
    sampler = make(path, "smc", seed=99)
    posterior = sampler.log_prob_fn.f
    sampler.run_mcmc(None, STEPS)
    assert same(sampler, whole)
    assert posterior.calls == sampler.evaluations - known - proposed_again + compared(contents)
    assert sampler.evaluations == whole.evaluations


def test_the_remaining_steps_can_be_requested(finished):
    path, whole = finished
    cut(path, 0.97)
    sampler = make(path, "smc")
    done = sampler.iteration
    assert 0 < done < STEPS
    sampler.run_mcmc(None, STEPS - done)
    assert np.array_equal(sampler.get_chain(), whole.get_chain())


def test_the_same_draws_continue_and_others_are_refused(tmp_path):
    draws = Gaussian(NDIM).sample_prior(N, np.random.default_rng(0))
    path = tmp_path / "run.h5"
    sampler = make(path, "smc")
    sampler.run_mcmc(draws, 3)
    whole = sampler.get_chain()
    sampler.backend.close()
    cut(path, 0.4)
    with pytest.raises(ValueError, match="run from other draws"):
        make(path, "smc").run_mcmc(draws + 1e-9, 3)
    again = make(path, "smc")
    again.run_mcmc(draws, 3)
    assert np.array_equal(again.get_chain(), whole)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"check_draws": 0}, "check_draws was None, is 0"),
        ({"recycle": False}, "recycle was True, is False"),
        ({"moves": emcee.moves.DEMove(), "recycle": True}, "moves was"),
        ({"sd": 0.02}, "log_prob_fn was"),
        ({"guide": SearchingGuide}, "guide was None, is SearchingGuide"),
        ({"log_prior_fn": lambda x: -np.sum(np.abs(x), axis=-1)}, "log-prior"),
    ],
    ids=lambda value: str(next(iter(value))) if isinstance(value, dict) else "",
)
def test_another_run_is_refused(finished, changes, message):
    path, _ = finished
    cut(path, 0.5)
    before = journal_of(path).read_bytes()
    with pytest.raises(ValueError, match=message):
        make(path, "smc", **changes).run_mcmc(None, STEPS)
    assert journal_of(path).read_bytes() == before


@pytest.mark.parametrize("place", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_damaged_journal_is_refused(finished, place):
    path, _ = finished
    data = bytearray(journal_of(path).read_bytes())
    data[int(place * len(data))] ^= 0x10
    journal_of(path).write_bytes(data)
    with pytest.raises(ValueError, match="is damaged"):
        make(path, "smc")


@pytest.mark.parametrize("damage", ["truncated", "overwritten", "a step lost", "acceptance", "blobs", "random state"])
def test_a_damaged_chain_is_rebuilt(finished, damage, caplog):
    """Damage that a process can leave when it dies inside HDF5."""
    import h5py

    path, whole = finished
    chain, blobs = whole.get_chain(), whole.get_blobs()
    if damage == "truncated":
        os.truncate(path, path.stat().st_size // 2)
    elif damage == "overwritten":
        path.write_bytes(b"\0" * 4096)
    else:
        with h5py.File(path, "a") as file:
            if damage == "a step lost":
                file["mcmc"].attrs["iteration"] = STEPS - 1
            elif damage == "acceptance":
                file["mcmc/accepted"][0] += 1
            elif damage == "blobs":
                file["mcmc/blobs"][2, 3] += 1.0
            else:
                file["mcmc"].attrs["random_state_2"] += 1
    sampler = make(path, "smc")
    assert np.array_equal(sampler.get_chain(), chain) and np.array_equal(sampler.get_blobs(), blobs)
    assert np.all(sampler.backend.random_state[2] == whole.random_state[2])
    sampler.run_mcmc(None, 2)
    assert np.array_equal(sampler.get_chain()[:STEPS], chain)
    if damage in ("truncated", "overwritten"):
        assert "set aside" in caplog.text and path.with_name(path.name + ".damaged").exists()


def test_a_damaged_file_without_a_journal_is_refused(finished):
    path, _ = finished
    journal_of(path).unlink()
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(ValueError, match="is damaged"):
        make(path, "smc")


@pytest.mark.parametrize("left", ["nothing", "half a name", "half a header", "header"])
def test_killed_before_the_start_was_in_the_journal(finished, left, tmp_path):
    """There is no run yet, and the chain is empty."""
    import h5py

    path, whole = finished
    journal_of(path).write_bytes(beginning(path, left))
    run = read_run(path)
    emcee.backends.HDFBackend(str(path)).reset(N, NDIM)
    with h5py.File(path, "a") as file:
        file["mcmc"].attrs["run"] = run
    sampler = make(path, "smc")
    sampler.run_mcmc(None, STEPS)
    assert same(sampler, whole)
    assert read_journal(journal_of(path)).steps


@pytest.mark.parametrize("left", ["nothing", "half a name", "half a header", "header"])
@pytest.mark.parametrize("steps", [0, 2])
def test_a_journal_that_ends_before_the_start_of_a_stored_run(left, steps, tmp_path, caplog):
    """The chain alone is continued; without steps, the run starts again, and the file is kept beside."""
    path = tmp_path / "run.h5"
    whole = make(path, "smc")
    whole.run_mcmc(None, steps)
    ladder = whole.ladder
    chain = whole.get_chain() if steps > 0 else None
    whole.backend.close()
    journal_of(path).write_bytes(beginning(path, left))
    sampler = make(path, "smc")
    assert "is missing or ends before the start of the run" in caplog.text
    assert path.with_name("run.h5.damaged").exists() == (steps == 0)
    sampler.run_mcmc(None, steps)  # the same script
    assert sampler.iteration == steps and [s._replace(seconds=0) for s in sampler.ladder] == [
        s._replace(seconds=0) for s in ladder
    ]
    if steps > 0:
        sampler.run_mcmc(None, 3)
        assert np.array_equal(sampler.get_chain()[:steps], chain) and sampler.iteration == steps + 3


def beginning(path, left):
    """The first bytes of a journal."""
    data = journal_of(path).read_bytes()
    end = data.index(b"INIT")
    return data[: {"nothing": 0, "half a name": 10, "half a header": 40, "header": end}[left]]


def read_run(path):
    import h5py

    with h5py.File(path) as file:
        return file["mcmc"].attrs["run"]


@pytest.mark.parametrize("written", ["nothing", "header", "content"])
def test_killed_while_the_file_was_created(written, tmp_path, caplog):
    """HDF5 writes the header of an empty file, the content, and then the header again."""
    path = tmp_path / "run.h5"
    emcee.backends.HDFBackend(str(path)).reset(N, NDIM)
    data = path.read_bytes()
    header = data[:40] + (2048).to_bytes(8, "little") + data[48:96]
    left = {"nothing": b"", "header": header, "content": header + data[96:]}[written]
    for number in (1, 2):  # it may happen again
        path.write_bytes(left)
        sampler = make(path, "smc")
        assert sampler.iteration == 0
        aside = path.with_name(path.name + (".damaged" if number == 1 else ".damaged-2"))
        assert aside.read_bytes() == left and "contains nothing" in caplog.text
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == 2


def test_a_file_that_another_process_writes_is_not_set_aside(finished):
    """It is locked, which is no damage."""
    path, whole = finished
    code = "import h5py, sys\nwith h5py.File(sys.argv[1], 'a'):\n    print('open', flush=True)\n    sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "open\n"
        with pytest.raises(ValueError, match="another run is writing"):
            make(path, "smc")
        other.communicate("")
    assert not path.with_name(path.name + ".damaged").exists()
    assert np.array_equal(make(path, "smc").get_chain(), whole.get_chain())


def test_a_reset_file_starts_a_new_run(finished):
    """The journal of the discarded run is kept beside."""
    path, whole = finished
    first, journal = whole.get_chain()[0], journal_of(path).read_bytes()
    emcee.backends.HDFBackend(str(path)).reset(N, NDIM)
    sampler = make(path, "smc", seed=6)
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == 2 and not np.array_equal(sampler.get_chain()[0], first)
    assert path.with_name("run.h5.mcmc.journal.old").read_bytes() == journal
    sampler.backend.close()
    path.unlink()
    journal_of(path).unlink()
    sampler = make(path, "smc", seed=7)
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == 2


def test_a_lost_journal_leaves_the_chain(finished):
    """Then the run continues at beta = 1, as with emcee."""
    path, whole = finished
    journal_of(path).unlink()
    sampler = make(path, "smc")
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == STEPS + 2 and sampler.ladder == whole.ladder


def test_a_new_annealing_after_a_resumed_run(finished):
    """It is entered in the journal like the first one: a third sampler continues it, not the old one."""
    path, _ = finished
    sampler = make(path, "smc")
    sampler.run_mcmc(None, 1)
    draws = Gaussian(NDIM).sample_prior(N, np.random.default_rng(1))
    sampler.run_mcmc(draws, 2)
    chain = sampler.get_chain()
    assert np.array_equal(read_journal(journal_of(path)).start.coords, draws)
    again = make(path, "smc")
    again.run_mcmc(None, 4)
    sampler = make(path, "smc")
    assert sampler.iteration == STEPS + 7
    assert np.array_equal(sampler.get_chain()[: STEPS + 3], chain)


def test_reset_after_burn_in(tmp_path):
    """The chain is discarded, the state is not."""
    chains = []
    for broken in (False, True):
        path = tmp_path / f"{broken}.h5"
        sampler = make(path, "smc")
        sampler.run_mcmc(None, 5)
        sampler.reset()
        if broken:
            sampler.backend.close()
            sampler = make(path, "smc")
        sampler.run_mcmc(None, 4)
        chains.append(sampler.get_chain())
    assert chains[0].shape == (4, N, NDIM)
    assert np.array_equal(*chains)


def test_two_runs_on_one_file(finished):
    """The second one gets an error, also in another process."""
    path, sampler = finished
    shutil.copy(path, path.with_name("copy.h5"))
    with spawn(path.with_name("new.h5"), "smc", seconds=0.2) as first:
        while not journal_of(path.with_name("new.h5")).exists():
            time.sleep(0.01)
        with pytest.raises(ValueError, match=f"another run is writing to .*process {first.pid} on "):
            make(path.with_name("new.h5"), "smc")
        first.kill()
    make(path.with_name("new.h5"), "smc")


def test_blobs_that_cannot_be_stored(tmp_path):
    """An error with the first batch, not at the first step of the chain."""
    from samplers import SMCSampler

    posterior = Gaussian(NDIM)
    sampler = SMCSampler(
        N,
        NDIM,
        lambda x: (posterior(x), {"any": "thing"}),
        log_prior_fn=posterior.log_prior,
        backend=emcee.backends.HDFBackend(str(tmp_path / "run.h5")),
    )
    with pytest.raises(ValueError, match="blobs of dtype object"):
        sampler.run_mcmc(posterior.sample_prior(N, np.random.default_rng(0)), 1)
    assert posterior.calls == N


def test_two_samplers_of_one_process(finished):
    """The later one owns the file; the earlier one gets an error."""
    path, _ = finished
    first, second = make(path, "smc"), make(path, "smc")
    first.run_mcmc(None, 1)
    with pytest.raises(ValueError, match="since it was read"):
        second.run_mcmc(None, 1)
    first.run_mcmc(None, 1)
    third = make(path, "smc")
    third.run_mcmc(None, 2)
    with pytest.raises(ValueError, match="another sampler has continued"):
        first.run_mcmc(None, 1)
    assert make(path, "smc").iteration == STEPS + 4


def test_failures_are_restored(tmp_path):
    """A point that raised an exception counts as -inf, before and after the kill."""

    class Fragile(Gaussian):
        def __call__(self, x):
            if np.any(x[..., 0] < 0):
                raise ArithmeticError("no equilibrium")
            return super().__call__(x)

    from samplers import SamplingWarning, SMCSampler

    def run(path, steps):
        sampler = SMCSampler(
            N,
            2,
            Fragile(2),
            vectorize=True,
            seed=3,
            backend=emcee.backends.HDFBackend(str(path)),
            max_failure_share=0.7,
        )
        with pytest.warns(SamplingWarning, match="ArithmeticError: no equilibrium"):
            sampler.run_mcmc(None, steps)
        return sampler

    whole = run(tmp_path / "run.h5", 6)
    whole.backend.close()
    cut(tmp_path / "run.h5", 0.8)
    again = run(tmp_path / "run.h5", 6)
    assert np.array_equal(again.get_chain(), whole.get_chain())
    assert again.get_chain()[..., 0].min() >= 0
    assert again.failure_count == whole.failure_count > 0
    assert [f["reason"] for f in again.failures] == [f["reason"] for f in whole.failures]


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_an_interrupt_says_what_is_kept_and_how_to_go_on(share, tmp_path, caplog):
    """In a new process, or by the same call."""
    whole = make(tmp_path / "whole.h5", "smc")
    whole.run_mcmc(None, STEPS)
    calls = whole.log_prob_fn.f.calls
    assert whole.report()["new_evaluations"] == whole.report()["evaluations"] == calls
    for where in ("the same object", "a new one"):
        path = tmp_path / f"{where}.h5"
        sampler = make(path, "smc")
        posterior = sampler.log_prob_fn.f
        evaluate = type(posterior).__call__

        def interrupted(x, posterior=posterior, evaluate=evaluate):
            if posterior.calls > share * calls:
                posterior.calls = -100_000
                raise KeyboardInterrupt
            return evaluate(posterior, x)

        sampler._evaluator._function.function = interrupted
        with pytest.raises(
            KeyboardInterrupt, match=rf"evaluations and \d+ steps are kept in .*{where}.h5 and .*journal"
        ):
            sampler.run_mcmc(None, STEPS)
        made = sampler.report()["new_evaluations"]
        if where == "a new one":
            sampler.backend.close()
            sampler = make(path, "smc", seed=99)
        with caplog.at_level("INFO", logger="samplers"):
            sampler.run_mcmc(None, STEPS)
        assert f"{made} evaluations and" in caplog.text and "Continuing" in caplog.text
        assert same(sampler, whole)
        report = sampler.report()
        assert report["evaluations"] == calls and report["steps"] == STEPS
        if where == "a new one":
            assert 0 < report["new_evaluations"] <= calls - made


def test_a_loop_over_sample_continues_from_its_last_state(tmp_path):
    """Also in a later session that extends the chain, and after a loop that the user ends early."""
    make(tmp_path / "run.h5", "smc").run_mcmc(None, 3)
    sampler = make(tmp_path / "run.h5", "smc")
    for _ in range(3):
        for _ in sampler.sample(None, iterations=2):
            pass
    for state in sampler.sample(None, iterations=9):
        last = state.coords.copy()
        if sampler.iteration == 10:
            break
    assert np.array_equal(last, sampler.get_last_sample().coords)
    sampler.run_mcmc(None, 1)
    chain = sampler.get_chain()
    assert len(chain) == 11 and len({step.tobytes() for step in chain}) == 11


def test_after_an_error_the_same_call_goes_on(tmp_path):
    """The log-probability raises an error in the annealing: nothing is evaluated twice, and the chain is the same."""
    whole = make(tmp_path / "whole.h5", "smc")
    whole.run_mcmc(None, 2)
    sampler = make(tmp_path / "run.h5", "smc", max_failure_share=0.0)
    posterior = sampler.log_prob_fn.f
    works, calls = type(posterior).__call__, []

    class Fails(type(posterior)):
        def __call__(self, x):
            calls.append(np.atleast_2d(x).shape[0])
            if sum(calls) > 0.4 * whole.evaluations:
                raise OSError("no licence")
            return works(self, x)

    posterior.__class__, usual = Fails, type(posterior)
    with pytest.raises(RuntimeError, match="no licence"):
        sampler.run_mcmc(None, 2)
    kept = sampler.evaluations
    posterior.__class__ = usual
    sampler.run_mcmc(None, 2)
    assert kept >= 0.2 * whole.evaluations
    assert np.array_equal(sampler.get_chain(), whole.get_chain())


def test_a_chain_without_its_journal_is_compared_with_the_posterior(tmp_path):
    path = tmp_path / "run.h5"
    make(path, "smc").run_mcmc(None, 3)
    journal_of(path).unlink()
    with pytest.raises(ValueError, match="run of another posterior"):
        make(path, "smc", sd=0.02).run_mcmc(None, 3)
    sampler = make(path, "smc")
    sampler.run_mcmc(None, 3)
    assert sampler.iteration == 3


def test_interrupted_between_the_steps_and_the_marks_of_a_flush(tmp_path, monkeypatch):
    """The steps are in the file and are written again at the same place."""
    sampler = make(tmp_path / "run.h5", "smc")
    sampler.run_mcmc(None, 2)
    marks, left = sampler.backend._write_marks, [1]

    def interrupted(file):
        if left:
            left.pop()
            raise KeyboardInterrupt
        marks(file)

    monkeypatch.setattr(sampler.backend, "_write_marks", interrupted)
    with pytest.raises(KeyboardInterrupt):
        for _ in sampler.sample(None, iterations=3):
            sampler.backend.flush()
    assert not left
    sampler.backend.flush()
    chain = sampler.get_chain()
    assert len(chain) == 3 and len({step.tobytes() for step in chain}) == 3
