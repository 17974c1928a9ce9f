"""Stiffness and damping that depend on the amplitude of the response: the equivalent-linear method.

A structure is linear within one motion, with the stiffness and the damping that belong to its response level in this
motion (Idriss & Seed 1968; Schnabel, Lysmer & Seed 1972, for soil). With the level ``l`` and a reference level
``l_0``, ::

    K(l) = K_0 (l / l_0)^-p,        zeta(l) = zeta_0 (l / l_0)^q,        l = level of the response with K(l) and zeta(l)

so that frequencies follow (l / l_0)^(-p/2). The level is the energy-weighted root mean square of the relative
displacement u of one channel, l^2 = sum u^4 / sum u^2. It is a smooth function of the parameters, unlike a peak, and
does not depend on the length of the quiet parts of a record. See ``docs/theory/equivalent_linear.rst``.

References
----------
I. M. Idriss, H. B. Seed, Seismic response of horizontal soil layers, Journal of the Soil Mechanics and Foundations
Division 94(4), 1968, 1003-1031.

P. B. Schnabel, J. Lysmer, H. B. Seed, SHAKE: a computer program for earthquake response analysis of horizontally
layered sites, report EERC 72-12, University of California, Berkeley, 1972.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..simulation.model import SimulationFailed
from .linear_system import LinearSystem, Parts, complex_modes, superpose
from .validation import check_positive

__all__ = ["EquivalentLinear", "Settled"]

_LARGEST_LOG = math.log(1000.0)  # of a level as a multiple of the reference
_STEP = 0.5  # of the search for a sign change, in the logarithm of the level
_TOLERANCE = 1e-13  # of the log-level
_OWN = ("softening", "damping_growth")


class Settled(NamedTuple):
    """A structure whose stiffness and damping agree with its response level."""

    level: float  # energy-weighted RMS of the relative displacement [m]; 0 under a motion of zeros
    stiffness_factor: float  # multiple of the stiffness at the reference level
    damping_factor: float  # multiple of the damping ratios there
    system: LinearSystem


@dataclass(frozen=True)
class EquivalentLinear:
    """Parts of a `LinearStructure` with stiffness and damping that depend on the response level.

    The parameters are the parameters of `parts`, whose frequencies, stiffnesses and damping ratios hold at the
    reference level, and two more: ``softening`` p, by which all stiffnesses are multiplied by (level / reference)^-p,
    and ``damping_growth`` q, by which all damping ratios are multiplied by (level / reference)^q. With p = q = 0 the
    structure is linear, with the same response to the last bit.

    Parameters
    ----------
    parts : BridgeDeck, ShearFrame, or an object with the interface `Parts`
        The structure at the reference level.
    reference : float
        Reference level [m]. A value in the middle of the measured events' levels keeps the other parameters almost
        independent of `softening` and `damping_growth`.
    channel : str, optional
        Channel whose displacement relative to the (quasi-static) motion of the supports is the level. Required if there
        are several channels; for a building, use the roof channel.

    Raises
    ------
    ValueError
        If the reference is not positive, the channel is missing or unknown, or `parts` has such parameters already.

    Notes
    -----
    One level holds for the whole record: the properties do not change within a motion, and differ between motions only
    through their levels. The structure has no memory and no residual displacement. If
    several levels agree with a motion, the first one in the direction of the search is used.

    Examples
    --------
    >>> deck = EquivalentLinear(BridgeDeck("middle"), reference=0.003)
    >>> deck.parameter_names
    ('frequency', 'damping', 'share', 'softening', 'damping_growth')
    >>> bridge = LinearStructure(deck, [record, record, record])
    >>> (acceleration,) = bridge.simulate([4.5, 0.1, 0.8, 0.15, 0.3])
    """

    parts: Parts
    reference: float
    channel: str | None = None

    def __post_init__(self) -> None:
        check_positive("reference of EquivalentLinear", self.reference)
        object.__setattr__(self, "reference", float(self.reference))
        if taken := set(_OWN) & set(self.parts.parameter_names):
            raise ValueError(
                f"EquivalentLinear: {type(self.parts).__name__} has parameters {', '.join(sorted(taken))} already; "
                "give the parts of a linear structure"
            )
        names = self.parts.channel_names
        if (self.channel is None and len(names) != 1) or (self.channel is not None and self.channel not in names):
            raise ValueError(
                f"EquivalentLinear: expected channel=, one of {', '.join(names)}, whose relative displacement is the "
                f"level; got {self.channel!r}"
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of the parts, then ``softening`` and ``damping_growth``."""
        return (*self.parts.parameter_names, *_OWN)

    @property
    def n_supports(self) -> int:
        """Number of supports."""
        return self.parts.n_supports

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return self.parts.channel_names

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Compute the matrices at the reference level; raises the errors of the parts."""
        return self.parts.assemble(np.asarray(theta, dtype=float)[:-2])

    def settle(self, theta: np.ndarray, support_acceleration: np.ndarray, dt: float) -> Settled:
        """Find the level whose stiffness and damping give a response with this level.

        The search goes from the reference level towards the response level, each time by a factor of 1.65, until it
        passes the response level. Brent's method then finds the fixed point in between to a relative error of 1e-13.

        `theta` are the parameters, and the support accelerations are (n_supports, n_steps) [m/s²]. Raises
        SimulationFailed as `assemble`, and if there is no fixed point between 1/1000 and 1000 times the reference
        level.
        """
        reference, excess = self._excess(theta, support_acceleration, dt)
        first = excess(0.0)
        if first == -math.inf:  # at rest
            return Settled(0.0, 1.0, 1.0, reference)
        step = math.copysign(_STEP, first)
        below, end = 0.0, 0.0
        while first * (last := excess(end)) > 0.0:
            if abs(end) >= _LARGEST_LOG:
                side = "above 1000 times" if step > 0.0 else "below 1/1000 of"
                raise SimulationFailed(
                    f"stiffness and damping do not settle: no response level agrees with its own properties at "
                    f"softening {theta[-2]:.4g} and damping_growth {theta[-1]:.4g}; the search ended {side} the "
                    f"reference level of {self.reference:g} m"
                )
            below, end = end, end + step
        return self._settled(_root(excess, below, end) if last else end, theta, reference)

    def _excess(
        self, theta: np.ndarray, support_acceleration: np.ndarray, dt: float
    ) -> tuple[LinearSystem, Callable[[float], float]]:
        """The structure at the reference level, and ln(response level / level) over ln(level / reference)."""
        theta = np.asarray(theta, dtype=float)
        reference = self.assemble(theta)
        names = self.parts.channel_names
        shape = reference.shape[names.index(self.channel) if self.channel else 0]
        displacement = np.zeros((1, support_acceleration.shape[1]))
        influence, motion = reference.influence, support_acceleration
        if influence.shape[1] > len(influence):  # fewer series than supports excite the degrees of freedom
            influence, motion = np.eye(len(influence)), influence @ motion

        @functools.cache
        def excess(x: float) -> float:
            modes = complex_modes(self._settled(x, theta, reference).system._replace(influence=influence))
            displacement[:] = 0.0
            superpose(modes, modes.shapes[:, :1] @ shape, motion, dt, displacement)
            level = _response_level(displacement[0])
            if not level < math.inf:
                raise SimulationFailed(f"the response at {math.exp(x):.3g} times the reference level is not finite")
            if level == 0.0:
                return -math.inf
            return math.log(level / self.reference) - x

        return reference, excess

    def _settled(self, x: float, theta: np.ndarray, reference: LinearSystem) -> Settled:
        """The structure at ln(level / reference) = x."""
        with np.errstate(over="ignore", invalid="ignore"):
            stiffness, damping = np.exp(-theta[-2] * x), np.exp(theta[-1] * x)
            # zeta = C / (2 sqrt(K M)) of each mode: C grows with the root of the stiffness
            system = reference._replace(
                stiffness=stiffness * reference.stiffness,
                damping=damping * np.sqrt(stiffness) * reference.damping,
            )
        return Settled(self.reference * math.exp(x), float(stiffness), float(damping), system)


def _response_level(displacement: np.ndarray) -> float:
    """Energy-weighted root mean square of a relative displacement (n_steps,) [m]: sqrt(sum u^4 / sum u^2)."""
    largest = np.abs(displacement).max()
    if not 0.0 < largest < math.inf:
        return 0.0 if largest == 0.0 else math.inf
    squares = np.square(displacement / largest)  # scaled, so that fourth powers do not underflow
    return float(largest * math.sqrt(squares @ squares / squares.sum()))


def _root(excess: Callable[[float], float], one: float, other: float) -> float:
    from scipy.optimize import brentq  # slow to import, and not needed for linear structures

    return brentq(excess, min(one, other), max(one, other), xtol=_TOLERANCE)
