"""Hierarchical posterior of six specimens of an oscillator under one record against NUTS on the whole model.

Every specimen has its own stiffness, damping and noise. Ours: each test is sampled alone by SMC, without the noise
levels (`Posterior.marginal`), and the population is sampled from the stored posteriors. Reference: PyMC samples the
population, the parameters of all tests and all noise levels at once, 2000 draws with exact gradients. Its oscillator is
written once more, as a sum over earlier loads in PyTensor; the largest difference of its response is a row.

PyMC is no requirement of the tests. It needs an environment of its own, since PyTensor replaces a newer numba::

    python -m venv ENV && ENV/bin/pip install -e '.[test]' 'pymc>=5.28,<6'
    ENV/bin/python -m benchmarks hierarchy

M. D. Hoffman, A. Gelman (2014), The No-U-Turn sampler, Journal of Machine Learning Research 15, 1593-1623.
"""

from typing import Any

import numpy as np

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    StoredPosterior,
    Varying,
)
from samplers import SMCSampler

from .rows import Row

__all__ = ["oscillator"]

_TESTS, _STEPS, _DT = 6, 100, 0.05
_NAMES = ("stiffness", "damping")
_MEDIAN, _SPREAD = np.array([1.0, 1.2]), np.array([0.15, 0.4])  # of the population that the tests are drawn from
_MEDIAN_SD, _SPREAD_SD = np.array([0.5, 0.6]), np.array([0.3, 0.5])  # of the priors of the hyper-parameters
_NOISE, _NOISE_SD = np.array([0.5, 0.02]), np.array([1.0, 0.05])  # [m/s²], [m]; standard deviations and their priors
_PRIOR = {name: LogNormal(1.0, sd) for name, sd in zip(_NAMES, _MEDIAN_SD, strict=True)}
_PRIOR |= {"sigma_acceleration": HalfNormal(_NOISE_SD[0]), "sigma_displacement": HalfNormal(_NOISE_SD[1])}


def oscillator(repeats: int = 1) -> list[Row]:
    """Shifts of the means of hyper-parameters and parameters of tests, in standard deviations; one set per seed."""
    rows = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        model = LinearOscillator(Record("noise", _DT, rng.standard_normal(_STEPS)))
        data = {}
        for k in range(_TESTS):
            response = model.simulate(_MEDIAN * np.exp(_SPREAD * rng.standard_normal(2)))
            data[f"specimen {k}"] = response + _NOISE[:, None] * rng.standard_normal(response.shape)
        ours = _from_stored_posteriors(model, data, seed)
        reference, difference = _from_nuts(model, data, seed)
        rows.append(Row("largest difference of the two responses", f"oscillator, seed {seed}", difference, ""))
        for name, theirs in reference.items():
            shift = float((ours[name].mean() - theirs.mean()) / theirs.std())
            note = f"sd ratio {ours[name].std() / theirs.std():.3f}; NUTS {theirs.mean():.4f} +- {theirs.std():.4f}"
            rows.append(Row(f"shift of the mean of {name}", f"oscillator, seed {seed}", shift, "sd", note))
    return rows


def _from_stored_posteriors(model: LinearOscillator, data: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    """Samples of the hyper-parameters and the parameters of the tests by `HierarchicalPosterior`."""
    tests = {}
    for name, values in data.items():
        measured = Measurements(model.channels, model.dt, values)
        posterior = Posterior(FELikelihood(model, measured), _PRIOR).marginal()
        sampler = SMCSampler(1000, posterior.ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 1, progress=False)
        tests[name] = StoredPosterior(sampler.get_chain(flat=True), posterior.prior)
    varying = {
        name: Varying(LogNormal(1.0, median_sd), HalfNormal(spread_sd))
        for name, median_sd, spread_sd in zip(_NAMES, _MEDIAN_SD, _SPREAD_SD, strict=True)
    }
    population = HierarchicalPosterior(tests, varying)
    sampler = SMCSampler(1000, population.ndim, population, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 4, progress=False)
    result = Hierarchy(population, sampler.get_chain(flat=True))
    found = dict(zip(population.parameter_names, result.samples.T, strict=True))
    for test in tests:
        found |= {f"{name} of {test}": draws for name, draws in result.draw_test(test, seed).items()}
    return found


def _from_nuts(model: LinearOscillator, data: dict[str, np.ndarray], seed: int) -> tuple[dict[str, np.ndarray], float]:
    """The same samples by NUTS on the whole model, and the largest relative difference of its response from ours."""
    import pymc
    import pytensor.tensor as pt

    with pymc.Model():
        medians = pymc.LogNormal("median", 0.0, _MEDIAN_SD)
        spreads = pymc.HalfNormal("spread", _SPREAD_SD)
        # centred: each specimen informs its parameters well
        theta = pymc.Deterministic("theta", pt.exp(pymc.Normal("logs", pt.log(medians), spreads, shape=(_TESTS, 2))))
        noise = pymc.HalfNormal("noise", _NOISE_SD, shape=(_TESTS, 2))
        responses = _responses(model, theta[:, 0], theta[:, 1])
        pymc.Normal("data", responses, noise[:, :, None], observed=np.stack(list(data.values())))
        trace = pymc.sample(1000, tune=1000, chains=2, cores=1, random_seed=seed, progressbar=False).posterior
    found = {}
    for i, name in enumerate(_NAMES):
        found[f"median_{name}"] = trace["median"][..., i].to_numpy().ravel()
        found[f"sd_log_{name}"] = trace["spread"][..., i].to_numpy().ravel()
    for k, test in enumerate(data):
        found |= {f"{name} of {test}": trace["theta"][..., k, i].to_numpy().ravel() for i, name in enumerate(_NAMES)}
    points = pt.dmatrix()
    evaluate = pymc.pytensorf.compile([points], _responses(model, points[:, 0], points[:, 1]))
    difference = 0.0
    for values in trace["theta"][0, ::250].to_numpy():
        expected = np.stack([model.simulate(each) for each in values])
        error = np.abs(evaluate(values) - expected).max(axis=2) / np.abs(expected).max(axis=2)
        difference = max(difference, float(error.max()))
    return found, difference


def _responses(model: LinearOscillator, stiffness: Any, damping: Any) -> Any:
    """Responses (n_tests, 2, n_steps) of the oscillator as an expression of PyTensor; parameters (n_tests,).

    The complex coordinate of `fe_likelihoods.signals.sdof` is a sum over the loads: q_k = sum over j = 1 ... k of
    exp(z (k - j)) (b_0 a_j + b_1 a_{j-1}), with z the eigenvalue times the step. PyTensor has no gradients of complex
    numbers, so they are pairs of real ones.
    """
    import pytensor.tensor as pt

    def times(a: tuple, b: tuple) -> tuple:
        return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]

    def over(a: tuple, b: tuple) -> tuple:
        real, imaginary = times(a, (b[0], -b[1]))
        return real / (b[0] ** 2 + b[1] ** 2), imaginary / (b[0] ** 2 + b[1] ** 2)

    dt, load, steps = model.dt, model.record.acceleration, np.arange(model.n_steps)[:, None]
    earlier = steps - steps.T  # loads a_j by the number of steps since then; none before the first step
    now = np.where(earlier >= 1, load[np.maximum(earlier, 0)], 0.0)
    before = np.where(earlier >= 1, load[np.maximum(earlier - 1, 0)], 0.0)
    ratio, omega = damping * model.damping_ratio, 2.0 * np.pi / model.period * pt.sqrt(stiffness)
    damped = omega * pt.sqrt(1.0 - ratio**2)
    eigenvalue = -ratio * omega, damped
    z = eigenvalue[0] * dt, eigenvalue[1] * dt
    decay, angle = pt.exp(z[0] * steps), z[1] * steps
    powers = decay * pt.cos(angle), decay * pt.sin(angle)
    first = pt.exp(z[0]) * pt.cos(z[1]) - 1.0, pt.exp(z[0]) * pt.sin(z[1])
    constant = over(first, z)
    slope = over((constant[0] - 1.0, constant[1]), z)
    b_0 = -dt * slope[0], -dt * slope[1]
    b_1 = -dt * (constant[0] - slope[0]), -dt * (constant[1] - slope[1])
    terms = [times(b, tuple(pt.dot(loads, part) for part in powers)) for b, loads in ((b_0, now), (b_1, before))]
    q = terms[0][0] + terms[1][0], terms[0][1] + terms[1][1]  # (n_steps, n_tests)
    displacement, velocity = q[1] / damped, times(eigenvalue, q)[1] / damped
    acceleration = -2.0 * ratio * omega * velocity - omega**2 * displacement
    return pt.stack([acceleration.T, displacement.T], axis=1)
