"""A sampler in a notebook: its summary is well formed, escaped, and in the units of the reader."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
)
from samplers import SMCSampler, summary

CHANNELS = (Channel("top <1>", "displacement", "mm"),)
TIME = 0.01 * np.arange(50)


def response(theta):
    return 0.01 * theta[0] * np.cos(8.0 * theta[1] * TIME)[None]


@pytest.fixture
def posterior():
    model = FunctionModel(response, ["a", "b"], CHANNELS, 0.01, 50, version="1")
    noise = 0.0005 * np.random.default_rng(1).standard_normal((1, 50))
    measured = Measurements(CHANNELS, 0.01, response([1.1, 0.9]) + noise, "made & up")
    prior = {"a": TruncatedNormal(1.0, 0.3), "b": stats.gamma(20.0, scale=0.05), "sigma_top <1>": HalfNormal(0.002)}
    return Posterior(FELikelihood(model, measured), prior)


def test_a_sampler_shows_its_summary(posterior):
    """Well-formed HTML with escaped names, before and after the run."""

    def text():
        return "".join(ElementTree.fromstring(sampler._repr_html_()).itertext())

    sampler = SMCSampler(60, 3, posterior, vectorize=True, seed=1)
    assert "Not run yet" in text()
    sampler.run_mcmc(None, 2)
    for table in (summary(sampler.get_chain(flat=True)), sampler.verdict):
        assert repr(table) == str(table) and "array(" not in repr(table)
    assert f"Log-evidence {sampler.log_evidence:.2f}" in text() and str(sampler.verdict) in text()
    chain, (first, _, last) = sampler.get_chain(flat=True), text().splitlines()[-3:]
    assert last.startswith("sigma_top <1> [mm]")
    assert float(last.split()[-5]) == pytest.approx(1000.0 * chain[:, 2].mean(), rel=1e-3)
    assert float(first.split()[-3]) == pytest.approx(chain[:, 0].std(), rel=1e-3)
