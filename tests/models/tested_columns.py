"""Read cyclic tests of circular reinforced-concrete columns: a history and a row of the table of properties.

The files are made from the repository kuanshi/ductile-fracture (https://github.com/kuanshi/ductile-fracture). The
history ``2017_Lehman_415.csv`` has the columns ``disp_in`` and ``force_kip``, and belongs to the row of
``properties_circular_columns.csv`` whose TSN is 2017 and whose Test is Lehman_415.
"""

import csv
from pathlib import Path

import numpy as np

from fe_likelihoods import (
    Bars,
    Channel,
    ColumnAnalysis,
    Concrete,
    DisplacementHistory,
    Hoops,
    LowCycleFatigue,
    RCColumn,
    Steel,
    read_columns,
    to_si,
)


def read_column(folder: Path, history: str, every: int, geometry: str = "linear") -> tuple[RCColumn, np.ndarray, int]:
    """Model, force (n,) [N] and half of n, at one sample in `every` and every turning point of a tested column.

    With "linear" geometry, the force is the base moment divided by the height.
    """
    with (folder / "properties_circular_columns.csv").open() as table:
        (row,) = (row for row in csv.DictReader(table) if f"{row['TSN']}_{row['Test']}.csv" == history)

    def si(key: str, unit: str, name: str = "{} ({})") -> float:
        return to_si(abs(float(row[name.format(key, unit)])), unit).item()

    channels = Channel("top", "displacement", "in"), Channel("force", "lateral force", "kip")
    displacement, force = read_columns(folder / history, channels, ["disp_in", "force_kip"], dt=1.0).values
    moves = np.flatnonzero(np.diff(displacement))
    turns = moves[1:][np.diff(np.sign(np.diff(displacement)[moves])) != 0]
    kept = np.unique(np.concatenate([np.arange(0, len(displacement), every), turns, [len(displacement) - 1]]))
    strains = float(row["esh"]), float(row["esu"])
    model = RCColumn(
        loading=DisplacementHistory(row["Test"], displacement[kept], history),
        diameter=si("D", "in"),
        height=si("L", "in"),
        cover=si("c", "in"),
        concrete=Concrete(fc=si("fc", "ksi"), ec=si("Ec", "ksi"), ft=si("ft", "ksi")),
        steel=Steel(si("fyl", "ksi"), si("ful", "ksi"), si("Esl", "ksi"), si("Esh", "ksi"), *strains),
        bars=Bars(int(row["nsl"]), si("dbl", "in")),
        hoops=Hoops(si("dbt", "in"), si("s", "in"), si("fyt", "ksi"), spiral=True),
        mass=1.0,  # unused in a quasi-static test, but must be positive
        axial_load=si("P (kips)", "kip", "{}"),
        penetration=si("Sy", "in", "{}") / float(row["esy"]),
        analysis=ColumnAnalysis(geometry=geometry, mesh=20, max_increment=si("L", "in") / 200.0),
        parameters=("Cf",),
        fatigue=LowCycleFatigue(),
    )
    return model, force[kept], int(np.searchsorted(kept, len(displacement) // 2))
