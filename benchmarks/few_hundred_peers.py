"""``python -m benchmarks.few_hundred_peers [problems] [--budgets 200 500]``: other programs at equal budgets.

Beside ``SMCSampler`` with the posterior's guide run PyVBMC (Acerbi 2018, arXiv:1810.05558) and GPry (El Gammal et al.
2023, doi:10.1088/1475-7516/2023/10/021), which fit a Gaussian process to the log-density. Both are approximate: their
samples come from the fit, and no draw is corrected. Every run has its own process and ``--limit`` seconds of wall time.
Settings are the defaults of the other program, except the number of evaluations. PyVBMC has the prior's bounds (the
quantiles of 1e-12 where these are infinite) and starts at its median; GPry has a uniform prior, in the box of the
quantiles of 1e-4, and draws its first points between those of 16 and 84 %.

PyVBMC stops by itself when it has converged, often before the budget: the column ``runs`` has the number. Install the
others in an environment of their own, since they pull in many packages::

    python -m venv .venv-few-hundred
    .venv-few-hundred/bin/pip install --editable . pyvbmc gpry
    .venv-few-hundred/bin/python -m benchmarks.few_hundred_peers --methods PyVBMC GPry

Results are added to ``--out``, whose whole content is printed, so that tables of several environments are joined.
"""

import argparse
import importlib.util
import json
import multiprocessing
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.statistics.guided_runs import Outcome, compare, run
from tests.statistics.hard_posteriors import CASES

from .few_hundred import reference_named
from .few_hundred_problems import PROBLEMS
from .hard_posteriors import cached_reference
from .rows import Row, aligned

__all__ = ["METHODS", "Method", "rows", "run_method"]

LIMIT = 900.0  # s of wall time for one run
BUDGETS = (200, 500)
SMALL = ("few_samples", "two_modes", "banana")  # of `tests.statistics.hard_posteriors`
DEFAULT = (*SMALL, "oscillator", "column4", "twin")
REFERENCES = Path("results") / "hard_references.json"
LOWEST = -1e5  # log-density where it is -inf: the others need a finite number
DRAWS = 4000  # from the fit of the others
HEADER = (
    "problem",
    "budget",
    "method",
    "seed",
    "runs",
    "log Z error",
    "+-",
    "means [sd]",
    "sd [%]",
    "share",
    "s",
    "judgement",
)


class _Counted:
    """The posterior as a function of one point that is counted and never infinite."""

    def __init__(self, posterior: Any) -> None:
        self.posterior, self.calls = posterior, 0

    def __call__(self, x: np.ndarray) -> float:
        self.calls += 1
        return max(float(self.posterior.log_prob(np.asarray(x, dtype=float).ravel())), LOWEST)


def _limits(posterior: Any) -> dict[str, np.ndarray]:
    """Median, bounds, and quantiles of the prior, (ndim,) each: 16 and 84 % (plausible), 0.01 and 99.99 %."""
    distributions = posterior.prior.distributions.values()
    bounds = np.array([d.bounds for d in distributions])
    levels = (1e-12, 1e-4, 0.16, 0.5, 0.84, 1.0 - 1e-4, 1.0 - 1e-12)
    quantile = {u: np.array([float(d.ppf(u)) for d in distributions]) for u in levels}
    return {
        "median": quantile[0.5],
        "low": np.where(np.isfinite(bounds[:, 0]), bounds[:, 0], quantile[1e-12]),
        "high": np.where(np.isfinite(bounds[:, 1]), bounds[:, 1], quantile[1.0 - 1e-12]),
        "least": quantile[1e-4],
        "most": quantile[1.0 - 1e-4],
        "plausible_low": quantile[0.16],
        "plausible_high": quantile[0.84],
    }


def _pyvbmc(posterior: Any, seed: int, budget: int) -> Outcome:
    from pyvbmc import VBMC

    target, at = _Counted(posterior), _limits(posterior)
    sampler = VBMC(
        target,
        *(at[key][None] for key in ("median", "low", "high", "plausible_low", "plausible_high")),
        options={"max_fun_evals": budget, "display": "off"},
        seed=seed,
    )
    fit, results = sampler.optimize()
    samples = np.asarray(fit.sample(DRAWS)[0])
    status = f"{results['convergence_status']}, r {float(results['r_index']):.2f}"
    return _approximate(samples, target.calls, results["elbo"], results["elbo_sd"], status)


def _approximate(samples: np.ndarray, calls: int, log_evidence: Any, error: Any, status: str) -> Outcome:
    """Outcome of a method that samples its own fit."""
    sd = samples.std(axis=0)
    return Outcome(
        log_evidence=float(log_evidence),
        log_evidence_error=float(error),
        mean=samples.mean(axis=0),
        mean_error=sd / np.sqrt(len(samples)),
        sd=sd,
        samples=samples,
        effective_sample_size=float(len(samples)),
        simulations=float(calls),
        status=status,
    )


def _guided(posterior: Any, seed: int, budget: int) -> Outcome:
    outcome = run(posterior, seed, budget)
    if outcome.failed:
        raise RuntimeError(outcome.failed)
    return outcome


def _gpry(posterior: Any, seed: int, budget: int) -> Outcome:
    from gpry import Runner

    target, at, d = _Counted(posterior), _limits(posterior), posterior.ndim
    low, high = np.maximum(at["low"], at["least"]), np.minimum(at["high"], at["most"])
    volume = np.log(high - low).sum()  # its prior is uniform in the box: its log Z is that of the density times this
    runner = Runner(
        lambda x: target(x) + volume,
        np.stack([low, high], axis=1).tolist(),
        ref_bounds=np.stack([at["plausible_low"], at["plausible_high"]], axis=1).tolist(),
        params=[f"x{i}" for i in range(d)],
        options={"max_total": budget, "max_initial": min(budget, int(30 * d**1.5))},
        seed=seed,
        verbose=1,
    )
    runner.run()
    runner.generate_mc_sample()
    draws = runner.last_mc_samples()
    weights = np.ones(len(draws["X"])) if draws["w"] is None else np.asarray(draws["w"])
    rng = np.random.default_rng(seed)
    samples = np.asarray(draws["X"])[rng.choice(len(weights), DRAWS, p=weights / weights.sum())]
    status = "converged" if runner.has_converged else "not converged"
    return _approximate(samples, target.calls, *runner.last_mc_logZ(), status)


class Method(NamedTuple):
    """Module of a method, the function that runs it, and how to install it."""

    module: str
    run: Callable[[Any, int, int], Outcome]
    install: str


METHODS = {
    "guide": Method("samplers", _guided, ""),
    "PyVBMC": Method("pyvbmc", _pyvbmc, "pip install pyvbmc"),
    "GPry": Method("gpry", _gpry, "pip install gpry"),
}


def _posterior_and_reference(name: str, seed: int) -> tuple[Any, Any, Callable | None]:
    if name in CASES:
        case = CASES[name]
        return case.posterior(seed, name), cached_reference(name, seed, REFERENCES), case.label
    posterior = PROBLEMS[name].posterior(seed)
    return posterior, reference_named(name, seed, posterior), PROBLEMS[name].labels


def _work(method: str, name: str, seed: int, budget: int, answer: Any) -> None:
    """Run a method in its own process and send its errors, or why it has none, through `answer`."""
    posterior, reference, labels = _posterior_and_reference(name, seed)
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            outcome = METHODS[method].run(posterior, seed, budget)
    except Exception as error:  # any exception of another program is reported in its row
        answer.send({"judgement": f"failed: {type(error).__name__}: {(str(error).splitlines() or [''])[0][:100]}"})
        return
    found = {
        "runs": outcome.simulations,
        "reported": outcome.log_evidence_error,
        "status": outcome.status,
        "seconds": time.perf_counter() - start,
    }
    if reference is None:
        found["judgement"] = "no reference"
    else:
        errors = compare(outcome, reference, labels)
        found |= errors._asdict() | {"judgement": errors.judgement}
    answer.send(found)


def run_method(method: str, name: str, seed: int, budget: int, limit: float = LIMIT) -> dict[str, Any]:
    """One run in its own process, ended after the time limit."""
    if name in CASES:
        cached_reference(name, seed, REFERENCES)  # not within the time limit
    context = multiprocessing.get_context("spawn")  # a fork would inherit numba's threads
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(method, name, seed, budget, sender))
    process.start()
    sender.close()  # only the child holds this end: the wait ends when the child dies
    try:
        found = receiver.recv() if receiver.poll(limit) else {"judgement": f"stopped at {limit:.0f} s"}
    except EOFError:
        process.join()
        found = {"judgement": f"ended without a result, exit code {process.exitcode}"}
    process.kill()
    process.join()
    return {"method": method, "problem": name, "seed": seed, "budget": budget} | found


def rows(repeats: int) -> list[Row]:
    """One row per method, small problem and budget: mean number of simulations, with the errors in the note."""
    table = []
    for method, (module, _, install) in METHODS.items():
        if importlib.util.find_spec(module) is None:
            table.append(Row(f"{method}, budget: simulations", "", None, "", f"not installed: {install}"))
            continue
        for name in SMALL:
            for budget in BUDGETS:
                runs = [run_method(method, name, seed, budget) for seed in range(1, repeats + 1)]
                done = [one for one in runs if "log_evidence" in one]
                note = "; ".join(
                    [f"log Z {one['log_evidence']:+.2f} ({one['reported']:.2f})" for one in done]
                    + [f"means {max(one['mean'] for one in done):.2f} sd"] * bool(done)
                    + [one["judgement"] for one in runs if "log_evidence" not in one]
                )
                simulations = float(np.mean([one["runs"] for one in done])) if done else None
                table.append(Row(f"{method}, budget {budget}: simulations", name, simulations, "", note))
    return table


def _line(one: dict[str, Any]) -> tuple[str, ...]:
    def cell(key: str, form: str, factor: float = 1.0) -> str:
        return format(factor * one[key], form) if key in one else ""

    return (
        one["problem"],
        str(one["budget"]),
        one["method"],
        str(one["seed"]),
        cell("runs", ".0f"),
        cell("log_evidence", "+.3f"),
        cell("reported", ".3f"),
        cell("mean", ".2f"),
        cell("sd", ".0f", 100.0),
        cell("share", ".2f"),
        cell("seconds", ".0f"),
        f"{one['judgement']} ({one['status']})" if "status" in one else one["judgement"],
    )


def main() -> None:
    """Run the methods and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.few_hundred_peers", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"problems (default {', '.join(DEFAULT)})")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--budgets", nargs="+", type=int, default=BUDGETS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=float, default=LIMIT, help=f"wall time of a run [s] (default {LIMIT:.0f})")
    parser.add_argument("--out", type=Path, default=Path("results") / "few_hundred_peers.json")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(CASES) - set(PROBLEMS):
        parser.error(f"expected names among {', '.join([*CASES, *PROBLEMS])}; got {', '.join(unknown)}")
    stored = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    for method in arguments.methods:
        if importlib.util.find_spec(METHODS[method].module) is None:
            print(f"NOT RUN: {method} is not installed: {METHODS[method].install}", flush=True)
            continue
        for name in arguments.names or DEFAULT:
            for budget in arguments.budgets:
                for seed in range(1, arguments.seeds + 1):
                    one = run_method(method, name, seed, budget, arguments.limit)
                    print(*_line(one), sep="  ", flush=True)
                    key = ("method", "problem", "seed", "budget")
                    stored = [old for old in stored if any(old[k] != one[k] for k in key)] + [one]
                    arguments.out.parent.mkdir(parents=True, exist_ok=True)
                    arguments.out.write_text(json.dumps(stored, indent=1) + "\n")
    stored.sort(key=lambda one: (one["problem"], one["budget"], one["method"], one["seed"]))
    print()
    print(aligned([HEADER, *map(_line, stored)], right=(1, 3, 4, 5, 6, 7, 8, 9, 10)))


if __name__ == "__main__":
    main()
