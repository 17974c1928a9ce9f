"""One run for several data sets: what it returns, how often it runs, and what is refused."""

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    JointLikelihood,
    LogNormal,
    Measurements,
    ModalData,
    ModalLikelihood,
    Posterior,
    SimulationCache,
    check_result,
)
from fe_likelihoods.checks.result import check_model
from fe_likelihoods.modal.load_cases import LoadTest
from fe_likelihoods.modal.mode_models import modal_channels, modal_response
from fe_likelihoods.models import one_run as module
from fe_likelihoods.models.one_run import one_run
from tests.emulation.problems import guided

NAMES = ("k1", "k2")
TOP = Channel("top", "displacement", "m")
TEST = LoadTest([TOP], ["pull", "push"], [[2.1, -2.1]], errors={"top": 0.05})
DATA = ModalData([0.098, 0.257], [[0.6, 1.0], [-1.0, 0.6]], ("a", "b"), frequency_cv=0.01, shape_error=0.02)
PARTS = {"modes": (modal_channels(("a", "b")), 1.0, 2), "static": ((TOP,), 1.0, 2)}
PRIOR = {"k1": LogNormal(1.0, 0.2), "k2": LogNormal(1.0, 0.2)} | TEST.known


def both(theta):
    """Modes and deflections."""
    k1, k2 = theta
    values, shapes = np.linalg.eigh([[k1 + k2, -k2], [-k2, k2]])
    top = 1 / k1 + 1 / k2
    return {"modes": modal_response(np.sqrt(values) / (2 * np.pi), shapes.T), "static": [[top, -top]]}


@pytest.fixture
def runs(monkeypatch):
    """Numbers of runs that were made together."""
    made, simulate = [], module.simulate_batch

    def counted(model, thetas, pool=None):
        made.append(len(thetas))
        return simulate(model, thetas, pool)

    monkeypatch.setattr(module, "simulate_batch", counted)
    return made


def joint(models, **options):
    modes = ModalLikelihood(models["modes"], DATA, **options)
    static = FELikelihood(models["static"], TEST.measurements, **options)
    return Posterior(JointLikelihood({"modes": modes, "static": static}), PRIOR)


def of_function(function=both):
    return one_run(PARTS, function, lambda output, **options: FunctionModel(output, NAMES, **options, version="1"))


def test_a_joint_posterior_runs_once_at_each_point(rng, runs):
    posterior = joint(of_function())
    points = rng.uniform(0.8, 1.2, (20, 2))
    values = posterior(points)
    assert sum(runs) == 20 and np.isfinite(values).all()
    alone = of_function()["static"]
    apart = [ModalLikelihood(of_function()["modes"], DATA)(points)]
    apart.append(Posterior(FELikelihood(alone, TEST.measurements), PRIOR).log_likelihood(points))
    made = sum(runs)
    np.testing.assert_allclose(posterior.log_likelihood(points), sum(apart), rtol=1e-12)
    assert sum(runs) == made


def test_a_guided_run_with_its_checks_and_a_cache_runs_once(tmp_path, runs):
    cache = SimulationCache(tmp_path / "both.db")
    posterior = joint(of_function(), cache=cache)
    sampler = guided(posterior, starts=3)
    assert sum(runs) == posterior.likelihood["modes"].simulations == posterior.likelihood["static"].simulations
    made = sum(runs)
    other = joint(of_function(), cache=cache)
    np.testing.assert_array_equal(other(sampler.get_chain(flat=True)), sampler.get_log_prob(flat=True))
    simulators = [part.simulator for part in other.likelihood.likelihoods.values()]
    assert [each.simulations for each in simulators] == [0, 0]
    # two rows of each data set are verified first, and one of every 100 that are used
    assert sum(runs) - made <= sum(each.verifications for each in simulators)
    assert [each.verifications for each in simulators] == [2 + each.disk_hits // 100 for each in simulators]
    assert check_result(sampler).status == "use"


def test_a_part_that_asks_again_gets_another_run():
    """So that responses that differ by chance are found."""
    rng = np.random.default_rng(1)

    def noisy(theta):
        return {"modes": modal_response([0.1, 0.26], [[0.6, 1.0], [-1.0, 0.6]]), "static": rng.normal(size=(1, 2))}

    models = of_function(noisy)
    first, second = models["static"].simulate_together(np.ones((2, 2))).response
    assert (first != second).any()
    found = check_model(joint(of_function(noisy)))
    assert "The model is not repeatable" in [each.kind for each in found.findings]


@pytest.mark.parametrize(
    ("returned", "text"),
    [
        ({"modes": np.ones((3, 2))}, "expected a response for each of modes, static; got modes"),
        ({"modes": np.ones((2, 2)), "static": np.ones((1, 2))}, r"modes has shape \(2, 2\), expected \(3, 2\)"),
        (np.ones(3), "got ndarray"),
    ],
)
def test_what_does_not_fit_is_a_failed_run(returned, text):
    batch = of_function(lambda theta: returned)["static"].simulate_together(np.ones((1, 2)))
    assert np.isnan(batch.response).all()
    with pytest.raises(AssertionError, match=text):
        raise AssertionError(batch.reasons[0])


def test_files_of_other_parts_are_refused():
    with pytest.raises(ValueError, match="an output for each of the parts modes, static"):
        one_run(PARTS, {"modes": "modes.txt"}, None)


def test_histories_keep_their_step():
    motion = Channel("roof", "acceleration", "m/s2")
    models = one_run(
        {"static": PARTS["static"], "shaking": ((motion,), 0.1, 3)},
        lambda theta: {"static": [[1.0, -1.0]], "shaking": [[0.0, theta[0], 1.0]]},
        lambda output, **options: FunctionModel(output, ("k",), **options, version="1"),
    )
    measured = Measurements((motion,), 0.1, [[0.0, 2.0, 1.0]])
    assert FELikelihood(models["shaking"], measured).misfit([[1.5]]).tolist() == [[0.25]]
