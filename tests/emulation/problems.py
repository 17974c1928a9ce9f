"""Small posteriors for the tests of modes, emulators and guides."""

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
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
from samplers import SMCSampler

N_STEPS, DT = 200, 0.02
CHANNELS = (Channel("top", "displacement", "mm"), Channel("base", "force", "kN"))
TRUTH = np.array([1.2, 0.8])
SD = np.array([2e-3, 5.0])


def free_vibration(theta):
    """Decaying vibration: displacement [m] and spring force [N]."""
    time = DT * np.arange(N_STEPS)
    omega = 2.0 * np.pi * 1.5 * np.sqrt(theta[0])
    displacement = 0.05 * np.exp(-0.05 * theta[1] * omega * time) * np.cos(omega * time)
    return np.stack([displacement, 1e5 * theta[0] * displacement])


def noisy(model, truth=TRUTH, sd=SD, seed=1):
    """Synthetic measurements."""
    errors = sd[:, None] * np.random.default_rng(seed).standard_normal((len(sd), model.n_steps))
    return Measurements(model.channels, model.dt, model.simulate(truth) + errors)


def vibration(noise="marginal", function=free_vibration, seed=1, truth=TRUTH, damping=None):
    """Posterior of stiffness and damping of a vibrating mass, with one of the noises and priors of the library."""
    model = FunctionModel(function, ["stiffness", "damping"], CHANNELS, DT, N_STEPS)
    measured = noisy(FunctionModel(free_vibration, ["stiffness", "damping"], CHANNELS, DT, N_STEPS), truth, seed=seed)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": damping or TruncatedNormal(1.0, 0.3)}
    sigmas = {"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(20.0)}
    if noise == "marginal":
        return Posterior(FELikelihood(model, measured).marginal(sigmas), prior)
    if noise == "shared":
        return Posterior(
            FELikelihood(model, measured, GaussianNoise(measured.channels, groups="all")),
            prior | {"sigma": HalfNormal(0.3)},
        )
    if noise == "autoregressive":
        rho = {"rho_top": Uniform(-0.5, 0.9), "rho_base": Uniform(-0.5, 0.9)}
        return Posterior(FELikelihood(model, measured, AutoregressiveNoise(CHANNELS)), prior | sigmas | rho)
    options = {"sensor": {"sensor": {"top": 1e-3}}, "effective": {"effective_samples": {"top": 60.0}}, "white": {}}
    return Posterior(FELikelihood(model, measured, GaussianNoise(CHANNELS, **options[noise])), prior | sigmas)


class Shortened:
    """A displacement `respond(theta, phase)` (n,), phase from 0 to 1 over the `whole` record; it can be shortened."""

    channels = (Channel("top", "displacement", "mm"),)
    dt = DT

    def __init__(self, respond, parameter_names, whole=400, n_steps=None):
        self.respond, self.parameter_names, self.whole = respond, parameter_names, whole
        self.n_steps = n_steps or whole
        self.fingerprint = f"{respond.__name__} {self.n_steps}"

    def first(self, seconds):
        """The same model for the first part of the record."""
        return Shortened(self.respond, self.parameter_names, self.whole, round(seconds / self.dt) + 1)

    def simulate(self, theta):
        """Displacement of the first `n_steps` samples."""
        return self.respond(theta, np.arange(self.n_steps) / self.whole)[None]


def late_response(theta, phase):
    amplitude, ratio, late = theta
    early = amplitude * (np.sin(40.0 * phase) + ratio * np.cos(33.0 * phase))
    return early + (phase > 0.5) * late**2 * np.sin(25.0 * phase)


def acts_late(seed=1, respond=late_response):
    """Two modes of equal shares, late = 1 and late = -1; the first half of the record does not depend on `late`."""
    model = Shortened(respond, ("amplitude", "ratio", "late"))
    measured = noisy(model, np.array([1.2, 0.8, 1.0]), np.array([0.05]), seed)
    prior = {"amplitude": TruncatedNormal(1.0, 0.3), "ratio": TruncatedNormal(1.0, 0.3), "late": Uniform(-2.0, 2.0)}
    return _marginal(model, measured, prior)


def symmetric(seed=1, first=True):
    """Two modes of equal shares, offset = 1.2 and -1.2; the response is even in `offset`, whose prior median is 0."""
    model = Shortened(_even, ("offset", "amplitude"))
    if not first:
        model = FunctionModel(model.simulate, model.parameter_names, model.channels, DT, 400, version="symmetric")
    measured = noisy(model, np.array([1.2, 1.0]), np.array([0.05]), seed)
    prior = {"offset": TruncatedNormal(0.0, 1.0, lower=-4.0, upper=4.0), "amplitude": TruncatedNormal(1.0, 0.3)}
    return _marginal(model, measured, prior)


def _even(theta, phase):
    offset, amplitude = theta
    return amplitude * np.sin(40.0 * phase) + 0.05 * offset**2 * np.cos(33.0 * phase)


def _misled(theta, phase):
    a, b = theta
    first, last = 0.25 * (a - 1.4) * np.cos(33.0 * phase), 0.6 * (a - 0.8) * np.cos(25.0 * phase)
    two_tops = 2.0 * (a - 0.8) * (a - 1.4) * np.sin(57.0 * phase)
    return b * np.sin(40.0 * phase) + (phase < 0.3) * first + (phase > 0.6) * last + two_tops


def misleading(seed=1):
    """The first part of the record fits exactly at a = 1.4, and with an error at a = 0.8; the rest excludes a = 1.4."""
    model = Shortened(_misled, ("a", "b"), whole=1500)
    phase = np.arange(1500) / 1500
    noise = 0.05 * np.random.default_rng(seed).standard_normal((1, 1500))
    measured = Measurements(model.channels, model.dt, np.sin(40.0 * phase)[None] + noise)
    return _marginal(model, measured, {"a": TruncatedNormal(1.1, 0.4), "b": TruncatedNormal(1.0, 0.3)})


def _marginal(model, measured, prior):
    prior = prior | {"sigma_top": HalfNormal(0.5)}
    return Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()


def guided(posterior, limit=None, starts=None, seed=1, steps=1, walkers=100, Sampler=SMCSampler):
    """A run with the guide of its posterior and a limit of simulations."""
    guide = posterior.guide() if starts is None else posterior.guide(starts)
    sampler = Sampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, guide=guide, max_simulations=limit)
    sampler.run_mcmc(None, steps)
    return sampler
