"""The figure of a run: drawn for annealing and for a guide, refused for other samplers."""

import emcee
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from samplers import SMCSampler, ladder_table, plot_run
from tests.contract.targets import Gaussian
from tests.tempering.test_guided import laplace

matplotlib.use("Agg")


@pytest.mark.parametrize("guided", [False, True])
def test_run_shows_every_stage_or_round_at_its_cost(guided):
    posterior = Gaussian()
    settings = {"guide": laplace(posterior)} if guided else {}
    run = SMCSampler(100, 3, posterior, vectorize=True, seed=1, **settings)
    run.run_mcmc(None, 5)
    phases, *_, sizes, evidence, chain = (axes for axes in plot_run(run).axes if axes.get_ylabel() != "acceptance [-]")
    widths = [int(text.get_text().rpartition(": ")[2]) for text in phases.get_legend().get_texts()]
    assert sum(widths) == run.evaluations and [bar.get_width() for bar in phases.patches] == widths
    parts = run.rounds if guided else run.ladder
    assert list(sizes.lines[0].get_ydata()) == [part.effective_sample_size for part in parts]
    so_far = evidence.containers[0].lines[0].get_ydata()
    assert so_far[-1] == pytest.approx(parts[-1].log_evidence if guided else run.log_evidence_ladder)
    np.testing.assert_array_equal(evidence.containers[0].lines[0].get_xdata()[-1], sizes.lines[0].get_xdata()[-1])
    assert chain.get_xlabel() == "step at beta = 1"
    plt.close("all")


@pytest.mark.parametrize("function", [plot_run, ladder_table])
def test_other_samplers_are_refused(function):
    with pytest.raises(ValueError, match="expected a tempered sampler.*got EnsembleSampler"):
        function(emcee.EnsembleSampler(40, 3, Gaussian()))
    with pytest.raises(ValueError, match="call run_mcmc first"):
        function(SMCSampler(40, 3, Gaussian()))
