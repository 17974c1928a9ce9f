"""Synthetic posteriors with many stiffnesses, and with a ridge.

A shear building of d storeys has one stiffness factor per storey, and accelerations are measured on four floors. Modes
of vibration are superposed in closed form, so that a simulation takes milliseconds. A vibrating cantilever has the
stiffness E h^3: only this product of its two parameters is identified.
"""

from functools import cache, partial

import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.signal import lfilter

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
    Uniform,
)
from tests.statistics.brute_force import Reference

__all__ = ["RIDGES", "ridge", "ridge_reference", "shear_building", "shear_truth"]

_N_STEPS, _DT, _DAMPING = 1500, 0.02, 0.03
_SENSORS, _NOISE = 4, 0.05
_RIDGE_STEPS, _RIDGE_NOISE = 300, 1e-3
RIDGES = {
    "ridge_uniform": {"E": Uniform(0.1, 5.0), "h": Uniform(0.3, 2.0)},
    "ridge_normal": {"E": TruncatedNormal(1.0, 0.3), "h": TruncatedNormal(1.0, 0.3)},
    "ridge_short": {"E": TruncatedNormal(1.0, 0.1), "h": TruncatedNormal(1.0, 0.1)},
}


@cache
def _ground_motion() -> np.ndarray:
    """Filtered white noise in an envelope, peak 3 m/s2."""
    time, frequency, ratio = _DT * np.arange(_N_STEPS), 2.0 * np.pi * 2.5, 0.6
    decay, turn = np.exp(-ratio * frequency * _DT), np.cos(frequency * np.sqrt(1.0 - ratio**2) * _DT)
    motion = lfilter([1.0], [1.0, -2.0 * decay * turn, decay**2], np.random.default_rng(5).standard_normal(_N_STEPS))
    motion *= np.minimum(1.0, time / 3.0) * np.exp(-np.maximum(0.0, time - 10.0) / 6.0)
    return 3.0 * motion / np.abs(motion).max()


def _floors(storeys: int) -> np.ndarray:
    return np.unique(np.round(np.linspace(storeys / _SENSORS, storeys, _SENSORS)).astype(int) - 1)


def _accelerations(storeys: int, theta: np.ndarray) -> np.ndarray:
    """Absolute accelerations [m/s2] of the measured floors; each mode by its ramp-invariant filter."""
    fundamental = 2.0 * np.pi / (0.1 * storeys) / (2.0 * np.sin(0.5 * np.pi / (2 * storeys + 1)))
    stiffness = fundamental**2 * np.linspace(1.3, 0.7, storeys) * theta
    diagonal = stiffness.copy()
    diagonal[:-1] += stiffness[1:]
    squares, shapes = eigh_tridiagonal(diagonal, -stiffness[1:])
    motion, floors = _ground_motion(), _floors(storeys)
    response, remaining = np.zeros((len(floors), _N_STEPS)), np.ones(len(floors))
    for omega, shape in zip(np.sqrt(squares), shapes.T, strict=True):
        if omega > np.pi / _DT:
            break
        damped, decay = omega * np.sqrt(1.0 - _DAMPING**2) * _DT, np.exp(-_DAMPING * omega * _DT)
        cosine, ratio = decay * np.cos(damped), decay * np.sin(damped) / damped
        numerator = [1.0 - ratio, 2.0 * (ratio - cosine), decay**2 - ratio]
        amplitude = shape[floors] * shape.sum()
        response += np.outer(amplitude, lfilter(numerator, [1.0, -2.0 * cosine, decay**2], motion))
        remaining -= amplitude
    return response + np.outer(remaining, motion)


def shear_truth(storeys: int, seed: int) -> np.ndarray:
    """True factors of the storeys' stiffnesses; one storey has lost 30 %."""
    truth = np.random.default_rng(100 + seed).normal(1.0, 0.1, storeys)
    truth[storeys // 3] *= 0.7
    return truth


def shear_building(storeys: int, seed: int) -> Posterior:
    """Stiffness factors of all storeys, with priors of mean 1 and standard deviation 0.2; noise of 5 %."""
    function = partial(_accelerations, storeys)
    channels = [Channel(f"floor_{k + 1}", "acceleration", "m/s2") for k in _floors(storeys)]
    names = [f"k_{k + 1}" for k in range(storeys)]
    model = FunctionModel(function, names, channels, _DT, _N_STEPS, version=f"shear building, {storeys} storeys")
    clean = function(shear_truth(storeys, seed))
    rms = np.sqrt(np.square(clean).mean(axis=1, keepdims=True))
    values = clean + _NOISE * rms * np.random.default_rng(seed).standard_normal(clean.shape)
    prior = {name: TruncatedNormal(1.0, 0.2) for name in names}
    prior |= {f"sigma_{c.name}": HalfNormal(float(s)) for c, s in zip(channels, rms[:, 0], strict=True)}
    measured = Measurements(channels, _DT, values, f"SYNTHETIC, seed {seed}")
    return Posterior(FELikelihood(model, measured, GaussianNoise(channels)), prior).marginal()


def _cantilever(theta: np.ndarray) -> np.ndarray:
    """Free vibration of the tip [m]."""
    time, omega = 0.02 * np.arange(_RIDGE_STEPS), 2.0 * np.pi * np.sqrt(theta[0] * theta[1] ** 3)
    return (0.01 * np.exp(-0.03 * omega * time) * np.cos(omega * time))[None]


def ridge(name: str, seed: int) -> Posterior:
    """E and h of a cantilever of the stiffness E h^3, with one of the priors `RIDGES`."""
    channels = [Channel("tip", "displacement", "mm")]
    model = FunctionModel(_cantilever, ("E", "h"), channels, 0.02, _RIDGE_STEPS, version="cantilever")
    values = _cantilever(np.array([1.3, 0.9]))
    values = values + _RIDGE_NOISE * np.random.default_rng(seed).standard_normal(values.shape)
    prior = RIDGES[name] | {"sigma_tip": HalfNormal(0.003)}
    return Posterior(
        FELikelihood(model, Measurements(channels, 0.02, values), GaussianNoise(channels)), prior
    ).marginal()


def ridge_reference(name: str, posterior: Posterior) -> Reference:
    """Quadrature over the stiffness k = E h^3, which the likelihood depends on, and h."""
    stiffness = np.linspace(0.7, 1.25, 3001)
    likelihood = posterior.log_likelihood(np.column_stack([stiffness, np.ones_like(stiffness)]))
    kept = likelihood > likelihood.max() - 40.0
    stiffness, likelihood = stiffness[kept], likelihood[kept]
    height = np.linspace(0.02, 3.0, 6000)
    modulus = stiffness[:, None] / height**3
    prior = RIDGES[name]
    density = likelihood[:, None] + prior["E"].logpdf(modulus) + prior["h"].logpdf(height) - 3.0 * np.log(height)
    weights = np.exp(density - density.max())
    total = weights.sum()
    area = (stiffness[1] - stiffness[0]) * (height[1] - height[0])
    log_evidence = float(density.max() + np.log(total * area))
    means, sds = [], []
    for values in (modulus, np.broadcast_to(height, weights.shape)):
        mean = float((weights * values).sum() / total)
        means.append(mean)
        sds.append(float(np.sqrt((weights * (values - mean) ** 2).sum() / total)))
    none, one = np.zeros(2), np.ones(1)
    return Reference(
        log_evidence, 0.0, np.array(means), none, np.array(sds), none, one, 0.0 * one, np.inf, weights.size
    )
