"""``python -m benchmarks.few_hundred [problems] [--seeds 5] [--budget N]``: a posterior for a few hundred runs.

Samples every problem of `few_hundred_problems` with a guide and a budget, ``SMCSampler(100, ndim, posterior,
vectorize=True, seed=seed, guide=posterior.guide(), max_simulations=N)``, and prints one line per problem and seed:
simulations of the whole record (parts count as fractions) up to the weighted draws and with the first sweep of the
walkers, effective sample size of these draws, simulations per effective sample, log Z, errors against the reference,
verdict, wall time and CPU time of this process outside simulations; beside it, cost and log Z of the default sampler on
the same data.

References and runs of the default sampler take minutes to hours. They are our own results, kept in
``few_hundred_references.json``: ``--references`` makes those that are missing (`importance_reference`), ``--default``
runs the default sampler where its result is missing. No simulation is shared between these and the runs in the table.
"""

import argparse
import json
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from fe_likelihoods import Posterior
from samplers import SMCSampler
from tests.statistics.brute_force import Reference
from tests.statistics.guided_runs import Errors, Outcome, compare, run

from .few_hundred_problems import PROBLEMS, Problem
from .importance_reference import by_importance
from .rows import aligned, machine

__all__ = ["load", "make_default", "make_reference", "reference_named"]

FILE = Path(__file__).with_name("few_hundred_references.json")
LONG = 8  # sweeps at beta = 1 of a reference by the default sampler
BUDGET = 4  # default, in goals of the problem
HEADER = (
    "problem",
    "seed",
    "verdict",
    "judgement",
    "runs",
    "goal",
    "with sweep",
    "ESS",
    "runs/ESS",
    "log Z",
    "+-",
    "error",
    "in se",
    "means [sd]",
    "in se",
    "share",
    "s",
    "CPU s",
    "default SMC: runs",
    "log Z",
)


def load() -> dict[str, dict[str, Any]]:
    """Contents of the file of references."""
    return json.loads(FILE.read_text()) if FILE.exists() else {}


def _store(kind: str, key: str, entry: dict[str, Any]) -> None:
    """Add an entry to the file, which another process may have changed in the meantime."""
    contents = load()
    contents["about"] = (
        "Own results of this repository, made by `python -m benchmarks.few_hundred --references --default`: "
        "importance sampling that starts at the known modes, and the default SMCSampler."
    )
    contents.setdefault(kind, {})[key] = entry
    FILE.write_text(json.dumps(contents, indent=1, sort_keys=True) + "\n")


def _rounded(values: Any) -> Any:
    return np.asarray([float(f"{value:.6g}") for value in np.ravel(values)]).tolist()


def key_of(name: str, seed: int) -> str:
    """Key of a problem and seed in the file: measured data have one reference for all seeds."""
    return f"{name} {1 if PROBLEMS[name].measured else seed}"


def reference_named(name: str, seed: int, posterior: Posterior) -> Any:
    """Reference of a problem and seed from the file, or None; ValueError if the data are not those it was made with."""
    entry = load().get("references", {}).get(key_of(name, seed))
    if entry is None:
        return None
    if entry["data"] != posterior.data_fingerprint:
        raise ValueError(
            f"the reference of {name}, seed {seed}, was made with other data: delete it from {FILE.name} and run "
            "again with --references"
        )
    return SimpleNamespace(**{key: np.array(v) if isinstance(v, list) else v for key, v in entry.items()})


def _quadrature(posterior: Posterior, about: Reference, points: int = 141, reach: float = 7.0) -> Reference:
    """The same by the midpoint rule for two parameters, `reach` standard deviations about the mean."""
    axes = [mean + sd * np.linspace(-reach, reach, points) for mean, sd in zip(about.mean, about.sd, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    values = posterior(grid)
    weights = np.exp(values - values.max())
    area = np.prod([axis[1] - axis[0] for axis in axes])
    w = weights / weights.sum()
    mean = w @ grid
    none = np.zeros(2)
    return about._replace(
        log_evidence=float(values.max() + np.log(weights.sum() * area)),
        log_evidence_error=0.0,
        mean=mean,
        mean_error=none,
        sd=np.sqrt(w @ (grid - mean) ** 2),
        sd_error=none,
        effective_sample_size=float("inf"),
        draws=len(grid),
    )


def _long_run(posterior: Posterior, problem: Problem, seed: int) -> Reference:
    """Reference from the default sampler; errors as the sampler reports them."""
    sampler = SMCSampler(problem.walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, LONG)
    samples = sampler.get_chain(flat=True)
    error, sd = sampler.mean_error(), samples.std(axis=0)
    n = float((sd / error).min() ** 2)  # effective sample size of the worst mean
    label = np.zeros(len(samples), dtype=int) if problem.labels is None else problem.labels(samples)
    shares = np.bincount(label) / len(label)
    return Reference(
        float(sampler.log_evidence),
        float(sampler.log_evidence_error),
        samples.mean(axis=0),
        error,
        sd,
        sd / np.sqrt(2.0 * n),
        shares,
        np.sqrt(shares * (1.0 - shares) / n),
        n,
        len(samples),
    )


def make_reference(name: str, problem: Problem, seed: int) -> None:
    """Make the reference of a problem and seed, and store it."""
    posterior = problem.posterior(seed)
    start = time.perf_counter()
    if problem.reference_draws:
        method = "importance sampling from the known modes"
        found = by_importance(
            posterior,
            problem.starts(posterior),
            draws=problem.reference_draws,
            rounds=problem.reference_rounds,
            seed=seed,
            labels=problem.labels,
            inform=lambda text: print(text, flush=True),
        )
    else:
        method = f"default SMCSampler, {problem.walkers} walkers, {LONG} sweeps"
        found = _long_run(posterior, problem, seed)
    if posterior.ndim == 2:
        method, found = "quadrature", _quadrature(posterior, found)
    entry = {
        key: _rounded(value) if np.ndim(value) else (round(value, 6) if np.isfinite(value) else None)
        for key, value in found._asdict().items()
    }
    report = posterior.report()
    entry |= {
        "data": posterior.data_fingerprint,
        "parameters": posterior.parameter_names,
        "simulations": report["simulations"],
        "failures": report["failure_count"],
        "method": method,
    }
    _store("references", key_of(name, seed), entry)
    print(
        f"{name} {seed}: log Z {found.log_evidence:.3f} +- {found.log_evidence_error:.3f}, effective "
        f"{found.effective_sample_size:.0f} of {found.draws}, shares {np.round(found.shares, 3)}, "
        f"{report['simulations']} simulations in {time.perf_counter() - start:.0f} s",
        flush=True,
    )


def make_default(name: str, problem: Problem, seed: int) -> None:
    """Run the default sampler on a problem and seed, and store its cost and result."""
    posterior = problem.posterior(seed)
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        sampler = SMCSampler(problem.walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 1)
    samples = sampler.get_chain(flat=True)
    entry = {
        "walkers": problem.walkers,
        "simulations": posterior.report()["simulations"],
        "log_evidence": round(float(sampler.log_evidence), 4),
        "log_evidence_error": round(float(sampler.log_evidence_error), 4),
        "mean": _rounded(samples.mean(axis=0)),
        "mean_error": _rounded(sampler.mean_error()),
        "sd": _rounded(samples.std(axis=0)),
        "data": posterior.data_fingerprint,
        "seconds": round(time.perf_counter() - start, 1),
        "warnings": [str(w.message) for w in caught if issubclass(w.category, UserWarning)],
    }
    if problem.labels is not None:
        entry["shares"] = _rounded(np.bincount(problem.labels(samples)) / len(samples))
    _store("default SMC", key_of(name, seed), entry)
    print(
        f"{name} {seed}: default SMC, {entry['simulations']} simulations, log Z {entry['log_evidence']:.3f} +- "
        f"{entry['log_evidence_error']:.3f} in {entry['seconds']:.0f} s",
        flush=True,
    )


def line(
    name: str, problem: Problem, seed: int, outcome: Outcome, errors: Errors | None, default: dict | None
) -> tuple[str, ...]:
    """Cells of one run."""
    if outcome.failed:
        return (name, str(seed), "", outcome.failed[:80], *[""] * (len(HEADER) - 4))
    effective = outcome.effective_sample_size
    against = ("no reference", *[""] * 4)
    if errors is not None:
        against = (
            f"{errors.log_evidence:+.3f}",
            f"{errors.log_evidence_z:+.1f}",
            f"{errors.mean:.2f}",
            f"{errors.mean_z:.1f}",
            f"{errors.share:.2f}" if problem.labels else "",
        )
    beside = ("", "") if default is None else (f"{default['simulations']}", f"{default['log_evidence']:.2f}")
    return (
        name,
        str(seed),
        outcome.status,
        errors.judgement if errors else "",
        f"{outcome.weighted:.0f}",
        str(problem.goal),
        f"{outcome.simulations:.0f}",
        f"{effective:.0f}",
        f"{outcome.weighted / effective:.1f}" if effective else "",
        f"{outcome.log_evidence:.3f}",
        f"{outcome.log_evidence_error:.3f}",
        *against,
        f"{outcome.seconds:.0f}",
        f"{outcome.overhead:.1f}",
        *beside,
    )


def main() -> None:
    """Run the problems and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.few_hundred", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(PROBLEMS)}; all by default")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, of data and sampler (default 5)")
    parser.add_argument("--first", type=int, default=1, help="first seed (default 1)")
    parser.add_argument("--budget", type=int, help=f"largest number of simulations (default: {BUDGET} goals)")
    parser.add_argument("--references", action="store_true", help="make missing references instead of the table")
    parser.add_argument("--default", action="store_true", help="make missing runs of the default sampler instead")
    parser.add_argument("--reasons", action="store_true", help="print reasons of verdicts and warnings too")
    parser.add_argument("--out", type=Path, help="file for the results (JSON)")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(PROBLEMS):
        parser.error(f"expected names among {', '.join(PROBLEMS)}; got {', '.join(unknown)}")
    lines, stored = [HEADER], []
    for name in arguments.names or PROBLEMS:
        problem = PROBLEMS[name]
        if reason := problem.needs():
            print(f"NOT RUN: {name}: {reason}", flush=True)
            continue
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            key = key_of(name, seed)
            if arguments.references or arguments.default:
                if arguments.references and key not in load().get("references", {}):
                    make_reference(name, problem, seed)
                if arguments.default and key not in load().get("default SMC", {}):
                    make_default(name, problem, seed)
                continue
            posterior = problem.posterior(seed)
            known = reference_named(name, seed, posterior)
            outcome = run(posterior, seed, arguments.budget or BUDGET * problem.goal)
            errors = None if known is None else compare(outcome, known, problem.labels)
            lines.append(line(name, problem, seed, outcome, errors, load().get("default SMC", {}).get(key)))
            print(*lines[-1], sep="  ", flush=True)
            if arguments.reasons:
                print("   ", outcome.reasons, *outcome.warnings, sep="\n    ", flush=True)
            stored.append({"problem": name, "seed": seed, "goal": problem.goal, "budget": arguments.budget})
            stored[-1] |= {} if errors is None else {f"error_{key}": value for key, value in errors._asdict().items()}
            stored[-1] |= {
                key: value for key, value in outcome._asdict().items() if isinstance(value, int | float | str | tuple)
            }
    if len(lines) > 1:
        print()
        print(aligned(lines, right=range(4, len(HEADER))))
    if arguments.out and stored:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"machine": machine(), "runs": stored}, indent=1) + "\n")


if __name__ == "__main__":
    main()
