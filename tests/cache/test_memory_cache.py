"""Cache of statistics in memory, and fingerprints of posteriors."""

import dataclasses
import os
import pickle
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.priors.distributions import Distribution, HalfNormal, TruncatedNormal, Uniform
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from tests.lines import Line


def likelihood_of(model, **kwargs):
    return FELikelihood(model, Measurements(model.channels, model.dt, np.ones((2, model.n_steps))), **kwargs)


def points(rng, n, slope=0.5):
    return np.column_stack([rng.normal(size=n), np.full(n, slope), rng.uniform(0.5, 2.0, size=(n, 2))])


# cache ----------------------------------------------------------------------------------------------------------------


def test_a_change_of_the_noise_needs_no_simulation(rng):
    model = Line()
    likelihood = likelihood_of(model)
    x = points(rng, 20)
    likelihood.log_likelihood(x)
    assert (likelihood.simulations, likelihood.simulator.cache_hits) == (20, 0)
    x[:, 2:] *= rng.uniform(0.5, 2.0, size=(20, 2))
    again = likelihood.log_likelihood(x)
    assert (likelihood.simulations, likelihood.simulator.cache_hits, model.runs) == (20, 20, 20)
    np.testing.assert_array_equal(again, likelihood_of(Line(), memory_rows=0).log_likelihood(x))
    x[3, 0] = np.nextafter(x[3, 0], 9.0)
    likelihood.log_likelihood(x)
    assert (likelihood.simulations, likelihood.simulator.cache_hits) == (21, 39)


def test_the_cache_is_bounded(rng):
    model = Line()
    likelihood = likelihood_of(model, memory_rows=10)
    thetas = points(rng, 15)[:, :2]
    likelihood.misfit(thetas)  # a batch larger than the cache
    likelihood.misfit(thetas[5:])
    assert likelihood.simulations == 15
    likelihood.misfit(thetas[5:6])  # now the most recently used row
    likelihood.misfit(points(rng, 9)[:, :2])
    assert likelihood.simulations == 24
    likelihood.misfit(thetas[[5, 6]])
    assert likelihood.simulations == 25
    assert len(memory := likelihood.simulator.memory_cache) == 10
    for _ in range(20):  # outcomes that are stored again take no more room
        memory.store([b"one"], [b"outcome"])
    assert len(memory) == 10


def test_the_cache_is_not_pickled(rng):
    likelihood = likelihood_of(Line(), memory_rows=500)
    x = points(rng, 200)
    small = len(pickle.dumps(likelihood))
    values = likelihood.log_likelihood(x)
    likelihood.model.runs = 0
    assert len(pickle.dumps(likelihood)) <= small + 300
    copy = pickle.loads(pickle.dumps(likelihood))
    assert len(copy.simulator.memory_cache) == 0
    assert copy.simulator.memory_cache.most == 500
    np.testing.assert_array_equal(copy.log_likelihood(x), values)
    assert copy.model.runs == 200


# fingerprint ----------------------------------------------------------------------------------------------------------


def oscillator_posterior(**changes):
    samples = np.sin(np.arange(50.0))
    options = {"record": samples, "period": 0.6, "scale": 1.0, "unit": "g", "sd": 0.3, "noise": None, "sigma": 0.2}
    options |= changes
    model = LinearOscillator(Record("sine", 0.02, options["record"]), options["period"])
    channels = tuple(dataclasses.replace(c, unit=options["unit"]) if c.unit == "g" else c for c in model.channels)
    measurements = Measurements(channels, model.dt, options["scale"] * np.ones((2, 50)))
    likelihood = FELikelihood(model, measurements, noise=options["noise"])
    free = [HalfNormal(options["sigma"]), HalfNormal(0.005)]
    prior = {"stiffness": TruncatedNormal(1.0, options["sd"]), "damping": TruncatedNormal(1.0, 0.6)}
    prior |= dict(zip(likelihood.noise.parameter_names, free, strict=True))
    return Posterior(likelihood, prior)


@dataclass(frozen=True)
class ScaledNoise:
    """A noise with two parameters and a large table."""

    weights: np.ndarray
    parameter_names: tuple[str, ...] = ("level_a", "level_b")

    def log_likelihood(self, misfit, n_steps, parameters):
        return -(misfit / parameters).sum(axis=1)


class NamelessNoise(ScaledNoise):
    __repr__ = object.__repr__


def test_fingerprint_changes_with_what_the_density_depends_on():
    weights = np.ones(2000)
    other = weights.copy()
    other[1000] += 1e-12  # a small change in the middle of a long table
    changes = [
        {},
        {"record": np.cos(np.arange(50.0))},
        {"period": 0.61},
        {"scale": 1.0 + 1e-12},
        {"sd": np.nextafter(0.3, 1.0)},
        {"sigma": 0.21},
        {"noise": ScaledNoise(weights)},
        {"noise": ScaledNoise(other)},
        {"noise": ScaledNoise(weights, ("level_b", "level_a"))},
    ]
    fingerprints = [oscillator_posterior(**change).fingerprint for change in changes]
    assert len(set(fingerprints)) == len(changes)
    assert fingerprints[0] == oscillator_posterior().fingerprint
    assert fingerprints[0] == oscillator_posterior(unit="m/s2").fingerprint  # a display unit changes nothing
    swapped = oscillator_posterior()
    distributions = dict(swapped.prior.distributions)
    assert Posterior(swapped.likelihood, dict(reversed(distributions.items()))).fingerprint == fingerprints[0]
    uniform = Posterior(swapped.likelihood, {**distributions, "damping": Uniform(0.0, 2.0)})
    assert uniform.fingerprint not in fingerprints
    traded = {**distributions, "stiffness": distributions["damping"], "damping": distributions["stiffness"]}
    assert Posterior(swapped.likelihood, traded).fingerprint not in fingerprints


class Vague(Distribution):
    bounds, moments = (0.0, 1.0), (0.5, 0.3)
    _log_density = _quantile = lambda self, x: x


def test_values_that_a_repr_does_not_show_have_no_fingerprint():
    posterior = oscillator_posterior()
    vague = Posterior(posterior.likelihood, {**posterior.prior.distributions, "damping": Vague()})
    for each, name in ((vague, "Vague"), (oscillator_posterior(noise=NamelessNoise(np.ones(2))), "NamelessNoise")):
        with pytest.raises(ValueError, match=f"repr that shows all values of .*{name}"):
            _ = each.fingerprint


def test_fingerprint_is_the_same_in_another_process():
    root = Path(__file__).resolve().parents[2]
    code = "from test_memory_cache import oscillator_posterior; print(oscillator_posterior().fingerprint)"
    path = f"{root}{os.pathsep}{Path(__file__).parent}"
    environment = os.environ | {"PYTHONHASHSEED": "1", "PYTHONPATH": path}  # the seed of this process is another one
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == oscillator_posterior().fingerprint
    assert pickle.loads(pickle.dumps(oscillator_posterior())).fingerprint == oscillator_posterior().fingerprint
