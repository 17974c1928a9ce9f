"""What the command ``check`` does: read everything, simulate a few times, estimate the cost, draw the picture."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..checks.finding import labelled
from ..checks.rehearsal import ModelCheck, check_model
from ..checks.screening import check_noise_prior, repair_lines, screen
from ..information.identifiability import of_mode
from ..likelihood.posterior import Posterior
from ..signals.error_measures import rrmse
from ..units import from_si
from .events import Event, read_events
from .job import Job, read_job
from .models import Problem, make_problem, noise_channels_of
from .runs import CACHE, default_folder, is_free
from .sampling import is_emcee, make_sampler

__all__ = ["check_job"]

PICTURE_SECONDS = 10.0
FEWEST_DRAWS, MOST_DRAWS = 5, 40


def check_job(file: Path, picture: Path, say: Callable[[str], None], progress: bool = False) -> None:
    """Check a TOML file and its data, `say` line by line what a run will do, and draw the prior predictive picture.

    ValueError if anything in the file is wrong, or the simulation at the mean of the prior fails.
    """
    if not picture.resolve().parent.is_dir():
        raise ValueError(f"cannot write {picture}: there is no folder {picture.parent}; give another file with --out")
    job = read_job(file)
    problem = make_problem(job, _cache_of_the_run(job, default_folder(file)))
    sampler = make_sampler(job, problem)
    events = read_events(job, problem)
    _say_data(problem, say)
    checked = _say_simulation(problem, events, say, progress)
    repairs = repair_lines(screen(problem.posterior.likelihood.measurements), job.measurements)
    if repairs:
        say("Lines of [measurements] that deal with the sensors, instead of lines with the same keys:")
        for line in repairs:
            say(f"  {line}")
    for event in events:
        steps = f"{event.record.n_steps} samples at {event.record.dt:g} s"
        compared = "without measurements" if event.measured is None else "compared with measurements"
        say(f"Event {event.name}: {event.record.name}, {steps}, {compared}")
    guided = job.sampler.get("guide", False)
    if is_emcee(job):
        simulations = sampler.nwalkers * (job.sampler["steps"] + 1)
        say(f"emcee makes {simulations} simulations: {sampler.nwalkers} walkers, {job.sampler['steps']} steps")
    else:
        _say_cost(make_problem(job).posterior, sampler, guided, job.budget, checked, say)
    _draw(problem, checked.seconds, picture)
    say(f"{picture}: the measurements should lie within the band of the simulations at draws of the prior")
    made, cache = checked.simulations, problem.posterior.likelihood.simulator.cache
    stored = (
        "" if cache is None else f", those of the calibrated model are stored in {default_folder(file)}/ for the run"
    )
    say(f"This check made {made} simulations besides those of the picture{stored}")
    say(f"Next: fe-likelihoods run {file} (writes to {default_folder(file)}/)")


def _say_data(problem: Problem, say: Callable[[str], None]) -> None:
    posterior, record = problem.posterior, problem.record
    likelihood = posterior.likelihood
    measured, model = likelihood.measurements, likelihood.model
    if record is not None:
        peak = from_si(np.abs(record.acceleration).max(), "g").item()
        say(f"Record: {record.name}, {record.n_steps} samples at {record.dt:g} s, peak {peak:.3g} g")
        if record.source:
            say(f"  from {record.source}")
    say(f"Measurements: {measured.description or 'without a description'}")
    modal = likelihood.is_modal
    if modal:
        say(str(model.data))
    for channel, values in () if modal else zip(measured.channels, measured.values, strict=True):
        shown = from_si(values[np.isfinite(values)], channel.unit)
        missing = f", {len(values) - len(shown)} missing" if len(shown) < len(values) else ""
        what = "samples" if measured.is_history else "values"
        say(f"  {channel.name}: {len(shown)} {what}{missing}, peak {np.abs(shown).max():.3g} {channel.unit}")
    inner = getattr(model, "model", model) if modal else model
    name, n = type(getattr(inner, "parts", inner)).__name__, len(model.parameter_names)
    say(f"Model: {name}, {n} parameters; with the noise {posterior.ndim}:")
    width, channels = max(len(parameter.label) for parameter in posterior.parameters), noise_channels_of(likelihood)
    for parameter in posterior.parameters:
        prior = posterior.prior.distributions[parameter.name]
        mean, sd = (parameter.shown(value) for value in prior.moments)
        note = " (assumed: not in the file)" if parameter.name in problem.assumed else ""
        say(f"  {parameter.label:<{width}}  prior mean {mean:.3g}, standard deviation {sd:.3g}{note}")
        channel = channels.get(parameter.name)
        if channel is not None:
            largest = float(np.nanmax(np.abs(measured.channel(channel.name))))
            for line in labelled(check_noise_prior(channel.name, channel.unit, float(prior.moments[0]), largest)):
                say(f"  {line}")


def _cache_of_the_run(job: Job, folder: Path) -> SimulationCache | None:
    """The cache that a run in this folder will use; None if it uses none, or cannot use the folder."""
    if not job.budget.get("cache", True) or not is_free(folder):
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # the run will say so
        return None
    return SimulationCache(folder / CACHE)


def _say_simulation(
    problem: Problem, events: tuple[Event, ...], say: Callable[[str], None], progress: bool
) -> ModelCheck:
    """Check the model, and say what was found."""
    posterior = problem.posterior
    likelihood, mean = posterior.likelihood, posterior.prior.mean()
    measured, n = likelihood.measurements, len(likelihood.model.parameter_names)
    point = mean if likelihood.ndim == len(mean) else mean[:n]
    if not np.isfinite(likelihood.log_likelihood(point)):
        raise ValueError(
            f"the simulation at the mean of the prior has failed: {likelihood.fault(point) or 'no finite likelihood'}; "
            "check [model] and [priors]"
        )
    checked = check_model(posterior, {event.name: event.record for event in events}, progress=progress)
    say(f"One simulation takes {checked.seconds:.2g} s")
    if likelihood.is_modal:
        say(f"At the mean of the prior:\n{likelihood.predict_modes(mean[None, :n]).short()}")
    else:
        response = likelihood.simulate(mean[None, :n]).response[0]
        errors = rrmse(measured.values - likelihood.residuals_of(response), measured.values)
        fit = ", ".join(f"{c.name} {100 * e:.0f} %" for c, e in zip(measured.channels, errors, strict=True))
        say(f"At the mean of the prior the error of the response (RRMSE) is {fit}")
    for line in labelled(checked.findings):
        say(line)
    if checked.best_fit is not None:
        with suppress(ValueError):  # a parameter that its prior does not let vary there
            say(f"{of_mode(*checked.best_fit)}")
    for name, how in checked.tests.items():
        say(f"{name}: {how}")
    return checked


def _say_cost(
    posterior: Posterior, sampler: Any, guided: bool, budget: dict, checked: ModelCheck, say: Callable[[str], None]
) -> None:
    """Estimate the cost with a posterior whose simulations are not cached."""
    from samplers import estimate_cost

    estimate = estimate_cost(posterior, sampler.nwalkers, type(sampler), seed=1)
    if guided and np.isfinite(checked.searched):
        # later starts often join earlier ones; rough responses take several rounds of draws
        fewest = 2.0 * checked.searched + sampler.nwalkers
        say(
            f"The run uses a guide: a search from one start took {checked.searched:.0f} simulations, so that the run "
            f"needs at least about {fewest:.0f}, and up to several times as many if the response is rough; "
            f"{5.0 * fewest:.0f} take {estimate.time_of(5.0 * fewest)}, to which the guide adds its own computations, "
            "half a minute for 7 parameters"
        )
    elif guided:
        say(
            f"The run uses a guide: how many simulations it needs is not predicted; 500 take "
            f"{estimate.time_of(500)}, to which the guide adds its own computations, half a minute for 7 parameters"
        )
    else:
        say(f"Estimated cost until beta = 1:\n{estimate}")
    if "max_simulations" in budget:
        say(f"The run stops at {budget['max_simulations']} simulations (max_simulations)")
        if not guided and budget["max_simulations"] < estimate.fewest:
            say(
                f"CAUTION: it needs about {estimate.fewest:.3g} or more, and will probably end before "
                "beta = 1; a larger max_simulations continues it"
            )


def _draw(problem: Problem, seconds: float, picture: Path) -> None:
    """Simulations at draws of the prior with the measurements, as a PNG file."""
    from ..plots.predictions import plot_bands
    from ..plots.without_time import plot_modes, plot_points
    from ..prediction.propagation import propagate
    from ..reporting.pictures import save_picture

    posterior = problem.posterior
    n = int(np.clip(PICTURE_SECONDS / max(seconds, 1e-6), FEWEST_DRAWS, MOST_DRAWS))
    structural = len(posterior.likelihood.model.parameter_names)
    draws = posterior.sample_prior(n, np.random.RandomState(1))[:, :structural]
    if posterior.likelihood.is_modal:
        save_picture(
            plot_modes(posterior.likelihood.predict_modes(draws), label=f"{n} draws of the prior, 90 %"), picture
        )
        return
    prediction = propagate(posterior.likelihood.model, draws, quantiles=(0.05, 0.95), progress=False)
    measured = posterior.likelihood.measurements
    figure = plot_bands(prediction, measured) if measured.is_history else plot_points(measured, prediction=prediction)
    figure.suptitle(f"{n} draws of the prior and the measurements")
    save_picture(figure, picture)
