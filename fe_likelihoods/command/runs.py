"""Runs in a folder: one that is new, one that is continued, and the report of a stored one.

A folder has the run itself (``run.h5`` and its record of evaluations), the cache of simulations, a copy of the TOML
file, and the results. A run that was killed goes on from the record, with the results of an uninterrupted run.
"""

import json
import logging
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..checks.finding import NOTE, labelled
from ..checks.model import refuse_chance
from ..checks.result import judge_run
from ..checks.run import read_run
from ..reporting.other_events import describe_event
from .events import Event, predict_events, predict_quietly, read_events
from .job import Job, parse_job, read_job
from .models import Problem, make_problem, runs_code_of_user
from .results import write_events, write_samples, write_tables

__all__ = ["CACHE", "Outcome", "default_folder", "is_free", "make_sampler", "report_run", "run_job"]

SETTINGS, ORIGIN, CHAIN, PAGE = "settings.toml", "origin.json", "run.h5", "report.html"
CACHE = "simulations.sqlite"
CHANGEABLE = ("budget", "events", "prediction")  # sections that do not change what a run has computed so far


class Outcome(NamedTuple):
    """What a run has left."""

    folder: Path
    sampler: Any
    problem: Problem
    files: tuple[str, ...]  # names of the result files
    findings: tuple[str, ...]  # lines on what speaks against the result and the predictions
    usable: bool  # whether the result can be used, if with care


def default_folder(file: Path) -> Path:
    """Folder for the results of a TOML file, in the current folder: ``results-column`` for ``column.toml``."""
    return Path(f"results-{file.stem}")


def is_free(folder: Path) -> bool:
    """Whether a run may use a folder: it is the folder of a run, or has nothing but simulations of a check."""
    if (folder / SETTINGS).is_file() or not folder.exists():
        return True
    return folder.is_dir() and all(each.name.startswith(CACHE) for each in folder.iterdir())


def make_sampler(job: Job, problem: Problem, backend: Any = None, chain: int = 0) -> Any:
    """Make the sampler of a TOML file, in memory without a backend; ValueError for a setting names its section.

    `chain` is the number of the independent run.
    """
    import samplers

    given, posterior = job.sampler, problem.posterior
    try:
        return {"smc": samplers.SMCSampler, "tmcmc": samplers.TMCMCSampler}[given.kind](
            given.walkers,
            posterior.ndim,
            posterior,
            backend=backend,
            vectorize=True,
            seed=given.seed + chain,
            guide=posterior.guide() if given.guide else None,
            max_simulations=job.budget.max_simulations,
            **given.given("recycle", "ess_ratio", "min_moves", "max_moves", "max_failure_share"),
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{job.where('sampler')} {error}") from error


def run_job(file: Path, folder: Path | None = None, overwrite: bool = False, progress: bool = True) -> Outcome:
    """Start or continue the run of a TOML file in a folder (default: `default_folder`), and write its results.

    With `overwrite` the run that the folder contains is deleted. ValueError if anything in
    the file is wrong, the folder contains the run of other settings, or a model of the user is not repeatable.
    """
    job = read_job(file)
    folder = folder or default_folder(file)
    tried = make_problem(job)
    make_sampler(job, tried)  # before the folder is touched
    events = read_events(job, tried)
    _prepare(job, folder, getattr(tried.posterior, "fingerprint", None), overwrite)
    problem = make_problem(job, SimulationCache(folder / CACHE) if job.budget.cache else None)
    if runs_code_of_user(job) and not (folder / CHAIN).exists():
        refuse_chance(problem.posterior)
    samplers = _stored_samplers(job, problem, folder)
    for sampler in samplers:
        # the annealing of a stored run is made again from its record, also where no step is missing
        sampler.run_mcmc(None, max(job.sampler.steps - sampler.iteration, 0), progress=progress)
    return _write(folder, job, _command(job.file, folder), samplers, problem, events, progress)


def report_run(path: Path, runs_code: bool = False) -> Outcome:
    """Make the tables and the report of a stored run, its folder or a file in it, again, without new samples.

    ValueError if it is not such a folder, its data are no longer there, the run has no samples yet, or the model is a
    user's code and `runs_code` is false.
    """
    folder = path.parent if path.is_file() else path
    if not (folder / SETTINGS).is_file() or not (folder / CHAIN).is_file():
        raise ValueError(
            f"{folder} is not the folder of a run: it has no {SETTINGS} or {CHAIN}; give the folder that "
            "`fe-likelihoods run` made"
        )
    origin = _origin(folder)
    job = parse_job((folder / SETTINGS).read_text(encoding="utf-8"), folder / SETTINGS, Path(origin["folder"]))
    if runs_code_of_user(job) and not runs_code:
        raise ValueError(
            f"the model of {folder} is a Python file or program that its settings name, and nothing was run: give "
            "--run-code if you trust this code"
        )
    problem = make_problem(job, SimulationCache(folder / CACHE) if (folder / CACHE).is_file() else None)
    again, fingerprint = _command(Path(origin["file"]), folder), getattr(problem.posterior, "fingerprint", None)
    if origin.get("posterior", fingerprint) != fingerprint:
        raise ValueError(
            f"{folder} contains a run with other data or another model than its files have now, or of another release: "
            f"put them back, or make a new run: {again} --overwrite"
        )
    samplers = _stored_samplers(job, problem, folder)
    if not all(sampler.iteration for sampler in samplers):
        raise ValueError(f"the run in {folder} has no samples yet; continue it with: {again}")
    logger = logging.getLogger("samplers.tempered")
    level = logger.level
    logger.setLevel(logging.ERROR)  # a report need not say that a run continues or is complete
    for sampler in samplers:
        if sampler.iteration >= job.sampler.steps:
            # the annealing is made again without an evaluation; the chain alone has lost which walkers are copies
            sampler.run_mcmc(None, 0, progress=False)
    logger.setLevel(level)
    return _write(folder, job, again, samplers, problem, read_events(job, problem), False)


def _command(file: Path, folder: Path) -> str:
    """The command that makes a run again."""
    return shlex.join(["fe-likelihoods", "run", str(file), "--out", str(folder)])


def _damaged(path: Path, error: Exception | str) -> ValueError:
    """The error for a file of a run that cannot be read."""
    return ValueError(
        f"{path} is damaged ({error}): put back a copy of it, or begin again with `fe-likelihoods run FILE "
        "--overwrite`, which deletes the run in this folder with its simulations"
    )


def _origin(folder: Path) -> dict[str, Any]:
    """Where a run comes from; ValueError if its file is missing or damaged."""
    try:
        found = json.loads((folder / ORIGIN).read_text(encoding="utf-8"))
        return {"file": found["file"], "folder": found["folder"]} | found
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(folder / ORIGIN, error) from error


def _stored_samplers(job: Job, problem: Problem, folder: Path) -> list[Any]:
    """A sampler for each independent run of a folder, whose chains are in run.h5, run-2.h5, ..."""
    import emcee

    names = [CHAIN, *(f"run-{k}.h5" for k in range(2, job.sampler.chains + 1))]
    backends = [emcee.backends.HDFBackend(str(folder / name)) for name in names]
    return [make_sampler(job, problem, backend, chain) for chain, backend in enumerate(backends)]


def _write(
    folder: Path, job: Job, again: str, samplers: list[Any], problem: Problem, events: tuple[Event, ...], progress: bool
) -> Outcome:
    """Write tables, predictions, samples and report; `again` is the command that makes the run.

    Predictions are made here; their responses are in the cache if they were made before.
    """
    from ..reporting.report import write_page

    run = read_run(samplers[0], problem.posterior)
    drawn, prediction = _drawn(job, problem, samplers[0]), None
    if len(drawn) and not job.modes and not (job.load_test and job.measurements):  # the report has a figure of each fit
        prediction = job.located("prediction", predict_quietly, job, problem, drawn, progress=progress)
    predicted = predict_events(job, events, problem, drawn, progress)
    measured = {event.name: event.measured for event in events if event.name in predicted and event.measured}
    described = [describe_event(name, each, measured.get(name)) for name, each in predicted.items()]
    judged = judge_run(run)
    judgement = judged.judgement
    samples, agreement = write_samples(folder, run, samplers, prediction, job.prediction.draws, judgement)
    write_page(folder / PAGE, run, prediction, judged, events=predicted, measured=measured, repeat=again)
    tables = write_tables(folder, run, judged, agreement)  # last: they say how many simulations there are
    found = {"": judgement.findings, "prediction: ": () if prediction is None else prediction.findings}
    found |= {f"event {each.name}: ": each.findings for each in described}
    said = [line for of, group in found.items() for line in labelled((x for x in group if x.severity != NOTE), of)]
    files = (PAGE, *tables, samples, *write_events(folder, described))
    return Outcome(folder, samplers[0], problem, files, tuple(said), judgement.status != "do not use")


def _prepare(job: Job, folder: Path, fingerprint: str | None, overwrite: bool) -> None:
    """Make the folder, or check that it contains a run of the same settings and of the posterior with a fingerprint."""
    settings = folder / SETTINGS
    if overwrite and settings.is_file():
        shutil.rmtree(folder)
    if settings.is_file():
        try:
            changed = _changes(settings.read_text(encoding="utf-8"), job.text)
        except ValueError as error:  # also of tomllib
            raise _damaged(settings, error) from error
        stored, other = _origin(folder), ""
        if changed:
            other = f"other settings: {', '.join(changed)} differ from {job.file.name}"
        elif stored.get("posterior", fingerprint) != fingerprint:
            other = f"other data or another model, of {stored['file']}"
        if other:
            raise ValueError(
                f"{folder} contains a run with {other}. Give another folder with --out, or delete that run with "
                "--overwrite"
            )
    elif not is_free(folder):
        raise ValueError(f"{folder} exists and is not the folder of a run; give another one with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot make the folder {folder}: {error.strerror}; give another one with --out") from error
    settings.write_text(job.text, encoding="utf-8")
    origin = {"file": str(job.file.resolve()), "folder": str(job.folder.resolve()), "posterior": fingerprint}
    (folder / ORIGIN).write_text(json.dumps(origin, indent=2) + "\n", encoding="utf-8")


def _changes(old: str, new: str) -> list[str]:
    """Keys whose values differ, except in sections that a continued run may change."""
    before, after = (tomllib.loads(text) for text in (old, new))
    found = []
    for section in sorted({*before, *after} - {*CHANGEABLE}):
        ours, theirs = before.get(section, {}), after.get(section, {})
        found += [f"[{section}] {key}" for key in sorted({*ours, *theirs}) if ours.get(key) != theirs.get(key)]
    return found


def _drawn(job: Job, problem: Problem, sampler: Any) -> np.ndarray:
    """Draws of the posterior to predict with, those that `samplers.to_arviz` takes from one chain."""
    chain, n = sampler.get_chain()[:, np.argsort(sampler.founders, kind="stable")], job.prediction.draws
    samples = chain.swapaxes(0, 1).reshape(-1, sampler.ndim)
    rows = np.unique(np.linspace(0, len(samples) - 1, min(n, len(samples))).round().astype(int))
    return problem.posterior.draw_noise(samples[rows], job.sampler.seed) if job.marginal else samples[rows]
