"""What the command ``check`` does: read everything, simulate a few times, draw the picture."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..checks.compared import data_sets_of, draws_to_compare
from ..checks.finding import NOTE, labelled
from ..checks.rehearsal import ModelCheck, check_model
from ..checks.screening import repair_lines, screen
from ..information.identifiability import identifiability
from ..signals.error_measures import rrmse
from ..units import from_si
from .events import read_events
from .job import read_job
from .models import Problem, make_problem
from .runs import CACHE, default_folder, is_free, make_sampler

__all__ = ["check_job"]

SEARCH_SECONDS, MOST_SEARCHED = 60.0, 150  # of a search for what the data determine, and its simulations


def check_job(file: Path, picture: Path, say: Callable[[str], None], progress: bool = False) -> None:
    """Check a TOML file and its data, `say` line by line what a run will do, and draw the prior predictive picture.

    ValueError if anything in the file is wrong, or the simulation at the mean of the prior fails.
    """
    if not picture.resolve().parent.is_dir():
        raise ValueError(f"cannot write {picture}: there is no folder {picture.parent}; give another file with --out")
    job, folder = read_job(file), default_folder(file)
    cache = None
    if job.budget.cache and is_free(folder):
        with suppress(OSError):  # the run will say so
            folder.mkdir(parents=True, exist_ok=True)
            cache = SimulationCache(folder / CACHE)
    problem = make_problem(job, cache)
    make_sampler(job, problem)  # checks its settings
    events = read_events(job, problem)
    _say_data(problem, say)
    checked = _say_simulation(problem, say, progress)
    given = {} if job.measurements is None else job.measurements.given()
    parts = [part for part, _ in problem.posterior.likelihood.parts()]
    repairs = [f"  {line}" for part in parts for line in repair_lines(screen(part.measurements), given)]
    if repairs and given:
        say("Lines of [measurements] that deal with the sensors, instead of lines with the same keys:")
        say("\n".join(repairs))
    for event in events:
        compared = "without measurements" if event.measured is None else "compared with measurements"
        say(f"Event {event.name}: {event.record}, {compared}")
    if (most := job.budget.max_simulations) is not None:
        say(f"The run stops at {most} simulations (max_simulations)")
    names = ", ".join(map(str, _draw(problem, checked, picture)))
    say(f"{names}: the measurements should lie within the band of the simulations at draws of the prior")
    stored = "" if cache is None else f", those of the calibrated model are stored in {folder}/ for the run"
    say(f"This check made {checked.simulations} simulations{stored}")
    say(f"Next: fe-likelihoods run {file} (writes to {folder}/)")


def _say_data(problem: Problem, say: Callable[[str], None]) -> None:
    posterior, record = problem.posterior, problem.record
    if record is not None:
        say(f"Record: {record}" + (f"\n  from {record.source}" if record.source else ""))
    for likelihood, _ in posterior.likelihood.parts():
        measured, model, modal = likelihood.measurements, likelihood.model, likelihood.is_modal
        say(f"Measurements: {measured.description or 'without a description'}")
        if modal:
            say(str(model.data))
        for channel, values in () if modal else zip(measured.channels, measured.values, strict=True):
            shown = from_si(values[np.isfinite(values)], channel.unit)
            missing = f", {len(values) - len(shown)} missing" if len(shown) < len(values) else ""
            what = "samples" if measured.is_history else "values"
            say(f"  {channel.name}: {len(shown)} {what}{missing}, peak {np.abs(shown).max():.3g} {channel.unit}")
        inner = getattr(model, "model", model) if modal else model
        say(f"Model: {type(getattr(inner, 'parts', inner)).__name__}, parameters: {len(model.parameter_names)}")
    say(f"Parameters with those of the noise: {posterior.ndim}")
    width = max(len(parameter.label) for parameter in posterior.parameters)
    for parameter in posterior.parameters:
        mean, sd = (parameter.shown(value) for value in posterior.prior.distributions[parameter.name].moments)
        note = " (assumed: not in the file)" if parameter.name in problem.assumed else ""
        say(f"  {parameter.label:<{width}}  prior mean {mean:.3g}, standard deviation {sd:.3g}{note}")


def _say_simulation(problem: Problem, say: Callable[[str], None], progress: bool) -> ModelCheck:
    """Check the model, and say what was found."""
    posterior = problem.posterior
    mean, checked = posterior.prior.mean(), check_model(posterior, progress=progress)
    say(f"One simulation takes {checked.seconds:.2g} s")
    for part, columns in posterior.likelihood.parts():
        theta, measured = mean[None, columns[: len(part.model.parameter_names)]], part.measurements
        if part.is_modal:
            say(f"At the mean of the prior:\n{part.predict_modes(theta)}")
            continue
        errors = rrmse(measured.values - part.residuals_of(part.simulate(theta).response[0]), measured.values)
        fit = ", ".join(f"{c.name} {100 * e:.0f} %" for c, e in zip(measured.channels, errors, strict=True))
        say(f"At the mean of the prior the error of the response (RRMSE) is {fit}")
    for line in (*labelled(checked.findings), *(f"{name}: {how}" for name, how in checked.steps.items())):
        say(line)
    most = min(MOST_SEARCHED, SEARCH_SECONDS / max(checked.seconds, 1e-6))
    # of wrong data, nothing is known
    if most > 10 * posterior.ndim and all(each.severity == NOTE for each in checked.findings):
        with suppress(ValueError, np.linalg.LinAlgError):
            told = identifiability(posterior, max_simulations=most)
            say(f"{told}")
            return checked._replace(simulations=checked.simulations + round(told.simulations))
    return checked


def _draw(problem: Problem, checked: ModelCheck, picture: Path) -> list[Path]:
    """The draws of the prior that a check has simulated, with the measurements, as a PNG file for each data set."""
    from ..plots.predictions import plot_bands
    from ..plots.without_time import plot_modes, plot_points
    from ..prediction.propagation import propagate
    from ..reporting.pictures import save_picture

    posterior, files = problem.posterior, []
    points, modes = draws_to_compare(posterior, checked.seconds), {fit.title: fit.modal for fit in checked.fits}
    for key, part, columns in data_sets_of(posterior):
        measured = part.measurements
        if part.is_modal:
            drawn = modes[key].draws
            if drawn is None:  # the log says why
                continue
            figure = plot_modes(drawn, label=f"{len(drawn.frequencies)} draws of the prior, 90 %")
        else:
            draws = points[:, columns[: len(part.model.parameter_names)]]
            options = {"quantiles": (0.05, 0.95), "cache": part.simulator, "progress": False}
            drawn = propagate(part.model, draws, **options)
            figure = plot_bands(drawn, measured) if measured.is_history else plot_points(measured, prediction=drawn)
            figure.suptitle(f"{drawn.n_samples} draws of the prior and the measurements")
        files.append(picture.with_name(f"{picture.stem}-{key}{picture.suffix}") if key else picture)
        save_picture(figure, files[-1])
    return files
