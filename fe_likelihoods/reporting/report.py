"""One self-contained page about a finished run: what was found, whether to trust it, and how to repeat it.

Figures are drawn by the libraries' own functions and embedded as PNG, each with a caption that says what to look for.
"""

import base64
import io
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from samplers import plot_corner, plot_marginals, plot_run

from ..checks.result import FinishedRun, JudgedRun, judge_run, read_run
from ..information.identifiability import of_samples
from ..likelihood.fits import Fit
from ..plots.histories import plot_fit
from ..plots.modes_and_load_tests import plot_modes, plot_points
from ..prediction.prediction import Prediction
from ..signals.channels import Measurements
from ..simulation.model import SimulationFailed
from ..units import from_si
from .contents import (
    EventPredictions,
    OtherEvent,
    as_events,
    cost,
    data_sets,
    describe_event,
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SMOOTH = 4000  # draws with smooth contours of 50 and 90 %
LEGIBLE = 80  # pixels per inch at which the smallest labels can be read
WIDEST = 1100  # pixels: fits on a page of 1200
RESOLUTION = 110  # dots per inch: sharp at the width of a page, some tens of kB


class Picture(NamedTuple):
    """A figure of a report."""

    title: str
    caption: str  # what to look for
    alt: str  # description for readers who do not see it
    source: str  # the PNG as a data URI; empty if it could not be drawn
    problem: str  # why it could not be drawn; empty otherwise
    width: int = 0  # smallest one to read the labels [pixel]; a narrower page scrolls


def save_picture(figure: "Figure", file: Path | io.BytesIO, dpi: int = 150) -> None:
    """Write a figure as a PNG and close it: matplotlib keeps figures of pyplot in memory until then.

    The layout is made here, because `savefig` draws all of a figure for its layout, and then again.
    """
    import matplotlib.pyplot as plt

    figure.dpi = dpi
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine(None)
    quick = {"compress_level": 3}  # 2 % of a report's time for files that are 4 % larger
    figure.savefig(file, format="png", dpi=dpi, facecolor="white", pil_kwargs=quick)
    plt.close(figure)


def _picture(title: str, caption: str, alt: str, draw: Callable[[], "Figure"]) -> Picture:
    """Draw a figure and embed it; a ValueError of the drawing function becomes a sentence of the report."""
    try:
        figure = draw()
    except ValueError as error:
        return Picture(title, caption, alt, "", f"This figure could not be drawn: {error}")
    file = io.BytesIO()
    save_picture(figure, file, RESOLUTION)
    width = min(round(LEGIBLE * figure.get_figwidth()), WIDEST)
    source = f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"
    return Picture(title, caption, alt, source, "", width)


def drawn_samples(run: FinishedRun) -> tuple[np.ndarray, str]:
    """Samples (n, ndim) for figures: many of the emulated posterior of a usable guided run; and what they are."""
    signed = getattr(run.sampler, "signed_sample", None)
    if signed is None or run.is_inconclusive:
        distinct = len(np.unique(run.samples, axis=0))
        return run.samples, f"Drawn are {len(run.samples)} samples of the chain, {distinct} of them distinct."
    draws = signed.draw(SMOOTH)
    return draws, f"Drawn are {len(draws)} draws of the emulated posterior; the table is corrected by simulated draws."


def draw_posterior(run: FinishedRun) -> list[Picture]:
    """Prior and posterior of each parameter, and samples of all pairs."""
    described = run.posterior if hasattr(run.posterior, "parameters") else SimpleNamespace(parameter_names=run.names)
    samples, drawn = drawn_samples(run)
    return [
        _picture(
            "What the data have changed",
            "Where the posterior is as wide as the prior, the data say nothing about the parameter. Where it leans "
            "against the end of the prior, the prior decides.",
            f"Prior and posterior density of {', '.join(run.names)}.",
            lambda: plot_marginals(samples, posterior=described),
        ),
        _picture(
            "Pairs of parameters",
            "A narrow, inclined cloud: the data determine a combination of two parameters better than each of them. "
            "Separate clouds: separate explanations of the data. Values outside of a panel are written above it. "
            + drawn,
            f"Posterior samples of each parameter and each pair of {', '.join(run.names)}.",
            lambda: plot_corner(samples, posterior=described),
        ),
    ]


def draw_fit(fit: Fit, before: str, after: str) -> list[Picture]:
    """Measured and computed histories, points or modes, before and after the update, which have these names."""
    if fit.modal is not None:
        return _draw_modes(fit)
    responses = {name: each for name, each in ((before, fit.before), (after, fit.after)) if each is not None}
    if not responses:
        return []
    if not fit.measurements.is_history:
        return [
            _picture(
                "Measured and computed values",
                "After the update, about two of three measured values should be within their standard deviations of "
                "the computed ones.",
                f"Values of {', '.join(channel.name for channel in fit.measurements.channels)}.",
                lambda: plot_points(fit.measurements, responses, fit.deviations),
            )
        ]
    return [
        _picture(
            "Measured and simulated response",
            "After the update, the two lines should lie on one another at the strong peaks.",
            f"Histories of {', '.join(channel.name for channel in fit.measurements.channels)}, "
            f"{' and '.join(responses)}.",
            lambda: plot_fit(fit.measurements, responses),
        )
    ]


def _draw_modes(fit: Fit) -> list[Picture]:
    """Measured and computed modes."""
    pictures = []
    if fit.modal.samples is not None:
        caption = (
            "Intervals of frequencies contain the errors of an identification, known and unknown ones, so they should "
            "hold nine of ten measured values; intervals of shapes contain the uncertainty of parameters alone. MAC is "
            "1 for equal shapes and 0 for orthogonal ones. Scale and sign of a shape are arbitrary."
        )
        alt = "Frequencies over measured frequencies, and shapes of the measured modes."
        pictures.append(
            _picture(
                "Measured and computed modes", caption, alt, lambda: plot_modes(fit.modal.samples, fit.modal.draws)
            )
        )
    if fit.modal.held_out is not None:
        caption = "These modes were measured, but not compared: they test the prediction. Intervals are as above."
        alt = "Predicted and measured frequencies and shapes of the modes that were held out."
        pictures.append(_picture("Modes that were held out", caption, alt, lambda: plot_modes(fit.modal.held_out)))
    return pictures


def draw_residuals(fit: Fit) -> list[Picture]:
    """Residuals against time, their autocorrelation and quantiles."""
    from ..plots.histories import plot_residuals

    if fit.residuals is None or not fit.measurements.simultaneous or not fit.measurements.is_history:
        return []
    return [
        _picture(
            "Residuals",
            "Left: measured minus simulated; a pattern is something that the model lacks. Middle: outside of the "
            "grey band, residuals depend on earlier ones. Right: points off the line are not normal.",
            f"Residuals of {', '.join(channel.name for channel in fit.measurements.channels)}.",
            lambda: plot_residuals(fit.residuals, fit.measurements.channels, fit.measurements.dt),
        )
    ]


def draw_run(run: FinishedRun) -> list[Picture]:
    """What the sampler did, with its tempering stages."""
    if not run.tempered:
        return []
    if len(run.sampler.ladder) == 1:  # of a guide
        caption = "The effective sample size of the draws should reach the number of walkers, the log-evidence settle."
        return [_picture("What the sampler did", caption, "Rounds of the guide.", lambda: plot_run(run.sampler))]
    return [
        _picture(
            "What the sampler did",
            "From the prior (beta near 0) to the posterior (beta = 1). An effective sample size far below the number "
            "of walkers, or an acceptance near zero, shows a stage that was too hard. The log-evidence should settle "
            "within its error. The log-probability of the walkers at the end should be level: a trend means that the "
            "run has not converged.",
            "Evaluations of each phase, exponent beta, acceptance, effective sample size and log-evidence of each "
            "tempering stage, and log-probability of the walkers.",
            lambda: plot_run(run.sampler),
        )
    ]


def draw_event(event: OtherEvent) -> list[Picture]:
    """Predicted histories of another event with their band and its measurements."""
    from ..plots.histories import plot_bands

    pictures = []
    for each in event.predictions.values():
        if each.dt is None:
            continue
        names, data = [channel.name for channel in each.channels], each.data
        if data is not None and not data.is_history:
            caption = "The error bars hold the predicted values with the stated probability, of the parameters alone."
            alt = f"Predicted values of {', '.join(names)}: {event.name}."
            draw = lambda data=data, each=each: plot_points(data, prediction=each)  # noqa: E731
            pictures.append(_picture(event.name, caption, alt, draw))
            continue
        measured = event.measured
        if measured is not None and not {channel.name for channel in measured.channels} & set(names):
            measured = None
        pictures.append(
            _picture(
                event.name,
                "Mean and band of the prediction, and the measurements where there are any. The band contains the "
                "uncertainty of the parameters, and the noise only if the legend says so.",
                f"Predicted histories of {', '.join(names)}: {event.name}.",
                lambda each=each, measured=measured: plot_bands(each, measured),
            )
        )
    return pictures


def draw_scores_of_events(events: Sequence[OtherEvent]) -> list[Picture]:
    """Calibration and intervals of the predicted numbers of all events with measurements."""
    from ..plots.scores import plot_scores

    numbers = {event.name: event.values[0] for event in events if event.values and event.values[0].measured.all()}
    if not numbers:
        return []
    return [
        _picture(
            "Predicted and measured numbers of all events",
            "Left: bars outside of the grey band show predictions that are too narrow (high at both ends), too wide "
            "(high in the middle) or biased (high at one end). Middle: intervals divided by the measured value; those "
            "that cross the line contain it. Right: shares of measured values in the intervals, which should be in the "
            "grey bars.",
            f"Predicted intervals by measured values of {', '.join(numbers)}.",
            lambda: plot_scores(numbers),
        )
    ]


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
    is_mean = not fits or np.array_equal(run.centre, run.samples.mean(axis=0))
    sets, after = data_sets(run), "posterior mean" if is_mean else "sample of highest posterior density"
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
