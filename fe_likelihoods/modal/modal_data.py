"""Identified natural frequencies and mode shapes as data."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..models.base import digest
from ..signals.sampling import array_digest
from ..text_tables import text_table
from .pairing import close_groups

__all__ = ["ModalData", "real_shapes"]

_LARGEST_SHARE = 0.5  # above it, an error was given in percent or in hertz


@dataclass(frozen=True, eq=False, repr=False)
class ModalData:
    """Natural frequencies and mode shapes that were identified once or several times.

    Parameters
    ----------
    frequencies : (m,) or (n_sets, m) array_like
        Natural frequencies of m modes [Hz], of one or several identifications. NaN: one of several missed the mode.
    shapes : (m, n_sensors) or (n_sets, m, n_sensors) array_like, optional
        Mode shapes, a row for each mode. Scale and sign are arbitrary; the attribute has a norm of 1, and a dimension
        n_sets as all attributes. A row of NaN: no shape for this mode.
    sensors : sequence of str
        Names of the sensors, in the order of the components of a shape. The model has sensors of these names.
    damping : (m,) or (n_sets, m) array_like, optional
        Damping ratios. They are kept and shown, but not compared with a model.
    frequency_cv : float or (m,) array_like, optional
        Known coefficients of variation of the frequencies, for example 0.005.
    covariance : (m, m) array_like, optional
        Known covariance of the frequencies of one identification [Hz²], instead of `frequency_cv`.
    shape_error : float or (m,) array_like, optional
        Known standard deviation of a component of a shape with a norm of 1, for example 0.02.
    temperatures : float or (n_sets,) array_like, optional
        Temperature of the structure in each identification [°C]. The likelihood then has a parameter
        ``temperature_slope`` [1/K], the relative change of all frequencies; the model has those at 20 °C.
    mode_numbers : sequence of int, optional
        Numbers of the modes, used as names and to find the computed modes without a measured shape. Default: 1 to m.
    description : str
        What was measured, where and when.

    Raises
    ------
    ValueError
        If a number is impossible, shapes and sensors do not fit, shapes are complex (`real_shapes`), some but not all
        components of a shape are missing, or the covariance is not positive definite.

    Examples
    --------
    >>> identified = ModalData([2.9, 7.8], [[0.62, 1.0], [-1.0, 0.62]], ["floor 1", "roof"],
    ...                        frequency_cv=0.005, shape_error=0.02)
    >>> identified.shapes.shape  # identifications, modes, sensors
    (1, 2, 2)
    """

    frequencies: Any
    shapes: Any = None
    sensors: Sequence[str] = ()
    _: KW_ONLY
    damping: Any = None
    frequency_cv: Any = None
    covariance: Any = None
    shape_error: Any = None
    temperatures: Any = None
    mode_numbers: Sequence[int] | None = None
    description: str = ""

    def __post_init__(self) -> None:
        frequencies = _numbers("frequencies", self.frequencies, (1, 2))
        n_sets, m = frequencies.shape
        known = ~np.isnan(frequencies)
        if not (frequencies[known] > 0.0).all() or np.isinf(frequencies).any() or not known.any(axis=0).all():
            raise ValueError(
                "ModalData: frequencies must be positive numbers [Hz], or NaN where one of several identifications "
                f"missed the mode; got {self.frequencies}: leave out modes that were never identified"
            )
        numbers = tuple(range(1, m + 1)) if self.mode_numbers is None else tuple(self.mode_numbers)
        whole = all(isinstance(number, int | np.integer) and number > 0 for number in numbers)
        if len(numbers) != m or len(set(numbers)) != m or not whole:
            raise ValueError(f"ModalData: mode_numbers must be {m} different whole numbers from 1 on; got {numbers}")
        damping = None if self.damping is None else _numbers("damping", self.damping, (1, 2), (n_sets, m))
        if damping is not None and not ((damping >= 0.0) & (damping < 1.0) | np.isnan(damping)).all():
            raise ValueError(
                f"ModalData: damping ratios must be from 0 to below 1, such as 0.015 for 1.5 %, or NaN; got "
                f"{damping.tolist()}: in a file, state the unit, damping_%"
            )
        sensors = (self.sensors,) if isinstance(self.sensors, str) else tuple(self.sensors)
        if len(set(sensors)) != len(sensors) or not all(isinstance(name, str) and name for name in sensors):
            raise ValueError(f"ModalData: the names of the sensors must differ and not be empty; got {sensors}")
        values = {
            "frequencies": frequencies,
            "shapes": _checked_shapes(self.shapes, n_sets, m, sensors, known),
            "sensors": sensors,
            "damping": damping,
            "frequency_cv": _share("frequency_cv", self.frequency_cv, m, "0.005 for 0.5 %"),
            "covariance": self._checked_covariance(frequencies),
            "shape_error": _share("shape_error", self.shape_error, m, "0.02, for shapes with a norm of 1"),
            "temperatures": _temperatures(self.temperatures, n_sets),
            "mode_numbers": tuple(int(number) for number in numbers),
        }
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)
        order = np.argsort(self.mode_numbers)
        unsorted = (np.diff(self.mean_frequencies[order]) < 0.0).any()
        if unsorted and not self.has_shape.any(axis=0).all():
            raise ValueError(
                f"ModalData: modes without a shape are found by their number, so frequencies must ascend; got "
                f"{self.mean_frequencies.tolist()} Hz of the modes {self.mode_numbers}: sort them, or give mode_numbers"
            )

    def _checked_covariance(self, frequencies: np.ndarray) -> np.ndarray | None:
        """The covariance of the frequencies [Hz²]; ValueError if it is none."""
        if self.covariance is None:
            return None
        if self.frequency_cv is not None or np.isnan(frequencies).any():
            raise ValueError(
                "ModalData: covariance and frequency_cv state the same errors: leave one out (frequency_cv=None, "
                "where a file has them); a covariance is for modes that were never missed"
            )
        m = frequencies.shape[1]
        try:
            covariance = np.array(self.covariance, dtype=float)
            largest = np.sqrt(covariance.diagonal()) / frequencies.mean(axis=0)
            symmetric = covariance.shape == (m, m) and np.allclose(covariance, covariance.T, rtol=1e-8, atol=0.0)
            fits = symmetric and np.linalg.eigvalsh(covariance)[0] > 0.0 and largest.max() < _LARGEST_SHARE
        except ValueError:  # rows of different lengths
            fits = False
        if not fits:
            raise ValueError(
                f"ModalData: covariance must be a symmetric positive definite matrix ({m}, {m}) [Hz²], with standard "
                f"deviations below {_LARGEST_SHARE} of the frequencies; got {self.covariance}: take the variances "
                "alone (frequency_cv) if the covariances are poorly known"
            )
        return covariance

    @property
    def n_sets(self) -> int:
        return len(self.frequencies)

    @property
    def n_modes(self) -> int:
        return self.frequencies.shape[1]

    @property
    def n_sensors(self) -> int:
        return len(self.sensors)

    @cached_property
    def mean_frequencies(self) -> np.ndarray:
        """Mean frequency of each mode (m,) [Hz]."""
        return np.nanmean(self.frequencies, axis=0)

    @cached_property
    def has_shape(self) -> np.ndarray:
        """Whether each identification (n_sets, m) has a shape of each mode."""
        return ~np.isnan(self.shapes).any(axis=2) & (self.n_sensors > 0)

    @cached_property
    def known_shapes(self) -> np.ndarray:
        """Shapes (n_sets, m, n_sensors), zero where there is none."""
        return np.where(self.has_shape[:, :, None], self.shapes, 0.0)

    @property
    def fingerprint(self) -> str:
        """Hex digest of frequencies, shapes, sensors and mode numbers: what simulations are compared with."""
        values = [np.where(np.isnan(each), np.nan, each) for each in (self.frequencies, self.shapes)]  # one NaN
        return digest(repr([self.sensors, self.mode_numbers]), array_digest(*values))

    def groups(self, close: float) -> tuple[tuple[int, ...], ...]:
        """Modes whose frequencies are within a ratio of 1 + `close`, as groups.

        Modes without a shape, and groups whose plane would take up all sensors, are single.
        """
        shaped = np.flatnonzero(self.has_shape.any(axis=0))
        groups = [(mode,) for mode in range(self.n_modes) if mode not in shaped]
        for group in close_groups(self.mean_frequencies[shaped], close) if len(shaped) else ():
            modes = tuple(int(shaped[each]) for each in group)
            groups += [modes] if len(modes) < self.n_sensors else [(mode,) for mode in modes]
        return tuple(groups)

    def select(self, mode_numbers: Sequence[int]) -> "ModalData":
        """Return the modes with these numbers; ValueError for an unknown one."""
        if unknown := [number for number in mode_numbers if number not in self.mode_numbers]:
            raise ValueError(f"ModalData has no modes {unknown}; the modes are {self.mode_numbers}")
        rows = [self.mode_numbers.index(number) for number in mode_numbers]
        per_mode = {
            name: None if (value := getattr(self, name)) is None else value[..., rows]
            for name in ("frequencies", "damping", "frequency_cv", "shape_error")
        }
        covariance = None if self.covariance is None else self.covariance[np.ix_(rows, rows)]
        shapes, numbers = self.shapes[:, rows], tuple(mode_numbers)
        return replace(self, **per_mode, covariance=covariance, shapes=shapes, mode_numbers=numbers)

    def at(self, sensors: Sequence[str]) -> "ModalData":
        """Return the shapes at some of the sensors; ValueError for an unknown one."""
        if unknown := [name for name in sensors if name not in self.sensors]:
            raise ValueError(
                f"ModalData has no sensors {', '.join(unknown)}; the sensors are {', '.join(self.sensors)}"
            )
        columns = [self.sensors.index(name) for name in sensors]
        return replace(self, shapes=self.shapes[:, :, columns], sensors=tuple(sensors))

    def mean(self) -> "ModalData":
        """Return the mean of several identifications, with their scatter as the errors `frequency_cv`, `shape_error`.

        The scatter is not divided by the square root of the number of identifications: what they have in common, such
        as the temperature of the day, does not average out. ValueError for modes that were identified only once.
        """
        counts = (~np.isnan(self.frequencies)).sum(axis=0)
        if (counts < 2).any():
            few = [number for number, count in zip(self.mode_numbers, counts, strict=True) if count < 2]
            raise ValueError(f"ModalData.mean: the scatter needs two identifications or more; the modes {few} have one")
        frequencies, there = self.mean_frequencies, self.has_shape
        shapes = np.full(self.shapes.shape[1:], np.nan)
        errors = np.zeros(self.n_modes)
        for mode in range(self.n_modes):
            if len(found := self.shapes[there[:, mode], mode]):
                shapes[mode] = np.linalg.svd(found, full_matrices=False)[2][0]
                squares = np.maximum(1.0 - np.square(found @ shapes[mode]), 0.0).sum()
                errors[mode] = np.sqrt(squares / (max(len(found) - 1, 1) * max(self.n_sensors - 1, 1)))
        return replace(
            self,
            frequencies=frequencies,
            shapes=shapes,
            damping=None if self.damping is None else np.nanmean(self.damping, axis=0),
            frequency_cv=np.nanstd(self.frequencies, axis=0, ddof=1) / frequencies,
            covariance=None,
            temperatures=None if self.temperatures is None else self.temperatures.mean(),
            shape_error=errors if (errors > 0.0).all() else self.shape_error,
        )

    def __repr__(self) -> str:
        rows = [
            [
                str(number),
                f"{self.mean_frequencies[mode]:.4g}",
                *([] if self.damping is None else [f"{100.0 * np.nanmean(self.damping[:, mode]):.2g} %"]),
                *(f"{value:.3f}" for value in self.shapes[int(self.has_shape[:, mode].argmax()), mode]),
            ]
            for mode, number in enumerate(self.mode_numbers)
        ]
        damping = [] if self.damping is None else ["damping"]
        what = f"modes {self.n_modes}, sensors {self.n_sensors}, identifications {self.n_sets}"
        return f"ModalData: {what}\n" + text_table([["mode", "f [Hz]", *damping, *self.sensors], *rows])


def real_shapes(shapes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Real parts of complex mode shapes (..., n_sensors) after a rotation by their mean phases, and their scatter.

    A shape of proportional damping is real up to a factor. The rotation makes the real part as large as possible. The
    tangent of the scatter (...,) [deg] is the norm of the imaginary parts that are left over the norm of the real
    parts: below about 10 degrees, little is lost.

    Examples
    --------
    >>> from fe_likelihoods.modal.modal_data import real_shapes
    >>> shapes, phases = real_shapes([[1.0 + 0.1j, 2.0 + 0.2j]])
    >>> (shapes / shapes[0, 0]).round(2)
    array([[1., 2.]])
    """
    shapes = np.asarray(shapes, dtype=complex)
    turned = shapes * np.exp(-0.5j * np.angle(np.square(shapes).sum(axis=-1, keepdims=True)))
    left = np.linalg.norm(turned.imag, axis=-1), np.linalg.norm(turned.real, axis=-1)
    return turned.real, np.degrees(np.arctan2(*left))


def _numbers(what: str, given: Any, dims: tuple[int, ...], shape: tuple[int, int] | None = None) -> np.ndarray:
    """Numbers (n_sets, m) that were given for one identification or several."""
    try:
        values = np.array(given)
        values = values.astype(float) if not np.iscomplexobj(values) else None
    except (TypeError, ValueError):
        values = None
    if values is None or values.ndim not in dims or not values.size or shape not in (None, np.atleast_2d(values).shape):
        expected = "(m,) or (n_sets, m)" if shape is None else f"{shape[1:]} or {shape}"
        raise ValueError(f"ModalData: {what} must be real numbers of shape {expected}; got {given!r}")
    return np.atleast_2d(values)


def _share(what: str, given: Any, m: int, example: str) -> np.ndarray | None:
    """Relative errors (m,); None where none are given."""
    if given is None:
        return None
    values = np.array(given, dtype=float)
    if values.shape not in ((), (m,)) or not ((values > 0.0) & (values < _LARGEST_SHARE)).all():
        raise ValueError(
            f"ModalData: {what} must be one number, or one for each of {m} modes, between 0 and {_LARGEST_SHARE}, such "
            f"as {example}; got {given!r}"
        )
    return np.broadcast_to(values, (m,)).copy()


def _temperatures(given: Any, n_sets: int) -> np.ndarray | None:
    """Temperatures (n_sets,) [°C]; None where none are given."""
    if given is None:
        return None
    values = np.atleast_1d(np.array(given, dtype=float))
    if values.shape != (n_sets,) or not (np.isfinite(values) & (values > -80.0) & (values < 80.0)).all():
        raise ValueError(
            f"ModalData: temperatures must be a number [°C] for each of {n_sets} identifications, from -80 to 80; got "
            f"{given!r}"
        )
    return values


def _checked_shapes(given: Any, n_sets: int, m: int, sensors: Sequence[str], known: np.ndarray) -> np.ndarray:
    """Shapes (n_sets, m, n_sensors) with a norm of 1, NaN where there is none."""
    n_sensors = len(sensors)
    if given is None or (not n_sensors and not np.size(given)):
        if n_sensors:
            raise ValueError(f"ModalData: sensors {', '.join(sensors)} are given without shapes")
        return np.full((n_sets, m, 0), np.nan)
    shapes = np.array(given)
    if np.iscomplexobj(shapes):
        if np.nan_to_num(shapes.imag).any():
            raise ValueError(
                "ModalData: shapes must be real; take the real parts after a rotation by the mean phase, "
                "real_shapes(shapes)[0], and look at the scatter of the phases, real_shapes(shapes)[1]"
            )
        shapes = shapes.real
    shapes = shapes.astype(float)
    shapes = shapes[None] if shapes.ndim == 2 else shapes
    if shapes.shape != (n_sets, m, n_sensors):
        turned = shapes.ndim == 3 and shapes.shape == (n_sets, n_sensors, m)
        advice = "transpose the shapes" if turned else "give the name of each sensor in sensors="
        raise ValueError(
            f"ModalData: expected shapes with a row for each of {m} modes and a column for each of {n_sensors} sensors "
            f"({', '.join(sensors)}), n_sets = {n_sets}; got shape {shapes.shape}: {advice}"
        )
    missing = np.isnan(shapes)
    partial = np.argwhere(missing & ~missing.all(axis=2, keepdims=True))
    if len(partial):
        k, mode, sensor = partial[0]
        raise ValueError(
            f"ModalData: the component of mode {mode + 1} at {sensors[sensor]!r} is NaN (set {k + 1}): leave this "
            "sensor out, or give a row of NaN for a mode without a shape"
        )
    if not (missing.all(axis=2) | known).all() or np.isinf(shapes).any():
        raise ValueError("ModalData: shapes must be finite, and NaN where the frequency of the mode is NaN")
    lengths = np.linalg.norm(shapes, axis=2, keepdims=True)
    if (lengths == 0.0).any():
        raise ValueError(
            f"ModalData: the shape of mode {np.argwhere(lengths == 0.0)[0][1] + 1} is zero at all sensors: give a row "
            "of NaN for a mode without a shape"
        )
    return shapes / lengths
