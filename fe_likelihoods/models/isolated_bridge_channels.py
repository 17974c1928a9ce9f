"""Channels of the isolated bridge: their names, and the measured sets.

Channels of pier i are the bearing displacement ``Ub_i``, the isolator force ``Fb_i``, the drift of the block's top
``drift_i``, the elastic shear force of the pier ``shear_i`` and the absolute acceleration of the block's top
``acc_pi``. Channels of the deck are its displacement ``Ud`` and its absolute acceleration ``acc_d``. ``mean_Ub``,
``mean_Fb``, ``mean_drift``, ``mean_shear`` and ``mean_acc_p`` are means over the two piers; they do not identify which
pier is which.
"""

from __future__ import annotations

from ..signals.channels import Channel

__all__ = ["ALL_CHANNELS", "CHANNELS", "CHANNEL_SETS", "OF_A_PIER", "at_pier"]

OF_A_PIER = {
    "Ub": ("bearing displacement", "mm"),
    "Fb": ("isolator force", "kN"),
    "drift": ("drift displacement", "mm"),
    "shear": ("shear force", "kN"),
    "acc_p": ("absolute acceleration", "g"),
}


def at_pier(name: str, i: int) -> str:
    """Name of a channel at pier `i`."""
    return f"{name}{i}" if name == "acc_p" else f"{name}_{i}"


CHANNELS = {
    **{at_pier(name, i): Channel(at_pier(name, i), *what) for name, what in OF_A_PIER.items() for i in (1, 2)},
    "Ud": Channel("Ud", "deck displacement", "mm"),
    "acc_d": Channel("acc_d", "absolute acceleration", "g"),
    **{f"mean_{name}": Channel(f"mean_{name}", *what) for name, what in OF_A_PIER.items()},
}
"""All channels by name."""

ALL_CHANNELS = tuple(name for name in CHANNELS if not name.startswith("mean_"))
"""Names of the twelve channels that are not means."""

_PIER_1, _PIER_2 = (tuple(at_pier(name, i) for name in OF_A_PIER) for i in (1, 2))
CHANNEL_SETS = {5: _PIER_1, 6: (*_PIER_1, "Ub_2"), 10: _PIER_1 + _PIER_2}
"""Sets of measured channels: five at pier 1, these with the bearing displacement at pier 2, and ten at both piers."""
