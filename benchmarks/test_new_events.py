"""Few events of real structures predict the others."""

import numpy as np
import pytest

from benchmarks.new_events import new_events


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.usefixtures("shared")
def test_few_events_of_a_real_bridge_predict_the_others():
    """In the mean over models and sizes, and in the worst of them."""
    decks = "Painter Street", "Painter Street ground", "Painter Street along", "Painter Street east end"
    rows = list(new_events(structures=decks))
    assert len(rows) == 24
    for what in ("peaks", "Arias intensities"):
        shares = [row.value for row in rows if row.what.startswith(what)]
        assert 85.0 < np.mean(shares) and 70.0 < min(shares)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.usefixtures("shared")
def test_three_columns_predict_the_peaks_of_the_next():
    rows = list(new_events(structures=("columns",)))
    simulations, shares = ([row.value for row in rows if row.what.startswith(what)] for what in ("sim", "peaks"))
    assert len(simulations) == len(shares) == 4 and max(simulations) <= 800
    assert 85.0 < np.mean(shares) < 97.0 and min(shares) > 60.0


def test_twins_with_a_stated_spread_are_covered():
    rows = new_events(structures=("twins",), sizes=(3,), twins=40)
    shares = [row.value for row in rows if row.case.endswith("stated")]
    assert len(shares) == 8 and 85.0 < np.mean(shares) < 99.0
