"""Figures of runs are asserted by what they show: stages, evaluations by phase, evidence, log-probability."""

import emcee
import matplotlib
import numpy as np
import pytest

from samplers import SMCSampler, ladder_table, plot_ladder, plot_run
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


def test_ladder_shows_every_stage_at_its_cost(run):
    beta, sizes, moves, evidence, acceptance = plot_ladder(run).axes
    stages = run.ladder
    ends = np.cumsum([stage.evaluations for stage in stages])
    assert beta.get_ylabel() == r"exponent $\beta$ [-]" and beta.get_yscale() == "log"
    np.testing.assert_array_equal(beta.lines[0].get_xdata(), ends)
    assert list(beta.lines[0].get_ydata()) == [stage.beta for stage in stages]
    assert f"{len(stages)} stages" in beta.get_title() and f"{run.log_evidence:.2f}" in beta.get_title()
    assert legend(sizes) == ["effective sample size", "distinct points", "walkers"]
    assert list(sizes.lines[0].get_ydata()) == [stage.effective_sample_size for stage in stages]
    assert [bar.get_height() for bar in moves.patches] == [stage.moves for stage in stages]
    assert [bar.get_width() for bar in moves.patches] == [stage.evaluations for stage in stages]
    assert list(acceptance.lines[0].get_ydata()) == [stage.acceptance for stage in stages]
    so_far = evidence.containers[0].lines[0].get_ydata()
    assert so_far[-1] == pytest.approx(run.log_evidence_ladder) and len(so_far) == len(stages)
    assert evidence.get_xlabel() == "evaluations of the log-probability"


def test_ladder_shows_an_effective_sample_size_above_the_number_of_walkers(guided):
    """As of the weighted draws of a guide."""
    beta, sizes, moves, *_ = plot_ladder(guided).axes
    assert beta.get_title().startswith("1 stage, ") and moves.get_ylim() == (0, 1.05)
    assert 100 < guided.ladder[0].effective_sample_size < sizes.get_ylim()[1]


def test_stages_without_evaluations_are_drawn_against_their_number(run):
    class Read:
        """As read from a file of an earlier version."""

        ladder = tuple(stage._replace(evaluations=0) for stage in run.ladder)
        ended_at = None
        nwalkers, log_evidence, log_evidence_error = run.nwalkers, run.log_evidence, run.log_evidence_error

    *_, evidence, _ = plot_ladder(Read()).axes
    assert evidence.get_xlabel() == "stage"
    assert list(evidence.containers[0].lines[0].get_xdata()) == [*range(1, len(run.ladder) + 1)]


def test_an_unfinished_ladder_says_so(run):
    class Unfinished:
        ladder, nwalkers, ended_at = run.ladder[:2], run.nwalkers, None

    title = plot_ladder(Unfinished()).axes[0].get_title()
    assert "not finished" in title and f"{run.ladder[1].beta:.3g}" in title


def test_run_shows_where_the_evaluations_went(run):
    phases, sizes, evidence, chain = plot_run(run).axes
    widths = {text.rpartition(": ")[0]: int(text.rpartition(": ")[2]) for text in legend(phases)}
    assert sum(widths.values()) == run.evaluations
    assert widths["tempering"] == sum(stage.evaluations for stage in run.ladder)
    assert widths["sweeps at beta = 1"] == 5 * 40
    assert widths["check of the evidence"] == run.log_evidence_check.evaluations
    assert [bar.get_width() for bar in phases.patches] == list(widths.values())
    assert legend(sizes) == ["tempering stages", "walkers"]
    assert "result of the run" in legend(evidence)
    median = next(line for line in chain.lines if line.get_label() == "median").get_ydata()
    np.testing.assert_allclose(median, np.median(run.get_log_prob(), axis=1))
    assert chain.get_xlabel() == "step at beta = 1"


def test_run_shows_the_rounds_of_a_guide(guided):
    phases, sizes, evidence, chain = plot_run(guided).axes
    assert legend(phases)[0] == f"draws of the guide: {sum(r.draws for r in guided.rounds)}"
    assert legend(sizes) == ["rounds of the guide", "walkers"]
    assert list(sizes.lines[0].get_ydata()) == [r.effective_sample_size for r in guided.rounds]
    assert evidence.containers[0].lines[0].get_ydata()[-1] == guided.rounds[-1].log_evidence
    assert legend(chain) == ["median and 90 % of the walkers"]


def test_run_without_steps_says_so():
    sampler = SMCSampler(40, 3, Gaussian(), vectorize=True, seed=1)
    sampler.run_mcmc(None, 0)
    chain = plot_run(sampler).axes[3]
    assert [text.get_text() for text in chain.texts] == ["no steps at beta = 1 were made"]


@pytest.mark.parametrize("function", [plot_ladder, plot_run, ladder_table])
def test_other_samplers_are_refused(function):
    with pytest.raises(ValueError, match="expected a tempered sampler.*got EnsembleSampler"):
        function(emcee.EnsembleSampler(40, 3, Gaussian()))
    with pytest.raises(ValueError, match="call run_mcmc first"):
        function(SMCSampler(40, 3, Gaussian()))
