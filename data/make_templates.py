"""Make ``templates/synthetic_*.csv``, the SYNTHETIC data of the function, OpenSees and executable templates.

The motion is the synthetic table motion of the isolated bridge, `fe_likelihoods.problems.table_motion`. The
measurements are the response of ``my_function.py`` with a four times smaller step, plus white noise of 0.03 g and 2 mm
(seed 1). The logger file has both, with clock times, after five seconds of noise before the motion.
"""

import datetime
import runpy
from pathlib import Path

import numpy as np

from fe_likelihoods import Record, from_si
from fe_likelihoods.problems import table_motion

TRUTH = (1.15, 0.85)
START = datetime.datetime(2024, 5, 14, 10, 32, 7)  # of the logger
QUIET = 250  # samples before the motion
FOLDER = Path(__file__).parent / "templates"


def main() -> None:
    """Write the three files."""
    simulate = runpy.run_path(str(FOLDER / "my_function.py"))["simulate"]
    fine = table_motion().trim(0.0, 8.0).resample(0.005)
    record = fine.resample(0.02)
    response = simulate(TRUTH, fine)[:, ::4][:, : record.n_steps]
    noise = np.random.default_rng(1).standard_normal(response.shape) * [[0.3], [2e-3]]
    acceleration, displacement = response + noise
    rows = zip(record.time, from_si(record.acceleration, "g"), strict=True)
    text = ["# SYNTHETIC base motion", "time_s,base acceleration [g]", *(f"{t:.2f},{a:.6f}" for t, a in rows)]
    (FOLDER / "synthetic_record.csv").write_text("\n".join(text) + "\n")
    rows = zip(record.time, from_si(acceleration, "g"), from_si(displacement, "mm"), strict=True)
    text = ["# SYNTHETIC response", "time_s,top acceleration [g],top displacement [mm]"]
    text += [f"{t:.2f},{a:.5f},{d:.3f}" for t, a, d in rows]
    (FOLDER / "synthetic_measured.csv").write_text("\n".join(text) + "\n")
    _write_logger(record, np.array([acceleration, displacement]))


def _write_logger(record: Record, measured: np.ndarray) -> None:
    """The same motion and response in one file of a logger."""
    quiet = np.random.default_rng(2).standard_normal((2, QUIET)) * [[0.3], [2e-3]]
    acceleration, displacement = np.hstack([quiet, measured])
    base = from_si(np.append(np.zeros(QUIET), record.acceleration), "g")
    times = (START + datetime.timedelta(seconds=k * record.dt) for k in range(base.size))
    rows = zip(times, base, from_si(acceleration, "g"), from_si(displacement, "mm"), strict=True)
    text = ["# SYNTHETIC file of a logger", "Timestamp,Base [g],Top [g],Top [mm]"]
    text += [f"{t:%Y-%m-%d %H:%M:%S.%f},{b:.6f},{a:.5f},{d:.3f}" for t, b, a, d in rows]
    (FOLDER / "synthetic_logger.csv").write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
