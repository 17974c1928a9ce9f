"""
SMC, TMCMC and emcee on the same posterior
==========================================

Three samplers are exchanged by changing one name, and SMC runs once more with a guide. They sample the bridge column
and the isolated bridge (synthetic data for both, assumed nominal values for the bridge). The tutorial shows what each
sampler needs, what it returns, and where it fails::

    python tutorials/04_compare_samplers.py                          # all three problems
    python tutorials/04_compare_samplers.py --problem column         # one of them
    python tutorials/04_compare_samplers.py --cache simulations.db   # a second run needs no simulation

**Where samplers fail** is visible in the figures ``wrong_*.png`` and in the warnings:

* TMCMC as published makes too few moves after resampling, which duplicates points. Few distinct points and a wrong
  evidence are left.
* emcee stays in the mode in which it starts, here the one that a search from the median of the prior finds. Nothing
  in its chain shows that there is another mode.
* emcee walkers that start from the prior get stuck at many places.

**A guide** replaces thousands of simulations by hundreds. SMC, TMCMC and emcee see log-probabilities only. The guide
also sees the responses, finds the modes by Gauss-Newton steps, and proposes draws from emulators of the responses.
Every draw is simulated by the model and weighted. A guide fails where the response is not a smooth function of the
parameters, and it cannot see a mode to which none of its searches leads. The verdict of the sampler says what the
result is worth.

The cache stores sums of squared residuals by parameters, and the responses that the guide requests. Equal seeds lead to
equal simulations, so a repeated or an interrupted run finds all previous simulations in the cache.

``FAST=1`` runs everything in about a minute. Its chains are too short to converge; the numbers are not results.
"""

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import Posterior, StoredPosterior, check_result, problems
from fe_likelihoods.emulation.modes import find_modes
from samplers import SamplingWarning, SMCSampler, TMCMCSampler, plot_corner, presets

FAST = bool(os.environ.get("FAST"))
parser = argparse.ArgumentParser(description="Compare SMC, TMCMC and emcee; write tables and figures to a folder.")
parser.add_argument("--problem", choices=("column", "bridge", "means"), action="append", help="default: all three")
parser.add_argument("--walkers", type=int, default=24 if FAST else 500, help="walkers of SMC and TMCMC")
parser.add_argument("--max-simulations", type=int, default=1500, help="limit of simulations of SMC with a guide")
parser.add_argument("--cache", type=Path, help="file of the simulation cache; created if it does not exist")
parser.add_argument("--steps", type=int, default=30 if FAST else 1500, help="steps of emcee")
parser.add_argument("--seed", type=int, default=1, help="seed of the samplers")
parser.add_argument("--out", type=Path, default=Path("results-comparison"), help="folder of the results")
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)
TOO_SHORT = (
    "REDUCED SETTING (fast): few points, few moves, not converged; these numbers are not results" if FAST else ""
)
if FAST:
    print(TOO_SHORT)


# %%
# The problems
# ------------
#
# Time steps are longer than in tutorials 02 and 03, and equal for all samplers. emcee has no tempering: from the prior
# its walkers do not find such narrow posteriors, which is shown by a run that starts there, as SMC and TMCMC do. A
# second run starts where a search for the best fit ends (`find_modes` with one start), with the spread that the search
# states. The simulations of the search are counted.


class Problem(NamedTuple):
    """A posterior, the true parameters of its synthetic data, and two parameters that show where samplers fail."""

    make: Callable[[], Posterior]
    truth: np.ndarray
    pair: tuple[str, str]


def bridge(data: str) -> Problem:
    """The isolated bridge with time steps of 1 ms (fast: 2.5 ms)."""
    truth = [*problems.ISOLATED_BRIDGE_TRUTH[data].values(), problems.ISOLATED_BRIDGE_NOISE[data]]
    step = 2.5e-3 if FAST else 1e-3
    return Problem(
        lambda: problems.isolated_bridge(data=data, step=step, cache=args.cache), np.array(truth), ("df_1", "df_2")
    )


PROBLEMS = {
    "column": Problem(
        lambda: problems.bridge_column(data="short", substeps=1 if FAST else 2, cache=args.cache),
        np.array(list(problems.bridge_column_data("short").attributes["truth"].values())),
        ("Ec", "ft"),
    ),
    "bridge": bridge("twin"),
    "means": bridge("means"),
}
few = {"max_moves": 3} if FAST and args.walkers < 250 else {}
SAMPLERS = {
    "SMC": (SMCSampler, few),
    "TMCMC": (TMCMCSampler, {"burn_in": 1} if few else {}),
    "TMCMC as published": (TMCMCSampler, presets.CHING_CHEN_2007),
}
EMCEE_WALKERS = 24 if FAST else 64
GUIDED_WALKERS = 24 if FAST else 100
GUIDED = "SMC with a guide"
COLOURS = {"SMC": "#1f5a8c", "TMCMC": "#d9822b", GUIDED: "#5b8c5a", "emcee": "#7b5ea7"}  # those of plot_corner
COLOURS |= {"TMCMC as published": "#b03a48", "emcee from the prior": "#6b4a2f"}


# %%
# Sampling: the same lines for all samplers
# -----------------------------------------
#
# With a guide, the run ends when the effective sample size of the weighted draws reaches the number of walkers.
# Therefore it has 100 walkers instead of 500, and makes one step: each further step needs up to 100 simulations more.
# The guide needs a posterior that knows the responses, not only log-probabilities. Nothing else is changed; the noise
# levels are sampled like the other parameters.


def make_sampler(label: str, posterior: Posterior, seed: int) -> SMCSampler | TMCMCSampler:
    """A tempered sampler of the posterior."""
    if label == GUIDED:
        return SMCSampler(
            GUIDED_WALKERS,
            posterior.ndim,
            posterior,
            vectorize=True,
            seed=seed,
            guide=posterior.guide(),
            max_simulations=args.max_simulations,
        )
    Sampler, settings = SAMPLERS[label]
    return Sampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **dict(settings))


class Run(NamedTuple):
    """A sampler that has run, what it cost, and its warnings."""

    sampler: emcee.EnsembleSampler
    seconds: float
    new: int  # simulations made by this run of the script
    needed: float  # simulations without a cache file
    warnings: list[str]


def sample(problem: Problem) -> tuple[Posterior, dict[str, Run]]:
    """Run every sampler on one problem; return its posterior, and the runs by sampler."""
    runs = {}
    for number, label in enumerate([*SAMPLERS, GUIDED]):
        posterior = problem.make()
        seed = args.seed + number
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            sampler = make_sampler(label, posterior, seed)
            sampler.run_mcmc(None, 1 if label == GUIDED else 4, progress=not FAST)
        messages = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
        new = posterior.report()["simulations"]
        runs[label] = Run(sampler, time.perf_counter() - begin, new, sampler.simulations, messages)
    rng = np.random.default_rng(args.seed)
    for label in ("emcee", "emcee from the prior"):
        posterior, begin, searched = problem.make(), time.perf_counter(), 0.0
        start = posterior.sample_prior(EMCEE_WALKERS, rng)
        if label == "emcee":
            search = find_modes(posterior, starts=1)
            start = StoredPosterior.from_search(search, posterior, EMCEE_WALKERS, args.seed).samples
            searched = search.simulations
        np.random.seed(args.seed)  # noqa: NPY002 - emcee uses NumPy's global generator
        sampler = emcee.EnsembleSampler(EMCEE_WALKERS, posterior.ndim, posterior, vectorize=True)
        chain_from = posterior.report()
        sampler.run_mcmc(start, args.steps, progress=not FAST)
        report = posterior.report()
        made = sum(report[each] - chain_from[each] for each in ("simulations", "disk_hits"))
        messages = [
            str(each) for each in check_result(sampler, discard=args.steps // 3).findings if each.severity == "wrong"
        ]
        runs[label] = Run(sampler, time.perf_counter() - begin, report["simulations"], searched + made, messages)
    return posterior, runs


def draws(label: str, sampler) -> np.ndarray:
    """Samples of the posterior, without the first third of the chain of emcee."""
    return sampler.get_chain(flat=True, discard=args.steps // 3 if label.startswith("emcee") else 0)


def effective_size(label: str, sampler) -> float:
    """Effective sample size of the worst parameter, from the errors of the means or the autocorrelation of emcee."""
    x = draws(label, sampler)
    if label.startswith("emcee"):
        return len(x) / np.max(sampler.get_autocorr_time(discard=args.steps // 3, tol=0))
    return float(np.min((x.std(axis=0) / sampler.mean_error()) ** 2))


def size_by_error(label: str, runs: dict[str, Run]) -> float:
    """Effective sample size by the errors of the means: as many independent draws have such errors.

    The means are compared with those of SMC, and those of SMC with those of TMCMC. An effective sample size of a chain
    comes from its autocorrelation, and cannot count a mode that is missing; this one does.
    """
    x, reference = (draws(name, runs[name].sampler) for name in (label, "TMCMC" if label == "SMC" else "SMC"))
    return float(1.0 / np.mean(((x.mean(axis=0) - reference.mean(axis=0)) / reference.std(axis=0)) ** 2))


def other_mode(posterior: Posterior, truth: np.ndarray) -> np.ndarray:
    """The true parameters with the devices of the two piers exchanged: the second mode."""
    return np.append(posterior.likelihood.model.exchange_piers(truth[:10]), truth[10])


def draw_corner(name: str, problem: Problem, posterior: Posterior, runs: dict[str, Run]) -> None:
    """Corner plot of the samplers whose result is reliable, on common axes."""
    shown = ["SMC", "TMCMC", GUIDED]
    if runs[GUIDED].sampler.verdict.status == "not usable":
        shown.remove(GUIDED)
    if name != "means":  # where emcee has one mode, or walkers at many places
        shown.append("emcee")
    points = {label: draws(label, runs[label].sampler) for label in shown}
    title = f"{name} (synthetic data)" + (f"\n{TOO_SHORT}" if FAST else "")
    plot_corner(points, posterior, truths=problem.truth, title=title).savefig(args.out / f"corner_{name}.png", dpi=80)


def plot_failures(name: str, problem: Problem, posterior: Posterior, runs: dict[str, Run]) -> None:
    """Samples of two parameters, one panel per sampler on common axes, with the known errors in the titles."""
    i, j = (posterior.parameter_names.index(parameter) for parameter in problem.pair)
    trusted = np.concatenate([draws(label, runs[label].sampler) for label in ("SMC", "TMCMC")])[:, [i, j]]
    distinct = [np.unique(draws(label, run.sampler), axis=0) for label, run in runs.items()]
    everything = np.concatenate(distinct)[:, [i, j]]
    low, high = np.quantile(everything, [0.01, 0.99], axis=0)
    modes = [problem.truth, *([other_mode(posterior, problem.truth)] if name == "means" else [])]
    inside = np.concatenate([trusted, np.array(modes)[:, [i, j]]])
    low, high = np.minimum(low, inside.min(axis=0)), np.maximum(high, inside.max(axis=0))
    low, high = low - 0.08 * (high - low), high + 0.08 * (high - low)
    figure, panels = plt.subplots(
        1, len(runs), figsize=(3.1 * len(runs), 3.9), sharex=True, sharey=True, layout="constrained"
    )
    for axes, (label, run) in zip(panels, runs.items(), strict=True):
        x = draws(label, run.sampler)
        share = len(np.unique(x, axis=0)) / len(x)
        size = 5 if label == GUIDED else 3  # fewer points
        axes.plot(x[:, i], x[:, j], ".", color=COLOURS[label], markersize=size, alpha=0.5, markeredgewidth=0)
        axes.plot(problem.truth[i], problem.truth[j], "+", color="k", markersize=11, label="truth (synthetic)")
        text = f"{run.needed:.0f} simulations\n{100 * share:.0f} % of {len(x)} points distinct"
        if name == "means":
            axes.plot(modes[1][i], modes[1][j], "x", color="k", markersize=8, label="piers exchanged: equally likely")
            text += f"\n{100 * np.mean(x[:, i] < x[:, j]):.0f} % in the true mode (+)"
        text += "\nwarning (see the output)" if run.warnings else "\nno warning"
        axes.set_title(f"{label}\n{text}", fontsize="small", color=COLOURS[label])
        axes.set(xlabel=f"{problem.pair[0]} [x nominal]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(f"{problem.pair[1]} [x nominal]")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize="small", loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(f"{name} (synthetic data)" + (f"\n{TOO_SHORT}" if FAST else ""), fontsize="medium")
    figure.savefig(args.out / f"wrong_{name}.png", dpi=90)


# %%
# Results
# -------
#
# For every problem: tables of the samplers and of their posteriors, the warnings and verdicts, a corner plot of the
# samplers whose result is reliable, and one panel per sampler that shows where samplers fail.
#
# Simulations are what a slow model costs; the search of the guide is included.
# emcee has no verdict; the warnings of its runs are what `check_result` finds against their chains. Its effective
# sample size does not count what is missed: the runs from the mode and from the prior can have the same effective
# sample size, although the second one is far from the posterior. The last column counts it: the effective sample size
# by the errors of the means.

results = {}
for name in args.problem or PROBLEMS:
    problem = PROBLEMS[name]
    posterior, runs = sample(problem)
    print(f"\n=== {name}: {posterior.likelihood.measurements.description}")
    samplers = {label: run.sampler for label, run in runs.items()}
    sizes = {label: effective_size(label, sampler) for label, sampler in samplers.items()}
    names = f"{'simulations':>12}{'per effective sample':>22}{'size by errors':>16}"
    print(f"{'':<20}{'seconds':>8}{'log-evidence':>14}{names}")
    for label, run in runs.items():
        evidence = f"{getattr(run.sampler, 'log_evidence', np.nan):14.2f}{run.needed:12.0f}"
        each, by_error = run.needed / max(sizes[label], 1.0), size_by_error(label, runs)
        print(f"{label:<20}{run.seconds:8.3g}{evidence}{each:22.1f}{by_error:16.2g}")
    print()
    lines = [f"{'':<20}" + "".join(f"{n[:11]:>12}" for n in posterior.parameter_names)]
    lines.append(f"{'truth':<20}" + "".join(f"{value:12.4g}" for value in problem.truth))
    for label, sampler in samplers.items():
        x = draws(label, sampler)
        lines.append(f"{label:<20}" + "".join(f"{value:12.4g}" for value in x.mean(axis=0)))
        lines.append(f"{'  sd':<20}" + "".join(f"{value:12.2g}" for value in x.std(axis=0)))
    print("\n".join(lines))
    for label, run in runs.items():
        for message in run.warnings:
            print(f"warning of {label}: {message}")
        if not label.startswith("emcee"):
            print(f"verdict of {label}: {run.sampler.verdict}")
    if name == "means":
        truth, other = problem.truth, other_mode(posterior, problem.truth)
        odds = np.exp(posterior.log_prior(truth) - posterior.log_prior(other))
        print(f"weight of the mode with df_1 < df_2 (about {odds / (1 + odds):.2f} by the prior at the two modes):")
        for label, sampler in samplers.items():
            x = draws(label, sampler)
            print(f"  {label:<20} {np.mean(x[:, 1] < x[:, 4]):.2f}")
    results[name] = {
        label: {
            "mean": draws(label, run.sampler).mean(axis=0).tolist(),
            "sd": draws(label, run.sampler).std(axis=0).tolist(),
            "new_simulations": run.new,
            "simulations": run.needed,
            "seconds": run.seconds,
            "log_evidence": float(getattr(run.sampler, "log_evidence", np.nan)),
            "verdict": None if label.startswith("emcee") else run.sampler.verdict.status,
            "warnings": run.warnings,
        }
        for label, run in runs.items()
    }

    draw_corner(name, problem, posterior, runs)
    plot_failures(name, problem, posterior, runs)

(args.out / "comparison.json").write_text(json.dumps(results, indent=2) + "\n")
total = sum(run["new_simulations"] for problem in results.values() for run in problem.values())
print(f"\n{total} simulations in total; figures and comparison.json are in {args.out}/")
