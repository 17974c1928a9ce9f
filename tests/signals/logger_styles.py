"""The same eight samples as different loggers write them; all data are synthetic."""

import datetime
import math

STEP = 0.02  # [s]
ACCELERATION = [0.0, 1.0644, 1.9854, 2.6863, 0.335, -1.3508, -2.8716, -0.9825]  # [g]
START = datetime.datetime(2024, 5, 14, 10, 32, 7)


def _rows(cells, separator=",", end="\n"):
    return "".join(separator.join(cells(k)) + end for k in range(len(ACCELERATION)))


def _clock(k, form):
    return (START + datetime.timedelta(seconds=k * STEP)).strftime(form)


def _table(header, time, value=lambda k: f"{ACCELERATION[k]:.4f}", separator=","):
    return header + "\n" + _rows(lambda k: [time(k), value(k)], separator)


def _seconds(k):
    return f"{k * STEP:.2f}"


def _comma(text):
    return text.replace(".", ",")


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
    "X_Columns\t{columns}\nTime_Pref\tRelative\nDate\t2024/05/14\nTime\t10:32:07.0\n***End_of_Header***\t\n\t\n"
    "Channels\t1\t\nSamples\t8\t\nY_Unit_Label\tg\t\nX_Dimension\tTime\t\nX0\t0.0E+0\t\nDelta_X\t0.020000\t\n"
    "***End_of_Header***\t\t\nX_Value\tTop\tComment\n"
)
TOA5 = (
    '"TOA5","CR6","CR6","123","CR6.Std.10","CPU:a.CR6","4062","Table1"\n"TIMESTAMP","RECORD","Top"\n"TS","RN","g"\n'
    '"","","Smp"\n'
)
IN_MM = [9806.65 * value for value in ACCELERATION]  # [mm/s²]: thousands

READ = {
    "AM and PM": _table("Time,acc_g", lambda k: _clock(k, "%I:%M:%S.%f %p")),
    "comma": _table("time_s,acc_g", _seconds),
    "semicolon, decimal comma": _comma(_table("time_s;acc_g", _seconds, separator=";")),
    "tab, line of units": _table("Time\tAcc\n[s]\t[g]", _seconds, separator="\t"),
    "blanks": _table("Time(s)    acc(g)", _seconds, lambda k: f"{ACCELERATION[k]:10.4f}", "  "),
    "ISO with zone": _table("Timestamp,acc_g", lambda k: _clock(k, "%Y-%m-%dT%H:%M:%S.%fZ")),
    "clock": _table("Time,acc_g", lambda k: _clock(k, "%H:%M:%S.%f")[:-4]),
    "day first, decimal comma": _comma(
        _table("Zeit;acc_g", lambda k: _clock(k, "%d/%m/%Y %H:%M:%S.%f"), separator=";")
    ).replace("/", "."),
    "date apart": _comma(
        "Datum;Zeit;acc_g\n"
        + _rows(lambda k: [_clock(k, "%d/%m/%Y"), _clock(k, "%H:%M:%S.%f"), f"{ACCELERATION[k]:.4f}"], ";")
    ).replace("/", "."),
    "year first, slashes": _table("Time,acc_g", lambda k: _clock(k, "%Y/%m/%d %H:%M:%S.%f")),
    "milliseconds": _table("time_ms,acc_g", lambda k: f"{20 * k}"),
    "microseconds": _table("Time [µs],acc_g", lambda k: f"{20000 * k}"),
    "milli-g": _table("time_s,acc [mg]", _seconds, lambda k: f"{1000 * ACCELERATION[k]:.1f}"),
    "Unix seconds": _table("epoch_s,acc_g", lambda k: f"{1715682727 + k * STEP:.2f}"),
    "Unix milliseconds": _table("timestamp_ms,acc_g", lambda k: f"{1715682727000 + 20 * k}"),
    "Unix milliseconds without unit": _table("unix_time,acc_g", lambda k: f"{1715682727000 + 20 * k}"),
    "thousands, decimal point": _table("time_s,acc [mm/s2]", _seconds, lambda k: f'"{IN_MM[k]:,.1f}"'),
    "thousands, decimal comma": _table(
        "time_s;acc [mm/s2]",
        lambda k: _comma(_seconds(k)),
        lambda k: f"{IN_MM[k]:,.1f}".translate({44: 46, 46: 44}),
        ";",
    ),
    "thousands, blanks": _table(
        "time_s\tacc [mm/s2]", _seconds, lambda k: f"{IN_MM[k]:,.1f}".replace(",", "\u00a0"), "\t"
    ),
    "exponents of Fortran": _table(
        "time_s  acc_g", _seconds, lambda k: f"{ACCELERATION[k]:.5E}".replace("E", "D"), "  "
    ),
    "Campbell TOA5": TOA5
    + _rows(lambda k: [_clock(k, '"%Y-%m-%d %H:%M:%S.%f')[:-4] + '"', f"{k}", f"{ACCELERATION[k]:.4f}"]),
    "LabVIEW": LABVIEW.format(columns="One") + _rows(lambda k: [f"{k * STEP:.6f}", f"{ACCELERATION[k]:.6f}", ""], "\t"),
    "LabVIEW without times": LABVIEW.format(columns="No") + _rows(lambda k: ["", f"{ACCELERATION[k]:.6f}", ""], "\t"),
    "LabVIEW with times for each channel": LABVIEW.format(columns="Multi")
    .replace("\tTop\t", "\tacc\tX_Value\tdeck\t")
    .replace("_Label\tg", "_Label\tg\t\tg")
    + _rows(lambda k: [f"{k * STEP:.6f}", f"{ACCELERATION[k]:.6f}", f"{k * STEP:.6f}", "0.1"], "\t"),
    "text beside": "State,time_s,acc_g,Flag\n" + _rows(lambda k: ["ok", _seconds(k), f"{ACCELERATION[k]:.4f}", "A"]),
    "missing channel beside": "time_s,acc_g,wind\n" + _rows(lambda k: [_seconds(k), f"{ACCELERATION[k]:.4f}", "NAN"]),
}
"""Texts that are read as `ACCELERATION` with `STEP`."""

COLUMNS = {
    "Campbell TOA5": "Top",
    "missing channel beside": "acc_g",
    "LabVIEW with times for each channel": "acc",
    "LabVIEW, different times": "Top",
}
"""Columns of the styles with several ones."""

REFUSED = {
    "month or day first": (
        _table("Time,acc_g", lambda k: _clock(k, "%m/%d/%Y %H:%M:%S.%f")),
        "which may begin with the day or the month; write the year first",
    ),
    "seconds without fraction": (
        _table("Time,acc_g", lambda k: _clock(k, "%H:%M:%S")),
        "print the times with more digits, or leave the column out and give dt=",
    ),
    "lost packets": (
        _table("time_s,acc_g", lambda k: f"{(k + (k > 3)) * STEP:.2f}"),
        "line 6: expected a uniform time step .* give resample=0.02",
    ),
    "jitter": (
        _table("time_s,acc_g", lambda k: f"{k * STEP + 0.001 * math.sin(k * k):.4f}"),
        "expected a uniform time step .* give resample=0.02",
    ),
    "names in a comment": (_table("# time_s acc_g", _seconds, separator=" "), "no header line; write one such as"),
    "Unix times without a name": (
        _table("Time,acc_g", lambda k: f"{1715682727 + k * STEP:.2f}"),
        r"has no unit; .* give time_unit= \(for Unix times 's' would fit",
    ),
    "two decimal marks": (
        _table("time_s;acc [mm/s2]", _seconds, lambda k: f"{IN_MM[k]:,.1f}".translate({44: 46, 46: 44}), ";"),
        r"expected one decimal mark, got '0\.00' in line 2 and '0,0' in line 2; write all numbers alike",
    ),
    "LabVIEW, two segments": (
        LABVIEW.format(columns="One") + "0.0\t1.0\n" + "Channels\t1\n***End_of_Header***\nX_Value\tTop\n0.02\t1.0\n",
        "LabVIEW file with one segment, got 2; write a file for each segment",
    ),
    "LabVIEW, different times": (
        LABVIEW.format(columns="Multi").replace("X_Value\tTop", "X_Value\tTop\tX_Value\tDeck")
        + _rows(lambda k: [f"{k * STEP:.6f}", "1.0", f"{k * STEP + 0.01:.6f}", "2.0"], "\t"),
        "the columns 'time .s.' and 'time .s.' with different times; write one file for each",
    ),
}
"""Texts that are refused, and what the message says."""
