"""Log-likelihood of natural frequencies and mode shapes, and the modes that samples of a posterior predict."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from ..cache.simulation_cache import TOLERANCE
from ..cache.verification import Simulated, difference_in_words
from ..likelihood.likelihood import FELikelihood
from ..likelihood.simulator import Simulator
from ..models.linear_structure import LinearStructure
from ..priors.points import as_points
from ..signals.channels import Measurements
from ..simulation.model import Model, SimulationBatch, SimulationFailed
from ..text_tables import text_table
from .modal_data import ModalData
from .modal_noise import modal_noise
from .mode_models import StructureModes
from .paired_modes import PairedModes, sensor_rows
from .temperature import ModesWithSlope

__all__ = ["ModalLikelihood", "PredictedModes"]

_PROBABILITIES = (np.arange(32) + 0.5) / 32  # of an error, for each sample


class ModalLikelihood(FELikelihood):
    """Log-likelihood of structural parameters, given natural frequencies and mode shapes.

    Modes are paired by their shapes at every point. Measured frequencies within 2 % of each other are compared by the
    plane of their shapes, and by their order in the pair. One number per frequency and per shape is cached for a
    simulation, so that all errors are served without another one. It is an `FELikelihood`: `Posterior`, all samplers,
    guides and `JointLikelihood` take it. The channels of its ``model`` are the measured modes.

    Parameters
    ----------
    model : Model, LinearStructure or Parts
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
        model = _with_modes(model)
        self._paired = PairedModes(model if data.temperatures is None else ModesWithSlope(model), data)
        noise = modal_noise(self._paired, (frequency_error, shape_error), student_t)
        self.held_out = held_out
        if held_out is not None:
            sensor_rows(model, held_out)  # refuses what cannot be predicted
        super().__init__(self._paired, self._paired.measurements, noise, pool, **options)

    def _make_simulator(self, model: PairedModes, measurements: Measurements, **options: Any) -> Simulator:
        return _ModesSimulator(model, **options)

    @property
    def model(self) -> PairedModes:
        """The model of the measured modes."""
        return self._paired

    @property
    def measurements(self) -> Measurements:
        """The data as measurements of the channels of the model."""
        return self._paired.measurements

    @property
    def measured(self) -> np.ndarray:
        """What responses are compared with (m, n_sets (1 + n_sensors))."""
        return self._paired.measurements.values

    def run(self, thetas: np.ndarray) -> tuple[np.ndarray, SimulationBatch]:
        """Statistics and responses of the paired modes at structural parameters, as `FELikelihood.run`."""
        statistics, batch = super().run(thetas)
        found = np.full((len(batch.reasons), *self.measured.shape), np.nan)
        for row in [row for row, reason in enumerate(batch.reasons) if not reason]:
            found[row] = self._paired.response(batch.response[row])
        return statistics, SimulationBatch(found, batch.reasons)

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
            known = np.zeros(1) if self.model.frequency_cv is None else self.model.frequency_cv
            squares = np.square(self.noise.standard_deviations(parameters)) - np.square(known)
            errors = np.sqrt(np.maximum(squares.mean(axis=1), 0.0))  # of the modes of the data, for any modes
        batch = self.simulator.simulate(rows)
        batch.response[:, 0] *= paired.factors(batch.response).mean(axis=1, keepdims=True)
        good = (batch.response[:, 0] > 0.0).all(axis=1)
        if not good.any():
            reason = batch.reasons[0] or "a frequency is not positive"
            raise SimulationFailed(f"none of {len(rows)} samples can be simulated; the first reason: {reason}")
        return PredictedModes.of(paired, batch.response[good], errors[good], self.noise.student)


class _ModesSimulator(Simulator):
    """Simulator of a model that has modes, compared as paired ones; the modes are kept, for predictions."""

    stores_responses = True

    def __init__(self, paired: PairedModes, **options: Any) -> None:
        modes = paired.model
        anything = Measurements(modes.channels, modes.dt, np.ones((len(modes.channels), modes.n_steps)))
        super().__init__(modes, anything, paired, **options)

    def _difference(self, earlier: np.ndarray, reason: str, new: Simulated) -> tuple[str, float]:
        measured, tolerance = self.statistic.measurements, TOLERANCE if self.cache is None else self.cache.tolerance
        names, norm = [each.name for each in measured.channels], np.linalg.norm(measured.values, axis=1)
        return difference_in_words(earlier, reason, new._replace(norm=norm), names, tolerance, False)


def _with_modes(model: Any) -> Model:
    """A model that has modes."""
    model = model.parts if isinstance(model, LinearStructure) else model
    return StructureModes(model) if hasattr(model, "assemble") else model


class PredictedModes(NamedTuple):
    """Modes of a model for n parameter samples, paired with m measured modes.

    Shapes have the scale and sign of the measured ones (of the first identification that has them).
    """

    paired: PairedModes  # the measured modes (``paired.data``), and the model
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
        return cls(paired, computed, frequencies, assurance, numbers, shapes, unknown, student)

    @property
    def data(self) -> ModalData:
        """The measured modes."""
        return self.paired.data

    def against(self, data: ModalData) -> "PredictedModes":
        """The same computed modes beside other measured ones; nothing is simulated."""
        paired = PairedModes(self.paired.model, data)
        return self.of(paired, self.computed, self.unknown, self.student)

    @property
    def errors(self) -> np.ndarray:
        """Known and unknown relative errors (n, m) of an identified frequency, together; scales if Student-t."""
        known = 0.0 if (stated := self.data.frequency_errors) is None else stated
        return np.hypot(self.unknown[:, None], known) * np.ones(self.data.n_modes)

    def interval(self, level: float = 0.9) -> np.ndarray:
        """Central intervals (2, m) of an identified frequency [Hz], with its errors."""
        errors = stdtrit(self.student, _PROBABILITIES) if self.student else ndtri(_PROBABILITIES)
        drawn = self.frequencies * (1.0 + self.errors * errors[:, None, None])
        return np.quantile(drawn, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=(0, 1))

    def rows(self) -> list[list[str]]:
        """The table as texts: number, measured frequency, median of the computed one, `interval`, median MAC."""
        rows, (low, high) = [["mode", "measured [Hz]", "computed [Hz]", "5 %", "95 %", "MAC"]], self.interval()
        for k, number in enumerate(self.data.mode_numbers):
            values = [self.data.mean_frequencies[k], np.median(self.frequencies[:, k]), low[k], high[k]]
            rows.append([str(number), *(f"{x:.4g}" for x in values), f"{np.median(self.assurance[:, k]):.3f}"])
        return rows

    def __str__(self) -> str:
        return text_table(self.rows())
