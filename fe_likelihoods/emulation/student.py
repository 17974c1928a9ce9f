"""Mixtures of multivariate Student-t distributions with equal degrees of freedom."""

from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

__all__ = ["StudentMixture", "draw_mixture", "factor_of", "mixture_log_density"]


class StudentMixture(NamedTuple):
    """A mixture of t distributions."""

    weights: np.ndarray  # (k,), with sum 1
    centres: np.ndarray  # (k, d)
    factors: np.ndarray  # lower Cholesky factors of the scale matrices (k, d, d)
    freedom: float  # degrees of freedom


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor (d, d) of a covariance; variances that rounding made negative become small ones."""
    sd = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    lower = np.linalg.qr(root.T, mode="r").T
    return sd[:, None] * lower * np.sign(np.diag(lower))


def draw_mixture(mixture: StudentMixture, n: int, random: np.random.RandomState) -> np.ndarray:
    """Independent draws (n, d)."""
    d = mixture.centres.shape[1]
    component = random.choice(len(mixture.weights), n, p=mixture.weights)
    normal = random.standard_normal((n, d))
    stretch = np.sqrt(mixture.freedom / random.chisquare(mixture.freedom, n))
    return mixture.centres[component] + stretch[:, None] * np.einsum("nij,nj->ni", mixture.factors[component], normal)


def mixture_log_density(mixture: StudentMixture, coords: np.ndarray) -> np.ndarray:
    """Logarithm of the density (n,) at points (n, d)."""
    d, nu = mixture.centres.shape[1], mixture.freedom
    constant = gammaln(0.5 * (nu + d)) - gammaln(0.5 * nu) - 0.5 * d * np.log(nu * np.pi)
    total = np.full(len(coords), -np.inf)
    for weight, centre, factor in zip(*mixture[:3], strict=True):
        if weight > 0.0:
            inverse = np.linalg.inv(factor)
            squared = np.square((coords - centre) @ inverse.T).sum(axis=1)
            one = np.log(weight) + constant - np.log(np.diag(factor)).sum() - 0.5 * (nu + d) * np.log1p(squared / nu)
            total = np.logaddexp(total, one)
    return total
