"""Posteriors on which few simulations are counted: every problem is a function of a seed.

Seed 1 is the bundled data set where there is one; other seeds have new noise.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from fe_likelihoods.data.make_bridge_column_eq1 import column_measurements
from fe_likelihoods.data.make_isolated_bridge import bridge_measurements

from fe_likelihoods import (
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    TruncatedNormal,
    problems,
)
from tests.statistics.hard_posteriors import CASES

from . import many_stiffnesses, tested_column

__all__ = ["PROBLEMS", "Problem", "oscillator"]


class Problem(NamedTuple):
    """A posterior by seed, and what is known of it."""

    posterior: Callable[[int], Posterior]  # of the seed
    labels: Callable[[np.ndarray], np.ndarray] | None = None  # numbers (n,) of the modes of samples (n, ndim)
    exact: Callable[[Posterior], Any] | None = None  # `Reference` of the posterior by quadrature, at once


def oscillator(seed: int, truth: tuple[float, float] = (1.15, 0.8)) -> Posterior:
    """Linear oscillator under the table motion of the isolated bridge, noise of 10 % of the root mean square."""
    model = LinearOscillator(problems.isolated_bridge_data().record, period=0.5)
    clean = model.simulate(np.array(truth))
    rms = np.sqrt(np.square(clean).mean(axis=1, keepdims=True))
    values = clean + 0.1 * rms * np.random.default_rng(seed).standard_normal(clean.shape)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.5)}
    prior |= {f"sigma_{c.name}": HalfNormal(float(scale)) for c, scale in zip(model.channels, rms[:, 0], strict=True)}
    measured = Measurements(model.channels, model.dt, values, f"SYNTHETIC, seed {seed}")
    return Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()


def bridge(data: str, seed: int) -> Posterior:
    """Isolated bridge with new noise."""
    usual = problems.isolated_bridge(data=data)
    if seed == 1:
        return usual.marginal()
    bundled = problems.isolated_bridge_data(data)
    test = bundled._replace(measurements=bridge_measurements(bundled.record, data, seed))
    return problems.isolated_bridge(data=test, channels=usual.likelihood.model.outputs).marginal()


def column(seed: int, every: int = 1) -> Posterior:
    """Bridge column with new noise."""
    if seed == 1:
        return problems.bridge_column(every=every).marginal()
    bundled = problems.bridge_column_data()
    test = bundled._replace(measurements=column_measurements(bundled.record, seed=seed))
    return problems.bridge_column(data=test, every=every).marginal()


def _pier_with_more_friction(samples: np.ndarray) -> np.ndarray:
    return (samples[:, 1] >= samples[:, 4]).astype(int)


PROBLEMS = {
    "oscillator": Problem(oscillator),  # 2 parameters
    "twin": Problem(partial(bridge, "twin")),  # 10 parameters
    "means": Problem(partial(bridge, "means"), _pier_with_more_friction),  # 10 parameters, 2 modes
    "column4": Problem(partial(column, every=4)),  # one sample in 4, 5 parameters
    "column": Problem(column),
}
PROBLEMS |= {
    f"shear{storeys}{suffix}": Problem(partial(many_stiffnesses.shear_building, storeys, jacobian=bool(suffix)))
    for storeys in (10, 20, 30, 50)
    for suffix in ("", "_jacobian")
}
PROBLEMS |= {f"tested_{name}": Problem(partial(tested_column.column, name)) for name in tested_column.HISTORIES}
PROBLEMS |= {name: Problem(case.posterior, case.label) for name, case in CASES.items()}
PROBLEMS |= {  # only the product E h^3 is identified
    name: Problem(partial(many_stiffnesses.ridge, name), exact=partial(many_stiffnesses.ridge_reference, name))
    for name in many_stiffnesses.RIDGES
}
"""All problems by name."""
