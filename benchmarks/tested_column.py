"""A cyclic test of a reinforced-concrete column, read by ``tested_columns.py``.

Lehman & Moehle, specimen 415, first half of the history, one sample in two and all turning points; seven parameters.
The data are in the folder ``measured/rc_column_cyclic`` of the reference material.
"""

from dataclasses import replace

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
from tests.models.tested_columns import PROPERTIES, read_column

from .targets import SHARED

__all__ = ["autoregressive", "missing", "white"]

FOLDER = SHARED / "measured" / "rc_column_cyclic"
HISTORY = "2017_Lehman_415.csv"
EVERY = 2
SENSOR = to_si(0.13, "kip").item()  # upper bound of the noise of the force
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


def _model_and_data() -> tuple[RCColumn, Measurements]:
    """Model under the first half of the history, and the measured force; the stored references belong to them."""
    read = read_column(FOLDER, HISTORY, EVERY, tuple(PRIOR))
    part, whole = slice(0, read.half), read.model.loading
    history = DisplacementHistory(f"{read.name}, first half", whole.displacement[part], whole.source)
    model = replace(read.model, geometry="corotational").with_record(history)
    return model, Measurements(model.channels, model.dt, read.force[None, part], history.name)


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


def missing() -> str:
    """Why the problem cannot be run, or an empty string."""
    complete = all((FOLDER / name).exists() for name in (HISTORY, PROPERTIES))
    return "" if complete else f"{HISTORY} or {PROPERTIES} is missing in {FOLDER}: set FE_SHARED to its parent folder"
