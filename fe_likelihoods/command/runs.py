"""Runs in a folder: one that is new, one that is continued, and the report of a stored one.

A folder has the run itself (``run.h5`` and its record of evaluations), the cache of simulations, a copy of the TOML
file, and the results. A run that was killed goes on from the record, with the results of an uninterrupted run.
"""

import json
import shlex
import tomllib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import samplers

from ..cache.simulation_cache import SimulationCache
from ..checks.finding import NOTE, FindingWarning, labelled
from ..checks.model import refuse_chance
from ..checks.result import FinishedRun, JudgedRun, judge_run, read_run
from .job import Job, parse_job, read_job
from .make_posterior import Problem, make_problem, runs_code_of_user

SETTINGS, ORIGIN, CHAIN, PAGE = "settings.toml", "origin.json", "run.h5", "report.html"
CACHE = "simulations.sqlite"
CHANGEABLE = ("budget", "prediction")  # sections that do not change what a run has computed so far


class Outcome(NamedTuple):
    """What a run has left: its folder, the first sampler, and whether the result can be used."""

    folder: Path
    sampler: Any
    usable: bool


def default_folder(file: Path) -> Path:
    """Folder for the results of a TOML file, in the current folder: ``results-column`` for ``column.toml``."""
    return Path(f"results-{file.stem}")


def make_sampler(job: Job, problem: Problem, backend: Any = None, chain: int = 0) -> Any:
    """Make the sampler of a TOML file, in memory without a backend, of the independent run `chain`."""
    given, posterior = job.sampler, problem.posterior
    kind = {"smc": samplers.SMCSampler, "tmcmc": samplers.TMCMCSampler}[given.kind]
    options = {"guide": posterior.guide() if given.guide else None} | given.given("recycle", "max_failure_share")
    options |= {"seed": given.seed + chain, "max_simulations": job.budget.max_simulations, "backend": backend}
    return kind(given.walkers, posterior.ndim, posterior, vectorize=True, **options)


def run_job(file: Path, folder: Path | None = None, progress: bool = True) -> Outcome:
    """Start or continue the run of a TOML file in a folder (default: `default_folder`), and write its results."""
    job, folder = read_job(file), folder or default_folder(file)
    problem = make_problem(job)
    job.located("sampler", make_sampler, job, problem)  # before the folder is touched
    _prepare(job, folder, problem)
    if runs_code_of_user(job) and not (folder / CHAIN).exists():
        refuse_chance(problem.posterior)
    return _go_on(job, folder, job.file, True, progress)


def report_run(path: Path, runs_code: bool = False) -> Outcome:
    """Make the results of a stored run again, its folder or a file in it, without new samples.

    ValueError if the model is a user's code and `runs_code` is false, or the data are no longer as they were.
    """
    folder = path.parent if path.is_file() else path
    if not (folder / CHAIN).is_file():
        raise ValueError(f"{folder} is not the folder of a run: it has no {CHAIN}; give one that `run` has made")
    text, origin = _stored(folder)
    job = parse_job(text, folder / SETTINGS, Path(origin["folder"]))
    if runs_code_of_user(job) and not runs_code:
        raise ValueError(
            f"the model of {folder} is a Python file or program that its settings name, and nothing was run: give "
            "--run-code if you trust this code"
        )
    _check_same(folder, make_problem(job), origin, [])
    return _go_on(job, folder, Path(origin["file"]), False, False)


def _go_on(job: Job, folder: Path, file: Path, samples: bool, progress: bool) -> Outcome:
    """Go on with the run in a folder, without new steps if not `samples`, and write its results."""
    import emcee  # slow to import

    problem, chains = make_problem(job, SimulationCache(folder / CACHE)), []
    again = shlex.join(["fe-likelihoods", "run", str(file), "--out", str(folder)])
    for k in range(job.sampler.chains):  # independent runs
        backend = emcee.backends.HDFBackend(str(folder / (f"run-{k + 1}.h5" if k else CHAIN)))
        sampler = make_sampler(job, problem, backend, k)
        # the first step with a guide is its draws, and costs no simulation
        missing = max((job.sampler.steps or (1 if job.sampler.guide else 4)) - sampler.iteration, 0)
        if not samples and not sampler.iteration:
            raise ValueError(f"the run in {folder} has no samples yet; continue it with: {again}")
        if samples or not missing:
            # the annealing of a stored run is made again from its record, without an evaluation, also where no step is
            # missing: the chain alone has lost which walkers are copies
            sampler.run_mcmc(None, missing, progress=progress)
        chains.append(sampler)
    return _write(folder, job, file, again, chains, problem, progress)


def _write(
    folder: Path, job: Job, file: Path, again: str, chains: list[Any], problem: Problem, progress: bool
) -> Outcome:
    """Write tables, prediction, samples and report with the name of the TOML file; `again` is the command."""
    from ..prediction.propagation import propagate  # slow to import
    from ..reporting.report import write_page

    run, drawn, prediction = read_run(chains[0], problem.posterior), _drawn(chains[0], job.prediction.draws), None
    if len(drawn) and not job.modes and not (job.load_test and job.measurements):  # the report has a figure of each fit
        cache = problem.posterior.likelihood.simulator.cache
        options = {"noise": job.prediction.noise, "seed": job.sampler.seed, "cache": cache, "progress": progress}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FindingWarning)  # the outcome has its findings
            prediction = job.located("prediction", propagate, problem.posterior, drawn, **options)
    judged = judge_run(run)
    agreement = write_samples(folder, run, chains, prediction, str(judged.judgement))
    write_page(folder / PAGE, run, prediction, judged, title=f"Bayesian updating: {file.stem}", repeat=again)
    said = [each.measurements.description for each, _ in problem.posterior.likelihood.data_sets()]
    said = [agreement, *(f"Measurements: {each}" for each in said if "CAUTION" in each)]
    said += [f"Assumed priors [SI], which the file does not give: {problem.assumed}"] if problem.assumed else []
    for of, findings in (("", judged.judgement.findings), ("prediction: ", prediction and prediction.findings)):
        said += labelled((each for each in findings or () if each.severity != NOTE), of)
    write_summary(folder, run, judged, said)  # last: it says how many simulations there are
    return Outcome(folder, chains[0], judged.judgement.status != "do not use")


def write_summary(folder: Path, run: FinishedRun, judged: JudgedRun, said: Sequence[str]) -> None:
    """Write ``summary.txt`` (judgement, moments of the parameters, fit, what else is `said`) and ``summary.csv``."""
    import pandas as pd  # slow to import

    from ..reporting.contents import parameter_table
    from ..text_tables import text_table

    rows = parameter_table(run)
    columns = ["parameter", "mean", "mean_error", "sd", "sd_error", "cv", "q05", "median", "q95", "nominal"]
    rows.to_csv(folder / "summary.csv", index=False, columns=columns)
    pd.DataFrame([stage._asdict() for stage in run.sampler.ladder]).to_csv(folder / "stages.csv", index=False)
    forms = ("", ".5g", ".2g", ".4g", ".2g", ".3g")
    cells = [map(format, row, forms) for row in rows[columns[:6]].itertuples(index=False)]
    moments = text_table([columns[:6], *map(list, cells)])
    evidence = f"log-evidence {run.sampler.log_evidence:.2f} +- {run.sampler.log_evidence_error:.2g}"
    lines = [str(judged.judgement), "", moments, "", evidence, str(run.verdict), ""]
    for fit in judged.fits:
        title = f" ({fit.title})" if fit.title else ""
        errors = [f"  {each.channel.name}: {100 * each.after:.1f} %" for each in fit.channels]
        lines += [f"Relative RMS error of the response (RRMSE){title}:", *errors] if errors else []
        if fit.modal:
            found = {"": fit.modal.samples, "Held out, predicted:\n": fit.modal.held_out}
            lines += [f"{what}{modes}" for what, modes in found.items() if modes is not None]
    (folder / "summary.txt").write_text("\n".join([*lines, *filter(None, said), ""]), encoding="utf-8")


def write_samples(folder: Path, run: FinishedRun, samplers: Sequence[Any], prediction: Any, judgement: str) -> str:
    """Write ``posterior.nc``, the samples with the prediction and the judgement as an attribute.

    Independent runs are chains. Returns how the runs agree, empty for one.
    """
    import arviz  # slow to import

    from samplers import to_arviz

    data = to_arviz(samplers, prediction, discard=run.discard)
    data.posterior.attrs["judgement"] = judgement
    data.to_netcdf(str(folder / "posterior.nc"))
    if len(samplers) == 1:
        return ""
    found = arviz.rhat(data)
    found = found["posterior"] if "posterior" in getattr(found, "children", {}) else found
    worst, name = max((float(each), name) for name, each in found.data_vars.items())
    values = ", ".join(f"{each.log_evidence:.2f} +- {each.log_evidence_error:.2g}" for each in samplers)
    agree = f"r_hat at most {worst:.3f} ({name}; above 1.01 they differ)"
    return f"{len(samplers)} independent runs: {agree}, log-evidences {values}"


def _drawn(sampler: Any, n: int) -> np.ndarray:
    """Draws of the posterior to predict with, evenly spaced among founders, walkers and steps."""
    chain = sampler.get_chain()[:, np.argsort(sampler.founders, kind="stable")]
    samples = chain.swapaxes(0, 1).reshape(-1, sampler.ndim)
    rows = np.unique(np.linspace(0, len(samples) - 1, min(n, len(samples))).round().astype(int))
    return samples[rows]


def _stored(folder: Path) -> tuple[str, dict[str, Any]]:
    """The settings of the run in a folder, and where they are from; ValueError if a file is missing or damaged."""
    try:
        text, origin = ((folder / name).read_text(encoding="utf-8") for name in (SETTINGS, ORIGIN))
        tomllib.loads(text)
        return text, {"file": "", "folder": "", "posterior": None} | json.loads(origin)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(
            f"{SETTINGS} or {ORIGIN} in {folder} is damaged ({error}): put back a copy of it, or delete the folder"
        ) from error


def _check_same(folder: Path, problem: Problem, origin: dict[str, Any], changed: list[str]) -> None:
    """ValueError if the run in a folder has other settings, of which some have `changed`, or another posterior."""
    other = f"other settings: {', '.join(changed)} differ" if changed else ""
    if not other and origin["posterior"] != problem.posterior.fingerprint:
        other = f"other data or another model than now, of {origin['file']}"
    if other:
        raise ValueError(
            f"{folder} contains a run with {other}. Put them back, give another folder with --out, or delete this one"
        )


def _prepare(job: Job, folder: Path, problem: Problem) -> None:
    """Make the folder of a run, or check that it contains a run of the same settings and posterior."""
    if (folder / SETTINGS).is_file():
        text, origin = _stored(folder)
        before, after = tomllib.loads(text), tomllib.loads(job.text)
        changed = []
        for section in sorted({*before, *after} - {*CHANGEABLE}):
            ours, theirs = before.get(section, {}), after.get(section, {})
            changed += [f"[{section}] {key}" for key in sorted({*ours, *theirs}) if ours.get(key) != theirs.get(key)]
        _check_same(folder, problem, origin, changed)
    elif folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is not the folder of a run; give another one with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot make the folder {folder}: {error.strerror}; give another one with --out") from error
    (folder / SETTINGS).write_text(job.text, encoding="utf-8")
    origin = {"file": str(job.file.resolve()), "folder": str(job.folder.resolve())}
    origin["posterior"] = problem.posterior.fingerprint
    (folder / ORIGIN).write_text(json.dumps(origin, indent=2) + "\n", encoding="utf-8")
