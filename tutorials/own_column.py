"""A column, its measurements and its prior from one TOML file, for ``02_bridge_column.py --measurements``.

The page ``docs/own_column.rst`` describes the file. What it leaves out is that of the column of the tutorial. Numbers
are in SI units; a text such as ``"48 in"`` is a number with its unit.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    Bars,
    Concrete,
    HalfNormal,
    Hoops,
    Measurements,
    Posterior,
    Prior,
    RCColumn,
    Record,
    Steel,
    TruncatedNormal,
    problems,
    read_columns,
    to_si,
)

PARTS = {"concrete": Concrete, "steel": Steel, "bars": Bars, "hoops": Hoops}
LENGTH, STRESS = "displacement", "stress"
DIMENSIONS = {  # of the settings that are not numbers without a unit, or in seconds, kilograms and 1/s
    "diameter": LENGTH,
    "height": LENGTH,
    "cover": LENGTH,
    "penetration": LENGTH,
    "spacing": LENGTH,
    **dict.fromkeys(("fc", "ec", "ft", "fy", "fu", "es", "esh"), STRESS),
    "first_angle": "rotation",
    "axial_load": "force",
}
COLUMN = ("diameter", "height", "cover", "mass", "axial_load", "rotational_inertia", "a0", "a1", "penetration")
NOISES = ("per channel", "autoregressive", "shared")
SECTIONS = ("column", "measurements", "prior", "noise")
MEASUREMENTS = ("columns", "units", "time_unit", "skip", "zero")


class Settings(NamedTuple):
    """Contents of a TOML file.

    Attributes
    ----------
    column : dict
        Arguments of `RCColumn.lhpost`.
    measurements : dict
        ``columns`` (channel to name of the column) and options of `read_columns`.
    prior : dict
        Coefficients of variation of structural parameters, and scales of noise levels [SI].
    noise : str
        Name of the noise, as for `problems.bridge_column`.
    """

    column: dict[str, Any]
    measurements: dict[str, Any]
    prior: dict[str, float]
    noise: str


def read_settings(path: Path | None) -> Settings:
    """Read a TOML file; without one, all settings are those of the tutorial.

    Raises
    ------
    ValueError
        If the file cannot be read, or a section, a name or a value in it is not known.
    """
    try:
        content = {} if path is None else tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"cannot read {path}: {error}; write it as in docs/own_column.rst") from error
    _known(content, SECTIONS, f"{path}")
    for section in content:
        _table(content, section, path)
    measurements = dict(content.get("measurements", {}))
    _known(measurements, MEASUREMENTS, f"{path}, [measurements]")
    zero = measurements.get("zero", 0.0)
    if isinstance(zero, bool) or not isinstance(zero, int | float) or not math.isfinite(zero):
        raise ValueError(
            f"{path}, [measurements] zero: expected the time in the file at which the base motion begins, a number "
            f"without a unit [s], got {zero!r}"
        )
    noise = dict(content.get("noise", {}))
    _known(noise, ("kind",), f"{path}, [noise]")
    if noise.get("kind", NOISES[0]) not in NOISES:
        raise ValueError(f"{path}, [noise]: expected a kind of {', '.join(map(repr, NOISES))}, got {noise['kind']!r}")
    prior = {
        name: _value(value, _prior_dimension(name), f"{path}, {name}")
        for name, value in content.get("prior", {}).items()
    }
    return Settings(_column(content.get("column", {}), path), measurements, prior, noise.get("kind", NOISES[0]))


def read_measurements(path: Path, settings: Settings, record: Record) -> Measurements:
    """Read the measured channels, ``acceleration`` and ``displacement`` of the top or one, from CSV or a workbook.

    Samples before and after the record are left out, and times after the last sample count as missing; the description
    says so.
    """
    channels = {channel.name: channel for channel in RCColumn.lhpost(record, **settings.column).channels}
    options = dict(settings.measurements)
    columns = options.pop("columns", {name: name for name in channels})
    units = options.pop("units", {})
    _known(columns, tuple(channels), "columns of the measurements")
    _known(units, tuple(columns), "units of the measurements")
    measurements = read_columns(
        path,
        [channels[name] for name in channels if name in columns],
        [columns[name] for name in channels if name in columns],
        [units.get(name) for name in channels if name in columns],
        description=f"measurements of {path.name}",
        **options,
    )
    return _within(measurements, record)


def _within(measurements: Measurements, record: Record) -> Measurements:
    """The samples between the first and the last one of the record, with NaN where the measurements are shorter."""
    end, rows, starts, notes = record.time[-1], [], [], []
    for channel, values, step in zip(measurements.channels, measurements.values, measurements.steps, strict=True):
        times = measurements.times(channel.name)
        inside = np.flatnonzero((times >= -1e-6 * step) & (times <= end + 1e-6 * step))
        outside = np.isfinite(values).sum() - np.isfinite(values[inside]).sum()
        if not np.isfinite(values[inside]).any():
            raise ValueError(
                f"channel {channel.name!r} was measured from {times[0]:g} to {times[-1]:g} s and has no sample within "
                f"the record, 0 to {end:g} s; set zero in [measurements] to the time in the file at which the base "
                "motion begins"
            )
        missing = int((end - times[inside[-1]]) / step + 1e-6)
        rows.append(np.append(values[inside], np.full(missing, np.nan)))
        starts.append(0.0 if abs(times[inside[0]]) <= 1e-6 * step else float(times[inside[0]]))
        notes += [f"without {outside} samples of {channel.name} before or after the record"] if outside else []
        notes += [f"{channel.name} ends {missing * step:.3g} s before the record"] if missing else []
    text = ", ".join([measurements.description, *notes])
    return Measurements(measurements.channels, measurements.steps, rows, text, starts)


def make_posterior(record: Record, measurements: Measurements, settings: Settings, every: int, **changes) -> Posterior:
    """Make the posterior of the tutorial with the column, the prior and the noise of the settings."""
    changes = settings.column | {"outputs": tuple(c.name for c in measurements.channels)} | changes
    posterior = problems.bridge_column(
        record=record, measurements=measurements, every=every, noise=settings.noise, **changes
    )
    return Posterior(posterior.likelihood, _prior(posterior.prior, settings.prior), _coarse(posterior, settings.prior))


def _coarse(posterior: Posterior, changes: Mapping[str, float]) -> Posterior | None:
    coarse = posterior.coarse
    return None if coarse is None else Posterior(coarse.likelihood, _prior(coarse.prior, changes))


def _prior(prior: Prior, changes: Mapping[str, float]) -> dict:
    distributions = dict(prior.distributions)
    _known(changes, tuple(distributions), "[prior]")
    for name, number in changes.items():
        kind = type(distributions[name])
        if kind not in (TruncatedNormal, HalfNormal):
            raise ValueError(f"[prior]: the prior of {name} is fixed; leave it out")
        distributions[name] = TruncatedNormal(1.0, number) if kind is TruncatedNormal else HalfNormal(number)
    return distributions


def _column(content: Mapping[str, Any], path: Path | None) -> dict[str, Any]:
    """Arguments of `RCColumn.lhpost`: numbers, and parts made from those of the tutorial's column."""
    _known(content, (*COLUMN, *PARTS), f"{path}, [column]")
    where = f"{path}, [column]"
    changes = {
        name: _value(value, DIMENSIONS.get(name), f"{where} {name}")
        for name, value in content.items()
        if name in COLUMN
    }
    usual = RCColumn.lhpost(Record("none", 1.0, [0.0, 0.0]))
    for name, part in PARTS.items():
        if name in content:
            given = _table(content, name, path)
            names = tuple(field.name for field in fields(part))
            _known(given, names, f"{where[:-1]}.{name}]")
            values = {
                key: _value(value, _dimension(name, key), f"{where[:-1]}.{name}] {key}") for key, value in given.items()
            }
            if name in ("bars", "hoops") and "diameter" in values:
                values.setdefault("area", None)  # that of the new diameter
            changes[name] = replace(getattr(usual, name), **values)
    return changes


def _dimension(part: str, name: str) -> str | None:
    return None if part in ("bars", "hoops") and name in ("area", "number") else DIMENSIONS.get(name)


def _prior_dimension(name: str) -> str | None:
    return {"sigma_acceleration": "acceleration", "sigma_displacement": "displacement"}.get(name)


def _value(value: Any, dimension: str | None, where: str) -> Any:
    """A number in SI units, a truth value, or a text with a number and a unit."""
    if isinstance(value, str):
        number, _, unit = value.strip().partition(" ")
        try:
            if dimension is None:
                raise ValueError("this setting is a number in SI units, without a text")
            return to_si(float(number), unit, dimension).item()
        except ValueError as error:
            raise ValueError(
                f"{where}: expected a number with its unit such as '48 in', got {value!r}: {error}"
            ) from None
    if not isinstance(value, int | float):
        raise ValueError(f"{where}: expected a number, got {value!r}")
    return value


def _known(given: Mapping[str, Any], names: tuple[str, ...], where: str) -> None:
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ValueError(f"{where}: unknown {', '.join(unknown)}; known are {', '.join(names)}")


def _table(content: Mapping[str, Any], name: str, path: Path | None) -> Mapping[str, Any]:
    if not isinstance(content[name], Mapping):
        raise ValueError(f"{path}: expected a table [{name}], got {content[name]!r}")
    return content[name]
