r"""How much a number is expected to scatter between events of one structure, from its model and one calibrated event.

Two things differ between events. The *structural parameters* do: temperature, moisture, amplitude and age change the
frequencies and the damping. Their spread is carried through the model, by simulations with all frequencies, all
stiffnesses or all damping parameters a standard deviation larger and smaller. And *what the model cannot fit* does: the
residuals of a calibrated event, less what a change of these parameters explains, meet the response of a new event at
another phase. They are rotated in phase (by the Hilbert transform, which keeps their envelope), and added to the
response. The standard deviation of the logarithm of a number over both is its scatter, so that peaks, root mean
squares, Arias intensities and energies have each their own.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

__all__ = ["REMAINDER", "log_variance", "remainder_variance", "spread_rows"]

REMAINDER = 0.05
"""Scatter of an amplitude beyond both: 0.02 to 0.06 is best for three structures, each of them left out in turn."""
_PHASES = 16


def spread_rows(at: Sequence[float], names: Sequence[str], spread: Mapping[str, float]) -> np.ndarray:
    """Parameters (1 + 2 m, n): as given, then each of m groups a standard deviation larger and smaller.

    A group has all parameters whose names begin with a key of `spread`.
    """
    rows = [np.asarray(at, dtype=float)]
    for kind, sd in spread.items():
        if any(name.startswith(kind) for name in names):
            power = np.array([float(name.startswith(kind)) for name in names])
            rows += [rows[0] * np.exp(sign * sd * power) for sign in (1.0, -1.0)]
    return np.array(rows)


def log_variance(values: np.ndarray) -> np.ndarray:
    """Variance (...) of the logarithm of a number from its values (1 + 2 m, ...) at `spread_rows`; NaN for failures.

    Values that are not positive, and failures, count as far as their opposites. Zero without groups.
    """
    if len(values) == 1:
        return np.zeros(values.shape[1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.square(np.log(values[1:] / values[0])).reshape(-1, 2, *values.shape[1:])
    known = np.isfinite(squares)
    counted = known.sum(axis=1)
    return (np.where(known, squares, 0.0).sum(axis=1) / np.maximum(counted, 1)).sum(axis=0)


def remainder_variance(
    evaluate: Callable[[np.ndarray], np.ndarray], responses: np.ndarray, residuals: np.ndarray | None, floor: float
) -> np.ndarray:
    """Variance (...) of the logarithms of numbers by what the model cannot fit in a calibrated event.

    `responses` (1 + 2 m, n_channels, n_steps) are those at `spread_rows`, `residuals` (n_channels, n_steps) are of the
    first one, NaN where they are not known. To their variance comes the variance by a factor of all histories with the
    standard deviation `floor` of its logarithm, such as `REMAINDER`.
    """
    base = responses[0]
    from scipy.signal import hilbert  # slow to import

    variance = np.square(np.log(evaluate(np.exp(floor) * base) / evaluate(base)))
    if residuals is None:
        return variance
    scale = np.maximum(base.std(axis=1, keepdims=True), np.finfo(float).tiny)
    known = np.isfinite(residuals)
    left = np.where(known, residuals, 0.0) / scale
    changes = [0.5 * (up - down) for up, down in zip(responses[1::2], responses[2::2], strict=True)]
    changes = [(each * known / scale).ravel() for each in changes if np.isfinite(each).all()]
    if changes:
        shapes = np.stack(changes, axis=1)
        left = left - (shapes @ np.linalg.lstsq(shapes, left.ravel(), rcond=None)[0]).reshape(left.shape)
    rotated = hilbert(left, axis=1) * scale
    phases = np.exp(2j * np.pi * np.arange(_PHASES) / _PHASES)
    values = np.array([evaluate(base + (phase * rotated).real) for phase in phases])
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(values)
    logs = np.where(np.isfinite(logs), logs, np.log(evaluate(base)))
    return variance + logs.var(axis=0)
