"""Sweeps over parameters that cost no simulation: the right posterior, nothing else touched, nothing simulated."""

import pickle
from multiprocessing.pool import ThreadPool

import emcee
import numpy as np
import pytest
from emcee.model import Model
from scipy import stats

from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.probability.likelihood import FELikelihood
from fe_likelihoods.probability.posterior import Posterior
from fe_likelihoods.probability.priors import HalfNormal, TruncatedNormal
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from samplers import (
    CHING_CHEN_2007,
    RAMANCHA_2022_CONSTANT,
    RAMANCHA_2022_LITERAL,
    SMCSampler,
    TemperedSampler,
    TMCMCSampler,
)
from samplers.moves.fast_parameters import WithFastSweeps, _FreeWalk
from samplers.moves.kernels import MixtureMove, RandomWalkMove
from tests.contract.targets import Gaussian, WithBlobs
from tests.statistics.test_posteriors import deviations, evidence_deviation, runs, within


class NormalInverseGamma:
    """Mean and standard deviation of a sample, under the conjugate prior: everything is known.

    The variance is inverse gamma (2, 1); the mean, given it, is normal about zero with the variance itself.
    """

    ndim = 2
    fast_parameters = (1,)

    def __init__(self, n=12):
        y = stats.norm.ppf((np.arange(n) + 0.5) / n, 0.8, 0.4)
        self.n, self.centre, self.square = n, y.mean(), np.sum((y - y.mean()) ** 2)
        self.shape = 2.0 + 0.5 * n
        self.scale = 1.0 + 0.5 * self.square + 0.5 * n / (1.0 + n) * self.centre**2
        self.mean = n * self.centre / (1.0 + n)
        variance = stats.invgamma(self.shape, scale=self.scale)
        self.variance, self.median = variance.mean(), np.sqrt(variance.median())
        # evidence by Bayes' rule, at any point
        at = np.array([0.7, 0.5])
        posterior = variance.logpdf(0.25) + np.log(1.0) + stats.norm.logpdf(0.7, self.mean, 0.5 / np.sqrt(1.0 + n))
        self.log_evidence = self.log_likelihood(at) + self.log_prior(at) - np.log(2 * 0.5) - posterior

    def log_prior(self, x):
        mean, sd = x[..., 0], x[..., 1]
        with np.errstate(all="ignore"):
            variance = sd * sd
            log_prior = stats.invgamma.logpdf(variance, 2.0) + np.log(2.0 * sd) + stats.norm.logpdf(mean, 0.0, sd)
        return np.where(sd > 0.0, log_prior, -np.inf)[()]

    def log_likelihood(self, x):
        mean, sd = x[..., 0], x[..., 1]
        square = self.square + self.n * (mean - self.centre) ** 2
        return -self.n * np.log(np.sqrt(2 * np.pi) * sd) - 0.5 * square / sd**2

    def __call__(self, x):
        return self.log_prior(x) + self.log_likelihood(x)

    def sample_prior(self, n, rng):
        sd = np.sqrt(1.0 / rng.gamma(2.0, size=n))
        return np.column_stack([sd * rng.standard_normal(n), sd])


class Noisy(Gaussian):
    fast_parameters = (0, 2)


class NoisyWithBlobs(WithBlobs):
    fast_parameters = (2,)


MODES = {
    "recycling": {},
    "moves": {"recycle": False},
    "walk": {"moves": RandomWalkMove(adapt=True), "min_moves": 6, "max_moves": 15},
    "stretch": {"moves": emcee.moves.StretchMove(), "min_moves": 8, "max_moves": 20},
    "tmcmc": {"Sampler": TMCMCSampler},
    "leaders": {"Sampler": TMCMCSampler, "chains": "leaders", "burn_in": 3, "moves": RandomWalkMove(adapt=True)},
}


# ---------------------------------------------------------------- the right posterior


@pytest.mark.parametrize("mode", MODES)
def test_conjugate_sample(mode, seed):
    posterior = NormalInverseGamma()
    samplers = runs(posterior, seed, **MODES[mode])
    assert all(isinstance(move, WithFastSweeps) for s in samplers for move in s._moves)
    assert within(deviations(samplers, posterior.mean, lambda x: x[:, 0]), samplers)
    assert within(deviations(samplers, posterior.variance, lambda x: x[:, 1] ** 2), samplers)
    assert within(deviations(samplers, 0.5, lambda x: x[:, 1] < posterior.median), samplers)
    assert within(evidence_deviation(samplers, posterior.log_evidence), samplers)


class WrongMove(WithFastSweeps):
    """Free sweeps that drift upwards, without the ratio for it."""

    def __init__(self, move, indices):
        super().__init__(move, indices, sweeps=5)
        walk, draw = self._walk, self._walk._draw

        def drift(coords, random):
            proposed, factors = draw(coords, random)
            proposed[:, walk.indices] += walk._root.diagonal()
            return proposed, factors

        self._walk.get_proposal = drift


def test_wrong_free_sweeps_are_caught(seed):
    """Negative control: the criterion of the test above can fail."""
    posterior = NormalInverseGamma()
    samplers = []
    for k in range(8):
        sampler = SMCSampler(200, 2, posterior, vectorize=True, seed=[seed, k], recycle=False, fast_sweeps=0)
        sampler._moves = [WrongMove(MixtureMove(), (1,))]  # its closure cannot be copied, as a sampler does with moves
        sampler.run_mcmc(None, 4)
        samplers.append(sampler)
    assert not within(deviations(samplers, 0.5, lambda x: x[:, 1] < posterior.median), samplers)


class Still(emcee.moves.Move):
    """The costly move that never moves."""

    def propose(self, model, state):
        return state, np.zeros(len(state.coords), dtype=bool)


def target(x):
    """Log density of two coordinates whose second has a spread that depends on the first, and blobs to tell points."""
    return stats.norm.logpdf(x[:, 0]) + stats.norm.logpdf(x[:, 1], x[:, 0], np.exp(0.5 * x[:, 0])), x.copy()


@pytest.fixture
def ensemble(rng):
    """Exact draws of `target`, and what moves them."""
    first = rng.normal(size=20_000)
    first[:2] = -0.0, 5e-324
    x = np.column_stack([first, rng.normal(first, np.exp(0.5 * first))])
    log_prob, blobs = target(x)
    state = emcee.State(x, log_prob=log_prob, blobs=blobs, copy=True)
    return state, Model(None, target, map, np.random.RandomState(rng.integers(2**31)))


def test_free_sweeps_alone_keep_the_target_and_the_other_coordinates(ensemble):
    """Exact draws stay exact draws, the held coordinate keeps every bit, and values and blobs go with their points."""
    state, model = ensemble
    start = state.coords.copy()
    move = WithFastSweeps(Still(), [1], sweeps=10)
    move.calibrate(start[:500] * np.array([1.2, 0.7]), np.full(500, 1 / 500))  # a fit to something else makes no matter
    state, accepted = move.propose(model, state)
    assert not accepted.any()  # the flags are those of the costly move
    assert state.coords[:, 0].tobytes() == start[:, 0].tobytes()
    assert np.mean(state.coords[:, 1] != start[:, 1]) > 0.9
    np.testing.assert_array_equal(state.blobs, state.coords)
    np.testing.assert_array_equal(state.log_prob, target(state.coords)[0])
    z = (state.coords[:, 1] - start[:, 0]) * np.exp(-0.5 * start[:, 0])
    assert stats.kstest(z, "norm").pvalue > 1e-4
    assert stats.ks_2samp(state.coords[:10_000, 1], start[10_000:, 1]).pvalue > 1e-4


def test_the_walk_has_the_conditional_covariance(rng):
    covariance = np.array([[1.0, 0.9, 0.2], [0.9, 1.0, 0.5], [0.2, 0.5, 2.0]]) * np.outer([1, 1e6, 1], [1, 1e6, 1])
    points = rng.multivariate_normal(np.zeros(3), covariance, size=100_000)
    for free, held in (([1], [0, 2]), ([0, 2], [1])):
        walk = _FreeWalk(free)
        walk.calibrate(points, np.full(len(points), 1.0 / len(points)))
        cross = covariance[np.ix_(free, held)]
        expected = covariance[np.ix_(free, free)] - cross @ np.linalg.solve(covariance[np.ix_(held, held)], cross.T)
        assert walk._root @ walk._root.T == pytest.approx(expected, rel=0.05)


def test_the_scale_is_steered_by_tuning_alone(ensemble):
    state, model = ensemble
    move = WithFastSweeps(RandomWalkMove(), [1])
    fixed = emcee.EnsembleSampler(64, 2, lambda x: target(x[None])[0][0], moves=move)
    fixed.run_mcmc(state.coords[:64], 5)
    assert move._walk._log_factor == 0.0
    move.calibrate(10.0 * state.coords, np.full(len(state.coords), 1 / len(state.coords)))  # much too wide
    for _ in range(20):
        state, accepted = move.propose(model, state)
        move.tune(state, accepted)
    assert -3.0 < move._walk._log_factor < -1.5  # - log 10, about
    assert np.mean(move._accepted) == pytest.approx(0.35, abs=0.1)


@pytest.mark.filterwarnings("ignore:stuck")
def test_the_noise_moves_without_its_structure(seed):
    """Where the costly move hardly ever accepts, the free coordinates are renewed all the same."""
    moved = []
    for fast_sweeps in (0, 2):
        sampler = SMCSampler(
            200, 3, Noisy(), vectorize=True, seed=seed, moves=RandomWalkMove(scale=8.0), fast_sweeps=fast_sweeps
        )
        sampler.run_mcmc(None, 20)
        chain = sampler.get_chain()
        moved.append(np.mean(chain[1:] != chain[:-1], axis=(0, 1)))
        assert moved[-1][1] == pytest.approx(sampler.acceptance_fraction.mean(), abs=0.02)
    assert np.all(moved[0] < 0.1)
    assert np.all(moved[1][[0, 2]] > 0.4)
    assert moved[1][1] < 0.1


# ---------------------------------------------------------------- what it costs


class Recorded(Posterior):
    """A posterior that keeps every point it was asked for."""

    def __call__(self, x):
        self.asked = [*getattr(self, "asked", []), np.array(x)]
        return super().__call__(x)


def oscillator(kind=Posterior, memory=100_000):
    rng = np.random.default_rng(3)
    model = LinearOscillator(Record("noise", 0.02, rng.normal(size=200)), period=0.6, damping_ratio=0.05)
    values = model.simulate([1.15, 0.8]) + np.array([[0.2], [0.004]]) * rng.normal(size=(2, model.n_steps))
    prior = {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(1.0, 0.6),
        "sigma_acceleration": HalfNormal(0.5),
        "sigma_displacement": HalfNormal(0.01),
    }
    return kind(FELikelihood(model, Measurements(model.channels, model.dt, values), memory=memory), prior)


@pytest.mark.parametrize("mode", ["recycling", "moves", "tmcmc"])
def test_no_simulation_but_for_new_structural_parameters(mode, seed):
    posterior = oscillator(Recorded)
    kwargs = dict(MODES[mode])
    sampler = kwargs.pop("Sampler", SMCSampler)(60, 4, posterior, vectorize=True, seed=seed, **kwargs)
    sampler.run_mcmc(None, 10)
    asked = np.concatenate(posterior.asked)
    report = posterior.report()
    assert report["simulations"] == len(np.unique(asked[:, :2], axis=0))
    assert sampler.evaluations == len(asked) == report["simulations"] + report["cache_hits"]
    # control: the samplers do ask for more than they have simulated
    sweeps = 10 + sum(stage.moves for stage in sampler.ladder)
    assert report["cache_hits"] > 60 * sweeps  # two fast sweeps each; a few points lie outside the support
    forgetful = oscillator(memory=0)
    again = type(sampler)(60, 4, forgetful, vectorize=True, seed=seed, **kwargs)
    again.run_mcmc(None, 10)
    np.testing.assert_array_equal(again.get_chain(), sampler.get_chain())
    # equal rows of one batch are simulated once with and without memory
    assert forgetful.report()["simulations"] > 1.5 * report["simulations"]


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_stages_count_costly_sweeps(Sampler):
    posterior = Noisy()
    kwargs = {"recycle": False} if Sampler is SMCSampler else {}
    sampler = Sampler(40, 3, posterior, vectorize=True, seed=1, fast_sweeps=3, **kwargs)
    sampler.run_mcmc(None, 0)
    assert all(stage.evaluations == 4 * 40 * stage.moves for stage in sampler.ladder[1:])
    assert all(2 <= stage.moves <= 7 for stage in sampler.ladder)
    assert sampler.evaluations == posterior.calls


# ---------------------------------------------------------------- where it is not wanted


@pytest.mark.parametrize("preset", [CHING_CHEN_2007, RAMANCHA_2022_LITERAL, RAMANCHA_2022_CONSTANT])
def test_presets_are_untouched(preset, seed):
    Sampler = TMCMCSampler if preset is CHING_CHEN_2007 else SMCSampler
    chains, calls = [], []
    for posterior in (Gaussian(), Noisy()):
        sampler = Sampler(60, 3, posterior, vectorize=True, seed=seed, **preset)
        sampler.run_mcmc(None, 3)
        chains.append(sampler.get_chain())
        calls.append(posterior.calls)
    np.testing.assert_array_equal(*chains)
    assert calls[0] == calls[1]


def kinds(posterior, Sampler=SMCSampler, **kwargs):
    return {type(move) for move in Sampler(50, 3, posterior, log_prior_fn=Gaussian().log_prior, **kwargs)._moves}


def test_only_where_there_is_something_free():
    assert kinds(Noisy()) == kinds(Noisy(), TMCMCSampler) == kinds(Noisy(), TemperedSampler) == {WithFastSweeps}
    assert kinds(Noisy(), moves=[(emcee.moves.DEMove(), 0.8), (RandomWalkMove(), 0.2)]) == {WithFastSweeps}
    assert kinds(Noisy(), fast_sweeps=0) == kinds(Gaussian()) == kinds(Noisy().__call__) == {MixtureMove}
    everything = Noisy()
    everything.fast_parameters = (0, 1, 2)
    nothing = Noisy()
    nothing.fast_parameters = ()
    assert kinds(everything) == kinds(nothing) == {MixtureMove}


def test_workers_that_forget_make_nothing_free():
    with ThreadPool(1) as pool:
        assert kinds(Noisy(), pool=pool) == {MixtureMove}
        assert kinds(Noisy(), pool=pool, vectorize=True) == {WithFastSweeps}


@pytest.mark.parametrize("free", [(3,), (-1,), (0, 7), (0.5,), ("sigma",)])
def test_indices_that_are_none(free):
    posterior = Noisy()
    posterior.fast_parameters = free
    with pytest.raises(ValueError, match="fast_parameters must be indices of parameters"):
        SMCSampler(50, 3, posterior)


def test_impossible_free_sweeps():
    with pytest.raises(ValueError, match="sweeps must be at least 1"):
        WithFastSweeps(RandomWalkMove(), [0], sweeps=0)
    with pytest.raises(ValueError, match="fast_parameters"):
        WithFastSweeps(RandomWalkMove(), [])
    move = WithFastSweeps(RandomWalkMove(), [4])
    with pytest.raises(ValueError, match="from 0 to 2"):
        emcee.EnsembleSampler(50, 3, Noisy(), moves=move).run_mcmc(
            Noisy().sample_prior(50, np.random.default_rng(1)), 1
        )
    assert WithFastSweeps(RandomWalkMove(), [2, 0, np.int64(2)]).indices == (0, 2)


# ---------------------------------------------------------------- blobs, pickles, files


@pytest.mark.parametrize("vectorize", [False, True])
def test_blobs_go_with_their_points(vectorize):
    posterior = NoisyWithBlobs()
    sampler = SMCSampler(40, 3, posterior, vectorize=vectorize, seed=1)
    sampler.run_mcmc(None, 4)
    chain, blobs = sampler.get_chain(), sampler.get_blobs()
    assert np.allclose(blobs[..., 0], np.sum(chain**2, axis=-1), rtol=1e-13)
    assert np.array_equal(blobs[..., 1], chain[..., 0])
    assert np.allclose(sampler.get_log_prob(flat=True), Gaussian()(sampler.get_chain(flat=True)), rtol=1e-13)


def test_pickled_samplers_go_on_bit_by_bit():
    sampler = SMCSampler(40, 3, Noisy(), vectorize=True, seed=1)
    sampler.run_mcmc(None, 3)
    copy = pickle.loads(pickle.dumps(sampler))
    first, second = sampler.run_mcmc(None, 5), copy.run_mcmc(None, 5)
    np.testing.assert_array_equal(first.coords, second.coords)
    np.testing.assert_array_equal(first.log_prob, second.log_prob)


def test_a_reopened_file_goes_on(tmp_path):
    """The moves of a new process fit themselves to the ensemble; two of them do so alike."""

    def reopen(name):
        sampler = SMCSampler(40, 3, Noisy(), vectorize=True, seed=1, backend=emcee.backends.HDFBackend(tmp_path / name))
        assert sampler._moves[0].indices == (0, 2)
        return sampler

    chains = []
    for name in ("a.h5", "b.h5"):
        reopen(name).run_mcmc(None, 3)
        sampler = reopen(name)
        stages = sampler.ladder
        sampler.run_mcmc(None, 4)
        assert sampler.ladder == stages
        chains.append(sampler.get_chain())
    assert chains[0].shape == (7, 40, 3)
    np.testing.assert_array_equal(*chains)
