"""The cyclic test of a reinforced-concrete column, calibrated as in ``tutorials/08_cyclic_column.py``.

Lehman & Moehle, specimen 415, first half of the history, one sample in two and all turning points; seven parameters.
The data are those that the tutorial names, in the folder ``measured/rc_column_cyclic`` of the reference material.
"""

import csv
from typing import NamedTuple

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    Bars,
    Channel,
    Concrete,
    DisplacementHistory,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Hoops,
    Measurements,
    Posterior,
    RCColumn,
    Steel,
    TruncatedNormal,
    Uniform,
    read_imposed_test,
    to_si,
)

from .targets import SHARED

__all__ = [
    "Specimen",
    "autoregressive",
    "failure",
    "first_half",
    "missing",
    "specimen",
    "start",
    "white",
]

FOLDER = SHARED / "measured" / "rc_column_cyclic"
HISTORY, PROPERTIES = "2017_Lehman_415.csv", "properties_circular_columns.csv"
EVERY = 2
SENSOR = to_si(0.13, "kip").item()  # upper bound of the noise of the force, as the tutorial finds it
SIGMA = to_si(5.0, "kip").item()  # scale of the prior of the error
PRIOR = {
    "Ec": TruncatedNormal(1.0, 0.3),
    "ft": TruncatedNormal(1.0, 0.5),
    "fc": TruncatedNormal(1.0, 0.2),
    "Es": TruncatedNormal(1.0, 0.1),
    "fy": TruncatedNormal(1.0, 0.08),
    "Esh": TruncatedNormal(1.0, 0.5),
    "penetration": TruncatedNormal(1.0, 0.5),
}


class Specimen(NamedTuple):
    """A tested column at the kept samples: model and data of the whole test, and the samples of its parts.

    Attributes
    ----------
    name : str
        Name of the specimen.
    model : RCColumn
        Model under the imposed displacements.
    measured : Measurements
        Lateral force [N].
    parts : dict of str to slice
        "first half" and "second half", which ends where the column fails (`failure`).
    """

    name: str
    model: RCColumn
    measured: Measurements
    parts: dict[str, slice]


def failure(displacement: np.ndarray, force: np.ndarray) -> int:
    """First sample of the first excursion to the largest displacement so far with less than 80 % of the peak force."""
    ends = [0, *(np.flatnonzero(np.diff(np.sign(displacement)) != 0) + 1), len(displacement)]
    reached = 0.0
    for start, stop in zip(ends[:-1], ends[1:], strict=True):
        largest = np.abs(displacement[start:stop]).max()
        if largest > 0.97 * reached and reached > 0.01 * np.abs(displacement).max():
            if np.abs(force[start:stop]).max() < 0.8 * np.abs(force).max() and start > np.argmax(np.abs(force)):
                return start
        reached = max(reached, largest)
    return len(displacement)


def specimen(test: str, history: str, every: int = EVERY) -> Specimen:
    """Read a test: its name in the table of properties, and the file of its history; one sample in `every` is kept."""
    with (FOLDER / PROPERTIES).open() as rows:
        row = next(row for row in csv.DictReader(rows) if row["Test"] == test)
    v = {key: float(value) for key, value in row.items() if key != "Test"}

    def si(key: str, unit: str) -> float:
        return to_si(abs(v[f"{key} ({unit})"]), unit).item()

    channel = Channel("force", "lateral force", "kip")
    data = read_imposed_test(FOLDER / history, "disp_in", [channel], ["force_kip"])
    displacement, force = data.history.displacement, data.measurements.values[0]
    moves = np.flatnonzero(np.diff(displacement))
    turns = moves[1:][np.diff(np.sign(np.diff(displacement)[moves])) != 0]
    kept = np.unique(np.concatenate([np.arange(0, len(displacement), every), turns, [len(displacement) - 1]]))
    half, failed = np.searchsorted(kept, [len(displacement) // 2, failure(displacement, force)]).tolist()
    name = test.replace("_", " ")
    model = RCColumn(
        loading=DisplacementHistory(name, displacement[kept], history),
        diameter=si("D", "in"),
        height=si("L", "in"),
        cover=si("c", "in"),
        concrete=Concrete(fc=si("fc", "ksi"), ec=si("Ec", "ksi"), ft=si("ft", "ksi")),
        steel=Steel(si("fyl", "ksi"), si("ful", "ksi"), si("Esl", "ksi"), si("Esh", "ksi"), v["esh"], v["esu"]),
        bars=Bars(int(v["nsl"]), si("dbl", "in")),
        hoops=Hoops(si("dbt", "in"), si("s", "in"), si("fyt", "ksi"), spiral=True),
        mass=1.0,  # unused in a quasi-static test, but must be positive
        axial_load=to_si(v["P (kips)"], "kip").item(),
        penetration=to_si(v["Sy"], "in").item() / v["esy"],
        parameters=tuple(PRIOR),
        mesh=20,
        max_increment=si("L", "in") / 200.0,
        units=(("force", "kip"),),
    )
    parts = {"first half": slice(0, half), "second half": slice(half, failed)}
    return Specimen(name, model, Measurements(model.channels, model.dt, force[None, kept], name), parts)


def first_half(tested: Specimen) -> tuple[RCColumn, Measurements]:
    """Model and data of the first half of a test."""
    part = tested.parts["first half"]
    history = DisplacementHistory(f"{tested.name}, first half", tested.model.loading.displacement[part], HISTORY)
    model = tested.model.with_record(history)
    return model, Measurements(model.channels, model.dt, tested.measured.values[:, part], history.name)


def _model_and_data() -> tuple[RCColumn, Measurements]:
    return first_half(specimen("Lehman_415", HISTORY))


def white(seed: int) -> Posterior:
    """White noise with its standard deviation integrated out; the data do not depend on the seed."""
    model, measured = _model_and_data()
    prior = PRIOR | {"sigma_force": HalfNormal(SIGMA)}
    return Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()


def autoregressive(seed: int) -> Posterior:
    """Autoregressive noise and known noise of the sensor; the data do not depend on the seed."""
    model, measured = _model_and_data()
    prior = PRIOR | {"sigma_force": HalfNormal(SIGMA), "rho_force": Uniform(0.0, 1.0)}
    noise = AutoregressiveNoise(model.channels, sensor={"force": SENSOR})
    return Posterior(FELikelihood(model, measured, noise), prior)


def start(posterior: Posterior) -> np.ndarray:
    """Start of the search for the mode of the reference: the nominal values."""
    return np.ones((1, len(PRIOR)))


def missing() -> str:
    """Why the problem cannot be run, or an empty string."""
    complete = all((FOLDER / name).exists() for name in (HISTORY, PROPERTIES))
    return "" if complete else f"{HISTORY} or {PROPERTIES} is missing in {FOLDER}: set FE_SHARED to its parent folder"
