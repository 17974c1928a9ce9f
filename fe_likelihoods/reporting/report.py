"""One self-contained page about a finished run: what was found, whether to trust it, and how to repeat it."""

import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.result import JudgedRun, judge_run
from ..checks.run import FinishedRun, read_run
from ..information.identifiability import of_samples
from ..prediction.prediction import Prediction
from ..signals.channels import Measurements
from ..simulation.model import SimulationFailed
from ..units import from_si
from .contents import (
    cost,
    data_sets,
    evidence,
    fingerprints,
    how_to_repeat,
    moments_of,
    parameter_table,
    residual_sentences,
    sampler_settings,
    summary_sentences,
    versions,
)
from .other_events import EventPredictions, OtherEvent, as_events, describe_event
from .pictures import (
    draw_event,
    draw_fit,
    draw_posterior,
    draw_residuals,
    draw_run,
    draw_scores_of_events,
)


def report(
    sampler: Any,
    posterior: Any = None,
    prediction: Prediction | Mapping[str, Prediction] | None = None,
    out: str | os.PathLike = "report.html",
    *,
    title: str = "",
    names: Sequence[str] | None = None,
    measured: Measurements | Mapping[str, Measurements] | None = None,
    events: Mapping[str, Prediction | EventPredictions | SimulationFailed] | None = None,
    discard: int = 0,
    repeat: str = "",
) -> Path:
    """Write a report of a finished run: one HTML file without scripts or links to other files.

    It contains a summary in words, every finding with what to do about it, the table of the parameters, the evidence
    with its check, figures, checks of the residuals, failures, cost, and what is needed to repeat the run. The response
    at two points (before and after the update) is needed for the figures. Where the likelihood has not cached it, it is
    simulated, and the report says how many simulations that took.

    Parameters
    ----------
    sampler : SMCSampler, TMCMCSampler or emcee.EnsembleSampler
        A sampler that has run.
    posterior : Posterior or callable, optional
        What was sampled. Default: the log-density of the sampler. A user-defined log-density has no units, no data and
        no fit; the report then leaves these sections out, and says so.
    prediction : Prediction, or mapping of str to Prediction, optional
        Results of `fe_likelihoods.propagate`, by title.
    out : path
        The file to write. Its folder is made where it does not exist.
    title : str
        Title of the page. Default: the name of the model.
    names : sequence of str, optional
        Names of the parameters, for a log-density that has none.
    measured : Measurements, or mapping of str to Measurements, optional
        Measurements to draw with the predictions, by the title of the prediction or the name of the event.
    events : mapping of str to Prediction, to mapping of str to Prediction, or to SimulationFailed, optional
        Predictions of events other than the calibration event, by the name of the event: results of
        `fe_likelihoods.propagate` with ``record=`` or of `fe_likelihoods.predict_new_event`, of one quantity or of
        several by name, such as ``{"histories": None, "peaks": [peak("top")]}``. All predictions are scored where
        `measured` has them. The error `SimulationFailed` of an event that could not be predicted names it there.
    discard : int
        Number of iterations to leave out at the beginning of the chain (burn-in).
    repeat : str
        Commands that make the run again, for the last section. Default: lines of Python from what the sampler knows.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ValueError
        If the sampler has no chain, or names, the posterior or the prediction do not fit; nothing is
        simulated or written then.

    Examples
    --------
    >>> path = report(sampler, posterior, prediction, out="report.html")
    >>> path.name
    'report.html'
    """
    run = read_run(sampler, posterior, names=names, discard=discard)
    return write_page(Path(out), run, prediction, title=title, measured=measured, events=events, repeat=repeat)


def write_page(
    path: Path,
    run: FinishedRun,
    prediction: Prediction | Mapping[str, Prediction] | None = None,
    judged: JudgedRun | None = None,
    *,
    title: str = "",
    measured: Measurements | Mapping[str, Measurements] | None = None,
    events: Mapping[str, Prediction | EventPredictions | SimulationFailed] | None = None,
    repeat: str = "",
) -> Path:
    """Write the report of a run that was read, and perhaps `judged`; other parameters as for `report`."""
    given = {} if prediction is None else prediction if isinstance(prediction, Mapping) else {"Prediction": prediction}
    if not isinstance(measured, Mapping | None) and not given and events:
        raise ValueError("measured must be a mapping of the names of events to their measurements")
    known = measured if isinstance(measured, Mapping) else {} if measured is None else dict.fromkeys(given, measured)
    predictions = as_events(given) | as_events({} if events is None else events)
    if unknown := [name for name in known if name not in predictions]:
        raise ValueError(
            f"measured has {', '.join(unknown)}, but the predictions are {', '.join(predictions) or 'none'}, and no "
            "event has this name"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    described = [describe_event(name, each, known.get(name)) for name, each in predictions.items()]
    page = render(gather(run, described, title, repeat, judged))
    path.write_text(page, encoding="utf-8")
    return path


def gather(
    run: FinishedRun,
    events: Sequence[OtherEvent] = (),
    title: str = "",
    repeat: str = "",
    judged: JudgedRun | None = None,
) -> dict[str, Any]:
    """What the template shows, by name; a run that was not judged is judged, which may simulate."""
    fits, failed, judgement = judge_run(run) if judged is None else judged
    rows = list(parameter_table(run).itertuples())
    sets, after = data_sets(run), "posterior mean" if run.n_modes == 1 else "sample of highest posterior density"
    before, after = "before: mean of the prior", f"after: {after}"
    models = " and ".join(dict.fromkeys(each.model for each in sets)) or "a log-density"
    return {
        "title": title or f"Bayesian updating of {models}",
        "date": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "status": judgement.status,
        "summary": summary_sentences(run, rows, fits, judgement),
        "findings": judgement.findings,
        "data": sets,
        "rows": rows,
        "factor": judgement.width_factor,
        "signed": not np.array_equal(moments_of(run)[0], run.samples.mean(axis=0)),
        "has_nominal": any(np.isfinite(row.nominal) for row in rows),
        "evidence": evidence(run),
        "fits": fits,
        "before": before,
        "after": after,
        "told": _told(run),
        "posterior_pictures": draw_posterior(run),
        "fit_pictures": [(fit.title, [*draw_fit(fit, before, after), *draw_residuals(fit)]) for fit in fits],
        "run_pictures": draw_run(run),
        "events": list(events),
        "event_pictures": [draw_event(each) for each in events],
        "score_pictures": draw_scores_of_events(events),
        "residuals": [] if run.is_inconclusive else residual_sentences(fits),
        "verdict": "" if run.verdict is None else f"Verdict of the sampler: {run.verdict}",
        "inconclusive": run.is_inconclusive,
        "failures": failed,
        "cost": cost(run),
        "settings": sampler_settings(run),
        "versions": versions(),
        "fingerprints": fingerprints(run),
        "tests": judgement.tests,
        "repeat": repeat or how_to_repeat(run),
    }


def _told(run: FinishedRun) -> list[str]:
    """Which parameters the data determine, in sentences; none where that is not known."""
    if run.prior is None or run.is_inconclusive:
        return []
    try:
        return list(of_samples(run.posterior, run.samples).sentences)
    except ValueError:  # few samples, or a prior without standard normal coordinates
        return []


def render(contents: Mapping[str, Any]) -> str:
    """The page as text. All texts are escaped."""
    from jinja2 import Environment, StrictUndefined

    template = resources.files(__package__).joinpath("templates/report.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "shown": _shown,
        "number": _number,
        "like": _like,
        "error": lambda x: _number(x, 2),
        "percent": _percent,
    }
    return environment.from_string(template).render(contents)


def _number(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}g}".replace("-", "−") if np.isfinite(value) else "–"


def _like(value: float, sd: float) -> str:
    """A number with two digits of its standard deviation, and with four digits or more."""
    if not (np.isfinite(value) and value and sd > 1e-12 * abs(value)):
        return _number(value)
    digits = int(np.floor(np.log10(abs(value))) - np.floor(np.log10(sd))) + 2
    return f"{value:#.{max(digits, 4)}g}".rstrip(".").replace("-", "−")


def _shown(value: float, unit: str) -> str:
    """A value in SI units as a number in a display unit."""
    return _number(from_si(value, unit).item(), 3)


def _percent(value: float) -> str:
    return f"{100.0 * value:.3g} %" if np.isfinite(value) else "–"
