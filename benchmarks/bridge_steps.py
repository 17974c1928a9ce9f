"""Error of the isolated bridge per friction law and integration step, as a fraction of the peak of each channel.

The motions are white noise through a soil filter with peaks of 0.04 and 0.56 g (8 s), and the first six seconds of the
bundled record (0.82 g). References: `solve_ivp` with tight tolerances for the laws that are differential equations,
steps of 1 us for the law of Coulomb.
"""

import time

import numpy as np

from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.problems import isolated_bridge_data
from fe_likelihoods.signals.records import Record
from tests.scipy_bridge import CHANNELS, Definition, peak_errors, solve

from .bridge import DT, NOMINAL, _ground
from .rows import Row

__all__ = ["steps"]

STEPS = {
    "bouc-wen": (5e-4, 2.5e-4, 1e-4),
    "elastic-plastic": (2.5e-4, 1e-4, 5e-5),
    "coulomb": (2.5e-4, 1e-4),
}
GROUPS = {"displacements": ("Ub", "drift", "Ud"), "forces": ("Fb", "shear"), "accelerations": ("acc",)}


def _motions() -> dict[str, np.ndarray]:
    soil = _ground()[:1601]
    bundled = isolated_bridge_data().record.acceleration[:1201]
    return {"0.04 g": soil * (0.04 * 9.81 / 5.5), "0.56 g": soil, "0.82 g, bundled": bundled}


def _reference(law: str, motion: np.ndarray) -> np.ndarray:
    if law == "coulomb":
        return IsolatedBridge(Record("noise", DT, motion), outputs=CHANNELS, friction=law, step=1e-6).simulate(NOMINAL)
    return solve(Definition(), motion, DT, friction=law).response


def steps(repeats: int) -> list[Row]:
    """Worst error per group of channels, error of the peaks, and CPU time per simulation."""
    rows = []
    for law, lengths in STEPS.items():
        for name, motion in _motions().items():
            reference = _reference(law, motion)
            peaks = np.abs(reference).max(axis=1)
            for step in lengths:
                model = IsolatedBridge(Record("noise", DT, motion), outputs=CHANNELS, friction=law, step=step)
                model.simulate(NOMINAL)
                start = time.process_time()
                for _ in range(repeats):
                    response = model.simulate(NOMINAL)
                seconds = (time.process_time() - start) / repeats
                errors = dict(zip(CHANNELS, peak_errors(response, reference), strict=True))
                worst = {
                    group: max(value for channel, value in errors.items() if channel.startswith(starts))
                    for group, starts in GROUPS.items()
                }
                worst["peaks"] = np.abs(np.abs(response).max(axis=1) / peaks - 1.0).max()
                case = f"{law}, {1e3 * step:g} ms, {name}"
                note = f"{1e3 * seconds:.1f} ms CPU"
                rows += [
                    Row(f"IsolatedBridge, error of {what}", case, 100.0 * e, "%", note) for what, e in worst.items()
                ]
    return rows
