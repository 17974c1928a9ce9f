"""Small posteriors on which a sampler that spends few simulations must be right, or refuse.

Every case is a cheap Python function behind a `FunctionModel` (see `HardPosterior`), so that a posterior takes seconds.
`brute_force.reference` gives evidence, moments and mode shares of a case, with their errors.

The cases are those in which a search from few starts, a smooth emulator or a Gaussian approximation goes wrong: several
modes, bounds, failing simulations, likelihoods with jumps, curved posteriors, few samples. The models cannot be
shortened (there is no method ``first``), and most have one channel.
"""

from functools import partial

import numpy as np

from fe_likelihoods import LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.priors.distributions import Distribution

from .case import HardPosterior

__all__ = ["CASES", "hash_uniform"]


def hash_uniform(x: np.ndarray, salt: int = 0) -> np.ndarray:
    """Numbers in [0, 1), one per row of x (n, d): equal rows give equal numbers, others look independent."""
    bits = np.ascontiguousarray(x, dtype=float).view(np.uint64)
    state = np.full(len(bits), 0x9E3779B97F4A7C15 + salt, dtype=np.uint64)
    for column in bits.T:  # the finaliser of SplitMix64, once per column
        state = state ^ column
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)) / 2.0**53


def _three(mean: float = 1.0, sd: float = 0.4) -> dict[str, Distribution]:
    return {name: TruncatedNormal(mean, sd) for name in ("a", "b", "c")}


# ------------------------------------------------------------------ features


def _smooth(x):
    a, b, c = x.T
    return np.stack([a * b, b**1.5, c / (1.0 + 0.3 * a)], axis=1)


def _two_modes(x):
    a, b, c = x.T
    # a exp(1 - a) has the value 0.729 at a = 0.4 and at a = 2.02, with slopes of ratio three
    return np.stack([a * np.exp(1.0 - a) * b, b, c * (1.0 + 0.2 * a)], axis=1)


def _three_modes(x):
    a, b, c = x.T
    return np.stack([(a - 0.4) * (a - 0.9) * (a - 2.0) * b, b, c * (1.0 + 0.2 * a)], axis=1)


def _far(width, gain, x):
    a, b, c = x.T
    dip = 2.4 * np.exp(-0.5 * ((a - 2.4) / width) ** 2)
    # the last feature is an effect that only the narrow modes have: it gives them a share of about one half
    return np.stack([(a - dip) * b, b, c, gain / (1.0 + np.exp(-40.0 * (a - 1.8)))], axis=1)


def _at_bounds(x):
    a, b, c, d = x.T
    return np.stack([a + 0.1 * b, b * (1.0 + 0.3 * a), b * c, d], axis=1)


def _failing_region(x):
    return np.where((x[:, 0] + x[:, 1] > 2.476)[:, None], np.nan, _smooth(x))


def _failing_scattered(x):
    return np.where((hash_uniform(x) < 0.2)[:, None], np.nan, _smooth(x))


def _rough(size, x):
    cells = np.floor(x[:, :2] / np.array([0.004, 0.003]))
    jumps = np.stack([hash_uniform(cells, salt) - 0.5 for salt in (1, 2)], axis=1)
    features = _smooth(x)
    features[:, :2] += 2.0 * size * 0.05 / np.sqrt(200.0) * jumps
    return features


def _banana(thickness, x):
    a, b, c = x.T
    return np.stack([(b - a**2) * 0.0035 / thickness, 0.02 * a, c], axis=1)


def _product(x):
    a, b, c = x.T
    return np.stack([a * b, c * np.sqrt(a * b)], axis=1)


def _four(x):
    a, b, c, d = x.T
    return np.stack([a * b, b + 0.3 * c**2, c * d, np.sqrt(a) - 0.5 * d], axis=1)


# ------------------------------------------------------------------ responses over time


def _free_vibration(x, n_steps=400):
    """Twenty cycles of a decaying vibration: the likelihood of the stiffness has a local maximum every few per cent."""
    stiffness, damping, amplitude = x.T[:, :, None]
    phase = 2.0 * np.pi * 20.0 * np.sqrt(stiffness) * np.linspace(0.0, 1.0, n_steps)
    return (amplitude * np.exp(-0.02 * damping * phase) * np.cos(phase))[:, None]


def _small_or_large(x):
    return (x[:, 0] > 1.0).astype(int)


def _thirds(x):
    return np.searchsorted([0.636, 1.564], x[:, 0])  # the extrema between the three roots


def _near_or_far(x):
    return np.searchsorted([1.5, 2.4], x[:, 0])


_WIDE = {"a": Uniform(0.0, 3.0), "b": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.4)}

CASES = {
    "smooth": HardPosterior("nothing: a mildly curved posterior, for comparison", _three(), _smooth, [0.9, 1.1, 0.7]),
    "two_modes": HardPosterior(
        "two modes, one three times as wide as the other",
        {"a": TruncatedNormal(1.2, 0.7), "b": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.4)},
        _two_modes,
        [0.729, 1.0, 1.08],
        label=_small_or_large,
        n_modes=2,
    ),
    "three_modes": HardPosterior(
        "three modes with widths of 1, 1.5 and 0.5",
        {"a": Uniform(0.0, 2.6), "b": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.4)},
        _three_modes,
        [0.0, 1.0, 1.2],
        label=_thirds,
        n_modes=3,
    ),
    "far": HardPosterior(
        "two narrow modes with half the mass, in a region that holds a tenth of the prior, far from the wide mode",
        _WIDE,
        partial(_far, 0.15, 0.0063),
        [0.8, 1.0, 1.0, 0.0063],
        label=_near_or_far,
        n_modes=3,
        balanced=True,
    ),
    "bounds": HardPosterior(
        "three of four parameters at a bound of their prior",
        {
            "a": Uniform(0.0, 2.0),
            "b": TruncatedNormal(1.0, 0.4),
            "c": TruncatedNormal(1.0, 0.5),
            "d": Uniform(0.0, 2.0),
        },
        _at_bounds,
        [0.1 - 0.004, 1.0, 0.0, 2.01],
    ),
    "failing_region": HardPosterior(
        "simulations fail in a region with 20 % of the prior and half of the posterior that would be there without it",
        _three(),
        _failing_region,
        [1.3 * 1.176, 1.176**1.5, 1.0 / 1.39],
    ),
    "failing_scattered": HardPosterior(
        "one simulation in five fails, at points without any pattern", _three(), _failing_scattered, [0.9, 1.1, 0.7]
    ),
    "rough_mild": HardPosterior(
        "a log-likelihood with jumps of up to one", _three(), partial(_rough, 0.5), [0.9, 1.1, 0.7]
    ),
    "rough": HardPosterior(
        "a log-likelihood with jumps of one to three", _three(), partial(_rough, 1.5), [0.9, 1.1, 0.7]
    ),
    "banana": HardPosterior(
        "a curved posterior, bent by several times its thickness",
        {"a": TruncatedNormal(1.0, 0.5), "b": TruncatedNormal(1.0, 1.0), "c": TruncatedNormal(1.0, 0.4)},
        partial(_banana, 0.02),
        [0.0, 0.02, 1.0],
    ),
    "product": HardPosterior("two parameters of which only the product has an effect", _three(), _product, [0.9, 0.95]),
    "few_samples": HardPosterior(
        "30 samples for four parameters",
        _three() | {"d": TruncatedNormal(1.0, 0.4)},
        _four,
        [1.0, 1.3, 1.0, 0.5],
        noise=0.3,
        n_steps=30,
    ),
    "side_lobes": HardPosterior(
        "a frequency: local maxima of the likelihood every few per cent, a model that cannot be shortened",
        {
            "stiffness": TruncatedNormal(1.0, 0.3),
            "damping": LogNormal(1.0, 0.5),
            "amplitude": TruncatedNormal(1.0, 0.3),
        },
        respond=_free_vibration,
        truth=[1.23, 0.8, 1.1],
        noise=0.2,
        n_steps=400,
    ),
    "sampled_noise": HardPosterior(
        "standard deviations of the noise as parameters, two channels",
        _three(),
        _smooth,
        [0.9, 1.1, 0.7],
        n_channels=2,
        error_model="white",
    ),
    "correlated_noise": HardPosterior(
        "autoregressive noise with two parameters, one channel",
        _three(),
        _smooth,
        [0.9, 1.1, 0.7],
        error_model="autoregressive",
    ),
}
"""All cases by name."""
