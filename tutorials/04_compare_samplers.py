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
from fe_likelihoods.posterior import Posterior
from samplers import CHING_CHEN_2007, SMCSampler, TMCMCSampler
from samplers.alarms import SamplingWarning
from samplers.report import comparison_table

FAST = bool(os.environ.get("FAST"))
parser = argparse.ArgumentParser(description="Compare SMC, TMCMC and emcee; tables and figures into a folder.")
parser.add_argument("--problem", choices=("column", "bridge", "means"), action="append", help="default: all three")
parser.add_argument("--walkers", type=int, default=40 if FAST else 500, help="of SMC and TMCMC")
parser.add_argument("--cache", type=Path, help="file of simulations, made where there is none")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--out", type=Path, default=Path("results-comparison"))
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)


# %% [markdown]
# ## The problems
#
# Cheaper than in tutorials 02 and 03 (longer steps), the same for all samplers. emcee has no ladder: from the prior its
# walkers do not find such narrow posteriors, so it is given a ball around the truth, which nobody has in earnest. On
# the data with two modes it is given the prior, to show what that does.


# %%
class Problem(NamedTuple):
    """A posterior, the truth of its synthetic data, and where emcee starts."""

    make: Callable[[], Posterior]
    truth: np.ndarray
    start_at_truth: bool


def bridge(data: str) -> Problem:
    """The isolated bridge with steps of 1 ms."""
    truth = [*problems.ISOLATED_BRIDGE_TRUTH[data].values(), problems.ISOLATED_BRIDGE_NOISE[data]]
    return Problem(
        lambda: problems.isolated_bridge(data=data, step=1e-3, cache=args.cache), np.array(truth), data == "twin"
    )


column_truth = np.array([*problems.BRIDGE_COLUMN_MEANS.values(), *problems.BRIDGE_COLUMN_NOISE.values()])
PROBLEMS = {
    "column": Problem(
        lambda: problems.bridge_column(every=16 if FAST else 8, cache=args.cache), column_truth, start_at_truth=True
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
EMCEE_WALKERS, EMCEE_STEPS = (24, 40) if FAST else (64, 1500)
COLOURS = {"SMC": "#1f5a8c", "TMCMC": "#d9822b", "TMCMC as published": "#b03a48", "emcee": "#5b8c5a"}

# %% [markdown]
# ## Sampling: the same lines for all


# %%
def sample(name: str, problem: Problem):
    """Every sampler on one problem: samplers, seconds, simulations, alarms."""
    runs, seconds, simulations, alarms = {}, {}, {}, {}
    for label, (Sampler, settings) in SAMPLERS.items():
        posterior = problem.make()
        begin = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            sampler = Sampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=args.seed, **dict(settings))
            sampler.run_mcmc(None, 4, progress=not FAST)
        runs[label], seconds[label] = sampler, time.perf_counter() - begin
        simulations[label] = posterior.report()["simulations"]
        alarms[label] = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
    posterior = problem.make()
    rng = np.random.default_rng(args.seed)
    if problem.start_at_truth:
        start = problem.truth * (1.0 + 0.005 * rng.standard_normal((EMCEE_WALKERS, posterior.ndim)))
    else:
        start = posterior.sample_prior(EMCEE_WALKERS, rng)
    np.random.seed(args.seed)  # noqa: NPY002 - the generator of emcee
    begin = time.perf_counter()
    sampler = emcee.EnsembleSampler(EMCEE_WALKERS, posterior.ndim, posterior, vectorize=True)
    sampler.run_mcmc(start, EMCEE_STEPS, progress=not FAST)
    runs["emcee"], seconds["emcee"] = sampler, time.perf_counter() - begin
    simulations["emcee"], alarms["emcee"] = posterior.report()["simulations"], []
    return posterior, runs, seconds, simulations, alarms


def draws(label: str, sampler) -> np.ndarray:
    """Samples of the posterior; the first third of emcee's chain is left out."""
    return sampler.get_chain(flat=True, discard=EMCEE_STEPS // 3 if label == "emcee" else 0)


# %% [markdown]
# ## What each needed and gave

# %%
results = {}
for name in args.problem or PROBLEMS:
    problem = PROBLEMS[name]
    posterior, runs, seconds, simulations, alarms = sample(name, problem)
    print(f"\n=== {name}: {posterior.likelihood.measurements.description}")
    print(comparison_table(runs, {"emcee": seconds["emcee"]}, discard=EMCEE_STEPS // 3))
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
        model = posterior.likelihood.model
        truth = np.append(problem.truth[:10], problem.truth[10])
        other = np.append(model.exchanged(problem.truth[:10]), problem.truth[10])
        odds = np.exp(posterior.log_prior(truth) - posterior.log_prior(other))
        print(f"weight of the mode with df_1 < df_2 (about {odds / (1 + odds):.2f} by the prior at the two summits):")
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
        shown.remove("emcee")  # its walkers are all over the prior
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
            truths=problem.truth,
            truth_color="0.6",
        )
    handles = [Line2D([], [], color=COLOURS[label], label=label) for label in shown]
    figure.legend(handles=handles, loc="upper right", fontsize=22, frameon=False)
    figure.suptitle(f"{name}: contours hold 50 and 90 % (synthetic data)", fontsize=22)
    figure.savefig(args.out / f"corner_{name}.png", dpi=70)
    plt.close(figure)

(args.out / "comparison.json").write_text(json.dumps(results, indent=2) + "\n")
total = sum(run["simulations"] for problem in results.values() for run in problem.values())
print(f"\n{total} simulations in all; figures and comparison.json are in {args.out}/")
