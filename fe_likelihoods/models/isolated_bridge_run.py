"""One simulation of the isolated bridge."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from ..kernels.bearings import BOUC_WEN, COULOMB, RubberLaw, Slider
from ..kernels.isolated_bridge import N_OUT, Isolators, step_isolated
from ..simulation.model import SimulationFailed
from .isolated_bridge_channels import channel_matrix
from .isolated_bridge_parts import Damper
from .isolated_bridge_system import BridgeStateSpace
from .validation import check_values

__all__ = ["FORMS", "BridgeRun", "PreparedBridge", "prepare_bridge", "run_bridge"]

FORMS = {"bouc-wen": BOUC_WEN, "coulomb": COULOMB}
COULOMB_HALVINGS = 6
"""How often a step with Coulomb's law is halved to find the instant at which a bearing begins or ceases to stick."""

_MAY_BE_ZERO = ("df_1", "a_1", "df_2", "a_2")


class PreparedBridge(NamedTuple):
    """Inputs of the kernel that are the same for every theta."""

    linear: BridgeStateSpace
    to_channels: csr_array
    weights: np.ndarray  # (n_steps, 2) load on the bearings at the samples of the record, negative in uplift [N]
    law: RubberLaw
    tolerance: float  # of a correction to the isolator forces [N]
    rubber_range: float  # bearing displacement up to which the rubber law holds [m]


class BridgeRun(NamedTuple):
    """Result of one simulation, up to the last sample of the response."""

    values: np.ndarray  # (16, n) state, isolator forces F and Z at the samples of the record
    drivers: np.ndarray  # (15, n) state, F and table acceleration: channels are linear combinations of them
    iterations: float  # of Newton's method per step


def prepare_bridge(model: Any) -> PreparedBridge:
    """Inputs of the kernel for a bridge."""
    matrices, rubber = model.matrices, model.rubber
    load = np.array([bearing.load for bearing in model.bearings])
    lift = np.zeros(model.record.n_steps) if model.vertical is None else model.vertical.acceleration / model.gravity
    return PreparedBridge(
        linear=BridgeStateSpace.of(matrices),
        # Sparse, because a dense product is left to BLAS, whose last bit depends on its number of threads.
        to_channels=csr_array(channel_matrix(matrices, model.piers, model.outputs)),
        weights=(1.0 + lift)[:, None] * load,
        law=RubberLaw(*map(float, (*rubber.skeleton[1:], *rubber.half_loop, rubber.scale, rubber.limit))),
        tolerance=model.tolerance * load.min(),
        rubber_range=rubber.limit * rubber.scale,
    )


def run_bridge(model: Any, prepared: PreparedBridge, theta: np.ndarray) -> BridgeRun:
    """Simulate for multiples `theta` (n_parameters,) of the nominal parameters.

    Raises SimulationFailed if the parameters describe no structure, or the solution does not converge.
    """
    v = model.physical_values(theta)
    check_values(v, _MAY_BE_ZERO)
    dampers = [Damper(v[f"Kd_{i}"], v[f"C0_{i}"], damper.count) for i, damper in enumerate(model.dampers, 1)]
    step = model.integration_step
    coulomb = model.friction == "coulomb"
    matrices = prepared.linear.step_matrices(dampers, step, COULOMB_HALVINGS if coulomb else None)
    sliders = tuple(
        Slider(
            f_min=float(v[f"fmin_{i}"]),
            df=float(v[f"df_{i}"]),
            a=float(v[f"a_{i}"]),
            yield_displacement=float(bearing.yield_displacement),
        )
        for i, bearing in enumerate(model.bearings, 1)
    )
    c = math.sqrt(2.0 * model.bearings[0].gamma - 1.0)
    ground = model.record.acceleration[: (model.n_steps - 1) * model.every + 1]  # up to the last sample of the response
    out = np.zeros((ground.size, N_OUT))
    n_sub = round(model.record.dt / step)
    status, iterations = step_isolated(
        matrices,
        Isolators(sliders, prepared.law, c, FORMS[model.friction]),
        ground,
        prepared.weights,
        n_sub,
        prepared.tolerance,
        model.max_iterations,
        np.zeros((2, 16)),
        out,
    )
    if status:
        n_steps = n_sub * (ground.size - 1)
        raise SimulationFailed(f"step {status} of {n_steps} (t = {status * step:.4g} s) did not converge")
    if coulomb:
        prepared.linear.hold_stuck_bearings(dampers, ground, out)
    return BridgeRun(out.T, np.vstack([out.T[:14], ground]), iterations / max(1, n_sub * (ground.size - 1)))
