"""First halves of cyclic tests of four reinforced-concrete columns: seven parameters and white noise.

One sample in six and all turning points; the data are in the folder ``measured/rc_column_cyclic`` of the reference
material (``FE_SHARED``).
"""

from dataclasses import replace

from fe_likelihoods import (
    DisplacementHistory,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
    to_si,
)
from tests.models.tested_columns import read_column

from .targets import SHARED

__all__ = ["HISTORIES", "column"]

HISTORIES = "2013_Hose_SRPH1", "2017_Lehman_415", "2019_Lehman_1015", "2020_Lehman_407"
SPREADS = {"Ec": 0.3, "ft": 0.5, "fc": 0.2, "Es": 0.1, "fy": 0.08, "Esh": 0.5, "penetration": 0.5}


def column(history: str, seed: int) -> Posterior:
    """Posterior of a column by the name of its file; the data do not depend on the seed."""
    read, force, half = read_column(SHARED / "measured" / "rc_column_cyclic", f"{history}.csv", 6, "corotational")
    whole = replace(read, parameters=tuple(SPREADS), fatigue=None, units=(("force", "kip"),))
    model = whole.with_record(DisplacementHistory(history, whole.loading.displacement[:half], whole.loading.source))
    measured = Measurements(model.channels, model.dt, force[None, :half], history)
    prior = {name: TruncatedNormal(1.0, spread) for name, spread in SPREADS.items()}
    prior["sigma_force"] = HalfNormal(to_si(5.0, "kip").item())
    return Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()
