"""Files of a finished run: tables as text and CSV, and samples for arviz."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.compared import Fit, ModalFit, data_sets_of
from ..checks.finding import Judgement
from ..checks.result import JudgedRun
from ..checks.run import FinishedRun
from ..prediction.prediction import Prediction
from ..reporting.other_events import OtherEvent

__all__ = ["write_events", "write_samples", "write_tables"]

Rows = list[dict[str, Any]]


def write_tables(folder: Path, run: FinishedRun, judged: JudgedRun, agreement: str = "") -> tuple[str, ...]:
    """Write judgement, moments of the parameters, stages and errors of the fit; returns the names of the files.

    `agreement` says how independent runs agree.
    """
    from samplers.reporting.summary import Summary

    columns = ("label", "mean", "mean_error", "sd", "sd_error", "cv", "low", "median", "high", "nominal")
    names = {"label": "parameter", "low": "q05", "high": "q95"}
    of_each = [{names.get(key, key): getattr(row, key) for key in columns} for row in judged.rows]
    moments = Summary(*([getattr(row, key) for row in judged.rows] for key in ("label", *Summary._fields[1:])))
    tables: dict[str, Rows] = {"summary.csv": of_each}
    evidence = f"log-evidence {run.sampler.log_evidence:.2f} +- {run.sampler.log_evidence_error:.2g}"
    lines = [str(judged.judgement), "", str(moments), "", evidence, str(run.verdict), *filter(None, [agreement]), ""]
    for key, _, _ in data_sets_of(run.posterior):
        own = [fit for fit in judged.fits.fits if not key or fit.title == key or fit.title.startswith(f"{key}, ")]
        tables[f"fit-{key}.csv" if key else "fit.csv"], text = _modes(own[0].modal) if own[0].modal else _responses(own)
        lines += text
    tables["stages.csv"] = [stage._asdict() for stage in run.sampler.ladder]
    for name, rows in tables.items():
        _write_csv(folder / name, rows)
    (folder / "summary.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return "summary.txt", *tables


def _responses(fits: Sequence[Fit]) -> tuple[Rows, list[str]]:
    """RRMSE of every channel of each event, as in the report, as rows and as lines."""
    rows = [
        ({"event": fit.title} if len(fits) > 1 else {}) | {"channel": each.channel.name, "rrmse": each.after}
        for fit in fits
        for each in fit.channels
    ]
    shown = [f"  {' '.join(map(str, [*row.values()][:-1]))}: {100 * row['rrmse']:.1f} %" for row in rows]
    return rows, ["Relative RMS error of the response (RRMSE):", *shown]


def _modes(fit: ModalFit) -> tuple[Rows, list[str]]:
    """Measured and computed modes [Hz] at samples of the posterior, as rows and as lines; the same as in the report."""
    rows, lines = [], []
    for modes, title in ((fit.samples, ""), (fit.held_out, "Held out, predicted:\n")):
        if modes is None:
            continue
        columns = {
            "mode": modes.data.mode_numbers,
            "measured_Hz": modes.data.mean_frequencies.tolist(),
            "median_Hz": np.median(modes.frequencies, axis=0).tolist(),
            **dict(zip(("q05_Hz", "q95_Hz"), (ends.tolist() for ends in modes.interval()), strict=True)),
            "mac": np.median(modes.assurance, axis=0).tolist(),
            "compared": ["no" if title else "yes"] * modes.data.n_modes,
        }
        rows += [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        lines.append(f"{title}{modes}")
    return rows or [{"mode": ""}], lines


def _write_csv(path: Path, rows: Rows) -> None:
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
    import arviz

    from samplers import to_arviz

    options = {"draws": max(draws, len(samplers))} if draws else {}
    data = to_arviz(samplers, run.posterior if draws else None, prediction, discard=run.discard, **options)
    data.posterior.attrs["judgement"] = str(judgement)
    data.to_netcdf(str(folder / "posterior.nc"))
    if len(samplers) == 1:
        return "posterior.nc", ""
    found = arviz.rhat(data)
    found = found["posterior"] if "posterior" in getattr(found, "children", {}) else found
    worst, name = max((float(each), name) for name, each in found.data_vars.items())
    evidences = ", ".join(f"{each.log_evidence:.2f} +- {each.log_evidence_error:.2g}" for each in samplers)
    return "posterior.nc", (
        f"{len(samplers)} independent runs: r_hat at most {worst:.3f} ({name}; above 1.01 they differ), log-evidences "
        f"{evidences}"
    )
