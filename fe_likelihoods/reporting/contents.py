"""The contents of a report in words and numbers, section by section, before they are put on a page.

After the sections on the run: where a result comes from (settings, versions, digests of model, data and posterior, how
to repeat), and predictions of events other than the calibration event, with their scores.
"""

import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..checks.finding import Finding, Judgement, percent
from ..checks.model import describe_residuals
from ..checks.result import FinishedRun
from ..likelihood.fits import Fit
from ..likelihood.likelihood import FELikelihood
from ..noise.protocol import noise_title
from ..prediction.prediction import Prediction
from ..prediction.scores import HistoryScores, QuantityScores, central_interval, share_within
from ..signals.channels import Measurements
from ..simulation.model import SimulationFailed
from ..units import from_si

if TYPE_CHECKING:
    import pandas


class DataSet(NamedTuple):
    """One data set: what was measured, and what it was compared with."""

    name: str  # in a joint likelihood
    model: str  # its class
    excitation: str
    description: str
    noise: str
    channels: str  # names, units, numbers of samples and steps


def data_sets(run: FinishedRun) -> list[DataSet]:
    """The data sets of a likelihood; empty for another posterior."""
    return [] if run.likelihood is None else [_data_set(*each) for each in run.likelihood.likelihoods.items()]


def _data_set(key: str, likelihood: FELikelihood) -> DataSet:
    model, measurements = likelihood.model, likelihood.measurements
    excitations = (getattr(model, name, None) for name in ("record", "loading"))
    excitation = next((_named(each) for each in excitations if isinstance(getattr(each, "name", None), str)), "")
    samples = np.isfinite(measurements.values).sum(axis=1)
    along = "" if measurements.is_history else f" ({measurements.axis})"
    channels = [
        f"{channel.name} [{channel.unit}], {count} {f'values{along}' if along else f'samples at {step:g} s'}"
        for channel, count, step in zip(measurements.channels, samples, measurements.steps, strict=True)
    ]
    if likelihood.is_modal:
        data = model.data
        times = f", identified {data.n_sets} times" if data.n_sets > 1 else ""
        channels = [f"{data.n_modes} modes at {data.n_sensors} sensors{times}"]
        model = getattr(model.model, "structure", model.model)
    noise = noise_title(likelihood.noise)
    return DataSet(key, type(model).__name__, excitation, measurements.description, noise, "; ".join(channels))


def _named(excitation: Any) -> str:
    """Name of an excitation, with its origin and how it was processed, if it states them."""
    source = getattr(excitation, "source", "")
    return f"{excitation.name} ({source})" if source else excitation.name


def moments_of(run: FinishedRun) -> np.ndarray:
    """Mean, its error, standard deviation, its error, and 5 %, 50 % and 95 % quantiles (7, ndim).

    They belong to the chain, or to the signed sample if that has smaller errors and determines all deviations.
    """
    probabilities = (0.05, 0.5, 0.95)
    if (signed := getattr(run.sampler, "signed_sample", None)) is not None:
        mean, sd = signed.expectation(), signed.standard_deviation()
        if np.all(mean.error < run.mean_error) and np.all(sd.value > 0.0):
            order = np.argsort(signed.coords, axis=0)
            below = np.maximum.accumulate(np.cumsum(signed.weights[order], axis=0))  # falls by negative weights
            columns = zip(np.take_along_axis(signed.coords, order, axis=0).T, below.T, strict=True)
            quantiles = [values[np.searchsorted(share[:-1], probabilities)] for values, share in columns]
            return np.stack([*mean, *sd, *np.transpose(quantiles)])
    quantiles = np.quantile(run.samples, probabilities, axis=0)
    return np.stack([run.samples.mean(axis=0), run.mean_error, run.samples.std(axis=0), run.sd_error, *quantiles])


def parameter_table(run: FinishedRun) -> "pandas.DataFrame":
    """A row for each parameter in the unit of its label; texts are empty and numbers NaN where they are not known."""
    import pandas as pd  # slow to import

    rows, nan = [], np.nan
    numbers = ("mean", "mean_error", "sd", "sd_error", "q05", "median", "q95", "nominal")
    priors = [("", nan, nan, -np.inf, np.inf)] * len(run.parameters)
    priors = priors if run.prior is None else [each[1:] for each in run.prior.table()[1]]
    for parameter, (family, *of_prior), found in zip(run.parameters, priors, moments_of(run).T, strict=True):
        mean, prior_sd, lower, upper = (float(each) for each in parameter.shown(of_prior))
        family, bounds = family.split("(")[0], (("above", lower), ("below", upper))
        text = f"{family}, mean {mean:.4g}, sd {prior_sd:.3g}" * bool(family)
        text += "".join(f", {side} {bound:.4g}" for side, bound in bounds if np.isfinite(bound))
        text = f"{family}, {lower:.4g} to {upper:.4g}" if family == "Uniform" else text
        unit = parameter.label.removeprefix(parameter.name).strip()
        shown = parameter.shown([*found, parameter.nominal])
        rows.append((parameter.label, parameter.name, unit, text, prior_sd, *map(float, shown)))
    table = pd.DataFrame(rows, columns=["parameter", "name", "unit", "prior", "prior_sd", *numbers])
    return table.assign(cv=table["sd"] / table["mean"].abs().where(table["mean"] != 0.0))


def summary_sentences(
    run: FinishedRun, rows: Sequence[Any], fits: Sequence[Fit], judgement: Judgement | None = None
) -> list[str]:
    """Whether to use the result, what was updated with which data, what was found, and from how many samples."""
    sets = data_sets(run)
    if sets:
        models = " and ".join(sorted({each.model for each in sets}))
        n_channels = sum(len(likelihood.measurements.channels) for likelihood, _ in run.likelihood.data_sets())
        modal = any(likelihood.is_modal for likelihood, _ in run.likelihood.data_sets())
        what = "modes" if modal and len(sets) == 1 else "modes and channels" if modal else "channels"
        channels = f"{n_channels} measured {what if n_channels > 1 else what[:-1]}"
        what = f"{len(rows)} parameters of {models} and its noise were updated with {channels}"
        what += f" of {len(sets)} data sets" if len(sets) > 1 else ""
        what += " (synthetic data)." if any("synthetic" in each.description.lower() for each in sets) else "."
    else:
        what = f"{len(rows)} parameters were sampled from a log-density of the user's own."
    first = [] if judgement is None else [str(judgement)]
    fast = set(getattr(run.posterior, "fast_parameters", ()))
    if run.is_inconclusive:
        nothing = "Nothing can be said about the parameters yet: the table shows what the run has so far."
        return [*first, what, nothing, *_worth(run)]
    return [*first, what, _finding([row for i, row in enumerate(rows) if i not in fast], fits), *_worth(run)]


def _finding(rows: Sequence[Any], fits: Sequence[Fit]) -> str:
    known = [(row.sd / row.prior_sd, row.name) for row in rows if row.prior_sd > 0.0]
    found = ""
    if known:
        ratio, best = min(known)
        found = f"The data inform {best} most: its standard deviation is {100.0 * ratio:.2g} % of its prior value"
    errors = [(each.before, each.after) for fit in fits for each in fit.channels]
    ends = [[f"{each:.3f}" for each in pair] for pair in map(_assurance, fits) if np.isfinite(pair).all()]
    assured = [" to ".join(dict.fromkeys(each)) for each in ends]
    if assured:
        fit = f"the MAC of the measured modes is {' and '.join(assured)}"
        found = f"{found}; {fit}" if found else f"T{fit[1:]}"
    if errors and np.isfinite(errors).all():
        before, after = 100.0 * np.mean(errors, axis=0)
        fit = f"the mean relative error of the response went from {before:.3g} % to {after:.3g} %"
        found = f"{found}; {fit}" if found else f"{fit[0].upper()}{fit[1:]}"
    return f"{found}." if found else "Means and intervals of the parameters are in the table below."


def _assurance(fit: Fit) -> tuple[float, float]:
    """The least and largest median MAC of the modes; NaN without modes."""
    if fit.modal is None or fit.modal.samples is None or np.isnan(fit.modal.samples.assurance).all():
        return np.nan, np.nan
    middle = np.median(fit.modal.samples.assurance, axis=0)
    return float(np.nanmin(middle)), float(np.nanmax(middle))


def _worth(run: FinishedRun) -> list[str]:
    """The effective sample size of a Markov chain; other runs have it in their verdict."""
    if run.tempered:
        return []
    if not np.isfinite(run.effective_sample_size):
        return ["The chain is too short to have an effective sample size."]
    text = f"Effective sample size {run.effective_sample_size:.0f} (of {len(run.samples)} samples of a Markov chain)"
    return [f"{text}; a Markov chain gives no verdict of its own, and no evidence."]


def evidence(run: FinishedRun) -> list[str]:
    """The evidence with its check, in sentences; the findings judge them."""
    if not run.tempered:
        return ["This sampler gives no evidence; SMCSampler and TMCMCSampler do."]
    sampler, check = run.sampler, run.sampler.log_evidence_check
    lines = [
        f"Log-evidence {sampler.log_evidence:.2f} ± {sampler.log_evidence_error:.2g}. Only differences between models "
        "for the same data mean something: a difference of 3 is odds of 20 to 1."
    ]
    if check is not None:
        own, error = sampler.log_evidence_ladder, sampler.ladder[-1].log_evidence_error
        text = (
            f"Check: the tempering stages (or all weighted draws) give {own:.2f} ± {error:.2g}, {check.evaluations} "
            f"independent draws give {check.log_evidence:.2f} ± {check.error:.2g} (effective sample size "
            f"{check.effective_sample_size:.2g}, Pareto shape of the weights {check.pareto_shape:.2f})."
        )
        return [*lines, text if check.reliable else f"{text} Its weights are too uneven to confirm anything."]
    if sampler.rounds:
        *_, mean, error, _ = sampler.rounds[-1]
        draws = sum(each.draws for each in sampler.rounds)
        text = f"The mean weight of {draws} draws of a guide is {mean:.2f} ± {error:.2g}"
        corrected = ", and corrects the evidence of the emulated posterior" if sampler.signed_sample is not None else ""
        return [*lines, f"{text}{corrected}."]
    return [*lines, "It was not checked by independent draws."]


def residual_sentences(fits: Sequence[Fit]) -> list[str]:
    """The checks of the residuals, one sentence per channel and event; values without an order in time have none."""
    histories = [fit for fit in fits if fit.residuals is not None and fit.measurements.is_history]
    channels = [(fit, each) for fit in histories for each in fit.channels]
    return [f"{fit.where(each.channel.name)}: {describe_residuals(each.checks)[0]}" for fit, each in channels]


def cost(run: FinishedRun) -> list[tuple[str, str]]:
    """Numbers of simulations, cache hits and wall times."""
    rows, of_posterior = [], _report_of(run)
    if run.tempered:
        sampler = run.sampler
        rows.append(("simulations of the run", f"{sampler.simulations:.0f}"))
        if sampler.simulations_of_guides > 0.0:
            rows += [
                ("of these, for the search of the guide", f"{sampler.simulations_of_guides:.0f}{_of_parts(run)}"),
                ("of these, draws and moves", f"{sampler.simulations - sampler.simulations_of_guides:.0f}"),
            ]
        rows += [
            ("evaluations of the log-density, also of known responses", f"{sampler.evaluations}"),
            ("wall time of the annealing", _duration(sum(stage.seconds for stage in sampler.ladder))),
        ]
    if of_posterior:
        rows += [
            ("simulations in this process, without predictions", f"{of_posterior['simulations']}"),
            ("wall time of these simulations", _duration(of_posterior["seconds"])),
            ("answers from the cache", f"{of_posterior['cache_hits']}, {of_posterior['disk_hits']} of them from disk"),
        ]
    return rows


def _of_parts(run: FinishedRun) -> str:
    """How many simulations of this process were short parts of the record, which count as fractions."""
    likelihoods = [] if run.likelihood is None else [likelihood for likelihood, _ in run.likelihood.data_sets()]
    parts = sum(part.simulations for likelihood in likelihoods for part in likelihood.shortened)
    return f"; {parts} simulations of short parts of the record count as fractions" if parts else ""


def _report_of(run: FinishedRun) -> dict[str, Any]:
    return run.likelihood.report() if run.likelihood is not None else {}


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    return f"{seconds / 60.0:.1f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def names_of_values(prediction: Prediction) -> list[str]:
    """Names of the numbers in a prediction that is no history, such as "peak of top", or "quantity 1"."""
    n = prediction.mean.size
    named = len(prediction.channels) == n  # quantities of channels, such as peak("top")
    given = prediction.quantity if isinstance(prediction.quantity, list | tuple) else [prediction.quantity]
    if named and len(given) == n:
        return [str(each) for each in given]
    return [f"quantity {i + 1}" for i in range(n)]


# where it comes from -----------------------------------------------------------------------------------------------

_PACKAGES = ("fe-likelihoods", "numpy", "scipy", "numba", "emcee", "h5py", "corner", "arviz", "matplotlib")


def versions() -> list[tuple[str, str]]:
    """Names and versions of Python, the operating system and the packages that a result depends on."""
    found = [("Python", platform.python_version()), ("system", f"{platform.system()} {platform.machine()}")]
    for package in (*_PACKAGES, *(["openseespy"] if "openseespy" in sys.modules else [])):
        try:
            found.append((package, version(package)))
        except PackageNotFoundError:  # for instance a source folder that is not installed
            found.append((package, "not installed as a package"))
    return found


def fingerprints(run: FinishedRun) -> list[tuple[str, str]]:
    """Digests (hexadecimal) of models, data and posterior; equal digests stand for equal inputs."""
    found = []
    for name in ("fingerprint", "data_fingerprint"):
        try:
            digest = getattr(run.posterior, name, None)
        except ValueError as error:  # a prior or noise of the user's own that does not show its values
            digest = f"none: {error}"
        if digest:
            found.append(("posterior" if name == "fingerprint" else "data", str(digest)))
    for key, each in {} if run.likelihood is None else run.likelihood.likelihoods.items():
        found.append((f"model of {key}" if key else "model", each.model.fingerprint))
    return found


def sampler_settings(run: FinishedRun) -> list[tuple[str, str]]:
    """Size and settings of the sampler, in words."""
    sampler = run.sampler
    rows = [("sampler", type(sampler).__name__), ("walkers", str(sampler.nwalkers))]
    rows.append(("stored iterations", str(sampler.iteration)))
    if run.discard:
        rows.append(("iterations left out as burn-in", str(run.discard)))
    rows.append(("samples in this report", str(len(run.samples))))
    if not hasattr(sampler, "settings"):
        return rows
    seed = sampler.seed
    rows.append(("seed", "not given to this sampler" if seed is None else str(seed)))
    rows.append(("guide", "none" if sampler.guide is None and not sampler.rounds else "yes"))
    limit = sampler.max_simulations
    rows.append(("largest number of simulations", "none" if limit is None else f"{limit:g}"))
    return rows + changed_settings(sampler.settings)


def changed_settings(settings: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Names and values of dataclass fields that differ from their defaults, nested ones with a dot."""
    found, default = [], type(settings)()
    for field in fields(settings):
        value, usual = getattr(settings, field.name), getattr(default, field.name)
        if is_dataclass(value):
            found += changed_settings(value, f"{prefix}{field.name}.")
        elif value != usual:
            found.append((f"{prefix}{field.name}", getattr(value, "__name__", None) or repr(value)))
    return found


def how_to_repeat(run: FinishedRun) -> str:
    """Lines of Python that make the run again, from a posterior with the same fingerprint."""
    sampler = run.sampler
    name, package = type(sampler).__name__, "samplers" if hasattr(sampler, "settings") else "emcee"
    arguments = [str(sampler.nwalkers), "posterior.ndim", "posterior"]
    # of a function of the user's own, whose values only the user can write down
    arguments += [f"{key}={key}" for key in ("args", "kwargs") if getattr(sampler.log_prob_fn, key, None)]
    if getattr(sampler, "vectorize", False):
        arguments.append("vectorize=True")
    if package == "emcee":
        return (
            f"from emcee import {name}\n\nsampler = {name}({', '.join(arguments)})\n"
            f"sampler.run_mcmc(start, {sampler.iteration})    # start: the ({sampler.nwalkers}, {sampler.ndim}) points "
            "that the walkers began at"
        )
    if sampler.seed is not None:
        arguments.append(f"seed={sampler.seed}")
    if sampler.guide is not None or sampler.rounds:
        arguments.append("guide=posterior.guide()")
    if sampler.max_simulations is not None:
        arguments.append(f"max_simulations={sampler.max_simulations:g}")
    changed = changed_settings(sampler.settings)
    usual = ("recycle", str(name == "SMCSampler"))  # None, the default, was replaced by it
    arguments += [f"{key}={text}" for key, text in changed if "." not in key and (key, text) != usual]
    lines = "".join(f"    {each},\n" for each in arguments)
    return f"from {package} import {name}\n\nsampler = {name}(\n{lines})\nsampler.run_mcmc(None, {sampler.iteration})"


EventPredictions = Mapping[str, Prediction]
"""Predictions of one event by quantity, such as the result of `fe_likelihoods.propagate` for several quantities."""

LEVEL = 0.9  # of the intervals
MOST_NUMBERS = 20  # of a prediction that are shown


class NumberRow(NamedTuple):
    """A predicted number of an event, such as a peak, in the unit of its channel; NaN without measurements."""

    name: str  # such as "peak of deck"
    unit: str  # for display
    median: float
    quartiles: tuple[float, float]  # of the central interval with probability 0.5
    ends: tuple[float, float]  # of the central interval with probability 0.9
    measured: float
    pit: float  # predicted probability of a value smaller than the measured one

    @property
    def place(self) -> str:
        """Where the measured value is, in words; empty without one."""
        if not np.isfinite(self.pit):
            return ""
        if abs(self.pit - 0.5) <= 0.25:
            return "within 50 %"
        if abs(self.pit - 0.5) <= 0.5 * LEVEL:
            return f"within {percent(LEVEL)}"
        return "above" if self.pit > 0.5 else "below"


class OtherEvent(NamedTuple):
    """The prediction of one event; its scores exist where there are measurements."""

    name: str
    predictions: EventPredictions  # by quantity; none if all simulations failed
    measured: Measurements | None
    numbers: tuple[NumberRow, ...]  # of all predictions that are not histories
    histories: tuple[HistoryScores, ...]
    values: tuple[QuantityScores, ...]
    sentence: str  # how it was predicted, and how the measurements compare with it
    findings: tuple[Finding, ...] = ()  # of the predictions, and failed samples


def as_events(events: Any) -> dict[str, EventPredictions | SimulationFailed]:
    """Predictions of each event by quantity, or why there are none; ValueError for other objects.

    The events map names to a `Prediction`, a mapping of predictions, or `SimulationFailed`.
    """
    if not isinstance(events, Mapping):
        raise ValueError(f"events must be a mapping of names to predictions of these events; got {events!r}")
    found = {}
    for name, given in events.items():
        if isinstance(given, SimulationFailed):
            found[str(name)] = given
            continue
        of_event = {"": given} if isinstance(given, Prediction) else given
        if not isinstance(of_event, Mapping) or not all(isinstance(each, Prediction) for each in of_event.values()):
            raise ValueError(
                f"events: expected the result of propagate for each event, of one quantity or of several by name; "
                f"{name!r} is {given!r}"
            )
        if not of_event:
            raise ValueError(
                f"events: {name!r} has no prediction; give the result of propagate for it, or leave the event out"
            )
        found[str(name)] = dict(of_event)
    return found


def describe_event(
    name: str, predictions: EventPredictions | SimulationFailed, measured: Measurements | None
) -> OtherEvent:
    """Describe and score the predictions of an event, or the error that `propagate` raises if all simulations fail."""
    if isinstance(predictions, SimulationFailed):
        text = f"It could not be predicted: {predictions.reason}. Mend the model for this motion; the samples stay."
        return OtherEvent(name, {}, measured, (), (), (), text)
    findings = list(dict.fromkeys(found for each in predictions.values() for found in each.findings))
    first = next(iter(predictions.values()))
    reasons = "; ".join(f"{count}: {reason}" for reason, count in first.failure_reasons.items())
    told = f" {first.n_failed} samples failed and are left out ({reasons})." if first.n_failed else ""
    histories, values, numbers = [], [], []
    for each in predictions.values():
        scores = None
        if measured is not None:
            try:
                scores = each.score(measured, LEVEL)
            except ValueError as error:
                told += f" No scores: {error}."
        if scores is not None:
            (histories if each.dt is not None else values).append(scores)
        if each.dt is None and each.values is not None:
            numbers += _number_rows(each, scores)
    sentence = _sentence(first, measured, histories, numbers) + told
    return OtherEvent(
        name, predictions, measured, tuple(numbers), tuple(histories), tuple(values), sentence, tuple(findings)
    )


def _number_rows(prediction: Prediction, scores: QuantityScores | None) -> list[NumberRow]:
    """The numbers of a prediction, in the units of their channels where these are known."""
    values = np.sort(prediction.values.reshape(len(prediction.values), -1), axis=0)
    ends, quartiles = central_interval(values, LEVEL), central_interval(values, 0.5)
    known, names = len(prediction.channels) == values.shape[1], names_of_values(prediction)
    rows = []
    for k, name in enumerate(names[:MOST_NUMBERS]):
        unit = prediction.channels[k].unit if known else "SI"
        found = [np.median(values[:, k]), *(end[k] for end in (*quartiles, *ends))]
        found.append(np.nan if scores is None else scores.measured[k])
        shown = [float(each if unit == "SI" else from_si(each, unit)) for each in found]
        pit = np.nan if scores is None else float(scores.pit[k])
        rows.append(NumberRow(name, unit, shown[0], tuple(shown[1:3]), tuple(shown[3:5]), shown[5], pit))
    return rows


def _sentence(
    first: Prediction, measured: Measurements | None, histories: list[HistoryScores], numbers: list[NumberRow]
) -> str:
    """How an event was predicted, and how the measurements compare with it."""
    noise = "with the noise of measurements" if first.noise else "without the noise of measurements"
    if first.ratios is not None:
        noise = "times ratios of measured to simulated values in other events"
    state = "as the event of the calibration has left it" if first.from_state == "end" else "before any other event"
    text = f"Predicted from {first.n_samples} samples, {noise}."
    text += f" The motion meets the structure {state}." if first.data is None or first.data.is_history else ""
    if measured is None:
        return f"{text} There are no measurements to compare with."
    known = [row for row in numbers if np.isfinite(row.pit)]
    if known:
        share = share_within([row.pit for row in known], LEVEL)
        text += f" {share.inside} of {share.n} measured numbers are within their {percent(LEVEL)} intervals"
        outside = [f"{row.name} {row.place}" for row in known if not row.place.startswith("within")]
        text += f" ({', '.join(outside)})" if outside else ""
        text += "; so few show a share between {} and {} of all such numbers.".format(*map(percent, share.interval))
    for scores in histories:
        shares = ", ".join(
            f"{percent(share)} of {channel.name}"
            for channel, share in zip(scores.channels, scores.coverage, strict=True)
        )
        text += f" The {percent(LEVEL)} band contains {shares}."
    if not first.noise:
        text += " A band without noise shows the response, and contains fewer measurements."
    return text
