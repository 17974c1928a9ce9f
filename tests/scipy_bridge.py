"""The isolated bridge as an ordinary differential equation for scipy's `solve_ivp`, a peer for tests and benchmarks.

It shares no code with the kernels: free bodies of the deck and of the two blocks on their piers, rate equations of
friction (Bouc-Wen, exponent 2) and of dampers.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

CHANNELS = (
    *("Ub_1", "Ub_2", "Fb_1", "Fb_2", "drift_1", "drift_2"),
    *("shear_1", "shear_2", "acc_p1", "acc_p2", "Ud", "acc_d"),
)
GRAVITY = 9.81  # [m/s²], for masses from weights
# typical sizes of the states: five degrees of freedom, their velocities, friction, damper forces
SCALE = np.repeat([1e-2, 1e-1, 1.0, 1e4], [5, 5, 2, 2])


class Definition(NamedTuple):
    """Nominal values [N, m, s, kg]; pairs hold the values of the two piers."""

    deck_weight: float = 140e3
    weight: tuple[float, float] = (70e3, 70e3)  # on the bearing
    modulus: float = 200e9
    inertia: float = 3.02e-5
    length: float = 1.6
    height: float = 0.3  # of the block
    centre: float = 0.15  # of mass, above the block's bottom
    mass: float = 907.0
    rotary: float = 34.0  # about the centre of mass
    damping: float = 0.02  # of the first mode of a pier alone
    slow: tuple[float, float] = (0.055, 0.050)
    rise: tuple[float, float] = (0.065, 0.070)
    rate: tuple[float, float] = (24.0, 28.0)
    spring: tuple[float, float] = (2575e3, 2700e3)
    dashpot: tuple[float, float] = (15.45e3, 14.80e3)
    dampers: float = 2.0
    rubber_length: float = 0.05
    rubber_limit: float = 1.2
    rubber: tuple[float, ...] = (8500.0, 250.0, 100.0, 150.0, 1500.0, 7500.0)
    loop: tuple[float, ...] = (450.0, 100.0, 250.0)
    slip: float = 0.13e-3
    gamma: float = 0.9
    beta: float = 0.1

    def at(self, theta: np.ndarray) -> "Definition":
        """Return the bridge at multiples (10,) of fmin_1, df_1, a_1, fmin_2, df_2, a_2, Kd_1, C0_1, Kd_2, C0_2."""
        x = np.asarray(theta, dtype=float)
        scaled = {"slow": x[0:6:3], "rise": x[1:6:3], "rate": x[2:6:3], "spring": x[6::2], "dashpot": x[7::2]}
        return self._replace(
            **{name: tuple((np.array(getattr(self, name)) * factors).tolist()) for name, factors in scaled.items()}
        )

    @property
    def stiffness(self) -> np.ndarray:
        """Stiffness (2, 2) of the tip of a cantilever: shear and moment from displacement and rotation."""
        length = self.length
        terms = np.array([[12.0, -6.0 * length], [-6.0 * length, 4.0 * length**2]])
        return self.modulus * self.inertia / length**3 * terms

    @property
    def stiffness_damping(self) -> float:
        """Factor [s] of the stiffness of a pier that gives its damping."""
        lever = self.mass * self.centre
        mass = np.array([[self.mass, lever], [lever, self.rotary + lever * self.centre]])
        return 2.0 * self.damping / np.sqrt(eigh(self.stiffness, mass, eigvals_only=True)[0])


# one structured array: scipy passes it at every evaluation, and passing a tuple of arrays takes longer than that
_CONSTANTS = np.dtype(
    [(name, float) for name in ("dt", "k_uu", "k_up", "k_pp", "retardation", "deck")]
    + [(name, float) for name in ("mass", "rotary", "height", "centre", "rubber_length", "rubber_limit")]
    + [(name, float) for name in ("slip", "gamma", "beta")]
    + [(name, float, 2) for name in ("weight", "slow", "rise", "rate")]
    + [(name, float, 2) for name in ("spring", "relaxation")]
    + [("rubber", float, 6), ("loop", float, 3)]
)


@njit(cache=True)
def _sample(values, dt, t):
    place = t / dt
    k = min(max(int(place), 0), len(values) - 2)
    return values[k] + (place - k) * (values[k + 1] - values[k])


@njit(cache=True)
def _odd(coefficients, s):
    force, slope, power = 0.0, 0.0, 1.0
    for n in range(len(coefficients)):
        force += coefficients[n] * power * s
        slope += (2 * n + 1) * coefficients[n] * power
        power *= s * s
    return force, slope


@njit(cache=True)
def _isolator(c, i, u, v, z, damper, load):
    """Return the force of an isolator and the rate of its friction variable."""
    friction = c.slow[i] + c.rise[i] * (1.0 - np.exp(-c.rate[i] * abs(v)))
    rate = v / c.slip * (1.0 - z * z * (c.gamma * np.sign(v * z) + c.beta))
    s = u / c.rubber_length
    inside = min(max(s, -c.rubber_limit), c.rubber_limit)
    skeleton, slope = _odd(c.rubber, inside)
    skeleton += slope * (s - inside)
    half = 0.0
    for m in range(len(c.loop)):
        half += c.loop[m] * inside ** (2 * m)
    return (friction * c.weight[i] * load + half) * z + skeleton + damper, rate


@njit(cache=True)
def _state(t, x, c, motion, lift, rates, out):
    """Write the rates (14,) of the state and the channels (12,) at one instant."""
    ground = _sample(motion, c.dt, t)
    load = max(0.0, 1.0 + _sample(lift, c.dt, t) / GRAVITY)
    deck_force = 0.0
    for i in range(2):
        u, turn, du, dturn = x[1 + 2 * i], x[2 + 2 * i], x[6 + 2 * i], x[7 + 2 * i]
        slide, speed = x[0] - u - c.height * turn, x[5] - du - c.height * dturn
        force, rate = _isolator(c, i, slide, speed, x[10 + i], x[12 + i], load)
        shear = c.k_uu * u + c.k_up * turn
        moment = c.k_up * u + c.k_pp * turn
        pushed = shear + c.retardation * (c.k_uu * du + c.k_up * dturn)
        turned = moment + c.retardation * (c.k_up * du + c.k_pp * dturn)
        of_centre = (force - pushed) / c.mass  # absolute acceleration of the centre of mass
        angular = ((c.height - c.centre) * force - turned + c.centre * pushed) / c.rotary
        rates[1 + 2 * i], rates[2 + 2 * i] = du, dturn
        rates[6 + 2 * i], rates[7 + 2 * i] = of_centre - c.centre * angular - ground, angular
        rates[10 + i] = rate
        rates[12 + i] = c.spring[i] * speed - x[12 + i] / c.relaxation[i]
        deck_force += force
        out[i], out[2 + i], out[4 + i], out[6 + i] = slide, force, u + c.height * turn, shear
        out[8 + i] = of_centre + (c.height - c.centre) * angular
    rates[0], rates[5] = x[5], -deck_force / c.deck - ground
    out[10], out[11] = x[0], -deck_force / c.deck


@njit(cache=True)
def _right_hand_side(t, x, constants, motion, lift):
    rates = np.empty(14)
    _state(t, x, constants[0], motion, lift, rates, np.empty(12))
    return rates


@njit(cache=True)
def _outputs(times, states, constants, motion, lift):
    response = np.empty((12, len(times)))
    rates, out = np.empty(14), np.empty(12)
    for k in range(len(times)):
        _state(times[k], states[:, k], constants[0], motion, lift, rates, out)
        response[:, k] = out
    return response


def _constants(bridge, dt) -> np.ndarray:
    k = bridge.stiffness
    derived = dict(
        dt=dt,
        k_uu=k[0, 0],
        k_up=k[0, 1],
        k_pp=k[1, 1],
        retardation=bridge.stiffness_damping,
        deck=bridge.deck_weight / GRAVITY,
        spring=bridge.dampers * np.array(bridge.spring),  # all dampers of a pier
        relaxation=np.array(bridge.dashpot) / np.array(bridge.spring),
    )
    constants = np.zeros(1, _CONSTANTS)
    for name in _CONSTANTS.names:
        constants[name] = derived[name] if name in derived else getattr(bridge, name)
    return constants


def solve(
    bridge: Definition,
    acceleration: np.ndarray,
    dt: float,
    *,
    method: str = "LSODA",
    tolerance: float = 1e-9,
    vertical: np.ndarray | None = None,
) -> np.ndarray:
    """Response (12, n) [SI], rows as `CHANNELS`, of a bridge (``Definition().at(theta)``) from rest.

    `acceleration` (n,) and `vertical` (n,), which changes the load on the bearings, belong to the table [m/s²], with
    step `dt` [s]. `tolerance` is relative; the absolute one is a tenth of it, times the typical size of each state.
    """
    motion = np.ascontiguousarray(acceleration, dtype=float)
    lift = np.zeros_like(motion) if vertical is None else np.ascontiguousarray(vertical, dtype=float)
    arguments = (_constants(bridge, dt), motion, lift)
    times = np.arange(len(acceleration)) * dt
    run = solve_ivp(
        _right_hand_side,
        (0.0, times[-1]),
        np.zeros(14),
        method=method,
        t_eval=times,
        args=arguments,
        rtol=tolerance,
        atol=0.1 * tolerance * SCALE,
        # the bridge is at rest before the record begins: without this the first step could jump over its beginning
        first_step=1e-5,
    )
    if not run.success:
        raise RuntimeError(f"{method} stopped at {run.t[-1]:g} s: {run.message}")
    return _outputs(run.t, run.y, *arguments)


def peak_errors(response: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the largest difference of each channel over the largest value of the reference."""
    return np.abs(response - reference).max(axis=-1) / np.abs(reference).max(axis=-1)


def exchange_piers(model, thetas):
    """Multiples (..., 10) of the nominal values with the same physical values at the other pier."""
    nominal = np.array(list(model.nominal.values()))
    return (np.asarray(thetas) * nominal)[..., [3, 4, 5, 0, 1, 2, 8, 9, 6, 7]] / nominal
