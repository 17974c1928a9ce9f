"""Identified natural frequencies and mode shapes as data."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from ..models.base import digest
from ..signals.sampling import array_digest
from ..text_tables import text_table

_LARGEST_SHARE = 0.5  # above it, an error was given in percent or in hertz
_ABOVE_ZERO = np.finfo(float).tiny
_OF_SETS = "frequencies", "damping", "temperatures"  # each has a value in each identification
_CLOSE = 0.02  # ratio of frequencies, less 1, below which an identification finds the plane of two shapes only


@dataclass(frozen=True, eq=False, repr=False)
class ModalData:
    """Natural frequencies and mode shapes that were identified once or several times.

    Parameters
    ----------
    frequencies : (m,) or (n_sets, m) array_like
        Natural frequencies of m modes [Hz], of one or several identifications. NaN: one of several missed the mode.
    shapes : (m, n_sensors) or (n_sets, m, n_sensors) array_like, optional
        Mode shapes in any scale and sign, a row for each mode; NaN for a mode without. The attribute has a norm of 1.
    sensors : sequence of str
        Names of the sensors, in the order of the components of a shape. The model has sensors of these names.
    damping : (m,) or (n_sets, m) array_like, optional
        Damping ratios. They are kept and shown, but not compared with a model.
    frequency_cv, shape_error : float or (m,) array_like, optional
        Known coefficients of variation of the frequencies, for example 0.005, and standard deviations of a component of
        a shape with a norm of 1, for example 0.02.
    covariance : (m, m) array_like, optional
        Known covariance of the frequencies of one identification [Hz²], instead of `frequency_cv`.
    temperatures : float or (n_sets,) array_like, optional
        Temperature of the structure in each identification [°C]. The likelihood then has a parameter
        ``temperature_slope`` [1/K], the relative change of all frequencies; the model has those at 20 °C.
    mode_numbers : sequence of int, optional
        Numbers of the modes, used as names and to find the computed modes without a measured shape. Default: 1 to m.
    description : str
        What was measured, where and when.

    Attributes
    ----------
    n_sets, n_modes, n_sensors : int
        Numbers of identifications, modes and sensors.
    mean_frequencies : (m,) ndarray
        Mean frequency of each mode [Hz].
    frequency_errors : (m,) ndarray or None
        Known coefficients of variation, also by the covariance.
    has_shape, known_shapes : (n_sets, m) and (n_sets, m, n_sensors) ndarray
        Whether each identification has a shape of each mode, and the shapes, zero where there is none.

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
        expected = "positive numbers [Hz] of shape (m,) or (n_sets, m), NaN where one of several missed the mode"
        frequencies = np.atleast_2d(_numbers("frequencies", self.frequencies, None, (_ABOVE_ZERO, np.inf), expected))
        known, (n_sets, m), sensors = ~np.isnan(frequencies), frequencies.shape, tuple(self.sensors)
        if not known.any(axis=0).all():
            raise ValueError("ModalData: a mode has no frequency: leave out modes that were never identified")
        if len(set(sensors)) != len(sensors) or not all(isinstance(name, str) and name for name in sensors):
            raise ValueError(f"ModalData: the names of the sensors must differ and not be empty; got {sensors}")
        share = f"one number, or one for each of {m} modes, between 0 and {_LARGEST_SHARE}, such as"
        ratios = "ratios from 0 to below 1, of the shape of frequencies, such as 0.015 for 1.5 % (in a file damping_%)"
        days = f"a [°C] for each of {n_sets} identifications, from -80 to 80"
        numbers = range(1, m + 1) if self.mode_numbers is None else self.mode_numbers
        whole, matrix = (
            f"{m} different whole numbers from 1 on",
            f"a matrix ({m}, {m}) [Hz²], symmetric positive definite",
        )
        values: dict[str, Any] = {"n_sets": n_sets, "n_modes": m, "n_sensors": len(sensors), "sensors": sensors}
        for what, given, shape, limits, expected in (
            ("mode_numbers", list(numbers), (m,), (1.0, 1e9), whole),
            ("frequency_cv", self.frequency_cv, (m,), (_ABOVE_ZERO, _LARGEST_SHARE), f"{share} 0.005 for 0.5 %"),
            ("shape_error", self.shape_error, (m,), (_ABOVE_ZERO, _LARGEST_SHARE), f"{share} 0.02, of a norm of 1"),
            ("temperatures", self.temperatures, (n_sets,), (-80.0, 80.0), days),
            ("damping", self.damping, (n_sets, m), (0.0, 1.0), ratios),
            ("covariance", self.covariance, (m, m), (-np.inf, np.inf), matrix),
        ):
            values[what] = None if given is None else _numbers(what, given, shape, limits, expected)
        values["mode_numbers"] = tuple(int(number) for number in values["mode_numbers"])
        if len(set(values["mode_numbers"])) < m or values["mode_numbers"] != tuple(numbers):
            raise ValueError(f"ModalData: mode_numbers must be {whole}; got {self.mode_numbers!r}")
        shapes, means = _checked_shapes(self.shapes, sensors, known), np.nanmean(frequencies, axis=0)
        has_shape = ~np.isnan(shapes).any(axis=2) & (len(sensors) > 0)
        values |= {"frequencies": frequencies, "shapes": shapes, "mean_frequencies": means, "has_shape": has_shape}
        values["known_shapes"] = np.where(has_shape[:, :, None], shapes, 0.0)
        if (covariance := values["covariance"]) is not None and (
            self.frequency_cv is not None
            or not known.all()
            or not np.allclose(covariance, covariance.T, rtol=1e-8, atol=0.0)
            or not np.linalg.eigvalsh(covariance)[0] > 0.0
            or (np.diag(covariance) >= np.square(_LARGEST_SHARE * means)).any()
        ):
            raise ValueError(
                "ModalData: covariance must be a symmetric positive definite matrix of modes that were never missed, "
                f"with deviations below {_LARGEST_SHARE} of the frequencies; got {self.covariance}: take the variances "
                "alone (frequency_cv) if the covariances are poorly known. If covariance and frequency_cv state the "
                "same errors: leave one out (frequency_cv=None, where a file has them)"
            )
        if (np.diff(means[np.argsort(values["mode_numbers"])]) < 0.0).any() and not has_shape.any(axis=0).all():
            raise ValueError(
                f"ModalData: modes without a shape are found by their number, so frequencies must ascend; got "
                f"{means.tolist()} Hz of the modes {self.mode_numbers}: sort them, or give mode_numbers"
            )
        values["frequency_errors"] = (
            values["frequency_cv"] if covariance is None else np.sqrt(np.diag(covariance)) / means
        )
        one_nan = [np.where(np.isnan(each), np.nan, each) for each in (frequencies, shapes)]
        values["fingerprint"] = digest(repr([sensors, values["mode_numbers"]]), array_digest(*one_nan))
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Modes so close to each other that an identification finds the plane of their shapes only, as groups.

        Modes without a shape, and groups whose plane would take up all sensors, are single.
        """
        has_shape = self.has_shape.any(axis=0)
        shaped, groups = np.flatnonzero(has_shape), [(mode,) for mode in np.flatnonzero(~has_shape).tolist()]
        for group in close_groups(self.mean_frequencies[shaped], _CLOSE):
            modes = tuple(shaped[list(group)].tolist())
            groups += [modes] if len(modes) < self.n_sensors else [(mode,) for mode in modes]
        return tuple(groups)

    def select(self, mode_numbers: Sequence[int]) -> "ModalData":
        """Return the modes with these numbers; ValueError for an unknown one."""
        if unknown := [number for number in mode_numbers if number not in self.mode_numbers]:
            raise ValueError(f"ModalData has no modes {unknown}; the modes are {str(self.mode_numbers)[1:-1]}")
        rows = [self.mode_numbers.index(number) for number in mode_numbers]
        given = {name: getattr(self, name) for name in ("frequencies", "damping", "frequency_cv", "shape_error")}
        found = {name: each[..., rows] for name, each in given.items() if each is not None}
        found["covariance"] = None if self.covariance is None else self.covariance[np.ix_(rows, rows)]
        return replace(self, **found, shapes=self.shapes[:, rows], mode_numbers=tuple(mode_numbers))

    def mean(self) -> "ModalData":
        """Return the mean of several identifications, with their scatter as the errors `frequency_cv`, `shape_error`.

        The scatter is not divided by the square root of the number of identifications: what they have in common, such
        as the temperature of the day, does not average out. ValueError for modes that were identified only once.
        """
        if (np.isfinite(self.frequencies).sum(axis=0) < 2).any():
            raise ValueError("ModalData.mean: the scatter needs two identifications of each mode: select others")
        shapes, errors = np.full(self.shapes.shape[1:], np.nan), np.zeros(self.n_modes)
        for mode in np.flatnonzero(self.has_shape.any(axis=0)):
            found = self.shapes[self.has_shape[:, mode], mode]
            shapes[mode] = np.linalg.svd(found, full_matrices=False)[2][0]
            squares = np.maximum(1.0 - np.square(found @ shapes[mode]), 0.0).sum()
            errors[mode] = np.sqrt(squares / (max(len(found) - 1, 1) * max(self.n_sensors - 1, 1)))
        cv = np.nanstd(self.frequencies, axis=0, ddof=1) / self.mean_frequencies
        error = errors if (errors > 0.0).all() else self.shape_error
        means = {name: None if (x := getattr(self, name)) is None else np.nanmean(x, axis=0) for name in _OF_SETS}
        return replace(self, **means, shapes=shapes, frequency_cv=cv, shape_error=error, covariance=None)

    def __repr__(self) -> str:
        damping = [] if self.damping is None else ["damping"]
        rows = [["mode", "f [Hz]", *damping, *self.sensors]]
        for mode, number in enumerate(self.mode_numbers):
            ratio = [f"{100.0 * np.nanmean(self.damping[:, mode]):.2g} %"] if damping else []
            shape = self.shapes[int(self.has_shape[:, mode].argmax()), mode]
            rows.append([str(number), f"{self.mean_frequencies[mode]:.4g}", *ratio, *(f"{x:.3f}" for x in shape)])
        what = f"modes {self.n_modes}, sensors {self.n_sensors}, identifications {self.n_sets}"
        return f"ModalData: {what}\n" + text_table(rows)


def close_groups(frequencies: Sequence[float], close: float) -> tuple[tuple[int, ...], ...]:
    """Groups of modes whose frequencies follow each other at ratios below 1 + `close`, in ascending order."""
    order, ordered = np.argsort(frequencies, kind="stable"), np.sort(frequencies)
    starts = np.flatnonzero(ordered[1:] >= (1.0 + close) * ordered[:-1]) + 1
    return tuple(tuple(each.tolist()) for each in np.split(order, starts) if len(each))


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


def _numbers(
    what: str, given: Any, shape: tuple[int, ...] | None, limits: tuple[float, float], expected: str
) -> np.ndarray:
    """Numbers from a limit to below another one, repeated to a shape; NaN where an identification has none."""
    try:
        values = np.array(given).astype(float, casting="no" if np.asarray(given).dtype == bool else "same_kind")
    except (TypeError, ValueError):  # texts, complex numbers, truth values, rows of different lengths
        values = np.array([])
    fits = values.ndim in (1, 2) if shape is None else values.shape in ((), shape, shape[-1:])
    wrong = ~((values >= limits[0]) & (values < limits[1]) | np.isnan(values) & (what in ("frequencies", "damping")))
    if not fits or not values.size or wrong.any():
        places = "".join(f", {values[tuple(k)]:g} at {(k + 1).tolist()}" for k in np.argwhere(wrong)[:3] if values.ndim)
        raise ValueError(f"ModalData: {what} must be {expected}; got {given!r}{places}: correct or leave out")
    return values if shape is None else np.broadcast_to(values, shape).copy()


def _checked_shapes(given: Any, sensors: Sequence[str], known: np.ndarray) -> np.ndarray:
    """Shapes (n_sets, m, n_sensors) with a norm of 1, NaN where there is none; `known` (n_sets, m) are frequencies."""
    shape = *known.shape, len(sensors)
    if not sensors and (given is None or not np.size(given)):
        return np.full(shape, np.nan)
    shapes = np.array(given)
    if np.iscomplexobj(shapes) and np.nan_to_num(shapes.imag).any():
        raise ValueError(
            "ModalData: shapes must be real; take the real parts after a rotation by the mean phase, "
            "real_shapes(shapes)[0], and look at the scatter of the phases, real_shapes(shapes)[1]"
        )
    shapes = (shapes.real if np.iscomplexobj(shapes) else shapes).astype(float)
    shapes = shapes[None] if shapes.ndim == 2 else shapes
    if shapes.shape != shape:
        turned = shapes.shape == (shape[0], shape[2], shape[1])
        raise ValueError(
            f"ModalData: expected shapes (n_sets, modes, sensors) = {shape}, of the sensors {', '.join(sensors)}; got "
            f"{shapes.shape}: {'transpose them' if turned else 'name each sensor in sensors='}"
        )
    lengths = np.linalg.norm(shapes, axis=2)
    good = np.isnan(shapes).all(axis=2) | (known & (lengths > 0.0) & (lengths < np.inf))
    if not good.all():
        k, mode = np.argwhere(~good)[0]
        named = ", ".join(f"{name}: {x:.4g}" for name, x in zip(sensors, shapes[k, mode], strict=True))
        raise ValueError(
            f"ModalData: the shape of mode {mode + 1} (set {k + 1}) must be finite numbers, not all zero, and NaN "
            f"where its frequency is; got {named}: leave a sensor out, or give a row of NaN for a mode without a shape"
        )
    return shapes / lengths[..., None]
