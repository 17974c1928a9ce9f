"""Files of a finished run: tables as text and CSV, samples for arviz, the prediction, and the report."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.compared import Fit, ModalFit, data_sets_of
from ..checks.finding import Judgement
from ..checks.result import JudgedRun
from ..checks.run import FinishedRun
from ..checks.table import moments_of
from ..prediction.prediction import Prediction
from ..reporting.other_events import OtherEvent

__all__ = ["write_events", "write_samples", "write_tables"]


def write_tables(folder: Path, run: FinishedRun, judged: JudgedRun, agreement: str = "") -> tuple[str, ...]:
    """Write judgement, moments of the parameters, stages and errors of the fit; returns the names of the files.

    `agreement` says how independent runs agree.
    """
    from samplers import ladder_table, summary

    posterior, factors = run.posterior, np.array([p.factor for p in run.parameters])
    mean, errors, sd, of_sd, low, median, high = (values / factors for values in moments_of(run))
    labels = [parameter.label for parameter in run.parameters]
    with np.errstate(divide="ignore", invalid="ignore"):
        cv = sd / np.abs(mean)
    moments = summary(run.samples, labels)._replace(mean=mean, sd=sd, cv=cv, mean_error=errors, sd_error=of_sd)
    fits = {}  # of each data set: rows of a table, and lines of text
    for key, _, _ in data_sets_of(posterior):
        own = [fit for fit in judged.fits.fits if not key or fit.title == key or fit.title.startswith(f"{key}, ")]
        fits[key] = _modes(own[0].modal) if own[0].modal else _responses(own)
    lines = [
        str(judged.judgement),
        "",
        str(moments),
        "",
        f"log-evidence {run.sampler.log_evidence:.2f} +- {run.sampler.log_evidence_error:.2g}",
        str(run.verdict),
        *filter(None, [agreement]),
        "",
    ]
    lines += [line for _, text in fits.values() for line in text]
    (folder / "summary.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    columns = ("parameter", "mean", "mean_error", "sd", "sd_error", "cv", "q05", "median", "q95", "nominal")
    nominal = [parameter.shown(parameter.nominal) for parameter in run.parameters]
    values = (labels, moments.mean, errors, moments.sd, of_sd, moments.cv, low, median, high, nominal)
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]
    _write_csv(folder / "summary.csv", rows)
    files = ["summary.txt", "summary.csv", "stages.txt"]
    for key, (rows, _) in fits.items():
        name = f"fit-{key}.csv" if key else "fit.csv"
        _write_csv(folder / name, rows)
        files.append(name)
    (folder / "stages.txt").write_text(ladder_table(run.sampler) + "\n", encoding="utf-8")
    return tuple(files)


Table = tuple[list[dict[str, Any]], list[str]]


def _responses(fits: Sequence[Fit]) -> Table:
    """RRMSE of every channel of each event, as in the report, as rows and as lines."""
    event = {fit.title: {"event": fit.title} if len(fits) > 1 else {} for fit in fits}
    found = [(fit, each) for fit in fits for each in fit.channels]
    rows = [event[fit.title] | {"channel": each.channel.name, "rrmse": each.after} for fit, each in found]
    shown = [f"  {' '.join(map(str, [*row.values()][:-1]))}: {100 * row['rrmse']:.1f} %" for row in rows]
    return rows, ["Relative RMS error of the response (RRMSE):", *shown]


def _modes(fit: ModalFit) -> Table:
    """Measured and computed modes [Hz] at samples of the posterior, as rows and as lines; the same as in the report."""
    rows, lines = [], []
    for modes, compared in ((fit.samples, "yes"), (fit.held_out, "no")):
        if modes is None:
            continue
        low, high = modes.interval()
        columns = {
            "mode": modes.data.mode_numbers,
            "measured_Hz": modes.data.mean_frequencies.tolist(),
            "median_Hz": np.median(modes.frequencies, axis=0).tolist(),
            "q05_Hz": low.tolist(),
            "q95_Hz": high.tolist(),
            "mac": np.median(modes.assurance, axis=0).tolist(),
            "compared": [compared] * modes.data.n_modes,
        }
        rows += [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        lines += [str(modes) if compared == "yes" else f"Held out, predicted:\n{modes}"]
    return rows or [{"mode": ""}], lines


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with the same keys as a CSV file with a header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def write_events(folder: Path, events: Sequence[OtherEvent]) -> tuple[str, ...]:
    """Write the predicted numbers of all events to ``events.csv``, in the units of the report; returns its name."""
    rows = []
    for event in events:
        for row in event.numbers:
            (q25, q75), (q05, q95) = row.quartiles, row.ends
            values = {"q05": q05, "q25": q25, "median": row.median, "q75": q75, "q95": q95}
            known = {"measured": row.measured, "pit": row.pit} if np.isfinite(row.pit) else {"measured": "", "pit": ""}
            rows.append({"event": event.name, "quantity": row.name, "unit": row.unit} | values | known)
    if rows:
        _write_csv(folder / "events.csv", rows)
    return ("events.csv",) if rows else ()


def write_samples(
    folder: Path,
    run: FinishedRun,
    samplers: Sequence[Any],
    prediction: Prediction | None,
    draws: int,
    judgement: Judgement,
) -> tuple[str, str]:
    """Write the samples in netCDF, with the responses of `draws` of them and the judgement as an attribute.

    Independent runs are chains. Returns the name of the file, and how the runs agree, empty for one.
    """
    from samplers import to_arviz

    options = {"draws": max(draws, len(samplers))} if draws else {}
    data = to_arviz(samplers, run.posterior if draws else None, prediction, discard=run.discard, **options)
    data.posterior.attrs["judgement"] = str(judgement)
    data.to_netcdf(str(folder / "posterior.nc"))
    return "posterior.nc", _agreement(data, samplers) if len(samplers) > 1 else ""


def _agreement(data: Any, samplers: Sequence[Any]) -> str:
    """The largest r_hat of independent runs, and their evidences, as a sentence."""
    import arviz

    found = arviz.rhat(data)
    found = found["posterior"] if "posterior" in getattr(found, "children", {}) else found
    name, worst = max(((name, float(each)) for name, each in found.data_vars.items()), key=lambda each: each[1])
    text = f"{len(samplers)} independent runs: r_hat at most {worst:.3f} ({name}; above 1.01 they differ)"
    evidences = (f"{each.log_evidence:.2f} +- {each.log_evidence_error:.2g}" for each in samplers)
    return f"{text}, log-evidences {', '.join(evidences)}"
