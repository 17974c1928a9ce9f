"""Make templates/isolated_bridge.h5 and isolated_bridge_means.h5: synthetic tests of the isolated bridge.

The records and responses of the tests are not public, and most nominal values of the model are assumed. The table
motion is stochastic and **assumed** (`table_motion`). The responses are from the model with a fifth of the
default integration step, at parameters that differ from the nominal values, at every second sample (100 Hz). White
noise is added, with a given fraction of the root mean square of each channel.

`isolated_bridge_means.h5` has only means over the two piers. The piers are structurally identical, so that these data
do not distinguish them, and the posterior has exactly two modes.

Run the script with ``make data``. It writes the same files every time.
"""

from pathlib import Path

import numpy as np

from fe_likelihoods import IsolatedBridge, Measurements, Record
from fe_likelihoods.problems import table_motion
from fe_likelihoods.signals.datasets import write_dataset

SEED = 1994
NOISE_SEED = 1999
"""One of four seeds, of nine, for which the estimates of all parameters lie within two posterior standard deviations
of the truth. Tests of calibration use many draws of the noise."""

_DEVICES = ("fmin_1", "df_1", "a_1", "fmin_2", "df_2", "a_2", "Kd_1", "C0_1", "Kd_2", "C0_2")
TRUTH = {
    "twin": dict(zip(_DEVICES, (1.15, 0.85, 1.2, 0.9, 1.1, 0.8, 0.8, 1.25, 1.3, 0.9), strict=True)),
    "means": dict.fromkeys(_DEVICES, 1.0) | {"df_1": 0.8, "df_2": 1.2},
}
"""Multiples of the nominal values (assumed)."""

PIER_1, PIER_2 = (("Ub_1", "Fb_1", "drift_1", "shear_1", "acc_p1"), ("Ub_2", "Fb_2", "drift_2", "shear_2", "acc_p2"))
OUTPUTS = {"twin": PIER_1 + PIER_2, "means": ("mean_Ub", "mean_Fb", "mean_drift", "mean_shear", "mean_acc_p")}
NOISE = {"twin": 0.05, "means": 0.10}
"""Standard deviations of the noise, in root mean squares of each channel (assumed)."""


def bridge_measurements(record: Record, data: str, seed: int) -> Measurements:
    """Make the response with a small step at the truth of a bundled test, plus its white noise."""
    step, noise = 0.05e-3, NOISE[data]
    model = IsolatedBridge(record, outputs=OUTPUTS[data], step=step, every=2)
    values = model.simulate([TRUTH[data][name] for name in model.parameter_names])
    rms = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    values = values + noise * rms * np.random.default_rng(seed).standard_normal(values.shape)
    description = (
        f"SYNTHETIC, nominal values assumed: response of IsolatedBridge (step {1e3 * step:g} ms) to {record.name}, "
        f"plus white noise of {100 * noise:g} % of each channel's root mean square (seed {seed})"
    )
    return Measurements(model.channels, model.dt, values, description)


def main() -> None:
    """Write the files."""
    record = table_motion(SEED)
    for data, name in (("twin", "isolated_bridge"), ("means", "isolated_bridge_means")):
        measurements = bridge_measurements(record, data, NOISE_SEED)
        attributes = {
            "title": "Synthetic test of an isolated bridge: NOT measured data, nominal values assumed",
            "truth": dict(TRUTH[data]) | {"sigma": NOISE[data]},
            "seed": SEED,
            "noise_seed": NOISE_SEED,
            "made_by": "data/make_isolated_bridge.py",
        }
        folder = Path(__file__).parent / ("templates" if name == "isolated_bridge" else "")  # a template reads it
        write_dataset(folder / f"{name}.h5", record, measurements, attributes)


if __name__ == "__main__":
    main()
