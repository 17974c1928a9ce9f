"""Figures of samples are asserted by what they show: limits, labels, densities, marks of true and nominal values."""

from typing import NamedTuple

import matplotlib
import numpy as np
import pytest

from fe_likelihoods import HalfNormal, Prior, TruncatedNormal
from samplers import plot_corner
from samplers.reporting.figures import plot_marginals

matplotlib.use("Agg")
import matplotlib.pyplot as plt

NAMES = ["stiffness", "damping [%]", "sigma [mm]"]
RED, GREY = "#b03a48", "#8a8f98"


class Shown(NamedTuple):
    """As `fe_likelihoods.likelihood.parameters.Parameter`."""

    name: str
    label: str
    factor: float = 1.0
    nominal: float = np.nan


class Posterior:
    """Two multiples of nominal values, and a noise level in metres that is shown in millimetres."""

    parameter_names = ("k", "c", "sigma")
    parameters = (
        Shown("k", "k [x 3 kN/m]", 1.0, 1.0),
        Shown("c", "c [x 0.02]", 1.0, 1.0),
        Shown("sigma", "sigma [mm]", 1e-3),
    )
    prior = Prior({"k": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.5), "sigma": HalfNormal(0.01)})


@pytest.fixture
def samples(rng):
    return rng.multivariate_normal([1.0, 5.0, 0.2], np.diag([0.01, 1.0, 1e-4]), size=500)


@pytest.fixture
def updated(rng):
    return rng.normal([1.2, 0.9, 0.002], [0.1, 0.2, 0.0002], size=(600, 3))


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


def grid(figure) -> np.ndarray:
    n = round(len(figure.axes) ** 0.5)
    return np.array(figure.axes, dtype=object).reshape(n, n)


def lines(axes, colour: str) -> list[float]:
    """Positions of the vertical lines of a colour."""
    marks = [line for line in axes.lines if line.get_color() == colour and len(line.get_xdata()) == 2]
    return [line.get_xdata()[0] for line in marks if line.get_xdata()[0] == line.get_xdata()[1]]


def legend(figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_corner_shows_units_prior_truth_and_nominal_values(updated):
    figure = plot_corner(updated, Posterior(), truths=[1.25, 0.95, 0.0021])
    axes = grid(figure)
    labels = ["k\n[x 3 kN/m]", "c\n[x 0.02]", "sigma\n[mm]"]
    assert [each.get_xlabel() for each in axes[-1]] == labels
    assert [each.get_ylabel() for each in axes[:, 0]] == ["", *labels[1:]]
    assert legend(figure) == ["posterior", "prior", "nominal value", "true value"]
    low, high = axes[2, 2].get_xlim()
    assert low < 1e3 * updated[:, 2].min() < 1e3 * updated[:, 2].max() < 1.2 * high, "millimetres"
    assert lines(axes[2, 2], RED) == [pytest.approx(2.1)] and lines(axes[0, 0], GREY) == [1.0]
    prior = next(line for line in axes[0, 0].lines if line.get_linestyle() == ":")
    np.testing.assert_allclose(prior.get_ydata(), np.exp(Posterior.prior.distributions["k"].logpdf(prior.get_xdata())))
    of_sigma = next(line for line in axes[2, 2].lines if line.get_linestyle() == ":")
    assert of_sigma.get_ydata()[0] == pytest.approx(
        1e-3 * np.exp(Posterior.prior.distributions["sigma"].logpdf(1e-3 * of_sigma.get_xdata()[0]))
    )
    assert axes[0, 0].get_title() == f"{updated[:, 0].mean():.3f} ± {updated[:, 0].std():.3f}"


def test_numbers_of_eight_parameters_do_not_touch(rng):
    """Those of one axis among each other, and those of a panel and the next one."""
    means, deviations = (
        [0.59, 0.96, 0.27, 4.73, 2.43, 12.0, 0.004947, 0.02247],
        [1.2e-4, 1e-4, 5e-4, 0.04, 6e-4, 3, 2e-5, 1e-4],
    )
    figure = plot_corner(rng.normal(means, deviations, size=(400, 8)))
    figure.canvas.draw()
    axes = grid(figure)
    for texts in ([each.get_xticklabels() for each in axes[-1]], [each.get_yticklabels() for each in axes[1:, 0]]):
        ends = [text.get_window_extent() for each in texts for text in each]
        assert len(ends) >= 14
        # rotated by 45 degrees: boxes of neighbours overlap, their baselines are a letter apart
        places = np.array([[box.x1, box.y1] for box in ends])
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 20.0


def test_chosen_parameters_keep_their_marks(updated):
    axes = grid(plot_corner(updated, Posterior(), truths=[1.25, 0.95, 0.0021], var_names=["sigma", "k"]))
    assert [each.get_xlabel() for each in axes[-1]] == ["sigma\n[mm]", "k\n[x 3 kN/m]"]
    assert lines(axes[1, 0], RED) == [pytest.approx(2.1)] and lines(axes[1, 1], RED) == [1.25]
    (axes,) = plot_corner(updated, Posterior(), var_names=["k"]).axes
    assert lines(axes, GREY) == [1.0], "a single parameter"


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (lambda x: x[0], {}, r"array \(n, ndim\) with n >= 2"),
        (lambda x: np.vstack([x[1:], [np.nan, 1.0, 1.0]]), {}, "1 of 600 rows are not"),
        (
            lambda x: x[:, :2],
            {"posterior": Posterior()},
            r"3 parameters \(k, c, sigma\), but the samples have 2 columns",
        ),
        (lambda x: x, {"truths": [1.0]}, "truths must have one value for each of 3"),
        (lambda x: x[:2], {}, "n >= ndim"),
        (
            lambda x: x,
            {"posterior": ["k", "c", "sigma"]},
            r"var_names= chooses parameters\); got \['k', 'c', 'sigma'\]",
        ),
        (lambda x: x, {"posterior": Posterior(), "var_names": ["c", "m"]}, r"k, c, sigma; got \['c', 'm'\]"),
    ],
)
def test_wrong_arguments_are_refused(change, arguments, message, updated):
    with pytest.raises(ValueError, match=message):
        plot_corner(change(updated), **arguments)


def test_marginals_show_what_the_data_changed(updated):
    figure = plot_marginals(updated, Posterior(), truths=[1.25, 0.95, 0.0021])
    k, c, sigma = figure.axes
    assert [axes.get_xlabel() for axes in figure.axes] == ["k [x 3 kN/m]", "c [x 0.02]", "sigma [mm]"]
    low, high = k.get_xlim()
    assert low < 0.4 and high > 1.6, "the prior is in the panel"
    assert sigma.get_title().endswith("times wider") and sigma.get_xlim()[1] < 4.0, "the prior is much wider"
    ratio = float(sigma.get_title().split()[-3])
    assert ratio == pytest.approx(0.01 * np.sqrt(1.0 - 2.0 / np.pi) / updated[:, 2].std(), rel=0.1)
    assert lines(k, RED) == [1.25] and lines(k, GREY) == [1.0] == lines(c, GREY)
    constant = np.column_stack([updated[:, :2], 0.002 * (1.0 + 1e-16 * np.arange(len(updated)))])
    assert "wider" not in plot_marginals(constant, Posterior()).axes[2].get_title()
