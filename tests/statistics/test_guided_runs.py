"""A run with few simulations is judged by its own errors."""

import numpy as np

from tests.statistics.brute_force import Reference
from tests.statistics.guided_runs import Outcome, compare

KNOWN = Reference(
    -3.0, 0.01, np.zeros(2), np.full(2, 0.01), np.ones(2), np.full(2, 0.01), np.array([0.6, 0.4]), np.zeros(2), 1e4, 10
)


def outcome(rng, **changes):
    """A run with 400 independent draws of a standard normal."""
    samples = rng.standard_normal((400, 2))
    right = Outcome(
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
    assert compare(right, KNOWN, labels).judgement == "right"
    wrong = {
        "evidence": right._replace(log_evidence=-2.8),
        "mean": right._replace(mean=right.mean + [0.0, 0.3]),
        "sd": right._replace(sd=1.5 * right.sd),
        "share": right._replace(samples=right.samples + [0.5, 0.0]),
    }
    for one in wrong.values():
        assert compare(one, KNOWN, labels).judgement == "WRONG"
        assert compare(one._replace(status="usable"), KNOWN, labels).judgement == "WRONG"
        assert compare(one._replace(status="not usable"), KNOWN, labels).judgement == "refused"
    assert compare(right._replace(log_evidence_error=np.inf), KNOWN, labels).judgement == "no error"
    assert compare(Outcome(failed="ValueError: no"), KNOWN, labels).judgement == "ValueError: no"
