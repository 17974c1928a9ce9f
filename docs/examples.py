"""What the examples of the reference use, besides NumPy and all public names (``tests/test_examples.py``)."""

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
    RCColumn,
    Record,
    ShearFrame,
    StoredPosterior,
    Uniform,
    Varying,
    propagate,
)
from samplers import SMCSampler

# an oscillator with a period of 1 s under a motion of 10 s, and what was measured on it
time = np.arange(200) * 0.05
record = Record("shaking", 0.05, np.sin(6.0 * time) * np.exp(-0.3 * time))
model = LinearOscillator(record)
noise = np.random.default_rng(1).normal(size=(2, 200)) * [[0.5], [0.02]]
measurements = Measurements(model.channels, record.dt, model.simulate([1.1, 0.9]) + noise)

# its posterior, a run, and a prediction
prior = {
    "stiffness": LogNormal(1.0, 0.2),
    "damping": Uniform(0.2, 4.0),
    "sigma_acceleration": HalfNormal(1.0),
    "sigma_displacement": HalfNormal(0.05),
}
likelihood = FELikelihood(model, measurements)
posterior = Posterior(likelihood, prior)
sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
sampler.run_mcmc(None, 3)
samples = sampler.get_chain(flat=True)
prediction = propagate(posterior, samples, noise=True)

# two other structures
column = RCColumn.lhpost(record)
frame = ShearFrame({"floor 1": 1, "roof": 2}, masses=[1.0, 1.0], stiffnesses=[900.0, 900.0])

# three oscillators of one kind, their posteriors with samples, and the population that they belong to
posteriors, tests, draw = {}, {}, np.random.default_rng(2).normal
for name, stiffness in {"north": 0.9, "middle": 1.0, "south": 1.2}.items():
    measured = Measurements(model.channels, record.dt, model.simulate([stiffness, 0.9]) + noise)
    posteriors[name] = Posterior(FELikelihood(model, measured), prior)
    chain = draw([stiffness, 0.9, 0.5, 0.02], [0.003, 0.03, 0.03, 0.001], size=(300, 4))
    tests[name] = StoredPosterior(chain, posterior.prior)
varying = {"stiffness": Varying(LogNormal(1.0, 0.5), HalfNormal(0.3))}
population = HierarchicalPosterior(tests, varying, common={"damping": prior["damping"]})
run = SMCSampler(100, population.ndim, population, vectorize=True, seed=1)
run.run_mcmc(None, 2)
hierarchy = Hierarchy(population, run.get_chain(flat=True))
