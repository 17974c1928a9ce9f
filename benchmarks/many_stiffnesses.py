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

from .guided_runs import Reference

__all__ = [
    "DT",
    "RIDGES",
    "floors",
    "ground_motion",
    "nominal_stiffnesses",
    "ridge",
    "ridge_reference",
    "shear_building",
    "shear_model",
    "shear_truth",
]

DT = 0.02
_N_STEPS, _DAMPING, _MOTION = 1500, 0.03, 5
_SENSORS, _NOISE = 4, 0.05
_RIDGE_STEPS, _RIDGE_NOISE = 300, 1e-3
RIDGES = {
    "ridge_uniform": {"E": Uniform(0.1, 5.0), "h": Uniform(0.3, 2.0)},
    "ridge_normal": {"E": TruncatedNormal(1.0, 0.3), "h": TruncatedNormal(1.0, 0.3)},
    "ridge_short": {"E": TruncatedNormal(1.0, 0.1), "h": TruncatedNormal(1.0, 0.1)},
}


@cache
def ground_motion(seed: int = _MOTION) -> np.ndarray:
    """Filtered white noise in an envelope, peak 3 m/s2."""
    time, frequency, ratio = DT * np.arange(_N_STEPS), 2.0 * np.pi * 2.5, 0.6
    decay, turn = np.exp(-ratio * frequency * DT), np.cos(frequency * np.sqrt(1.0 - ratio**2) * DT)
    motion = lfilter([1.0], [1.0, -2.0 * decay * turn, decay**2], np.random.default_rng(seed).standard_normal(_N_STEPS))
    motion *= np.minimum(1.0, time / 3.0) * np.exp(-np.maximum(0.0, time - 10.0) / 6.0)
    return 3.0 * motion / np.abs(motion).max()


def floors(storeys: int) -> np.ndarray:
    """Indices of the measured floors."""
    return np.unique(np.round(np.linspace(storeys / _SENSORS, storeys, _SENSORS)).astype(int) - 1)


def nominal_stiffnesses(storeys: int) -> np.ndarray:
    """Stiffnesses of the storeys over the mass of a floor [1/s2]."""
    fundamental = 2.0 * np.pi / (0.1 * storeys) / (2.0 * np.sin(0.5 * np.pi / (2 * storeys + 1)))
    return fundamental**2 * np.linspace(1.3, 0.7, storeys)


def _modes(storeys: int, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared angular frequencies (n_modes,), and shapes (n_floors, n_modes) of length one."""
    stiffness = nominal_stiffnesses(storeys) * theta
    diagonal = stiffness.copy()
    diagonal[:-1] += stiffness[1:]
    return eigh_tridiagonal(diagonal, -stiffness[1:])


def _accelerations(storeys: int, seed: int, theta: np.ndarray) -> np.ndarray:
    """Absolute accelerations [m/s2] of the measured floors; each mode by its ramp-invariant filter."""
    squares, shapes = _modes(storeys, theta)
    motion, measured = ground_motion(seed), floors(storeys)
    response, remaining = np.zeros((len(measured), _N_STEPS)), np.ones(len(measured))
    for omega, shape in zip(np.sqrt(squares), shapes.T, strict=True):
        if omega > np.pi / DT:
            break
        damped, decay = omega * np.sqrt(1.0 - _DAMPING**2) * DT, np.exp(-_DAMPING * omega * DT)
        cosine, ratio = decay * np.cos(damped), decay * np.sin(damped) / damped
        numerator = [1.0 - ratio, 2.0 * (ratio - cosine), decay**2 - ratio]
        amplitude = shape[measured] * shape.sum()
        response += np.outer(amplitude, lfilter(numerator, [1.0, -2.0 * cosine, decay**2], motion))
        remaining -= amplitude
    return response + np.outer(remaining, motion)


def _derivatives(storeys: int, seed: int, theta: np.ndarray) -> np.ndarray:
    """Derivatives (n_storeys, n_floors, n_steps) of `_accelerations` by the factors of the stiffnesses."""
    squares, shapes = _modes(storeys, theta)
    motion, measured = ground_motion(seed), floors(storeys)
    drifts = np.diff(shapes, axis=0, prepend=0.0)  # (storey, mode)
    # K' of a storey couples modes m and n by the product of their drifts in it
    coupled = nominal_stiffnesses(storeys)[:, None, None] * drifts[:, :, None] * drifts[:, None, :]
    gaps = squares[None, :] - squares[:, None]
    mixing = coupled / np.where(gaps == 0.0, np.inf, gaps)  # of shape m in the derivative of shape n
    shape_slopes = np.einsum("fm,kmn->kfn", shapes, mixing)
    total, result = shapes.sum(axis=0), np.zeros((storeys, len(measured), _N_STEPS))
    undamped = np.sqrt(1.0 - _DAMPING**2)
    for n, omega in enumerate(np.sqrt(squares)):
        if omega > np.pi / DT:
            break
        angle, decay = omega * undamped * DT, np.exp(-_DAMPING * omega * DT)
        cosine, sine = decay * np.cos(angle), decay * np.sin(angle)
        ratio = sine / angle
        # derivatives by omega
        shrink, turn = -_DAMPING * DT, undamped * DT
        d_cosine, d_sine = shrink * cosine - turn * sine, shrink * sine + turn * cosine
        d_ratio, d_square = (d_sine - ratio * turn) / angle, 2.0 * shrink * decay**2
        poles = [1.0, -2.0 * cosine, decay**2]
        motion_of_mode = lfilter([1.0 - ratio, 2.0 * (ratio - cosine), decay**2 - ratio], poles, motion)
        by_omega = lfilter([-d_ratio, 2.0 * (d_ratio - d_cosine), d_square - d_ratio], poles, motion)
        by_omega -= lfilter([0.0, -2.0 * d_cosine, d_square], poles, motion_of_mode)
        amplitudes = shapes[measured, n] * total[n]
        own, whole = shape_slopes[:, measured, n], shape_slopes[:, :, n].sum(axis=1)
        changes = own * total[n] + shapes[measured, n] * whole[:, None]
        frequency_slopes = coupled[:, n, n] / (2.0 * omega)
        result += changes[:, :, None] * (motion_of_mode - motion)
        result += (frequency_slopes[:, None] * amplitudes)[:, :, None] * by_omega
    return result


def shear_truth(storeys: int, seed: int) -> np.ndarray:
    """True factors of the storeys' stiffnesses; one storey has lost 30 %."""
    truth = np.random.default_rng(100 + seed).normal(1.0, 0.1, storeys)
    truth[storeys // 3] *= 0.7
    return truth


def shear_model(storeys: int, jacobian: bool = False, motion: int = _MOTION) -> FunctionModel:
    """Shear building of d storeys under a ground motion with the given seed."""
    channels = [Channel(f"floor_{k + 1}", "acceleration", "m/s2") for k in floors(storeys)]
    names = [f"k_{k + 1}" for k in range(storeys)]
    version = f"shear building, {storeys} storeys" + (f", motion {motion}" if motion != _MOTION else "")
    own = partial(_derivatives, storeys, motion) if jacobian else None
    function = partial(_accelerations, storeys, motion)
    return FunctionModel(function, names, channels, DT, _N_STEPS, version=version, jacobian=own)


def shear_building(storeys: int, seed: int, jacobian: bool = False) -> Posterior:
    """Stiffness factors of all storeys, with priors of mean 1 and standard deviation 0.2; noise of 5 %.

    With `jacobian`, the model has derivatives in closed form.
    """
    model = shear_model(storeys, jacobian)
    names, channels = model.parameter_names, model.channels
    clean = model.simulate(shear_truth(storeys, seed))
    rms = np.sqrt(np.square(clean).mean(axis=1, keepdims=True))
    values = clean + _NOISE * rms * np.random.default_rng(seed).standard_normal(clean.shape)
    prior = {name: TruncatedNormal(1.0, 0.2) for name in names}
    prior |= {f"sigma_{c.name}": HalfNormal(float(s)) for c, s in zip(channels, rms[:, 0], strict=True)}
    measured = Measurements(channels, DT, values, f"SYNTHETIC, seed {seed}")
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
    return Reference(log_evidence, 0.0, np.array(means), none, np.array(sds), one, 0.0 * one)
