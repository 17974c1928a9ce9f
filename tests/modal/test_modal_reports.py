"""What a report says and draws of modes, load tests and histories of one structure."""

import re
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModes,
    LogNormal,
    ModalData,
    ModalLikelihood,
    Posterior,
    ShearFrame,
    check_result,
    propagate,
    report,
)
from fe_likelihoods.modal.load_cases import LoadTest
from fe_likelihoods.modal.mode_models import StructureModes
from tests.checks.fitted import check_fit
from tests.emulation.problems import guided

FLOORS = {"floor 1": 1, "roof": 2}
FRAME = ShearFrame(FLOORS, [20e3] * 2, [30e6] * 2)
PRIOR = {"stiffness_1": LogNormal(1.0, 0.2), "stiffness_2": LogNormal(1.0, 0.2)}
TRUTH = np.array([1.0, 0.9])
OF_TIME = re.compile(r"time step|clock|spectr|histor| at 1 s|time \[s\]|Motion", re.IGNORECASE)


def pulled(theta):
    return np.outer(np.cumsum(1.0 / (30e6 * theta)), [10e3, 20e3])


def modal_likelihood(rng):
    response = StructureModes(FRAME).simulate(TRUTH)
    shapes = response[1:].T / np.linalg.norm(response[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(2, 2))
    data = ModalData(response[0], shapes, tuple(FLOORS), frequency_cv=0.005, shape_error=0.02, description="a frame")
    return ModalLikelihood(FRAME, data)


def static_likelihood(rng):
    channels = [Channel(name, "displacement", "mm") for name in FLOORS]
    values = pulled(TRUTH) + 2e-5 * rng.normal(size=(2, 2))
    test = LoadTest(channels, ["10 kN", "20 kN"], values, errors=dict.fromkeys(FLOORS, 2e-5))
    return FELikelihood(test.model(pulled, tuple(PRIOR)), test.measurements), test.known


def reported(posterior, path, predicted=False):
    """Text of the report of a guided run, without styles and pictures, and the judgement."""
    sampler = guided(posterior, starts=3)
    samples = sampler.get_chain(flat=True)[:10]
    page = report(sampler, posterior, propagate(posterior, samples) if predicted else None, out=path / "report.html")
    text = page.read_text()
    assert text.count("data:image/png") == 5 + predicted - 1 and "could not be drawn" not in text
    text = re.sub(r"<style>.*?</style>|src=\"[^\"]*\"|<pre>.*?</pre>", "", text, flags=re.DOTALL)
    return text, check_result(sampler)


@pytest.mark.slow
def test_modes_are_a_table_and_a_figure_and_nothing_is_said_of_time(rng, tmp_path):
    text, judgement = reported(Posterior(modal_likelihood(rng), PRIOR), tmp_path)
    assert judgement.status == "use" and not judgement.findings
    assert "2 parameters of ShearFrame and its noise were updated with 2 measured modes" in text
    assert "Data: natural frequencies and mode shapes of a frame" in text
    assert "Measured and computed modes" in text and '<th class="n">measured [Hz]</th>' in text
    assert not OF_TIME.findall(text) and "RRMSE" not in text


@pytest.mark.slow
def test_load_cases_are_bars_and_nothing_is_said_of_time(rng, tmp_path):
    static, known = static_likelihood(rng)
    text, judgement = reported(Posterior(static, PRIOR | known), tmp_path, predicted=True)
    assert judgement.status == "use" and not judgement.findings
    assert "roof [mm], 2 values (load case)" in text and "Measured and computed values" in text
    assert "Predicted values" in text and not OF_TIME.findall(text)


def matrices(theta):
    stiffness = 30e6 * np.array([[theta[0] + theta[1], -theta[1]], [-theta[1], theta[1]]])
    return stiffness, np.diag([20e3, 20e3])


@pytest.mark.parametrize("workers", [None, 2])
def test_a_sample_is_simulated_once_for_all_reports_also_with_a_pool_and_after_a_restart(workers, rng, tmp_path):
    """Statistics of the likelihood and modes that are predicted are of the same simulations."""

    def posterior():
        model = FunctionModes(matrices, tuple(PRIOR), {"floor 1": 0, "roof": 1}, n_modes=2)
        return Posterior(ModalLikelihood(model, data, pool=workers, cache=tmp_path / "cache"), PRIOR)

    data, theta = modal_likelihood(rng).model.data, np.exp(0.2 * rng.normal(size=(300, 2)))
    sampled = posterior()
    logs = sampled.log_prob(theta)  # as in a run
    found = str(sampled.likelihood.predict_modes(theta)), [str(each) for each in check_fit(sampled, theta)]
    draws = sampled.report()["simulations"] - 301  # of the prior; one is the centre of the samples
    assert 0 < draws <= 100
    again = posterior()
    assert (str(again.likelihood.predict_modes(theta)), [str(each) for each in check_fit(again, theta)]) == found
    assert (again.log_prob(theta) == logs).all() and again.report()["simulations"] == 0
    assert again.report()["verifications"] < 20
    other = replace(data, frequencies=data.frequencies * 1.01)  # other data of the same model
    changed = ModalLikelihood(again.likelihood.model.model, other, cache=tmp_path / "cache")
    assert np.isfinite(changed(theta)).all() and changed.simulations == 0
