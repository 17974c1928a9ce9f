"""Cyclic tests of reinforced-concrete columns, as in ``tutorials/08_cyclic_column.py``.

The problem of a calibration is Lehman & Moehle, specimen 415, first half of the history, one sample in two and all
turning points; seven parameters. The data are those that the tutorial names, in the folder
``measured/rc_column_cyclic`` of the reference material. Further tests of the same database are found by themselves
(`specimens`): a CSV file ``TSN_Test.csv`` with the columns ``disp_in`` and ``force_kip``, where TSN and Test are those
of a row of the table of properties, such as ``2018_Lehman_815.csv``.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    DisplacementHistory,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    RCColumn,
    TruncatedNormal,
    Uniform,
    to_si,
)
from tutorials.tested_columns import PROPERTIES, read_column

from .targets import SHARED

__all__ = [
    "Found",
    "Specimen",
    "autoregressive",
    "first_half",
    "missing",
    "specimen",
    "specimens",
    "start",
    "white",
]

FOLDER = SHARED / "measured" / "rc_column_cyclic"
HISTORY = "2017_Lehman_415.csv"
WITHOUT_P_DELTA = range(9, 24)  # numbers of tests whose forces do not contain the contribution of the axial load
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
        "first half" and "second half", which ends where the column fails (`find_failure`).
    """

    name: str
    model: RCColumn
    measured: Measurements
    parts: dict[str, slice]


class Found(NamedTuple):
    """Tests in the folder.

    Attributes
    ----------
    specimens : tuple of Specimen
        The tests that can be simulated, that of the calibration first.
    skipped : dict of str to str
        Why other files cannot be used.
    """

    specimens: tuple[Specimen, ...]
    skipped: dict[str, str]


def specimens(every: int = EVERY) -> Found:
    """Read all tests of the folder for which the table of properties has a row; one sample in `every` is kept."""
    found, skipped = [], {}
    for path in sorted(FOLDER.glob("*.csv"), key=lambda path: (path.name != HISTORY, path.name)):
        if path.name == PROPERTIES:
            continue
        try:
            found.append(specimen(path.name, every))
        except ValueError as error:
            skipped[path.name] = str(error)
    return Found(tuple(found), skipped)


def specimen(history: str, every: int = EVERY) -> Specimen:
    """Read a test from the file of its history, such as ``2017_Lehman_415.csv``; one sample in `every` is kept.

    The lateral force is M/h of the base moment where the axial load has no part in it ("linear" geometry), else the
    reading of the actuator ("corotational"). The script ``example/FiberElementBarFractureTest_Spiral.m`` of the
    repository subtracts P times drift from the forces of the tests 9 to 23 of the table before it compares them with
    simulations with P-Delta; it takes those of the other tests as they are. ValueError as `read_column`.
    """
    read = read_column(FOLDER, history, every, tuple(PRIOR))
    model = replace(read.model, geometry="linear" if read.number in WITHOUT_P_DELTA else "corotational")
    parts = {"first half": slice(0, read.half), "second half": slice(read.half, read.failure)}
    return Specimen(read.name, model, Measurements(model.channels, model.dt, read.force[None], read.name), parts)


def first_half(tested: Specimen) -> tuple[RCColumn, Measurements]:
    """Model and data of the first half of a test."""
    part = tested.parts["first half"]
    whole = tested.model.loading
    history = DisplacementHistory(f"{tested.name}, first half", whole.displacement[part], whole.source)
    model = tested.model.with_record(history)
    return model, Measurements(model.channels, model.dt, tested.measured.values[:, part], history.name)


def _model_and_data() -> tuple[RCColumn, Measurements]:
    tested = specimen(HISTORY)  # the references of this problem were made with the forces of the actuator
    return first_half(tested._replace(model=replace(tested.model, geometry="corotational")))


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
