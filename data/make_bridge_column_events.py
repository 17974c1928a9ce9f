"""Make data/bridge_column_events.h5: synthetic data of two earthquakes on the bridge column, EQ1 and a stronger EQ2.

EQ1 is the motion of `make_bridge_column_eq1`. Under it the bars of the column stay elastic, and its data say nothing
about a1. EQ2, 10 s later, is another draw of the same stochastic model, with **assumed** parameters: 30 s and 0.35 g.
It yields the bars to a strain of 0.013 and displaces the top by 5 in, so that the data of both events inform all five
structural parameters.

The responses are from the model that is updated, with its number of strips and its time step: the posterior is so
sharp that the error of this discretization, compared with a refined model, is 1 of its standard deviations. White noise
is added with the levels `SENSOR_NOISE`, which are **assumed**.

Run the script with ``make data``. It writes the same file every time.
"""

from pathlib import Path

from fe_likelihoods.data.make_bridge_column_eq1 import base_motion, column_measurements, column_motion

from fe_likelihoods import Events, Record
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, BRIDGE_COLUMN_NOISE
from fe_likelihoods.signals.datasets import write_dataset
from fe_likelihoods.units import G0

SEED = 2
"""A draw under which the response depends smoothly on the parameters; with others a residual displacement jumps."""
NOISE_SEED = 1
DURATION = 30.0  # s
PEAK = 0.35 * G0  # m/s2
REST = 10.0  # s
SENSOR_NOISE = {name: 0.25 * level for name, level in BRIDGE_COLUMN_NOISE.items()}
"""A quarter of the levels of the paper, which also contain the error of its model: 0.005 g and 0.57 mm."""


def second_motion(seed: int = SEED, peak: float = PEAK, name: str = "synthetic EQ2") -> Record:
    """Make a stronger base motion with the spectral content of EQ1, scaled to `peak` [m/s²]."""
    return column_motion(name, seed, duration=DURATION, peak=peak)


def main() -> None:
    """Write the file."""
    events = Events([base_motion(), second_motion()], REST, ["EQ1", "EQ2"])
    measurements = column_measurements(events, seed=NOISE_SEED, n_strips=40, substeps=1, levels=SENSOR_NOISE)
    attributes = {
        "title": "Synthetic EQ1 and EQ2 of the bridge column: NOT measured data",
        "truth": dict(BRIDGE_COLUMN_MEANS) | {f"sigma_{k}": v for k, v in SENSOR_NOISE.items()},
        "seed": SEED,
        "made_by": "data/make_bridge_column_events.py",
    }
    write_dataset(Path(__file__).with_name("bridge_column_events.h5"), events, measurements, attributes)


if __name__ == "__main__":
    main()
