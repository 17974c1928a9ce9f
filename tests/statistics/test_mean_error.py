"""Monte Carlo errors of posterior means and of the evidence from one run, compared with those over many runs."""

import emcee
import numpy as np
import pytest
from scipy import stats

from samplers import SMCSampler
from samplers.estimates.genealogy import standard_error_of_mean, trace_founders
from samplers.moves.population_moves import RandomWalkMove
from samplers.resampling import multinomial
from tests.contract.targets import Gaussian, Modes
from tests.statistics.test_posteriors import MODES, runs


def two_modes():
    """Weights 1:2, ten standard deviations apart."""
    return Modes([[1.0, 1.0, 1.0], [2.0, 1.0, 1.5]], np.array([1.0, 2.0]) / 3.0, 0.1, 3.0)


def test_walkers_without_common_founders_are_independent_draws(rng):
    chain = 3e10 * rng.standard_normal((1, 400, 2))
    expected = chain[0].std(axis=0, ddof=1) / np.sqrt(400)
    assert np.allclose(standard_error_of_mean(chain, np.arange(400)), expected, rtol=1e-12)
    constant = np.repeat(chain, 7, axis=0)  # sweeps without any change add no information
    assert np.allclose(standard_error_of_mean(constant, rng.permutation(400)), expected, rtol=1e-12)


def test_copies_count_once(rng):
    chain = rng.standard_normal((1, 400, 2))
    expected = standard_error_of_mean(chain, np.arange(400))
    copies, founders = np.repeat(chain, 5, axis=1), np.repeat(np.arange(400), 5)
    assert np.allclose(standard_error_of_mean(copies, founders), expected, rtol=1e-12)
    assert np.all(standard_error_of_mean(copies, np.arange(2000)) < expected / 2)


def test_resampled_weights_give_the_error_of_importance_sampling(rng):
    n, estimates, errors = 300, [], []
    for _ in range(300):
        x = rng.standard_normal(n)
        weights = np.exp(1.5 * x)
        ancestors = multinomial(weights / weights.sum(), rng)
        estimates.append(x[ancestors].mean())
        errors.append(standard_error_of_mean(x[ancestors][None, :, None], ancestors)[0])
    # the error of one run varies here (few points carry the weight); its square is right on average
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(estimates), rel=0.2)


def test_founders_are_followed_while_there_are_enough(rng):
    n, generations, lineage = 200, [], np.arange(200)
    for _ in range(4):
        ancestors = multinomial(np.full(n, 1 / n), rng)
        generations = trace_founders(generations, ancestors)
        lineage = lineage[ancestors]
    assert len(generations) == 4
    assert np.array_equal(generations[0], lineage) and np.array_equal(generations[-1], ancestors)
    few = trace_founders(generations, np.repeat([3, 7], n // 2))
    assert len(few) == 1 and set(few[0]) == {3, 7}


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode, target, nwalkers, low",
    [
        *((mode, Gaussian, 150, 0.6) for mode in ("default", "tmcmc", "moves", "literal")),
        # by moves, shares of modes have the error of the stages, as if no draw crossed between the modes; here nearly
        # all do, so that the stated errors are 3 times too large
        ("moves", two_modes, 120, 0.2),
        # by recycling, those of the parameters that tell the modes apart: 0.55 to 0.67 of the stated ones, by the seed
        ("default", two_modes, 250, 0.5),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_stated_errors_cover(mode, target, nwalkers, low, seed):
    """Two standard errors cover the truth in nearly 95 % of 40 short runs, and are not too wide.

    Those of the means; for the Gaussian, of standard deviations and the log-evidence too.
    """
    posterior = target()
    samplers = runs(posterior, seed, count=40, nwalkers=nwalkers, nsteps=2, **MODES[mode])
    chains = [s.get_chain(flat=True) for s in samplers]
    found = [(low, np.array([c.mean(axis=0) - posterior.mean for c in chains]), [s.mean_error() for s in samplers])]
    if target is Gaussian:
        deviations = np.array([c.std(axis=0) - posterior.sd for c in chains])
        found.append((0.6, deviations, [s.sd_error() for s in samplers]))
        evidences = np.array([[s.log_evidence - posterior.log_evidence] for s in samplers])
        found.append((0.5, evidences, [[s.log_evidence_error] for s in samplers]))
    for least, errors, stated in found:
        ratio = errors / np.array(stated)
        assert np.all(np.sum(np.abs(ratio) < 2.0, axis=0) >= stats.binom(40, 0.93).ppf(1e-3))
        assert np.all((least < np.sqrt(np.mean(ratio**2, axis=0))) & (np.sqrt(np.mean(ratio**2, axis=0)) < 1.6))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_control_walkers_counted_as_independent_give_too_small_an_error(seed):
    """Negative control: moves too short to separate copies. The error accounts for it only with the founders."""
    posterior = Gaussian(2, sd=0.1)
    samplers = runs(
        posterior, seed, count=40, nwalkers=400, nsteps=1, moves=RandomWalkMove(scale=0.3), min_moves=1, max_moves=1
    )
    errors = np.array([s.get_chain(flat=True).mean(axis=0) - posterior.mean for s in samplers])
    alone = np.array([standard_error_of_mean(s.get_chain(), np.arange(s.nwalkers)) for s in samplers])
    founders = np.array([s.mean_error() for s in samplers])
    assert np.max(np.sqrt(np.mean((errors / alone) ** 2, axis=0))) > 1.6
    assert np.all(np.sqrt(np.mean((errors / founders) ** 2, axis=0)) < 1.6)


def test_a_chain_that_another_sampler_reads_keeps_its_founders(tmp_path):
    posterior, backend = Gaussian(), emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
    sampler = SMCSampler(60, 3, posterior, vectorize=True, seed=1, recycle=False, backend=backend)
    sampler.run_mcmc(None, 3)
    again = SMCSampler(60, 3, posterior, vectorize=True, backend=backend)
    assert np.array_equal(again.mean_error(), sampler.mean_error())
    assert not np.array_equal(again.mean_error(), standard_error_of_mean(sampler.get_chain(), np.arange(60)))
    assert sampler.mean_error(discard=1).shape == (3,)


def test_walkers_that_weighted_draws_refute_have_the_error_that_is_missing():
    sampler = SMCSampler(60, 3, Gaussian(), vectorize=True, seed=1, recycle=False)
    sampler.run_mcmc(None, 3)
    mean, error = sampler.get_chain(flat=True).mean(axis=0), sampler.mean_error()
    for apart, expected in ((0.5 * error, error), (np.ones(3), np.full(3, 0.8))):
        check = sampler.log_evidence_check._replace(mean=(mean + apart).tolist(), mean_error=[0.6] * 3)
        sampler._result = sampler._result._replace(check=check)
        assert np.allclose(sampler.mean_error(), expected)
    few = check._replace(effective_sample_size=1.5, mean_error=[0.0] * 3)  # whose own error tells nothing
    sampler._result = sampler._result._replace(check=few)
    assert np.allclose(sampler.mean_error(), error)
