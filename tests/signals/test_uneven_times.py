"""Samples at uneven times: jitter and lost packets."""

import numpy as np
import pytest

from fe_likelihoods import Channel, read_columns
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.signals.sampling import uniform_times
from fe_likelihoods.units import G0

TOP = Channel("top", "acceleration", "g")
STEP = 0.01


def motion(times):
    return np.sin(2 * np.pi * times) + 0.3 * np.cos(7 * times)


def write(path, times):
    rows = (f"{time:.6f},{value:.8f}" for time, value in zip(times, motion(times), strict=True))
    path.write_text("time_s,acc_g\n" + "\n".join(rows) + "\n")
    return path


def uneven(lost=()):
    times = STEP * np.arange(300) + 0.2 * STEP * np.random.default_rng(1).uniform(-1, 1, 300)
    return np.delete(times, lost)


def test_jitter_is_interpolated_within_the_curvature_of_the_motion(tmp_path):
    path = write(tmp_path / "a.csv", uneven())
    with pytest.raises(ValueError, match=r"give resample=0\.01 to interpolate"):
        read_record(path)
    record = read_record(path, resample=STEP)
    curvature = (2 * np.pi) ** 2 + 0.3 * 7**2
    times = uneven()[0] + record.time
    assert record.dt == STEP and record.n_steps in (299, 300)
    assert np.abs(record.acceleration / G0 - motion(times)).max() < (1.4 * STEP) ** 2 / 8 * curvature + 1e-6
    assert (
        "interpolated linearly to a step of 0.01 s from steps of 0.006" in record.source and "gap" not in record.source
    )


def test_lost_samples_are_missing_in_measurements_and_straight_in_a_record(tmp_path):
    path = write(tmp_path / "a.csv", uneven([100, 101, 102, 200]))
    measured = read_columns(path, (TOP,), ("acc_g",), description="top", resample=STEP)
    missing = np.flatnonzero(np.isnan(measured.values[0]))
    assert {100, 101, 102, 200} <= set(missing) <= {99, 100, 101, 102, 103, 199, 200, 201}
    assert (
        measured.description.startswith("top, interpolated") and "with 2 gap(s) of up to 0.0396" in measured.description
    )
    with pytest.warns(UserWarning, match=r"with 2 gap\(s\) of up to 0\.0396.*the gaps are straight lines") as caught:
        record = read_record(path, resample=STEP)
    assert [warning.filename for warning in caught] == [__file__]
    assert np.isfinite(record.acceleration).all() and "2 gap(s)" in record.source
    assert np.diff(record.acceleration[100:103], 2) == pytest.approx(0.0, abs=1e-9)


def test_marks_of_missing_samples_are_not_interpolated(path):
    rows = [f"{0.01 * k + 0.001 * (k % 2)},{-9999 if k == 4 else k}" for k in range(10)]
    path.write_text("time_s,acc_g\n" + "\n".join(rows) + "\n")
    measured = read_columns(path, (TOP,), ("acc_g",), missing=(-9999,), resample=STEP)
    assert np.flatnonzero(np.isnan(measured.values[0])).tolist() == [4]
    assert np.nanmax(np.abs(measured.values / G0 - np.arange(10))) < 0.11
    with pytest.raises(ValueError, match="an excitation needs all samples, 1 are missing"):
        read_record(path, missing=(-9999,), resample=STEP)


@pytest.mark.parametrize(
    ("times", "given", "message"),
    [
        ([0, 0.01, 0.01, 0.02], {"resample": 0.01}, "got 0.01 s after 0.01 s; if the times are of packets"),
        (
            [0, 0.01, 0.0201, 0.03],
            {"resample": 0.02},
            "about 0.01 s, got resample=0.02; resample the record or decimate",
        ),
        ([0, 0.01, 0.0201, 0.03], {"resample": 0.01, "dt": 0.01}, "resample is for uneven times in the file and dt"),
        ([0, 0.01, 0.0201, 0.03], {"resample": 0.0}, "must be a positive number of seconds"),
    ],
)
def test_what_cannot_be_resampled_is_refused(tmp_path, times, given, message):
    path = write(tmp_path / "a.csv", np.array(times))
    for read in (lambda: read_record(path, **given), lambda: read_columns(path, (TOP,), ("acc_g",), **given)):
        with pytest.raises(ValueError, match=message):
            read()


def test_a_drifting_clock_keeps_its_times():
    """A clock that is fast by 1e-4: after 10 000 steps the samples are one step late, and are read so."""
    times = STEP * (1 + 1e-4) * np.arange(10_001)
    even = uniform_times(times, STEP, "a")
    found = even.interpolate(motion(times))
    assert even.uniform.size == 10_002 and not np.isnan(found).any()
    assert np.abs(found - motion(even.uniform)).max() < STEP**2 / 8 * ((2 * np.pi) ** 2 + 0.3 * 49) + 1e-9
