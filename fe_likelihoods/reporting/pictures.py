"""The figures of a report: drawn by the libraries' own functions, embedded as PNG, each with a caption to look by."""

import base64
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from samplers import plot_corner, plot_marginals, plot_run

from ..checks.run import FinishedRun
from ..likelihood.fits import Fit
from ..plots.fits import plot_fit
from ..plots.modes_and_load_tests import plot_modes, plot_points
from .other_events import OtherEvent

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
            "Separate clouds: separate explanations of the data. Values outside of a panel are written at its edge. "
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
            "hold nine of ten measured values; those of shapes contain the uncertainty of the parameters alone. MAC is "
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
    from ..plots.predictions import plot_bands

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
