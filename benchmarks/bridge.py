"""Time per simulation of the isolated bridge, compared with the solvers of scipy.

The record has 15 s at 200 samples/s. Errors are of the worst of twelve channels, relative to its peak, against
a solver with a tight tolerance.
"""

import time
from collections.abc import Callable
from statistics import median

import numpy as np
from scipy.signal import cont2discrete, lfilter

from fe_likelihoods.signals.records import Record
from tests.scipy_bridge import CHANNELS, Definition, peak_errors, solve

from .rows import Row

__all__ = ["simulation"]

DT, N_STEPS = 0.005, 3001
STEPS = (5e-4, 2.5e-4)  # s; the second is the default
SOLVERS = (("LSODA", 1e-6), ("LSODA", 1e-8), ("DOP853", 1e-6), ("Radau", 1e-6))
NOMINAL = np.ones(10)


def _ground() -> np.ndarray:
    """Synthetic ground acceleration (n_steps,): white noise through a soil filter of 2.5 Hz with 60 % damping.

    The envelope rises for one second and decays after five; the peak is 5.5 m/s².
    """
    t = np.arange(N_STEPS) * DT
    frequency, damping = 2.0 * np.pi * 2.5, 0.6
    soil = ([2.0 * damping * frequency, frequency**2], [1.0, 2.0 * damping * frequency, frequency**2])
    numerator, denominator, _ = cont2discrete(soil, DT, "bilinear")
    shaken = lfilter(numerator.ravel(), denominator, np.random.default_rng(81).standard_normal(N_STEPS))
    shaken *= np.minimum(1.0, t) * np.exp(-np.maximum(0.0, t - 5.0) / 4.0)
    return 5.5 * shaken / np.abs(shaken).max()


def _timed(function: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    start = time.process_time()
    response = function()
    return time.process_time() - start, response


def _models(record: Record) -> dict[tuple[str, float], Callable[[], np.ndarray]]:
    """Functions that run one simulation, for each step."""
    from fe_likelihoods.models.isolated_bridge import IsolatedBridge

    models = {("bouc-wen", step): IsolatedBridge(record, outputs=CHANNELS, step=step) for step in STEPS}
    return {key: lambda model=model: model.simulate(NOMINAL) for key, model in models.items()}


def simulation(repeats: int) -> list[Row]:
    """CPU time of one simulation on one core and its error; the codes run in alternation."""
    ground = _ground()
    reference = solve(Definition(), ground, DT, tolerance=1e-10)
    ours = _models(Record("noise", DT, ground))
    for function in ours.values():
        function()  # compile before the measurement
    seconds, errors = {}, {}

    def note(key: tuple, cost: float, response: np.ndarray) -> None:
        seconds.setdefault(key, []).append(cost)
        errors[key] = peak_errors(response, reference).max() if response.shape == reference.shape else None

    for _ in range(repeats):
        for key, function in ours.items():
            for _ in range(5):  # one run is too short for the resolution of the clock
                note(key, *_timed(function))
        for method, tolerance in SOLVERS:
            options = dict(method=method, tolerance=tolerance)
            cost, response = _timed(lambda options=options: solve(Definition(), ground, DT, **options))
            note((method, tolerance), cost, response)
    return _rows(seconds, errors)


def _rows(seconds: dict[tuple, list[float]], errors: dict[tuple, float | None]) -> list[Row]:
    """Rows of times, errors and ratios to scipy at its own tolerance."""

    def spread(key: tuple) -> str:
        error = "did not finish" if errors[key] is None else f"worst peak error {errors[key]:.1e}"
        return f"{error}; from {min(seconds[key]):.3g} to {max(seconds[key]):.3g} s"

    def ratio(theirs: tuple, mine: tuple) -> float:
        return median(seconds[theirs]) / median(seconds[mine])

    rows = []
    for step in STEPS:
        key, case = ("bouc-wen", step), f"bouc-wen, {1e3 * step:g} ms"
        rows.append(Row("IsolatedBridge, CPU time", case, median(seconds[key]), "s", spread(key)))
    for key in SOLVERS:
        case = f"bouc-wen, {key[0]} {key[1]:g}"
        rows.append(Row("scipy, CPU time", case, median(seconds[key]), "s", spread(key)))
        for step in STEPS:
            note = "scipy has a compiled right-hand side"
            beside = f"{1e3 * step:g} ms beside {key[0]} {key[1]:g}"
            rows.append(Row("IsolatedBridge, times faster", beside, ratio(key, ("bouc-wen", step)), "", note))
    return rows
