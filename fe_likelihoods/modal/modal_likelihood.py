"""Log-likelihood of natural frequencies and mode shapes, their errors, and the modes that samples predict."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from ..likelihood.likelihood import FELikelihood
from ..likelihood.simulator import Simulator
from ..models.linear_structure import LinearStructure
from ..noise.student import check_degrees, student_constant
from ..priors.points import as_points
from ..priors.truncated_normal_integrals import HALF_LOG_TWO_PI
from ..signals.channels import Measurements
from ..simulation.model import Model, SimulationBatch, SimulationFailed
from ..text_tables import text_table
from .modal_data import ModalData
from .mode_models import StructureModes
from .pairing import ModesWithSlope, PairedModes

_LEAST_ERRORS = 1e-4, 1e-3  # of frequencies and shapes, known where no error is stated

_PROBABILITIES = (np.arange(32) + 0.5) / 32  # of an error, for each sample


class ModalLikelihood(FELikelihood):
    """Log-likelihood of structural parameters, given natural frequencies and mode shapes.

    Modes are paired by their shapes at every point. Measured frequencies within 2 % of each other are compared by the
    plane of their shapes, and by their order in the pair. One number per frequency and per shape is cached for a
    simulation, so that all errors are served without another one. It is an `FELikelihood`: `Posterior`, all samplers,
    guides and `JointLikelihood` take it. The channels of its ``model`` are the measured modes.

    Parameters
    ----------
    model : Model, LinearStructure or Structure
        A model that has modes and the sensors of the data: a `FunctionModes`; any model whose channels are
        `modal_channels`, such as an `OpenSeesModel`; or a linear structure, such as a `ShearFrame`.
    data : ModalData
        The measured modes.
    frequency_error, shape_error : {"common", "mode"}, optional
        What is unknown: one error of all modes, the parameters ``frequency_error`` and ``shape_error``; or one of each
        mode, ``frequency_error_1``, ... Its variance is added to the known one of the data. Default: nothing if the
        data have known errors, else ``"common"``.
    student_t : float, optional
        Degrees of freedom, above 2, of Student-t errors, such as 4, of which errors are the scales: wrong
        identifications move the parameters little. Default: Gaussian errors.
    held_out : ModalData, optional
        Measured modes that are not compared, but that reports show beside the predicted ones.
    pool, **options
        Of `FELikelihood`, such as ``cache``.

    Raises
    ------
    ValueError
        If the model has no modes, other sensors or fewer modes, an error is not as above, or as `FELikelihood`.

    Examples
    --------
    >>> identified = ModalData([2.9, 7.8], [[0.62, 1.0], [-1.0, 0.62]], ["floor 1", "roof"],
    ...                        frequency_cv=0.005, shape_error=0.02)
    >>> modal = ModalLikelihood(frame, identified)
    >>> calibrated = Posterior(modal, {name: LogNormal(1.0, 0.2) for name in modal.parameter_names})
    >>> calibrated.parameter_names
    ['stiffness_1', 'stiffness_2']
    """

    is_modal = True

    def __init__(
        self,
        model: Model | Any,
        data: ModalData,
        frequency_error: str | None = None,
        shape_error: str | None = None,
        pool: Any = None,
        *,
        student_t: float | None = None,
        held_out: ModalData | None = None,
        **options: Any,
    ) -> None:
        if not isinstance(data, ModalData):
            raise ValueError(f"ModalLikelihood: expected ModalData; got {type(data).__name__}")
        model = model.structure if isinstance(model, LinearStructure) else model
        model = StructureModes(model) if hasattr(model, "assemble") else model
        self._paired = PairedModes(model if data.temperatures is None else ModesWithSlope(model), data)
        noise = ModalNoise(self._paired, (frequency_error, shape_error), student_t)
        self.held_out = held_out
        if held_out is not None:
            PairedModes(model, held_out)  # refuses what cannot be predicted
        super().__init__(self._paired, self._paired.measurements, noise, pool, **options)

    def _make_simulator(self, model: PairedModes, measurements: Measurements, **options: Any) -> Simulator:
        return _ModesSimulator(model, **options)

    @property
    def model(self) -> PairedModes:
        """The model of the measured modes."""
        return self._paired

    @property
    def measured(self) -> np.ndarray:
        """What responses are compared with (m, n_sets (1 + n_sensors))."""
        return self._paired.measurements.values

    def run(self, thetas: np.ndarray) -> tuple[np.ndarray, SimulationBatch]:
        """Statistics and responses of the paired modes at structural parameters, as `FELikelihood.run`."""
        statistics, batch = super().run(thetas)
        failed = np.full(self.measured.shape, np.nan)
        each = zip(*batch, strict=True)
        found = [failed if reason else self._paired.response(modes) for modes, reason in each]
        return statistics, SimulationBatch(np.reshape(found, (-1, *failed.shape)), batch.reasons)

    def predict_modes(self, samples: Any, data: ModalData | None = None, most: int = 400) -> "PredictedModes":
        """Modes that samples of a posterior predict, beside measured ones, which may be others than the data.

        `samples` (n, n_parameters), or a mapping of names to samples, have the structural parameters; the parameters of
        the errors may follow, and enter the intervals. At most `most` samples are taken, evenly spaced among all, and
        simulated where their modes are not cached. Raises ValueError for samples of another shape, or data with other
        sensors or more modes than the model, and SimulationFailed if no sample can be simulated.

        Examples
        --------
        >>> shapes, sensors = [[0.62, 1.0], [-1.0, 0.62]], ["floor 1", "roof"]
        >>> modal = ModalLikelihood(frame, ModalData([2.9, 7.8], shapes, sensors, frequency_cv=0.005, shape_error=0.02))
        >>> draws = np.random.default_rng(1).lognormal(0.0, 0.2, size=(100, 2))
        >>> print(modal.predict_modes(draws))
        mode  measured [Hz]  computed [Hz] ...
        """
        paired = self.model if data is None else PairedModes(self.model.model, data)
        names = paired.parameter_names
        short = isinstance(samples, Mapping) or np.shape(samples)[-1:] == (len(names),)
        rows = np.atleast_2d(as_points(samples, names if short else self.parameter_names))
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]
        rows, parameters, errors = rows[:, : len(names)], rows[:, len(names) :], np.zeros(len(rows))
        if parameters.shape[1] == len(self.noise.parameter_names):
            known = 0.0 if self.model.frequency_cv is None else self.model.frequency_cv
            squares = np.square(self.noise.standard_deviations(parameters)) - np.square(known)
            errors = np.sqrt(np.maximum(squares.mean(axis=1), 0.0))  # of the modes of the data, for any modes
        batch = self.simulator.run(rows, full=True)[1]
        batch.response[:, 0] *= paired.factors(batch.response).mean(axis=1, keepdims=True)
        good = (batch.response[:, 0] > 0.0).all(axis=1)
        if not good.any():
            reason = batch.reasons[0] or "a frequency is not positive"
            raise SimulationFailed(f"none of {len(rows)} samples can be simulated; the first reason: {reason}")
        return PredictedModes.of(paired, batch.response[good], errors[good], self.noise.student)


class ModalNoise:
    """Errors of m modes, known, unknown or both, with a `Noise`'s members (``docs/theory/modes.rst``).

    Known errors (2, m), and degrees of freedom `counts` (2, m, n_sets), are of frequencies and of shapes. What is
    `unknown` of them is an error ``"common"`` to all modes, one for each (``"mode"``), or None: nothing beside known
    ones. Where none is known, it is 1e-4 for frequencies, and 1e-3 for shapes, because digits and temperature leave no
    identification more exact: a few frequencies that the parameters can fit exactly would give a spike of any height to
    an error of zero. `student` are the degrees of freedom of Student-t errors, 0 for Gaussian ones.
    """

    shares_of = None  # the errors do not depend on the response

    def __init__(self, paired: PairedModes, unknown: tuple[Any, Any], student_t: float | None) -> None:
        data, stated = paired.data, (paired.frequency_cv, paired.data.shape_error)
        if data.covariance is not None and (unknown[0] is not None or student_t is not None):
            raise ValueError(
                "ModalLikelihood: beside a covariance of the frequencies, neither an unknown frequency_error nor "
                "student_t is possible: leave it out, or give the data frequency_cv and no covariance"
            )
        if wrong := [each for each in unknown if each not in (None, "common", "mode")]:
            raise ValueError(
                f'ModalLikelihood: frequency_error and shape_error must be "common" or "mode"; got {wrong[0]!r}: known '
                "errors belong to the data (frequency_cv, shape_error), or are numbers in the mapping of priors"
            )
        freedoms = data.has_shape.T * data.n_sensors
        for group in map(list, paired.groups):  # what is fitted: a scale, or a place in the plane of close modes
            freedoms[group] = np.maximum(freedoms[group] - len(group), 0)
        self.counts = np.stack([~np.isnan(data.frequencies).T, freedoms])
        self.known, names, places = np.zeros((2, data.n_modes)), [], []  # of unknown errors, and where each is added
        modes = [(f"_{number}", place) for place, number in enumerate(data.mode_numbers)]
        for k, what in enumerate(("frequency_error", "shape_error")):
            self.known[k] = _LEAST_ERRORS[k] if stated[k] is None else stated[k]
            kind = unknown[k] or ("common" if stated[k] is None else "")
            ends = {"common": [("", slice(None))], "mode": modes}.get(kind, []) if self.counts[k].any() else []
            for end, place in ends:
                names.append(what + end)
                places.append(np.zeros((2, data.n_modes)))
                places[-1][k, place] = 1.0
        self.parameter_names, self._places = tuple(names), np.reshape(places, (-1, 2, data.n_modes))
        self.channels, self.n_sets, self.statistic = paired.channels, data.n_sets, paired.sums
        self.student, self.title = 0.0, "errors of natural frequencies and mode shapes"
        if student_t is not None:
            self.student = check_degrees("ModalLikelihood: student_t", student_t)
            self.title += f", Student-t with {self.student:g} degrees of freedom"

    def __repr__(self) -> str:
        return f"ModalNoise({self.parameter_names}, {self.known.tolist()}, {self.counts.tolist()}, {self.student})"

    def deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, 2, m) of frequencies and of components of shapes, at parameters (n, n_noise)."""
        # an unknown error that is not positive is impossible, also beside a known one
        variances = np.square(np.where(parameters > 0.0, parameters, np.nan))
        return np.sqrt(np.square(self.known) + np.tensordot(variances, self._places, 1))

    def log_likelihood(self, statistics: np.ndarray, n_samples: Any, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) for the statistics (n, m + 2 m n_sets); -inf for impossible errors."""
        d, spread = self.counts, self.deviations(parameters)[..., None]
        squares = statistics[:, len(self.channels) :].reshape(len(statistics), *d.shape)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ratios = squares / np.square(spread)
            if self.student:
                logs = 0.5 * (self.student + d) * np.log1p(ratios / self.student) - student_constant(self.student, d)
            else:
                logs = 0.5 * ratios + d * HALF_LOG_TWO_PI
            total = -np.where(d > 0, d * np.log(spread) + logs, 0.0).sum(axis=(1, 2, 3))
        return np.where(np.isnan(total) | (total == np.inf), -np.inf, total)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, m) of the frequencies, as shares."""
        return self.deviations(parameters)[:, 0]

    def response_deviations(self, parameters: np.ndarray, response: np.ndarray, dt: Any = None) -> np.ndarray:
        """Standard deviations of all samples (m, n_sets (1 + n_sensors)); zero where nothing was measured."""
        (deviations,), n = self.deviations(np.atleast_2d(parameters)), response.shape[1] // self.n_sets
        return np.tile(np.repeat(deviations.T, [1, n - 1], axis=1), self.n_sets) * (np.asarray(response) != 0.0)


class _ModesSimulator(Simulator):
    """Simulator of a model that has modes, compared as paired ones; the modes are kept, for predictions."""

    stores_responses = True

    def __init__(self, paired: PairedModes, **options: Any) -> None:
        modes = paired.model
        anything = Measurements(modes.channels, modes.dt, np.ones((len(modes.channels), modes.n_steps)))
        super().__init__(modes, anything, paired, **options)
        self.measurements, self._of_response = paired.measurements, False

    def _difference(self, earlier: np.ndarray, reason: str, now: np.ndarray, why: str, _: Any) -> str:
        return super()._difference(earlier, reason, now, why, np.linalg.norm(self.measurements.values, axis=1))


class PredictedModes(NamedTuple):
    """Modes of a model for n parameter samples, paired with m measured modes.

    Shapes have the scale and sign of the measured ones (of the first identification that has them).
    """

    model: Model  # of the modes
    data: ModalData  # the measured modes
    computed: np.ndarray  # (n, 1 + n_sensors, n_modes) all computed modes: frequencies [Hz], and shapes
    frequencies: np.ndarray  # (n, m) computed frequencies of the measured modes [Hz]
    assurance: np.ndarray  # (n, m) modal assurance criterion; NaN for modes without a measured shape
    numbers: np.ndarray  # (n, m) numbers of the computed modes, from 1
    shapes: np.ndarray  # (n, m, n_sensors)
    unknown: np.ndarray  # (n,) unknown relative error of a frequency, as of the model; 0 if there is none
    student: float  # degrees of freedom of Student-t errors; 0 for Gaussian ones

    @classmethod
    def of(cls, paired: PairedModes, computed: np.ndarray, unknown: Any, student: float) -> "PredictedModes":
        """Pair computed modes (n, 1 + n_sensors, n_modes) with the measured ones; ValueError if n is zero."""
        found, first = [paired.pair(modes) for modes in computed], paired.data.has_shape.argmax(axis=0)
        frequencies, assurance = (np.stack([getattr(each, x) for each in found]) for x in ("frequencies", "assurance"))
        numbers = np.stack([each.columns for each in found]) + 1
        shapes = np.stack([each.shapes[first, np.arange(len(first))] for each in found])
        unknown = np.broadcast_to(unknown, len(found))
        return cls(paired.model, paired.data, computed, frequencies, assurance, numbers, shapes, unknown, student)

    def against(self, data: ModalData) -> "PredictedModes":
        """The same computed modes beside other measured ones; nothing is simulated."""
        return self.of(PairedModes(self.model, data), self.computed, self.unknown, self.student)

    def interval(self, probability: float = 0.9) -> np.ndarray:
        """Central intervals (2, m) of an identified frequency [Hz], with its known and unknown errors."""
        known = 0.0 if self.data.frequency_errors is None else self.data.frequency_errors
        errors = stdtrit(self.student, _PROBABILITIES) if self.student else ndtri(_PROBABILITIES)
        drawn = self.frequencies * (1.0 + np.hypot(self.unknown[:, None], known) * errors[:, None, None])
        return np.quantile(drawn, [0.5 - 0.5 * probability, 0.5 + 0.5 * probability], axis=(0, 1))

    def rows(self) -> list[list[str]]:
        """The table as texts: number, measured frequency, median of the computed one, `interval`, median MAC, pairs."""
        rows, (low, high) = [["mode", "measured [Hz]", "computed [Hz]", "5 %", "95 %", "MAC", "pair"]], self.interval()
        for k, number in enumerate(self.data.mode_numbers):
            values = [self.data.mean_frequencies[k], np.median(self.frequencies[:, k]), low[k], high[k]]
            pairs = " or ".join(map(str, np.unique(self.numbers[:, k])))  # several: the pairing changes
            assurance = f"{np.median(self.assurance[:, k]):.3f}".replace("nan", "-")  # of a mode without a shape
            rows.append([str(number), *(f"{x:.4g}" for x in values), assurance, pairs])
        return rows

    def __str__(self) -> str:
        return text_table(self.rows())
