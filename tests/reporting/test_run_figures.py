"""The figure of a run: drawn for annealing and for a guide, refused for other samplers."""

import emcee
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from samplers import SMCSampler, plot_run
from tests.contract.targets import Gaussian
from tests.tempering.test_guided import laplace

matplotlib.use("Agg")


@pytest.mark.parametrize("guided", [False, True])
def test_run_shows_every_stage_or_round_at_its_cost(guided):
    posterior = Gaussian()
    settings = {"guide": laplace(posterior)} if guided else {}
    run = SMCSampler(100, 3, posterior, vectorize=True, seed=1, **settings)
    run.run_mcmc(None, 5)
    figure = plot_run(run)
    *_, sizes, evidence, chain = figure.axes
    assert figure.get_suptitle().startswith(f"{run.simulations:.0f} simulations, ")
    made = f", after {run.simulations_of_guides:.0f} simulations by the guide" if guided else ""
    assert evidence.get_xlabel() == f"evaluations of the log-probability{made}"
    parts = run.rounds if guided else run.ladder
    assert list(sizes.lines[0].get_ydata()) == [part.effective_sample_size for part in parts]
    so_far = evidence.containers[0].lines[0].get_ydata()
    assert so_far[-1] == pytest.approx(parts[-1].log_evidence if guided else run.log_evidence_ladder)
    np.testing.assert_array_equal(evidence.containers[0].lines[0].get_xdata()[-1], sizes.lines[0].get_xdata()[-1])
    assert chain.get_xlabel() == "step at beta = 1"
    plt.close("all")


@pytest.mark.parametrize("Sampler", [emcee.EnsembleSampler, SMCSampler])
def test_samplers_without_stages_are_refused(Sampler):
    with pytest.raises(ValueError, match=f"call run_mcmc first; got {Sampler.__name__}"):
        plot_run(Sampler(40, 3, Gaussian()))
