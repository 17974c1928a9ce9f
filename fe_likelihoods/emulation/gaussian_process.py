"""Gaussian process for several outputs that share their inputs and length scales.

Each output is a linear function of the inputs plus a Gaussian process with rational quadratic covariance::

    y_k(w) = b_k0 + b_k . w + f_k(w) + e_k,    cov f_k = s_k^2 (1 + |(w - w') / l|^2 / 2a)^-a,    var e_k = s_k^2 g_k,

with one length scale l per input and a shape a, common to all outputs, and a variance s_k^2 and a nugget g_k per
output. A small shape is a mixture of many length scales, as of a structure whose bars yield one after the other; for a
large one the covariance is the squared exponential. The linear part is integrated out with a flat prior: restricted
maximum likelihood (C. E. Rasmussen, C. K. I. Williams, 2006, "Gaussian Processes for Machine Learning", MIT Press,
sections 2.7 and 4.2). With N an orthonormal basis of the contrasts, which the linear part cannot explain, N'KN = U D U'
is decomposed once per length scale; a nugget and output then costs a sum.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular

_NUGGETS = 10.0 ** np.array([-9.0, -7.0, -5.0, -3.0, -1.0, 1.0])
_LOG_SCALES = -2.0, 4.0  # bounds of the logarithms of the length scales, in units of the inputs, and of the shape
_ITERATIONS, _TINY = 8, 1e-300


class GaussianProcess(NamedTuple):
    """A fitted process."""

    inputs: np.ndarray  # (m, d) of training
    log_scales: np.ndarray  # logarithms of the length scales and of the shape (d + 1,)
    linear: np.ndarray  # coefficients of the linear part (1 + d, k)
    weights: np.ndarray  # of the covariances with the training inputs (m, k)
    left_out: np.ndarray  # errors (m, k) of the training outputs as predicted from the other training points


def _basis(inputs: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(inputs)), inputs])


def _logarithm(first: np.ndarray, second: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Minus the logarithm (n, m) of the covariance over the shape, log(1 + q / 2a), of inputs (n, d) and (m, d)."""
    a, b = first / np.exp(log_scales[:-1]), second / np.exp(log_scales[:-1])
    squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None] - 2.0 * a @ b.T
    return np.log1p(0.5 * np.exp(-log_scales[-1]) * np.maximum(squared, 0.0))


def _covariance(first: np.ndarray, second: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    return np.exp(-np.exp(log_scales[-1]) * _logarithm(first, second, log_scales))


def _restricted(
    log_scales: np.ndarray, inputs: np.ndarray, contrasts: np.ndarray, targets: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minus twice the restricted log-likelihood of every nugget and output, (n_nuggets, k), up to a constant.

    Also the derivatives (d + 1,) of its mean with shares (k,), each output at its best nugget, by the logarithms of the
    length scales and the shape: with R = N (N'KN + g)^-1 N', they are tr(R K') - y'R K'R y / s^2 for an output y.
    """
    logarithm, shape = _logarithm(inputs, inputs, log_scales), np.exp(log_scales[-1])
    covariance = np.exp(-shape * logarithm)
    values, vectors = np.linalg.eigh(contrasts.T @ covariance @ contrasts)
    rotated = vectors.T @ targets
    spread = np.maximum(values, 0.0)[None] + _NUGGETS[:, None]
    variances = (1.0 / spread) @ np.square(rotated) / len(values) + _TINY
    losses = np.log(spread).sum(axis=1)[:, None] + len(values) * np.log(variances)
    best, basis = losses.argmin(axis=0), contrasts @ vectors
    solved = basis @ (rotated / spread[best].T * np.sqrt(share / variances[best, np.arange(len(best))]))
    by_covariance = ((basis * (share @ (1.0 / spread[best]))) @ basis.T - solved @ solved.T) * covariance
    less = np.exp(-logarithm)  # 1 / (1 + q / 2a)
    by_shape = shape * float((by_covariance * (1.0 - less - logarithm)).sum())
    by_covariance *= less
    squares = np.square(inputs).T @ by_covariance.sum(axis=1) - (inputs * (by_covariance @ inputs)).sum(axis=0)
    return losses, np.append(2.0 * squares * np.exp(-2.0 * log_scales[:-1]), by_shape)


def fit_process(
    inputs: np.ndarray, outputs: np.ndarray, importance: np.ndarray, log_scales: np.ndarray | None = None
) -> GaussianProcess:
    """Fit a process to outputs (m, k) at m >= d + 3 inputs (m, d) of about unit spread, by restricted likelihood.

    `importance` (k,) weights the outputs in the search for the length scales; `log_scales` (d + 1,) of another fit are
    kept.
    """
    m, d = inputs.shape
    basis, share = _basis(inputs), importance / importance.sum()
    contrasts = qr(basis)[0][:, d + 1 :]
    fixed = inputs, contrasts, contrasts.T @ outputs, share

    def loss(scales: np.ndarray) -> tuple[float, np.ndarray]:
        losses, gradient = _restricted(scales, *fixed)
        return float(losses.min(axis=0) @ share), gradient

    if log_scales is None:
        from scipy.optimize import minimize  # slow to import

        # one common scale first: cheap, and a good start for the others
        starts = (np.append(np.full(d, scale), 1.0) for scale in np.arange(0.2, 3.4, 0.4))
        start, bounds = min(starts, key=lambda scales: loss(scales)[0]), [_LOG_SCALES] * (d + 1)
        options = {"maxiter": _ITERATIONS}
        log_scales = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    nuggets = _NUGGETS[_restricted(log_scales, *fixed)[0].argmin(axis=0)]
    covariance = _covariance(inputs, inputs, log_scales)
    linear, weights, left_out = np.empty((d + 1, outputs.shape[1])), np.empty_like(outputs), np.empty_like(outputs)
    for nugget in np.unique(nuggets):
        members = np.flatnonzero(nuggets == nugget)
        factor = cho_factor(covariance + nugget * np.eye(m), lower=True)
        solved = cho_solve(factor, basis)
        gram = cho_factor(basis.T @ solved)
        linear[:, members] = cho_solve(gram, solved.T @ outputs[:, members])
        weights[:, members] = cho_solve(factor, outputs[:, members] - basis @ linear[:, members])
        # (P y)_i / P_ii, P the inverse without the linear part; both are rounding errors if a run alone tells a slope
        inverse = np.square(solve_triangular(factor[0], np.eye(m), lower=True)).sum(axis=0)
        inverse -= (solved * cho_solve(gram, solved.T).T).sum(axis=1)
        left_out[:, members] = weights[:, members] / np.maximum(inverse, np.finfo(float).eps)[:, None]
    return GaussianProcess(inputs, log_scales, linear, weights, left_out)


def predict(process: GaussianProcess, inputs: np.ndarray) -> np.ndarray:
    """Means (n, k) of the outputs at inputs (n, d)."""
    return _basis(inputs) @ process.linear + _covariance(inputs, process.inputs, process.log_scales) @ process.weights
