"""Make data/bridge_column_eq1.h5: a synthetic EQ1 for the bridge column.

The record and the responses of the paper could not be had. This script makes a base motion with the published
stochastic model of Rezaeian & Der Kiureghian (2008, Earthq. Eng. Struct. Dyn. 37(13), 1609-1627; 2010, 39(10),
1155-1180): white noise through an oscillator filter whose frequency drifts, scaled to unit variance, modulated in time
by a gamma function, then high-pass filtered so that velocity and displacement end at rest. Its parameters are
**assumed**, chosen to give the features of the paper's Fig. 3 (50 s, about .2 g, top displacement about +-2 in at the
paper's posterior means). The responses are those of a finer model than the one that is updated, plus white noise.

Run it with ``make data``; it writes the same file every time.
"""

import math
from pathlib import Path

import numpy as np
from scipy import signal

from fe_likelihoods.channels import write_dataset
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, BRIDGE_COLUMN_NOISE, bridge_column_measurements
from fe_likelihoods.records import Record
from fe_likelihoods.units import G0

SEED = 1989
DT = 1.0 / 256.0  # s
DURATION = 50.0  # s
PEAK = 0.20 * G0  # m/s2
PEAK_TIME, SHAPE = 9.0, 3.0  # s, -; gamma modulation t^(SHAPE-1) exp(-(SHAPE-1) t/PEAK_TIME)
START_FREQUENCY, END_FREQUENCY = 4.0, 2.0  # Hz at 0 s and at 40 s
FILTER_DAMPING = 0.30
HIGH_PASS = 0.20  # Hz


def base_motion(seed: int = SEED) -> Record:
    """The stochastic base motion, scaled to PEAK."""
    n = round(DURATION / DT)
    time = DT * np.arange(n)
    rng = np.random.default_rng(seed)
    pulses = rng.standard_normal(n)
    frequency = 2.0 * math.pi * np.interp(time, [0.0, 40.0], [START_FREQUENCY, END_FREQUENCY])
    damped = frequency * math.sqrt(1.0 - FILTER_DAMPING**2)
    motion, variance = np.zeros(n), np.zeros(n)
    memory = round(6.0 / DT)  # the filter forgets within seconds
    for i in range(n):
        t = time[: min(memory, n - i)]
        response = np.exp(-FILTER_DAMPING * frequency[i] * t) * np.sin(damped[i] * t)
        motion[i : i + t.size] += pulses[i] * response
        variance[i : i + t.size] += response**2
    motion = motion / np.sqrt(np.maximum(variance, 1e-12))
    motion *= (time / PEAK_TIME) ** (SHAPE - 1.0) * np.exp((SHAPE - 1.0) * (1.0 - time / PEAK_TIME))
    # critically damped oscillator of frequency w: acceleration s^2/(s + w)^2
    w = 2.0 * math.pi * HIGH_PASS
    motion = signal.lfilter(*signal.bilinear([1.0, 0.0, 0.0], [1.0, 2.0 * w, w * w], fs=1.0 / DT), motion)
    ends = signal.windows.tukey(n, 0.04)
    motion *= ends
    motion *= PEAK / np.abs(motion).max()
    return Record("synthetic EQ1", DT, motion, "SYNTHETIC: Rezaeian & Der Kiureghian (2008, 2010), assumed parameters")


def main() -> None:
    """Write the file."""
    record = base_motion()
    measurements = bridge_column_measurements(record, seed=SEED)
    attributes = {
        "title": "Synthetic EQ1 of the bridge column: NOT measured data",
        "truth": dict(BRIDGE_COLUMN_MEANS) | {f"sigma_{k}": v for k, v in BRIDGE_COLUMN_NOISE.items()},
        "seed": SEED,
        "made_by": "data/make_bridge_column_eq1.py",
    }
    write_dataset(Path(__file__).with_name("bridge_column_eq1.h5"), record, measurements, attributes)


if __name__ == "__main__":
    main()
