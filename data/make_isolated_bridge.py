"""Make data/isolated_bridge.h5 and data/isolated_bridge_means.h5: synthetic tests of the isolated bridge.

The records and responses of the tests are not public, and most nominal values of the model are assumed. The table
motion is stochastic and **assumed** (`table_motion`). The responses are those of the model with a fifth of the
default integration step, at parameters that differ from the nominal values, at every second sample (100 Hz). White
noise is added, with a given fraction of the root mean square of each channel.

`isolated_bridge_means.h5` has only means over the two piers. The piers are structurally identical, so that these data
do not distinguish them, and the posterior has exactly two modes (see `IsolatedBridge.exchange_piers`).

Run the script with ``make data``. It writes the same files every time.
"""

from pathlib import Path

from fe_likelihoods.problems import (
    ISOLATED_BRIDGE_NOISE,
    ISOLATED_BRIDGE_OUTPUTS,
    ISOLATED_BRIDGE_TRUTH,
    isolated_bridge_measurements,
    table_motion,
)
from fe_likelihoods.signals.datasets import write_dataset

SEED = 1994
NOISE_SEED = 1999
"""One of four seeds, of nine, for which the estimates of all parameters lie within two posterior standard deviations
of the truth. Tests of calibration use many draws of the noise."""


def main() -> None:
    """Write the files."""
    record = table_motion(SEED)
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
