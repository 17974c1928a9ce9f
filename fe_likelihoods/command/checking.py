"""What the command ``check`` does: read everything, simulate a few times, draw the picture."""

import shlex
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

from ..checks.faults import FAULTS
from ..checks.finding import labelled
from ..checks.result import ModelCheck, check_model
from ..likelihood.fits import data_sets_of, draws_to_compare
from ..signals.channels import relative_errors
from ..text_tables import number, text_table
from .describe_files import describe
from .job import Job, read_job
from .make_posterior import Problem, make_problem
from .runs import default_folder, make_sampler


def check_job(file: Path, picture: Path, say: Callable[[str], None]) -> None:
    """Check a TOML file and its data, `say` line by line what a run will do, and draw the prior predictive picture.

    ValueError if anything in the file is wrong, or the simulation at the mean of the prior fails.
    """
    job = read_job(file)
    problem = make_problem(job)
    job.located("sampler", make_sampler, job, problem)
    _say_data(problem, say)
    checked = check_model(problem.posterior)
    _say_simulation(problem, checked, say)
    if zero := _zero_of(job, problem, checked):
        say(zero)
    if (most := job.budget.max_simulations) is not None:
        say(f"The run stops at {most} simulations (max_simulations)")
    names = ", ".join(map(str, _draw(problem, checked, picture)))
    say(f"{names}: the measurements should lie within the band of the simulations at draws of the prior")
    say(f"Next: fe-likelihoods run {shlex.quote(str(file))} (writes to {default_folder(file)}/)")


def _say_data(problem: Problem, say: Callable[[str], None]) -> None:
    posterior, record, levels = problem.posterior, problem.record, dict[str, float]()
    if record is not None:
        say(f"Record: {record}" + (f"\n  from {record.source}" if record.source else ""))
    for data_set, _ in posterior.likelihood.data_sets():
        say(
            "Measurements:\n"
            + (str(data_set.model.data) if data_set.is_modal else "\n".join(describe(data_set.measurements)))
        )
        rms = () if data_set.is_modal else data_set.measurements.root_mean_squares
        levels |= {
            f"sigma_{each.name}": level for each, level in zip(data_set.measurements.channels, rms, strict=False)
        }
    rows = [("parameter", "prior mean", "standard deviation", "measured RMS", "")]
    for parameter in posterior.parameters:
        mean, sd = (parameter.shown(value) for value in posterior.prior.distributions[parameter.name].moments)
        note = "assumed: not in the file" if parameter.name in problem.assumed else ""
        level = number(parameter.shown(levels[parameter.name])) if parameter.name in levels else ""
        rows.append((parameter.label, f"{mean:.3g}", f"{sd:.3g}", level, note))
    say(text_table(rows))


def _say_simulation(problem: Problem, checked: ModelCheck, say: Callable[[str], None]) -> None:
    report, mean = problem.posterior.report(), problem.posterior.prior.mean()[None]
    say(f"One simulation takes {report['seconds'] / report['simulations']:.2g} s")
    for data_set, columns in problem.posterior.likelihood.data_sets():
        theta, measured = mean[:, columns[: len(data_set.model.parameter_names)]], data_set.measurements
        if data_set.is_modal:
            say(f"At the mean of the prior:\n{data_set.predict_modes(theta)}")
            continue
        errors = relative_errors(data_set.residuals_of(data_set.simulate(theta).response[0]), measured.values)
        fit = ", ".join(f"{c.name} {100 * e:.0f} %" for c, e in zip(measured.channels, errors, strict=True))
        say(f"At the mean of the prior the error of the response (RRMSE) is {fit}")
    for line in labelled(checked.findings):
        say(line)


def _zero_of(job: Job, problem: Problem, checked: ModelCheck) -> str:
    """The line of ``[measurements]`` that moves all channels by the time by which all are late, else empty."""
    found = [each for each in checked.findings if each.kind == FAULTS["lag"][0]]
    late, said = [each.numbers["lag"] for each in found], " ".join(each.text for each in found)
    sets = [data_set.measurements for data_set, _ in problem.posterior.likelihood.data_sets()]
    alike = late and max(late) - min(late) <= min(min(data_set.steps) for data_set in sets)
    if not alike or any(channel.name not in said for data_set in sets for channel in data_set.channels):
        return ""
    zero, shift = job.measurements.zero or 0.0, sum(late) / len(late)
    if not isinstance(zero, str):
        return f"In [measurements], if the clocks differ: zero = {round(zero + shift, 6)!r}"
    day = "" if "-" in zero else "2000-01-01 "
    with suppress(ValueError):  # another way to write a date
        moved = datetime.fromisoformat(day + zero) + timedelta(seconds=shift)
        return f'In [measurements], if the clocks differ: zero = "{moved.isoformat(" ")[len(day) :]}"'
    return ""


def _draw(problem: Problem, checked: ModelCheck, picture: Path) -> list[Path]:
    """The draws of the prior that a check has simulated, with the measurements, as a PNG file for each data set."""
    from ..plots.histories import plot_bands  # slow to import
    from ..plots.modes_and_load_tests import plot_modes, plot_points
    from ..prediction.propagation import propagate
    from ..reporting.report import save_picture

    posterior, files, modes = problem.posterior, [], {fit.title: fit.modal for fit in checked.fits}
    points = draws_to_compare(posterior)[: max(len(fit.draws) for fit in checked.fits)]  # as many as were simulated
    for key, data_set, columns in data_sets_of(posterior):
        measured = data_set.measurements
        if data_set.is_modal:
            drawn = modes[key].draws
            if drawn is None:  # the log says why
                continue
            figure = plot_modes(drawn, label=f"{len(drawn.frequencies)} draws of the prior, 90 %")
        else:
            draws = points[:, columns[: len(data_set.model.parameter_names)]]
            drawn = propagate(data_set.model, draws, quantiles=(0.05, 0.95), cache=data_set.simulator, progress=False)
            figure = plot_bands(drawn, measured) if measured.is_history else plot_points(measured, prediction=drawn)
            figure.suptitle(f"{drawn.n_samples} draws of the prior and the measurements")
        files.append(picture.with_name(f"{picture.stem}-{key}{picture.suffix}") if key else picture)
        save_picture(figure, files[-1])
    return files
