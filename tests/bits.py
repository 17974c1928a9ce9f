"""Seeded results of the whole library as bytes: ``python -m tests.bits write FILE`` or ``compare FILE``.

A change that should alter no result (files moved, code rearranged, sentences rewritten) is checked by writing the
results before it and comparing them after it on the same machine. The comparison is bit for bit, so a file written on
another processor, or with another version of numpy or numba, need not agree. Takes about two minutes.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import emcee
import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    BridgeDeck,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    LinearStructure,
    Measurements,
    Posterior,
    Prior,
    ShearFrame,
    SimulationCache,
    TruncatedNormal,
    exceedance,
    peak,
    problems,
    propagate,
    residual_checks,
)
from samplers import SMCSampler, TMCMCSampler, compare_models
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_LITERAL
from tests.contract.targets import Gaussian

__all__ = ["results"]

NOMINAL = {"frequency": 3.7, "damping": 0.05, "share": 0.8} | {f"damping_{i}": 0.03 for i in (1, 2, 3)}

Results = dict[str, np.ndarray]


class Interrupted(Exception):
    """Raised by a posterior in the middle of a run."""


class StopsAfter(Gaussian):
    """A Gaussian target that raises after a number of calls: the process that is killed, without the process."""

    def __init__(self, calls: int, **target):
        super().__init__(**target)
        self.calls_left = calls

    def __call__(self, x):
        if self.calls_left == 0:
            raise Interrupted
        self.calls_left -= 1
        return super().__call__(x)


def oscillator(noise=None) -> Posterior:
    """Linear oscillator, synthetic measurements of a correlated error."""
    record = problems.bridge_column_data().record
    record = record.resample(8 * record.dt).trim(0.0, 20.0)
    model = LinearOscillator(record, period=1.0, damping_ratio=0.05)
    clean = model.simulate([1.15, 0.7])
    values = clean + np.array([[0.2], [0.005]]) * np.random.default_rng(3).standard_normal(clean.shape)
    names = [channel.name for channel in model.channels]
    law = GaussianNoise(model.channels) if noise is None else noise(model.channels)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.5)}
    scales = dict(zip(names, (1.0, 0.03), strict=True))
    for name in law.parameter_names:
        kind, channel = name.split("_", 1)
        prior[name] = HalfNormal(scales[channel]) if kind == "sigma" else TruncatedNormal(0.0, 0.5, -1.0, 1.0)
    return Posterior(
        FELikelihood(model, Measurements(model.channels, model.dt, values, "SYNTHETIC"), law), Prior(prior)
    )


def noises() -> dict[str, Posterior]:
    """The oscillator under every kind of noise."""
    return {
        "white": oscillator(),
        "autoregressive": oscillator(AutoregressiveNoise),
        "autoregressive and sensor": oscillator(lambda c: AutoregressiveNoise(c, sensor=[0.01, 0.0001])),
        "effective samples": oscillator(lambda c: GaussianNoise(c, effective_samples=[120.0, 60.0])),
        "marginal": oscillator().marginal(),
    }


def responses() -> Results:
    """Responses and misfits of every built-in model at draws of a prior around the nominal values."""
    record = problems.bridge_column_data().record
    short = record.resample(4 * record.dt).trim(0.0, 15.0)
    column = problems.bridge_column(every=4, duration=20.0)
    bridges = {data: problems.isolated_bridge(data=data) for data in ("twin", "means")}
    models = {
        "column": column.likelihood.model,
        **{f"isolated bridge, {data}": posterior.likelihood.model for data, posterior in bridges.items()},
        "oscillator": noises()["white"].likelihood.model,
        "deck": LinearStructure(BridgeDeck("middle"), [short, short.scale(0.9), short.scale(1.1)]),
        "frame": LinearStructure(ShearFrame({"floor 1": 1, "roof": 3}, (3e3, 3e3, 2e3), (2e6, 2e6, 2e6)), short),
    }
    found: Results = {}
    for name, model in models.items():
        n = len(model.parameter_names)
        own = NOMINAL if name in ("deck", "frame") else {}
        thetas = np.array([own.get(parameter, 1.0) for parameter in model.parameter_names])
        thetas = thetas * (1.0 + 0.2 * np.random.default_rng(11).uniform(-1.0, 1.0, (4, n)))
        found[f"{name}: response"] = np.stack([model.simulate(theta) for theta in thetas])
        if hasattr(model, "misfit_batch"):
            measured = 0.9 * found[f"{name}: response"][0]
            found[f"{name}: misfits"] = np.asarray(model.misfit_batch(thetas, measured)[0])
    for name, posterior in {"column": column, **bridges, **noises()}.items():
        found[f"{name}: log_prob"] = posterior(posterior.sample_prior(12, np.random.default_rng(5)))
    for name, (real, draws) in {"column": (column, 4), "isolated bridge": (bridges["twin"], 4)}.items():
        found[f"{name}: coarse"] = (
            real.coarse(real.sample_prior(draws, np.random.default_rng(5))) if real.coarse else np.zeros(0)
        )
    white = noises()["white"]
    checks = residual_checks(white.likelihood.residuals([1.1, 0.8]))
    found["residual checks"] = np.concatenate([np.ravel(np.asarray(value, dtype=float)) for value in checks[:7]])
    return found


def of_run(sampler) -> dict[str, np.ndarray]:
    """Everything that a run hands out, but times."""
    stages = [stage._replace(seconds=0.0) for stage in sampler.ladder]
    check = sampler.log_evidence_check
    return {
        "chain": sampler.get_chain(),
        "log_prob": sampler.get_log_prob(),
        "ladder": np.array(stages, dtype=float),
        "evidence": np.array([sampler.log_evidence, sampler.log_evidence_error, sampler.log_evidence_ladder]),
        "check": np.array(check if check is not None else [], dtype=float),
        "mean error": sampler.mean_error(),
        "evaluations": np.array([sampler.evaluations]),
    }


def chains() -> Results:
    """Seeded runs of both samplers on the column, both bridges, the oscillator with every noise, and a Gaussian."""
    column = problems.bridge_column(every=8, duration=10.0)
    bridge = problems.isolated_bridge(step=1e-3)
    means = problems.isolated_bridge(data="means", step=1e-3)
    target = Gaussian(4, sd=0.02)
    runs = {
        **{f"SMC, oscillator, {name}": (SMCSampler, 260, p, {}) for name, p in noises().items()},
        "SMC by moves, oscillator": (SMCSampler, 60, oscillator(), {}),
        "TMCMC, oscillator": (TMCMCSampler, 80, oscillator(), {}),
        "SMC, column": (SMCSampler, 250, column, {}),
        "TMCMC, column": (TMCMCSampler, 30, column, {"chains": "equal", "max_moves": 3}),
        "SMC, isolated bridge": (SMCSampler, 40, bridge, {"max_moves": 3}),
        "SMC, isolated bridge, two modes": (SMCSampler, 40, means, {"max_moves": 3}),
        "SMC, Gaussian": (SMCSampler, 300, target, {}),
        "SMC, Gaussian, residual resampling": (SMCSampler, 60, target, {"resampling": "residual", "ess_ratio": 0.6}),
        "TMCMC, Gaussian, leaders": (TMCMCSampler, 100, target, {"chains": "leaders", "burn_in": 1}),
        "literal, Gaussian": (SMCSampler, 100, target, RAMANCHA_2022_LITERAL),
        "Ching and Chen, Gaussian": (TMCMCSampler, 200, target, CHING_CHEN_2007),
        "stretch, Gaussian": (SMCSampler, 60, target, {"moves": emcee.moves.StretchMove()}),
    }
    found: Results = {}
    kept = {}
    for name, (Sampler, nwalkers, posterior, settings) in runs.items():
        sampler = Sampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=7, **settings)
        sampler.run_mcmc(None, 3)
        found |= {f"{name}: {what}": values for what, values in of_run(sampler).items()}
        kept[name] = sampler
    flat = kept["SMC, oscillator, white"].get_chain(flat=True)
    prediction = propagate(oscillator(), flat, noise=True, seed=2, progress=False)
    found["prediction"] = np.stack([prediction.mean, prediction.variance, *prediction.quantiles])
    peaks = propagate(oscillator(), flat, quantity=peak("displacement"), progress=False)
    probability = exceedance(peaks, 0.05)
    found["exceedance"] = np.array([np.ravel(np.asarray(value, dtype=float))[0] for value in probability[:1]])
    compared = compare_models({"white": kept["SMC, oscillator, white"], "two": kept["TMCMC, oscillator"]})
    found["models compared"] = np.asarray(compared.probability, dtype=float)
    return found


def resumed() -> Results:
    """A run that was cut off and went on from its file, and the file read by another sampler."""
    found: Results = {}
    settings = {"smc": {"recycle": True}, "moves": {"recycle": False}}
    with tempfile.TemporaryDirectory() as folder:
        for name, more in settings.items():
            for whole, calls in (("whole", -1), ("resumed", 9)):
                path = str(Path(folder) / f"{name}-{whole}.h5")

                def make(calls, path=path, more=more):
                    return SMCSampler(
                        60,
                        3,
                        StopsAfter(calls, ndim=3, sd=0.02),
                        vectorize=True,
                        seed=5,
                        backend=emcee.backends.HDFBackend(path),
                        max_failure_share=0.0,
                        **more,
                    )

                try:
                    sampler = make(calls)
                    sampler.run_mcmc(None, 4)
                except Exception as error:  # a stated share of failures of 0 ends the run at the first one
                    if calls < 0:
                        raise error
                    sampler = make(-1)
                    sampler.run_mcmc(None, 4)
                results = of_run(sampler)
                found |= {f"{name}, {whole}: {what}": values for what, values in results.items()}
    for key in [key for key in found if ", resumed: " in key]:
        if "evaluations" not in key and not np.array_equal(found[key], found[key.replace("resumed", "whole")]):
            raise ValueError(f"{key} differs from that of the run that was not cut off")
    return found


def slow_line(theta):
    """A model of the user's own."""
    return theta[0] * np.linspace(0.0, 1.0, 50)[None] + theta[1]


def cached() -> Results:
    """Simulations kept, exported, read back by another cache, and used by another run."""
    channels = (Channel("x", "displacement", "m"),)
    model = FunctionModel(slow_line, ("a", "b"), channels, dt=0.1, n_steps=50)
    measured = Measurements(channels, 0.1, slow_line([1.0, 0.2]), "SYNTHETIC")
    prior = {"a": TruncatedNormal(1.0, 0.3), "b": TruncatedNormal(0.2, 0.3), "sigma_x": HalfNormal(0.1)}
    points = Prior(prior).rvs(40, 4)
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / name) for name in ("one.db", "copy.db", "two.db")]
        posterior = Posterior(FELikelihood(model, measured, cache=paths[0]), Prior(prior))
        first = posterior(points)
        posterior.likelihood.simulator.cache.copy(paths[1])
        second = SimulationCache(paths[2])
        second.add(paths[1])
        again = Posterior(FELikelihood(model, measured, cache=second), Prior(prior))
        found = {"cache: log_prob": first, "cache: read back": again(points)}
        found["cache: simulations"] = np.array([posterior.likelihood.simulations, again.likelihood.simulations])
        second.close()
    return found


def results() -> Results:
    """All of them."""
    return responses() | chains() | resumed() | cached()


def main() -> None:
    """Write the results, or compare them with a file of earlier ones."""
    parser = argparse.ArgumentParser(prog="python -m tests.bits", description=__doc__)
    parser.add_argument("job", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    found = results()
    if arguments.job == "write":
        np.savez_compressed(arguments.file, **{key.replace("/", "|"): value for key, value in found.items()})
        print(f"{len(found)} arrays, {sum(value.nbytes for value in found.values())} bytes, in {arguments.file}")
        return
    with np.load(arguments.file) as before:
        names = sorted(set(before.files) | set(found))
        wrong = []
        for name in names:
            if name not in before.files or name not in found:
                wrong.append(f"{name}: only {'before' if name in before.files else 'after'}")
            elif before[name].shape != found[name].shape or before[name].tobytes() != found[name].tobytes():
                wrong.append(f"{name}: differs")
    print(f"{len(names) - len(wrong)} of {len(names)} arrays are equal to the last bit", *wrong, sep="\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
