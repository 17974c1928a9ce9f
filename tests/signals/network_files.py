"""Synthetic files in the formats of strong-motion networks."""

import numpy as np


def smc(values, rate, kind="2 CORRECTED ACCELEROGRAM", comments=2, times=None):
    """Lines of a USGS SMC file, in cm/s²; with `times` in pairs with the values."""
    numbers = values if times is None else np.column_stack([times, values]).ravel()
    integers = [-32768] * 48
    integers[15], integers[16] = comments, len(numbers)
    reals = [1.7e38] * 50
    reals[1], reals[29], reals[31] = rate, max(values), min(values)
    cells = [f"{value: .4E}".replace("E+0", "E+").replace("E-0", "E-") for value in numbers]
    return [
        kind,
        "*",
        "SYNTH",
        *["station = nowhere"] * 8,
        *("".join(f"{n:10d}" for n in integers[k : k + 8]) for k in range(0, 48, 8)),
        *("".join(f"{n:15.7E}" for n in reals[k : k + 5]) for k in range(0, 50, 5)),
        *["| synthetic"] * comments,
        *("".join(f"{cell:>10}" for cell in cells[k : k + 8]) for k in range(0, len(cells), 8)),
    ]


def geonet(components, dt, corrected=True):
    """Lines of a GeoNet file, in mm/s², of components by name."""
    lines = []
    for name, values in components.items():
        values = np.round(values, 1)
        peak = values[np.argmax(np.abs(values))]
        integers, reals = [0] * 40, [0.0] * 60
        step = f"Raw readings in units of 1.00 mm/s/s  at intervals of {dt:.3f} s"
        if corrected:
            step = f"Instrument corrected data at {dt:.3f} sec intervals"
        integers[33:36] = [len(values)] * 3 if corrected else [len(values), 0, 0]
        reals[25], reals[29] = dt, 9806.6
        lines += [
            f"{'C' if corrected else 'Unc'}orrected accelerogram 20200101_000000_SYNT_20 GNS Science",
            "Site SYNT      40 00 00S  175 00 00E",
            *["synthetic"] * 8,
            step,
            "",
            f"Component {name}",
            f"Acceleration:  peak {peak:8.1f} mm/s/s at   1.00 sec     rms      1.0 mm/s/s",
            "Velocity",
            "Displacement",
            *("".join(f"{n:8d}" for n in integers[k : k + 10]) for k in range(0, 40, 10)),
            *("".join(f"{n:8.4f}" for n in reals[k : k + 10]) for k in range(0, 60, 10)),
        ]
        for digits in (1, 2, 5) if corrected else (1,):
            block = values if digits == 1 else 0.0 * values
            cells = [f"{value:8.{digits}f}" for value in block]
            lines += ["".join(cells[k : k + 10]) for k in range(0, len(cells), 10)]
    return lines


def csmip_v1(values, rate, pairs=False, channel=2):
    """Lines of one channel in a CSMIP V1 file, in g, or in pairs of times and g/10."""
    n, peak = len(values), values[np.argmax(np.abs(values))]
    integers, reals = [0] * 100, [0.0] * 50
    integers[27], reals[2], reals[6] = n, n / rate, round(peak, 3 if pairs else 6)
    text = [
        "Uncorrected Accelerogram Data             Processed: 01/01/20, synthetic",
        *["synthetic"] * 5,
        f"Chan  {channel}: 360 Deg",
        *["synthetic"] * 4,
        f"Units of uncor {'accel' if pairs else 'data'} are sec and {'g/10' if pairs else 'g'}.   Max = {peak:.3f} g",
        "RMS",
    ]
    header = [
        *("".join(f"{n:5d}" for n in integers[k : k + 16]) for k in range(0, 100, 16)),
        *("".join(f"{n:10.{3 if pairs else 6}f}" for n in reals[k : k + 8]) for k in range(0, 50, 8)),
    ]
    end = [f"/&  ----------  End of data for channel {channel}"]
    if pairs:
        cells = [f"{cell:7.3f}" for k, value in enumerate(values) for cell in (k / rate, 10 * value)]
        return [*text, *header, *("".join(cells[k : k + 10]) for k in range(0, len(cells), 10)), *end]
    line = f" {n} Accelerogram points at {rate} pts/sec in units of g.       Format: (8f9.6)  "
    cells = [f"{value:9.6f}" for value in values]
    return [*text, *header, line, *("".join(cells[k : k + 8]) for k in range(0, n, 8)), *end]


def knet(counts, rate, scale=(3920, 6182761)):
    """Lines of a K-NET file."""
    acceleration = (np.asarray(counts) - np.mean(counts)) * scale[0] / scale[1]
    header = {
        "Origin Time": "2020/01/01 00:00:00",
        "Lat.": "35.0",
        "Long.": "140.0",
        "Depth. (km)": "10",
        "Mag.": "5.0",
        "Station Code": "SYN001",
        "Station Lat.": "35.1",
        "Station Long.": "140.1",
        "Station Height(m)": "10",
        "Record Time": "2020/01/01 00:00:15",
        "Sampling Freq(Hz)": f"{rate}Hz",
        "Duration Time(s)": f"{len(counts) / rate:g}",
        "Dir.": "N-S",
        "Scale Factor": f"{scale[0]}(gal)/{scale[1]}",
        "Max. Acc. (gal)": f"{np.abs(acceleration).max():.3f}",
        "Last Correction": "2020/01/01 00:00:00",
        "Memo.": "",
    }
    rows = ["".join(f"{count:9d}" for count in counts[k : k + 8]) for k in range(0, len(counts), 8)]
    return [*(f"{name:<18}{value}" for name, value in header.items()), *rows]


def esm(values, dt, kind="ACCELERATION"):
    """Lines of an ESM file, in cm/s²."""
    header = {
        "EVENT_NAME": "SYNTHETIC",
        "EVENT_ID": "",
        "NETWORK": "XX",
        "STATION_CODE": "SYN",
        "SAMPLING_INTERVAL_S": f"{dt:.6f}",
        "NDATA": len(values),
        "STREAM": "HNE",
        "UNITS": "cm/s^2",
        "PGA_CM/S^2": f"{values[np.argmax(np.abs(values))]:.6f}",
        "DATA_TYPE": kind,
        "USER1": "",
    }
    return [*(f"{name}: {value}" for name, value in header.items()), *(f"{value:.6f}" for value in values)]
