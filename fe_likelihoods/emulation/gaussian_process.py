"""Gaussian process for several outputs that share their inputs and length scales.

Each output is a linear function of the inputs plus a Gaussian process with squared exponential covariance::

    y_k(w) = b_k0 + b_k . w + f_k(w) + e_k,    cov f_k = s_k^2 exp(-|(w - w') / l|^2 / 2),    var e_k = s_k^2 g_k,

with one length scale l per input, common to all outputs, and a variance s_k^2 and a nugget g_k per output. The linear
part is integrated out with a flat prior (restricted maximum likelihood, [1]_ section 2.7 with an infinitely wide
prior). With N an orthonormal basis of the contrasts (the vectors that the linear part cannot explain), N'KN = U D U'
is decomposed once per length scale; every nugget and output then costs a sum.

References
----------
.. [1] C. E. Rasmussen, C. K. I. Williams (2006), "Gaussian Processes for Machine Learning", MIT Press.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular
from scipy.optimize import minimize

__all__ = ["GaussianProcess", "fit_process", "left_out_errors", "predict", "predict_mean"]

_NUGGETS = 10.0 ** np.array([-9.0, -7.0, -5.0, -3.0, -1.0, 1.0])
_LOG_SCALES = -2.0, 4.0  # bounds of the logarithms of the length scales, in units of the inputs
_TINY = 1e-300


class _Level(NamedTuple):
    """Outputs with the same nugget: their indices and what their variance needs.

    `root` is the inverse of the Cholesky factor of the covariance: products with it are quicker than solutions.
    """

    outputs: np.ndarray
    nugget: float
    root: np.ndarray
    solved: np.ndarray
    gram: tuple


class GaussianProcess(NamedTuple):
    """A fitted process."""

    inputs: np.ndarray  # (m, d) of training
    log_scales: np.ndarray  # logarithms of the length scales (d,)
    linear: np.ndarray  # coefficients of the linear part (1 + d, k)
    weights: np.ndarray  # of the covariances with the training inputs (m, k)
    variances: np.ndarray  # s_k^2 (k,)
    levels: tuple[_Level, ...]  # groups of outputs with equal nugget, for the variance


def _basis(inputs: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(inputs)), inputs])


def _covariance(first: np.ndarray, second: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    a, b = first / np.exp(log_scales), second / np.exp(log_scales)
    squared = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None] - 2.0 * a @ b.T
    return np.exp(-0.5 * np.maximum(squared, 0.0))


def _restricted(log_scales: np.ndarray, inputs: np.ndarray, contrasts: np.ndarray, targets: np.ndarray) -> tuple:
    """Minus twice the restricted log-likelihood of every nugget and output, (n_nuggets, k), up to a constant.

    Also the covariance (m, m) of the inputs, and the decomposition that `_gradient` needs.
    """
    covariance = _covariance(inputs, inputs, log_scales)
    values, vectors = np.linalg.eigh(contrasts.T @ covariance @ contrasts)
    rotated = vectors.T @ targets
    spread = np.maximum(values, 0.0)[None] + _NUGGETS[:, None]
    variances = (1.0 / spread) @ np.square(rotated) / len(values) + _TINY
    losses = np.log(spread).sum(axis=1)[:, None] + len(values) * np.log(variances)
    return losses, covariance, contrasts @ vectors, rotated, spread, variances


def _gradient(log_scales: np.ndarray, inputs: np.ndarray, share: np.ndarray, fitted: tuple) -> np.ndarray:
    """Derivatives (d,) by the logarithms of the length scales of the mean loss with shares (k,), each at its nugget.

    With R = N (N'KN + g)^-1 N', the loss of an output y has the derivative tr(R K') - y'R K'R y / s^2.
    """
    losses, covariance, basis, rotated, spread, variances = fitted
    best = losses.argmin(axis=0)
    trace, solved = np.zeros(basis.shape[1]), np.empty_like(rotated)
    for g in np.unique(best):
        members = best == g
        trace += share[members].sum() / spread[g]
        solved[:, members] = rotated[:, members] / spread[g][:, None] * np.sqrt(share[members] / variances[g, members])
    solved = basis @ solved
    by_covariance = ((basis * trace) @ basis.T - solved @ solved.T) * covariance
    squares = np.square(inputs).T @ by_covariance.sum(axis=1) - (inputs * (by_covariance @ inputs)).sum(axis=0)
    return 2.0 * squares * np.exp(-2.0 * log_scales)


def fit_process(
    inputs: np.ndarray,
    outputs: np.ndarray,
    importance: np.ndarray,
    log_scales: np.ndarray | None = None,
    iterations: int = 8,
) -> GaussianProcess:
    """Fit a process to outputs (m, k) at m >= d + 3 inputs (m, d) of about unit spread, by restricted likelihood.

    `importance` (k,) weights the outputs in the search for the length scales, which starts at `log_scales` (d,), such
    as those of an earlier fit; 0 iterations keep the start.
    """
    m, d = inputs.shape
    basis = _basis(inputs)
    contrasts = qr(basis)[0][:, d + 1 :]
    targets = contrasts.T @ outputs
    share = importance / importance.sum()

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        fitted = _restricted(parameters, inputs, contrasts, targets)
        return float(fitted[0].min(axis=0) @ share), _gradient(parameters, inputs, share, fitted)

    if log_scales is None:  # one common scale first: cheap, and a good start for the others
        log_scales = min((np.full(d, scale) for scale in np.arange(0.2, 3.4, 0.4)), key=lambda scales: loss(scales)[0])
    log_scales = np.asarray(log_scales, dtype=float)
    if iterations > 0:
        bounds, options = [_LOG_SCALES] * d, {"maxiter": iterations}
        log_scales = minimize(loss, log_scales, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    losses, covariance, *_ = _restricted(log_scales, inputs, contrasts, targets)
    nuggets = _NUGGETS[losses.argmin(axis=0)]
    linear, weights = np.empty((d + 1, outputs.shape[1])), np.empty_like(outputs)
    variances, levels = np.empty(outputs.shape[1]), []
    for nugget in np.unique(nuggets):
        members = np.flatnonzero(nuggets == nugget)
        factor = cho_factor(covariance + nugget * np.eye(m), lower=True)
        solved = cho_solve(factor, basis)
        gram = cho_factor(basis.T @ solved)
        linear[:, members] = cho_solve(gram, solved.T @ outputs[:, members])
        rest = outputs[:, members] - basis @ linear[:, members]
        weights[:, members] = cho_solve(factor, rest)
        variances[members] = (rest * weights[:, members]).sum(axis=0) / (m - d - 1)
        root = solve_triangular(factor[0], np.eye(m), lower=True)
        levels.append(_Level(members, float(nugget), root, solved, gram))
    return GaussianProcess(inputs, log_scales, linear, weights, variances, tuple(levels))


def predict(process: GaussianProcess, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (n, k) of the outputs; the variance includes nugget and uncertainty of the linear part."""
    covariance, basis = _covariance(inputs, process.inputs, process.log_scales), _basis(inputs)
    mean = basis @ process.linear + covariance @ process.weights
    variance = np.empty_like(mean)
    for members, nugget, root, solved, gram in process.levels:
        explained = np.square(covariance @ root.T).sum(axis=1)
        gap = basis - covariance @ solved
        unknown = (gap * cho_solve(gram, gap.T).T).sum(axis=1)
        variance[:, members] = np.maximum(1.0 - explained + unknown, 0.0)[:, None] + nugget
    return mean, variance * process.variances


def predict_mean(process: GaussianProcess, inputs: np.ndarray) -> np.ndarray:
    """Mean (n, k) of the outputs at inputs (n, d), without the variance, which takes most of the time of `predict`."""
    return _basis(inputs) @ process.linear + _covariance(inputs, process.inputs, process.log_scales) @ process.weights


def left_out_errors(process: GaussianProcess) -> tuple[np.ndarray, np.ndarray]:
    """Error (m, k) of every training output as predicted from the other training points, and its variance.

    With P the inverse of the covariance after the linear part has been projected out, the error is (P y)_i / P_ii, and
    its variance is s^2 / P_ii, both in closed form.
    """
    errors, variances = np.empty_like(process.weights), np.empty_like(process.weights)
    for members, _, root, solved, gram in process.levels:
        inverse = np.square(root).sum(axis=0)
        projected = inverse - (solved * cho_solve(gram, solved.T).T).sum(axis=1)
        projected = np.maximum(projected, _TINY)[:, None]
        errors[:, members] = process.weights[:, members] / projected
        variances[:, members] = process.variances[members] / projected
    return errors, variances
