"""
Strengthen a column, leave it, or measure first?
================================================

A decision needs the annual rate of each damage state: hazard times fragility. The parameters of the column are
uncertain, so each sample of them has rates and losses of its own:

* `propagate` gives the peak displacement of each sample under motions of growing strength;
* numpy integrates the exceedance of two limits over a hazard curve, and adds costs: the loss of each option;
* the same losses tell what it is worth to know a parameter, or the data of a test, before the decision.

**The column is the bundled synthetic one, and the hazard curve, the costs and the model error are assumed.** ::

    python tutorials/14_decisions.py            # 400 samples, about a minute
    python tutorials/14_decisions.py --fast     # 60 samples, seconds; its numbers are not results
"""

import argparse
import json
import os
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import ndtr

from fe_likelihoods import peak, problems, propagate, rank_sensors

parser = argparse.ArgumentParser(description="Choose between strengthening, leaving, and a test.")
parser.add_argument("--fast", action="store_true", default=bool(os.environ.get("FAST")), help="few samples")
parser.add_argument("--out", type=Path, default=Path("results-decisions"), help="folder of the results")
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)
N = 60 if args.fast else 400
if args.fast:
    print("REDUCED SETTING (fast): few samples; these numbers are not results")

# %%
# Peaks of each sample
# --------------------
#
# The samples are draws of the prior, because the column is not measured yet; after a run, take the samples of the
# posterior. The intensity is the peak ground acceleration. Between two motions, and beyond the strongest one, peaks are
# a power law of the intensity; below the weakest one they are proportional to it. A measured peak is the predicted one
# times a lognormal ratio.

problem = problems.bridge_column(data="short")
column, prior = problem.likelihood.model, problem.prior.subset(problem.likelihood.model.parameter_names)
samples = prior.rvs(N, random_state=1)
factors = (0.8, 1.2, 1.8, 2.7, 4.0)
pga = np.array([np.abs(column.loading.acceleration).max() * factor for factor in factors])
options = {"quantity": peak("displacement"), "from_state": "virgin", "quantiles": (0.5,), "progress": False}
peaks = np.array([propagate(column, samples, record=column.loading.scale(k), **options).values for k in factors])
points = np.log([pga[0] / 2.0, *pga]), np.log([peaks[0] / 2.0, *peaks])
log_peak = make_interp_spline(*points, k=1)  # (n_intensities,) -> (n_intensities, N)
MODEL_ERROR = 0.2  # standard deviation of the log ratio
LIMITS, COSTS = {"repair": 0.10, "replacement": 0.25}, {"repair": 1.0, "replacement": 10.0}  # limits [m]

# %%
# Rates and losses
# ----------------
#
# The hazard curve is the annual rate H(s) at which an intensity s is exceeded, a power law between its points and
# beyond them. A state with the fragility P(s) is reached at the rate :math:`\int P\,|dH|`. For a lognormal P and
# :math:`H = c\,s^{-k}`, this is :math:`c\,m^{-k} e^{k^2\beta^2/2}` (Cornell et al. 2002,
# doi:10.1061/(ASCE)0733-9445(2002)128:4(526)), which checks the sum.

HAZARD = np.array([1.0, 4.0, 15.0]), np.array([0.05, 0.005, 1e-4])  # peak ground acceleration [m/s²], rate [1/year]
s = np.geomspace(0.05, 500.0, 4001)
middle = np.sqrt(s[1:] * s[:-1])
events = -np.diff(np.exp(make_interp_spline(*np.log(HAZARD), k=1)(np.log(s))))  # annual rate of each interval


def fragility(limit: float, strength: float = 1.0) -> np.ndarray:
    """Probability (n_intensities, N) that a peak exceeds `limit` [m], in a column stronger by the factor `strength`."""
    return ndtr((log_peak(np.log(middle / strength)) - np.log(limit)) / MODEL_ERROR)


def annual_loss(strength: float) -> np.ndarray:
    """Expected loss per year of each sample (N,): each event costs what its severest state costs."""
    repair, replacement = (events @ fragility(limit, strength) for limit in LIMITS.values())
    return COSTS["repair"] * (repair - replacement) + COSTS["replacement"] * replacement


power_law = -np.diff(1e-3 * s**-2.5) @ ndtr(np.log(middle / 3.0) / 0.4)
closed_form = 1e-3 * 3.0**-2.5 * np.exp(0.5 * (2.5 * 0.4) ** 2)
print(f"one power law: the sum is {power_law / closed_form - 1.0:+.1e} beside the closed form")
rates = {name: events @ fragility(limit) for name, limit in LIMITS.items()}
for name, rate in rates.items():
    ends = "{:.2g} to {:.2g}".format(*np.quantile(rate, [0.05, 0.95]))
    print(f"{name}: {rate.mean():.3g} ± {rate.std() / np.sqrt(N):.2g} per year, 90 % of samples {ends}")

# %%
# The decision, and what information is worth
# -------------------------------------------
#
# Strengthening costs 0.1 and makes the column 1.5 times as strong, for 50 years. With x known before the choice, the
# expected loss falls by :math:`V(x) = \min_d E[L_d] - E_x[\min_d E[L_d | x]]`. The conditional mean is a regression
# on x, so that nothing is simulated again (Strong, Oakley & Brennan 2014, doi:10.1177/0272989X13505910). Each tenth of
# the samples is decided by a regression on the others: otherwise noise would seem to be worth something.

more = 0.1 + 50.0 * (annual_loss(1.5) - annual_loss(1.0))  # loss of strengthening, beyond that of leaving
print(f"strengthening costs {more.mean():.3g} ± {more.std() / np.sqrt(N):.2g} more than leaving the column as it is")


def worth(decided: np.ndarray) -> list[float]:
    """Mean loss that the decisions (N,) avoid, beside the same decision for all samples, with its standard error."""
    avoided = more * (more.mean() < 0.0) - more * decided
    return [float(avoided.mean()), float(avoided.std() / np.sqrt(N))]


def decide(data: np.ndarray) -> np.ndarray:
    """Whether each sample is strengthened if its row of `data` (N, k) is known, by quadratic regressions."""
    z = (data - data.mean(axis=0)) / data.std(axis=0)
    terms = np.column_stack([np.ones(N), z, *(z[:, [i]] * z[:, i:] for i in range(z.shape[1]))])
    part, expected = np.random.default_rng(0).permutation(N) % 10, np.empty(N)
    for here in (part == k for k in range(10)):
        expected[here] = terms[here] @ np.linalg.lstsq(terms[~here], more[~here], rcond=None)[0]
    return expected < 0.0


# A test with the motion of ten seconds: its data tell the coordinates with errors of the precision of a sensor.
coords, rng = prior.to_normal(samples), np.random.default_rng(2)
ranking = rank_sensors(column, prior, noise=0.1, effective_samples=50, draws=2 if args.fast else 16)
precision, directions = np.linalg.eigh(ranking.precisions["displacement"])
data = coords @ directions + rng.standard_normal(coords.shape) / np.sqrt(np.maximum(precision, 1e-9))
known = {name: coords[:, [k]] for k, name in enumerate(prior.names)}
known |= {"test: displacement": data[:, precision > 0.1], "noise": rng.standard_normal((N, 1))}
values = {"everything": worth(more < 0.0)} | {name: worth(decide(each)) for name, each in known.items()}
for name, each in values.items():
    print("{:>20} {:8.4f} ± {:.2g}".format(name, *each))

fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for color, (name, limit) in zip(("C0", "C3"), LIMITS.items(), strict=True):
    left.plot(middle, fragility(limit)[:, :30], color=color, lw=0.5, alpha=0.3)
    left.plot(middle, fragility(limit).mean(axis=1), color=color, lw=2.0, label=f"{name}: {100 * limit:.0f} cm")
left.set(xscale="log", xlim=(1.0, 40.0), xlabel="peak ground acceleration [m/s²]", ylabel="P(peak exceeds the limit)")
left.legend(loc="upper left")
value, error = np.transpose(list(values.values()))
right.barh(list(values), value, xerr=error)
right.invert_yaxis()
right.set_xlabel("worth before the decision [cost of a repair]")
fig.savefig(args.out / "decisions.png", dpi=150)
summary = {"sum": power_law / closed_form, "rates": {name: rate.mean() for name, rate in rates.items()}}
summary |= {"more": more.mean(), "values": values}
(args.out / "summary.json").write_text(json.dumps(summary, indent=1))
