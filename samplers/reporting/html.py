"""A sampler in a notebook: what the run has done and found, as an HTML table."""

from html import escape
from typing import Any

from .inspection import described_parameters_of, log_posterior_of
from .summary import summary

__all__ = ["describe_sampler"]


def describe_sampler(sampler: Any) -> str:
    """Describe a tempered sampler as HTML: size, cost, evidence, verdict and the moments of its chain.

    Parameters
    ----------
    sampler : TemperedSampler
        Before, after or between runs.

    Returns
    -------
    str
        HTML without styles; all text is escaped.
    """
    title = f"{type(sampler).__name__} of {sampler.nwalkers} walkers and {sampler.ndim} parameters"
    lines, table = [], ""
    if not sampler.ladder:
        lines.append("Not run yet: run_mcmc(None, 4) anneals draws of the prior and makes 4 sweeps of the posterior.")
    else:
        stages = f"{len(sampler.ladder)} stages to beta = {sampler.ladder[-1].beta:.3g}"
        failed = f", {sampler.failure_count} failed" if sampler.failure_count else ""
        lines.append(f"{stages}, {sampler.iteration} sweeps stored, {sampler.evaluations} evaluations{failed}")
        if sampler.ladder[-1].beta == 1.0:
            lines.append(f"Log-evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2g}")
            lines.append(str(sampler.verdict))
        if sampler.iteration > 0:
            table = _moments(sampler)
    text = "".join(f"<div>{escape(line)}</div>" for line in lines)
    return f"<div><strong>{escape(title)}</strong>{text}{table}</div>"


def _moments(sampler: Any) -> str:
    """Mean, its error and standard deviation of every parameter, in its own unit where the posterior has units."""
    parameters = described_parameters_of(log_posterior_of(sampler), sampler.ndim)
    found = summary(sampler.get_chain(flat=True), mean_error=sampler.mean_error())
    rows = []
    for parameter, *values in zip(parameters, found.mean, found.mean_error, found.sd, strict=True):
        cells = "".join(f"<td>{value / parameter.factor:.4g}</td>" for value in values)
        rows.append(f"<tr><td>{escape(parameter.label)}</td>{cells}</tr>")
    header = "".join(f"<th>{name}</th>" for name in ("parameter", "mean", "MC error", "sd"))
    return f"<table><thead><tr>{header}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
