"""Kills of the parent, of workers and of the scheduler of an asynchronous run on a real dask cluster.

``python -m tests.faults.asynchronous_kills [--kills 100] [--seed 1]`` prints a table by what was killed.

A scheduler and two workers with their nannies are processes of their own. A script anneals on them with
``asynchronous=True``, a file and a cache. While it runs, one of the processes is killed by signal 9. A script whose
parent or scheduler was killed is started again, with a new scheduler where needed, until it ends. Then the journal is
cut before its first step and the script is started again: the annealing must be repeated from the journal to the last
bit, without a simulation. Simulations are counted by the model itself, in a file.
"""

import argparse
import collections
import contextlib
import itertools
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
)
from tests.faults.treacherous import descendants

__all__ = ["main"]

WALKERS, WORKERS, STEPS = 60, 2, 1
TIMES = np.arange(10) * 0.1
TARGETS = ("parent", "parent", "worker", "scheduler")
LONGEST = 180.0  # [s] of a script, after which it counts as hanging
LOG = "FE_SIMULATION_LOG"


def response(theta: np.ndarray) -> np.ndarray:
    """A parabola (1, n_steps)."""
    return (theta[0] * TIMES + theta[1] * TIMES**2)[None]


def logged(theta: np.ndarray) -> np.ndarray:
    """`response` after 2 to 40 ms, with the parameters appended to a file."""
    time.sleep(0.002 * np.exp(np.clip(theta[0], -3.0, 3.0)))
    with open(os.environ[LOG], "ab", buffering=0) as file:
        file.write(np.asarray(theta, float).tobytes())
    return response(theta)


def script(name: str, address: str) -> None:
    """The script that is killed: an annealing and a step, with a file and a cache."""
    import emcee

    from samplers import SMCSampler

    warnings.simplefilter("ignore")
    folder = Path(name)
    with contextlib.ExitStack() as stack:
        client = None
        if address:
            from distributed import Client

            client = stack.enter_context(Client(address, timeout=30))
        model = FunctionModel(logged, ["a", "b"], [Channel("u", "displacement", "m")], dt=0.1, n_steps=len(TIMES))
        noise = 0.05 * np.random.default_rng(1).standard_normal((1, len(TIMES)))
        measurements = Measurements(model.channels, model.dt, response((1.0, 0.5)) + noise)
        prior = Prior({"a": TruncatedNormal(1.0, 0.5), "b": TruncatedNormal(0.5, 0.5), "sigma_u": HalfNormal(0.2)})
        likelihood = FELikelihood(model, measurements, pool=client, cache=folder / "simulations.db")
        backend = emcee.backends.HDFBackend(str(folder / "chain.h5"))
        settings = {"seed": 5, "recycle": True, "asynchronous": True}
        posterior = Posterior(likelihood, prior)
        sampler = SMCSampler(WALKERS, 3, posterior, vectorize=True, backend=backend, **settings)
        sampler.run_mcmc(None, STEPS)
        numbers = [sampler.log_evidence, sampler.evaluations, *(stage.beta for stage in sampler.ladder)]
        np.savez(folder / "result.npz", chain=sampler.get_chain(), numbers=numbers)


class Cluster:
    """A scheduler and its workers, as processes of their own."""

    def __init__(self, folder: Path):
        self._folder, self._started = folder, []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.start()

    def start(self) -> None:
        """Start scheduler and workers, after the end of earlier ones."""
        self.stop()
        here = ["--host", "127.0.0.1"]
        port = self.address.rsplit(":", 1)[1]
        self.scheduler = self._run("scheduler", *here, "--port", port, "--no-dashboard")
        options = ("--nworkers", str(WORKERS), "--nthreads", "1", "--no-dashboard")
        self._run("worker", self.address, *here, *options, "--local-directory", str(self._folder))

    def _run(self, what: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *options]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._started.append(subprocess.Popen(command, start_new_session=True, **quiet))
        return self._started[-1]

    def worker(self) -> int | None:
        """Process number of a worker, which its nanny replaces."""
        marked = []
        for pid in descendants(self._started[-1].pid):
            with contextlib.suppress(OSError):
                if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    marked.append(pid)
        return random.choice(marked) if marked else None

    def stop(self) -> None:
        """End everything."""
        for process in self._started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self._started = []


def _start(folder: Path, address: str = "") -> subprocess.Popen:
    # imported, so that workers find the model in a module
    code = "import sys; from tests.faults.asynchronous_kills import script; script(*sys.argv[1:])"
    with open(folder / "errors.txt", "ab") as errors:
        return subprocess.Popen([sys.executable, "-c", code, str(folder), address], stderr=errors)


def _ends(process: subprocess.Popen) -> int | None:
    """How a script ends; None if it hangs, and is then killed."""
    try:
        return process.wait(LONGEST)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return None


def _journal(folder: Path) -> Path:
    return folder / "chain.h5.mcmc.journal"


def _wait_for(folder: Path, size: int, process: subprocess.Popen) -> bool:
    """Whether the journal reaches a size while the script runs."""
    while process.poll() is None:
        if _journal(folder).exists() and _journal(folder).stat().st_size >= size:
            return True
        time.sleep(0.005)
    return False


def _simulated(folder: Path) -> list[bytes]:
    data = (folder / "log").read_bytes() if (folder / "log").exists() else b""
    return [data[place : place + 16] for place in range(0, len(data), 16)]


def _replay(folder: Path) -> str:
    """What is wrong with a repetition from the journal; empty if nothing is."""
    from tests.faults.test_asynchronous import kinds

    whole = np.load(folder / "result.npz")
    data = _journal(folder).read_bytes()
    first = next(place for kind, place in kinds(data) if kind == b"STEP")
    _journal(folder).write_bytes(data[:first])
    (folder / "chain.h5").unlink()
    (folder / "result.npz").unlink()
    before = len(_simulated(folder))
    if _ends(_start(folder)) != 0:
        return "the repetition failed"
    again = np.load(folder / "result.npz")
    same = np.array_equal(whole["chain"], again["chain"]) and np.array_equal(whole["numbers"], again["numbers"])
    # with a cache, one or two stored rows are simulated again for comparison
    return ("" if same else "another chain ") + ("" if len(_simulated(folder)) - before <= 2 else "simulated again")


def _one_run(folder: Path, kills: int, counts: collections.Counter, whole_size: int) -> None:
    """A run with kills, and the repetition of its journal."""
    os.environ[LOG] = str(folder / "log")
    cluster = Cluster(folder)
    try:
        for size in sorted(random.randrange(2000, int(0.9 * whole_size)) for _ in range(kills)):
            process, target = _start(folder, cluster.address), random.choice(TARGETS)
            if not _wait_for(folder, size, process):
                break
            victim = {"parent": process.pid, "scheduler": cluster.scheduler.pid}.get(target) or cluster.worker()
            if victim is None:
                continue
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)
            counts[target, "kills"] += 1
            code = _ends(process)
            counts[target, "hung"] += code is None
            if target == "scheduler":
                cluster.start()
            if code == 0:  # a worker was killed, and the run went on
                break
            if target == "worker":
                counts[target, "ended the run"] += 1
        if not (folder / "result.npz").exists() and _ends(_start(folder, cluster.address)) != 0:
            counts["all", "could not go on"] += 1
            print((folder / "errors.txt").read_text()[-3000:])
            return
    finally:
        cluster.stop()
    counts["all", "runs"] += 1
    points = _simulated(folder)
    counts["all", "simulations"] += len(points)
    counts["all", "of points simulated before"] += len(points) - len(set(points))
    if fault := _replay(folder):
        counts["all", fault] += 1


def main() -> None:
    """Kill, and print what happened."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.asynchronous_kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    random.seed(arguments.seed)
    counts: collections.Counter = collections.Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "whole"
        folder.mkdir()
        _one_run(folder, 0, counts, 0)
        size = _journal(folder).stat().st_size
        for number in itertools.count():
            if sum(count for (_, what), count in counts.items() if what == "kills") >= arguments.kills:
                break
            folder = Path(name) / str(number)
            folder.mkdir()
            _one_run(folder, random.randint(1, 4), counts, size)
            print(".", end="", flush=True)
    print()
    for (target, what), count in sorted(counts.items()):
        print(f"{target:12}{what:30}{count:6}")


if __name__ == "__main__":
    main()
