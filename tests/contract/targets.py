"""Posteriors with known answers, in the form the samplers ask for; they take a point (ndim,) or a batch (n, ndim)."""

import numpy as np
from scipy import stats


class Gaussian:
    """Standard normal prior, Gaussian likelihood of width `sd` about `centre`: everything is known.

    `offset` is added to the log-likelihood; `unit` multiplies every parameter: the same problem in another unit.
    """

    def __init__(self, ndim=3, sd=0.1, centre=0.7, offset=0.0, unit=1.0):
        self.ndim, self.unit, self.offset = ndim, unit, offset
        self.centre, self.width = centre, sd
        self.parameter_names = [f"x{i}" for i in range(ndim)]
        self.mean = unit * np.full(ndim, centre / (1 + sd**2))
        self.sd = unit * np.full(ndim, sd / np.sqrt(1 + sd**2))
        self.log_evidence = offset + ndim * stats.norm.logpdf(centre, 0, np.hypot(1, sd))
        self.calls = 0

    def log_prior(self, x):
        return -0.5 * np.sum((x / self.unit) ** 2, axis=-1) - self.ndim * np.log(np.sqrt(2 * np.pi) * self.unit)

    def log_likelihood(self, x):
        z = (x / self.unit - self.centre) / self.width
        return -0.5 * np.sum(z**2, axis=-1) - self.ndim * np.log(np.sqrt(2 * np.pi) * self.width) + self.offset

    def __call__(self, x):
        self.calls += len(x) if np.ndim(x) == 2 else 1
        return self.log_prior(x) + self.log_likelihood(x)

    def sample_prior(self, n, rng):
        return self.unit * rng.standard_normal((n, self.ndim))


class Box:
    """Uniform prior on a box and any log-likelihood of a batch or a point."""

    def __init__(self, low, high, log_likelihood):
        self.low, self.high = np.atleast_1d(low).astype(float), np.atleast_1d(high).astype(float)
        self.ndim = len(self.low)
        self.log_likelihood = log_likelihood

    def log_prior(self, x):
        inside = np.all((x >= self.low) & (x <= self.high), axis=-1)
        return np.where(inside, -np.sum(np.log(self.high - self.low)), -np.inf)[()]

    def __call__(self, x):
        return self.log_prior(x) + self.log_likelihood(x)

    def sample_prior(self, n, rng):
        return rng.uniform(self.low, self.high, size=(n, self.ndim))


class Modes(Box):
    """Gaussian modes of one width in a cube: their shares are the weights of their normal densities."""

    def __init__(self, centres, shares, width, side):
        self.centres, self.shares, self.width = np.array(centres), np.array(shares), width
        ndim = len(self.centres[0])
        super().__init__(np.zeros(ndim), np.full(ndim, side), self._log_likelihood)
        self.mean, self.log_evidence = self.shares @ self.centres, -ndim * np.log(side)

    def _log_likelihood(self, x):
        densities = [np.sum(stats.norm.logpdf(x, centre, self.width), axis=-1) for centre in self.centres]
        return np.logaddexp.reduce([np.log(w) + each for w, each in zip(self.shares, densities, strict=True)])


class WithBlobs(Gaussian):
    """A Gaussian that returns the squared radius and the first coordinate beside the log-density."""

    def __call__(self, x):
        blobs = np.stack([np.sum(x**2, axis=-1), x[..., 0]], axis=-1)
        return np.concatenate([np.expand_dims(super().__call__(x), -1), blobs], axis=-1)
