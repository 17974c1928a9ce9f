"""The whole job: simulations, time and memory from the prior to the column's posterior, by default and as in the paper.

Seven parameters of the bridge column are updated by the default SMC and by the paper's setting (1000 particles, ten
Metropolis steps a stage, its ladder read literally), on the same data, each in a process of its own that keeps its
chain in a file, as the tutorial does. The paper's setting costs some 235 000 simulations: by default the record is
reduced to one sample in sixteen, and a run that takes longer than its limit is stopped, and its row says how far it
came; nothing is extrapolated. ``--every 4`` takes the tutorial's reduced setting, ``--every 1`` the full record.

One run: ``python -m tests.benchmarks.job SETTING EVERY FILE``.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from .rows import Row

__all__ = ["EVERY", "LIMIT", "job", "memory"]

ROOT = Path(__file__).resolve().parents[2]
EVERY, LIMIT = 16, 900.0
SETTINGS = {"default": "SMC, default, 500 walkers", "paper": "SMC, the paper's, 1000 particles x 10 moves a stage"}
SEED = 1
BATCH = 500


def _peak() -> float:
    """Most memory that this program ever held [MiB]."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss includes that of the process which started this one
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 2**10
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def _run(setting: str, every: int, path: str) -> dict:
    """One run; its cost and its posterior."""
    from emcee.backends import HDFBackend

    from fe_likelihoods.problems import bridge_column
    from samplers import RAMANCHA_2022_LITERAL, SMCSampler

    walkers, sweeps, settings = {"default": (500, 4, {}), "paper": (1000, 1, RAMANCHA_2022_LITERAL)}[setting]
    posterior = bridge_column(every=every)
    posterior(posterior.sample_prior(1, 1))  # compiled from here on; counted, and one more
    start, cpu = time.perf_counter(), time.process_time()
    sampler = SMCSampler(
        walkers, posterior.ndim, posterior, vectorize=True, seed=SEED, backend=HDFBackend(path), **settings
    )
    sampler.run_mcmc(None, sweeps)
    samples, report = sampler.get_chain(flat=True), posterior.report()
    return {
        "simulations": report["simulations"] - 1,
        "failures": report["failure_count"],
        "stages": len(sampler.ladder),
        "seconds": time.perf_counter() - start,
        "cpu": time.process_time() - cpu,
        "peak": _peak(),
        "mean": samples.mean(axis=0).tolist(),
        "sd": samples.std(axis=0, ddof=1).tolist(),
        "log_evidence": [float(sampler.log_evidence), float(sampler.log_evidence_error)],
    }


def _memory() -> dict:
    """Peak so far, after each thing that a job does on the full record [MiB]."""
    peaks = {"interpreter and NumPy": _peak()}
    from fe_likelihoods.problems import bridge_column
    from samplers import SMCSampler  # noqa: F401

    peaks["both packages imported"] = _peak()
    posterior = bridge_column()
    peaks["posterior made"] = _peak()
    posterior(posterior.sample_prior(1, 1))
    peaks["first simulation"] = _peak()
    posterior(posterior.sample_prior(BATCH, 2))
    peaks[f"batch of {BATCH} simulations"] = _peak()
    return peaks


def _ask(*arguments: str, limit: float | None = None) -> dict | None:
    """What one process says, None if it was stopped at `limit` seconds."""
    command = [sys.executable, "-m", "tests.benchmarks.job", *arguments]
    try:
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:  # it is killed
        return None
    if run.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with code {run.returncode}: {run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


def _how_far(path: Path) -> str:
    """What the file of a run that was killed tells of it."""
    from emcee.backends import HDFBackend

    from samplers import read_ladder
    from samplers.storage.backends import JournaledBackend

    ladder = read_ladder(JournaledBackend.of(HDFBackend(str(path)))) if path.exists() else ()
    if not ladder:
        return "before its first stage was done"
    evaluations = sum(stage.evaluations for stage in ladder)
    return f"after {len(ladder)} stages and {evaluations} evaluations, at beta = {ladder[-1].beta:.3g}"


def job(repeats: int, every: int = EVERY, limit: float = LIMIT) -> list[Row]:
    """Both settings on one sample in `every`, once each (`repeats` is of no effect), within `limit` seconds each."""
    kept = "full record" if every == 1 else f"1 sample in {every}"
    rows, done = [], {}
    for setting, what in SETTINGS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "chain.h5"
            found = _ask(setting, str(every), str(path), limit=limit or None)
            told = "" if found else f"stopped at {limit:g} s, {_how_far(path)}"
        case = f"{what}, {kept}"
        if found is None:
            rows.append(Row("job: simulations", case, None, "", told))
            continue
        done[setting] = found
        evidence, error = found["log_evidence"]
        note = f"{found['stages']} stages, {found['failures']} failed; log Z {evidence:.2f} +- {error:.2f}; seed {SEED}"
        rows += [
            Row("job: simulations", case, found["simulations"], "", note),
            Row("job: wall time", case, found["seconds"], "s", "compiled before"),
            Row("job: CPU time", case, found["cpu"], "s"),
            Row("job: peak memory", case, found["peak"], "MiB", "resident"),
        ]
    return rows + (_beside(done["default"], done["paper"], kept) if len(done) == len(SETTINGS) else [])


def _beside(default: dict, paper: dict, kept: str) -> list[Row]:
    """The default beside the paper's setting: cost, and whether the two answers agree."""
    means, sds = ([np.array(run[key]) for run in (default, paper)] for key in ("mean", "sd"))
    return [
        Row("job: paper / default, simulations", kept, paper["simulations"] / default["simulations"], ""),
        Row("job: paper / default, wall time", kept, paper["seconds"] / default["seconds"], ""),
        Row("job: paper / default, CPU time", kept, paper["cpu"] / default["cpu"], ""),
        Row("job: means apart", kept, np.abs((means[1] - means[0]) / sds[0]).max(), "sd", "largest of the seven"),
        Row("job: sds apart", kept, 100 * np.abs(sds[1] / sds[0] - 1.0).max(), "%", "largest of the seven"),
    ]


def memory(repeats: int) -> list[Row]:
    """Peak resident memory of the main job on the full record, as it grows; once (`repeats` is of no effect)."""
    return [Row("memory, peak resident", case, value, "MiB") for case, value in _ask("memory").items()]


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    answer = _memory() if what == "memory" else _run(what, int(rest[0]), rest[1])
    sys.stdout.write(json.dumps(answer) + "\n")
