"""Channels of the isolated bridge: their names, the measured sets, and how they follow from the state.

Channels of pier i are the bearing displacement ``Ub_i``, the isolator force ``Fb_i``, the drift of the block's top
``drift_i``, the elastic shear force of the pier ``shear_i`` and the absolute acceleration of the block's top
``acc_pi``. Channels of the deck are its displacement ``Ud`` and its absolute acceleration ``acc_d``. ``mean_Ub``,
``mean_Fb``, ``mean_drift``, ``mean_shear`` and ``mean_acc_p`` are means over the two piers; they do not identify which
pier is which.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..signals.channels import Channel

if TYPE_CHECKING:
    from .isolated_bridge_parts import Pier
    from .isolated_bridge_system import BridgeMatrices

__all__ = ["ALL_CHANNELS", "CHANNELS", "CHANNEL_SETS", "channel_matrix"]

_OF_A_PIER = {
    "Ub": ("bearing displacement", "mm"),
    "Fb": ("isolator force", "kN"),
    "drift": ("drift displacement", "mm"),
    "shear": ("shear force", "kN"),
    "acc_p": ("absolute acceleration", "g"),
}


def _at_pier(name: str, i: int) -> str:
    """Name of a channel at pier `i`."""
    return f"{name}{i}" if name == "acc_p" else f"{name}_{i}"


CHANNELS = {
    **{_at_pier(name, i): Channel(_at_pier(name, i), *what) for name, what in _OF_A_PIER.items() for i in (1, 2)},
    "Ud": Channel("Ud", "deck displacement", "mm"),
    "acc_d": Channel("acc_d", "absolute acceleration", "g"),
    **{f"mean_{name}": Channel(f"mean_{name}", *what) for name, what in _OF_A_PIER.items()},
}
"""All channels by name."""

ALL_CHANNELS = tuple(name for name in CHANNELS if not name.startswith("mean_"))
"""Names of the twelve channels that are not means."""

_PIER_1, _PIER_2 = (tuple(_at_pier(name, i) for name in _OF_A_PIER) for i in (1, 2))
CHANNEL_SETS = {5: _PIER_1, 6: (*_PIER_1, "Ub_2"), 10: _PIER_1 + _PIER_2}
"""Sets of measured channels: five at pier 1, these with the bearing displacement at pier 2, and ten at both piers."""


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
    for name in _OF_A_PIER:
        pair = [rows[_at_pier(name, i)] for i in (1, 2)]
        rows[f"mean_{name}"] = 0.5 * (pair[0] + pair[1])
    return np.array([rows[name] for name in names])
