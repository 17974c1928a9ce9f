"""Joint likelihoods: sums over shared parameters, evidence in closed form, and everything that a likelihood can do."""

import pickle

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    Events,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    RCColumn,
    Record,
    SimulationFailed,
    TruncatedNormal,
    propagate,
)
from fe_likelihoods.noise.marginal import MarginalNoise
from fe_likelihoods.problems import bridge_column_data
from samplers import SMCSampler
from tests.likelihood.linear_gaussian import Linear, exact_log_evidence, likelihood_of

NORMAL = TruncatedNormal(1.0, 0.7, -np.inf, np.inf)


@pytest.fixture
def pieces(rng):
    return {
        "component": likelihood_of(("k", "c"), rng, noise=None),
        "system": likelihood_of(("k", "m"), rng, n_steps=20, noise=None),
    }


def prior_of(joint):
    structural = len(joint.parameter_names) - len(joint.fast_parameters)
    return {n: NORMAL if i < structural else HalfNormal(1.0) for i, n in enumerate(joint.parameter_names)}


def points_of(joint, rng, n=7):
    return np.abs(rng.normal(1.0, 0.2, size=(n, joint.ndim)))


def test_sum_over_the_union_of_the_parameters(pieces, rng):
    joint = JointLikelihood(pieces)
    assert joint.parameter_names == ("k", "c", "m", "sigma_top") and joint.ndim == 4 and joint.fast_parameters == (3,)
    points = points_of(joint, rng)
    expected = pieces["component"](points[:, [0, 1, 3]]) + pieces["system"](points[:, [0, 2, 3]])
    np.testing.assert_array_equal(joint.log_likelihood(points), expected)
    named = dict(zip(joint.parameter_names, points[2], strict=True))
    assert joint(points[2]) == joint.log_likelihood(named) == expected[2]
    own = JointLikelihood(pieces, separate="sigma_top")
    assert own.parameter_names == ("k", "c", "m", "sigma_top_component", "sigma_top_system")
    assert own.fast_parameters == (3, 4)
    np.testing.assert_array_equal(own(np.hstack([points, points[:, 3:]])), expected)


@pytest.mark.parametrize("names", [(("a", "b"), ("c", "d")), (("a", "b"), ("b", "c")), (("a", "b"), ("b", "a"))])
def test_evidence_is_that_of_the_closed_form(names, rng):
    likelihoods = {"one": likelihood_of(names[0], rng), "two": likelihood_of(names[1], rng, n_steps=5, sigma=0.8)}
    joint = JointLikelihood(likelihoods)
    union = list(joint.parameter_names)
    exact = exact_log_evidence(likelihoods.values(), union, 1.0, 0.7)
    apart = sum(exact_log_evidence([each], list(each.parameter_names), 1.0, 0.7) for each in likelihoods.values())
    # parts without common parameters are independent, and only then the evidences are multiplied
    assert (abs(exact - apart) < 1e-9) == (len(union) == 4)
    sampler = SMCSampler(500, joint.ndim, Posterior(joint, prior_of(joint)), vectorize=True, seed=3)
    sampler.run_mcmc(None, 1, progress=False)
    assert abs(sampler.log_evidence - exact) < 4.0 * sampler.log_evidence_error < 0.2


def test_simulations_failures_and_report_are_those_of_all_parts(rng):
    def fails(theta):
        if theta[0] > 1.5:
            raise SimulationFailed("buckled")
        return theta[0] * np.ones((1, 6))

    channel = (Channel("strain", "strain", "1"),)
    model = FunctionModel(fails, ("k",), channel, 0.1, 6, version="1")
    first = FELikelihood(model, Measurements(channel, 0.1, np.ones((1, 6))))
    second = likelihood_of(("k", "m"), rng, noise=None)
    joint = JointLikelihood({"test": first, "system": second})
    posterior = Posterior(joint, prior_of(joint))
    assert posterior.parameter_names == ["k", "m", "sigma_strain", "sigma_top"]
    points = np.array([[1.0, 1.0, 0.1, 0.5], [2.0, 1.0, 0.1, 0.5], [1.1, 1.0, 0.1, 0.5], [1.1, 1.0, 0.1, -0.5]])
    values = posterior(points)
    assert np.isfinite(values).tolist() == [True, False, True, False]
    assert (first.simulations, second.simulations) == (3, 2)  # none of the second where the first has failed
    points[0, 2:] = 0.2
    posterior(points[:1])
    report = posterior.report()
    assert report["simulations"] == posterior.likelihood.simulations == 5 and report["cache_hits"] == 2
    assert report["failures"][0]["likelihood"] == "test" and report["failures"][0]["parameters"] == {"k": 2.0}
    assert report["failure_count"] == 1 and "buckled" in str(report["failure_reasons"])
    assert report["likelihoods"]["system"]["simulations"] == 2 and report["likelihoods"]["test"]["failure_count"] == 1
    assert posterior.failure(points[1])[1] == -np.inf


def test_fingerprints(pieces, rng):
    joint = JointLikelihood(pieces)
    posterior = Posterior(joint, prior_of(joint))
    assert posterior.fingerprint == Posterior(JointLikelihood(pieces), prior_of(joint)).fingerprint
    own = JointLikelihood(pieces, separate=["sigma_top"])
    others = [Posterior(own, prior_of(own)), Posterior(joint, prior_of(joint) | {"k": HalfNormal(1.0)})]
    assert len({posterior.fingerprint, *(other.fingerprint for other in others)}) == 3
    backwards = JointLikelihood(dict(reversed(pieces.items())))
    assert joint.data_fingerprint == backwards.data_fingerprint == own.data_fingerprint
    assert joint.data_fingerprint != pieces["system"].data_fingerprint
    copy = pickle.loads(pickle.dumps(posterior))
    point = points_of(joint, rng)[0]
    assert copy(point) == posterior(point) and copy.fingerprint == posterior.fingerprint


def test_noise_integrated_out(pieces, rng):
    joint = JointLikelihood(pieces, separate=["sigma_top"])
    posterior = Posterior(joint, prior_of(joint))
    marginal = posterior.marginal()
    assert marginal.parameter_names == ["k", "c", "m"]
    points = points_of(joint, rng)[:, :3]
    expected = sum(
        each.with_noise(MarginalNoise(each.noise, {"sigma_top": HalfNormal(1.0)}))(points[:, columns])
        for each, columns in zip(pieces.values(), ([0, 1], [0, 2]), strict=True)
    )
    np.testing.assert_array_equal(marginal.log_likelihood(points), expected)
    drawn = marginal.draw_noise(points, 1)
    assert list(drawn) == ["k", "c", "m", "sigma_top_component", "sigma_top_system"]
    found = propagate(marginal, drawn, data_set="system", noise=True, progress=False)
    assert (found.variance > propagate(marginal, drawn, data_set="system", progress=False).variance).all()
    with pytest.raises(ValueError, match=r"sigma_top belong to several likelihoods.*separate=\['sigma_top'\]"):
        Posterior(JointLikelihood(pieces), prior_of(JointLikelihood(pieces))).marginal()


def test_predictions_are_of_one_data_set(pieces, rng):
    joint = JointLikelihood(pieces)
    posterior, samples = Posterior(joint, prior_of(joint)), points_of(joint, rng)
    for part, columns in {"component": [0, 1, 3], "system": [0, 2, 3]}.items():
        for noise in (False, True):
            settings = {"noise": noise, "seed": 1, "progress": False}
            ours = propagate(posterior, samples, data_set=part, **settings)
            theirs = propagate(pieces[part], samples[:, columns], **settings)
            np.testing.assert_array_equal(ours.mean, theirs.mean)
            np.testing.assert_array_equal(ours.variance, theirs.variance)
        structural = propagate(joint, samples[:, :3], data_set=part, progress=False)
        np.testing.assert_array_equal(structural.mean, theirs.mean)
    cases = {
        "give data_set= one of 'component', 'system'": (posterior, {}),
        "no likelihood 'pier'; the likelihoods are 'component'": (posterior, {"data_set": "pier"}),
        "data_set='system' is for a JointLikelihood": (joint["system"], {"data_set": "system"}),
    }
    for message, (target, settings) in cases.items():
        with pytest.raises(ValueError, match=message):
            propagate(target, samples, progress=False, **settings)


def test_bad_input_is_refused_before_anything_is_simulated(pieces, rng):
    forces = Linear(("k",), rng.normal(size=(5, 1)), "force")
    in_newton = FELikelihood(forces, Measurements(forces.channels, 0.1, np.ones((1, 5))))
    cases = {
        "non-empty mapping of names to likelihoods": ({}, {}),
        "an FELikelihood under each name; got 1.0 under 'a'": ({"a": 1.0}, {}),
        "separate has the unknown parameters sigma_roof": (pieces, {"separate": ["sigma_roof"]}),
        "one unit; it is in m in 'component' and in N in 'test'": (pieces | {"test": in_newton}, {}),
    }
    for message, (likelihoods, settings) in cases.items():
        with pytest.raises(ValueError, match=message):
            JointLikelihood(likelihoods, **settings)
    assert JointLikelihood(pieces | {"test": in_newton}, separate=["sigma_top"]).ndim == 6


def test_units_of_the_noise_of_events_are_compared(rng):
    events = Events([Record("EQ1", 0.02, rng.normal(size=20))])
    likelihoods = {}
    for key, quantity in {"a": "relative displacement", "b": "acceleration"}.items():
        channels = (Channel("top", quantity, "m" if key == "a" else "m/s2"),)
        model = FunctionModel(lambda theta: np.ones((1, 20)), ["k"], channels, 0.02, 20)
        model.record = events
        likelihoods[key] = FELikelihood(
            model, {"EQ1": Measurements(channels, 0.02, np.ones((1, 20)))}, GaussianNoise(channels, groups="event")
        )
    with pytest.raises(ValueError, match="'sigma_top_EQ1' must have one unit; it is in m in 'a' and in m/s2 in 'b'"):
        JointLikelihood(likelihoods)
    assert JointLikelihood(likelihoods, separate=["sigma_top_EQ1"]).ndim == 3


def test_separate_gives_no_two_parameters_one_name(rng):
    likelihoods = {
        "b_c": likelihood_of(("a", "k"), rng, noise=None),
        "c": likelihood_of(("a_b", "k"), rng, noise=None),
    }
    with pytest.raises(ValueError, match="separate makes the name 'a_b_c' of two parameters, 'a' and 'a_b'; rename"):
        JointLikelihood(likelihoods, separate=["a", "a_b"])


def test_multiples_of_different_nominal_values_are_different_units():
    record = bridge_column_data().record.trim(8.0, 8.1)
    columns = {"a": RCColumn.lhpost(record), "b": RCColumn.lhpost(record, a0=0.5)}
    likelihoods = {
        name: FELikelihood(column, Measurements(column.channels, column.dt, np.ones((2, column.n_steps))))
        for name, column in columns.items()
    }
    with pytest.raises(ValueError, match=r"'a0' must have one unit; it is in multiples of [0-9.]+ in 'a' and in mult"):
        JointLikelihood(likelihoods)
    assert "a0_b" in JointLikelihood(likelihoods, separate=["a0"]).parameter_names
