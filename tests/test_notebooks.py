"""Objects in notebooks: tables that are well formed, escaped, and in the units of the reader."""

import importlib.util
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
    MultivariateNormal,
    Posterior,
    Prior,
    Record,
    TruncatedNormal,
    peak,
    propagate,
)
from fe_likelihoods.plots.html import html_history
from samplers import SMCSampler

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


def shown(thing):
    """Text, and the rows of the table, of an object in a notebook; ParseError if its HTML is not well formed."""
    tree = ElementTree.fromstring(thing._repr_html_())
    rows = [["".join(cell.itertext()) for cell in row] for row in tree.iter("tr")]
    return "".join(tree.itertext()), [dict(zip(rows[0], row, strict=True)) for row in rows[1:]] if rows else []


def test_record():
    text, (row,) = shown(Record("El <Centro>", 0.02, 9.80665 * np.sin(TIME), "a source"))
    assert "Record El <Centro>" in text and "a source" in text
    assert row["samples"] == "50" and row["duration [s]"] == "0.98"
    assert float(row["peak [g]"]) == pytest.approx(np.abs(np.sin(TIME)).max(), rel=1e-3)


def test_measurements_with_a_gap():
    values = np.array([[np.nan, 0.001, np.nan, -0.003], [0.1, 0.2, 0.3, 0.4]])
    two = (*CHANNELS, Channel("base", "acceleration", "m/s^2"))
    text, rows = shown(Measurements(two, (0.5, 0.25), values, "made & up", start=(1.0, 0.0)))
    assert "made & up" in text
    assert (rows[0]["channel"], rows[0]["samples"], rows[0]["missing"]) == ("top <1>", "2", "1")
    assert (rows[0]["first [s]"], rows[0]["peak"], rows[0]["unit"]) == ("1.5", "3", "mm")
    assert rows[1]["RMS"] == "0.2739" and rows[1]["missing"] == "0"


def test_prior_with_a_joint_distribution():
    prior = Prior({("a", "b"): MultivariateNormal([1.0, 2.0], [[0.04, 0.0], [0.0, 0.01]]), "c": HalfNormal(0.1)})
    _, rows = shown(prior.reorder(["c", "b", "a"]))
    assert [row["parameter"] for row in rows] == ["c", "b", "a"]
    assert float(rows[1]["mean"]) == pytest.approx(2.0, abs=0.01) and rows[1]["lower"] == "-inf"
    assert rows[0]["distribution"] == "HalfNormal(sd=0.1)" and rows[0]["lower"] == "0"


def test_posterior_and_sampler(posterior):
    sampler = SMCSampler(60, 3, posterior, vectorize=True, seed=1)
    assert "Not run yet" in shown(sampler)[0]
    assert "0 simulations so far" in shown(posterior)[0]
    sampler.run_mcmc(None, 2)
    text, rows = shown(posterior)
    assert "FunctionModel, GaussianNoise, 50 samples of top <1>" in text
    assert f"{posterior.report()['simulations']} simulations so far" in text
    assert [row["prior"] for row in rows] == ["TruncatedNormal", "gamma", "HalfNormal"]
    assert rows[2]["parameter"] == "sigma_top <1> [mm]"
    assert float(rows[2]["mean"]) == pytest.approx(2.0 * np.sqrt(2.0 / np.pi), rel=1e-3)
    text, _ = shown(sampler)
    assert f"Log-evidence {sampler.log_evidence:.2f}" in text and str(sampler.verdict) in text
    chain, (first, _, last) = sampler.get_chain(flat=True), text.splitlines()[-3:]
    assert last.startswith("sigma_top <1> [mm]")
    assert float(last.split()[-4]) == pytest.approx(1000.0 * chain[:, 2].mean(), rel=1e-3)
    assert float(first.split()[-2]) == pytest.approx(chain[:, 0].std(), rel=1e-3)


def test_prediction(posterior):
    points = posterior.sample_prior(40, 1)
    histories = propagate(posterior, points, progress=False)
    text, (row,) = shown(histories)
    assert "40 samples, without measurement noise" in text
    assert float(row["largest mean"]) == pytest.approx(1000.0 * np.abs(histories.mean).max(), rel=1e-3)
    (row,) = shown(propagate(posterior, points, quantity=peak("top <1>"), progress=False))[1]
    assert row["unit"] == "mm" and float(row["mean"]) == pytest.approx(10.0 * points[:, 0].mean(), rel=0.01)


def test_no_peak_of_a_long_history_is_lost():
    values = np.zeros(100_000)
    values[12_345] = 1.0
    graphic = ElementTree.fromstring(html_history(values))
    (line,) = graphic
    heights = [float(point.split(",")[1]) for point in line.attrib["points"].split()]
    assert len(heights) <= 600 and heights.count(1.0) == 1 and max(heights) == 39.0
    assert len(ElementTree.fromstring(html_history(np.array([0.0, 1.0, np.nan, 2.0])))) == 2  # a gap


@pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("nbclient", "nbformat", "ipykernel")), reason="NO ipykernel"
)
@pytest.mark.slow
def test_a_kernel_shows_the_table(tmp_path):
    import nbclient
    import nbformat

    code = "from fe_likelihoods import Prior, HalfNormal\nPrior({'sigma': HalfNormal(0.1)})"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    (output,) = notebook.cells[0].outputs
    assert "HalfNormal(sd=0.1)" in output.data["text/html"]
