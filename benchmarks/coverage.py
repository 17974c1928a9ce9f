"""``python -m benchmarks.coverage [names] [--budgets 200 500 2000] [--runs 40]``: are the errors of a run right?

Runs a sampler with a guide many times, with four data sets and a new seed each time, on posteriors with known answers,
and counts how often two standard errors of log Z, and of every mean, contain the truth. It should be in 90 % of the
runs or more. A run whose verdict is "not usable" makes no claim: it is counted, but not in the coverage. The last
column counts the verdicts "converged" of runs that were wrong (`guided_runs.compare`); there should be none.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.statistics.guided_runs import compare, run
from tests.statistics.hard_posteriors import CASES

from .few_hundred import reference_named
from .few_hundred_problems import PROBLEMS
from .hard_posteriors import cached_reference
from .rows import aligned

__all__ = ["coverage"]

BUDGETS = (200, 500, 2000)
DATA_SETS = 4
DEFAULT = ("oscillator", "smooth", "few_samples", "two_modes", "banana", "bounds", "rough", "failing_scattered")
REFERENCES = Path("results") / "hard_references.json"
HEADER = (
    "problem",
    "budget",
    "runs",
    "failed",
    "not usable",
    "usable",
    "converged",
    "log Z covered [%]",
    "means covered [%]",
    "simulations",
    "ESS",
    "wrong, converged",
    "wrong, usable",
)


def _problem(name: str, data: int) -> tuple[Any, Any, Any]:
    """Posterior, reference and labels of the modes for one data set."""
    if name in CASES:
        return CASES[name].posterior(data, name), cached_reference(name, data, REFERENCES), CASES[name].label
    posterior = PROBLEMS[name].posterior(data)
    known = reference_named(name, data, posterior)
    if known is None:
        raise ValueError(f"no reference of {name}, seed {data}: python -m benchmarks.few_hundred {name} --references")
    return posterior, known, PROBLEMS[name].labels


def coverage(name: str, budget: int, runs: int) -> dict[str, Any]:
    """Counts and coverages of many runs on one problem with one budget."""
    one: dict[str, list] = {"status": [], "judgement": [], "evidence": [], "means": [], "simulations": [], "ess": []}
    for seed in range(1, runs + 1):
        posterior, known, labels = _problem(name, 1 + seed % DATA_SETS)
        outcome = run(posterior, 1000 + seed, budget)
        errors = compare(outcome, known, labels)
        one["status"].append("failed" if outcome.failed else outcome.status)
        one["judgement"].append(errors.judgement)
        if outcome.failed or outcome.status == "not usable":
            continue
        one["evidence"].append(abs(errors.log_evidence_z) < 2.0)
        error = np.hypot(outcome.mean_error, known.mean_error)
        one["means"].append(np.mean(np.abs(outcome.mean - known.mean) < 2.0 * error))
        one["simulations"].append(outcome.simulations)
        one["ess"].append(outcome.effective_sample_size)
    wrong = [status for status, found in zip(one["status"], one["judgement"], strict=True) if found == "WRONG"]

    def mean(key: str) -> float | None:
        return float(np.mean(one[key])) if one[key] else None

    return {
        "problem": name,
        "budget": budget,
        "runs": runs,
        **{status: one["status"].count(status) for status in ("failed", "not usable", "usable", "converged")},
        "log Z covered": mean("evidence"),
        "means covered": mean("means"),
        "simulations": mean("simulations"),
        "ESS": mean("ess"),
        "wrong, converged": wrong.count("converged"),
        "wrong, usable": wrong.count("usable"),
    }


def _line(found: dict[str, Any]) -> tuple[str, ...]:
    factors = {"log Z covered": 100.0, "means covered": 100.0}
    return tuple(
        value if isinstance(value, str) else "-" if value is None else f"{factors.get(key, 1.0) * value:.0f}"
        for key, value in found.items()
    )


def main() -> None:
    """Run the problems and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"problems (default {', '.join(DEFAULT)})")
    parser.add_argument("--budgets", nargs="+", type=int, default=BUDGETS)
    parser.add_argument("--runs", type=int, default=40, help="runs per problem and budget (default 40)")
    parser.add_argument("--out", type=Path, default=Path("results") / "coverage.json")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(CASES) - set(PROBLEMS):
        parser.error(f"expected names among {', '.join([*CASES, *PROBLEMS])}; got {', '.join(unknown)}")
    lines, stored = [HEADER], []
    for name in arguments.names or DEFAULT:
        for budget in arguments.budgets:
            stored.append(coverage(name, budget, arguments.runs))
            lines.append(_line(stored[-1]))
            print(*lines[-1], sep="  ", flush=True)
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(stored, indent=1) + "\n")
    print()
    print(aligned(lines, right=range(1, len(HEADER))))


if __name__ == "__main__":
    main()
