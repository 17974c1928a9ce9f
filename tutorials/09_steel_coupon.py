"""
A real bar of reinforcing steel under cyclic strain: how a wrong error model affects six parameters
===================================================================================================

A bar was strained in cycles and its stress was recorded. The steel law of ``RCColumn`` (``ReinforcingSteel`` of
OpenSees) is calibrated on the first half of the test and predicts the second half. One simulation takes a tenth of a
millisecond. This makes it easy to study residuals that are not white, their effect on a posterior that assumes white
noise (``cyclic_tests.py``), and parameters that compensate for errors of the law::

    python tutorials/09_steel_coupon.py --data FOLDER

FOLDER contains ``stress.1.coords`` and ``calDataField.csv`` from an example of quoFEM, in the repository
NHERI-SimCenter/quoFEM on GitHub (https://github.com/NHERI-SimCenter/quoFEM, BSD licence).
"""

import argparse
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from cyclic_tests import (
    find_folder,
    fit_noises,
    predict,
    prediction_row,
    report,
    save_posterior,
    save_residuals,
    save_summary,
    scatter,
    table,
)
from real_data import FAST, add_common_options
from steel_coupon import SteelCoupon

from fe_likelihoods import Measurements, Steel, TruncatedNormal

SOURCE = "https://github.com/NHERI-SimCenter/quoFEM (an example of quoFEM)"
FILES = ("stress.1.coords", "calDataField.csv")
BLUE, ORANGE = "#1f5a8c", "#d9822b"
MPA = 1e6

parser = argparse.ArgumentParser(description="Calibrate a steel law on a coupon test, and predict.")
add_common_options(parser, "results-steel-coupon")
parser.add_argument("--walkers", type=int, default=60 if FAST else 500, help="number of particles")
args = parser.parse_args()

begin = time.perf_counter()
folder = find_folder(args.data, FILES, SOURCE)
if FAST:
    print("REDUCED SETTING (fast): few walkers; these numbers are not results")
args.out.mkdir(parents=True, exist_ok=True)


# %%
# The test and the steel law
# --------------------------
#
# The nominal values are **assumed**: those of an ordinary bar. The shape of the curves between reversals and the
# reduction of the modulus at a reversal are fixed in the law.

strain = np.loadtxt(folder / FILES[0])
stress = MPA * np.loadtxt(folder / FILES[1], delimiter=",").ravel()
if strain.shape != stress.shape:
    raise SystemExit(
        f"{len(strain)} strains and {len(stress)} stresses in {folder}: the files are not from the same test"
    )
half = len(strain) // 2
whole = SteelCoupon(
    strain, Steel(fy=450 * MPA, fu=650 * MPA, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
)
model = whole.with_record(strain[:half])
measured = Measurements(model.channels, model.dt, stress[None, :half], "steel coupon, first half")
sensor = scatter(strain, stress, width=5)
print(
    f"{len(strain)} samples, strain from {100 * strain.min():.2f} to {100 * strain.max():.2f} %, stress to "
    f"{np.abs(stress).max() / MPA:.0f} MPa; scatter of neighbouring samples {sensor / MPA:.1f} MPa"
)


# %%
# The scatter of neighbouring samples is an upper bound of the noise of the sensor. The residuals will be twenty times
# larger: they are the error of the model.
#
# The priors are **assumed**: the modulus is known to 3 %, the strengths to 10 %, and hardening is hardly known.

prior = {
    "fy": TruncatedNormal(1.0, 0.1),
    "fu": TruncatedNormal(1.0, 0.1),
    "Es": TruncatedNormal(1.0, 0.03),
    "Esh": TruncatedNormal(1.0, 0.5),
    "eps_sh": TruncatedNormal(1.0, 0.3),
    "eps_u": TruncatedNormal(1.0, 0.3),
}
start = time.perf_counter()
fits = fit_noises(
    model,
    measured,
    prior,
    50 * MPA,
    sensor,
    walkers=args.walkers,
    seed=args.seed,
    progress=not FAST,
)
seconds_sampling = time.perf_counter() - start

names = list(prior)
title = "Steel coupon, first half: multiples of nominal values"
posterior_table = save_posterior(fits, prior, MPA, "MPa", title, args.out)


# %%
# Residuals
# ---------

checks = save_residuals(fits, MPA, "MPa", args.out)


# %%
# What the posterior says, and what it does not
# ---------------------------------------------
#
# With white noise 171 samples count as independent. The residuals are worth a tenth of them, and the posterior standard
# deviations of strengths and hardening are two to three times too small. AR(1) errors correct this for parameters that
# act slowly (``fu``, ``Esh``), but not for parameters that act at once: differences of successive stresses, which an
# AR(1) error hardly changes, contain much information about ``Es``.
#
# Under all three error models ``Es`` is at the edge of its prior or far beyond it. This is not a property of the bar.
# After a reversal the modulus of the law is 0.82 Es + Es / (5.55 + 1000 x largest strain), here 0.84 Es; the bar has
# 200 GPa, which requires an ``Es`` of 1.2 x 200 GPa. No error model corrects a parameter that compensates for an error
# of the law: that requires another law.
#
# Prediction of the second half
# -----------------------------
#
# The narrow bands are the response alone, the wide bands contain the noise. The score is the interval score of the band
# with noise in multiples of the root mean square: its width plus a penalty for every sample outside of it.

parts = {"first half (calibration)": slice(0, half), "second half (prediction)": slice(half, len(strain))}
before = whole.simulate(np.ones(len(names)))[0]
predictions = {name: predict(fit, 400, args.seed, whole) for name, fit in fits.items()}
results, rows = {}, []
for label, part in parts.items():
    row, results[label.split(" (")[0]] = prediction_row(predictions, before, stress, part)
    rows.append({"part": label} | row)
prediction_table = table(rows)
print(prediction_table)
(args.out / "tables.txt").write_text(f"{posterior_table}\n\n{prediction_table}\n")

figure, axes = plt.subplots(2, 2, figsize=(13, 8), layout="constrained", sharey=True, height_ratios=(1.5, 1))
for column, (label, part) in zip(axes.T, parts.items(), strict=True):
    alone, noisy = predictions["AR(1)"]
    loops, history = column
    loops.plot(100 * strain[part], stress[part] / MPA, ".-", color="k", linewidth=0.8, markersize=2.5, label="measured")
    loops.plot(100 * strain[part], alone.mean[0, part] / MPA, color=ORANGE, linewidth=0.9, label="mean")
    instants = np.arange(len(strain))[part]
    for prediction, alpha, text in ((noisy, 0.15, "90 % with noise"), (alone, 0.4, "90 % of the response")):
        band = (prediction.quantile(p)[0, part] / MPA for p in (0.05, 0.95))
        history.fill_between(instants, *band, color=BLUE, alpha=alpha, linewidth=0.0, label=text)
    history.plot(instants, stress[part] / MPA, color="k", linewidth=0.8)
    error = results[label.split(" (")[0]]["AR(1)"]["rrmse"]
    loops.set(xlabel="strain [%]", ylabel="stress [MPa]", title=f"{label}, RRMSE {100 * error:.1f} %")
    history.set(xlabel="sample", ylabel="stress [MPa]")
    for axis in column:
        axis.grid(alpha=0.25)
axes[0, 0].legend(frameon=False, fontsize="small")
axes[1, 0].legend(frameon=False, fontsize="small", loc="lower left", ncols=2)
figure.suptitle("Steel coupon, calibrated on the first half with AR(1) errors")
figure.savefig(args.out / "loops.png", dpi=130)


# %%
# Cost
# ----

settings_and_results = {
    "walkers": args.walkers,
    "seed": args.seed,
    "sensor": sensor / MPA,
    "predictions": results,
    "seconds_sampling": seconds_sampling,
    "seconds": time.perf_counter() - begin,
}
save_summary(report(fits, prior, checks, MPA) | settings_and_results, args.out)
