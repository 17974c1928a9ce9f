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

    log E L = log L(S(m)) + sum_k [v_k g_k^2 / (1 + H_kk v_k) - log(1 + H_kk v_k)] / 2,

which is exact for a quadratic with a diagonal H. Where the emulator is certain, this is log L at the mean. Where it is
not, residuals within its uncertainty cost little, so that draws are made there and train the emulator next; but at most
`_LARGEST_GAIN` more than at the mean, since few draws would be left for the posterior.

A Gaussian process with one length scale per input underestimates its error where the response has a kink or a jump. The
variances are therefore widened, per component, until the largest error of a left-out run is as large as the largest of
m normal variables, sqrt(2 log m) standard deviations.

References
----------
D. Higdon, J. Gattiker, B. Williams, M. Rightley (2008), "Computer model calibration using high-dimensional output",
Journal of the American Statistical Association 103, 570-583, doi:10.1198/016214507000000888 (principal components and
Gaussian processes).
"""

from typing import NamedTuple

import numpy as np

from .gaussian_process import GaussianProcess, fit_process, left_out_errors, predict
from .target import ResponseTarget

__all__ = ["ResponseEmulator", "TrainingSet", "fit_emulator"]

_MAX_COMPONENTS = 60
_NEGLIGIBLE_VARIANCE = 1e-3  # of the left-out components together, per run, in units of the noise variance
_SMALLEST_SHARE = 1e-10  # of the leading component
_TINY = 1e-300
_WIDEST = 9.0  # factor by which variances are widened at most
# In log-likelihood, at most. Without it, draws for a cyclic test had promised 20 to 130 more than at the mean, and
# simulations gave what the mean had said.
_LARGEST_GAIN = 3.0


class TrainingSet(NamedTuple):
    """Simulations that an emulator is fitted to."""

    coords: np.ndarray  # structural coordinates (m, d)
    numbers: np.ndarray  # (m,) of the runs in the archive of the target


class _Forms(NamedTuple):
    """What the expected statistics are computed from."""

    constant: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray


class ResponseEmulator:
    """Predicts statistics of responses near the runs that it was fitted to; made by `fit_emulator`.

    `target` has the scale of its inputs; `left_out` (m, k) are the errors of each training run's coefficients as
    predicted from the other runs. Rows of `histories` (1 + k, n) are the mean residual and the components, as weights
    of runs.
    """

    def __init__(
        self,
        target: ResponseTarget,
        centre: np.ndarray,
        whitening: np.ndarray,
        process: GaussianProcess,
        histories: np.ndarray,
        coefficients: np.ndarray,
        slopes: np.ndarray,
    ) -> None:
        self.target, self._centre, self._whitening, self.process = target, centre, whitening, process
        self.left_out, variances = left_out_errors(process)
        largest = (np.square(self.left_out) / np.maximum(variances, _TINY)).max(axis=0)
        self._widening = np.clip(largest / (2.0 * np.log(len(variances))), 1.0, _WIDEST)
        self._coefficients = coefficients
        forms = target.archive.forms(histories)
        self._forms = _Forms(forms[0, 0], forms[1:, 0], forms[1:, 1:])
        self._gradient = 2.0 * self._forms.linear @ slopes
        self._hessian = 2.0 * self._forms.quadratic @ slopes

    def _inputs(self, scaled: np.ndarray) -> np.ndarray:
        return (scaled[:, : self.target.n_structural] - self._centre) @ self._whitening

    def squared_distance(self, scaled: np.ndarray) -> np.ndarray:
        """Squared distance (n,) of scaled parameters (n, >= n_structural) from the centre, in whitened parameters."""
        return np.square(self._inputs(scaled)).sum(axis=1)

    def log_likelihood(self, scaled: np.ndarray) -> np.ndarray:
        """Logarithm (n,) of the expected likelihood, given the emulator's uncertainty, at scaled parameters (n, ndim).

        The columns are those of `ResponseTarget.scaled`.
        """
        noise = scaled[:, self.target.n_structural :]
        mean, variance = predict(self.process, self._inputs(scaled))
        variance = variance * self._widening
        curved = 1.0 + variance * np.maximum(-np.diagonal(self._hessian), 0.0)
        gradient = self._gradient + mean @ self._hessian
        gain = 0.5 * (variance * np.square(gradient) / curved - np.log(curved)).sum(axis=1)
        return self.target.log_likelihood(self._at(mean), noise) + np.minimum(gain, _LARGEST_GAIN)

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
    centre, covariance = target.region_in_scaled(centre, covariance)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)).T
    inputs = (target.scaled_parameters(training.coords) - centre) @ whitening
    importance = np.minimum(1.0, values[:k] / values[0] * 1e3)
    log_scales = None if earlier is None else earlier.process.log_scales
    process = fit_process(inputs, coefficients, importance, log_scales)
    return ResponseEmulator(target, centre, whitening, process, histories, coefficients, slopes)
