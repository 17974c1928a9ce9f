"""Make templates/bridge_column_short.h5: ten seconds of synthetic data for the first examples of the bridge column.

The truth is **assumed** and lies within the priors of Ramancha et al. (2022). Of the published means, one is six
standard deviations away from its prior mean. The responses are from the model that is updated, so that they differ
from the model by the noise alone, and a run finds the truth.

Run the script with ``make data``. It writes the same file every time.
"""

from pathlib import Path

from fe_likelihoods.data.make_bridge_column_eq1 import SEED, column_measurements, column_motion

from fe_likelihoods import Record
from fe_likelihoods.problems import BRIDGE_COLUMN_NOISE, SHORT_SUBSTEPS
from fe_likelihoods.signals.datasets import write_dataset
from fe_likelihoods.units import G0

NOISE_SEED = 1
DURATION = 10.0  # s
PEAK = 0.40 * G0  # m/s2
PEAK_TIME = 5.0  # s
DT = 1.0 / 64.0  # s
TRUTH = {"Ec": 0.8, "Es": 1.05, "a0": 0.7, "a1": 1.5, "ft": 1.3}


def short_motion() -> Record:
    """Make the stochastic base motion, scaled to PEAK, with the spectral content of EQ1."""
    motion = column_motion("synthetic short motion", SEED, duration=DURATION, peak=PEAK, peak_time=PEAK_TIME)
    return motion.resample(DT)


def main() -> None:
    """Write the file."""
    record = short_motion()
    measurements = column_measurements(record, theta=TRUTH, seed=NOISE_SEED, n_strips=40, substeps=SHORT_SUBSTEPS)
    attributes = {
        "title": "Synthetic short test of the bridge column: NOT measured data",
        "truth": TRUTH | {f"sigma_{k}": v for k, v in BRIDGE_COLUMN_NOISE.items()},
        "seed": SEED,
        "made_by": "data/make_bridge_column_short.py",
    }
    write_dataset(Path(__file__).parent / "templates" / "bridge_column_short.h5", record, measurements, attributes)


if __name__ == "__main__":
    main()
