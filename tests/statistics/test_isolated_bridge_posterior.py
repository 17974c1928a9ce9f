"""The isolated bridge sampled: do TMCMC, SMC and emcee agree, with the truth and on two modes of known mass?

Slow: ``pytest -m slow -s tests/statistics/test_isolated_bridge_posterior.py`` prints the figures, half an hour on two
cores. ``SEED`` is the samplers'. The step of integration is .5 ms throughout, and the data were made with .05 ms.
"""

import functools
import os
import time
import warnings
from typing import NamedTuple

import arviz
import emcee
import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import problems
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.noise.gaussian import GaussianNoise
from fe_likelihoods.problems import table_motion
from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.presets import CHING_CHEN_2007

pytestmark = pytest.mark.slow

SEED = int(os.environ.get("SEED", "1"))
STEP = 0.5e-3
WALKERS = 1000


class Run(NamedTuple):
    """Draws of one sampler, how many of them count, and what they cost."""

    samples: np.ndarray
    effective_sample_size: float
    messages: list[str]
    log_evidence: float
    log_evidence_error: float


def truth(data: str) -> np.ndarray:
    """Ten multiples and sigma."""
    return np.append(list(problems.ISOLATED_BRIDGE_TRUTH[data].values()), problems.ISOLATED_BRIDGE_NOISE[data])


def tempered(Sampler: type, data: str, seed: int, **settings) -> Run:
    """SMC or TMCMC from the prior, 1000 walkers as in the paper."""
    posterior = problems.isolated_bridge(data=data, step=STEP)
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        sampler = Sampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
        sampler.run_mcmc(None, 2)
    samples = sampler.get_chain(flat=True)
    messages = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
    print(
        f"\n{Sampler.__name__}{' as published' if settings else ''} on {data!r}, seed {seed}: "
        f"{len(sampler.ladder)} stages, "
        f"{posterior.report()['simulations']} simulations in {time.perf_counter() - start:.0f} s, "
        f"log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f}, warnings {messages}"
    )
    return Run(samples, WALKERS, messages, sampler.log_evidence, sampler.log_evidence_error)


def ensemble(data: str, seed: int, initial: np.ndarray, n_steps: int, discard: int) -> Run:
    """emcee from given walkers."""
    posterior = problems.isolated_bridge(data=data, step=STEP)
    np.random.seed(seed)  # noqa: NPY002 - emcee's generator
    sampler = emcee.EnsembleSampler(len(initial), posterior.ndim, posterior, vectorize=True)
    start = time.perf_counter()
    sampler.run_mcmc(initial, n_steps)
    chain = sampler.get_chain(discard=discard)
    effective = arviz.ess(arviz.convert_to_dataset(chain.transpose(1, 0, 2)), method="mean")["x"].values.min()
    print(
        f"\nemcee on {data!r}: {posterior.report()['simulations']} simulations in {time.perf_counter() - start:.0f} s, "
        f"acceptance {sampler.acceptance_fraction.mean():.2f}, effective sample size {effective:.0f}"
    )
    return Run(chain.reshape(-1, posterior.ndim), float(effective), [], np.nan, np.nan)


@functools.cache
def twin(name: str) -> Run:
    """One sampler on the twin."""
    if name == "emcee":
        # from a ball at the truth: from the prior it does not arrive within this many steps
        ball = truth("twin") * (1.0 + 0.005 * np.random.default_rng(SEED).standard_normal((64, 11)))
        return ensemble("twin", SEED, ball, 2500, 800)
    Sampler, settings = {
        "smc": (SMCSampler, {}),
        "tmcmc": (TMCMCSampler, {}),
        "published": (TMCMCSampler, CHING_CHEN_2007),
    }[name]
    run = tempered(Sampler, "twin", SEED, **settings)
    z = (run.samples.mean(axis=0) - truth("twin")) / run.samples.std(axis=0)
    print(f"{name}: (mean - truth) / sd {np.round(z, 2)}, sigma {run.samples[:, -1].mean():.4f}")
    return run


# ------------------------------------------------------------------ the twin experiment


@pytest.mark.parametrize("name", ["smc", "tmcmc", "emcee"])
def test_the_truth_is_found(name):
    samples = twin(name).samples
    z = (samples.mean(axis=0) - truth("twin")) / samples.std(axis=0)
    assert np.all(np.abs(z) < 2.0), z
    assert samples[:, -1].mean() == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize(("one", "other"), [("smc", "tmcmc"), ("smc", "emcee")])
def test_samplers_agree(one, other):
    one, other = twin(one), twin(other)
    sd = one.samples.std(axis=0)
    error = sd * np.sqrt(1.0 / one.effective_sample_size + 1.0 / other.effective_sample_size)
    distance = (one.samples.mean(axis=0) - other.samples.mean(axis=0)) / error
    print("difference of the means in standard errors:", np.round(distance, 2))
    assert np.all(np.abs(distance) < 4.5)
    np.testing.assert_allclose(other.samples.std(axis=0), sd, rtol=0.2)


def test_evidences_agree():
    one, other = twin("smc"), twin("tmcmc")
    error = np.hypot(one.log_evidence_error, other.log_evidence_error)
    assert abs(one.log_evidence - other.log_evidence) < 4.0 * error


def test_tmcmc_as_published_is_wrong_and_says_so():
    """One move a sample at a scale of .2 does not decorrelate 11 parameters: the spread is far too small."""
    published, right = twin("published"), twin("smc")
    distance = np.abs(published.samples.mean(axis=0) - right.samples.mean(axis=0)) / right.samples.std(axis=0)
    print("published TMCMC, distance of the means in posterior sd:", np.round(distance, 1))
    assert distance.max() > 3.0
    assert published.messages


# ------------------------------------------------------------------ two modes of known mass


def weight_of_first_mode(samples: np.ndarray) -> float:
    """Share with the larger increment of friction at pier 2, as in the truth."""
    return float(np.mean(samples[:, 1] < samples[:, 4]))


def exact_weight(samples: np.ndarray, posterior: Posterior) -> float:
    """Of the first mode, from samples of the larger mode alone: the masses are as the prior's densities."""
    model = posterior.likelihood.model
    first = samples[:, 1] < samples[:, 4]
    larger = first if first.mean() > 0.5 else ~first
    inside = samples[larger]
    other = np.column_stack([model.exchange_piers(inside[:, :10]), inside[:, 10]])
    ratio = float(np.mean(np.exp(posterior.log_prior(other) - posterior.log_prior(inside))))
    return 1.0 / (1.0 + ratio) if first.mean() > 0.5 else ratio / (1.0 + ratio)


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
@pytest.mark.parametrize("seed", [SEED, SEED + 1, SEED + 2])
def test_masses_of_two_modes(Sampler, seed):
    run = tempered(Sampler, "means", seed)
    exact = exact_weight(run.samples, problems.isolated_bridge(data="means", step=STEP))
    weight = weight_of_first_mode(run.samples)
    print(f"weight of the first mode {weight:.3f}, exact {exact:.3f}")
    assert abs(weight - exact) < 0.05


def test_emcee_does_not_weigh_the_modes():
    """From the prior walkers come to either mode, and stay: the weights are those of where they fell."""
    posterior = problems.isolated_bridge(data="means", step=STEP)
    run = ensemble("means", SEED, posterior.sample_prior(100, SEED), 400, 200)
    chain = run.samples.reshape(200, 100, posterior.ndim)
    arrived = posterior.log_prob(chain[0]) > posterior.log_prob(truth("means")) - 50.0
    first = chain[:, arrived, 1] < chain[:, arrived, 4]
    changes = int(np.abs(np.diff(first.astype(int), axis=0)).sum())
    exact = exact_weight(
        run.samples[posterior.log_prob(run.samples) > posterior.log_prob(truth("means")) - 50.0], posterior
    )
    print(
        f"emcee from the prior: after 20 000 evaluations {arrived.sum()} of 100 walkers have arrived, "
        f"{first[-1].mean():.2f} of these in the first mode (exact {exact:.2f}); in 20 000 more they went {changes} "
        "times to the other mode"
    )
    assert arrived.sum() > 20
    assert changes <= 2


# ------------------------------------------------------------------ coverage


@functools.cache
def _motion():
    return table_motion().trim(2.0, 9.0)


def test_credible_intervals_cover():
    """Truths drawn from the prior, data made from each: the 90 % intervals hold it in about nine cases of ten."""
    n_sets, step, rng = 20, 1e-3, np.random.default_rng(SEED)
    covered = []
    for number in range(n_sets):
        true = np.append(rng.normal(1.0, 0.5, 10), 0.05)
        while np.any((true[:10] < 0.2) | (true[:10] > 2.5)):
            true[:10] = np.where((true[:10] < 0.2) | (true[:10] > 2.5), rng.normal(1.0, 0.5, 10), true[:10])
        measurements = problems.isolated_bridge_measurements(
            _motion(),
            theta=dict(zip(problems.ISOLATED_BRIDGE_TRUTH["twin"], true, strict=False)),
            outputs=6,
            noise=true[10],
            seed=1000 * SEED + number,
            step=step,
        )
        model = IsolatedBridge(_motion(), outputs=6, step=step, every=2)
        noise = GaussianNoise(measurements.channels, groups="all")
        prior = problems.isolated_bridge_prior(model.parameter_names, {"sigma": 1.0})
        posterior = Posterior(FELikelihood(model, measurements, noise), prior)
        sampler = SMCSampler(400, posterior.ndim, posterior, vectorize=True, seed=SEED + number)
        sampler.run_mcmc(None, 3)
        low, high = np.quantile(sampler.get_chain(flat=True)[:, :10], [0.05, 0.95], axis=0)
        covered.append((low <= true[:10]) & (true[:10] <= high))
    share = np.mean(covered)
    # parameters of one data set are correlated: the error comes from the spread between data sets
    error = np.std(np.mean(covered, axis=1), ddof=1) / np.sqrt(n_sets)
    print(f"covered {100 * share:.1f} +- {100 * error:.1f} % of {n_sets} x 10, by parameter {np.mean(covered, axis=0)}")
    assert abs(share - 0.9) < max(3.0 * error, stats.binom(10 * n_sets, 0.9).std() / (10 * n_sets) * 3.0)
