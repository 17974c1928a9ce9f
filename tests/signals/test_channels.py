"""Channels, measurements, their readers, and the HDF5 data set: what is kept, what is refused, what damage does."""

import h5py
import numpy as np
import pytest

from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.signals.readers import read_columns, read_imposed_test, read_v2
from fe_likelihoods.signals.records import Record
from fe_likelihoods.units import G0, to_si

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
            (("", "force", "N"), "needs a name"),
            (("a", "loudness", "g"), "must be one of acceleration, .* got 'loudness'"),
            (("a", "", "g"), "must be one of"),
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
            ((TOP,), 0.1, np.ones((1, 0)), r"got \(1, 0\)"),
            ((TOP,), 0.0, np.ones((1, 3)), "positive number of seconds, got 0.0"),
            ((TOP, DRIFT), 0.1, [[0, 1], [2, np.nan]], "1 are not, the first is sample 1 of channel 'drift'"),
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

    def test_trim(self, measurements):
        np.testing.assert_array_equal(measurements.trim(0.2, 0.4).values, measurements.values[:, 10:21])
        with pytest.raises(ValueError, match="expected 0 <= start < stop <= 1.98 s"):
            measurements.trim(0.2, 2.0)

    def test_fingerprint_follows_values_step_and_names(self, measurements):
        def changed(**changes):
            parts = {"channels": measurements.channels, "dt": measurements.dt, "values": measurements.values}
            return Measurements(**{**parts, **changes}).fingerprint

        assert changed() == measurements.fingerprint, "the description does not enter"
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

    def test_decimation_leaves_white_noise_white(self, rng):
        noise = Measurements((TOP,), 0.01, rng.normal(size=(1, 40_000))).decimate(4).values[0]
        # Sample variance and lag-one correlation of n independent normal samples have these standard errors.
        n = noise.size
        assert abs(noise.var() - 1) < 4 * np.sqrt(2 / n)
        assert abs(noise[1:] @ noise[:-1] / n) < 4 / np.sqrt(n)

    def test_decimation_folds_fast_motion_back(self):
        """Control: unfiltered decimation is no resampling of a motion; 45 Hz sampled at 50 Hz looks like 5 Hz."""
        time = np.arange(4000) * 0.005
        fewer = Measurements((TOP,), 0.005, [np.cos(2 * np.pi * 45 * time)]).decimate(4)
        np.testing.assert_allclose(fewer.values[0], np.cos(2 * np.pi * 5 * fewer.time), atol=1e-9)
        resampled = Record("same motion", 0.005, np.cos(2 * np.pi * 45 * time)).resample(0.02)
        assert np.abs(resampled.acceleration[30:-30]).max() < 3e-3


class TestDataset:
    ATTRIBUTES = {"theta": [0.1, 1 / 3], "how": "made up", "seed": 3, "nested": {"noise": 1e-300}, "µ": None}

    @pytest.fixture
    def record(self, rng):
        return Record("motion", 1 / 128, rng.normal(size=500), source="nowhere")

    @pytest.fixture
    def path(self, tmp_path, record, measurements):
        write_dataset(tmp_path / "set.h5", record, measurements, self.ATTRIBUTES)
        return tmp_path / "set.h5"

    def test_round_trip_is_exact(self, path, record, measurements):
        back = read_dataset(path)
        np.testing.assert_array_equal(back.record.acceleration, record.acceleration)
        np.testing.assert_array_equal(back.measurements.values, measurements.values)
        assert (back.record.name, back.record.dt, back.record.source) == (record.name, record.dt, record.source)
        assert back.measurements.channels == measurements.channels
        assert (back.measurements.dt, back.measurements.description) == (0.02, "synthetic")
        assert back.attributes == self.ATTRIBUTES
        assert back.record.fingerprint == record.fingerprint
        assert back.measurements.fingerprint == measurements.fingerprint

    def test_file_describes_itself(self, path):
        with h5py.File(path) as file:
            samples, values = file["record/acceleration"], file["measurements/values"]
            assert samples.dtype == values.dtype == np.dtype("<f8")
            assert (samples.attrs["units"], *values.attrs["units"]) == ("m/s2", "m/s2", "m")
            assert list(values.attrs["channel_names"]) == ["top", "drift"]

    def test_writing_replaces_and_leaves_nothing_behind(self, path, record, measurements):
        before = path.read_bytes()
        write_dataset(path, record, measurements, self.ATTRIBUTES)
        assert path.read_bytes() == before, "the same data make the same file"
        write_dataset(path, record, measurements, {"theta": np.array([1.5, 2.5]), "n": np.int64(3)})
        assert read_dataset(path).attributes == {"theta": [1.5, 2.5], "n": 3}
        assert [each.name for each in path.parent.iterdir()] == ["set.h5"]

    def test_failed_write_keeps_the_old_file(self, path, record, measurements, monkeypatch):
        before = path.read_bytes()

        def full(*args, **kwargs):
            raise OSError("no space left on device")

        monkeypatch.setattr(h5py.Group, "create_dataset", full)
        with pytest.raises(OSError, match="no space"):
            write_dataset(path, record, measurements)
        assert path.read_bytes() == before
        assert [each.name for each in path.parent.iterdir()] == ["set.h5"]

    @pytest.mark.parametrize("value", [np.nan, object(), [1, {2, 3}], {(1, 2): 3}])
    def test_attributes_that_cannot_be_kept(self, tmp_path, record, measurements, value):
        with pytest.raises(ValueError, match="attributes must be"):
            write_dataset(tmp_path / "a.h5", record, measurements, {"value": value})
        with pytest.raises(ValueError, match="there is no folder"):
            write_dataset(tmp_path / "none" / "a.h5", record, measurements)

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda file: file["measurements/values"].__setitem__((1, 3), 0.0), "do not match their checksum"),
            (lambda file: file["record/acceleration"].__setitem__(0, 0.0), "do not match their checksum"),
            (lambda file: file["record/acceleration"].attrs.__setitem__("dt", 0.01), "do not match their checksum"),
            (lambda file: file["measurements/values"].attrs.__setitem__("dt", 0.01), "do not match their checksum"),
            (lambda file: file.attrs.__setitem__("attributes", '{"theta": [0.2]}'), "do not match their checksum"),
            (lambda file: file.attrs.__setitem__("checksum", "0" * 32), "do not match their checksum"),
            (lambda file: file["record/acceleration"].attrs.__setitem__("units", "g"), "expected SI units, got"),
            (lambda file: file["measurements/values"].__setitem__((0, 0), np.nan), "values must be finite"),
            (lambda file: file.attrs.__setitem__("schema_version", 2), "version 1, got .* version 2"),
            (lambda file: file.attrs.__delitem__("schema"), "expected schema .* got None"),
            (lambda file: file.attrs.__delitem__("checksum"), "not a complete data set"),
            (lambda file: file.__delitem__("record/acceleration"), "not a complete data set"),
            (lambda file: file["measurements/values"].attrs.__delitem__("quantities"), "not a complete data set"),
        ],
    )
    def test_damage_is_found(self, path, damage, message):
        read_dataset(path)
        with h5py.File(path, "r+") as file:
            damage(file)
        with pytest.raises(ValueError, match=message):
            read_dataset(path)

    def test_one_flipped_bit_is_found(self, path, measurements):
        content = bytearray(path.read_bytes())
        place = content.index(measurements.values.tobytes())
        content[place + 801] ^= 1
        path.write_bytes(content)
        with pytest.raises(ValueError, match="do not match their checksum"):
            read_dataset(path)

    def test_other_files_are_refused(self, tmp_path, path):
        (tmp_path / "text.h5").write_text("not HDF5")
        (tmp_path / "cut.h5").write_bytes(path.read_bytes()[:3000])
        for name in ("none.h5", "text.h5", "cut.h5"):
            with pytest.raises(ValueError, match=f"{name}: not a complete data set"):
                read_dataset(tmp_path / name)


class TestReaders:
    def test_units_by_column_or_for_all(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("time_s,acc_g,disp [in]\n0,1,2\n0.01,3,4\n")
        expected = [[G0, 3 * G0], [0.0508, 0.1016]]
        for units in (None, ["g", "in"]):
            found = read_columns(path, (TOP, DRIFT), ("acc_g", "disp [in]"), units, description="two rows")
            np.testing.assert_allclose(found.values, expected)
            assert (found.dt, found.description, found.channels) == (0.01, "two rows", (TOP, DRIFT))

    @pytest.mark.parametrize(
        ("channels", "columns", "units", "message"),
        [
            ((TOP,), ("acc_g", "disp"), None, "one column and one unit for each of 1 channels"),
            ((TOP,), "acc_g", None, "one column and one unit"),
            ((TOP,), ("acc",), None, "named 'acc', the columns are time_s, acc_g, disp"),
            ((TOP,), ("time_s",), None, "named 'time_s'"),
            ((DRIFT,), ("disp",), None, "column 'disp' does not state the unit of its displacement"),
            ((DRIFT,), ("acc_g",), None, "expected a unit of displacement, got 'g'"),
            ((TOP,), ("acc_g",), "cm/s2", "states the unit 'g' but units = 'cm/s2'"),
        ],
    )
    def test_refusals(self, tmp_path, channels, columns, units, message):
        path = tmp_path / "a.csv"
        path.write_text("time_s,acc_g,disp\n0,1,2\n0.01,3,4\n")
        with pytest.raises(ValueError, match=message):
            read_columns(path, channels, columns, units)

    def test_bridge_response_is_that_of_its_v2_files(self, shared):
        folder = shared / "measured/meloland_bridge"
        channels = [Channel(f"ch{number}", "acceleration", "g") for number in (5, 7, 9)]
        path = folder / "imperial_valley_1979/acc_cm_s2_dt0.02.csv"
        deck = read_columns(path, channels, [channel.name for channel in channels], "cm/s2")
        assert (deck.dt, deck.values.shape) == (0.02, (3, 1138))
        for number in (5, 7, 9):
            original = read_v2(folder / "imperialvalley79_ce01336p.zip", channel=number)
            np.testing.assert_allclose(deck.channel(f"ch{number}"), original.acceleration, rtol=5e-6)

    def test_shake_table_at_120_hertz(self, shared):
        channels = [Channel(name, "acceleration", "g") for name in ("ground", "roof")]
        path = shared / "measured/mini_shake_table/Flexible_3_story__Northridge.csv"
        response = read_columns(path, channels, ("ground_x", "3rd_x"), "m/s2")
        assert response.dt == 1 / 120
        np.testing.assert_allclose(response.values[:, 0], [0.0853, -0.10002], rtol=1e-14)

    def test_cyclic_column(self, shared):
        path = shared / "measured/rc_column_cyclic/2017_Lehman_415.csv"
        history, forces = read_imposed_test(path, "disp_in", (Channel("base", "shear force", "kip"),), ("force_kip",))
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        np.testing.assert_allclose(history.displacement, to_si(rows[:, 0], "in"), rtol=1e-14)
        np.testing.assert_allclose(forces.channel("base"), to_si(rows[:, 1], "kip"), rtol=1e-14)
        fine, indices = history.subdivide(0.001)
        assert fine.n_steps > history.n_steps == forces.n_steps == indices.size

    def test_imposed_displacement_needs_a_unit(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("top,force_kN\n0,1\n5,3\n")
        force = (Channel("base", "force", "kN"),)
        with pytest.raises(ValueError, match="column 'top' does not state the unit of its displacement"):
            read_imposed_test(path, "top", force, ("force_kN",))
        test = read_imposed_test(path, "top", force, ("force_kN",), displacement_unit="mm")
        np.testing.assert_allclose(test.history.displacement, [0, 0.005])
        np.testing.assert_allclose(test.measurements.values, [[1000, 3000]])
