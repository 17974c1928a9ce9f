"""Analytic posteriors with exact evidences, means, standard deviations and shares of modes; one evaluation takes µs.

Each function returns a `Posterior`. All log-densities are of batches (n, ndim). A posterior is given by its own
density, from which the likelihood is the quotient by the prior, so every answer is exact for any prior. Where the
posterior reaches beyond the box of the prior, less than 1e-5 of it is lost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special, stats

LOG_2_PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Posterior:
    """A posterior with known answers, as the samplers take it (``vectorize=True``)."""

    ndim: int
    # log of the unnormalised posterior density (n,) at points (n, ndim) inside the box
    density: Callable[[np.ndarray], np.ndarray]
    log_evidence: float  # log of its integral
    mean: np.ndarray  # (ndim,)
    sd: np.ndarray  # (ndim,)
    # bounds of the uniform prior in every dimension; where infinite, the prior is standard normal
    lower: float = float("-inf")
    upper: float = float("inf")
    # Probability (n, k) that points (n, ndim) belong to each mode. The mean over draws of the posterior is `shares`,
    # even where modes overlap.
    responsibilities: Callable[[np.ndarray], np.ndarray] | None = None
    shares: np.ndarray | None = None  # (k,), posterior probabilities of the modes

    @property
    def bounded(self) -> bool:
        """Whether the prior is uniform in a box."""
        return np.isfinite(self.upper)

    def log_prior(self, x: np.ndarray) -> np.ndarray:
        """(n, ndim) -> (n,); -inf outside the box."""
        if not self.bounded:
            return -0.5 * np.sum(x**2, axis=1) - 0.5 * self.ndim * LOG_2_PI
        inside = np.all((x >= self.lower) & (x <= self.upper), axis=1)
        return np.where(inside, -self.ndim * np.log(self.upper - self.lower), -np.inf)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Log-posterior (n,) at points (n, ndim)."""
        return np.where(self.log_prior(x) > -np.inf, self.density(x), -np.inf)

    def sample_prior(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws of the prior, (n, ndim)."""
        if not self.bounded:
            return random.standard_normal((n, self.ndim))
        return random.uniform(self.lower, self.upper, (n, self.ndim))


def _box(prior: str) -> dict[str, float]:
    """Bounds of a prior "normal" or "box"; the box is as wide as six standard deviations of the normal prior."""
    return {} if prior == "normal" else {"lower": -3.0, "upper": 3.0}


def _mixture(shares: np.ndarray, means: np.ndarray, roots: np.ndarray, prior: str) -> Posterior:
    """Gaussian modes with given shares (k,), means (k, d) and lower roots of the covariances (k, d, d)."""
    ndim = means.shape[1]
    inverses = np.linalg.inv(roots)
    constants = np.log(shares) - 0.5 * ndim * LOG_2_PI - np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)

    def parts(x: np.ndarray) -> np.ndarray:
        z = np.einsum("kij,nkj->nki", inverses, x[:, None] - means)
        return constants - 0.5 * np.sum(z**2, axis=2)

    mean = shares @ means
    variances = np.sum(roots**2, axis=2)
    sd = np.sqrt(shares @ (variances + means**2) - mean**2)
    return Posterior(
        ndim,
        lambda x: np.logaddexp.reduce(parts(x), axis=1),
        0.0,
        mean,
        sd,
        responsibilities=lambda x: special.softmax(parts(x), axis=1),
        shares=shares,
        **_box(prior),
    )


def _direction(random: np.random.RandomState, ndim: int) -> np.ndarray:
    direction = random.standard_normal(ndim)
    return direction / np.linalg.norm(direction)


def modes(
    seed: int, count: int, ndim: int, separation: float, mass_ratio: float, volume_ratio: float, prior: str
) -> Posterior:
    """Round Gaussian modes at random positions, for a prior "normal" (standard normal) or "box" (uniform in (-3, 3)).

    The seed also decides which mode has the larger share. Logarithms of the widths and shares of the `count` modes are
    equally spaced: `mass_ratio` and `volume_ratio` (width to the power of `ndim`) are the largest divided by the
    smallest. `separation` is the distance of each mode from the first, widest one, in standard deviations of that one.
    """
    random = np.random.RandomState(seed)
    steps = np.linspace(0.0, 1.0, count)
    width = 10.0 ** random.uniform(-2.0, -1.0) * min(1.0, 15.0 / separation)
    widths = width * volume_ratio ** (-steps / ndim)
    shares = mass_ratio ** -(steps if random.uniform() < 0.5 else steps[::-1])
    centre = random.uniform(-0.5, 0.5, ndim)
    offsets = np.stack([np.zeros(ndim)] + [separation * width * _direction(random, ndim) for _ in steps[1:]])
    return _mixture(shares / shares.sum(), centre + offsets, widths[:, None, None] * np.eye(ndim), prior)


def narrow_mode(seed: int) -> Posterior:
    """Two modes of equal mass in 10-D, one unit apart, with sd 0.01 and 0.0125; the volumes differ by a factor of 9."""
    random = np.random.RandomState(seed)
    middle, half = random.uniform(-0.5, 0.5, 10), 0.5 * _direction(random, 10)
    roots = np.array([0.0125, 0.01])[:, None, None] * np.eye(10)
    return _mixture(np.array([0.5, 0.5]), middle + np.stack([half, -half]), roots, "normal")


def three_shapes(seed: int) -> Posterior:
    """Three modes of masses 0.5, 0.3, 0.2 and different shapes in 8-D: axes of 0.01 to 0.04 in random directions."""
    random = np.random.RandomState(seed)
    means = random.uniform(-0.7, 0.7, (3, 8))
    roots = []
    for _ in range(3):
        axes = np.linalg.qr(random.standard_normal((8, 8)))[0] * 10.0 ** random.uniform(-2.0, -1.4, 8)
        roots.append(np.linalg.cholesky(axes @ axes.T))
    return _mixture(np.array([0.5, 0.3, 0.2]), means, np.array(roots), "normal")


def gaussian(seed: int, ndim: int = 7, width: float = 0.01) -> Posterior:
    """A correlated Gaussian with axes of about `width` to four times that, prior N(0, 1)."""
    random = np.random.RandomState(seed)
    axes = np.linalg.qr(random.standard_normal((ndim, ndim)))[0] * width * 4.0 ** random.uniform(size=ndim)
    root = np.linalg.cholesky(axes @ axes.T)
    one = _mixture(np.ones(1), random.uniform(-1.0, 1.0, (1, ndim)), root[None], "normal")
    return Posterior(ndim, one.density, 0.0, one.mean, one.sd)


def banana(seed: int, thickness: float = 0.1) -> Posterior:
    """Bent valley in 5-D: x1 ~ N(0, 1); x2, x3 ~ N(x1^2, thickness^2); x4, x5 ~ N(0, 0.1^2); box of +-25."""
    del seed
    centres = np.array([1.0, 1.0, 0.0, 0.0])
    constants = -2.5 * LOG_2_PI - 2.0 * np.log(thickness) - 2.0 * np.log(0.1)

    def density(x: np.ndarray) -> np.ndarray:
        thick = np.array([thickness, thickness, 0.1, 0.1])
        z = (x[:, 1:] - centres * x[:, :1] ** 2) / thick
        return constants - 0.5 * x[:, 0] ** 2 - 0.5 * np.sum(z**2, axis=1)

    bent = np.sqrt(2.0 + thickness**2)
    mean, sd = np.array([0.0, 1.0, 1.0, 0.0, 0.0]), np.array([1.0, bent, bent, 0.1, 0.1])
    return Posterior(5, density, 0.0, mean, sd, -25.0, 25.0)


def rotated_banana(seed: int, bend: float = 0.03) -> Posterior:
    """Bent valley in 5-D, random axes: y1 ~ N(0, 10^2), y2 ~ N(bend (100 - y1^2), 1), others N(0, 1); box of +-150."""
    rotation = np.linalg.qr(np.random.RandomState(seed).standard_normal((5, 5)))[0]
    constant = -2.5 * LOG_2_PI - np.log(10.0)

    def density(x: np.ndarray) -> np.ndarray:
        y = x @ rotation
        bent = y[:, 1] + bend * (y[:, 0] ** 2 - 100.0)
        return constant - 0.5 * ((y[:, 0] / 10.0) ** 2 + bent**2 + np.sum(y[:, 2:] ** 2, axis=1))

    variances = np.array([100.0, 1.0 + 2e4 * bend**2, 1.0, 1.0, 1.0])
    return Posterior(5, density, 0.0, np.zeros(5), np.sqrt(rotation**2 @ variances), -150.0, 150.0)


@lru_cache
def _moments_of_rosenbrock(scale: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Log-evidence, means and standard deviations of `rosenbrock`, by sums over a grid along the chain."""
    step = 0.01
    grid, last = np.arange(-5.0, 5.0, step), np.arange(-3.0, 30.0, step)
    squares = (1.0 - grid[:, None]) ** 2
    kernel = np.exp(-(100.0 * (grid - grid[:, None] ** 2) ** 2 + squares) / scale) * step
    to_last = np.exp(-(100.0 * (last - grid[:, None] ** 2) ** 2 + squares) / scale) * step
    after = [to_last.sum(axis=1)]
    for _ in range(3):
        after.insert(0, kernel @ after[0])
    before, mean, variance = np.ones(len(grid)), [], []
    for i in range(5):
        if i == 4:
            points, density = last, before @ to_last
        else:
            points, density = grid, before * after[i]
        density = density / density.sum()
        mean.append(density @ points)
        variance.append(density @ points**2 - mean[-1] ** 2)
        before = before @ kernel if i < 3 else before
    return float(np.log(after[0].sum() * step)), np.array(mean), np.sqrt(variance)


def rosenbrock(seed: int, scale: float = 20.0) -> Posterior:
    """Rosenbrock's function in 5-D, divided by 20 (Goodman & Weare 2010, doi:10.2140/camcos.2010.5.65); box of +-30."""
    del seed

    def density(x: np.ndarray) -> np.ndarray:
        return -np.sum(100.0 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1.0 - x[:, :-1]) ** 2, axis=1) / scale

    return Posterior(5, density, *_moments_of_rosenbrock(scale), -30.0, 30.0)


def bounds(seed: int) -> Posterior:
    """A product in the unit cube, 6-D: two exponentials, two half-normals, the tail of a normal, a normal inside."""
    del seed
    scale = 0.03
    pieces = [stats.expon(scale=scale)] * 2 + [stats.truncnorm(0.0, 1.0 / scale, 0.0, scale)] * 2
    pieces += [stats.truncnorm(1.0, 1.0 / scale, -scale, scale), stats.norm(0.5, scale)]

    def density(x: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            z = x / scale
            return (
                -(z[:, 0] + z[:, 1])
                - 0.5 * (z[:, 2:4] ** 2).sum(axis=1)
                - 0.5 * ((z[:, 4] + 1.0) ** 2 + (z[:, 5] - 0.5 / scale) ** 2)
            )

    half = np.log(scale) + 0.5 * LOG_2_PI
    log_evidence = 2.0 * np.log(scale) + 2.0 * (half + np.log(0.5)) + half + special.log_ndtr(-1.0) + half
    mean, sd = np.array([[piece.mean(), piece.std()] for piece in pieces]).T
    return Posterior(6, density, float(log_evidence), mean, sd, 0.0, 1.0)


def student(seed: int, ndim: int = 10, dof: float = 3.0) -> Posterior:
    """Multivariate Student t of unit scale in a box of +-100."""
    random = np.random.RandomState(seed)
    centre = random.uniform(-5.0, 5.0, ndim)
    constant = special.gammaln(0.5 * (dof + ndim)) - special.gammaln(0.5 * dof) - 0.5 * ndim * np.log(dof * np.pi)

    def density(x: np.ndarray) -> np.ndarray:
        return constant - 0.5 * (dof + ndim) * np.log1p(np.sum((x - centre) ** 2, axis=1) / dof)

    return Posterior(ndim, density, 0.0, centre, np.full(ndim, np.sqrt(dof / (dof - 2.0))), -100.0, 100.0)


def _hash_uniform(x: np.ndarray, salt: int) -> np.ndarray:
    """Numbers in [0, 1), one per row of x (n, d): equal rows give equal numbers, others look independent."""
    bits = np.ascontiguousarray(x, dtype=float).view(np.uint64)
    state = np.full(len(bits), 0x9E3779B97F4A7C15 + salt, dtype=np.uint64)
    for column in bits.T:  # the finaliser of SplitMix64, once per column
        state = state ^ column
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)) / 2.0**53


def rough(seed: int, jump: float) -> Posterior:
    """A round Gaussian in 5-D, sd 0.05, whose log-likelihood has normal jumps of standard deviation `jump`.

    The jumps are constant in cells of a twentieth of a standard deviation, so that they average out in the integrals.
    """
    random = np.random.RandomState(seed)
    ndim, width = 5, 0.05
    centre = random.uniform(-0.5, 0.5, ndim)

    def density(x: np.ndarray) -> np.ndarray:
        z = (x - centre) / width
        jumps = special.ndtri(np.clip(_hash_uniform(np.floor(20.0 * z), seed), 1e-12, 1.0 - 1e-12))
        return -0.5 * np.sum(z**2, axis=1) + jump * jumps

    log_evidence = ndim * (np.log(width) + 0.5 * LOG_2_PI) + 0.5 * jump**2
    return Posterior(ndim, density, float(log_evidence), centre, np.full(ndim, width))
