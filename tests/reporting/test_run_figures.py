"""Figures of runs are asserted by what they show: stages, evaluations by phase, evidence, log-probability."""

import emcee
import matplotlib
import numpy as np
import pytest

from samplers import SMCSampler, ladder_table, plot_run
from tests.contract.targets import Gaussian
from tests.tempering.test_guided import laplace

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


def legend(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


@pytest.fixture(scope="module")
def run():
    sampler = SMCSampler(40, 3, Gaussian(), vectorize=True, seed=1)
    sampler.run_mcmc(None, 5)
    return sampler


@pytest.fixture(scope="module")
def guided():
    posterior = Gaussian()
    sampler = SMCSampler(100, 3, posterior, vectorize=True, seed=1, guide=laplace(posterior))
    sampler.run_mcmc(None, 1)
    return sampler


def test_run_shows_every_stage_at_its_cost(run):
    phases, beta, sizes, evidence, chain, acceptance = plot_run(run).axes
    stages = run.ladder
    ends = np.cumsum([stage.evaluations for stage in stages])
    assert beta.get_ylabel() == r"exponent $\beta$ [-]" and beta.get_yscale() == "log"
    assert list(beta.lines[0].get_ydata()) == [stage.beta for stage in stages]
    assert list(acceptance.lines[0].get_ydata()) == [stage.acceptance for stage in stages]
    for line in (beta.lines[0], sizes.lines[0], acceptance.lines[0], evidence.containers[0].lines[0]):
        np.testing.assert_array_equal(line.get_xdata(), ends)
    assert f"{len(stages)} stages" in phases.get_title() and f"{run.log_evidence:.2f}" in phases.get_title()
    assert legend(sizes) == ["effective sample size", "distinct points", "walkers"]
    assert list(sizes.lines[0].get_ydata()) == [stage.effective_sample_size for stage in stages]
    assert list(sizes.lines[1].get_ydata()) == [stage.distinct_ancestors for stage in stages]
    so_far = evidence.containers[0].lines[0].get_ydata()
    assert so_far[-1] == pytest.approx(run.log_evidence_ladder) and len(so_far) == len(stages)
    assert evidence.get_xlabel() == "evaluations of the log-probability"


def test_run_shows_where_the_evaluations_went(run):
    phases, _, _, evidence, chain, _ = plot_run(run).axes
    widths = {text.rpartition(": ")[0]: int(text.rpartition(": ")[2]) for text in legend(phases)}
    assert sum(widths.values()) == run.evaluations
    assert widths["tempering"] == sum(stage.evaluations for stage in run.ladder)
    assert 0.9 * 5 * 40 <= widths["sweeps at beta = 1"] <= 5 * 40  # a point that is proposed again is known
    assert widths["check of the evidence"] == run.log_evidence_check.evaluations
    assert [bar.get_width() for bar in phases.patches] == list(widths.values())
    assert "result of the run" in legend(evidence)
    median = next(line for line in chain.lines if line.get_label() == "median").get_ydata()
    np.testing.assert_allclose(median, np.median(run.get_log_prob(), axis=1))
    assert chain.get_xlabel() == "step at beta = 1"


def test_run_shows_the_rounds_of_a_guide(guided):
    phases, sizes, evidence, chain = plot_run(guided).axes
    assert legend(phases)[0] == f"draws of the guide: {sum(r.draws for r in guided.rounds)}"
    assert legend(sizes) == ["effective sample size, guide", "walkers"]
    assert sizes.get_ylim()[1] > max(r.effective_sample_size for r in guided.rounds)
    assert list(sizes.lines[0].get_ydata()) == [r.effective_sample_size for r in guided.rounds]
    assert evidence.containers[0].lines[0].get_ydata()[-1] == guided.rounds[-1].log_evidence
    assert legend(chain) == ["median and 90 % of the walkers"]


@pytest.mark.parametrize("function", [plot_run, ladder_table])
def test_other_samplers_are_refused(function):
    with pytest.raises(ValueError, match="expected a tempered sampler.*got EnsembleSampler"):
        function(emcee.EnsembleSampler(40, 3, Gaussian()))
    with pytest.raises(ValueError, match="call run_mcmc first"):
        function(SMCSampler(40, 3, Gaussian()))
