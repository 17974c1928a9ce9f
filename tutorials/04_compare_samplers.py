"""
SMC, TMCMC and emcee on the same posterior
==========================================

Three samplers are exchanged by changing one name. They sample the bridge column and the isolated bridge (synthetic
data for both, assumed nominal values for the bridge). The tutorial shows what each sampler needs, what it returns,
and where it fails::

    python tutorials/04_compare_samplers.py                          # all three problems
    python tutorials/04_compare_samplers.py --problem column         # one of them
    python tutorials/04_compare_samplers.py --cache simulations.db   # a second run needs no simulation

**Where samplers fail** is visible in the figures ``wrong_*.png`` and in the warnings:

* TMCMC as published makes too few moves after resampling, which duplicates points. Few distinct points and a wrong
  evidence are left.
* emcee stays in the mode in which it starts. Nothing in its chain shows that there is another mode.
* emcee walkers that start from the prior get stuck at many places.

The cache stores sums of squared residuals by parameters. Equal seeds lead to equal simulations, so a repeated or an
interrupted run finds all previous simulations in the cache.

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

import corner
import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D

from fe_likelihoods import Posterior, problems
from samplers import CHING_CHEN_2007, SamplingWarning, SMCSampler, TMCMCSampler, comparison_table

FAST = bool(os.environ.get("FAST"))
parser = argparse.ArgumentParser(description="Compare SMC, TMCMC and emcee; write tables and figures to a folder.")
parser.add_argument("--problem", choices=("column", "bridge", "means"), action="append", help="default: all three")
parser.add_argument("--walkers", type=int, default=40 if FAST else 500, help="walkers of SMC and TMCMC")
parser.add_argument("--cache", type=Path, help="file of the simulation cache; created if it does not exist")
parser.add_argument("--steps", type=int, default=40 if FAST else 1500, help="steps of emcee")
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
# its walkers do not find such narrow posteriors. It therefore starts in a small ball around the true values, which are
# unknown in a real application. For the data with two modes it starts once in a ball in one of them, and once from the
# prior.


class Problem(NamedTuple):
    """A posterior, the true parameters of its synthetic data, and two parameters that show where samplers fail."""

    make: Callable[[], Posterior]
    truth: np.ndarray
    pair: tuple[str, str]


def bridge(data: str) -> Problem:
    """The isolated bridge with time steps of 1 ms."""
    truth = [*problems.ISOLATED_BRIDGE_TRUTH[data].values(), problems.ISOLATED_BRIDGE_NOISE[data]]
    return Problem(
        lambda: problems.isolated_bridge(data=data, step=1e-3, cache=args.cache), np.array(truth), ("df_1", "df_2")
    )


column_truth = np.array([*problems.BRIDGE_COLUMN_MEANS.values(), *problems.BRIDGE_COLUMN_NOISE.values()])
PROBLEMS = {
    "column": Problem(
        lambda: problems.bridge_column(every=16 if FAST else 8, cache=args.cache), column_truth, ("Ec", "ft")
    ),
    "bridge": bridge("twin"),
    "means": bridge("means"),
}
few = {"max_moves": 3} if FAST else {}
SAMPLERS = {
    "SMC": (SMCSampler, few),
    "TMCMC": (TMCMCSampler, few),
    "TMCMC as published": (TMCMCSampler, CHING_CHEN_2007),
}
EMCEE_WALKERS = 24 if FAST else 64
COLOURS = {"SMC": "#1f5a8c", "TMCMC": "#d9822b", "TMCMC as published": "#b03a48"}
COLOURS |= {"emcee": "#5b8c5a", "emcee from the prior": "#7b5ea7"}


# %%
# Sampling: the same lines for all samplers
# -----------------------------------------


def sample(name: str, problem: Problem):
    """Run every sampler on one problem; return a posterior, and runs, seconds, simulations and warnings by sampler."""
    runs, seconds, simulations, messages = {}, {}, {}, {}
    for number, (label, (Sampler, settings)) in enumerate(SAMPLERS.items()):
        posterior = problem.make()
        seed = args.seed + number  # different seeds: with few walkers SMC makes the same moves as TMCMC
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            sampler = Sampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **dict(settings))
            sampler.run_mcmc(None, 4, progress=not FAST)
        runs[label], seconds[label] = sampler, time.perf_counter() - begin
        simulations[label] = posterior.report()["simulations"]
        messages[label] = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
    rng = np.random.default_rng(args.seed)
    ball = problem.truth * (1.0 + 0.005 * rng.standard_normal((EMCEE_WALKERS, posterior.ndim)))
    starts = {"emcee": ball}
    if name == "means":
        starts["emcee from the prior"] = posterior.sample_prior(EMCEE_WALKERS, rng)
    for label, start in starts.items():
        posterior = problem.make()
        np.random.seed(args.seed)  # noqa: NPY002 - emcee uses NumPy's global generator
        begin = time.perf_counter()
        sampler = emcee.EnsembleSampler(EMCEE_WALKERS, posterior.ndim, posterior, vectorize=True)
        sampler.run_mcmc(start, args.steps, progress=not FAST)
        runs[label], seconds[label] = sampler, time.perf_counter() - begin
        simulations[label], messages[label] = posterior.report()["simulations"], []
    return posterior, runs, seconds, simulations, messages


def draws(label: str, sampler) -> np.ndarray:
    """Samples of the posterior, without the first third of the chain of emcee."""
    return sampler.get_chain(flat=True, discard=args.steps // 3 if label.startswith("emcee") else 0)


def other_mode(posterior: Posterior, truth: np.ndarray) -> np.ndarray:
    """The true parameters with the devices of the two piers exchanged: the second mode."""
    return np.append(posterior.likelihood.model.exchange_piers(truth[:10]), truth[10])


def plot_failures(name: str, problem: Problem, posterior: Posterior, runs: dict, messages: dict) -> None:
    """Samples of two parameters, one panel per sampler on common axes, with the known errors in the titles."""
    i, j = (posterior.parameter_names.index(parameter) for parameter in problem.pair)
    trusted = np.concatenate([draws(label, runs[label]) for label in ("SMC", "TMCMC")])[:, [i, j]]
    everything = np.concatenate([np.unique(draws(label, run), axis=0) for label, run in runs.items()])[:, [i, j]]
    low, high = np.quantile(everything, [0.01, 0.99], axis=0)
    modes = [problem.truth, *([other_mode(posterior, problem.truth)] if name == "means" else [])]
    inside = np.concatenate([trusted, np.array(modes)[:, [i, j]]])
    low, high = np.minimum(low, inside.min(axis=0)), np.maximum(high, inside.max(axis=0))
    low, high = low - 0.08 * (high - low), high + 0.08 * (high - low)
    figure, panels = plt.subplots(
        1, len(runs), figsize=(3.1 * len(runs), 3.9), sharex=True, sharey=True, layout="constrained"
    )
    for axes, (label, run) in zip(panels, runs.items(), strict=True):
        x = draws(label, run)
        share = len(np.unique(x, axis=0)) / len(x)
        axes.plot(x[:, i], x[:, j], ".", color=COLOURS[label], markersize=3, alpha=0.5, markeredgewidth=0)
        axes.plot(problem.truth[i], problem.truth[j], "+", color="k", markersize=11, label="truth (synthetic)")
        text = f"{100 * share:.0f} % distinct points"
        if name == "means":
            axes.plot(modes[1][i], modes[1][j], "x", color="k", markersize=8, label="piers exchanged: equally likely")
            text += f"\n{100 * np.mean(x[:, i] < x[:, j]):.0f} % in the true mode (+)"
        text += "\nwarning (see the output)" if messages[label] else "\nno warning"
        axes.set_title(f"{label}\n{text}", fontsize="small", color=COLOURS[label])
        axes.set(xlabel=f"{problem.pair[0]} [x nominal]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(f"{problem.pair[1]} [x nominal]")
    panels[0].legend(fontsize="x-small", loc="lower left")
    figure.suptitle(f"{name} (synthetic data)" + (f"\n{TOO_SHORT}" if FAST else ""), fontsize="medium")
    figure.savefig(args.out / f"wrong_{name}.png", dpi=90)


# %%
# Results
# -------
#
# For every problem: a table of the samplers, a table of the posteriors, the warnings, a corner plot of the samplers
# whose result is reliable, and one panel per sampler that shows where samplers fail.

results = {}
for name in args.problem or PROBLEMS:
    problem = PROBLEMS[name]
    posterior, runs, seconds, simulations, messages = sample(name, problem)
    print(f"\n=== {name}: {posterior.likelihood.measurements.description}")
    emcee_seconds = {label: value for label, value in seconds.items() if label.startswith("emcee")}
    print(comparison_table(runs, emcee_seconds, discard=args.steps // 3))
    lines = [f"{'':<20}" + "".join(f"{n[:11]:>12}" for n in posterior.parameter_names)]
    lines.append(f"{'truth':<20}" + "".join(f"{value:12.4g}" for value in problem.truth))
    for label, sampler in runs.items():
        x = draws(label, sampler)
        lines.append(f"{label:<20}" + "".join(f"{value:12.4g}" for value in x.mean(axis=0)))
        lines.append(f"{'  sd':<20}" + "".join(f"{value:12.2g}" for value in x.std(axis=0)))
    print("\n".join(lines))
    for label, own in messages.items():
        for message in own:
            print(f"warning of {label}: {message}")
    if name == "means":
        truth, other = problem.truth, other_mode(posterior, problem.truth)
        odds = np.exp(posterior.log_prior(truth) - posterior.log_prior(other))
        print(f"weight of the mode with df_1 < df_2 (about {odds / (1 + odds):.2f} by the prior at the two modes):")
        for label, sampler in runs.items():
            x = draws(label, sampler)
            print(f"  {label:<20} {np.mean(x[:, 1] < x[:, 4]):.2f}")
    results[name] = {
        label: {
            "mean": draws(label, sampler).mean(axis=0).tolist(),
            "sd": draws(label, sampler).std(axis=0).tolist(),
            "simulations": simulations[label],
            "seconds": seconds[label],
            "log_evidence": float(getattr(sampler, "log_evidence", np.nan)),
            "warnings": messages[label],
        }
        for label, sampler in runs.items()
    }

    # corner plots of the reliable samplers on common axes
    shown = [label for label in runs if label != "TMCMC as published"]
    if name == "means":
        shown = ["SMC", "TMCMC"]  # emcee has one mode, or walkers at many places
    pool = np.concatenate([draws(label, runs[label]) for label in shown])
    low, high = np.quantile(pool, [0.001, 0.999], axis=0)
    low, high = np.minimum(low, problem.truth), np.maximum(high, problem.truth)
    limits = list(zip(low - 0.02 * (high - low), high + 0.02 * (high - low), strict=True))
    figure = None
    for label in shown:
        x = draws(label, runs[label])
        figure = corner.corner(
            x,
            fig=figure,
            labels=posterior.parameter_names,
            range=limits,
            color=COLOURS[label],
            weights=np.full(len(x), 1.0 / len(x)),
            plot_datapoints=False,
            plot_density=False,
            fill_contours=False,
            levels=(0.5, 0.9),
            smooth=1.0,
            truths=problem.truth,
            truth_color="0.6",
            label_kwargs={"fontsize": 16},
            max_n_ticks=3,
        )
    for axes in figure.axes[:: posterior.ndim + 1]:  # corner scales each diagonal panel to the last histogram only
        axes.set_ylim(0.0, 1.1 * max(patch.get_xy()[:, 1].max() for patch in axes.patches))
    handles = [Line2D([], [], color=COLOURS[label], label=label) for label in shown]
    figure.legend(handles=handles, loc="upper right", fontsize=22, frameon=False)
    title = f"{name}: contours contain 50 and 90 % (synthetic data; grey: truth)"
    figure.suptitle(title + (f"\n{TOO_SHORT}" if FAST else ""), fontsize=22, color="#b03a48" if FAST else "k")
    figure.savefig(args.out / f"corner_{name}.png", dpi=70)
    plot_failures(name, problem, posterior, runs, messages)

(args.out / "comparison.json").write_text(json.dumps(results, indent=2) + "\n")
total = sum(run["simulations"] for problem in results.values() for run in problem.values())
print(f"\n{total} simulations in total; figures and comparison.json are in {args.out}/")
