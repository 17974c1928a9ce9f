"""The scripts of docs/clusters with MPI and on one machine; jobs, workers and parents end in the middle."""

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.simulation import dask_executor
from samplers.record import Record
from tests.clusters import noted
from tests.faults.treacherous import Treacherous, posterior_of

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "docs" / "clusters"
WALKERS = 250  # of slow_model.py
LOG_EVIDENCE = 2427.63  # +- 0.01, of problem.py with 2000 walkers in one process
PRINTED = re.compile(r"log-evidence ([\d.]+) \+- ([\d.]+)")


def needs(module):
    missing = importlib.util.find_spec(module) is None
    return pytest.mark.skipif(missing, reason=f"NO {module.upper()}: install it to test the scripts for clusters")


@pytest.fixture
def place(tmp_path):
    """Folder with the scripts of the documentation, whose model is slow."""
    for script in SCRIPTS.iterdir():
        if script.suffix in (".py", ".sh"):
            shutil.copy(script, tmp_path)
    slow = (Path(__file__).parent / "slow_model.py").read_text()
    with open(tmp_path / "problem.py", "a") as file:
        file.write(slow)
    return tmp_path


@contextlib.contextmanager
def started(place, *command):
    """A process of a script, which is killed at the end."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with (
        open(place / "output.txt", "ab") as output,
        subprocess.Popen(
            [sys.executable, *command], cwd=place, env=environment, stdout=output, stderr=output
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def lines(place, name):
    path = place / name
    return path.read_text().splitlines() if path.exists() else []


def progressed(place, process, number):
    """Wait until a number of simulations has ended."""
    stop = time.monotonic() + 300.0
    while len(lines(place, "ends.txt")) < number:
        assert process.poll() is None, (place / "output.txt").read_text()
        assert time.monotonic() < stop, "no progress"
        time.sleep(0.1)


def check_result(place, interruptions):
    """Every simulation that ended is kept, and the evidence is that of one machine without interruptions.

    No evaluation has failed, so that none was given up because of the ends of its workers. Every simulation that ended
    is in the record and in the cache.
    Each of the interruptions, the ends of worker processes, has repeated two simulations at most.
    """
    text = (place / "output.txt").read_text()
    estimate, error = map(float, PRINTED.search(text).groups())
    assert abs(estimate - LOG_EVIDENCE) < 4.0 * np.hypot(error, 0.01) + 0.01, text  # printed with two digits
    record = Record(place / "run.h5.mcmc.record")
    evaluated = record.latest(record.count)
    assert record.count >= WALKERS
    assert np.isfinite(evaluated.log_prob).all() and not record.failed
    starts, ends = Counter(lines(place, "starts.txt")), Counter(lines(place, "ends.txt"))
    assert set(starts) == set(ends)  # what was interrupted was simulated again
    repeated = starts.total() - len(starts)
    assert repeated <= 2 * interruptions, (repeated, interruptions)
    with contextlib.closing(sqlite3.connect(place / "simulations.db")) as cache:
        rows = cache.execute("select count(*) from rows where size is null").fetchone()[0]
    # the measurements are a simulation of the function that is not one of the likelihood
    known = {tuple(row[:2]) for row in evaluated.coords}
    assert len({tuple(map(float, re.findall(r"[-+.e\d]{3,}(?=\))", line))) for line in ends} - known) == 1
    assert rows == len(ends) - 1
    return repeated


@needs("dask_jobqueue")
@pytest.mark.slow
def test_scripts_of_jobs_limit_threads_and_leave_before_their_walltime(place):
    code = "import dask_jobs; print(dask_jobs.make_cluster(dask_jobs.parse_arguments()).job_script())"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    options = ["--partition", "compute", "--memory", "1GB", "--cores", "8", "--threads", "4"]
    scripts = {}
    for system in ("slurm", "pbs"):
        command = [sys.executable, "-c", code, *options, "--system", system]
        done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=True)
        scripts[system] = done.stdout
    assert "OMP_NUM_THREADS=4" in scripts["slurm"]
    assert re.search(r"--nworkers 2.*--nthreads 1 --lifetime 7h", scripts["slurm"]), scripts["slurm"]
    assert "#PBS -l select=1:ncpus=8:mem=" in scripts["pbs"] and "#PBS -l walltime=08:00:00" in scripts["pbs"]


@needs("mpi4py")
@pytest.mark.slow
def test_mpi(place):
    mpiexec = Path(sys.executable).with_name("mpiexec")
    command = [mpiexec if mpiexec.exists() else "mpiexec", "--oversubscribe", "-n", "3"]
    command += [sys.executable, "-m", "mpi4py.futures", "mpi.py"]
    environment = os.environ | {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    environment |= {"PYTHONPATH": str(ROOT), "SECONDS_PER_SIMULATION": "0.002"}
    with open(place / "output.txt", "wb") as output:
        subprocess.run(command, cwd=place, env=environment, stdout=output, stderr=output, timeout=300, check=True)
    assert check_result(place, 0) == 0


@pytest.mark.slow
def test_one_machine_stopped_by_a_signal_goes_on(place, monkeypatch):
    monkeypatch.setenv("SECONDS_PER_SIMULATION", "0.01")
    with started(place, "one_machine.py", "--cores", "2") as parent:
        progressed(place, parent, 1000)
        parent.send_signal(signal.SIGTERM)
        assert parent.wait(60) != 0
    with started(place, "one_machine.py", "--cores", "2") as parent:
        assert parent.wait(300) == 0
    check_result(place, 2)


# jobs on one machine -------------------------------------------------------------------------------------------------


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    """A client of dask-jobqueue with one job of two workers, which is a process of this machine; the jobs' names."""
    from dask.distributed import Client
    from dask_jobqueue.local import LocalCluster, LocalJob

    names = []

    class Job(LocalJob):
        async def start(self):
            names.append(self.name)
            await super().start()

        @classmethod
        async def _close_job(cls, job_id, cancel_command):
            with contextlib.suppress(ProcessLookupError):  # it has ended, which scancel does not mind
                await super()._close_job(job_id, cancel_command)

    class Cluster(LocalCluster):
        job_cls = Job

    monkeypatch.setattr(dask_executor, "SECONDS_BETWEEN_CHECKS", 0.2)
    options = ["--nthreads", "1", "--no-dashboard"]
    with (
        Cluster(
            cores=2, processes=2, memory="1GB", worker_extra_args=options, local_directory=str(tmp_path)
        ) as cluster,
        Client(cluster) as client,
    ):
        cluster.scale(jobs=1)
        yield client, names


@pytest.mark.slow
@needs("dask_jobqueue")
def test_a_job_with_several_workers_that_has_ended_is_submitted_again(jobs, tmp_path):
    client, names = jobs
    posterior = posterior_of(noted.EndsItsJob(tmp_path), pool=client)
    points = posterior.sample_prior(20, 1)
    values = posterior(points)
    assert len(names) == 2
    np.testing.assert_array_equal(values, posterior_of(Treacherous())(points))
    assert posterior.report()["failure_count"] == 0
