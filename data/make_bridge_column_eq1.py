"""Make data/bridge_column_eq1.h5: synthetic data of earthquake EQ1 for the bridge column.

The record and the responses of Ramancha et al. (2022) are not public. This script makes a stochastic base motion
(`ground_motion`) with **assumed** parameters. They give the features of Fig. 3 of the paper: 50 s, about 0.2 g, and a
displacement of the top of about ±2 in at the posterior means of the paper. The responses are from a refined model
with white noise added.

Run the script with ``make data``. It writes the same file every time.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from fe_likelihoods.data.ground_motion import stochastic_motion

from fe_likelihoods import ColumnAnalysis, Events, Measurements, RCColumn, Record
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, BRIDGE_COLUMN_NOISE
from fe_likelihoods.signals.datasets import write_dataset
from fe_likelihoods.units import G0

SEED = 17
"""A draw in which the data distinguish stiffness and strength from damping (see README.md)."""
DT = 1.0 / 256.0  # s
DURATION = 50.0  # s
PEAK = 0.20 * G0  # m/s2
PEAK_TIME, SHAPE = 9.0, 3.0  # s, -; modulation by t^(SHAPE-1) exp(-(SHAPE-1) t/PEAK_TIME)
START_FREQUENCY, END_FREQUENCY = 4.0, 2.0  # Hz at 0 s and at 40 s
FILTER_DAMPING = 0.30
HIGH_PASS = 0.20  # Hz


def column_motion(name: str, seed: int, *, duration: float, peak: float, peak_time: float = PEAK_TIME) -> Record:
    """Make a stochastic base motion with the spectral content of EQ1, scaled to `peak` [m/s²]; times in s."""
    motion = stochastic_motion(
        seed,
        dt=DT,
        duration=duration,
        peak=peak,
        peak_time=peak_time,
        shape=SHAPE,
        frequencies=(START_FREQUENCY, END_FREQUENCY),
        drift_time=40.0,
        filter_damping=FILTER_DAMPING,
        high_pass=HIGH_PASS,
    )
    return Record(name, DT, motion, "SYNTHETIC: Rezaeian & Der Kiureghian (2008, 2010), assumed parameters")


def base_motion(seed: int = SEED) -> Record:
    """Make the stochastic base motion, scaled to PEAK."""
    return column_motion("synthetic EQ1", seed, duration=DURATION, peak=PEAK)


def column_measurements(
    record: Record,
    *,
    theta: Mapping[str, float] = BRIDGE_COLUMN_MEANS,
    seed: int = 1,
    n_strips: int = 200,
    substeps: int = 4,
    levels: Mapping[str, float] = BRIDGE_COLUMN_NOISE,
) -> Measurements:
    """Make the response of a refined model plus white noise with the standard deviations `levels` [SI].

    In the pauses of `Events` nothing is measured (NaN).
    """
    model = RCColumn.lhpost(record, analysis=ColumnAnalysis(mesh=n_strips, substeps=substeps))
    values = model.simulate([theta[name] for name in model.parameter_names])
    deviations = np.array([levels[channel.name] for channel in model.channels])
    values = values + deviations[:, None] * np.random.default_rng(seed).standard_normal(values.shape)
    if isinstance(record, Events):
        values = np.where(record.in_events, values, np.nan)
    description = (
        f"SYNTHETIC: response of RCColumn.lhpost ({n_strips} strips, {substeps} integration steps per sample) to "
        f"{record.name} at {'the posterior means of the paper' if theta is BRIDGE_COLUMN_MEANS else 'an assumed truth'}"
        f", plus white noise (seed {seed})"
    )
    return Measurements(model.channels, record.dt, values, description)


def main() -> None:
    """Write the file."""
    record = base_motion()
    measurements = column_measurements(record, seed=SEED)
    attributes = {
        "title": "Synthetic EQ1 of the bridge column: NOT measured data",
        "truth": dict(BRIDGE_COLUMN_MEANS) | {f"sigma_{k}": v for k, v in BRIDGE_COLUMN_NOISE.items()},
        "seed": SEED,
        "made_by": "data/make_bridge_column_eq1.py",
    }
    write_dataset(Path(__file__).with_name("bridge_column_eq1.h5"), record, measurements, attributes)


if __name__ == "__main__":
    main()
