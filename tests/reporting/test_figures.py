"""Figures are asserted by what they show: data, labels, and axes that contain the true parameters."""

import emcee
import matplotlib
import numpy as np
import pytest

from samplers import SMCSampler, ladder_plot, ladder_table, pair_plot
from tests.contract.targets import Gaussian
from tests.tempering.test_guided import laplace

matplotlib.use("Agg")
import matplotlib.pyplot as plt

NAMES = ["stiffness", "damping [%]", "sigma [mm]"]


@pytest.fixture
def samples(rng):
    return rng.multivariate_normal([1.0, 5.0, 0.2], np.diag([0.01, 1.0, 1e-4]), size=500)


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


def test_pair_plot_shows_samples_labels_and_truth(samples):
    truth = [1.4, 4.0, 0.21]  # the first one is 4 standard deviations from the samples
    axes = np.array(pair_plot(samples, NAMES, truth=truth, max_points=200).axes).reshape(3, 3)
    for i in range(3):
        assert axes[2, i].get_xlabel() == axes[i, 0].get_ylabel() == NAMES[i]
        assert axes[i, i].get_title() == f"CV = {samples[:, i].std() / samples[:, i].mean():.2e}"
        for j in range(3):
            low, high = axes[i, j].get_xlim()
            assert low < samples[:, j].mean() < high and low < truth[j] < high
            assert any(np.all(np.asarray(line.get_xdata()) == truth[j]) for line in axes[i, j].lines)
            if i != j:
                assert axes[i, j].get_ylim()[0] < truth[i] < axes[i, j].get_ylim()[1]
    points = axes[0, 1].lines[0]
    assert len(points.get_xdata()) == 200 and set(points.get_xdata()) <= set(samples[:, 1])
    assert axes[1, 0].texts[0].get_text() == f"r = {np.corrcoef(samples[:, 0], samples[:, 1])[0, 1]:.2f}"
    assert len(axes[1, 0].collections) > 0, "contours of the density"


def test_pair_plot_points_to_values_outside_of_its_panels(samples):
    truth, nominal = [1.9, 5.0, np.nan], [0.2, 5.1, 0.2]  # 9 and -8 standard deviations from the samples
    axes = np.array(pair_plot(samples, NAMES, truth=truth, nominal=nominal).axes).reshape(3, 3)
    assert axes[0, 0].get_xlim()[0] > 0.2 and axes[0, 0].get_xlim()[1] < 1.9, "the panels stay those of the samples"
    values, arrows = [], []
    for text in axes[0, 0].texts:
        if text.get_text():
            values.append((text.get_text(), text.get_color()))
        else:
            arrows.append((text.xy[0], text.arrow_patch.get_edgecolor()))
    assert values == [("0.2", "#8a8f98"), ("1.9", "#d9822b")]
    assert [x for x, _ in arrows] == [0.01, 0.99]
    assert [text.xy[1] for text in axes[0, 1].texts] == [0.01, 0.99], "and upwards beside it"
    lines = [line.get_xdata()[0] for line in axes[1, 1].lines if len(line.get_xdata()) == 2]
    assert lines == [5.1, 5.0] and not axes[1, 1].texts
    assert sum(len(line.get_xdata()) == 2 for line in axes[2, 2].lines) == 1, "no mark for NaN"


def test_ladder_plot_shows_every_stage():
    sampler = SMCSampler(40, 3, Gaussian(), vectorize=True, seed=1)
    sampler.run_mcmc(None, 1)
    beta, sizes, moves, acceptance = ladder_plot(sampler).axes
    stages = sampler.ladder
    assert beta.get_ylabel() == r"$\beta$ [-]" and beta.get_yscale() == "log"
    assert list(beta.lines[0].get_ydata()) == [stage.beta for stage in stages]
    assert f"{len(stages)} stages" in beta.get_title() and f"{sampler.log_evidence:.2f}" in beta.get_title()
    labels = [text.get_text() for text in sizes.get_legend().get_texts()]
    assert labels == ["effective sample size", "distinct points", "walkers"]
    assert list(sizes.lines[0].get_ydata()) == [stage.effective_sample_size for stage in stages]
    assert [bar.get_height() for bar in moves.patches] == [stage.moves for stage in stages]
    assert moves.get_xlabel() == "stage" and moves.get_ylabel() == "sweeps per stage (bars)"
    assert list(acceptance.lines[0].get_ydata()) == [stage.acceptance for stage in stages]


def test_ladder_plot_shows_an_effective_sample_size_above_the_number_of_walkers():
    """As of the weighted draws of a guide."""
    posterior = Gaussian()
    sampler = SMCSampler(100, 3, posterior, vectorize=True, seed=1, guide=laplace(posterior))
    sampler.run_mcmc(None, 1)
    beta, sizes, moves, _ = ladder_plot(sampler).axes
    assert beta.get_title().startswith("1 stage, ") and moves.get_ylim() == (0, 1.05)
    assert [tick for tick in moves.get_xticks() if 0.3 < tick < 1.7] == [1]
    assert 100 < sampler.ladder[0].effective_sample_size < sizes.get_ylim()[1]


@pytest.mark.parametrize("function", [ladder_plot, ladder_table])
def test_ladders_of_other_samplers_are_refused(function):
    with pytest.raises(ValueError, match="expected a tempered sampler.*got EnsembleSampler"):
        function(emcee.EnsembleSampler(40, 3, Gaussian()))
    with pytest.raises(ValueError, match="call run_mcmc first"):
        function(SMCSampler(40, 3, Gaussian()))
