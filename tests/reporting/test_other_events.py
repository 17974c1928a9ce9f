"""Other events in a report: tables, sentences, figures, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import Measurements, peak, propagate, report
from fe_likelihoods.checks.finding import CARE, Finding
from fe_likelihoods.reporting.contents import describe_event
from tests.reporting.report_page import read_page
from tests.reporting.test_report import vibrating

__all__ = ["vibrating"]  # the fixture

SEVERAL = {"histories": None, "peaks": [peak("top")]}


def predicted(vibrating, n=40, **options):
    sampler, posterior = vibrating
    samples = sampler.get_chain(flat=True)[:: len(sampler.get_chain(flat=True)) // n]
    return propagate(posterior, samples, quantity=SEVERAL, progress=False, seed=1, **options)


def scaled(posterior, factor):
    measured = posterior.likelihood.measurements
    return Measurements(measured.channels, measured.dt, factor * measured.values)


@pytest.mark.filterwarnings("ignore:the residuals")
def test_events_have_tables_sentences_and_figures(vibrating, tmp_path):
    sampler, posterior = vibrating
    events = {"same": predicted(vibrating, noise=True), "larger": predicted(vibrating, noise=True)}
    events["unmeasured"] = predicted(vibrating)["histories"]
    measured = {"same": posterior.likelihood.measurements, "larger": scaled(posterior, 1.5)}
    path = report(sampler, posterior, out=tmp_path / "report.html", events=events, measured=measured)
    page = read_page(path)
    numbers = next(table for table in page.tables if table[0][1] == "Quantity")[1:]
    assert [row[0] for row in numbers] == ["same", "larger"] and numbers[0][1] == "peak of top [mm]"
    peaks = events["same"]["peaks"]
    for row, factor in zip(numbers, (1.0, 1.5), strict=True):
        largest = 1e3 * factor * np.abs(posterior.likelihood.measurements.values).max()
        assert float(row[5]) == pytest.approx(largest, rel=5e-3)
        assert float(row[2]) == pytest.approx(1e3 * np.median(peaks.values), rel=1e-4)
        values = np.sort(1e3 * peaks.values.ravel())
        assert [float(end) for end in row[4].split(" to ")] == pytest.approx([values[2], values[-3]], rel=0.05)
    assert numbers[0][6].startswith("within") and numbers[1][6:] == ["above", "0.99"]
    assert (
        "0 of 1 measured numbers are within their 90 % intervals (peak of top above); so few show a share between"
        in page.text
    )
    assert "There are no measurements to compare with" in page.text
    histories = next(table for table in page.tables if table[0][-1] == "In the 90 % band")[1:]
    scores = events["larger"]["histories"].score(measured["larger"])
    assert [row[0] for row in histories] == ["same", "larger"]
    assert float(histories[1][5]) == pytest.approx(1e3 * scores.interval_score[0], rel=5e-3)
    assert histories[1][7] == f"{100 * scores.coverage[0]:.3g} %"
    drawn = [alt for _, alt in page.images]
    assert sum(alt.startswith("Predicted histories of") for alt in drawn) == 3
    assert "Predicted intervals by measured values of same, larger." in drawn


@pytest.mark.filterwarnings("ignore:the residuals")
def test_what_speaks_against_an_event_is_said(vibrating, tmp_path):
    sampler, posterior = vibrating
    few = predicted(vibrating, n=8, noise=True)
    told = describe_event("few", few, posterior.likelihood.measurements).sentence
    assert "No scores: score: expected 20 samples or more" in told
    far = (Finding("Far", CARE, "The peaks are far away."),)
    found = {name: replace(each, findings=far) for name, each in few.items()}
    assert describe_event("far", found, None).findings == far  # once for all quantities
    silent = describe_event("silent", predicted(vibrating), posterior.likelihood.measurements)
    assert "A band without noise shows the response" in silent.sentence
    other = describe_event("other", few, Measurements(posterior.likelihood.measurements.channels, 0.02, [[0.0] * 9]))
    assert "No scores: " in other.sentence


def test_what_are_no_predictions_of_events_is_refused(vibrating, tmp_path):
    sampler, posterior = vibrating
    path = tmp_path / "report.html"
    measured = posterior.likelihood.measurements
    known = {"second": predicted(vibrating)}
    for options, message in (
        ({"events": known["second"]["peaks"]}, "events must be a mapping of names"),
        ({"events": {"second": 3.0}}, "expected the result of propagate for each event.*'second' is 3.0"),
        ({"events": {"second": {}}}, "'second' has no prediction; give the result of propagate"),
        ({"events": known, "measured": {"third": measured}}, "measured has third, .* no event has this name"),
        ({"events": known, "measured": measured}, "measured must be a mapping of the names of events"),
    ):
        with pytest.raises(ValueError, match=message):
            report(sampler, posterior, out=path, **options)
    assert not path.exists()
