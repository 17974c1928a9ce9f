"""Predictions with a cache: the same bits, and no simulation twice, also after an interruption."""

import signal
import sys

import numpy as np
import pytest

from fe_likelihoods import Record, SimulationCache, peak, propagate
from fe_likelihoods.simulation.model import SimulationFailed
from tests.prediction.flexible import Flexible

RECORD = Record("base", 0.1, np.sin(np.arange(40.0)))
OTHER = Record("other", 0.1, 0.5 * np.cos(np.arange(30.0)))


class Counted(Flexible):
    """Counts its simulations; fails for large flexibilities, and is interrupted at the n-th simulation."""

    runs: list = []  # noqa: RUF012 - of all copies
    factor = 1.0

    def simulate(self, theta):
        if theta[0] > 1.5:
            self.runs.append(theta[0])
            raise SimulationFailed("too flexible")
        if len(self.runs) == getattr(sys, "interrupted_at", None):  # no part of the label
            signal.raise_signal(signal.SIGINT)
        self.runs.append(theta[0])
        return self.factor * super().simulate(theta)


@pytest.fixture
def model(monkeypatch):
    monkeypatch.setattr(Counted, "runs", [])
    return Counted(RECORD)


def predict(model, cache, state="virgin", pool=None):
    thetas = np.linspace(-1.0, 2.0, 61)[:, None]
    quantities = {"histories": None, "peaks": peak("displacement")}
    options = {"record": OTHER, "quantity": quantities, "from_state": state, "rest": 1.0, "progress": False}
    return propagate(model, thetas, cache=cache, pool=pool, **options)


@pytest.mark.parametrize("state", ["virgin", "end"])
def test_stored_responses_give_the_same_bits_and_no_simulations(model, tmp_path, state):
    expected = predict(model, None, state)
    assert len(model.runs) == 61
    for process in range(3):  # a new object of the cache stands for a new process
        model.runs.clear()
        found = predict(model, SimulationCache(tmp_path / "cache.sqlite"), state)
        assert len(model.runs) == 61 if process == 0 else len(model.runs) <= 4  # responses and failures are verified
        for name, each in expected.items():
            for attribute in ("mean", "variance", "quantiles", "failed"):
                np.testing.assert_array_equal(getattr(found[name], attribute), getattr(each, attribute))
            assert found[name].failure_reasons == {"too flexible": 10}


def test_an_interrupted_prediction_goes_on_where_it_was(model, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "interrupted_at", 20, raising=False)
    with pytest.raises(KeyboardInterrupt):
        predict(model, tmp_path / "cache.sqlite")
    assert len(model.runs) == 20
    stored = SimulationCache(tmp_path / "cache.sqlite").info().responses
    assert stored >= 1
    monkeypatch.setattr(sys, "interrupted_at", None, raising=False)
    predict(model, tmp_path / "cache.sqlite")
    assert len(model.runs) <= 20 + (61 - stored) + 3  # two sums and a response are verified


def test_control_responses_of_a_changed_model_are_not_used(model, tmp_path, monkeypatch):
    predict(model, tmp_path / "cache.sqlite")
    monkeypatch.setattr(Counted, "factor", 1.1)  # its fingerprint does not say so
    changed = predict(Counted(RECORD), SimulationCache(tmp_path / "cache.sqlite"))
    expected = predict(Counted(RECORD), None)
    np.testing.assert_array_equal(changed["histories"].mean, expected["histories"].mean)
