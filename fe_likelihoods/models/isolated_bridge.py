"""Seismically isolated bridge: a rigid deck on two flexible piers, across sliders, rubber devices and fluid dampers.

Five degrees of freedom relative to the shake table, q = [deck, pier 1 and its rotation, pier 2 and its rotation]; each
pier is a massless cantilever with a rigid block at its tip, on which the isolators stand. The bearing displacement is
deck minus top of block, and the isolator force (friction, rubber, dampers) acts on both. Everything but friction and
the higher terms of the rubber is linear and is stepped exactly (`kernels.isolated`).

Channels of pier i: bearing displacement ``Ub_i``, isolator force ``Fb_i``, drift of the top of the block ``drift_i``,
elastic shear of the pier ``shear_i``, absolute acceleration of the top of the block ``acc_pi``; of the deck: ``Ud`` and
absolute acceleration ``acc_d``. ``mean_Ub``, ``mean_Fb``, ``mean_drift``, ``mean_shear`` and ``mean_acc_p`` are means
of the two piers, which do not tell the piers apart.

Most nominal values are assumed (specs/isolated_bridge.md, section 4): results are of a bridge *like* the tested one.

References
----------
The paper on TMCMC for the isolated bridge, equations (14) to (19); Tsopelas et al., NCEER 94-0002 (1994), the tests.
"""

from __future__ import annotations

import hashlib
import logging
import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from ..kernels.bearings import BOUC_WEN, COULOMB, ELASTIC_PLASTIC
from ..kernels.exponential import matrix_exponential
from ..kernels.isolated_bridge import N_OUT, N_STATES, step_isolated
from ..kernels.jit import KERNEL_HASH
from ..signals.channels import Channel, Measurements, plot_response
from ..signals.records import Record
from ..simulation.model import MisfitBatch, SimulationBatch, SimulationFailed
from ..simulation.threads import map_threads
from .isolated_bridge_parts import CHANNEL_SETS, Bearing, Damper, Pier, Rubber
from .validation import channel_rows, number, refuse, theta_row, theta_rows, whole_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure


__all__ = ["CHANNEL_SETS", "Bearing", "BridgeHistory", "Damper", "IsolatedBridge", "Pier", "Rubber"]

logger = logging.getLogger(__name__)
_WARNED: weakref.WeakSet[IsolatedBridge] = weakref.WeakSet()

PARAMETERS = ("fmin_1", "df_1", "a_1", "fmin_2", "df_2", "a_2", "Kd_1", "C0_1", "Kd_2", "C0_2")

_OF_A_PIER = {
    "Ub": ("bearing displacement", "mm"),
    "Fb": ("isolator force", "kN"),
    "drift": ("drift displacement", "mm"),
    "shear": ("shear force", "kN"),
    "acc_p": ("absolute acceleration", "g"),
}


def _at_pier(name: str, i: int) -> str:
    """Name of a channel of pier `i`."""
    return f"{name}{i}" if name == "acc_p" else f"{name}_{i}"


_CHANNELS = {
    **{_at_pier(name, i): Channel(_at_pier(name, i), *what) for name, what in _OF_A_PIER.items() for i in (1, 2)},
    "Ud": Channel("Ud", "deck displacement", "mm"),
    "acc_d": Channel("acc_d", "absolute acceleration", "g"),
    **{f"mean_{name}": Channel(f"mean_{name}", *what) for name, what in _OF_A_PIER.items()},
}
ALL_CHANNELS = tuple(name for name in _CHANNELS if not name.startswith("mean_"))

_FORMS = {"bouc-wen": BOUC_WEN, "elastic-plastic": ELASTIC_PLASTIC, "coulomb": COULOMB}
_STATE_ROWS = (
    *("deck", "pier_1", "rotation_1", "pier_2", "rotation_2"),
    *("deck velocity", "pier_1 velocity", "rotation_1 velocity", "pier_2 velocity", "rotation_2 velocity"),
    *("damper_1", "damper_2"),
)


class _Fixed(NamedTuple):
    """What is the same for every theta: x' = A x + [b, B_F] [a_g, F], and what else the kernel is given."""

    system: np.ndarray  # A (12, 12), the dampers' rows zero
    inputs: np.ndarray  # b and B_F (12, 3)
    kinematics: np.ndarray  # B (2, 5)
    weights: np.ndarray  # load on the bearings at the samples of the record (n_steps, 2) [N]
    law: np.ndarray  # of the rubber (10,)
    tolerance: float  # of a correction of F [N]


@dataclass(frozen=True)
class BridgeHistory:
    """Everything one simulation can tell, for plots and checks: names and values (n_rows, n_steps), SI.

    Rows: the state (displacements and velocities relative to the table, damper forces of each pier), ``Z_1``, ``Z_2``,
    then all channels. `beyond_range` (2,) is the largest bearing displacement as a multiple of where the rubber's law
    ends: above 1 the device was continued along its tangent. `iterations`: of Newton, per step.
    """

    names: tuple[str, ...]
    values: np.ndarray
    beyond_range: np.ndarray
    iterations: float

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[self.names.index(name)]


@dataclass(frozen=True, eq=False)
class IsolatedBridge:
    """Sandbox bridge on a shake table; `simulate` turns multiples of the nominal parameters into responses.

    Attributes
    ----------
    record : Record
        Acceleration of the table, straight lines between its samples. At the model's scale: for a quarter-scale model
        the time of a prototype record is halved.
    deck_mass : float
        [kg]
    piers, bearings, dampers : pairs of Pier, Bearing, Damper
    rubber : Rubber
        The same at both piers; never updated.
    outputs : tuple of str, 5, 6 or 10
        Channels by name, or a set of `CHANNEL_SETS`. None: all twelve.
    parameters : tuple of str
        Which of fmin_1, df_1, a_1, fmin_2, df_2, a_2, Kd_1, C0_1, Kd_2, C0_2 make up theta, as multiples of nominal.
    friction : str
        "bouc-wen" (regularised, the default), "elastic-plastic" (the law of other codes' sliders), or "coulomb": exact
        stick and slip, with the isolators' forces held constant over a step, so of first order.
    step : float
        Of integration [s]; it divides the record's step. At the default the error is below .1 % of the peak on every
        channel; displacements and forces need twice as long a step for that.
    every : int
        One response sample in so many of the record's.
    p_delta : bool
        Geometric stiffness of the piers under the weight that they carry.
    vertical : Record or None
        Vertical acceleration of the table [m/s2], upwards positive, at the record's samples: it changes the load on
        the bearings by the factor 1 + a_v/g, not below zero.
    gravity : float
        [m/s2]
    tolerance : float
        Of the last correction of the isolators' forces, in multiples of the smaller bearing load.
    max_iterations : int
        Of Newton in one step.
    """

    record: Record
    deck_mass: float = 140e3 / 9.81
    piers: tuple[Pier, Pier] = (Pier(), Pier())
    bearings: tuple[Bearing, Bearing] = (Bearing(), Bearing(f_min=0.050, df=0.070, a=28.0))
    dampers: tuple[Damper, Damper] = (Damper(), Damper(2700e3, 14.80e3))
    rubber: Rubber = Rubber()
    outputs: tuple[str, ...] | int | None = None
    parameters: tuple[str, ...] = PARAMETERS
    friction: str = "bouc-wen"
    step: float = 0.25e-3
    every: int = 1
    p_delta: bool = False
    vertical: Record | None = None
    gravity: float = 9.81
    tolerance: float = 1e-5
    max_iterations: int = 50

    def __post_init__(self) -> None:
        outputs = ALL_CHANNELS if self.outputs is None else self.outputs
        if isinstance(outputs, int) and outputs in CHANNEL_SETS:
            outputs = CHANNEL_SETS[outputs]
        object.__setattr__(self, "outputs", outputs)
        _check(self)
        for name in ("outputs", "parameters", "piers", "bearings", "dampers"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of theta, each a multiple of the value in `nominal`."""
        return self.parameters

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        values = {}
        for i, (bearing, damper) in enumerate(zip(self.bearings, self.dampers, strict=True), 1):
            values |= {f"fmin_{i}": bearing.f_min, f"df_{i}": bearing.df, f"a_{i}": bearing.a}
            values |= {f"Kd_{i}": damper.stiffness, f"C0_{i}": damper.viscosity}
        return {name: values[name] for name in PARAMETERS}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the response, in order."""
        return tuple(_CHANNELS[name] for name in self.outputs)

    @property
    def dt(self) -> float:
        """Step of the response [s]."""
        return self.record.dt * self.every

    @property
    def n_steps(self) -> int:
        """Number of samples of the response."""
        return (self.record.n_steps - 1) // self.every + 1

    @property
    def fingerprint(self) -> str:
        """Changes with anything that changes a response: arguments, records, kernels."""
        parts = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name not in ("record", "vertical")]
        parts += [self.record.fingerprint, "none" if self.vertical is None else self.vertical.fingerprint]
        parts += [KERNEL_HASH, type(self).__name__]
        return hashlib.blake2b("|".join(parts).encode(), digest_size=16).hexdigest()

    def with_record(self, record: Record) -> IsolatedBridge:
        """The same bridge under another motion of the table (without vertical motion)."""
        return replace(self, record=record, vertical=None)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] at multiples `theta` (n_parameters,) of the nominal parameters.

        Raises
        ------
        SimulationFailed
            For negative friction, stiffness or damping, and where a step does not converge.
        """
        return self._runner(theta_row(theta, self.parameters))

    def history(self, theta: np.ndarray) -> BridgeHistory:
        """States, hysteretic variables and all channels; same errors as `simulate`."""
        fixed = self._fixed()
        values, iterations = self._integrate(theta_row(theta, self.parameters), fixed)
        beyond = np.abs(fixed.kinematics @ values[:5]).max(axis=1) / (self.rubber.limit * self.rubber.scale)
        rows = csr_array(self._channel_matrix(ALL_CHANNELS)) @ self._drivers(values)
        names = (*_STATE_ROWS, "Z_1", "Z_2", *ALL_CHANNELS)
        kept = np.concatenate([values[:N_STATES], values[14:16], rows])[:, :: self.every]
        return BridgeHistory(names, kept, beyond, iterations)

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses at `thetas` (n, n_parameters), on numba's number of threads."""
        thetas = theta_rows(thetas, self.parameters)
        return SimulationBatch(*map_threads(self._runner, thetas, (len(self.outputs), self.n_steps)))

    def misfit_batch(self, thetas: np.ndarray, measured: np.ndarray) -> MisfitBatch:
        """Sums of squared residuals (n, n_channels) against `measured` (n_channels, n_steps); no response is kept."""
        thetas = theta_rows(thetas, self.parameters)
        measured = channel_rows(measured, self.channels, self.n_steps)
        run = self._runner
        return MisfitBatch(
            *map_threads(lambda theta: np.square(run(theta) - measured).sum(axis=1), thetas, (len(self.outputs),))
        )

    def exchanged(self, thetas: np.ndarray) -> np.ndarray:
        """The same devices, each at the other pier: multiples (..., 10) with the same physical values.

        Where the piers are alike and the data do not tell them apart, the likelihood is the same at both, and as the
        map keeps volumes, the masses of the two modes are as the prior's densities.
        """
        if self.parameters != PARAMETERS:
            raise ValueError(f"expected a model with the parameters {PARAMETERS}, in this order; got {self.parameters}")
        nominal = np.array(list(self.nominal.values()))
        physical = np.asarray(thetas, dtype=float) * nominal
        return physical[..., [3, 4, 5, 0, 1, 2, 8, 9, 6, 7]] / nominal

    def plot_response(self, theta: np.ndarray, measurements: Measurements | None = None) -> Figure:
        """Plot the response at `theta`, beside measurements if there are any."""
        return plot_response(Measurements(self.channels, self.dt, self.simulate(theta)), measurements)

    def plot_hysteresis(self, theta: np.ndarray) -> Figure:
        """Isolator force against bearing displacement of both piers."""
        from ..plots.structures import plot_bearing_loops

        return plot_bearing_loops(replace(self, every=1).history(theta))

    # ------------------------------------------------------------------ the linear part

    def _kinematics(self) -> np.ndarray:
        """B (2, 5): bearing displacements from q, deck minus top of block (equation 15)."""
        h1, h2 = (pier.height for pier in self.piers)
        return np.array([[1.0, -1.0, -h1, 0.0, 0.0], [1.0, 0.0, 0.0, -1.0, -h2]])

    def _structure(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass, damping and stiffness (5, 5) of deck and piers."""
        mass, damping, stiffness = np.zeros((3, 5, 5))
        mass[0, 0] = self.deck_mass
        for i, (pier, bearing) in enumerate(zip(self.piers, self.bearings, strict=True)):
            own = slice(1 + 2 * i, 3 + 2 * i)
            mass[own, own], damping[own, own], stiffness[own, own] = pier.mass_matrix, pier.damping, pier.stiffness
            if self.p_delta:
                stiffness[own, own] += pier.geometric_stiffness(bearing.load, self.gravity)
        return mass, damping, stiffness

    def _linear_rubber(self) -> float:
        return self.rubber.skeleton[0] / self.rubber.scale

    def _fixed(self) -> _Fixed:
        """What is the same for every theta."""
        mass, damping, stiffness = self._structure()
        b = self._kinematics()
        inverse = np.linalg.inv(mass)
        a, inputs = np.zeros((N_STATES, N_STATES)), np.zeros((N_STATES, 3))
        a[:5, 5:10] = np.eye(5)
        a[5:10, :5] = -inverse @ (stiffness + self._linear_rubber() * b.T @ b)
        a[5:10, 5:10] = -inverse @ damping
        a[5:10, 10:] = -inverse @ b.T
        inputs[5:10, 0] = [-1.0, -1.0, 0.0, -1.0, 0.0]
        inputs[5:10, 1:] = -inverse @ b.T
        load = np.array([bearing.load for bearing in self.bearings])
        lift = np.zeros(self.record.n_steps) if self.vertical is None else self.vertical.acceleration / self.gravity
        rubber = self.rubber
        law = np.array([*rubber.skeleton[1:], *rubber.half_loop, rubber.scale, rubber.limit])
        return _Fixed(a, inputs, b, np.maximum(0.0, 1.0 + lift)[:, None] * load, law, self.tolerance * load.min())

    def _system(self, v: dict[str, float], fixed: _Fixed) -> np.ndarray:
        """A (12, 12), with the dampers."""
        a = fixed.system.copy()
        for i, damper in enumerate(self.dampers):
            a[10 + i, 5:10] = damper.count * v[f"Kd_{i + 1}"] * fixed.kinematics[i]
            a[10 + i, 10 + i] = -v[f"Kd_{i + 1}"] / v[f"C0_{i + 1}"]
        return a

    def _step_matrices(self, v: dict[str, float], fixed: _Fixed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T transposed, H1, Q H1 of `kernels.isolated.step_isolated`."""
        a, inputs = self._system(v, fixed), fixed.inputs
        n, m = inputs.shape
        augmented = np.zeros((n + 2 * m, n + 2 * m))
        augmented[:n, :n], augmented[:n, n : n + m] = a * self.step, inputs * self.step
        augmented[n : n + m, n + m :] = np.eye(m)
        # velocities per step and forces as displacements, by powers of two, so exactly: large entries cost digits
        units = np.ones(n + 2 * m)
        units[5:n] = [1.0 / self.step] * 5 + [d.count * v[f"Kd_{i}"] for i, d in enumerate(self.dampers, 1)]
        units = 2.0 ** np.round(np.log2(units))
        exponential = np.empty_like(augmented)
        matrix_exponential(augmented / units[:, None] * units, exponential, np.empty((2, *augmented.shape)))
        exponential *= units[:, None] / units
        phi, whole, second = exponential[:n, :n], exponential[:n, n : n + m], exponential[:n, n + m :]
        first = whole - second
        if self.friction == "coulomb":  # a set-valued force that is a straight line would swing about rest for ever
            first[:, 1:], second[:, 1:] = 0.0, whole[:, 1:]
        ends = second[:, 1:]
        advance = np.column_stack([phi, first[:, 0], second[:, 0], phi @ ends + first[:, 1:]])
        q = np.zeros((4, n))
        q[:2, :5] = q[2:, 5:10] = fixed.kinematics
        return np.ascontiguousarray(np.vstack([advance, q @ advance]).T), np.ascontiguousarray(ends), q @ ends

    # ------------------------------------------------------------------ a run

    def _values(self, theta: np.ndarray) -> dict[str, float]:
        """Physical values [SI] of all parameters."""
        values = self.nominal
        for name, multiple in zip(self.parameters, theta.tolist(), strict=True):
            values[name] *= multiple
        for name, value in values.items():
            may_vanish = name.startswith(("df", "a_"))
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not may_vanish):
                raise SimulationFailed(f"{name} = {value:.4g} makes no device: it must be positive")
        return values

    def _integrate(self, theta: np.ndarray, fixed: _Fixed) -> tuple[np.ndarray, float]:
        """Output of the kernel (16, n_steps of the record), and Newton iterations per step."""
        v = self._values(theta)
        matrix, ends, compliance = self._step_matrices(v, fixed)
        bearing = np.array(
            [
                [v[f"fmin_{i}"], v[f"df_{i}"], v[f"a_{i}"], b.yield_displacement]
                + [v[f"fmin_{i}"] * b.load / b.yield_displacement]
                for i, b in enumerate(self.bearings, 1)
            ]
        )
        out = np.zeros((self.record.n_steps, N_OUT))
        n_sub = round(self.record.dt / self.step)
        status, iterations = step_isolated(
            matrix,
            ends,
            compliance,
            self.record.acceleration,
            fixed.weights,
            n_sub,
            bearing,
            math.sqrt(2.0 * self.bearings[0].gamma - 1.0),
            fixed.law,
            _FORMS[self.friction],
            fixed.tolerance,
            self.max_iterations,
            np.zeros((2, 16)),
            out,
        )
        if status:
            n_steps = n_sub * (self.record.n_steps - 1)
            raise SimulationFailed(f"step {status} of {n_steps} (t = {status * self.step:.4g} s) did not converge")
        return out.T, iterations / max(1, n_sub * (self.record.n_steps - 1))

    def _drivers(self, values: np.ndarray) -> np.ndarray:
        """What the channels are linear in, (15, n_steps): state, F and a_g."""
        return np.vstack([values[:14], self.record.acceleration])

    def _channel_matrix(self, names: Sequence[str]) -> np.ndarray:
        """(n_channels, 15): channels from state, F and a_g; accelerations by the equations of motion."""
        mass, damping, stiffness = self._structure()
        b = self._kinematics()
        q, ground = np.eye(15)[:5], np.eye(15)[14]
        force = np.zeros((2, 15))
        force[:, :5], force[:, 10:12], force[:, 12:14] = self._linear_rubber() * b, np.eye(2), np.eye(2)
        influence = np.outer([1.0, 1.0, 0.0, 1.0, 0.0], ground)
        restoring = np.zeros((5, 15))
        restoring[:, :5], restoring[:, 5:10] = stiffness, damping
        acceleration = np.linalg.solve(mass, -restoring - b.T @ force) - influence
        rows = {"Ud": q[0], "acc_d": acceleration[0] + ground}
        for i, pier in enumerate(self.piers, 1):
            u, phi = 2 * i - 1, 2 * i
            rows |= {f"Ub_{i}": b[i - 1] @ q, f"Fb_{i}": force[i - 1], f"drift_{i}": q[u] + pier.height * q[phi]}
            rows[f"shear_{i}"] = pier.stiffness[0] @ q[u : phi + 1]
            rows[f"acc_p{i}"] = acceleration[u] + pier.height * acceleration[phi] + ground
        for name in _OF_A_PIER:
            pair = [rows[_at_pier(name, i)] for i in (1, 2)]
            rows[f"mean_{name}"] = 0.5 * (pair[0] + pair[1])
        return np.array([rows[name] for name in names])

    def __getstate__(self) -> dict:
        return {name: value for name, value in vars(self).items() if name != "_runner"}  # each process makes its own

    @cached_property
    def _runner(self):
        """A function of theta that gives its response: what is the same for every theta is done once."""
        # sparse, as a dense product is BLAS's, whose last bit depends on its number of threads, so on the engine
        to_channels = csr_array(self._channel_matrix(self.outputs))
        fixed, end_of_law = self._fixed(), self.rubber.limit * self.rubber.scale

        def run(theta: np.ndarray) -> np.ndarray:
            values, _ = self._integrate(theta, fixed)
            largest = np.abs(fixed.kinematics @ values[:5]).max()
            if largest > end_of_law and self not in _WARNED:
                _WARNED.add(self)
                logger.warning(
                    "a bearing moved by %.1f mm, beyond the %.1f mm for which the rubber's law holds: it was continued "
                    "along its tangent, at %s; further ones are not told, see history(theta).beyond_range",
                    1e3 * largest,
                    1e3 * end_of_law,
                    dict(zip(self.parameters, theta.tolist(), strict=True)),
                )
            return to_channels @ self._drivers(values)[:, :: self.every]

        return run


def _check(m: IsolatedBridge) -> None:
    """ValueError for a bridge that cannot be run, before anything is run."""
    if not isinstance(m.record, Record):
        refuse("a Record of the table's acceleration", type(m.record).__name__, "read one with records.read_*")
    for name, kind in (("piers", Pier), ("bearings", Bearing), ("dampers", Damper)):
        pair = getattr(m, name)
        if not isinstance(pair, Sequence) or len(pair) != 2 or not all(isinstance(part, kind) for part in pair):
            refuse(f"two of {kind.__name__}(...) as {name}", pair, "one for each pier")
    if not isinstance(m.rubber, Rubber):
        refuse("Rubber(...) as rubber", m.rubber, "import it from this module")
    if m.bearings[0].gamma != m.bearings[1].gamma:
        refuse("one gamma for both bearings", [b.gamma for b in m.bearings], "it is a constant of the law")
    for name in ("deck_mass", "gravity", "step", "tolerance"):
        number(name, getattr(m, name))
    whole_number("max_iterations", m.max_iterations, 2, 10_000)
    whole_number("every", m.every, 1, max(1, m.record.n_steps - 1))
    if m.friction not in _FORMS:
        refuse(f"friction out of {tuple(_FORMS)}", m.friction, '"bouc-wen" is the default')
    ratio = m.record.dt / m.step
    if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        whole = m.record.dt / max(1, math.ceil(ratio))
        refuse(
            f"a step of integration that divides the record's {m.record.dt:.6g} s",
            m.step,
            f"take step={whole:.6g}, or Record.resample to a multiple of the step",
        )
    names = m.outputs
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or set(names) - set(_CHANNELS):
        refuse(f"outputs out of {tuple(_CHANNELS)}, or 5, 6 or 10", names, "see CHANNEL_SETS")
    if len(set(names)) != len(names):
        refuse("each output once", names, "leave the repeated one out")
    names = m.parameters
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or set(names) - set(PARAMETERS):
        refuse(f"parameters out of {PARAMETERS}", names, "see IsolatedBridge.nominal for their values")
    if len(set(names)) != len(names):
        refuse("each of the parameters once", names, "leave the repeated one out")
    zero = [name for name in names if m.nominal[name] == 0.0]
    if zero:
        refuse("non-zero nominal values to take multiples of", zero, "give them, or leave them out of parameters")
    if m.vertical is not None and (
        not isinstance(m.vertical, Record)
        or m.vertical.n_steps != m.record.n_steps
        or abs(m.vertical.dt - m.record.dt) > 1e-9 * m.record.dt
    ):
        refuse(
            f"a vertical Record of {m.record.n_steps} samples at {m.record.dt} s, as the horizontal one",
            m.vertical,
            "resample and trim the two alike",
        )
