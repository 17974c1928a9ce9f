"""What the command ``check`` does: read everything, simulate a few times, estimate the cost, draw the picture."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..reporting.fit_gate import compare, draws_to_compare, fit_gate
from ..signals.error_measures import rrmse
from ..units import from_si
from .events import read_events
from .job import read_job
from .models import Problem, make_problem, noise_channels_of
from .runs import default_folder
from .sampling import is_emcee, make_sampler

__all__ = ["check_job"]

PICTURE_SECONDS = 10.0
FEWEST_DRAWS, MOST_DRAWS = 5, 40


def check_job(file: Path, picture: Path, say: Callable[[str], None]) -> None:
    """Check a TOML file and its data, and say what a run will do.

    Parameters
    ----------
    file : Path
        The TOML file.
    picture : Path
        PNG file of the prior predictive picture.
    say : callable
        Called with every line.

    Raises
    ------
    ValueError
        If anything in the file is wrong, or the simulation at the mean of the prior fails.
    """
    if not picture.resolve().parent.is_dir():
        raise ValueError(f"cannot write {picture}: there is no folder {picture.parent}; give another file with --out")
    job = read_job(file)
    problem = make_problem(job)
    sampler = make_sampler(job, problem)
    events = read_events(job, problem)
    _say_data(problem, say)
    seconds = _say_simulation(problem, say)
    for event in events:
        steps = f"{event.record.n_steps} samples at {event.record.dt:g} s"
        compared = "without measurements" if event.measured is None else "compared with measurements"
        say(f"Event {event.name}: {event.record.name}, {steps}, {compared}")
    guided = job.sampler.get("guide", False)
    if is_emcee(job):
        simulations = sampler.nwalkers * (job.sampler["steps"] + 1)
        say(f"emcee makes {simulations} simulations: {sampler.nwalkers} walkers, {job.sampler['steps']} steps")
    else:
        _say_cost(problem, sampler, guided, job.budget, say)
    _draw(problem, seconds, picture)
    say(f"{picture}: the measurements should lie within the band of the simulations at draws of the prior")
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
    for channel, values in zip(measured.channels, measured.values, strict=True):
        shown = from_si(values[np.isfinite(values)], channel.unit)
        missing = f", {len(values) - len(shown)} missing" if len(shown) < len(values) else ""
        say(f"  {channel.name}: {len(shown)} samples{missing}, peak {np.abs(shown).max():.3g} {channel.unit}")
    say(f"Model: {type(model).__name__}, {len(model.parameter_names)} parameters; with the noise {posterior.ndim}:")
    width, channels = max(len(parameter.label) for parameter in posterior.parameters), noise_channels_of(likelihood)
    for parameter in posterior.parameters:
        prior = posterior.prior.distributions[parameter.name]
        mean, sd = (parameter.shown(value) for value in prior.moments)
        note = " (assumed: not in the file)" if parameter.name in problem.assumed else ""
        say(f"  {parameter.label:<{width}}  prior mean {mean:.3g}, standard deviation {sd:.3g}{note}")
        channel = channels.get(parameter.name)
        if channel is not None and prior.moments[0] > np.nanmax(np.abs(measured.channel(channel.name))):
            say(
                f"  CAUTION: this noise is expected to be larger than every measured value of {channel.name}. A number "
                f'without a unit is in SI units; give one, such as "half-normal(5 {channel.unit})"'
            )


def _say_simulation(problem: Problem, say: Callable[[str], None]) -> float:
    """Simulate at the mean of the prior; return the seconds of a second simulation, which compiles nothing."""
    posterior = problem.posterior
    likelihood, mean = posterior.likelihood, posterior.prior.mean()
    measured, n = likelihood.measurements, len(likelihood.model.parameter_names)
    point = mean if likelihood.ndim == len(mean) else mean[:n]
    if not np.isfinite(likelihood.log_likelihood(point)):
        raise ValueError(
            f"the simulation at the mean of the prior has failed: {likelihood.fault(point) or 'no finite likelihood'}; "
            "check [model] and [priors]"
        )
    response = measured.values - likelihood.residuals(mean)
    start = time.perf_counter()
    likelihood.model.simulate(1.0001 * mean[:n])
    seconds = time.perf_counter() - start
    errors = rrmse(response, measured.values)
    fit = ", ".join(f"{c.name} {100 * e:.0f} %" for c, e in zip(measured.channels, errors, strict=True))
    say(f"One simulation takes {seconds:.2g} s. At the mean of the prior the error of the response (RRMSE) is {fit}")
    draws = draws_to_compare(posterior, seconds)
    for finding in fit_gate(compare(likelihood, draws, False)):
        say(f"CAUTION: {finding}")
    return seconds


def _say_cost(problem: Problem, sampler: object, guided: bool, budget: dict, say: Callable[[str], None]) -> None:
    from samplers import estimate_cost

    estimate = estimate_cost(problem.posterior, sampler.nwalkers, type(sampler), seed=1)
    if guided:
        say(
            f"The run uses a guide: how many simulations it needs is not predicted; 500 take "
            f"{estimate.time_of(500)}, to which the guide adds its own computations, half a minute for 7 parameters"
        )
    else:
        say(f"Estimated cost until beta = 1:\n{estimate}")
    if "max_simulations" in budget:
        say(f"The run stops at {budget['max_simulations']} simulations (max_simulations)")
        if not guided and budget["max_simulations"] < estimate.evaluations.low:
            say(
                f"CAUTION: it needs about {estimate.evaluations.low:.3g} or more, and will probably end before "
                "beta = 1; a larger max_simulations continues it"
            )


def _draw(problem: Problem, seconds: float, picture: Path) -> None:
    """Simulations at draws of the prior with the measurements, as a PNG file."""
    from ..plots.predictions import plot_bands
    from ..prediction.propagation import propagate
    from ..reporting.pictures import save_picture

    posterior = problem.posterior
    n = int(np.clip(PICTURE_SECONDS / max(seconds, 1e-6), FEWEST_DRAWS, MOST_DRAWS))
    structural = len(posterior.likelihood.model.parameter_names)
    draws = posterior.sample_prior(n, np.random.RandomState(1))[:, :structural]
    prediction = propagate(posterior.likelihood.model, draws, quantiles=(0.05, 0.95), progress=False)
    figure = plot_bands(prediction, posterior.likelihood.measurements)
    figure.suptitle(f"{n} draws of the prior and the measurements")
    save_picture(figure, picture)
