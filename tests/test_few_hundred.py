"""Tools that measure samplers with few simulations: judgement of a run, references, and the stored references."""

import numpy as np
import pytest

from tests.benchmarks import few_hundred, guided
from tests.benchmarks.few_hundred_problems import PROBLEMS
from tests.benchmarks.importance_reference import by_importance, find_mode
from tests.statistics.brute_force import Reference, reference
from tests.statistics.hard_posteriors import CASES

KNOWN = Reference(
    -3.0, 0.01, np.zeros(2), np.full(2, 0.01), np.ones(2), np.full(2, 0.01), np.array([0.6, 0.4]), np.zeros(2), 1e4, 10
)


def outcome(rng, **changes):
    """A run with 400 independent draws of a standard normal."""
    samples = rng.standard_normal((400, 2))
    right = guided.Outcome(
        log_evidence=-3.02,
        log_evidence_error=0.03,
        mean=samples.mean(axis=0),
        mean_error=np.full(2, 0.05),
        sd=samples.std(axis=0),
        samples=samples,
        effective_sample_size=400.0,
        status="converged",
    )
    return right._replace(**changes)


def labels(samples):
    return (samples[:, 0] > 0.253).astype(int)  # the 60 % quantile


def test_judgement_of_a_run(rng):
    right = outcome(rng)
    assert guided.compare(right, KNOWN, labels).judgement == "right"
    wrong = {
        "evidence": right._replace(log_evidence=-2.8),
        "mean": right._replace(mean=right.mean + [0.0, 0.3]),
        "sd": right._replace(sd=1.5 * right.sd),
        "share": right._replace(samples=right.samples + [0.5, 0.0]),
    }
    for one in wrong.values():
        assert guided.compare(one, KNOWN, labels).judgement == "WRONG"
        assert guided.compare(one._replace(status="usable"), KNOWN, labels).judgement == "WRONG"
        assert guided.compare(one._replace(status="not usable"), KNOWN, labels).judgement == "refused"
    assert guided.compare(right._replace(log_evidence_error=np.inf), KNOWN, labels).judgement == "no error"
    assert guided.compare(guided.Outcome(failed="ValueError: no"), KNOWN, labels).judgement == "ValueError: no"


@pytest.mark.parametrize("name", ["few_samples", "sampled_noise"])
def test_importance_sampling_from_a_known_mode_agrees_with_brute_force(name):
    case = CASES[name]
    known, posterior = reference(case, 2, draws=20_000), case.posterior(2, name)
    mode, covariance = find_mode(posterior, np.ones(len(case.prior)))
    d = len(case.prior)
    assert np.all(np.abs(mode - known.mean[:d]) < 0.6 * known.sd[:d])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), known.sd[:d], rtol=0.4)
    found = by_importance(posterior, np.ones((1, d)), draws=300, rounds=5, inform=lambda text: None)
    error = np.hypot(found.log_evidence_error, known.log_evidence_error)
    assert abs(found.log_evidence - known.log_evidence) < 3.5 * error
    assert np.all(np.abs(found.mean - known.mean) < 4.0 * np.hypot(found.mean_error, known.mean_error))
    assert found.effective_sample_size > 400


def test_stored_references_are_complete_and_precise():
    stored = few_hundred.load()
    for kind in ("references", "default SMC"):
        for key, entry in stored.get(kind, {}).items():
            name, seed = key.split()
            assert name in PROBLEMS and int(seed) > 0
            assert len(entry["mean"]) == len(entry["sd"])
    for key, entry in stored["references"].items():
        assert entry["log_evidence_error"] < 0.15, key


def test_a_stored_reference_belongs_to_its_data():
    posterior = PROBLEMS["oscillator"].posterior(2)
    found = few_hundred.reference_named("oscillator", 2, posterior)
    assert found.mean.shape == (2,)
    with pytest.raises(ValueError, match="was made with other data"):
        few_hundred.reference_named("oscillator", 2, PROBLEMS["oscillator"].posterior(3))
    assert few_hundred.reference_named("oscillator", 99, posterior) is None
