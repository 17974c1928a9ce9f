"""Simulations, time and memory of a whole update of the column, with the default settings and with those of the paper.

Seven parameters of the bridge column are updated by the default SMC and by the settings of the paper (1000 particles,
ten Metropolis steps per stage, literal reading of its ladder) on the same data. Each run has its own process and stores
its chain in a file, as scripts do. The settings of the paper need about 235 000 simulations, so by default the
record is reduced to one sample in sixteen. A run that exceeds its time limit is stopped and its row reports the stage
reached; nothing is extrapolated. ``--every 4`` is a reduced setting, ``--every 1`` the full record.

One run: ``python -m benchmarks.job SETTING EVERY FILE``.
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

__all__ = ["EVERY", "LIMIT", "compare_settings", "job", "evaluations_made", "memory", "peak_memory"]

ROOT = Path(__file__).resolve().parents[1]
EVERY, LIMIT = 16, 900.0
SETTINGS = {"default": "SMC, default, 500 walkers", "paper": "SMC, paper, 1000 particles x 10 moves per stage"}
SEED = 1
BATCH = 500


def peak_memory() -> float:
    """Peak resident memory of this process [MiB]."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss includes the peak of the parent process
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 2**10
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def _run(setting: str, every: int, path: str) -> dict:
    """Cost and posterior of one run."""
    from emcee.backends import HDFBackend

    from fe_likelihoods.problems import bridge_column
    from samplers import SMCSampler
    from samplers.presets import RAMANCHA_2022_LITERAL

    walkers, sweeps, settings = {"default": (500, 4, {}), "paper": (1000, 1, RAMANCHA_2022_LITERAL)}[setting]
    posterior = bridge_column(every=every)
    posterior(posterior.sample_prior(1, 1))  # compile before the measurement; this simulation is subtracted below
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
        "peak": peak_memory(),
        "mean": samples.mean(axis=0).tolist(),
        "sd": samples.std(axis=0, ddof=1).tolist(),
        "log_evidence": [float(sampler.log_evidence), float(sampler.log_evidence_error)],
    }


def _memory() -> dict:
    """Peak memory [MiB] after each step of a run on the full record."""
    peaks = {"interpreter and NumPy": peak_memory()}
    from fe_likelihoods.problems import bridge_column
    from samplers import SMCSampler  # noqa: F401

    peaks["both packages imported"] = peak_memory()
    posterior = bridge_column()
    peaks["posterior made"] = peak_memory()
    posterior(posterior.sample_prior(1, 1))
    peaks["first simulation"] = peak_memory()
    posterior(posterior.sample_prior(BATCH, 2))
    peaks[f"batch of {BATCH} simulations"] = peak_memory()
    return peaks


def _ask(*arguments: str, limit: float | None = None) -> dict | None:
    """Result that one process prints; None if it was stopped after `limit` seconds."""
    command = [sys.executable, "-m", "benchmarks.job", *arguments]
    try:
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return None
    if run.returncode:
        raise RuntimeError(f"{' '.join(arguments)} ended with code {run.returncode}: {run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


def evaluations_made(path: Path) -> str:
    """Number of evaluations of a run that was killed, read from its record."""
    from samplers.record import Record

    return f"after {Record(path.with_name(f'{path.name}.mcmc.record')).count} evaluations"


def job(repeats: int, every: int = EVERY, limit: float = LIMIT) -> list[Row]:
    """Both settings on one sample in `every`, one run each with a limit of `limit` seconds; `repeats` has no effect."""
    kept = "full record" if every == 1 else f"1 sample in {every}"
    rows, done = [], {}
    for setting, what in SETTINGS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "chain.h5"
            found = _ask(setting, str(every), str(path), limit=limit or None)
            note = "" if found else f"stopped at {limit:g} s, {evaluations_made(path)}"
        case = f"{what}, {kept}"
        if found is None:
            rows.append(Row("job: simulations", case, None, "", note))
            continue
        done[setting] = found
        evidence, error = found["log_evidence"]
        note = f"{found['stages']} stages, {found['failures']} failed; log Z {evidence:.2f} +- {error:.2f}; seed {SEED}"
        rows += [
            Row("job: simulations", case, found["simulations"], "", note),
            Row("job: wall time", case, found["seconds"], "s", "kernels compiled before"),
            Row("job: CPU time", case, found["cpu"], "s"),
            Row("job: peak memory", case, found["peak"], "MiB", "resident"),
        ]
    return rows + (compare_settings(done["default"], done["paper"], kept) if len(done) == len(SETTINGS) else [])


def compare_settings(default: dict, paper: dict, kept: str) -> list[Row]:
    """Rows that compare the default with the settings of the paper: cost and difference of the posteriors."""
    means, sds = ([np.array(run[key]) for run in (default, paper)] for key in ("mean", "sd"))
    return [
        Row("job: paper / default, simulations", kept, paper["simulations"] / default["simulations"], ""),
        Row("job: paper / default, wall time", kept, paper["seconds"] / default["seconds"], ""),
        Row("job: paper / default, CPU time", kept, paper["cpu"] / default["cpu"], ""),
        Row(
            "job: difference of means", kept, np.abs((means[1] - means[0]) / sds[0]).max(), "sd", "largest of the seven"
        ),
        Row("job: difference of sds", kept, 100 * np.abs(sds[1] / sds[0] - 1.0).max(), "%", "largest of the seven"),
    ]


def memory(repeats: int) -> list[Row]:
    """Peak resident memory after each step of the update on the full record, measured once; `repeats` has no effect."""
    return [Row("memory, peak resident", case, value, "MiB") for case, value in _ask("memory").items()]


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    answer = _memory() if what == "memory" else _run(what, int(rest[0]), rest[1])
    sys.stdout.write(json.dumps(answer) + "\n")
