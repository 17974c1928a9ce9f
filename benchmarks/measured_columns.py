"""Predictions of cyclic tests of reinforced-concrete columns from the first half of one of them.

Lehman & Moehle, specimen 415, first half (`benchmarks.tested_column`, lateral force without the contribution of
the axial load, as in ``tutorials/08_cyclic_column.py``) to its second half, up to failure, and to both halves of every
other test whose file is in the folder: 1015 and 407 of the same series, Hose SRPH1 of another laboratory, and whatever
was added. Files that cannot be used have a row with the reason. The multiples of the nominal values are those of the
first column. The rows are explained in `benchmarks.measured_transfer`.
"""

import numpy as np

from fe_likelihoods import GaussianNoise, dissipated_energy, peak, propagate

from . import tested_column
from .measured_transfer import Case, Fit, calibrate, ratios_of, score_case, skipped, stored_responses, within
from .rows import Row
from .tested_column import HISTORY, PRIOR, PROPERTIES, SENSOR, SIGMA, Specimen, first_half, specimens

__all__ = ["columns"]

_SHEAR = 2.5  # height by diameter, below which the deformations by shear are no longer small
_WINDOW = 40.0  # samples, about one cycle
_WALKERS, _DRAWS = 100, 100


def columns(repeats: int = 1) -> list[Row]:
    """Force, its peak and the dissipated energy of the halves of four tests."""
    folder = tested_column.FOLDER.name
    if rows := skipped("transfer_columns", *(f"{folder}/{file}" for file in (HISTORY, PROPERTIES))):
        return rows
    tests, unused = specimens()
    rows = [Row("not used", file, None, "", why) for file, why in unused.items()]
    for test in tests:
        ratio = test.model.height / test.model.diameter
        note = "the model has no deformations by shear, which matter here" if ratio < _SHEAR else ""
        rows.append(Row("height by diameter", test.name, ratio, "", note))
    calibrated, measured = first_half(tests[0])
    scored = []
    for seed in range(1, repeats + 1):
        fit, modulated = (
            calibrate(calibrated, measured, PRIOR, SIGMA, seed, noise=noise, walkers=_WALKERS, draws=_DRAWS)
            for noise in (None, _noise(tests[0]))
        )
        for kind, each in (("white", fit), ("modulated", modulated)):
            rows.append(Row("simulations of the calibration", f"{kind}, seed {seed}", each.simulations, ""))
        half = tests[0].parts["first half"]
        ratios = ratios_of(fit, calibrated, _numbers(tests[0], half, half))
        for test in tests:
            growth = _growth(test, fit)
            rows.append(Row("growth of the error, power of the drift", f"{test.name}, seed {seed}", growth, ""))
            for label, part in test.parts.items():
                if test is not tests[0] or label != "first half":
                    numbers = _numbers(test, part, slice(None))
                    name = f"{test.name}, {label}"
                    case = Case(name, test.model, test.measured, part, numbers, _noise(test))
                    found, each = score_case(case, fit, modulated, ratios, seed)
                    rows += found
                    scored.append(each)
    return rows + within(scored)


def _growth(test: Specimen, fit: Fit) -> float:
    """Power of the drift with which the error of the mean response grows, by least squares over twelfths of a test."""
    kept = slice(0, test.parts["second half"].stop)
    mean = propagate(test.model, fit.structure, quantiles=(), cache=stored_responses(), progress=False).mean[0, kept]
    error = np.square(test.measured.values[0, kept] - mean)
    reached = np.maximum.accumulate(np.abs(test.model.loading.displacement[kept]))
    parts = np.array_split(np.arange(len(error)), 12)
    sizes = [[np.log(reached[part].mean()), 0.5 * np.log(error[part].mean())] for part in parts]
    return float(np.polyfit(*np.transpose(sizes), 1)[0])


def _noise(test: Specimen) -> GaussianNoise:
    """Shares of the level of the force at a drift of 1 %."""
    model = test.model
    return GaussianNoise(
        model.channels, level="response", window=_WINDOW, sensor=[SENSOR], deformation=0.01 * model.height
    )


def _numbers(test: Specimen, part: slice, kept: slice) -> dict:
    """Peak and dissipated energy in a part of a test, for histories of its `kept` samples."""
    displacement = test.model.loading.displacement[kept]
    return {"peak": peak("force", part), "energy": dissipated_energy("force", displacement, part)}
