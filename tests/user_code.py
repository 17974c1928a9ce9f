"""Code of a user, for a type checker (`tests.test_types`): it names what the pages name first, and is never run."""

import numpy as np

import fe_likelihoods as fe
import samplers
from fe_likelihoods import Channel, FELikelihood, GaussianNoise, HalfNormal, Measurements, Posterior, Record
from samplers import SMCSampler, TMCMCSampler

record = fe.read_record("motion.at2").scale(2.0).trim(0.0, 20.0)
top = Channel("top", "displacement", "mm")
measured = Measurements((top,), record.dt, np.zeros((1, record.n_steps)))
motion = Record("made", 0.01, np.zeros(100))


def respond(theta: np.ndarray, record: Record) -> np.ndarray:
    """A function of the user, as `FunctionModel` wants it."""
    return theta[0] * record.acceleration[None]


def shake(ops, theta: np.ndarray) -> np.ndarray:
    """A function of the user, as `OpenSeesModel` wants it."""
    return np.zeros((1, 100))


models = [
    fe.FunctionModel(respond, ["k"], [top], record=record, isolated=True),
    fe.OpenSeesModel(shake, ["k"], [top], 0.01, 100),
    fe.ExecutableModel(["solver", "in.txt"], {"in.txt": "$k"}, "out.txt", ["k"], [top], 0.01, 100, time_limit=60.0),
]
columns = [
    fe.RCColumn.lhpost(record, parameters=("Ec", "fy"), fatigue=fe.LowCycleFatigue()),
    fe.IsolatedBridge(record),
    fe.LinearOscillator(record, period=0.8),
    fe.LinearStructure(fe.ShearFrame({"top": 2}, [1.0, 1.0], [400.0, 400.0]), record),
]
likelihoods = [
    FELikelihood(models[0], measured, GaussianNoise([top], level="response", window=1.0), pool=2, cache="a.sqlite"),
    FELikelihood(columns[2], measured.select(["top"]), time_shifts={"top": 0.1}),
    FELikelihood(fe.RCColumn.lhpost(record), measured),
    FELikelihood(fe.IsolatedBridge(record), measured),
    FELikelihood(fe.LinearOscillator(record), measured, fe.AutoregressiveNoise([top])),
]
response = fe.LinearOscillator(record).simulate([1.0, 1.0])
prior = fe.Prior({"k": fe.TruncatedNormal(1.0, 0.3), "sigma_top": HalfNormal(1e-3)})
posterior = Posterior(likelihoods[0], prior)
both = Posterior(likelihoods[2], {"k": fe.LogNormal(1.0, 0.3), "sigma_top": fe.Uniform(0.0, 1.0)}).marginal()
print(posterior.ndim, posterior.parameter_names, posterior(np.ones(2)), posterior.report())

sampler = SMCSampler(500, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide())
sampler.run_mcmc(None, 4, progress=True)
other = TMCMCSampler(500, posterior.ndim, posterior, vectorize=True)
print(sampler.log_evidence, sampler.verdict, samplers.compare_models({"a": sampler, "b": other}))
samples = sampler.get_chain(flat=True)
print(samplers.summary(samples, posterior.parameter_names))
samplers.plot_corner(samples, posterior.parameter_names, truths=np.ones(2))
samplers.to_arviz(sampler, posterior=posterior)

future = fe.propagate(posterior, samples[:100], record=motion, noise=True, seed=1)
fe.plot_bands(future, measured)
fe.plot_scores(future.score(measured))
peaks = fe.propagate(posterior, samples[:100], quantity=fe.peak("top"))
several = fe.propagate(posterior, samples[:100], quantity={"top": fe.peak("top"), "whole": None})
print(fe.exceedance(peaks, 50.0, unit="mm"), several["top"].mean, fe.fit_measures(posterior, samples))
residuals = likelihoods[0].residuals(np.ones(2))
fe.plot_residuals(residuals, [top], record.dt)
print(fe.residual_checks(residuals, [top]).sentences)
print(fe.align(record, measured).lag, fe.rrmse(measured.values, measured.values), fe.to_si(1.0, "mm"))
fe.plot_fit(measured, {"mean": measured})
fe.plot_sensors(fe.RCColumn.lhpost(record))
fe.report(sampler, posterior, future, "report.html")
