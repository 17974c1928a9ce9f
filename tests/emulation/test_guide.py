"""The guide behind the samplers: right on small posteriors, exact counts, budgets, refusals."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    LogNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.emulation.guide import ResponseGuide
from fe_likelihoods.emulation.modes import Search
from fe_likelihoods.emulation.target import at_once, nothing_stored
from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.judgement.guides import check_excluded_runs, check_tops, check_unseen_modes
from tests.statistics.hard_posteriors import CASES

from .problems import guided, vibration


def quadrature(posterior):
    """Log-evidence and means of a posterior of two parameters on grids that are narrowed to it."""
    centre, spread = np.array([1.2, 0.8]), np.array([0.05, 0.2])
    for _ in range(6):
        axes = [np.linspace(centre[k] - 7.0 * spread[k], centre[k] + 7.0 * spread[k], 81) for k in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        log_density = posterior.log_prob(grid)
        top = log_density.max()
        density = np.exp(log_density - top)
        centre = density @ grid / density.sum()
        spread = np.maximum(np.sqrt(density @ (grid - centre) ** 2 / density.sum()), 0.05 * spread)
    cell = (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0])
    return top + np.log(density.sum() * cell), centre


@pytest.mark.parametrize("Sampler", [SMCSampler, pytest.param(TMCMCSampler, marks=pytest.mark.slow)])
def test_evidence_and_means_against_quadrature(Sampler):
    posterior = vibration()
    log_evidence, means = quadrature(vibration())
    sampler = guided(posterior, 600, Sampler=Sampler)
    assert sampler.verdict.status == "converged"
    assert abs(sampler.log_evidence - log_evidence) < 3.0 * sampler.log_evidence_error < 0.3
    assert (np.abs(sampler.get_chain(flat=True).mean(axis=0) - means) < 4.0 * sampler.mean_error()).all()
    assert posterior.report()["simulations"] == sampler.verdict.simulations <= 600


def test_what_data_do_not_tell_keeps_its_prior_down_to_zero():
    """Flexibilities of springs in series, and parameters without effect whose prior reaches zero: as reciprocals, these
    have tails that no draws reached, and the log-evidence of a run was .29 too low.
    """
    force = np.sin(np.arange(150) / 7.0)
    names = [f"stiffness_{k}" for k in range(3)] + [f"other_{k}" for k in range(6)]
    channels = [Channel(name, "displacement", "m") for name in ("first", "last")]
    model = FunctionModel(
        lambda theta: 0.01 * np.cumsum(1.0 / theta[:3])[[0, 2], None] * force, names, channels, 0.02, 150, version="1"
    )
    clean = model.simulate(np.array([1.1, 0.8, 1.2, *np.ones(6)]))
    measured = Measurements(channels, 0.02, clean + 5e-3 * np.random.default_rng(1).standard_normal(clean.shape))
    prior = {name: TruncatedNormal(1.0, 0.3 if name in names[:3] else 0.7) for name in names}
    sigmas = {f"sigma_{each.name}": HalfNormal(0.015) for each in channels}
    sampler = guided(Posterior(FELikelihood(model, measured).marginal(sigmas), prior), 400, 4, walkers=40)
    known = sampler.guide.known_density
    below, at = norm.cdf((np.array([0.0, 0.2]) - 1.0) / 0.7)
    expected = (at - below) / (1.0 - below)
    assert known.weights @ (known.coords[:, 3:] < 0.2) == pytest.approx(np.full(6, expected), rel=0.4)


def test_a_pickled_run_goes_on_as_the_run_itself():
    sampler = guided(vibration(), 600)
    again = pickle.loads(pickle.dumps(sampler))
    for each in (sampler, again):
        each.run_mcmc(None, 3)
    np.testing.assert_array_equal(sampler.get_chain(), again.get_chain())
    known = sampler.get_chain(flat=True)[:5]
    session = SimpleNamespace(remember=nothing_stored, fits=lambda _: True, remaining=lambda: np.inf)
    again.guide.observe(known, session)  # it was pickled without its runs
    assert len(again.guide._target.archive.coords) == len(np.unique(known, axis=0))
    top = again.guide.search.log_evidence
    at_once(again.guide._search(np.zeros((1, again.guide._target.n_structural)), session))
    assert abs(again.guide.search.log_evidence - top) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["autoregressive", "effective"])
def test_every_noise_is_sampled_together_with_its_parameters(noise):
    posterior = vibration(noise)
    sampler = guided(posterior, 500, starts=3, seed=2)
    assert sampler.verdict.status == "converged"
    reference = SMCSampler(250, posterior.ndim, vibration(noise), vectorize=True, seed=3)
    reference.run_mcmc(None, 2)
    joint = np.hypot(sampler.log_evidence_error, reference.log_evidence_error)
    assert abs(sampler.log_evidence - reference.log_evidence) < 4.0 * joint
    expected = reference.get_chain(flat=True)
    difference = np.abs(sampler.get_chain(flat=True).mean(axis=0) - expected.mean(axis=0))
    assert (difference < 0.5 * expected.std(axis=0)).all()


def test_densities_are_normalised_and_draws_are_inside_the_support():
    """The mean over draws of any normalised density divided by the density of the guide is one."""
    posterior = vibration()
    guide = guided(posterior, steps=0).guide
    coords = guide.draw(4000, np.random.RandomState(5))
    assert np.isfinite(posterior.log_prior(coords)).all()
    centre, spread = coords.mean(axis=0), coords.std(axis=0)
    log_normal = -0.5 * np.square((coords - centre) / spread).sum(axis=1) - np.log(2.0 * np.pi * spread.prod())
    ratio = np.exp(log_normal - guide.log_density(coords))
    assert ratio.mean() == pytest.approx(1.0, abs=4.0 * ratio.std() / np.sqrt(4000))


def test_impossible_guides_are_refused_before_any_simulation():
    posterior = vibration()
    with pytest.raises(ValueError, match="starts must be a whole number"):
        posterior.guide(0)
    with pytest.raises(ValueError, match="vectorize=True"):
        SMCSampler(100, 2, posterior, guide=posterior.guide())
    with pytest.raises(ValueError, match="another posterior object"):
        SMCSampler(100, 2, vibration(), vectorize=True, guide=posterior.guide())
    likelihood = posterior.likelihood
    forgetful = FELikelihood(likelihood.model, likelihood.measurements, likelihood.noise, memory_rows=0)
    with pytest.raises(ValueError, match="memory_rows"):
        Posterior(forgetful, posterior.prior).guide()
    assert posterior.report()["simulations"] == 0
    assert isinstance(posterior.guide(), ResponseGuide)


def test_a_channel_with_an_offset_of_a_million_times_its_noise():
    """Residuals keep the digits that responses in single precision lose."""
    results = []
    for offset in (0.0, 1e6):
        case = CASES["smooth"]
        posterior = replace(case, offset=offset * case.noise).posterior(1)
        sampler = guided(posterior, 500, starts=2)
        assert sampler.verdict.status == "converged"
        results.append((sampler.log_evidence, sampler.verdict.simulations))
    assert results[0][1] == results[1][1] <= 500
    assert abs(results[0][0] - results[1][0]) < 1e-4


@pytest.mark.slow
def test_springs_in_series():
    """The displacements are linear in the reciprocals of the stiffnesses."""
    n = 6
    force = np.random.default_rng(3).standard_normal((n, 40)) + 1.0
    model = FunctionModel(
        lambda stiffness: np.cumsum(force / stiffness[:, None], axis=0)[[2, 5]],
        [f"k_{i}" for i in range(n)],
        [Channel("middle", "displacement", "m"), Channel("top", "displacement", "m")],
        0.1,
        40,
        version="springs",
    )
    rng = np.random.default_rng(4)
    clean = model.simulate(rng.normal(1.0, 0.15, n))
    measured = Measurements(model.channels, model.dt, clean + 0.3 * rng.standard_normal(clean.shape), "SYNTHETIC")
    prior = {name: TruncatedNormal(1.0, 0.2) for name in model.parameter_names}
    prior |= {f"sigma_{c.name}": HalfNormal(1.0) for c in model.channels}
    posterior = Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()
    sampler = guided(posterior, steps=0)
    assert sampler.verdict.simulations < 250
    draws = posterior.sample_prior(40_000, 1)
    weights = np.exp(posterior(draws) - posterior.log_prior(draws) - sampler.log_evidence)
    error = weights.std() / np.sqrt(len(draws))
    assert abs(weights.mean() - 1.0) < 3.0 * np.hypot(error, sampler.log_evidence_error)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("n", [8, 12])
def test_a_banana_is_right(n):
    """With one component for the emulated posterior, standard deviations in 12 dimensions were .84 to .90 of theirs."""
    model = FunctionModel(
        lambda x: np.append(15.0 * (x[1] - 0.6 * x[0] ** 2), 3.0 * x[2:])[None],
        [f"x{i}" for i in range(n)],
        [Channel("y", "displacement", "m")],
        0.1,
        n - 1,
        version="banana",
    )
    values = np.random.default_rng(1).standard_normal((1, n - 1))
    prior = {name: TruncatedNormal(0.0, 1.0, -10.0, 10.0) for name in model.parameter_names}
    posterior = Posterior(
        FELikelihood(model, Measurements(model.channels, 0.1, values, "SYNTHETIC")),
        prior | {"sigma_y": LogNormal(1.0, 0.2)},
    )
    sampler = guided(posterior, 1500)
    # x1 and the noise apart, the first value is normal with the mean -9 x0^2
    x, sigma = np.meshgrid(np.linspace(-5.0, 5.0, 1001), np.exp(np.linspace(-1.2, 1.2, 201)), indexing="ij")
    density = norm.logpdf(values[0, 0], -9.0 * x**2, np.hypot(15.0, sigma)) + norm.logpdf(x)
    density += sum(norm.logpdf(value, 0.0, np.hypot(3.0, sigma)) for value in values[0, 1:])
    weights = np.exp(density + LogNormal(1.0, 0.2).logpdf(sigma)) * sigma
    sd = np.sqrt((weights * x**2).sum() / weights.sum())
    right = abs(sampler.get_chain(flat=True)[:, 0].std() / sd - 1.0) < 0.25  # 3.5 standard errors of 100 draws
    assert right and sampler.verdict.status != "not usable"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("seed", [12, 18])
def test_a_long_ridge_is_followed_to_the_bounds_of_its_prior(seed):
    """E h^3 alone is identified. In parameters, in which few runs are emulated as well, the ridge is curved."""
    time, channels = 0.02 * np.arange(300), [Channel("tip", "displacement", "mm")]

    def of_stiffness(k):
        omega = 2.0 * np.pi * np.sqrt(k)
        return (0.01 * np.exp(-0.03 * omega * time) * np.cos(omega * time))[None]

    model = FunctionModel(lambda x: of_stiffness(x[0] * x[1] ** 3), ("E", "h"), channels, 0.02, 300, version="ridge")
    values = of_stiffness(0.95) + 1e-3 * np.random.default_rng(seed).standard_normal((1, 300))
    prior = {"E": Uniform(0.1, 5.0), "h": Uniform(0.3, 2.0), "sigma_tip": HalfNormal(0.003)}
    posterior = Posterior(FELikelihood(model, Measurements(channels, 0.02, values)), prior).marginal()
    sampler = guided(posterior, 800, seed=seed)
    k, h = np.linspace(0.85, 1.05, 801), np.linspace(0.3, 2.0, 2001)
    inside = (k[:, None] / h**3 > 0.1) & (k[:, None] / h**3 < 5.0)
    of_k = np.where(inside, h**-3.0 / 4.9 / 1.7, 0.0).sum(axis=1) * (h[1] - h[0])
    log_likelihood = posterior.log_likelihood(np.column_stack([k, np.ones_like(k)]))
    truth = np.log(np.sum(np.exp(log_likelihood - log_likelihood.max()) * of_k) * (k[1] - k[0])) + log_likelihood.max()
    assert abs(sampler.log_evidence - truth) < 4.0 * sampler.log_evidence_error < 0.3


@pytest.mark.parametrize(
    ("simulated", "emulated", "doubted"),
    [
        ([0.0, -1.0, -20.0], [0.1, -1.5, -np.inf], False),  # improbable runs need not be emulated
        ([0.0, -1.0, -2.0], [0.0, -1.0, -np.inf], True),
        ([0.0, -1.0, -2.0], [0.0, -1.0, -6.5], True),
        ([0.0, -1.0, -2.0], [0.0, -1.0, np.nan], True),
        ([0.0, -1.0, -2.0], [-3.0, -4.0, -5.0], False),  # an uncertain emulator
    ],
)
def test_a_posterior_that_excludes_probable_simulations_is_doubted(simulated, emulated, doubted):
    found = check_excluded_runs(np.array(simulated), np.array(emulated))
    assert [each.severity for each in found] == ["care"] * doubted
    assert all("ends of a ridge" in each.text for each in found)


def test_a_rough_response_is_doubted_too(rng):
    """Its log-densities scatter around the emulated ones everywhere, and not only at the ends."""
    emulated = -rng.uniform(0.0, 3.0, 60)
    (found,) = check_excluded_runs(emulated + 2.0 * rng.standard_normal(60), emulated)
    assert "the response is rough" in found.text


@pytest.mark.parametrize(("excess", "severities"), [(-np.inf, []), (6.4, []), (28.0, ["wrong"])])
def test_draws_above_every_mode_are_told(excess, severities):
    assert [found.severity for found in check_tops(excess)] == severities


@pytest.mark.parametrize("converged", [False, True])
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_an_ascent_that_ended_below_its_top_goes_on_and_a_wrong_mode_is_refused(converged, monkeypatch):
    """Far above the mode of a search, draws are on the way that its ascent has left, or that it knew nothing of."""

    class Short(Search):
        def run(self, starts):
            found = yield from super().run(starts)
            if starts == 1:
                return found
            mode, first.search = found.modes[0], found
            lower = mode.coords + 8.0 * np.linalg.cholesky(mode.covariance)[:, 0]
            return found._replace(
                modes=(mode._replace(coords=lower, log_density=mode.log_density - 32.0, converged=converged),)
            )

    first = SimpleNamespace()
    monkeypatch.setattr("fe_likelihoods.emulation.guide.Search", Short)
    sampler = guided(vibration(), 600)
    search, known = sampler.guide.search, first.search
    assert abs(sampler.log_evidence - quadrature(vibration())[0]) < 3.0 * sampler.log_evidence_error < 0.3
    assert sampler.verdict.status == ("not usable" if converged else "converged")
    assert search.ends == known.ends and search.finished
    assert (search.simulations - known.simulations < 10) and sampler.guide.simulations == search.simulations
    assert abs(search.modes[0].log_density - known.modes[0].log_density) < (33.0 if converged else 1.0)


def test_a_search_that_finds_some_of_five_modes_is_refused():
    """Equal aliases of a frequency: ascents end where the amplitude is small, or the limit ends the search."""
    times = 0.25 * np.arange(40)

    def vibration(theta):
        amplitude, frequency = theta
        decay = amplitude * (1.0 + 0.01 * frequency) * np.exp(-0.05 * times)
        return [decay * np.cos(2.0 * np.pi * frequency * times)]

    model = FunctionModel(vibration, ["amplitude", "frequency"], [Channel("top", "displacement", "m")], 0.25, 40)
    noise = 0.15 * np.random.default_rng(1).standard_normal((1, 40))
    measured = Measurements(model.channels, 0.25, model.simulate([1.0, 3.3]) + noise)
    prior = {"amplitude": TruncatedNormal(1.0, 0.3), "frequency": Uniform(0.2, 9.8), "sigma_top": HalfNormal(0.45)}
    posterior = Posterior(FELikelihood(model, measured), prior).marginal()
    for seed in (1, 3):
        sampler = SMCSampler(50, 2, posterior, vectorize=True, seed=seed, guide=posterior.guide(), max_simulations=200)
        with pytest.warns(SamplingWarning):
            sampler.run_mcmc(None, 0)
        assert sampler.verdict.status == "not usable"


def test_many_ends_of_a_search_are_not_said_to_be_modes():
    """The draws of a flat ridge are one mode in the verdict, which the finding must not deny."""
    (finding,) = check_unseen_modes(0.29, 24, 11)
    assert "24 starts ended at 11 points" in finding.text and "11 modes" not in finding.text
    assert check_unseen_modes(0.05, 24, 11) == []
