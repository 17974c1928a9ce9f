"""Growth of cost: of a simulation with fibers and steps, of a run with particles and parameters.

Each quantity is doubled a few times while all others stay constant, and the sizes are run in alternation. The last row
of each group is the exponent p of cost ~ size^p over the last doubling, because small sizes may use another algorithm
(with few particles the default SMC uses moves instead of recycling). Simulations are of the column and the bridge at
nominal values; runs are of the default SMC on a Gaussian of seven parameters, a hundredth as wide as its prior.
"""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np

from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.problems import bridge_column_data, isolated_bridge_data

from .cost import run_smc
from .rows import Row

__all__ = ["exponent", "growth"]


class _Cost(NamedTuple):
    seconds: float  # CPU
    evaluations: int


def _timed(function: Callable[[], int | None]) -> _Cost:
    start = time.process_time()
    evaluations = function()
    return _Cost(time.process_time() - start, evaluations or 0)


def exponent(sizes: list[float], costs: list[float]) -> float:
    """Exponent p of cost ~ size^p between the last two sizes."""
    return math.log(costs[-1] / costs[-2]) / math.log(sizes[-1] / sizes[-2])


def _in_turns(functions: Mapping[float, Callable[[], int | None]], repeats: int) -> dict[float, _Cost]:
    """Median cost of each size. The sizes alternate, so that other load on the machine affects all of them."""
    costs = {size: [] for size in functions}
    for _ in range(repeats):
        for size, function in functions.items():
            costs[size].append(_timed(function))
    return {size: _Cost(median(c.seconds for c in found), found[0].evaluations) for size, found in costs.items()}


def _simulate(model: RCColumn | IsolatedBridge) -> None:
    model.simulate(np.ones(len(model.parameter_names)))


def _simulations() -> dict[str, dict[float, Callable]]:
    """Functions that run one simulation, by size: 12.5 s of the column, 15 s of the bridge."""
    record = bridge_column_data().record.trim(0.0, 12.5)
    ground = isolated_bridge_data().record
    models = {
        "column: fibers in a section": {
            sum(map(len, model.section.fibers())): model
            for model in (RCColumn.lhpost(record, mesh=strips) for strips in (20, 40, 80, 160))
        },
        "column: time steps": {
            (model.n_steps - 1) * model.substeps: model
            for model in (RCColumn.lhpost(record, substeps=substeps) for substeps in (1, 2, 4, 8))
        },
        "bridge: time steps": {
            round((ground.n_steps - 1) * ground.dt / step): IsolatedBridge(ground, step=step)
            for step in (1e-3, 5e-4, 2.5e-4, 1.25e-4)
        },
    }
    return {what: {size: partial(_simulate, m) for size, m in sizes.items()} for what, sizes in models.items()}


def _runs() -> dict[str, dict[float, Callable]]:
    """Functions that run the sampler, by size."""
    return {
        "particles": {n: partial(run_smc, n, steps=1) for n in (125, 250, 500, 1000, 2000)},
        "parameters": {n: partial(run_smc, 500, ndim=n, steps=1) for n in (2, 4, 8, 16)},
    }


def growth(repeats: int) -> list[Row]:
    """CPU time for each size, and the exponent."""
    rows = []
    for what, functions in _simulations().items():
        next(iter(functions.values()))()  # compile before the measurement
        costs = _in_turns(functions, repeats)
        rows += [Row(f"growth, {what}", f"{size}", 1e3 * cost.seconds, "ms", "CPU") for size, cost in costs.items()]
        rows.append(_exponent(what, list(costs), [cost.seconds for cost in costs.values()]))
    for what, functions in _runs().items():
        costs = _in_turns(functions, repeats)
        for size, cost in costs.items():
            note = f"{1e6 * cost.seconds / cost.evaluations:.0f} us CPU per evaluation"
            rows.append(Row(f"growth, evaluations of a run: {what}", f"{size}", cost.evaluations, "", note))
        rows.append(_exponent(f"evaluations of a run: {what}", list(costs), [c.evaluations for c in costs.values()]))
    return rows


def _exponent(what: str, sizes: list[float], costs: list[float]) -> Row:
    case = f"exponent, {sizes[-2]} to {sizes[-1]}"
    return Row(f"growth, {what}", case, exponent(sizes, costs), "", "1: proportional")
