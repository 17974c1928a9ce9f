# %% [markdown]
# # A real bar of reinforcing steel in cycles: what a wrong error does to six parameters
#
# A bar was strained to and fro and its stress recorded. The law of the bars of `RCColumn` (OpenSees'
# `ReinforcingSteel`) is calibrated on the first half of the test and predicts the second. One simulation takes a tenth
# of a millisecond: the place to look closely at residuals that are not white, at what they do to a posterior when one
# believes that they are (`cyclic_tests.py`), and at parameters that make up for what the law cannot do.
#
#     python tutorials/09_steel_coupon.py                      # data in ../shared/measured/steel_coupon
#     python tutorials/09_steel_coupon.py --data FOLDER        # or elsewhere
#
# The data are not part of this project; a run without them says where to get them.

# %%
import argparse
import os
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from cyclic_tests import (
    data_folder,
    fit_noises,
    keep_posterior,
    keep_residuals,
    keep_summary,
    predict,
    prediction_row,
    report,
    scatter,
    table,
)

from fe_likelihoods.models.rc_column import Steel
from fe_likelihoods.models.steel_coupon import SteelCoupon
from fe_likelihoods.probability.priors import TruncatedNormal
from fe_likelihoods.signals.channels import Measurements

SOURCE = "NHERI-SimCenter/quoFEM on GitHub (BSD licence; an example of quoFEM)"
FILES = ("stress.1.coords", "calDataField.csv")
BLUE, ORANGE = "#1f5a8c", "#d9822b"
MPA = 1e6

parser = argparse.ArgumentParser(description="Calibrate a law of steel on a coupon test; figures into a folder.")
parser.add_argument("--data", type=Path, help="folder of the coupon test (default: of FE_SHARED, or ../shared)")
parser.add_argument("--walkers", type=int, default=60 if os.environ.get("FAST") else 500)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--out", type=Path, default=Path("results-steel-coupon"))
args = parser.parse_args()

begin = time.perf_counter()
folder = data_folder(args.data, FILES, SOURCE)
args.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The test, and the law
#
# Nominal values are **assumed**: those of an ordinary bar. The shape of the curves between reversals, and how much of
# the modulus is lost at a reversal, are fixed in the law.

# %%
strain = np.loadtxt(folder / FILES[0])
stress = MPA * np.loadtxt(folder / FILES[1], delimiter=",").ravel()
if strain.shape != stress.shape:
    raise SystemExit(f"{len(strain)} strains and {len(stress)} stresses in {folder}: these are not of one test.")
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

# %% [markdown]
# That scatter bounds the noise of the sensor from above. Residuals will be twenty times larger: what is left is the
# error of the model.
#
# Priors, **assumed**: the modulus is known to 3 %, the strengths to some per cent, hardening hardly at all.

# %%
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
    progress=not os.environ.get("FAST"),
)
seconds_sampling = time.perf_counter() - start

# %%
names = list(prior)
title = "Steel coupon, first half: multiples of nominal values, regions of 50 and 90 %"
posterior_table = keep_posterior(fits, prior, MPA, "MPa", title, args.out)

# %% [markdown]
# ## Residuals

# %%
checks = keep_residuals(fits, MPA, "MPa", args.out)

# %% [markdown]
# ## What the posterior says, and what it does not
#
# White noise counts 171 witnesses where the residuals are worth a tenth of them, and is two to three times too sure of
# strengths and hardening. AR(1) corrects that where a parameter acts slowly (`fu`, `Esh`), and not where it acts at
# once: successive differences of the stress, which an AR(1) error leaves nearly alone, tell much about `Es`.
#
# All three pull `Es` to the edge of its prior or far beyond, and that is no property of this bar. After a reversal the
# law has .82 Es + Es / (5.55 + 1000 x largest strain), here .84 Es; the bar has 200 GPa, which takes an `Es` of 1.2 x
# 200. No idea of the error repairs a parameter that carries the error of the model: that takes another law.
#
# ## Prediction of the second half

# %%
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
axes[1, 0].legend(frameon=False, fontsize="small", loc="upper left")
figure.suptitle("Steel coupon, calibrated on the first half with errors AR(1)")
figure.savefig(args.out / "loops.png", dpi=130)
plt.close(figure)

# %% [markdown]
# ## What it cost

# %%
settings_and_results = {
    "walkers": args.walkers,
    "seed": args.seed,
    "sensor": sensor / MPA,
    "predictions": results,
    "seconds_sampling": seconds_sampling,
    "seconds": time.perf_counter() - begin,
}
keep_summary(report(fits, prior, checks, MPA) | settings_and_results, args.out)
