"""Files of a finished run: the summary as text and CSV, and samples for arviz."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..checks.result import JudgedRun
from ..checks.run import FinishedRun

__all__ = ["write_samples", "write_summary"]


def write_summary(folder: Path, run: FinishedRun, judged: JudgedRun, said: Sequence[str]) -> None:
    """Write ``summary.txt`` (judgement, moments of the parameters, fit, what else is `said`) and ``summary.csv``."""
    import pandas as pd  # slow to import

    from samplers.reporting.summary import Summary

    columns = {"label": "parameter", "mean": "mean", "mean_error": "mean_error", "sd": "sd", "sd_error": "sd_error"}
    columns |= {"cv": "cv", "low": "q05", "median": "median", "high": "q95", "nominal": "nominal"}
    rows = pd.DataFrame([{name: getattr(row, key) for key, name in columns.items()} for row in judged.rows])
    rows.to_csv(folder / "summary.csv", index=False)
    pd.DataFrame([stage._asdict() for stage in run.sampler.ladder]).to_csv(folder / "stages.csv", index=False)
    moments = Summary(*(rows["parameter" if name == "names" else name] for name in Summary._fields))
    evidence = f"log-evidence {run.sampler.log_evidence:.2f} +- {run.sampler.log_evidence_error:.2g}"
    lines = [str(judged.judgement), "", str(moments), "", evidence, str(run.verdict), ""]
    for fit in judged.fits:
        title = f" ({fit.title})" if fit.title else ""
        errors = [f"  {each.channel.name}: {100 * each.after:.1f} %" for each in fit.channels]
        lines += [f"Relative RMS error of the response (RRMSE){title}:", *errors] if errors else []
        if fit.modal:
            found = {"": fit.modal.samples, "Held out, predicted:\n": fit.modal.held_out}
            lines += [f"{what}{modes}" for what, modes in found.items() if modes is not None]
    (folder / "summary.txt").write_text("\n".join([*lines, *filter(None, said), ""]), encoding="utf-8")


def write_samples(folder: Path, run: FinishedRun, samplers: Sequence[Any], prediction: Any, judgement: str) -> str:
    """Write ``posterior.nc``, the samples with the prediction and the judgement as an attribute.

    Independent runs are chains. Returns how the runs agree, empty for one.
    """
    import arviz  # slow to import

    from samplers import to_arviz

    data = to_arviz(samplers, prediction, discard=run.discard)
    data.posterior.attrs["judgement"] = judgement
    data.to_netcdf(str(folder / "posterior.nc"))
    if len(samplers) == 1:
        return ""
    found = arviz.rhat(data)
    found = found["posterior"] if "posterior" in getattr(found, "children", {}) else found
    worst, name = max((float(each), name) for name, each in found.data_vars.items())
    values = ", ".join(f"{each.log_evidence:.2f} +- {each.log_evidence_error:.2g}" for each in samplers)
    agree = f"r_hat at most {worst:.3f} ({name}; above 1.01 they differ)"
    return f"{len(samplers)} independent runs: {agree}, log-evidences {values}"
