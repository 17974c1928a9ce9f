"""Formats of strong-motion networks: original files where there are some, and synthetic ones."""

import zipfile

import numpy as np
import pytest

from fe_likelihoods import read_record
from fe_likelihoods.units import G0
from tests.signals.network_files import csmip_v1, esm, geonet, knet, smc
from tests.signals.test_readers import cosmos

VALUES = 30.0 * np.sin(0.3 * np.arange(61.0)) * np.exp(-0.02 * np.arange(61.0))
V1 = 0.003 * VALUES
COUNTS = np.round(8000 + 5e4 * np.sin(0.2 * np.arange(100))).astype(int)


def write(path, lines):
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return path


# original files -------------------------------------------------------------------------------------------------------


def test_smc_is_the_same_as_its_csv(shared):
    record = read_record(shared / "records/formats/0111a.smc")
    expected = read_record(shared / "records/loma_prieta_1989_sf_1295_shafter_360.csv")
    assert (record.dt, record.n_steps) == (0.005, 6001)
    # the CSV is printed in g with seven decimals
    np.testing.assert_allclose(record.acceleration, expected.acceleration, atol=0.6e-7 * 9.80665)
    assert "1295 Shafter" in record.source


@pytest.mark.parametrize(
    ("name", "component", "n_steps", "dt", "peak"),
    [
        ("20180212_211557_WPWS_20.V2A", "S74E", 5800, 0.02, 0.1940),
        ("20190430_064319_INHS_21.V1A", "S65E", 17600, 0.005, 0.0040),
    ],
)
def test_geonet_components(shared, name, component, n_steps, dt, peak):
    record = read_record(shared / "records/formats" / name, component)
    assert (record.n_steps, record.dt) == (n_steps, dt)
    assert np.abs(record.acceleration).max() == pytest.approx(peak, abs=1e-9)


def uneven_smc():
    """Lines of an SMC file with times: three digitised points less than in 62 with a step of 0.02 s."""
    kept = np.delete(np.arange(VALUES.size), [5, 6, 40])
    times = 0.02 * kept + 0.002 * np.sin(kept**2)  # 0 at the first
    return smc(VALUES[kept], 1.7e38, times=times)


def changed(lines, old, new):
    assert any(old in line for line in lines)
    return [line.replace(old, new) for line in lines]


# synthetic files ------------------------------------------------------------------------------------------------------


def test_synthetic_files_are_read(tmp_path):
    record = read_record(write(tmp_path / "a.smc", smc(VALUES, 200.0)))
    np.testing.assert_allclose(record.acceleration, 1e-2 * VALUES, rtol=1e-4, atol=1e-7)
    assert record.dt == 0.005
    components = {"N10E": VALUES, "S80E": -2.0 * VALUES, "Up": 0.5 * VALUES}
    for corrected in (True, False):
        path = write(tmp_path / "a.V2A", geonet(components, 0.02, corrected))
        for name, values in components.items():
            found = read_record(path, name)
            np.testing.assert_allclose(found.acceleration, 1e-3 * np.round(values, 1), atol=1e-12)
            assert found.dt == 0.02 and found.name == f"SYNT, component {name}"
    found = read_record(write(tmp_path / "SYN.NS", knet(COUNTS, 100)))
    np.testing.assert_allclose(found.acceleration, 1e-2 * (COUNTS - COUNTS.mean()) * 3920 / 6182761, rtol=1e-12)
    assert found.dt == 0.01 and "SYN001, channel N-S, mean subtracted" in found.source
    found = read_record(write(tmp_path / "a.asc", esm(VALUES, 0.005)))
    np.testing.assert_allclose(found.acceleration, 1e-2 * VALUES, atol=1e-8)
    assert found.dt == 0.005
    lines = changed(esm(VALUES / 980.665, 0.005), "UNITS: cm/s^2", "UNITS: g")
    peak = next(line for line in lines if line.startswith("PGA"))
    in_g = write(tmp_path / "g.asc", changed(lines, peak, f"PGA_CM/S^2: {np.abs(VALUES).max():.6f}"))
    np.testing.assert_allclose(read_record(in_g).acceleration, found.acceleration, atol=1e-5)


def test_uneven_smc(tmp_path):
    path = write(tmp_path / "a.smc", uneven_smc())
    with pytest.warns(UserWarning, match="with 2 gap.s. of up to 0.0586.* the gaps are straight lines"):
        record = read_record(path, resample=0.02)
    assert record.dt == 0.02 and "interpolated linearly to a step of 0.02 s" in record.source
    known = np.setdiff1d(np.arange(record.n_steps), [5, 6, 40])
    # within a tenth of a step of the samples
    np.testing.assert_allclose(record.acceleration[known], 1e-2 * VALUES[known], atol=0.12 * 0.3 * 1e-2 * 30)
    with pytest.raises(ValueError, match="a uniform step; leave resample out"):
        read_record(write(tmp_path / "b.smc", smc(VALUES, 200.0)), resample=0.005)


@pytest.mark.parametrize(("digits", "peak"), [(0, 23.4), (1, 23.4), (0, 23)])
def test_the_peak_of_geonet_is_compared_within_the_printed_digits(tmp_path, digits, peak):
    lines = geonet({"Up": VALUES * 23.4 / np.abs(VALUES).max()}, 0.02, corrected=False)
    values = [f"{float(cell):8.{digits}f}" for line in lines[26:] for cell in line.split()]
    lines = lines[:26] + ["".join(values[k : k + 10]) for k in range(0, len(values), 10)]
    lines = changed(lines, "peak ", f"peak {peak} mm/s/s at 1.00 sec ")
    assert read_record(write(tmp_path / "a.V1A", lines)).n_steps == VALUES.size
    wrong = changed(lines, f"peak {peak}", f"peak {peak + 1.2}")
    with pytest.raises(ValueError, match="expected the peak of"):
        read_record(write(tmp_path / "a.V1A", wrong))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (smc(VALUES, 200.0, "3 VELOCITY"), "looks like a USGS SMC without acceleration file, which is not"),
        (smc(VALUES, 1.7e38), "expected .* an even number of times and values, got 1.7e.38 and 61"),
        (uneven_smc(), "samples are at uneven times; give their nominal step, resample=0.02"),
        (changed(uneven_smc(), f"{min(VALUES):15.7E}", f"{2 * min(VALUES):15.7E}"), "the peak of"),
        (changed(smc(VALUES, 200.0), f"{max(VALUES):15.7E}", f"{2 * max(VALUES):15.7E}"), "the peak of"),
        (smc(VALUES, 200.0)[:20], "line 21: expected a number, got ''"),
        (geonet({"Up": VALUES}, 0.02)[:30], "the file is truncated"),
        (
            changed(geonet({"Up": VALUES}, 0.02), "at 0.020", "at 0.010"),
            "0.010 s in the text",
        ),
        (
            changed(geonet({"Up": VALUES}, 0.02), f"{np.abs(np.round(VALUES, 1)).max():.1f} mm/s/s", "31.0 mm/s/s"),
            "the peak of 31",
        ),
        (geonet({"Up": VALUES, "N": VALUES}, 0.02), "(?s)found 2; choose.*channel Up: .*channel N: "),
        (changed(knet(COUNTS, 100), "(gal)/6182761", "(gal)/3091380"), "expected the peak of"),
        (changed(knet(COUNTS, 100), "3920(gal)/", "3920/"), "a scale factor such as"),
        (esm(VALUES, 0.005, "VELOCITY"), "got DATA_TYPE 'VELOCITY'"),
        (changed(esm(VALUES, 0.005), f"PGA_CM/S^2: {max(VALUES):.6f}", "PGA_CM/S^2: 1.0"), "the peak of 1"),
        (
            changed(esm(VALUES, 0.005), "UNITS: cm/s^2", "UNITS: g"),
            "the peak of 27.*, got 2[0-9]{4}",
        ),
        (csmip_v1(V1, 200, pairs=True)[:-2], "the file is truncated or damaged"),
        (changed(csmip_v1(V1, 200), f"{max(V1):10.6f}", f"{max(V1) + 1e-4:10.6f}"), "expected the peak of"),
        (
            changed(csmip_v1(V1, 200), "200 pts/sec", "100 pts/sec"),
            "expected 0.305.* s, got 61 samples at 100 per second",
        ),
        (
            changed(csmip_v1(V1, 200, pairs=True), "sec and g/10", "cm"),
            "expected 'Units of uncor data are sec and g' or",
        ),
        (changed(csmip_v1(V1, 200, pairs=True), "sec and g/10", "sec and g"), "expected the peak of"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, lines, message):
    with pytest.raises(ValueError, match=message):
        read_record(write(tmp_path / "a.txt", lines))


def test_formats_that_are_not_read_are_named(tmp_path):
    raw = ["Raw acceleration counts   (Format v01.20 with 13 text lines)", "x", "1 2 3"]
    binary = tmp_path / "a.bin"
    binary.write_bytes(bytes(range(256)) * 10)
    cases = (
        (write(tmp_path / "a.V0", raw), "COSMOS V0 .raw acceleration."),
        (write(tmp_path / "a.V3", ["RESPONSE AND FOURIER AMPLITUDE SPECTRA", "x"]), "CSMIP V3 .spectra."),
        (write(tmp_path / "a.htm", ["<!DOCTYPE html>", "<html>"]), "web page .HTML."),
        (write(tmp_path / "b.V1", ["* VOL1DS FILE:  5522/01", "x"]), "BHRC V1"),
        (binary, "binary"),
    )
    for path, name in cases:
        with pytest.raises(ValueError, match=f"this looks like a {name} file, which is not read"):
            read_record(path)


def test_uncorrected_acceleration_of_csmip_and_cosmos(tmp_path):
    path = write(tmp_path / "a.V1", csmip_v1(V1, 200) + csmip_v1(-2 * V1, 200, channel=3))
    record = read_record(path, 3)
    assert record.dt == 0.005 and record.name == "Chan 3: 360 Deg, uncorrected"
    np.testing.assert_allclose(record.acceleration / G0, -2 * V1, atol=0.51e-6)
    record = read_record(write(tmp_path / "b.V1", csmip_v1(V1, 200, pairs=True)))
    assert record.dt == 0.005
    np.testing.assert_allclose(record.acceleration / G0, V1, atol=0.51e-4)
    lines = changed(cosmos(1, VALUES, 0.005), "Corrected acceleration", "Uncorrected acceleration")
    record = read_record(write(tmp_path / "c.V1c", lines))
    assert record.name.endswith(", uncorrected") and record.dt == 0.005
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as archive:
        archive.write(path, "CHAN002.V1")
        archive.write(tmp_path / "b.V1", "raw/CHAN002.V0")
    assert read_record(tmp_path / "d.zip", 2).dt == 0.005


def test_v1_with_uneven_times(tmp_path):
    lines = csmip_v1(V1, 100, pairs=True)
    lines[27] = lines[27].replace("  0.010", "  0.013")
    with pytest.raises(ValueError, match="samples are at uneven times; give their nominal step, resample=0.01"):
        read_record(write(tmp_path / "a.V1", lines))
    record = read_record(tmp_path / "a.V1", resample=0.01)
    assert record.dt == 0.01 and record.source.startswith("a.V1; interpolated linearly to a step of 0.01 s")
