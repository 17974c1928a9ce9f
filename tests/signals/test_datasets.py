"""Data sets in HDF5: exact round trip, refused attributes, and detection of damage."""

import h5py
import numpy as np
import pytest

from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.signals.records import Events, Record

TOP = Channel("top", "absolute acceleration", "g")
DRIFT = Channel("drift", "relative displacement", "in")


@pytest.fixture
def measurements(rng):
    return Measurements((TOP, DRIFT), 0.02, rng.normal(size=(2, 100)), "synthetic")


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
            (lambda file: file["measurements/values"].attrs.__setitem__("dt", 0.01), "do not match their checksum"),
            (lambda file: file.attrs.__setitem__("attributes", '{"theta": [0.2]}'), "do not match their checksum"),
            (lambda file: file["record/acceleration"].attrs.__setitem__("units", "g"), "expected SI units, got"),
            (lambda file: file["measurements/values"].__setitem__((0, 0), np.inf), "expected finite values"),
            (lambda file: file.attrs.__setitem__("schema_version", 2), "version 1, got .* version 2"),
            (lambda file: file.attrs.__delitem__("schema"), "expected schema .* got None"),
            (lambda file: file.attrs.__delitem__("checksum"), "not a complete data set"),
            (lambda file: file.__delitem__("record/acceleration"), "not a complete data set"),
        ],
    )
    def test_damage_is_found(self, path, damage, message):
        read_dataset(path)
        with h5py.File(path, "r+") as file:
            damage(file)
        with pytest.raises(ValueError, match=message):
            read_dataset(path)

    def test_other_files_are_refused(self, tmp_path, path):
        (tmp_path / "text.h5").write_text("not HDF5")
        (tmp_path / "cut.h5").write_bytes(path.read_bytes()[:3000])
        with pytest.raises(ValueError, match="there is no such file"):
            read_dataset(tmp_path / "none.h5")
        for name in ("text.h5", "cut.h5"):
            with pytest.raises(ValueError, match=f"{name}: not a complete data set"):
                read_dataset(tmp_path / name)

    def test_events_are_events_again(self, tmp_path, measurements, rng):
        parts = [
            Record(name, 1 / 128, rng.normal(size=n), source=name) for name, n in (("a", 50), ("b", 30), ("c", 40))
        ]
        events = Events(parts, rest=[0.25, 0.0], names=["first", "second", "third"])
        write_dataset(tmp_path / "events.h5", events, measurements)
        back = read_dataset(tmp_path / "events.h5").record
        assert back.windows == events.windows and back.rests == events.rests and back.source == events.source
        assert [each.source for each in back.records] == ["a", "b", "c"]
        np.testing.assert_array_equal(back.acceleration, events.acceleration)
        with h5py.File(tmp_path / "events.h5", "r+") as file:
            shifted = file["record/acceleration"].attrs["events"].replace("50", "49")
            file["record/acceleration"].attrs["events"] = shifted
        with pytest.raises(ValueError, match="checksum"):
            read_dataset(tmp_path / "events.h5")
