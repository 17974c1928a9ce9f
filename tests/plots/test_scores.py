"""The figure of scores shows what the scores say: intervals, shares, and the band of chance."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from fe_likelihoods.plots.scores import plot_scores
from fe_likelihoods.prediction.scores import score_histories, score_values
from fe_likelihoods.signals.channels import Channel

CHANNELS = (Channel("deck", "absolute acceleration", "g"), Channel("drift", "relative displacement", "mm"))


def numbers(measured, rng, factor=1.0, center=None):
    """Scores of lognormal predictions about `center`; their spread is `factor` times the spread of events, 20 %."""
    values = (measured if center is None else center) * np.exp(0.2 * factor * rng.normal(size=(500, len(measured))))
    return score_values([c.name for c in CHANNELS], [c.unit for c in CHANNELS], values, measured, 0.9)


@pytest.mark.parametrize(("factor", "calibrated"), [(1.0, True), (0.3, False)])
def test_shares_are_within_the_band_of_chance_for_calibrated_predictions_alone(factor, calibrated, rng):
    measured = np.exp(0.2 * rng.normal(size=(60, 2)))
    axes = plot_scores({f"EQ{k}": numbers(each, rng, factor, np.ones(2)) for k, each in enumerate(measured)}).axes[1]
    bands = [each.get_paths()[0].vertices[:, 1] for each in axes.collections[::2]]
    within = [line.get_ydata()[0] for line in axes.lines]
    for share, band in zip(within, bands, strict=True):
        assert (band.min() <= share <= band.max()) == calibrated
    plt.close("all")


def test_intervals_of_numbers_are_drawn_relative_to_the_measured_values_in_the_order_of_events(rng):
    events = {name: numbers(np.array(values), rng) for name, values in {"B": (2.0, 0.01), "A": (0.5, 0.03)}.items()}
    figure = plot_scores(events)
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert [each.split(":")[0] for each in labels] == ["B, deck", "B, drift", "A, deck", "A, drift"]
    assert labels[1] == "B, drift: 10 mm"
    outer, inner = (each.get_segments() for each in figure.axes[0].collections[:2])
    np.testing.assert_allclose(
        [segment[:, 0] for segment in outer[2:]],
        np.stack([events["A"].lower, events["A"].upper], axis=1) / events["A"].measured[:, None],
    )
    assert all(o[0, 0] < i[0, 0] < i[1, 0] < o[1, 0] for o, i in zip(outer, inner, strict=True))
    shares = [line.get_ydata()[0] for line in figure.axes[1].lines]
    pit = np.concatenate([each.pit for each in events.values()])
    assert shares == [np.mean(np.abs(pit - 0.5) <= 0.25), np.mean(np.abs(pit - 0.5) <= 0.45)]
    plt.close("all")


def test_scores_that_do_not_belong_together_are_refused(rng):
    ones = np.ones((2, 9))
    histories = score_histories(CHANNELS, ones, (ones, ones), (0.0 * ones, 2.0 * ones), 0.9)
    for wrong in (histories, {"a": numbers(np.array([1.0, 2.0]), rng), "b": histories}, {}):
        with pytest.raises(ValueError, match="expected scores of numbers such as peaks, of one event or more"):
            plot_scores(wrong)
    with pytest.raises(ValueError, match=r"divided by the measured values.*drift"):
        plot_scores(numbers(np.array([1.0, 0.0]), rng))
