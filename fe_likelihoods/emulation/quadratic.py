"""Statistics of residuals that are quadratic forms, evaluated for linear combinations of given histories.

The sums that a Gaussian noise needs (sums of squares, of squared differences, ...) are quadratic in the residual r. For
a residual r = sum_i c_i v_i of known histories v_i they are

    S(r) = sum_ij c_i c_j B(v_i, v_j),    B(a, b) = (S(a + b) - S(a - b)) / 4,

so that, once the forms B(v_i, v_j) are known, S costs a few multiplications instead of a pass over the history. No
statistic needs to be known in more detail than as a function.
"""

from collections.abc import Callable

import numpy as np

from ..noise.statistics import sums_of_squares

__all__ = ["bilinear_form", "check_quadratic"]

_TOLERANCE = 1e-6


def bilinear_form(
    statistic: Callable[[np.ndarray], np.ndarray], first: np.ndarray, second: np.ndarray | None = None
) -> np.ndarray:
    """The symmetric bilinear form B(first_i, second_j) (k, l, n_numbers) of a statistic that is quadratic in residuals.

    Histories are (k, n_channels, n_steps) and (l, n_channels, n_steps), the first ones by default.
    """
    others = first if second is None else second
    if statistic is sums_of_squares:
        return np.matmul(first.transpose(1, 0, 2), others.transpose(1, 2, 0)).transpose(1, 2, 0)
    width = len(statistic(first[0]))
    form = np.empty((len(first), len(others), width))
    for i, a in enumerate(first):
        for j, b in enumerate(others):
            if second is None and j < i:
                form[i, j] = form[j, i]
                continue
            scale = np.abs(a).max() / (np.abs(b).max() or 1.0) or 1.0
            form[i, j] = 0.25 * (statistic(a + scale * b) - statistic(a - scale * b)) / scale
    return form


def check_quadratic(statistic: Callable[[np.ndarray], np.ndarray], residuals: np.ndarray) -> None:
    """Raise ValueError if a statistic is not quadratic in the residuals (n_channels, n_steps)."""
    if statistic is sums_of_squares:
        return
    other = np.roll(residuals, residuals.shape[-1] // 3, axis=-1)
    direct = statistic(residuals + 0.5 * other)
    form = bilinear_form(statistic, np.stack([residuals, other]))
    combined = form[0, 0] + form[0, 1] + 0.25 * form[1, 1]
    if not np.allclose(direct, combined, rtol=_TOLERANCE, atol=_TOLERANCE * np.abs(direct).max()):
        raise ValueError(
            f"the statistic {statistic!r} of the noise is not quadratic in the residuals, so the posterior cannot be "
            "emulated from responses: use GaussianNoise, AutoregressiveNoise, or a sampler "
            "without a guide"
        )
