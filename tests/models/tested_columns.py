"""Read cyclic tests of circular reinforced-concrete columns: a history and a row of the table of properties.

The files are made from the repository kuanshi/ductile-fracture (https://github.com/kuanshi/ductile-fracture). The
history ``2017_Lehman_415.csv`` has the columns ``disp_in`` and ``force_kip``, and belongs to the row of
``properties_circular_columns.csv`` whose TSN is 2017 and whose Test is Lehman_415.
"""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods import (
    Bars,
    Channel,
    Concrete,
    DisplacementHistory,
    Hoops,
    RCColumn,
    Steel,
    read_imposed_test,
    to_si,
)
from fe_likelihoods.prediction.quantities import find_failure

PROPERTIES = "properties_circular_columns.csv"


class TestedColumn(NamedTuple):
    """A tested column: model and measured force at the kept samples, and the whole history [m, N].

    `half` is the first kept sample of the second half, `failure` the first one after failure (`find_failure`).
    """

    name: str
    number: int
    model: RCColumn
    force: np.ndarray
    half: int
    failure: int
    displacement: np.ndarray
    whole_force: np.ndarray


def read_column(folder: Path, history: str, every: int, parameters: tuple[str, ...]) -> TestedColumn:
    """Read a tested column from the file of its history; one sample in `every` is kept, and every turning point.

    The model has "linear" geometry, for a force that is the base moment divided by the height. ValueError if the table
    has no row for this test or lacks a value.
    """
    test, v = _properties(folder, history)

    def value(key: str) -> float:
        if key not in v:
            raise ValueError(f"{PROPERTIES} has no {key!r} of {test}")
        return v[key]

    def si(key: str, unit: str) -> float:
        return to_si(abs(value(f"{key} ({unit})")), unit).item()

    data = read_imposed_test(folder / history, "disp_in", [Channel("force", "lateral force", "kip")], ["force_kip"])
    displacement, force = data.history.displacement, data.measurements.values[0]
    moves = np.flatnonzero(np.diff(displacement))
    turns = moves[1:][np.diff(np.sign(np.diff(displacement)[moves])) != 0]
    kept = np.unique(np.concatenate([np.arange(0, len(displacement), every), turns, [len(displacement) - 1]]))
    half, failure = np.searchsorted(kept, [len(displacement) // 2, find_failure(force, displacement)]).tolist()
    name = test.replace("_", " ")
    model = RCColumn(
        loading=DisplacementHistory(name, displacement[kept], history),
        diameter=si("D", "in"),
        height=si("L", "in"),
        cover=si("c", "in"),
        concrete=Concrete(fc=si("fc", "ksi"), ec=si("Ec", "ksi"), ft=si("ft", "ksi")),
        steel=Steel(si("fyl", "ksi"), si("ful", "ksi"), si("Esl", "ksi"), si("Esh", "ksi"), value("esh"), value("esu")),
        bars=Bars(int(value("nsl")), si("dbl", "in")),
        hoops=Hoops(si("dbt", "in"), si("s", "in"), si("fyt", "ksi"), spiral=True),
        mass=1.0,  # unused in a quasi-static test, but must be positive
        axial_load=to_si(value("P (kips)"), "kip").item(),
        penetration=to_si(value("Sy"), "in").item() / value("esy"),
        geometry="linear",
        parameters=parameters,
        mesh=20,
        max_increment=si("L", "in") / 200.0,
        units=(("force", "kip"),),
    )
    return TestedColumn(name, int(value("No.")), model, force[kept], half, failure, displacement, force)


def _properties(folder: Path, history: str) -> tuple[str, dict[str, float]]:
    """Name of a test and its row of the table, without cells that are empty; ValueError if there is none."""
    with (folder / PROPERTIES).open() as table:
        rows = {f"{row['TSN']}_{row['Test']}": row for row in csv.DictReader(table)}
    stem = history.removesuffix(".csv")
    if stem not in rows:
        raise ValueError(f"{PROPERTIES} has no row whose TSN and Test make the name {stem!r}")
    row = rows[stem]
    name = row.pop("Test")
    return name, {key: float(value) for key, value in row.items() if value and value.strip()}
