"""Emulator of the response near a mode: principal components of simulated residuals, a Gaussian process for each.

The residual, measured minus response, at structural parameters u is r(u) = r_0 + sum_k c_k(w) P_k, with the mean r_0 of
the training residuals, their principal components P_k in units of each channel's noise, and coefficients c_k that a
Gaussian process predicts from the whitened parameters w (`fe_likelihoods.emulation.gaussian_process`). The emulated
response is R(u) = y - r(u). A response is a smooth function of the parameters even where its misfit, summed over
thousands of samples, is narrow and curved; and the same emulator serves every noise. Its inputs are parameters, not
their standard normal coordinates, which go to infinity near a prior bound while the response hardly changes: an
emulator in coordinates would extrapolate there.

With means m_k of the coefficients, the statistics of the mean residual are, in closed form,

    S(m) = S(r_0) + 2 sum_k m_k B(r_0, P_k) + sum_kl m_k m_l B(P_k, P_l),

where B is the bilinear form of the statistics. The uncertainty of the emulator, with variances v_k of the coefficients,
enters through the expected likelihood. With the slopes f = d log L / dS at the mode, the log-likelihood is nearly
quadratic in the coefficients, with the gradient g and the Hessian -H, H_kl = -2 sum_a f_a B_a(P_k, P_l). By the method
of Laplace, the expectation over the coefficients is

    log E L = max over s of [log L(S(m + s)) - sum_k s_k^2 / (2 v_k)] - sum_k log(1 + H_kk v_k) / 2,

which is exact for a quadratic with a diagonal H. The steps s_k = t v_k g_k / (1 + H_kk v_k) are tried, with t = 0 and
with the t that is best for the quadratic. Where the emulator is certain, this is log L at the mean. Where it is not,
residuals within its uncertainty cost little, so that draws are made there and train the emulator next.

A Gaussian process with one length scale per input underestimates its error where the response has a kink or a jump. The
variances are therefore widened, per component, until the largest error of a left-out run is as large as the largest of
m normal variables, sqrt(2 log m) standard deviations.

References
----------
D. Higdon, J. Gattiker, B. Williams, M. Rightley (2008), "Computer model calibration using high-dimensional output",
Journal of the American Statistical Association 103, 570-583, doi:10.1198/016214507000000888 (principal components and
Gaussian processes).
"""

import hashlib
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..simulation.model import SimulationBatch, SimulationFailed
from .gaussian_process import GaussianProcess, fit_process, left_out_errors, predict
from .target import ResponseTarget

__all__ = ["ResponseEmulator", "TrainingSet", "fit_emulator"]

_MAX_COMPONENTS = 60
_NEGLIGIBLE_VARIANCE = 1e-3  # of the left-out components together, per run, in units of the noise variance
_SMALLEST_SHARE = 1e-10  # of the leading component
_REACH = 2.5  # squared distance up to which the emulator is used, as a multiple of the training points' largest one
_SMALLEST_SLOPE = 1e-6  # of a parameter by its coordinate, in units of its spread in the prior
_TINY = 1e-300
_WIDEST = 9.0  # factor by which variances are widened at most
_SMALLEST_GAIN = 0.02  # in log-likelihood, for which a step is tried
_ROWS = 4096  # points evaluated at once


class TrainingSet(NamedTuple):
    """Simulations that an emulator is fitted to."""

    coords: np.ndarray  # structural coordinates (m, d)
    numbers: np.ndarray  # (m,) of the runs in the archive of the target


class Whitening(NamedTuple):
    """Linear map of scaled parameters (`ResponseTarget.scaled_parameters`) to inputs of about unit variance."""

    centre: np.ndarray  # (d,) maps to zero
    matrix: np.ndarray  # (d, d): inputs are (scaled parameters - centre) @ matrix


def fit_whitening(target: ResponseTarget, centre: np.ndarray, covariance: np.ndarray) -> Whitening:
    """Whitening for a mean (d,) and covariance (d, d) of structural coordinates."""
    sd = np.sqrt(np.diag(covariance))
    low, at, high = target.scaled_parameters(np.stack([centre - sd, centre, centre + sd]))
    below, above = target.scaled_parameters(np.array([[-1.0], [1.0]]) * np.ones_like(sd))
    # d u / d z over two standard deviations; on a bound it can vanish, where any scale will do
    slope = np.maximum((high - low) / (2.0 * sd), _SMALLEST_SLOPE * (above - below))
    return Whitening(at, np.linalg.inv(np.linalg.cholesky(covariance)).T / slope[:, None])


def whitened(target: ResponseTarget, whitening: Whitening, coords: np.ndarray) -> np.ndarray:
    """Inputs (n, d) of the Gaussian process at structural coordinates (n, d)."""
    return (target.scaled_parameters(coords) - whitening.centre) @ whitening.matrix


class _Forms(NamedTuple):
    """What the expected statistics are computed from."""

    constant: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray


class ResponseEmulator:
    """A model that predicts responses instead of simulating them, near the points that it was fitted to.

    It has the members of `fe_likelihoods.simulation.model.Model`. Make one with `fit_emulator`.

    Attributes
    ----------
    reach : float
        Largest squared distance, see `squared_distance`, at which the emulator is used.
    process : GaussianProcess
        Predicts the components' coefficients.
    left_out : (m, k) float
        Errors of each training run's coefficients, predicted from the other runs.
    """

    def __init__(
        self,
        target: ResponseTarget,
        whitening: Whitening,
        process: GaussianProcess,
        histories: np.ndarray,
        coefficients: np.ndarray,
        slopes: np.ndarray,
    ) -> None:
        self._target, self._whitening, self.process = target, whitening, process
        self._histories = histories  # the mean residual and the components, as weights of runs
        self.reach = _REACH * float(np.square(process.inputs).sum(axis=1).max())
        self.left_out, variances = left_out_errors(process)
        largest = (np.square(self.left_out) / np.maximum(variances, _TINY)).max(axis=0)
        self._widening = np.clip(largest / (2.0 * np.log(len(variances))), 1.0, _WIDEST)
        self._coefficients = coefficients
        forms = target.archive.forms(histories)
        self._forms = _Forms(forms[0, 0], forms[1:, 0], forms[1:, 1:])
        self._gradient = 2.0 * self._forms.linear @ slopes
        self._hessian = 2.0 * self._forms.quadratic @ slopes

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the structural parameters, as in the emulated model."""
        return tuple(self._target.model.parameter_names)

    @property
    def channels(self) -> tuple:
        """Channels of the emulated model."""
        return tuple(self._target.model.channels)

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self._target.model.dt

    @property
    def n_steps(self) -> int:
        """Number of samples."""
        return self._target.model.n_steps

    @property
    def fingerprint(self) -> str:
        """Digest of the emulated model and of the runs that the emulator was fitted to."""
        inputs = self.process.inputs.tobytes() + self._coefficients.tobytes()
        return hashlib.blake2b(self._target.model.fingerprint.encode() + inputs, digest_size=16).hexdigest()

    @cached_property
    def _combined(self) -> np.ndarray:
        """The mean residual and the components (1 + k, n_channels, n_steps) [SI]."""
        return self._target.archive.combined(self._histories)

    def squared_distance(self, coords: np.ndarray) -> np.ndarray:
        """Squared distance (n,) of structural coordinates (n, d) from the centre, in whitened parameters."""
        return np.square(self._inputs(coords)).sum(axis=1)

    def _inputs(self, coords: np.ndarray) -> np.ndarray:
        return whitened(self._target, self._whitening, coords)

    def statistics(self, coords: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) of the mean residuals at structural coordinates (n, d)."""
        return self._at(predict(self.process, self._inputs(coords))[0])

    def log_likelihood(self, coords: np.ndarray) -> np.ndarray:
        """Logarithm (n,) of the expected likelihood, given the emulator's uncertainty.

        Parameters
        ----------
        coords : (n, ndim) float
            Coordinates of all parameters, the structural ones first.
        """
        parts = [self._log_likelihood(coords[k : k + _ROWS]) for k in range(0, len(coords), _ROWS)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _log_likelihood(self, coords: np.ndarray) -> np.ndarray:
        d = self._target.n_structural
        mean, variance = predict(self.process, self._inputs(coords[:, :d]))
        variance = variance * self._widening
        curvature = np.maximum(-np.diagonal(self._hessian), 0.0)
        gradient = self._gradient + mean @ self._hessian
        step = variance * gradient / (1.0 + curvature * variance)
        cost = (np.square(step) / np.maximum(variance, _TINY)).sum(axis=1)
        bend = cost - ((step @ self._hessian) * step).sum(axis=1)
        best = (gradient * step).sum(axis=1) / np.maximum(bend, _TINY)
        top = self._target.log_likelihood(self._at(mean), coords[:, d:])
        # far from the mode the quadratic may promise too much, but any step gives a lower bound
        rows = np.flatnonzero(0.5 * best * (gradient * step).sum(axis=1) > _SMALLEST_GAIN)
        if len(rows):
            best = best[rows]
            moved = self._at(mean[rows] + best[:, None] * step[rows])
            moved = self._target.log_likelihood(moved, coords[rows, d:]) - 0.5 * best**2 * cost[rows]
            top[rows] = np.fmax(top[rows], moved)
        return top - 0.5 * np.log1p(curvature * variance).sum(axis=1)

    def _at(self, mean: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) at coefficients (n, k)."""
        constant, linear, quadratic = self._forms
        columns = [
            constant[a] + 2.0 * mean @ linear[:, a] + ((mean @ quadratic[:, :, a]) * mean).sum(axis=1)
            for a in range(len(constant))
        ]
        return np.maximum(np.stack(columns, axis=1), np.finfo(float).tiny)

    def left_out_statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Statistics (m, n_numbers) of training runs, predicted from the other runs, and their true statistics."""
        return self._at(self._coefficients - self.left_out), self._at(self._coefficients)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Predicted response (n_channels, n_steps) [SI]; `SimulationFailed` away from the training points."""
        batch = self.simulate_batch(np.asarray(theta, dtype=float)[None])
        if batch.reasons[0]:
            raise SimulationFailed(batch.reasons[0])
        return batch.response[0]

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Predicted responses of parameters (n, d)."""
        coords = self._target.structural_coordinates(np.asarray(thetas, dtype=float))
        inside = self.squared_distance(coords) <= self.reach
        mean, _ = predict(self.process, np.where(inside[:, None], self._inputs(coords), 0.0))
        average, components = self._combined[0], self._combined[1:]
        residuals = average + np.einsum("nk,kct->nct", mean, components, optimize=True)
        if self._target.with_gaps:
            raise ValueError(
                "the emulator was fitted to measurements with missing samples, or with times of their own, and "
                "predicts the response at their samples only: predict with the posterior or the model"
            )
        response = self._target.measured - residuals
        response[~inside] = np.nan
        reason = "the parameters are outside the region that the emulator was fitted to"
        return SimulationBatch(response, ["" if good else reason for good in inside])


def fit_emulator(
    target: ResponseTarget,
    training: TrainingSet,
    centre: np.ndarray,
    covariance: np.ndarray,
    scales: np.ndarray,
    slopes: np.ndarray,
    earlier: ResponseEmulator | None = None,
) -> ResponseEmulator:
    """Fit an emulator to at least d + 4 simulations; the search starts at the length scales of an earlier fit.

    Centre (d,) and covariance (d, d) are about the mean and covariance of the posterior in structural coordinates, for
    whitening. Components are in units of `scales` (n_channels,), the standard deviations of the noise [SI]; `slopes`
    (n_numbers,) are the derivatives of the log-likelihood by the statistics at the mode.
    """
    centred = np.eye(len(training.coords)) - 1.0 / len(training.coords)
    products = target.archive.products(training.numbers, 1.0 / np.square(scales))
    values, vectors = np.linalg.eigh(centred @ products @ centred)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    if values[0] <= 0.0:
        raise np.linalg.LinAlgError("the responses of all runs are equal")
    left_out = values.sum() - np.cumsum(values)
    enough = 1 + int(np.argmax(left_out < _NEGLIGIBLE_VARIANCE * len(values)))
    k = max(1, min(enough, _MAX_COMPONENTS, int((values > _SMALLEST_SHARE * values[0]).sum()), len(values) - 1))
    lengths = np.sqrt(values[:k])
    histories = np.zeros((1 + k, len(target.archive)))
    histories[0, training.numbers] = 1.0 / len(training.coords)
    histories[1:, training.numbers] = (vectors[:, :k] / lengths).T @ centred
    coefficients = vectors[:, :k] * lengths
    whitening = fit_whitening(target, centre, covariance)
    inputs = whitened(target, whitening, training.coords)
    importance = np.minimum(1.0, values[:k] / values[0] * 1e3)
    log_scales = None if earlier is None else earlier.process.log_scales
    process = fit_process(inputs, coefficients, importance, log_scales)
    return ResponseEmulator(target, whitening, process, histories, coefficients, slopes)
