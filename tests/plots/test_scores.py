"""The figure of scores shows what the scores say: histogram, band of chance, coverage with errors, intervals."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.text import Text
from scipy import stats

from fe_likelihoods.plots.scores import plot_scores
from fe_likelihoods.prediction.scores import score_histories, score_values
from fe_likelihoods.signals.channels import Channel

CHANNELS = (Channel("deck", "absolute acceleration", "g"), Channel("drift", "relative displacement", "mm"))
STEPS = 4000


def histories(rng, factor=1.0, correlated=1):
    """Scores of two sines with normal errors; the stated standard deviation is `factor` times the true one."""
    mean = np.sin(0.1 * np.arange(STEPS)) * np.array([[3.0], [0.02]])
    sd = 0.2 * np.array([[3.0], [0.02]])
    kernel = np.ones(correlated) / np.sqrt(correlated)
    errors = np.array([np.convolve(row, kernel, "valid") for row in rng.normal(size=(2, STEPS + correlated - 1))])
    stated = np.broadcast_to(factor * sd, mean.shape)
    band = tuple(mean + z * stated for z in stats.norm.ppf([0.05, 0.95]))
    return score_histories(CHANNELS, mean + sd * errors, (mean, stated), band, 0.9)


def numbers(measured, rng):
    values = measured * np.exp(0.2 * rng.normal(size=(500, len(measured))))
    return score_values([c.name for c in CHANNELS], [c.unit for c in CHANNELS], values, measured, 0.9)


def bars(axes):
    return np.array([patch.get_height() for patch in axes.patches])


def chance(axes):
    """Ends of the shaded band."""
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    return heights.min(), heights.max()


def test_histogram_of_calibrated_histories_is_within_the_band_of_chance_and_that_of_narrow_ones_is_not(rng):
    low, high = chance(plot_scores(histories(rng)).axes[0])
    assert low < 0.1 < high
    assert np.mean((bars(plt.gcf().axes[0]) >= low) & (bars(plt.gcf().axes[0]) <= high)) >= 0.7
    narrow = plot_scores(histories(rng, factor=0.5)).axes[0]
    assert bars(narrow)[[0, -1]].min() > chance(narrow)[1] > bars(narrow)[4]
    plt.close("all")


def test_bars_show_width_and_penalty_in_multiples_of_the_rms(rng):
    one, other = histories(rng), histories(rng, factor=0.5)
    axes = plot_scores({"one": one, "other": other}).axes[2]
    ends = [patch.get_x() + patch.get_width() for patch in axes.patches]  # of both channels, width and penalty
    np.testing.assert_allclose(ends[::2], np.mean([each.width / each.rms for each in (one, other)], axis=0))
    np.testing.assert_allclose(ends[1::2], np.mean([each.interval_score / each.rms for each in (one, other)], axis=0))
    plt.close("all")


def test_coverage_of_several_events_has_the_error_between_events(rng):
    events = {f"EQ{k}": histories(rng, factor) for k, factor in enumerate((0.5, 1.0, 2.0))}
    axes = plot_scores(events).axes[1]
    each = np.array([scores.coverage for scores in events.values()])
    for k, drawn in enumerate(axes.containers):
        (segment,) = drawn[2][0].get_segments()
        assert drawn[0].get_xdata()[0] == pytest.approx(each[:, k].mean())
        assert 0.5 * np.ptp(segment[:, 0]) == pytest.approx(each[:, k].std(ddof=1) / np.sqrt(3))
    plt.close("all")


def test_intervals_of_numbers_are_drawn_relative_to_the_measured_values_in_the_order_of_events(rng):
    events = {name: numbers(np.array(values), rng) for name, values in {"B": (2.0, 0.01), "A": (0.5, 0.03)}.items()}
    figure = plot_scores(events)
    labels = [text.get_text() for text in figure.axes[1].get_yticklabels()]
    assert [each.split(":")[0] for each in labels] == ["B, deck", "B, drift", "A, deck", "A, drift"]
    assert labels[1] == "B, drift: 10 mm"
    outer, inner = (each.get_segments() for each in figure.axes[1].collections[:2])
    np.testing.assert_allclose(
        [segment[:, 0] for segment in outer[2:]],
        np.stack([events["A"].lower, events["A"].upper], axis=1) / events["A"].measured[:, None],
    )
    assert all(o[0, 0] < i[0, 0] < i[1, 0] < o[1, 0] for o, i in zip(outer, inner, strict=True))
    shares = [line.get_ydata()[0] for line in figure.axes[2].lines]
    pit = np.concatenate([each.pit for each in events.values()])
    assert shares == [np.mean(np.abs(pit - 0.5) <= 0.25), np.mean(np.abs(pit - 0.5) <= 0.45)]
    plt.close("all")


def test_scores_that_do_not_belong_together_are_refused(rng):
    with pytest.raises(ValueError, match="all of histories or all of numbers"):
        plot_scores({"a": histories(rng), "b": numbers(np.array([1.0, 2.0]), rng)})
    with pytest.raises(ValueError, match="expected scores of one event or more"):
        plot_scores({})
    with pytest.raises(ValueError, match=r"divided by the measured values.*drift"):
        plot_scores(numbers(np.array([1.0, 0.0]), rng))


def boxes(figure, artists):
    figure.canvas.draw()
    return [Text.get_window_extent(each) for each in artists if each.get_text()]  # of an annotation without its line


def overlaps(found):
    return [(i, j) for i, a in enumerate(found) for j, b in enumerate(found[:i]) if a.overlaps(b)]


@pytest.mark.parametrize("n", [3, 40])
def test_legends_cover_no_bar_and_labels_of_axes_do_not_overlap(rng, n):
    for events in (
        {f"EQ{k}": histories(rng, np.exp(0.3 * rng.normal())) for k in range(n)},
        {f"EQ{k}": numbers(np.exp(rng.normal(size=2)), rng) for k in range(n)},
    ):
        figure = plot_scores(events)
        figure.canvas.draw()
        legend = figure.axes[0].get_legend().get_window_extent()
        assert not any(legend.overlaps(bar.get_window_extent()) for bar in figure.axes[0].patches)
        labels = [axes.xaxis.label for axes in figure.axes] + [axes.yaxis.label for axes in figure.axes]
        labels += figure.axes[1].get_yticklabels() + figure.axes[1].get_xticklabels()
        labels += [axes.title for axes in figure.axes]
        assert not overlaps(boxes(figure, labels))
        assert figure.get_figheight() < 15.0 and figure.axes[0].get_window_extent().height > 100.0
        plt.close(figure)
