"""
From a posterior to damage, and to a decision
=============================================

A bridge column is shaken by two earthquakes, and calibrated with their measurements. Then:

* a third, stronger earthquake is predicted for the column that the first two have damaged, before it is measured;
* the posterior says which limit states are reached after each event, where, and with which probability;
* annual rates of repair and replacement, and their costs, say whether to strengthen the column.

**All data are synthetic; hazard curve, costs and model error of the decision are assumed.** ::

    python tutorials/07_damage_and_decision.py
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.special import ndtr

from fe_likelihoods import (
    Events,
    FELikelihood,
    HalfNormal,
    Measurements,
    Posterior,
    RCColumn,
    TruncatedNormal,
    damage,
    damage_measures,
    damage_outputs,
    from_si,
    park_ang_constants,
    peak,
    plot_damage,
    problems,
    propagate,
)
from samplers import SMCSampler

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# Events and data
# ---------------
#
# EQ1 cracks the column, EQ2 yields its bars, EQ3 is the motion of EQ2 again, 1.6 times as strong. Three multiples of
# nominal values are unknown, among them the yield strength of the bars, about which EQ1 says nothing.

DT, PAUSE = 1.0 / 32.0, 4.0  # s
TRUTH = {"Ec": 0.8, "ft": 1.25, "fy": 1.06}
bundled = problems.bridge_column_data("eq1-eq2").record.records
first, second = (part.trim(start, start + 10.0).resample(DT) for part, start in zip(bundled, (5.0, 4.0), strict=True))
events = Events([first, second, second.scale(1.6)], PAUSE, ["EQ1", "EQ2", "EQ3"])
column = RCColumn.lhpost(events, parameters=tuple(TRUTH))
rng = np.random.default_rng(1)
noise = np.array([[problems.BRIDGE_COLUMN_NOISE[channel.name]] for channel in column.channels])
measured = {
    name: Measurements(column.channels, DT, response + noise * rng.standard_normal(response.shape))
    for name, response in events.split(column.simulate(list(TRUTH.values()))).items()
}

# %%
# Calibration with EQ1 and EQ2
# ----------------------------
#
# A likelihood of a model under `Events` takes the measurements of the events by name.

known = Events(events.records[:2], PAUSE, ["EQ1", "EQ2"])
prior = {"Ec": TruncatedNormal(1.0, 0.3), "ft": TruncatedNormal(1.0, 0.4), "fy": TruncatedNormal(1.0, 0.08)}
sigmas = {"sigma_acceleration": HalfNormal(1.0), "sigma_displacement": HalfNormal(0.03)}
data = {name: measured[name] for name in ("EQ1", "EQ2")}
posterior = Posterior(FELikelihood(column.with_record(known), data), prior | sigmas)
sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide())
sampler.run_mcmc(None, 1)
print(sampler.verdict)
samples = sampler.get_chain(flat=True)[:, :3]
print(f"means {samples.mean(axis=0).round(3)}, standard deviations {samples.std(axis=0).round(3)}, truth {TRUTH}")

# %%
# EQ3 before it is measured
# -------------------------
#
# ``from_state="end"`` starts EQ3 from the state after EQ2, ``"virgin"`` from an uncracked column, which is too stiff.

figure, panels = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
coverage = {}
cases = ("after EQ1 and EQ2", "end", {"rest": PAUSE}), ("virgin column", "virgin", {})
for axes, (title, state, rest) in zip(panels, cases, strict=True):
    options = {"from_state": state, "noise": True, "seed": 1, "progress": False} | rest
    prediction = propagate(posterior, sampler.get_chain(flat=True), record=events.records[2], **options)
    coverage[state] = prediction.score(measured["EQ3"]).coverage[1]
    low, high = (from_si(prediction.quantile(p)[1], "in") for p in (0.05, 0.95))
    time = measured["EQ3"].time
    axes.fill_between(time, low, high, alpha=0.4, label="90 % band")
    axes.plot(time, from_si(measured["EQ3"].channel("displacement"), "in"), color="C1", linewidth=0.9, label="measured")
    axes.set(ylabel="displacement [in]", title=f"{title}: {100 * coverage[state]:.0f} % inside")
panels[0].legend(ncols=2)
panels[1].set_xlabel("time in EQ3 [s]")
figure.savefig("prediction.png")

# %%
# Damage
# ------
#
# The same samples, the same three events, and the strains of bars and cover, which were not measured. The data are
# synthetic, so the model has no error, which ``noise=False`` states; with real data, give ``ratios=``.

instrumented = replace(column, outputs=damage_outputs(column))
kinds = ("peak drift", "bar tension", "cover compression", "Park-Ang index")
measures = damage_measures(instrumented, measures=kinds, park_ang=park_ang_constants(column))
found = damage(propagate(instrumented, samples, quantity=measures, progress=False), noise=False)
print(found.table())
plot_damage(found).savefig("damage.png")

# %%
# Rates and losses
# ----------------
#
# The hazard curve is the annual rate at which an intensity is exceeded. Each sample has a peak displacement for each
# scaled motion, and so annual rates and an expected loss of its own; a measured peak is the predicted one times a
# lognormal ratio. Strengthening makes the column 1.5 times as strong.

factors = np.array([0.5, 1.0, 1.6, 2.5])
pga = np.abs(second.acceleration).max() * factors
quantity = {"quantity": peak("displacement"), "from_state": "virgin", "progress": False}
peaks = [np.ravel(propagate(column, samples, record=second.scale(k), **quantity).values) for k in factors]
log_peak = make_interp_spline(np.log(pga), np.log(peaks), k=1)  # a power law between the motions, and beyond them
hazard = make_interp_spline(np.log([1.0, 4.0, 15.0]), np.log([0.05, 0.005, 1e-4]), k=1)  # [m/s²] -> [1/year]
edges = np.geomspace(0.05, 100.0, 2001)
middle, rate = np.sqrt(edges[1:] * edges[:-1]), -np.diff(np.exp(hazard(np.log(edges))))
LIMITS, COSTS = {"repair": 0.10, "replacement": 0.25}, {"repair": 1.0, "replacement": 10.0}  # [m]


def annual_rate(limit: float, strength: float = 1.0) -> np.ndarray:
    """Annual rate of a peak above `limit` [m] for each sample."""
    return rate @ ndtr((log_peak(np.log(middle / strength)) - np.log(limit)) / 0.2)


def annual_loss(strength: float) -> np.ndarray:
    """Expected loss per year: each event costs what its severest state costs."""
    repair, replacement = (annual_rate(limit, strength) for limit in LIMITS.values())
    return COSTS["repair"] * (repair - replacement) + COSTS["replacement"] * replacement


print(", ".join(f"{name} {annual_rate(limit).mean():.2g} per year" for name, limit in LIMITS.items()))
more = 0.1 + 50.0 * (annual_loss(1.5) - annual_loss(1.0))  # strengthening costs 0.1, for 50 years
print(f"strengthening costs {more.mean():+.3f} repairs more than leaving; less in {np.mean(more < 0):.0%} of samples")
