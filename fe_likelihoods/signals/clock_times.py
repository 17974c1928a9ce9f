"""Clock times in tables, ``03:19:53.010``, ``2019-07-06T03:19:53.010Z`` or ``06.07.2019 03:19:53 PM``, and dates.

The year is first, or last after points. Dates with slashes and the year last may begin with the day or the month.
"""

from __future__ import annotations

import datetime
import re
from typing import NamedTuple

__all__ = ["ClockTime", "is_clock", "is_date", "parse_clock", "seconds_since_midnight", "unix_seconds"]

_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<month>\d{1,2})(?P=mark)(?P<last>\d{1,4})"
_TIME = r"(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d+))?"
_AFTER = r"(?:[ \u00a0\u202f]?(?:([AP])\.?M\.?|(Z|UTC|[-+]\d{2}:?\d{2})))?"
_CLOCK = re.compile(rf"(?:{_DATE}(?:T| +))?{_TIME}{_AFTER}", re.IGNORECASE)
_DAY_ONLY = re.compile(_DATE)
_HOUR, _DAY = 3600, 86400


class ClockTime(NamedTuple):
    """A clock time."""

    day: int | None  # number of the day, None without a date
    seconds: float  # since the midnight before [s]
    decimals: int  # of the seconds
    zone: int | None  # minutes by which the clock is before UTC, None without a time zone
    halves: bool = False  # hours from 1 to 12 with AM and PM


def is_clock(cell: str) -> bool:
    """Whether a cell is a clock time, with a date or without."""
    return ":" in cell and _CLOCK.fullmatch(cell) is not None


def is_date(cell: str) -> bool:
    """Whether a cell is a date without a time, in any order of day, month and year."""
    return _DAY_ONLY.fullmatch(cell) is not None


def parse_clock(cell: str, where: str) -> ClockTime:
    """Return the clock time in a cell; raise ValueError for anything else."""
    found = _CLOCK.fullmatch(cell)
    if found is None:
        raise ValueError(
            f"{where}: expected a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010', got {cell[:100]!r}"
        )
    *_, hour, minute, second, fraction, half, zone = found.groups()
    if not (1 <= int(hour) <= 12 if half else int(hour) <= 24):
        hours = "with AM and PM have hours from 1 to 12" if half else "have hours from 0 to 23"
        raise ValueError(f"{where}: clock times {hours}; got {cell[:100]!r}")
    hours = int(hour) % 12 + 12 * (half in ("P", "p")) if half else int(hour)
    whole = 3600 * hours + 60 * int(minute) + int(second)
    if zone is not None:  # minutes of a time zone such as +02:00; Z and UTC are zero
        zone = 0 if zone.upper() in ("Z", "UTC") else int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:]))
    day = None if found["first"] is None else _day_number(found, where)
    return ClockTime(day, float(f"{whole}.{fraction or 0}"), len(fraction or ""), zone, bool(half))


def _day_number(found: re.Match[str], where: str) -> int:
    """Number of the day in a date with the year first, or last after points."""
    year, day = found["first"], found["last"]
    if len(year) != 4:
        if found["mark"] != "." or len(day) != 4:
            raise ValueError(
                f"{where}: expected a date such as 2019-07-06 or 06.07.2019, got {found[0][:100]!r}, which may begin "
                "with the day or the month; write the year first"
            )
        year, day = day, year
    try:
        return datetime.date(int(year), int(found["month"]), int(day)).toordinal()
    except ValueError as error:
        raise ValueError(f"{where}: expected a date, got {found[0][:100]!r} ({error})") from None


def unix_seconds(time: ClockTime) -> float:
    """Return the seconds since 1970 (UTC) of a clock time with date and time zone."""
    return _DAY * (time.day - datetime.date(1970, 1, 1).toordinal()) + time.seconds - 60 * time.zone


def seconds_since_midnight(times: list[ClockTime | None], where: str) -> list[float]:
    """Return the seconds since the midnight before the first time, NaN for None.

    Without dates, a time that is more than half a day earlier than the previous time belongs to the next day. Raises
    ValueError if only some times have a date, or AM and PM, if time zones differ, or if 1 o'clock follows 12 o'clock,
    as on a 12-hour clock.
    """
    known = [time for time in times if time is not None]
    first, zones = known[0], {time.zone for time in known}
    for differ, expected in (
        (len({time.day is None for time in known}) > 1, "a date in all clock times or in none"),
        (len(zones) > 1, f"one time zone in all clock times, got {len(zones)}"),
        (len({time.halves for time in known}) > 1, "AM or PM in all clock times or in none"),
    ):
        if differ:
            raise ValueError(f"{where}: expected {expected}; write them alike")
    day, last, found = 0, 0.0, []
    for time in times:
        if time is None:
            found.append(float("nan"))
            continue
        if not first.halves and 12 * _HOUR <= last < 13 * _HOUR and _HOUR <= time.seconds < 2 * _HOUR:
            raise ValueError(
                f"{where}: the clock times go back from 12 to 1 o'clock, as on a clock of 12 hours; write hours from 0 "
                "to 23"
            )
        day = time.day - first.day if time.day is not None else day + (time.seconds < last - _DAY / 2)
        last = time.seconds
        found.append(day * _DAY + time.seconds)
    return found
