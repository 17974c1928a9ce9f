"""Channels and measurements: validation, selection, decimation, fingerprints."""

import numpy as np
import pytest

from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record

TOP = Channel("top", "absolute acceleration", "g")
DRIFT = Channel("drift", "relative displacement", "in")


@pytest.fixture
def measurements(rng):
    return Measurements((TOP, DRIFT), 0.02, rng.normal(size=(2, 100)), "synthetic")


class TestChannel:
    def test_dimension_is_the_last_word_of_the_quantity(self):
        assert (TOP.dimension, TOP.si_unit) == ("acceleration", "m/s2")
        assert Channel("base", "force", "kip").si_unit == "N"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (("", "force", "N"), "expected a name"),
            (("a", "loudness", "g"), "one of acceleration, .* got 'loudness'"),
            (("a", "", "g"), "one of"),
            (("a", "acceleration", "in"), "channel 'a': expected a unit of acceleration, got 'in'"),
            (("a", "force", "stone"), "channel 'a': unknown unit 'stone'"),
        ],
    )
    def test_refusals(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            Channel(*arguments)


class TestMeasurements:
    def test_values_are_a_read_only_copy(self):
        values = np.ones((2, 3), dtype=np.float32)
        measurements = Measurements([TOP, DRIFT], 0.5, values)
        values[:] = 9
        assert measurements.values.dtype == np.float64 and measurements.values.max() == 1
        with pytest.raises(ValueError, match="read-only"):
            measurements.values[0, 0] = 2
        assert (measurements.n_channels, measurements.n_steps) == (2, 3)
        np.testing.assert_array_equal(measurements.time, [0, 0.5, 1])

    @pytest.mark.parametrize(
        ("channels", "dt", "values", "message"),
        [
            ((TOP, TOP), 0.1, np.ones((2, 3)), "different names, got .'top', 'top'"),
            ((), 0.1, np.ones((0, 3)), "different names"),
            ((TOP, DRIFT), 0.1, np.ones((3, 2)), r"= \(2, n_steps\), got \(3, 2\)"),
            ((TOP,), 0.1, np.ones(3), r"got \(3,\)"),
            ((TOP,), 0.1, np.ones((1, 3)) + 0j, "values must be real numbers, one row per channel: got complex ones"),
            ((TOP,), 0.1, [["1,0", "2,0"]], "values must be real numbers, one row per channel"),
            ((TOP,), 0.1, np.ones((1, 0)), r"got \(1, 0\)"),
            ((TOP, DRIFT), 0.1, [[0, np.nan], [np.nan, np.nan]], "all samples of 'drift' are missing"),
            ((TOP,), 0.0, np.ones((1, 3)), "positive number of seconds, got 0.0"),
            ((TOP, DRIFT), 0.1, [[0, 1], [2, np.inf]], "1 infinite ones, the first is sample 1 of channel 'drift'"),
        ],
    )
    def test_refusals(self, channels, dt, values, message):
        with pytest.raises(ValueError, match=message):
            Measurements(channels, dt, values)

    def test_channel_and_select(self, measurements):
        np.testing.assert_array_equal(measurements.channel("drift"), measurements.values[1])
        swapped = measurements.select(["drift", "top"])
        assert [channel.name for channel in swapped.channels] == ["drift", "top"]
        np.testing.assert_array_equal(swapped.values, measurements.values[::-1])
        for wrong in (["roof"], "top", []):
            with pytest.raises(ValueError, match="no channel 'roof'; the channels are top, drift|sequence|different"):
                measurements.select(wrong)

    def test_printed_in_short(self, measurements):
        assert (
            repr(measurements)
            == str(measurements)
            == (f"Measurements of top [{TOP.unit}], drift [{DRIFT.unit}]: 100 samples at a step of 0.02 s")
        )
        assert repr(Measurements((TOP,), 1.0, [[1.0, 2.0]], axis="load case")).endswith("2 samples along 'load case'")

    def test_trim(self, measurements):
        np.testing.assert_array_equal(measurements.trim(0.2, 0.4).values, measurements.values[:, 10:21])
        with pytest.raises(ValueError, match="expected 0 <= start < stop <= 1.98 s"):
            measurements.trim(0.2, 2.0)

    def test_fingerprint_follows_values_step_and_names(self, measurements):
        def changed(**changes):
            parts = {"channels": measurements.channels, "dt": measurements.dt, "values": measurements.values}
            return Measurements(**{**parts, **changes}).fingerprint

        assert changed() == measurements.fingerprint, "the description is not included"
        assert changed(channels=(TOP, Channel("drift", "relative displacement", "m"))) == measurements.fingerprint
        values = measurements.values.copy()
        values[1, 50] = np.nextafter(values[1, 50], 1)
        others = [changed(dt=0.01), changed(values=values), changed(channels=(DRIFT, TOP)), changed(values=-values)]
        assert len({measurements.fingerprint, *others}) == 5

    def test_decimate_keeps_samples_as_measured(self, measurements):
        fewer = measurements.decimate(7)
        np.testing.assert_array_equal(fewer.values, measurements.values[:, ::7])
        np.testing.assert_allclose(fewer.time, measurements.time[::7])
        assert measurements.decimate(1).fingerprint == measurements.fingerprint
        for wrong in (0, -1, 2.0, 101, "2"):
            with pytest.raises(ValueError, match="factor must be a whole number from 1 to 100"):
                measurements.decimate(wrong)

    @pytest.mark.parametrize("form", [lambda rows: rows, list, lambda rows: [rows[0], rows[1, :2]]])
    def test_masked_samples_are_missing(self, form):
        rows = np.ma.array([[1.0, -9999.0, 2.0], [3.0, 4.0, 5.0]], mask=[[0, 1, 0], [0, 0, 0]])
        values = Measurements((TOP, DRIFT), 0.01, form(rows)).values
        np.testing.assert_array_equal(values[0], [1.0, np.nan, 2.0])
        np.testing.assert_array_equal(values[1, :2], [3.0, 4.0])
        with pytest.raises(ValueError, match="got 1 masked"):
            Record("masked", 0.01, rows[0])
