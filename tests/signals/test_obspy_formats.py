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
        read_record(path, units="g", column="HNZ") if form == "SAC" else read_record(path, column="HNE", units="g")


def test_what_is_refused(tmp_path, trace):
    import obspy

    counts, late = trace.copy(), trace.copy()
    counts.data = (1e6 * VALUES).astype(np.int32)
    counts.write(str(tmp_path / "counts.mseed"), format="MSEED")
    with pytest.raises(
        ValueError, match="got whole numbers, counts of the recorder XX.SYN..HNZ; give its StationXML file"
    ):
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
    with pytest.raises(ValueError, match="expected acceleration, got velocity by the SAC header of XX.SYN..HNZ"):
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


def response_file(path, unit, zeros, poles):
    """A StationXML file of a recorder with a sensor for acceleration (M/S**2) or velocity (M/S)."""
    from obspy import UTCDateTime
    from obspy.core.inventory import Channel, Inventory, Network, Response, Site, Station

    response = Response.from_paz(
        zeros,
        poles,
        stage_gain=4e5,
        input_units=unit,
        output_units="COUNTS",
        stage_gain_frequency=5.0,
        normalization_frequency=5.0,
        normalization_factor=1.0
        / abs(np.prod([10j * np.pi - z for z in zeros]) / np.prod([10j * np.pi - p for p in poles])),
    )
    place = {"latitude": 45.0, "longitude": 12.0, "elevation": 0.0}
    channel = Channel("HNZ", "", depth=0.0, response=response, sample_rate=200.0, **place)
    station = Station("SYN", site=Site("synthetic"), channels=[channel], creation_date=UTCDateTime(0), **place)
    Inventory([Network("XX", [station])], source="synthetic").write(str(path), format="STATIONXML")


@pytest.mark.parametrize("unit", ["M/S**2", "M/S"])
def test_counts_become_accelerations_with_an_inventory(tmp_path, trace, unit):
    time = 0.005 * np.arange(4000)
    shape = np.exp(-(((time - 10.0) / 1.5) ** 2))
    acceleration = 2.0 * shape * np.cos(2.0 * np.pi * 5.0 * time)
    if unit == "M/S**2":
        zeros, poles, motion = [], [-2e4 + 2e4j, -2e4 - 2e4j], acceleration
    else:  # a geophone of 1 Hz
        zeros, poles = [0j, 0j], [-4.4 + 4.4j, -4.4 - 4.4j]
        frequencies = 2j * np.pi * np.fft.rfftfreq(time.size, 0.005)
        gain = np.square(frequencies) / np.prod([frequencies - pole for pole in poles], axis=0)
        velocity = np.fft.rfft(acceleration)[1:] / frequencies[1:]
        motion = np.fft.irfft(np.concatenate([[0.0], velocity * gain[1:]]), time.size)
        motion /= abs(np.square(10j * np.pi) / np.prod([10j * np.pi - pole for pole in poles]))
    trace.data = np.round(4e5 * motion).astype(np.int32)
    trace.write(str(tmp_path / "counts.mseed"), format="MSEED")
    response_file(tmp_path / "station.xml", unit, zeros, poles)
    record = read_record(tmp_path / "counts.mseed", inventory=tmp_path / "station.xml")
    assert record.acceleration == pytest.approx(acceleration, abs=0.01 * 2.0)
    with pytest.raises(ValueError, match="m/s2"):
        read_record(tmp_path / "counts.mseed", units="g", inventory=tmp_path / "station.xml")
    trace.stats.station = "OTHER"
    trace.write(str(tmp_path / "other.mseed"), format="MSEED")
    with pytest.raises(ValueError, match="obspy cannot apply the inventory .* to XX.OTHER..HNZ"):
        read_record(tmp_path / "other.mseed", inventory=tmp_path / "station.xml")
    (tmp_path / "table.csv").write_text("time_s,acc_g\n0,1\n0.1,2\n")
    with pytest.raises(ValueError, match="inventory= is for miniSEED, SAC and GSE2 files"):
        read_record(tmp_path / "table.csv", inventory=tmp_path / "station.xml")
