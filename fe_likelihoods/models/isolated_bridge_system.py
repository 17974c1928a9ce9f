"""One simulation of the isolated bridge: matrices of deck and piers, of one exact integration step, and the run.

Degrees of freedom, relative to the table: q = [deck, pier 1 and its rotation, pier 2 and its rotation]. The linear part
holds the structure, its damping, the dampers (Maxwell elements) and the linear term of the rubber ::

    x' = A x + b a_g + B_F F,    x = [q, q', damper forces]

with the acceleration a_g of the table and the remaining forces F of the two isolators (friction and the higher terms of
the rubber). Between two instants a_g and F are linear in time, so that a step is exact for this part
(``docs/theory/time_integration.rst``). The equations of motion are in ``docs/theory/isolated_bridge.rst``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from ..kernels.bearings import BOUC_WEN, COULOMB, RubberLaw, Slider
from ..kernels.exponential import matrix_exponential
from ..kernels.isolated_bridge import N_OUT, N_STATES, Isolators, StepMatrices, step_isolated
from ..simulation.model import SimulationFailed
from .isolated_bridge_bearings import OF_A_PIER, Damper, Pier, Rubber, at_pier
from .validation import check_values

GRAVITY = 9.81  # [m/s²]
TOLERANCE = 1e-5  # largest last correction of the isolator forces, as a multiple of the smaller bearing load
MAX_ITERATIONS = 50  # of Newton's method per step
FORMS = {"bouc-wen": BOUC_WEN, "coulomb": COULOMB}
COULOMB_HALVINGS = 6
"""How often a step with Coulomb's law is halved to find the instant at which a bearing begins or ceases to stick."""

_MAY_BE_ZERO = ("df_1", "a_1", "df_2", "a_2")


class BridgeMatrices(NamedTuple):
    """Matrices of deck and piers for the degrees of freedom q, which do not depend on theta."""

    mass: np.ndarray  # (5, 5) [kg, and products with m]
    damping: np.ndarray  # (5, 5) [N s/m, ...]
    stiffness: np.ndarray  # (5, 5) [N/m, ...]
    kinematics: np.ndarray  # (2, 5), B: bearing displacements from q, deck minus top of the block
    rubber_stiffness: float  # linear, at each pier [N/m]

    @classmethod
    def assemble(
        cls,
        deck_mass: float,
        piers: Sequence[Pier],
        rubber: Rubber,
    ) -> BridgeMatrices:
        """Assemble the matrices."""
        mass, damping, stiffness = np.zeros((3, 5, 5))
        mass[0, 0] = deck_mass
        for i, pier in enumerate(piers):
            own = slice(1 + 2 * i, 3 + 2 * i)
            mass[own, own], damping[own, own], stiffness[own, own] = pier.mass_matrix, pier.damping, pier.stiffness
        h1, h2 = (pier.height for pier in piers)
        kinematics = np.array([[1.0, -1.0, -h1, 0.0, 0.0], [1.0, 0.0, 0.0, -1.0, -h2]])
        return cls(mass, damping, stiffness, kinematics, rubber.linear_stiffness)


def channel_matrix(matrices: BridgeMatrices, piers: Sequence[Pier], names: Sequence[str]) -> np.ndarray:
    """Matrix (n_channels, 15) that gives the channels; accelerations follow from the equations of motion.

    Columns: 5 displacements, 5 velocities, 2 damper forces, 2 isolator forces F and the table acceleration.
    """
    mass, damping, stiffness, b = matrices.mass, matrices.damping, matrices.stiffness, matrices.kinematics
    q, ground = np.eye(15)[:5], np.eye(15)[14]
    force = np.zeros((2, 15))
    force[:, :5], force[:, 10:12], force[:, 12:14] = matrices.rubber_stiffness * b, np.eye(2), np.eye(2)
    influence = np.outer([1.0, 1.0, 0.0, 1.0, 0.0], ground)
    restoring = np.zeros((5, 15))
    restoring[:, :5], restoring[:, 5:10] = stiffness, damping
    acceleration = np.linalg.solve(mass, -restoring - b.T @ force) - influence
    rows = {"Ud": q[0], "acc_d": acceleration[0] + ground}
    for i, pier in enumerate(piers, 1):
        u, phi = 2 * i - 1, 2 * i
        rows |= {f"Ub_{i}": b[i - 1] @ q, f"Fb_{i}": force[i - 1], f"drift_{i}": q[u] + pier.height * q[phi]}
        rows[f"shear_{i}"] = pier.stiffness[0] @ q[u : phi + 1]
        rows[f"acc_p{i}"] = acceleration[u] + pier.height * acceleration[phi] + ground
    for name in OF_A_PIER:
        pair = [rows[at_pier(name, i)] for i in (1, 2)]
        rows[f"mean_{name}"] = 0.5 * (pair[0] + pair[1])
    return np.array([rows[name] for name in names])


class BridgeStateSpace(NamedTuple):
    """State-space form x' = A x + [b, B_F] [a_g, F], with A still without the dampers."""

    system: np.ndarray  # (12, 12), A; the rows of the damper forces are zero
    inputs: np.ndarray  # (12, 3), b and B_F
    kinematics: np.ndarray  # (2, 5) bearing displacements from q

    @classmethod
    def of(cls, matrices: BridgeMatrices) -> BridgeStateSpace:
        """State-space form of the deck and pier matrices."""
        b = matrices.kinematics
        inverse = np.linalg.inv(matrices.mass)
        a, inputs = np.zeros((N_STATES, N_STATES)), np.zeros((N_STATES, 3))
        a[:5, 5:10] = np.eye(5)
        a[5:10, :5] = -inverse @ (matrices.stiffness + matrices.rubber_stiffness * b.T @ b)
        a[5:10, 5:10] = -inverse @ matrices.damping
        a[5:10, 10:] = -inverse @ b.T
        inputs[5:10, 0] = [-1.0, -1.0, 0.0, -1.0, 0.0]
        inputs[5:10, 1:] = -inverse @ b.T
        return cls(a, inputs, b)

    def step_matrices(self, dampers: Sequence[Damper], step: float, halvings: int | None = None) -> StepMatrices:
        """Matrices of the steps [s] with these dampers, one per pier.

        `halvings`: how often the step of Coulomb's law is halved, for kinds of steps with F constant or linear in time
        (`StepMatrices`): a set-valued force that is linear in time would oscillate about rest. None: one kind.
        """
        if halvings is None:
            return StepMatrices(*(part[None] for part in self._of_size(dampers, step, [(True, True)])[0]))
        holds = [(False, False), (True, False), (False, True), (True, True)]
        kinds = [kind for k in range(halvings + 1) for kind in self._of_size(dampers, 0.5**k * step, holds)]
        return StepMatrices(*(np.stack(parts) for parts in zip(*kinds, strict=True)))

    def _of_size(
        self, dampers: Sequence[Damper], step: float, linear: Sequence[tuple[bool, bool]]
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """The arrays of `StepMatrices` for one size of step; each of `linear` says which forces are linear in time."""
        a, inputs = self._with_dampers(dampers), self.inputs
        n, m = inputs.shape
        augmented = np.zeros((n + 2 * m, n + 2 * m))
        augmented[:n, :n], augmented[:n, n : n + m] = a * step, inputs * step
        augmented[n : n + m, n + m :] = np.eye(m)
        # Velocities are scaled by the step and forces by a stiffness, because large entries lose digits in the
        # exponential. The factors are powers of two, so the scaling is exact.
        units = np.ones(n + 2 * m)
        units[5:n] = [1.0 / step] * 5 + [damper.count * damper.stiffness for damper in dampers]
        units = 2.0 ** np.round(np.log2(units))
        exponential = np.empty_like(augmented)
        matrix_exponential(augmented / units[:, None] * units, exponential, np.empty((2, *augmented.shape)))
        exponential *= units[:, None] / units
        phi, whole, second = exponential[:n, :n], exponential[:n, n : n + m], exponential[:n, n + m :]
        found = []
        for each in linear:
            at_end = second.copy()
            for bearing in range(2):
                if not each[bearing]:
                    at_end[:, 1 + bearing] = whole[:, 1 + bearing]
            at_start, ends = whole - at_end, at_end[:, 1:]
            advance = np.column_stack([phi, at_start[:, 0], at_end[:, 0], phi @ ends + at_start[:, 1:]])
            q = np.zeros((4, n))
            q[:2, :5] = q[2:, 5:10] = self.kinematics
            found.append(
                (np.ascontiguousarray(np.vstack([advance, q @ advance]).T), np.ascontiguousarray(ends), q @ ends)
            )
        return found

    def hold_stuck_bearings(self, dampers: Sequence[Damper], ground: np.ndarray, values: np.ndarray) -> None:
        """Replace the forces of bearings that stick, in `values` (n_steps, 16), by the forces that keep them at rest at
        each sample, under the table acceleration `ground` (n_steps,) [m/s²]. The kernel computes their mean over a
        step.
        """
        b, inputs = self.kinematics, self.inputs[5:10]
        acceleration = values[:, :12] @ (b @ self._with_dampers(dampers)[5:10]).T + np.outer(ground, b @ inputs[:, 0])
        by_force, force = b @ inputs[:, 1:], values[:, 12:14]
        stuck = np.abs(values[:, 14:16]) < 1.0
        for first, second in ((0, 1), (1, 0)):
            alone = stuck[:, first] & ~stuck[:, second]
            rest = acceleration[alone, first] + by_force[first, second] * force[alone, second]
            force[alone, first] = -rest / by_force[first, first]
        both = stuck.all(axis=1)
        force[both] = -np.linalg.solve(by_force, acceleration[both].T).T

    def _with_dampers(self, dampers: Sequence[Damper]) -> np.ndarray:
        """A (12, 12) with the dampers."""
        a = self.system.copy()
        for i, damper in enumerate(dampers):
            a[10 + i, 5:10] = damper.count * damper.stiffness * self.kinematics[i]
            a[10 + i, 10 + i] = -damper.stiffness / damper.viscosity
        return a


class PreparedBridge(NamedTuple):
    """Inputs of the kernel that are the same for every theta."""

    linear: BridgeStateSpace
    to_channels: csr_array
    weights: np.ndarray  # (n_steps, 2) load on the bearings at the samples of the record, negative in uplift [N]
    law: RubberLaw
    tolerance: float  # of a correction to the isolator forces [N]
    rubber_range: float  # bearing displacement up to which the rubber law holds [m]


def prepare_bridge(model: Any) -> PreparedBridge:
    """Inputs of the kernel for a bridge."""
    matrices, rubber = model.matrices, model.rubber
    load = np.array([bearing.load for bearing in model.bearings])
    lift = np.zeros(model.record.n_steps) if model.vertical is None else model.vertical.acceleration / GRAVITY
    return PreparedBridge(
        linear=BridgeStateSpace.of(matrices),
        # Sparse, because a dense product is left to BLAS, whose last bit depends on its number of threads.
        to_channels=csr_array(channel_matrix(matrices, model.piers, model.outputs)),
        weights=(1.0 + lift)[:, None] * load,
        law=RubberLaw(*map(float, (*rubber.skeleton[1:], *rubber.half_loop, rubber.scale, rubber.limit))),
        tolerance=TOLERANCE * load.min(),
        rubber_range=rubber.limit * rubber.scale,
    )


def run_bridge(model: Any, prepared: PreparedBridge, theta: np.ndarray) -> np.ndarray:
    """State, isolator forces F and table acceleration (15, n) for multiples `theta` of the nominal parameters.

    There are n samples up to the last one of the response, whose channels are linear combinations of them.

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
    status = step_isolated(
        matrices,
        Isolators(sliders, prepared.law, c, FORMS[model.friction]),
        ground,
        prepared.weights,
        n_sub,
        prepared.tolerance,
        MAX_ITERATIONS,
        np.zeros((2, 16)),
        out,
    )
    if status:
        n_steps = n_sub * (ground.size - 1)
        raise SimulationFailed(f"step {status} of {n_steps} (t = {status * step:.4g} s) did not converge")
    if coulomb:
        prepared.linear.hold_stuck_bearings(dampers, ground, out)
    return np.vstack([out.T[:14], ground])
