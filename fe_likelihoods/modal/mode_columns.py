"""What the columns of a table of modes are, by their names."""

import re
from collections.abc import Sequence

import numpy as np

from ..signals.sampling import expect
from ..signals.tables import Column, Table
from ..signals.text_files import agree_on_unit, dimension_of
from ..units import to_si

# what a column is, by its name in lower case without a unit; all others of numbers are sensors
KINDS = {
    "frequency": r"f|fn|freq\.?|(natural[ _]|eigen)?(frequency|frequenz|fr[eé]quence|fre[ck]uencia|frequenza)|omega",
    "deviation": r"(f|fn|freq|frequency)[ _]std",
    "damping": r"damping|d[äa]e?mpfung|zeta|xi",
    "temperature": r"temp\.?|temp[eé]ratur[ea]?|t[ _]?(°c|degc|[\[(]?c[\])]?)|.*[\[(](°c|degc)[\])]",  # not a T alone
    "set": r"set|identification|messung|(daten)?satz|test|run|versuch",
    "time": r"date|datum|fecha|(date[ _]?)?time|timestamp|zeit(stempel|punkt)?|uhrzeit|heure|hora|day|tag|jour|d[ií]a",
    "mode": r"(eigen)?(mode|modus|modo|form)n?[ _-]?(no\.?|nr\.?|number|nummer|#)?|nr\.?|no\.?",
}
_NO_SENSOR = (  # also of a T alone: temperature, period, or top
    r"\b(re(al)?|im(ag)?|mag|phase|angle|mac|mpc|order|\w*ordnung|poles|index|std|sd|cv|cov|sigma|err(or)?|mass|factor|t|"
    r"tmean|\w*temp\w*|period\w*|complexity|quality|\w*de[ck]rement\w*|logdec|fem?|model\w*|damp\w*|d[äa]e?mpf\w*|"
    r"zeta|xi)\b|[|<∠]"
)
OF_MODE = re.compile(r"(?:fn?|freq|frequency|frequenz)[ _]?(\d+)(?:_hz)?\s*(?:[\[(].*)?", re.I)  # a column for each


def kind_of(column: Column) -> str:
    """What a column is, by its name with or without a unit, or its dates; empty for a sensor and other text."""
    name = column.name.strip().lower()
    plain = re.sub(r"[\s_]*([\[(].*[\])]|_(hz|rad/s|%|c|°c|degc))$", "", name)
    found = (kind for kind, known in KINDS.items() if any(re.fullmatch(known, x) for x in (name, plain)))
    dates = column.kind == "clock" or (column.kind == "text" and any(cell[:1].isdigit() for cell in column.cells))
    return next(found, "time" if dates else "")


def sensor_places(table: Table, others: Sequence[int], sensors: Sequence[str]) -> list[int]:
    """Places of the sensors among the columns at the places `others`: all of numbers, or those with the given names."""
    places = {table.columns[k].name: k for k in others if table.columns[k].kind == "number"}
    if unknown := [name for name in sensors if name not in places]:
        raise ValueError(f"{table.file}: no columns {', '.join(unknown)}; the sensors are {', '.join(places)}")
    units = {table.stated_unit(k, "dimensionless") for k in places.values()}
    doubtful = any(re.search(_NO_SENSOR, name.replace("_", " "), re.I) for name in places) or any(
        unit and dimension_of(unit) in ("frequency", "time", "temperature", "mass") for unit in units
    )
    if not sensors and (doubtful or len(units) > 1):
        raise ValueError(
            f"{table.file}: some of the columns {', '.join(places)} may be no components of real shapes (other units, "
            "a name as of a phase or a quality): give those that are sensors, sensors=[...] (columns in a TOML file); "
            "of complex shapes, give ModalData the real_shapes"
        )
    return [places[name] for name in sensors or places]


def si_values(table: Table, place: int, dimension: str, usual: str | None) -> np.ndarray:
    """Values of a column in the SI unit, or °C; `usual` is the unit of one that states none."""
    return to_si(table.measured(place), table.stated_unit(place, dimension) or usual, dimension)


def in_hertz(table: Table, place: int, given: str | None) -> np.ndarray:
    """Frequencies [Hz] in a column; ValueError if the unit is not known, or is stated and given differently."""
    unit = agree_on_unit(table.stated_unit(place, "frequency"), given, "frequency", table.file, "unit")
    angular = table.columns[place].name.lower().startswith("omega")
    expect(unit == "rad/s" or not angular, table.file, "omega in rad/s", unit, "correct the unit or the name")
    return si_values(table, place, "frequency", unit)
