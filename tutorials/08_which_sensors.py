"""
Which sensors and which motion to buy before a test
===================================================

A bridge column will be tested on a shake table. There is money for six sensors and for one motion, and the test shall
tell how far the column moves in a stronger design motion. `rank_sensors` ranks 29 possible sensors before anything is
measured: by the information on five parameters, and by the variance of the peak displacement that they leave. The same
function ranks the motions.

**The data are synthetic.** The prediction is a linearisation at draws of the prior. It counts on known noise levels, on
a known number of independent samples, and on a model without errors other than this noise: another noise gives other
ranks. ::

    python tutorials/08_which_sensors.py
"""

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import ColumnAnalysis, RCColumn, peak, plot_ranking, plot_sensors, problems, rank_sensors

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# Sensors and motions
# -------------------
#
# The candidates are the acceleration and the displacement of the top, the base moment of a load cell, the rotations
# over two gauge lengths, and strain gauges on bars at six heights and four positions. The levels of the noise are
# **assumed**, close to those of the published update of this column, which contain the error of its model. Such errors
# are correlated in time: the 64 samples of a second count as five.

DT, SECONDS = 1.0 / 64.0, 6.0
HEIGHTS = (0.15, 0.6, 1.2, 1.8, 3.0, 4.5)
NOISE = {"acceleration": 0.1, "displacement": 2e-3, "base_moment": 2e5, "rotation": 2e-4, "strain": 1e-4}  # [SI]
short, both = (problems.bridge_column_data(data).record for data in ("short", "eq1-eq2"))
motions = {
    "short motion": short.trim(0.0, SECONDS),
    "EQ1": both.trim(4.0, 4.0 + SECONDS).resample(DT),
    "EQ2": both.trim(64.0, 64.0 + SECONDS).resample(DT),
}
bar = RCColumn.lhpost(short).bar_circle_radius
positions = [-bar, -0.5 * bar, 0.5 * bar, bar]
gauges = {(height, x): f"strain@{height:g}:{x:.3f}" for x in positions for height in HEIGHTS}
places = ("acceleration", "displacement", "base_moment", "rotation@0:0.6", "rotation@0:1.2", *gauges.values())
column = RCColumn.lhpost(motions["EQ2"], outputs=places, analysis=ColumnAnalysis(substeps=2))
design = column.with_record(motions["EQ2"].scale(1.5))
prior = problems.bridge_column_prior(())

# %%
# Which sensors?
# --------------
#
# Start with EQ2. The sensors of the top and the gauges at the base on the outermost bars come first, where strains are
# largest: gauges have the same noise at all heights. Sensors repeat much of each other: alone each of the six has about
# as much information as any other, but after three of them the next one adds little.

settings = {"noise": NOISE, "effective_samples": 5.0 * SECONDS, "draws": 10, "seed": 1}
decision = {"target": peak("displacement"), "target_model": design}
ranking = rank_sensors(column, prior, **decision, **settings)
print(ranking)
plot_ranking(ranking).savefig("ranks.png")

# %%
# A lead of less than two standard errors does not decide: such a sensor can be exchanged for the next best one if that
# is cheaper. The column with the six sensors, and the expected information of every gauge alone:

six = ranking.chosen
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 6.4), sharey=True, width_ratios=(1.4, 1), layout="constrained")
plot_sensors(column, left, six)
left.set_title("the six sensors, with their ranks")
for x in positions:
    alone = [ranking.alone[ranking.candidates.index(gauges[height, x])] for height in HEIGHTS]
    right.plot(alone, HEIGHTS, "o-" if abs(x) == bar else "s--", label=f"gauge at {x:+.2f} m")
right.set(xlabel="expected information of the gauge alone [nat]", title="gauges along the column")
right.legend()
figure.savefig("column.png")

# %%
# Which motion?
# -------------
#
# A loop over the motions, with the same six sensors. Every motion determines ``Ec`` and ``a0``. EQ1 leaves much more of
# the standard deviation of ``Es`` than EQ2: the bars carry more once the concrete has cracked. No motion tells much of
# ``a1``, and more sensors do not help there. EQ2 tells most of the parameters, the short motion as much of the peak
# displacement.

left_of_motion, information = {}, {}
for name, motion in motions.items():
    known = rank_sensors(column.with_record(motion), prior, six, **decision, **settings)
    left_of_motion[name] = {parameter: float(shares[-1]) for parameter, shares in known.left.items()}
    information[name] = known.information[-1]
    left_of_motion[name]["peak displacement"] = float(np.sqrt(known.target_left[-1]))
    print(
        f"{name} ({np.abs(motion.acceleration).max():.1f} m/s²): {known.information[-1]:.1f} ± "
        f"{known.errors['information'][-1]:.1f} nat"
    )

figure, axes = plt.subplots(figsize=(8, 3.8), layout="constrained")
for k, (name, values) in enumerate(left_of_motion.items()):
    axes.bar(np.arange(6) + 0.27 * (k - 1), [100.0 * value for value in values.values()], 0.27, label=name)
axes.set_xticks(np.arange(6), left_of_motion["EQ2"])
axes.set(yscale="log", ylim=(1.0, 200.0), ylabel="standard deviation that is left [%]", title="six sensors, one motion")
axes.set_yticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
axes.legend(ncols=3)
figure.savefig("motions.png")
best = max(information, key=information.get)
print(f"the motion to buy: {best}")
