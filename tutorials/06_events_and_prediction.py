"""
Several earthquakes, and the prediction of the next one
=======================================================

A model that is calibrated with one earthquake predicts the next one too confidently: stiffness and damping of a
structure change from event to event, and one event does not show by how much. Several events do:

* each event is calibrated alone, and one sentence says how much the events differ;
* new events are predicted from one event, and from the population of all events;
* shares of new peaks inside the intervals, and scores, say which prediction is right.

**The data are synthetic**: a structure whose stiffness and damping vary between events. ::

    python tutorials/06_events_and_prediction.py
"""

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    StoredPosterior,
    Varying,
    event_ratios,
    from_si,
    peak,
    predict_new_event,
    problems,
    propagate,
    share_within,
)
from samplers import SMCSampler

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# Eight earthquakes of one structure
# ----------------------------------
#
# Between events, the logarithms of stiffness and damping have standard deviations of 0.08 and 0.2, which nobody knows
# who calibrates the model.

SPREAD, SENSOR = np.array([0.08, 0.2]), np.array([[0.05], [5e-4]])  # of logarithms; noise [m/s², m]


def earthquake(seed: int) -> tuple[Record, np.ndarray, Measurements]:
    """Base motion, true parameters and measured response of one event."""
    rng = np.random.default_rng([1, seed])
    record = problems.table_motion(seed).trim(0.0, 12.0).resample(0.02).scale(rng.uniform(0.9, 1.1))
    model, theta = LinearOscillator(record, period=0.6, damping_ratio=0.05), np.exp(SPREAD * rng.standard_normal(2))
    clean = model.simulate(theta)
    return record, theta, Measurements(model.channels, model.dt, clean + SENSOR * rng.standard_normal(clean.shape))


names = [f"E{k}" for k in range(1, 9)]
events = {name: earthquake(k) for k, name in enumerate(names)}
new_events = {f"new {k}": earthquake(100 + k) for k in range(1, 31)}

# %%
# Each event alone
# ----------------

posteriors, stored = {}, {}
prior = {"stiffness": LogNormal(1.0, 0.4), "damping": LogNormal(1.0, 0.5)}
prior |= {"sigma_acceleration": HalfNormal(1.0), "sigma_displacement": HalfNormal(0.01)}
for name, (record, _, measured) in events.items():
    model = LinearOscillator(record, period=0.6, damping_ratio=0.05)
    posteriors[name] = Posterior(FELikelihood(model, measured), prior).marginal()
    sampler = SMCSampler(300, 2, posteriors[name], vectorize=True, seed=1)
    sampler.run_mcmc(None, 2)
    stored[name] = StoredPosterior.from_run(sampler, posteriors[name])

figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for k, (axes, label) in enumerate(zip(panels, ("stiffness", "damping"), strict=True)):
    low, middle, high = np.transpose([np.quantile(each.samples[:, k], [0.05, 0.5, 0.95]) for each in stored.values()])
    axes.errorbar(names, middle, [middle - low, high - middle], fmt="o", capsize=3, label="median and 90 % interval")
    axes.plot(names, [theta[k] for _, theta, _ in events.values()], "kx", zorder=3, label="truth of the event")
    axes.set(ylabel=f"{label} [x nominal]", title="each event calibrated alone")
panels[0].legend()
figure.savefig("events.png")

# %%
# The population
# --------------
#
# `HierarchicalPosterior` is the density of the medians and of the standard deviations between events, given the stored
# samples of each event. It needs no simulation. The check says whether the stored samples suffice.

population = HierarchicalPosterior(
    stored,
    {
        "stiffness": Varying(LogNormal(1.0, 0.4), HalfNormal(0.3)),  # priors of the median, and of the spread
        "damping": Varying(LogNormal(1.0, 0.5), HalfNormal(0.5)),
    },
)
sampler = SMCSampler(300, population.ndim, population, vectorize=True, seed=1)
sampler.run_mcmc(None, 2)
hierarchy = Hierarchy(population, sampler.get_chain(flat=True))
print(hierarchy)
ratios = event_ratios(hierarchy, posteriors, peak("displacement"))
print(ratios)

# %%
# New events
# ----------
#
# From one event, `propagate` simulates its samples under the new motion: the interval contains the errors of the
# parameters of that event, and nothing of what differs between events. `predict_new_event` has the peak
# at the medians of the population, times the ratio of a new event. Both are compared with thirty unused events.

from_one, from_all = {}, {}
usual = sorted(events, key=lambda name: np.abs(events[name][2].values).max())[4]  # of the usual strength
for name, (record, _, measured) in new_events.items():
    options = {"quantity": peak("displacement"), "seed": 1}
    alone = propagate(posteriors[usual], stored[usual].samples[::10], record=record, progress=False, **options)
    from_one[name] = alone.score(measured)
    from_all[name] = predict_new_event(hierarchy, posteriors, record, **options).score(measured)

inside, scores = {}, {}
for label, found in (("one event", from_one), ("population of eight", from_all)):
    inside[label] = share_within([each.pit[0] for each in found.values()], 0.9)
    scores[label] = np.mean([each.interval_score[0] / each.measured[0] for each in found.values()])
    print(f"{label}: within 90 % {inside[label]}; interval score {scores[label]:.2f} of the measured peak")

# %%
# The interval score is the width of the interval plus a penalty for each value outside; smaller is better. Narrow
# intervals at the wrong place lose more than wide ones.

figure, panels = plt.subplots(1, 2, figsize=(10, 3.8), sharey=True, layout="constrained")
for axes, (label, found) in zip(panels, (("one event", from_one), ("population of eight", from_all)), strict=True):
    order = sorted(found, key=lambda name: found[name].measured[0])
    values = [[getattr(found[name], what)[0] for name in order] for what in ("lower", "median", "measured", "upper")]
    low, middle, measured, high = from_si(np.array(values), "cm")
    axes.vlines(range(len(order)), low, high, linewidth=5, alpha=0.5, label="90 % interval")
    axes.plot(range(len(order)), middle, "_", color="C0", markersize=8, label="median")
    axes.plot(range(len(order)), measured, "C1o", markersize=4, label="measured")
    axes.set(xlabel="new events, by their peak", title=f"{label}: {inside[label].value * 100:.0f} % inside", xticks=[])
panels[0].set_ylabel("peak displacement [cm]")
panels[0].legend()
figure.savefig("new_events.png")
