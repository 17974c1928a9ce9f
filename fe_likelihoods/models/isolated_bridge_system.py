"""Linear part of the isolated bridge: matrices of deck and piers, and the matrices of one exact integration step.

Degrees of freedom, relative to the table: q = [deck, pier 1 and its rotation, pier 2 and its rotation]. The linear part
holds the structure, its damping, the dampers (Maxwell elements) and the linear term of the rubber ::

    x' = A x + b a_g + B_F F,    x = [q, q', damper forces]

with the acceleration a_g of the table and the remaining forces F of the two isolators (friction and the higher terms of
the rubber). Between two instants a_g and F are linear in time, so that a step is exact for this part
(``docs/theory/time_integration.rst``). The equations of motion are in ``docs/theory/isolated_bridge.rst``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..kernels.exponential import matrix_exponential
from ..kernels.isolated_bridge import N_STATES, StepMatrices
from .isolated_bridge_parts import Bearing, Damper, Pier, Rubber

__all__ = ["BridgeMatrices", "BridgeStateSpace"]


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
        bearings: Sequence[Bearing],
        rubber: Rubber,
        gravity: float,
        p_delta: bool,
    ) -> BridgeMatrices:
        """Assemble the matrices; with `p_delta` the piers have their geometric stiffness."""
        mass, damping, stiffness = np.zeros((3, 5, 5))
        mass[0, 0] = deck_mass
        for i, (pier, bearing) in enumerate(zip(piers, bearings, strict=True)):
            own = slice(1 + 2 * i, 3 + 2 * i)
            mass[own, own], damping[own, own], stiffness[own, own] = pier.mass_matrix, pier.damping, pier.stiffness
            if p_delta:
                stiffness[own, own] += pier.geometric_stiffness(bearing.load, gravity)
        h1, h2 = (pier.height for pier in piers)
        kinematics = np.array([[1.0, -1.0, -h1, 0.0, 0.0], [1.0, 0.0, 0.0, -1.0, -h2]])
        return cls(mass, damping, stiffness, kinematics, rubber.linear_stiffness)


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
