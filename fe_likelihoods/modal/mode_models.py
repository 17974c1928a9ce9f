"""Models that have modes.

A model that has modes is an ordinary model: its first channel is the natural frequency, each other channel is a sensor,
and its samples are modes instead of times. The response (1 + n_sensors, n_modes) of every kind of model, a function, an
OpenSees script or a program, can therefore be modes.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..models.base import digest
from ..models.frames_and_decks import Structure
from ..models.function import FunctionModel
from ..models.undamped_modes import mode_derivatives, undamped_modes
from ..models.user_model import ExternalModel
from ..models.validation import check_theta
from ..signals.channels import Channel
from ..simulation.model import SimulationFailed

ABSENT = 1e12  # [Hz], from here on modes that a structure does not have, whose shapes are zero
_DAMPING = 0.05  # of a structure whose undamped modes are computed: without effect
_STEP = 1e-4  # for central differences of matrices, as a share of a parameter


def modal_channels(sensors: Sequence[str]) -> tuple[Channel, ...]:
    """Channels of a model that has modes: ``frequency`` [Hz], and the component of the shapes at each sensor."""
    return Channel("frequency", "frequency", "Hz"), *(Channel(name, "dimensionless", "1") for name in sensors)


def modal_response(frequencies: Any, shapes: Any, n_modes: int | None = None) -> np.ndarray:
    """Response (1 + n_sensors, n_modes) of a model that has modes.

    Of natural frequencies (n,) [Hz] and mode shapes (n, n_sensors) in any scale, the lowest `n_modes` are kept; if
    there are fewer, frequencies from `ABSENT` on stand for the others. Raises SimulationFailed if a frequency is not
    positive, or the numbers of rows and frequencies differ.

    Examples
    --------
    >>> from fe_likelihoods.modal.mode_models import modal_response
    >>> modal_response([2.9, 7.8], [[0.62, 1.0], [-1.0, 0.62]])  # frequencies, then a row for each sensor
    array([[ 2.9 ,  7.8 ],
           [ 0.62, -1.  ],
           [ 1.  ,  0.62]])
    """
    frequencies, shapes = np.asarray(frequencies, dtype=float), np.asarray(shapes)
    if frequencies.ndim != 1 or shapes.ndim != 2 or len(shapes) != len(frequencies):
        raise SimulationFailed(
            f"expected frequencies (n,) and shapes (n, n_sensors), a row for each mode; got {frequencies.shape} and "
            f"{shapes.shape}: transpose the shapes if their columns are modes"
        )
    if not (frequencies > 0.0).all():
        raise SimulationFailed(f"natural frequencies must be positive; they are {frequencies} Hz")
    order = np.argsort(frequencies, kind="stable")[:n_modes]
    absent = np.zeros((1 + shapes.shape[1], max((n_modes or 0) - len(order), 0)))
    absent[0] = ABSENT * 2.0 ** np.arange(absent.shape[1])
    return np.hstack([np.vstack([frequencies[order], shapes[order].T]), absent])


def opensees_modes(ops: Any, n_modes: int, sensors: Sequence[tuple[int, int]]) -> np.ndarray:
    """Modes of the present OpenSees model as the response (1 + n_sensors, n_modes) of a model that has modes.

    `ops` is ``openseespy.opensees``, as an `OpenSeesModel` passes it; `n_modes` is less than the number of degrees of
    freedom that have a mass; `sensors` are nodes and degrees of freedom in the order of the channels. Raises
    SimulationFailed if an eigenvalue is not positive. (An example is in ``docs/modes.rst``.)
    """
    squares = np.array(ops.eigen(n_modes) or [], dtype=float)
    if len(squares) != n_modes or not (squares > 0.0).all():
        raise SimulationFailed(
            f"ops.eigen({n_modes}) returned the eigenvalues {squares.tolist()}, expected {n_modes} positive ones: is "
            "the structure supported, and do more degrees of freedom than modes have a mass?"
        )
    shapes = [[ops.nodeEigenvector(node, mode, dof) for node, dof in sensors] for mode in range(1, n_modes + 1)]
    return modal_response(np.sqrt(squares) / (2.0 * np.pi), np.reshape(shapes, (n_modes, len(sensors))))


class FunctionModes(FunctionModel):
    """Python function as a model that has modes.

    Parameters
    ----------
    function : callable
        Of theta (n_parameters,). It returns the stiffness and the mass matrix (NumPy arrays or SciPy sparse matrices,
        in N/m and kg), or frequencies (n,) [Hz] and shapes (n, n_sensors), a row for each mode.
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    sensors : mapping of str to int, or sequence of str
        Names of the sensors. For matrices, with the row of the matrix, from 0, that each sensor measures.
    n_modes : int
        Number of modes that are computed, if there are as many: twice the measured ones, to pass over local modes.
    **options
        Of `FunctionModel`: ``version``, ``depends_on``, ``isolated``, ``time_limit``.

    Examples
    --------
    >>> def stiffness_and_mass(theta):
    ...     k1, k2 = theta
    ...     return np.array([[k1 + k2, -k2], [-k2, k2]]), np.eye(2)
    >>> modes = FunctionModes(stiffness_and_mass, ["k1", "k2"], {"floor 1": 0, "floor 2": 1}, n_modes=2)
    >>> modes.simulate([900.0, 900.0]).shape
    (3, 2)
    """

    def __init__(
        self,
        function: Callable[..., Any],
        parameter_names: Sequence[str],
        sensors: Mapping[str, int] | Sequence[str],
        n_modes: int = 10,
        **options: Any,
    ) -> None:
        self.rows = [int(row) for row in sensors.values()] if isinstance(sensors, Mapping) else None
        super().__init__(function, parameter_names, modal_channels(tuple(sensors)), 1.0, n_modes, **options)
        self.fingerprint = digest(self.fingerprint, repr(self.rows))

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        returned = super()._respond(theta)
        if not isinstance(returned, tuple | list) or len(returned) != 2:
            raise SimulationFailed(
                "expected the function to return (stiffness, mass) or (frequencies, shapes); got "
                f"{type(returned).__name__}"
            )
        if np.ndim(returned[0]) == 1:
            return modal_response(*returned, self.n_steps)
        if self.rows is None:
            raise SimulationFailed("the function returns matrices: give sensors as a mapping of names to rows of these")
        mass = returned[1] if hasattr(returned[1], "diagonal") else np.array(returned[1])
        modes = undamped_modes(*returned, max(1, min(self.n_steps, np.count_nonzero(mass.diagonal()))))
        return modal_response(modes.frequencies, modes.shapes[:, self.rows], self.n_steps)


class StructureModes(ExternalModel):
    """All modes of a linear structure of this library, such as a `ShearFrame`, as a model with derivatives.

    Its parameters are the structure's except dampings, which the undamped modes do not depend on. Its sensors
    are the channels of the structure.
    """

    path_dependent = False

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        names = self.parameter_names = tuple(x for x in structure.parameter_names if not x.startswith("damping"))
        size = len(self._system(np.linspace(0.5, 1.0, len(names))).mass)  # ascending, as frequencies must
        super().__init__(names, modal_channels(structure.channel_names), 1.0, size)
        self.fingerprint = self._digest(repr(structure))

    def _system(self, theta: np.ndarray) -> Any:
        given = dict(zip(self.parameter_names, theta, strict=True))
        return self.structure.assemble(np.array([given.get(name, _DAMPING) for name in self.structure.parameter_names]))

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        system = self._system(theta)
        modes = undamped_modes(system.stiffness, system.mass)
        return modal_response(modes.frequencies, modes.shapes @ system.shape.T)

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Derivatives (n_parameters, 1 + n_sensors, n_modes) of the response, exact but for differences of matrices."""
        theta = check_theta(theta, self.parameter_names)
        system, steps = self._system(theta), _STEP * np.where(theta == 0.0, 1.0, np.abs(theta))
        ends = [(self._system(theta + step), self._system(theta - step)) for step in np.diag(steps)]

        def slopes_of(what: str) -> np.ndarray:
            return np.stack([getattr(up, what) - getattr(down, what) for up, down in ends]) / (
                2.0 * steps[:, None, None]
            )

        modes = undamped_modes(system.stiffness, system.mass)
        slopes = mode_derivatives(modes, slopes_of("stiffness"), slopes_of("mass"))
        shapes = slopes.shapes @ system.shape.T + modes.shapes @ slopes_of("shape").transpose(0, 2, 1)
        return np.concatenate([slopes.frequencies[:, None, :], shapes.transpose(0, 2, 1)], axis=1)
