"""Adapters translate priors exactly, keep the likelihood, and refuse what they do not support; no sampling."""

import dataclasses
import pickle

import numpy as np
import pytest

from fe_likelihoods import HalfNormal, LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.adapters import to_bilby, to_pymc

from .problem import PRIOR, make_posterior, starts_of

NAMES = list(PRIOR)
VARIANTS = {
    "all four kinds": PRIOR,
    "one-sided and negative": {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(-1.0, 0.7, lower=-np.inf, upper=2.0),
        "sigma_acceleration": LogNormal(0.3, 1.5),
        "sigma_displacement": HalfNormal(1e-6),
    },
    "tail": PRIOR | {"stiffness": TruncatedNormal(0.0, 0.3, lower=0.9), "damping": Uniform(-5.0, 1e6)},
}


@dataclasses.dataclass(frozen=True)
class Triangle(Uniform):
    """A distribution that no client supports."""


@pytest.fixture(params=VARIANTS, ids=str)
def posterior(request):
    return make_posterior(VARIANTS[request.param])


@pytest.fixture
def points(posterior):
    """Quantiles in both tails, and random draws."""
    edge = np.array([1e-6, 1e-3, 0.5, 0.999, 1.0 - 1e-6])[:, None] * np.ones(4)
    return posterior.prior_transform(np.concatenate([edge, np.random.default_rng(5).random((20, 4))]))


def test_bilby_has_our_priors(client_named, posterior, points):
    client_named("bilby")
    likelihood, priors = to_bilby(posterior)
    assert list(priors) == NAMES
    as_dict = {name: points[:, i] for i, name in enumerate(NAMES)}
    np.testing.assert_allclose(priors.ln_prob(as_dict, axis=0), posterior.log_prior(points), rtol=1e-9, atol=1e-7)
    u = np.random.default_rng(6).random(4)
    np.testing.assert_allclose(priors.rescale(NAMES, u), posterior.prior_transform(u), rtol=1e-6)
    outside = points[0] - [1e3, 1e3, 1e3, 1e3]
    assert priors.ln_prob(dict(zip(NAMES, outside, strict=True))) == -np.inf
    assert likelihood.log_likelihood(dict(zip(NAMES, outside, strict=True))) == -1e100


def test_bilby_likelihood_takes_names_in_any_order_and_ignores_others(client_named):
    client_named("bilby")
    posterior = make_posterior()
    likelihood, _ = to_bilby(posterior)
    (x,) = starts_of(posterior, 1, 1)
    parameters = dict(reversed(list(zip(NAMES, x.tolist(), strict=True)))) | {"derived": 1.0}
    expected = posterior.log_likelihood(x)
    assert likelihood.log_likelihood(parameters) == expected
    assert pickle.loads(pickle.dumps(likelihood)).log_likelihood(parameters) == expected
    del parameters["damping"]
    with pytest.raises(ValueError, match="lack damping"):
        likelihood.log_likelihood(parameters)


def test_bilby_refuses_a_prior_beyond_its_arithmetic(client_named):
    client_named("bilby")
    far = make_posterior(PRIOR | {"damping": TruncatedNormal(0.0, 0.1, lower=0.9)})
    with pytest.raises(ValueError, match="'damping' differs from TruncatedNormal"):
        to_bilby(far)


def test_pymc_has_our_priors_and_likelihood(client_named, posterior, points):
    client_named("pymc-smc")
    model = to_pymc(posterior)
    assert [variable.name for variable in model.free_RVs] == NAMES
    # without the Jacobians of PyMC's transformations: densities in the original parameters
    log_prior = model.compile_fn(model.varlogp_nojac, inputs=model.value_vars, point_fn=False)
    log_likelihood = model.compile_fn(model.datalogp, inputs=model.value_vars, point_fn=False)
    for point in points:
        values = []
        for variable, x in zip(model.free_RVs, point, strict=True):
            transform = model.rvs_to_transforms[variable]
            forward = transform.forward(x, *variable.owner.inputs) if transform is not None else x
            values.append(np.asarray(forward.eval() if hasattr(forward, "eval") else forward))
        assert log_prior(*values) == pytest.approx(posterior.log_prior(point), rel=1e-6, abs=1e-6)
        assert log_likelihood(*values) == pytest.approx(posterior.log_likelihood(point), rel=1e-5)


def test_pymc_draws_our_prior(client_named, posterior):
    client_named("pymc-smc")
    import pymc

    with to_pymc(posterior):
        draws = pymc.draw([pymc.modelcontext(None)[name] for name in NAMES], draws=2000, random_seed=7)
    levels = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
    for distribution, values in zip(posterior.prior.distributions.values(), draws, strict=True):
        below = (values[:, None] < distribution.ppf(levels)).mean(axis=0)
        assert np.all(np.abs(below - levels) < 4.0 * np.sqrt(levels * (1.0 - levels) / 2000)), distribution


def test_pymc_op_pickles(client_named):
    client_named("pymc-smc")
    posterior = make_posterior()
    op = to_pymc(posterior).potentials[0].owner.op
    assert pickle.loads(pickle.dumps(op)).posterior.fingerprint == posterior.fingerprint


@pytest.mark.parametrize(("name", "adapter"), [("bilby", to_bilby), ("pymc-smc", to_pymc)])
def test_unknown_distribution_is_refused_by_name(client_named, name, adapter):
    client_named(name)
    unknown = make_posterior(PRIOR | {"stiffness": Triangle(0.5, 2.0)})
    with pytest.raises(ValueError, match="'stiffness' is a Triangle: replace it"):
        adapter(unknown)
