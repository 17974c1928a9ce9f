"""Figures of the documentation that need runs of their own: three samplers on both systems, and what goes wrong.

Short records and few walkers keep the runs short; all data are synthetic and made by the models themselves, so that the
true parameters are known. ``make figures`` calls this module.
"""

import emcee
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import lfilter

from fe_likelihoods import (
    AutoregressiveNoise,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
    Uniform,
    plot_residuals,
    problems,
)
from fe_likelihoods.problems import table_motion
from samplers import SMCSampler, TMCMCSampler, plot_corner

__all__ = ["bridge", "column", "correlated_errors"]

SEED = 1
CORRELATION_TIME = 0.6  # [s] of the errors: as of model errors, which change more slowly than the samples follow


def three_samplers(posterior: Posterior, truths: np.ndarray, title: str, walkers: int = 80) -> Figure:
    """Samples of SMC, TMCMC and emcee, which starts from the last walkers of TMCMC and needs no burn-in then."""
    samples = {}
    # different seeds: with few walkers both samplers make the same moves
    for seed, Sampler in enumerate((SMCSampler, TMCMCSampler), start=SEED):
        sampler = Sampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
        state = sampler.run_mcmc(None, 5)
        samples[Sampler.__name__.removesuffix("Sampler")] = sampler.get_chain(flat=True)
        print(f"{title}, {Sampler.__name__}: {sampler.simulations:.0f} simulations; {sampler.verdict}")
    np.random.seed(SEED)  # noqa: NPY002 - emcee uses NumPy's global generator
    sampler = emcee.EnsembleSampler(walkers, posterior.ndim, posterior, vectorize=True)
    sampler.run_mcmc(state, 40)
    samples["emcee, started from TMCMC"] = sampler.get_chain(flat=True, discard=10)
    return plot_corner(samples, posterior, truths=truths, title=title)


def column() -> Figure:
    """The column under four seconds of the synthetic motion."""
    motion = problems.bridge_column_data().record
    motion = motion.resample(16 * motion.dt).trim(5.0, 9.0)
    posterior = problems.bridge_column(record=motion)
    truths = np.array([*problems.BRIDGE_COLUMN_MEANS.values(), *problems.BRIDGE_COLUMN_NOISE.values()])
    return three_samplers(posterior, truths, "Bridge column, 4 s of synthetic data")


def bridge() -> Figure:
    """The isolated bridge under four seconds of the motion of the table."""
    motion = table_motion().trim(0.0, 4.0)
    theta, noise = problems.ISOLATED_BRIDGE_TRUTH["twin"], problems.ISOLATED_BRIDGE_NOISE["twin"]
    measured = problems.isolated_bridge_measurements(motion, theta=theta, noise=noise, step=2.5e-3)
    posterior = problems.isolated_bridge(record=motion, measurements=measured, channels=6, step=2.5e-3)
    return three_samplers(
        posterior, np.array([*theta.values(), noise]), "Isolated bridge, 4 s of synthetic data, assumed nominal values"
    )


def _oscillator(seed: int) -> tuple[Measurements, LinearOscillator, np.ndarray]:
    """Synthetic measurements with errors that are correlated from sample to sample."""
    motion = problems.bridge_column_data().record
    motion = motion.resample(2 * motion.dt).trim(0.0, 25.0)
    model = LinearOscillator(motion, period=1.0, damping_ratio=0.05)
    truth, correlation = np.array([1.15, 0.7]), np.exp(-motion.dt / CORRELATION_TIME)
    clean = model.simulate(truth)
    errors = np.random.default_rng(seed).standard_normal(clean.shape)
    errors[:, 1:] *= np.sqrt(1.0 - correlation**2)
    errors = 0.3 * clean.std(axis=1, keepdims=True) * lfilter([1.0], [1.0, -correlation], errors, axis=1)
    return Measurements(model.channels, model.dt, clean + errors, "SYNTHETIC: errors with correlation"), model, truth


def _sample(
    measured: Measurements, model: LinearOscillator, correlated: bool, seed: int
) -> tuple[Posterior, np.ndarray]:
    """Posterior and samples under white noise or under AR(1) errors."""
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.5)}
    prior |= {
        f"sigma_{channel.name}": HalfNormal(scale) for channel, scale in zip(model.channels, (5.0, 0.2), strict=True)
    }
    noise = AutoregressiveNoise(model.channels) if correlated else GaussianNoise(model.channels)
    prior |= {f"rho_{channel.name}": Uniform(0.0, 1.0) for channel in model.channels} if correlated else {}
    posterior = Posterior(FELikelihood(model, measured, noise), Prior(prior))
    sampler = SMCSampler(300, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 4)
    return posterior, sampler.get_chain(flat=True)


def correlated_errors() -> dict[str, Figure]:
    """What white noise does to a posterior when the errors are correlated: intervals too narrow, and how to see it."""
    measured, model, truth = _oscillator(SEED)
    runs = {"white noise": _sample(measured, model, False, SEED), "AR(1) noise": _sample(measured, model, True, SEED)}
    labels = [parameter.label for parameter in runs["white noise"][0].parameters[:2]]
    samples = {label: x[:, :2] for label, (_, x) in runs.items()}
    posterior, x = runs["white noise"]
    residuals = posterior.likelihood.residuals(x.mean(axis=0))
    return {
        "wrong_noise": plot_corner(samples, labels=labels, truths=truth, title="Correlated errors (synthetic data)"),
        "wrong_noise_residuals": plot_residuals(residuals, model.channels, model.dt),
    }
