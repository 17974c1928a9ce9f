"""Predictions of cyclic tests of reinforced-concrete columns from the first half of one of them.

Lehman & Moehle, specimen 415, first half (`tests.benchmarks.tested_column`, lateral force without the contribution of
the axial load, as in ``tutorials/08_cyclic_column.py``) to its second half, up to failure, and to both halves of the
specimens 1015 and 407 of the same series and of Hose SRPH1, of another laboratory. The multiples of the nominal values
are those of the first column. The rows are explained in `tests.benchmarks.measured_transfer`.
"""

from dataclasses import replace

from fe_likelihoods import dissipated_energy, peak

from . import tested_column
from .measured_transfer import Case, calibrate, ratios_of, score_case, skipped, within
from .rows import Row
from .tested_column import PRIOR, PROPERTIES, SENSOR, SIGMA, Specimen, first_half, specimen

__all__ = ["columns"]

_TESTS = {
    "Lehman_415": "2017_Lehman_415.csv",
    "Lehman_1015": "2019_Lehman_1015.csv",
    "Lehman_407": "2020_Lehman_407.csv",
    "Hose_SRPH1": "2013_Hose_SRPH1.csv",
}
_WINDOW = 40.0  # samples, about one cycle
_WALKERS, _DRAWS = 100, 100


def columns(repeats: int = 1) -> list[Row]:
    """Force, its peak and the dissipated energy of the halves of four tests."""
    folder = tested_column.FOLDER.name
    if rows := skipped("transfer_columns", *(f"{folder}/{file}" for file in (*_TESTS.values(), PROPERTIES))):
        return rows
    tests = [specimen(name, file) for name, file in _TESTS.items()]
    tests = [each._replace(model=replace(each.model, geometry="linear")) for each in tests]
    model, measured = first_half(tests[0])
    rows, scored = [], []
    for seed in range(1, repeats + 1):
        fit = calibrate(model, measured, PRIOR, SIGMA, seed, walkers=_WALKERS, draws=_DRAWS)
        rows.append(Row("simulations of the calibration", f"seed {seed}", fit.simulations, ""))
        half = tests[0].parts["first half"]
        ratios = ratios_of(fit, model, _numbers(tests[0], half, half))
        for test in tests:
            for label, part in test.parts.items():
                if test is not tests[0] or label != "first half":
                    numbers = _numbers(test, part, slice(None))
                    case = Case(f"{test.name}, {label}", test.model, test.measured, part, numbers)
                    found, each = score_case(case, fit, _WINDOW, ratios, SENSOR, seed)
                    rows += found
                    scored.append(each)
    return rows + within(scored)


def _numbers(test: Specimen, part: slice, kept: slice) -> dict:
    """Peak and dissipated energy in a part of a test, for histories of its `kept` samples."""
    displacement = test.model.loading.displacement[kept]
    return {"peak": peak("force", part), "energy": dissipated_energy("force", displacement, part)}
