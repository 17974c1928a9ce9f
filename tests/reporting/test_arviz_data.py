"""Data of arviz: groups, units, Monte Carlo errors."""

import json
from importlib.metadata import version

import emcee
import lazy_loader
import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import Posterior, TruncatedNormal, propagate
from samplers import SMCSampler, to_arviz
from tests.contract.targets import Gaussian
from tests.likelihood.linear_gaussian import likelihood_of

arviz = lazy_loader.load("arviz")  # its import takes seconds
SIGMA, MEAN, SD = 0.5, 0.8, 1.5
GENERATION = int(version("arviz").split(".")[0])


@pytest.fixture(scope="module")
def linear():
    """A linear model with 60 samples, whose posterior is normal and known."""
    likelihood = likelihood_of(("a", "b", "c"), np.random.default_rng(4), 60, SIGMA)
    normal = TruncatedNormal(MEAN, SD, -np.inf, np.inf)
    return Posterior(likelihood, dict.fromkeys(likelihood.parameter_names, normal))


def run(posterior, seed=1, n=200, steps=5, Sampler=SMCSampler):
    sampler = Sampler(n, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, steps)
    return sampler


@pytest.fixture(scope="module")
def runs(linear):
    return [run(linear, seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def data(linear, runs):
    prediction = propagate(linear, runs[0].get_chain(flat=True)[:50], progress=False)
    return to_arviz(runs, prediction)


def values(dataset):
    """One number per variable, of a Dataset or of a DataTree with one group."""
    dataset = dataset["posterior"] if "posterior" in getattr(dataset, "children", {}) else dataset
    return np.array([float(np.squeeze(dataset[name])) for name in dataset.data_vars])


def test_two_runs_have_an_r_hat_and_one_has_none(data, linear, runs):
    between = values(arviz.rhat(data))
    assert np.all((between > 0.99) & (between < 1.1))
    one = to_arviz(runs[0])
    assert np.isnan(values(arviz.rhat(one))).all()
    assert "independent run" in data["posterior"].attrs["chains"]
    moved = runs[0].get_chain(flat=True) + 0.0
    apart = to_arviz([runs[0], runs[1]])
    apart["posterior"]["a"][1] += 10.0 * moved[:, 0].std()  # control: runs that disagree
    assert values(arviz.rhat(apart))[0] > 1.5


def test_mcse_is_that_of_the_sampler():
    sampler = run(Gaussian(), seed=3, n=600, steps=6)
    expected = sampler.mean_error()
    found = values(arviz.mcse(to_arviz(sampler), method="mean"))
    assert found == pytest.approx(expected, rel=0.2)  # 90 % of 40 runs: 0.97 to 1.07
    shuffled = sampler.get_chain(flat=True)[None]  # control: in the order of emcee
    plain = {f"x{i}": shuffled[:, :, i] for i in range(3)}
    plain = arviz.from_dict({"posterior": plain}) if GENERATION else arviz.from_dict(posterior=plain)
    assert np.all(values(arviz.mcse(plain, method="mean")) < 0.9 * expected)


def test_chain_of_emcee_in_the_order_of_its_walkers():
    target = Gaussian()
    sampler = emcee.EnsembleSampler(32, 3, target, vectorize=True)
    sampler.run_mcmc(target.sample_prior(32, np.random.default_rng(0)), 30)
    data = to_arviz(sampler, discard=10)
    assert data["posterior"]["x1"].shape == (1, 32 * 20)
    assert np.array_equal(data["posterior"]["x1"][0, :20], sampler.get_chain()[10:, 0, 1])
    assert np.array_equal(data["sample_stats"]["step"][0, :20], np.arange(10, 30))


def gaussian_with_blobs(x):
    return -0.5 * float(x @ x), 2.0 * x[0], x[:2] + 1.0


@pytest.mark.parametrize("kind", [emcee.EnsembleSampler, SMCSampler])
@pytest.mark.parametrize("dtype", [None, [("twice", float), ("lp", float, 2)]])
def test_blobs_and_names_given_to_the_sampler(kind, dtype, tmp_path):
    names = {"k": 0, "damping": [1, 2]}

    def target(theta):
        x = np.array([theta["k"], *theta["damping"]])
        value, twice, more = gaussian_with_blobs(x)
        return (value, twice, more) if dtype else (value, twice)

    options = {"blobs_dtype": dtype, "parameter_names": names}
    if kind is SMCSampler:
        options |= {"log_prior_fn": lambda theta: stats.norm.logpdf([theta["k"], *theta["damping"]]).sum(), "seed": 1}
    sampler = kind(40, 3, target, **options)
    start = np.random.default_rng(0).normal(size=(40, 3))
    if kind is SMCSampler:
        sampler.run_mcmc(start, 2)
    else:
        sampler.run_mcmc(start, 12)
    assert set(to_arviz(sampler, parameter_names=["x", "y", "z"])["posterior"].data_vars) == {"x", "y", "z"}
    data = to_arviz(sampler, discard=0)
    data.to_netcdf(str(tmp_path / "run.nc"))
    again = arviz.from_netcdf(str(tmp_path / "run.nc"))
    assert set(again["posterior"].data_vars) == {"k", "damping_0", "damping_1"}
    blob = again["sample_stats"]["twice" if dtype else "blobs"]
    assert np.array_equal(blob.values, 2.0 * again["posterior"]["k"].values)
    if dtype:
        assert np.array_equal(again["sample_stats"]["blob_lp"][..., 1], again["posterior"]["damping_0"] + 1.0)


def test_groups_are_read_back(tmp_path, data, runs):
    data.to_netcdf(str(tmp_path / "run.nc"))
    again = arviz.from_netcdf(str(tmp_path / "run.nc"))
    assert again["predictions"]["top_mean"].shape == (60,)
    assert again["predictions"]["top_quantiles"].shape == (3, 60)
    stats_of_runs = again["sample_stats"].attrs
    assert np.allclose(stats_of_runs["simulations"], [run.simulations for run in runs])
    assert len(json.loads(stats_of_runs["ladder"])) == 2 and "onverged" in stats_of_runs["verdict"]
    assert json.loads(stats_of_runs["failures"].split("\n")[0]) == {}
    assert np.array_equal(again["prior"]["a"][1], runs[1].prior_draws[:, 0])


def test_slashes_in_names(tmp_path):
    from fe_likelihoods import Channel, FELikelihood, FunctionModel, HalfNormal, Measurements

    channels = [Channel("acc/top", "acceleration", "g")]
    model = FunctionModel(lambda theta: theta[0] * np.sin(np.arange(30.0))[None], ["E/top"], channels, 0.1, 30)
    measured = Measurements(channels, 0.1, model.simulate([1.0]) + 0.1)
    posterior = Posterior(FELikelihood(model, measured), dict.fromkeys(["E/top", "sigma_acc/top"], HalfNormal(1.0)))
    sampler = run(posterior, n=60, steps=1)
    to_arviz(sampler).to_netcdf(str(tmp_path / "run.nc"))
    again = arviz.from_netcdf(str(tmp_path / "run.nc"))
    for k, name in enumerate(("E_top", "sigma_acc_top")):
        assert set(again["posterior"][name].values.ravel()) == set(sampler.get_chain(flat=True)[:, k])


def test_what_is_refused(linear, runs):
    with pytest.raises(ValueError, match="chains of the same shape"):
        to_arviz([runs[0], run(linear, steps=1)])
