"""Gradient of the log-likelihood of models that know the derivatives of their response.

With the response y(theta), its derivatives J (the model's ``jacobian``) and the statistics S of the residuals, which
any noise reduces to a log-likelihood l(S, noise), the derivative along a structural parameter k is

    d l / d theta_k = d/dh l(S(y + h J_k), noise) at h = 0.

The derivative by h is a five-point difference of log-likelihoods. It simulates nothing, holds for every noise, and is
exact up to rounding where S is quadratic in the response and l is linear in S, as for Gaussian errors of known size.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..noise.protocol import noise_statistic
from ..simulation.model import SimulationBatch, derivatives_batch, misfit_of_responses

__all__ = ["likelihood_gradient", "slopes_along"]

# Offsets and weights of differences of fourth order, central and towards larger values.
_CENTRAL = np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
_FORWARD = np.arange(5.0), np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0

# Steps as shares of the distance to a bound or of a standard deviation, and of the residuals: a relative error of about
# 1e-12 by the order of the difference, and as much by rounding.
_STEP = 1e-3
_AT_BOUND = 1e-9  # distance to a bound, in standard deviations, at which the difference is one-sided


def slopes_along(
    density: Callable[[np.ndarray], np.ndarray], point: np.ndarray, sd: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Derivatives (k,) of a log-density of rows (n, k) at a point (k,); `sd` (k,) and `bounds` (k, 2) set the steps."""
    room = np.abs(bounds - point[:, None])
    at_low, at_high = (room <= _AT_BOUND * sd[:, None]).T
    steps = _STEP * np.minimum(sd, np.where(room > _AT_BOUND * sd[:, None], room, np.inf).min(axis=1))
    plans = [
        (_FORWARD if low or high else _CENTRAL, -step if high else step)
        for low, high, step in zip(at_low, at_high, steps, strict=True)
    ]
    rows = [
        point + step * offset * unit
        for ((offsets, _), step), unit in zip(plans, np.eye(len(point)), strict=True)
        for offset in offsets
    ]
    values, slopes = iter(density(np.array(rows))), []
    for (_, weights), step in plans:
        slopes.append(sum(weight * next(values) for weight in weights) / step)
    return np.array(slopes)


def likelihood_gradient(
    likelihood: Any, rows: np.ndarray, sd: np.ndarray, bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (n, ndim) of the log-likelihood at rows (n, ndim), and where (n,) all simulations succeeded; else zeros.

    `sd` (ndim,) are scales of the parameters and `bounds` (ndim, 2) bounds of the prior.
    """
    total, good = np.zeros(rows.shape), np.ones(len(rows), dtype=bool)
    for part, columns in likelihood.data_sets():
        own, left = columns[: part.simulator.n_structural], np.flatnonzero(good)
        batch, noise = part.simulate(rows[np.ix_(left, own)]), columns[len(own) :]
        good[left] = [not reason for reason in batch.reasons]
        derivatives = derivatives_batch(part.model, rows[np.ix_(good, own)], part.simulator.pool)
        for k, response, along in zip(np.flatnonzero(good), batch.response[good[left]], derivatives, strict=True):
            total[k, columns] += _slopes(part, response, along, rows[k, noise], sd[noise], bounds[noise])
    total[~good] = 0.0
    return total, good


def _slopes(
    part: Any, response: np.ndarray, along: np.ndarray, noise: np.ndarray, sd: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Derivatives of a log-likelihood as its response (c, n) moves along derivatives (d, c, n), and by its noise."""
    d = len(along)

    def density(moved: np.ndarray) -> np.ndarray:
        batch = SimulationBatch(response + np.tensordot(moved[:, :d], along, 1), [""] * len(moved))
        statistics, _ = misfit_of_responses(part.model, batch, part.measured, noise_statistic(part.noise))
        return part.noise.log_likelihood(statistics, part.n_samples, moved[:, d:])

    sizes = np.sqrt(np.nanmean(np.square(part.residuals_of(response)), axis=1))
    moves = np.sqrt(np.square(along).mean(axis=2))
    # the channel that moves most, compared with its residuals, sets the step
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.where((moves > 0.0) & (sizes > 0.0), sizes / moves, np.inf).min(axis=1)
    scales = np.where(np.isfinite(scales), scales, 1.0)
    free = np.full((d, 2), [-np.inf, np.inf])
    return slopes_along(density, np.append(np.zeros(d), noise), np.append(scales, sd), np.concatenate([free, bounds]))
