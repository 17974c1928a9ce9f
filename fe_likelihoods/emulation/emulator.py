"""Emulator of the response near a mode: principal components of simulated residuals, a Gaussian process for each.

A response is a smooth function of the parameters even where its misfit, summed over thousands of samples, is narrow and
curved. The emulated likelihood is the one of its mean, in closed form (``docs/theory/guided``, which also says why
variances of the process are not used).

Reference: Higdon, Gattiker, Williams & Rightley (2008), J. Am. Stat. Assoc. 103(482), doi:10.1198/016214507000000888.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from .gaussian_process import fit_process, predict
from .target import ResponseTarget

_NEGLIGIBLE_VARIANCE = 1e-3  # of the left-out components together, per run, in units of the noise variance
_SMALLEST_SHARE = 1e-10  # of the leading component


class ResponseEmulator:
    """Predicts statistics of responses near rows (m,) of the archive's runs, at least d + 4; LinAlgError if these do
    not span the parameters.

    Centre (d,) and covariance (d, d) whiten its inputs, and `slopes` (n_numbers,), derivatives of the log-likelihood by
    the statistics, are the metric in which components are in units of the noise.
    """

    def __init__(
        self, target: ResponseTarget, rows: np.ndarray, centre: np.ndarray, covariance: np.ndarray, slopes: np.ndarray
    ) -> None:
        self.target, archive, n, d = target, target.archive, len(rows), len(centre)
        centred = np.eye(n) - 1.0 / n
        products = -2.0 * archive.forms(archive.weights(archive.numbers[rows])) @ slopes
        values, vectors = np.linalg.eigh(centred @ products @ centred)
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        if values[0] <= 0.0:
            raise np.linalg.LinAlgError("the responses of all runs are equal")
        enough = 1 + int(np.argmax(values.sum() - np.cumsum(values) < _NEGLIGIBLE_VARIANCE * n))
        k = max(1, min(enough, int((values > _SMALLEST_SHARE * values[0]).sum()), n - 1))
        lengths = np.sqrt(values[:k])
        histories = np.zeros((1 + k, len(archive)))  # the mean residual and the components, as weights of runs
        histories[:, archive.numbers[rows]] = np.concatenate([np.full((1, n), 1.0 / n), vectors[:, :k].T @ centred])
        histories[1:] /= lengths[:, None]
        importance = np.minimum(1.0, values[:k] / values[0] * 1e3)
        # axes from those that the data tell best, along which the response is linear, to those left to the prior
        values, axes = np.linalg.eigh(covariance)
        axes /= np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
        fits, spread = [], np.diag(np.sqrt(np.diag(covariance)))
        for scales in target.scales:  # the ones that predict left-out runs better
            scaled = partial(target.scaled, scales=scales)
            # on a bound of the prior, parameters hardly depend on their coordinates, where any scale will do
            steps = np.diag(scaled(centre + spread) - scaled(centre - spread)) / (2.0 * np.diag(spread))
            stretch = np.maximum(steps, 1e-6 * (scaled(np.ones((1, d))) - scaled(-np.ones((1, d))))[0])
            inputs = partial(_whitened, scaled, scaled(centre[None])[0], axes / stretch[:, None])
            process = fit_process(inputs(archive.coords[rows]), vectors[:, :k] * lengths, importance)
            fits.append((float(np.square(process.left_out).sum()), scales, inputs, process))
        _, self.scales, self._inputs, self._process = min(fits, key=lambda fit: fit[0])
        self._forms = archive.forms(histories)

    def squared_distance(self, coords: np.ndarray) -> np.ndarray:
        """Squared distance (n,) of coordinates (n, >= n_structural) from the centre, in whitened parameters."""
        return np.square(self._inputs(coords)).sum(axis=1)

    def log_likelihood(self, coords: np.ndarray) -> np.ndarray:
        """Logarithm (n,) of the emulated likelihood at coordinates (n, ndim)."""
        mean = predict(self._process, self._inputs(coords))
        quadratic = np.stack([np.einsum("nk,nk->n", mean @ form, mean) for form in self._forms[1:, 1:].T], axis=1)
        statistics = np.maximum(self._forms[0, 0] + 2.0 * mean @ self._forms[1:, 0] + quadratic, np.finfo(float).tiny)
        return self.target.log_likelihood(statistics, coords[:, self.target.n_structural :])


def _whitened(scaled: Callable, centre: np.ndarray, whitening: np.ndarray, coords: np.ndarray) -> np.ndarray:
    """Inputs (n, d) at coordinates (n, >= d)."""
    return (scaled(coords)[:, : len(centre)] - centre) @ whitening
