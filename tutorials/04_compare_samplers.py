# %% [markdown]
# # SMC, TMCMC and emcee compared: one posterior, one interface
#
# Three samplers are swapped by changing one name. Here they sample the bridge column and the isolated bridge (synthetic
# data both, nominal values of the bridge assumed): what each needs, what each gives, and what goes wrong where.
#
#     python tutorials/04_compare_samplers.py                          # both systems and the data with two modes
#     python tutorials/04_compare_samplers.py --problem column         # one of them
#     python tutorials/04_compare_samplers.py --cache simulations.db   # a second run simulates nothing
#
# **What goes wrong where**, to be seen in the figures `wrong_*.png` and in the warnings: TMCMC as published moves its
# points too little to forget the copies that resampling makes, so that few distinct points and a wrong evidence are
# left; emcee stays in the mode in which it starts, and nothing in its chain says that there is another one; put over
# the whole prior, its walkers get stuck all over it. `FAST=1` runs everything in a minute and says that it is too short
# for a posterior: its numbers are no results.
#
# What is kept in the cache are sums of squared residuals by parameters: the same seeds ask for the same simulations, so
# a repeated or a killed run finds all that was simulated before.

# %%
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

from fe_likelihoods import problems
from fe_likelihoods.probability.posterior import Posterior
from samplers import CHING_CHEN_2007, SMCSampler, TMCMCSampler
from samplers.reporting.summary import comparison_table
from samplers.tempering.diagnostics import SamplingWarning

FAST = bool(os.environ.get("FAST"))
parser = argparse.ArgumentParser(description="Compare SMC, TMCMC and emcee; tables and figures into a folder.")
parser.add_argument("--problem", choices=("column", "bridge", "means"), action="append", help="default: all three")
parser.add_argument("--walkers", type=int, default=40 if FAST else 500, help="of SMC and TMCMC")
parser.add_argument("--cache", type=Path, help="file of simulations, made where there is none")
parser.add_argument("--steps", type=int, default=40 if FAST else 1500, help="of emcee")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--out", type=Path, default=Path("results-comparison"))
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)
TOO_SHORT = "FAST SETTING: few points, few moves, not converged; these are no results" if FAST else ""
print(TOO_SHORT)


# %% [markdown]
# ## The problems
#
# Cheaper than in tutorials 02 and 03 (longer steps), the same for all samplers. emcee has no ladder: from the prior its
# walkers do not find such narrow posteriors, so it is given a ball around the truth, which nobody has in earnest. On
# the data with two modes it is given a ball in one of them, and in another run the prior, to show what either does.


# %%
class Problem(NamedTuple):
    """A posterior, the truth of its synthetic data, and two parameters that show what goes wrong."""

    make: Callable[[], Posterior]
    truth: np.ndarray
    pair: tuple[str, str]


def bridge(data: str) -> Problem:
    """The isolated bridge with steps of 1 ms."""
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

# %% [markdown]
# ## Sampling: the same lines for all


# %%
def sample(name: str, problem: Problem):
    """Every sampler on one problem: samplers, seconds, simulations, alarms."""
    runs, seconds, simulations, alarms = {}, {}, {}, {}
    for number, (label, (Sampler, settings)) in enumerate(SAMPLERS.items()):
        posterior = problem.make()
        seed = args.seed + number  # of their own: with few walkers SMC makes the same moves as TMCMC
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            sampler = Sampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **dict(settings))
            sampler.run_mcmc(None, 4, progress=not FAST)
        runs[label], seconds[label] = sampler, time.perf_counter() - begin
        simulations[label] = posterior.report()["simulations"]
        alarms[label] = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
    rng = np.random.default_rng(args.seed)
    ball = problem.truth * (1.0 + 0.005 * rng.standard_normal((EMCEE_WALKERS, posterior.ndim)))
    starts = {"emcee": ball}
    if name == "means":
        starts["emcee from the prior"] = posterior.sample_prior(EMCEE_WALKERS, rng)
    for label, start in starts.items():
        posterior = problem.make()
        np.random.seed(args.seed)  # noqa: NPY002 - the generator of emcee
        begin = time.perf_counter()
        sampler = emcee.EnsembleSampler(EMCEE_WALKERS, posterior.ndim, posterior, vectorize=True)
        sampler.run_mcmc(start, args.steps, progress=not FAST)
        runs[label], seconds[label] = sampler, time.perf_counter() - begin
        simulations[label], alarms[label] = posterior.report()["simulations"], []
    return posterior, runs, seconds, simulations, alarms


def draws(label: str, sampler) -> np.ndarray:
    """Samples of the posterior; the first third of emcee's chain is left out."""
    return sampler.get_chain(flat=True, discard=args.steps // 3 if label.startswith("emcee") else 0)


def other_mode(posterior: Posterior, truth: np.ndarray) -> np.ndarray:
    """The truth of the data with two modes, with the devices of the piers exchanged."""
    return np.append(posterior.likelihood.model.exchanged(truth[:10]), truth[10])


def show_what_goes_wrong(name: str, problem: Problem, posterior: Posterior, runs: dict, alarms: dict) -> None:
    """Samples of two parameters, one panel a sampler on common axes, with what is known to be wrong."""
    i, j = (posterior.parameter_names.index(parameter) for parameter in problem.pair)
    trusted = np.concatenate([draws(label, runs[label]) for label in ("SMC", "TMCMC")])[:, [i, j]]
    everything = np.concatenate([np.unique(draws(label, run), axis=0) for label, run in runs.items()])[:, [i, j]]
    low, high = np.quantile(everything, [0.01, 0.99], axis=0)
    low, high = np.minimum(low, trusted.min(axis=0)), np.maximum(high, trusted.max(axis=0))
    low, high = low - 0.08 * (high - low), high + 0.08 * (high - low)
    figure, panels = plt.subplots(
        1, len(runs), figsize=(3.1 * len(runs), 3.9), sharex=True, sharey=True, layout="constrained"
    )
    for axes, (label, run) in zip(panels, runs.items(), strict=True):
        x = draws(label, run)
        share = len(np.unique(x, axis=0)) / len(x)
        axes.plot(x[:, i], x[:, j], ".", color=COLOURS[label], markersize=3, alpha=0.5, markeredgewidth=0)
        axes.plot(problem.truth[i], problem.truth[j], "+", color="k", markersize=11, label="truth (synthetic)")
        text = f"{100 * share:.0f} % of its points distinct"
        if name == "means":
            other = other_mode(posterior, problem.truth)
            axes.plot(other[i], other[j], "x", color="k", markersize=8, label="piers exchanged: as likely")
            text += f"\n{100 * np.mean(x[:, i] < x[:, j]):.0f} % in the mode of the truth (+)"
        text += "\nit WARNS (see the output)" if alarms[label] else "\nno warning"
        axes.set_title(f"{label}\n{text}", fontsize="small", color=COLOURS[label])
        axes.set(xlabel=f"{problem.pair[0]} [x nominal]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(f"{problem.pair[1]} [x nominal]")
    panels[0].legend(fontsize="x-small", loc="lower left")
    figure.suptitle(f"{name} (synthetic data)" + (f"\n{TOO_SHORT}" if FAST else ""), fontsize="medium")
    figure.savefig(args.out / f"wrong_{name}.png", dpi=90)
    plt.close(figure)


# %% [markdown]
# ## What each needed and gave

# %%
results = {}
for name in args.problem or PROBLEMS:
    problem = PROBLEMS[name]
    posterior, runs, seconds, simulations, alarms = sample(name, problem)
    print(f"\n=== {name}: {posterior.likelihood.measurements.description}")
    of_emcee = {label: value for label, value in seconds.items() if label.startswith("emcee")}
    print(comparison_table(runs, of_emcee, discard=args.steps // 3))
    lines = [f"{'':<20}" + "".join(f"{n[:11]:>12}" for n in posterior.parameter_names)]
    lines.append(f"{'truth':<20}" + "".join(f"{value:12.4g}" for value in problem.truth))
    for label, sampler in runs.items():
        x = draws(label, sampler)
        lines.append(f"{label:<20}" + "".join(f"{value:12.4g}" for value in x.mean(axis=0)))
        lines.append(f"{'  sd':<20}" + "".join(f"{value:12.2g}" for value in x.std(axis=0)))
    print("\n".join(lines))
    for label, messages in alarms.items():
        for message in messages:
            print(f"{label} WARNS: {message}")
    if name == "means":
        truth, other = problem.truth, other_mode(posterior, problem.truth)
        odds = np.exp(posterior.log_prior(truth) - posterior.log_prior(other))
        print(f"weight of the mode with df_1 < df_2 (by the prior at the two summits about {odds / (1 + odds):.2f}):")
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
            "alarms": alarms[label],
        }
        for label, sampler in runs.items()
    }

    # %% overlaid corner plots: of the samplers that are to be trusted, on common axes
    shown = [label for label in runs if label != "TMCMC as published"]
    if name == "means":
        shown = ["SMC", "TMCMC"]  # emcee has one mode, or walkers all over the prior
    pool = np.concatenate([draws(label, runs[label]) for label in shown])
    limits = [(low, high) for low, high in np.quantile(pool, [0.001, 0.999], axis=0).T]
    limits = [(low, high) if high > low else (low - 1e-9, low + 1e-9) for low, high in limits]
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
    handles = [Line2D([], [], color=COLOURS[label], label=label) for label in shown]
    figure.legend(handles=handles, loc="upper right", fontsize=22, frameon=False)
    title = f"{name}: contours hold 50 and 90 % (synthetic data; grey: truth)"
    figure.suptitle(title + (f"\n{TOO_SHORT}" if FAST else ""), fontsize=22, color="#b03a48" if FAST else "k")
    figure.savefig(args.out / f"corner_{name}.png", dpi=70)
    plt.close(figure)
    show_what_goes_wrong(name, problem, posterior, runs, alarms)

(args.out / "comparison.json").write_text(json.dumps(results, indent=2) + "\n")
total = sum(run["simulations"] for problem in results.values() for run in problem.values())
print(f"\n{total} simulations in all; figures and comparison.json are in {args.out}/\n{TOO_SHORT}")
