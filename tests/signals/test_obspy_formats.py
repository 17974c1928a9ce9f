"""Records in miniSEED, SAC and GSE2, which obspy reads; the files are written by obspy. The tests need this package."""

import sys

import numpy as np
import pytest

from fe_likelihoods import read_record

VALUES = np.sin(0.3 * np.arange(200.0)).astype(np.float32)


@pytest.fixture
def trace():
    obspy = pytest.importorskip("obspy", reason="obspy is not installed: records in miniSEED and SAC are not tested")
    header = {"network": "XX", "station": "SYN", "channel": "HNZ", "delta": 0.005}
    return obspy.Trace(VALUES.copy(), header)


@pytest.mark.parametrize(("name", "form"), [("a.mseed", "MSEED"), ("a.sac", "SAC")])
def test_samples_and_step(tmp_path, trace, name, form):
    path = tmp_path / name
    trace.write(str(path), format=form)
    for record in (read_record(path, units="cm/s2"), read_record(path, "HNZ", "cm/s2")):
        np.testing.assert_array_equal(record.acceleration, 1e-2 * VALUES.astype(float))
        assert record.dt == 0.005 and record.name == "XX.SYN..HNZ"
    with pytest.raises(ValueError, match="does not state the unit of its acceleration: give units="):
        read_record(path)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ValueError, match="obspy cannot read the file") if form == "SAC" else pytest.raises(ValueError):
        read_record(path, units="g", channel="HNZ") if form == "SAC" else read_record(path, channel="HNE", units="g")


def test_what_is_refused(tmp_path, trace):
    import obspy

    counts, late = trace.copy(), trace.copy()
    counts.data = (1e6 * VALUES).astype(np.int32)
    counts.write(str(tmp_path / "counts.mseed"), format="MSEED")
    with pytest.raises(ValueError, match="whole numbers, counts of a recorder; remove its response in obspy"):
        read_record(tmp_path / "counts.mseed", units="g")
    late.stats.starttime += 2.0
    obspy.Stream([trace, late]).write(str(tmp_path / "gap.mseed"), format="MSEED")
    with pytest.raises(ValueError, match="got XX.SYN..HNZ without 200 samples; an excitation needs all samples"):
        read_record(tmp_path / "gap.mseed", units="g")
    late.stats.channel = "HNE"
    obspy.Stream([trace, late]).write(str(tmp_path / "two.mseed"), format="MSEED")
    with pytest.raises(ValueError, match="expected one trace .*, found 2; the traces are XX.SYN..HNE, XX.SYN..HNZ"):
        read_record(tmp_path / "two.mseed", units="g")
    assert read_record(tmp_path / "two.mseed", "HNE", "g").n_steps == 200
    trace.stats.sac = {"idep": 7}
    trace.write(str(tmp_path / "velocity.sac"), format="SAC")
    with pytest.raises(ValueError, match="expected acceleration, the SAC header of XX.SYN..HNZ says velocity"):
        read_record(tmp_path / "velocity.sac", units="g")


def test_no_code_of_a_file_is_run(tmp_path, trace):
    """obspy would read a pickle."""
    path = tmp_path / "a.mseed"
    trace.write(str(path), format="PICKLE")
    with pytest.raises(ValueError, match="expected a file in miniSEED, SAC, GSE2|looks like a binary file"):
        read_record(path, units="g")


def test_without_obspy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "obspy", None)
    (tmp_path / "a.mseed").write_bytes(b"000001D SYN     HNZXX" + bytes(500))
    with pytest.raises(ValueError, match="needs the package obspy: install it with pip install obspy, or write"):
        read_record(tmp_path / "a.mseed", units="g")
