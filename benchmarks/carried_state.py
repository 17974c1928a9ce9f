"""What an earlier event changes, and what it costs to predict several later ones: the column under EQ1 and others.

The response to a second event of the column that EQ1 has cracked is compared with that of the virgin column.
Predictions of three later events from the end of EQ1 are timed without and with kept states.
"""

import time

import numpy as np

from fe_likelihoods import RCColumn, propagate, rrmse
from fe_likelihoods.prediction.kept_states import KEPT_STATES
from fe_likelihoods.problems import bridge_column_data
from fe_likelihoods.units import INCH

from .rows import Row

__all__ = ["carried_state"]

_REST = 10.0
_SAMPLES = 100
_PAPER = np.array([0.59, 0.96, 0.27, 4.78, 2.43])  # posterior means of Ramancha et al. (2022), Table 2


def carried_state(repeats: int = 3) -> list[Row]:
    """Differences between the carried and the virgin state, and the least processor time of predictions."""
    eq1 = bridge_column_data().record
    column = RCColumn.lhpost(eq1)
    rows = []
    for case, theta in {"nominal": np.ones(5), "paper's means": _PAPER}.items():
        for factor in (2.0, 1.0, 0.5):
            rows += _differences(column, factor, theta, case)
    short = column.with_record(eq1.trim(5.0, 15.0))
    later = [short.loading.scale(factor) for factor in (0.5, 1.0, 1.5)]
    samples = np.random.default_rng(1).normal(1.0, 0.1, (_SAMPLES, 5))
    means = {}
    for case, limit in {"no states kept": 0, "states kept": 256 * 2**20}.items():
        seconds = []
        for _ in range(repeats):
            KEPT_STATES.clear()
            start = time.process_time()
            means[case] = [
                propagate(
                    short, samples, record=eq, from_state="end", rest=_REST, state_bytes=limit, progress=False
                ).mean
                for eq in later
            ]
            seconds.append(time.process_time() - start)
        size = f"{len(KEPT_STATES)} states, {KEPT_STATES.n_bytes / 2**20:.1f} MiB"
        rows.append(
            Row("EQ2, EQ3, EQ4 from the end of EQ1", f"{_SAMPLES} samples, {case}", min(seconds), "s CPU", size)
        )
    np.testing.assert_array_equal(*means.values())
    return rows


def _differences(column: RCColumn, factor: float, theta: np.ndarray, case: str) -> list[Row]:
    eq2 = column.loading.scale(factor)
    virgin = column.with_record(eq2).simulate(theta)
    carried = column.followed_by(eq2, _REST).simulate(theta)[:, -eq2.n_steps :]
    peaks = [np.abs(response[1]).max() / INCH for response in (carried, virgin)]
    note = f"peak displacement {peaks[0]:.2f} in, virgin {peaks[1]:.2f} in"
    errors = 100.0 * rrmse(carried, virgin)
    return [
        Row(f"RRMSE of the {channel.name} to the virgin column", f"{factor:g} EQ1 after EQ1, {case}", error, "%", note)
        for channel, error in zip(column.channels, errors, strict=True)
    ]
