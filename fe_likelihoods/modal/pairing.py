"""Computed modes at the measured ones, paired by their shapes, never by their order (``docs/theory/modes.rst``)."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import orth

from ..models.base import code_within, digest
from ..signals.channels import Channel, Measurements
from ..signals.sampling import array_digest
from ..simulation.by_value import is_of_user
from ..simulation.model import Model, SimulationBatch, SimulationFailed
from .modal_data import ModalData, close_groups
from .mode_models import ABSENT

SLOPE = "temperature_slope"
_REFERENCE = 20.0  # [°C], of the stiffnesses of a model
_FREQUENCY_WEIGHT = 0.1  # of |log(f / measured f)| beside 1 - MAC: decides only where the shapes hardly do
_COINCIDENT = 1e-6  # relative difference of computed frequencies whose shapes are any basis of their space
_SAME = 1e-6  # smallest singular value of shapes that the sensors tell apart, as a share of the largest
_FORCED = 1e3  # cost of any pairing but the one by number


class Paired(NamedTuple):
    """Computed modes at the measured ones."""

    columns: np.ndarray  # (m,) numbers of the computed modes, from 0
    assurance: np.ndarray  # (m,) modal assurance, the mean of the sets; with a space of modes where they are close
    frequencies: np.ndarray  # (m,) [Hz]
    shapes: np.ndarray  # (n_sets, m, n_sensors) projections of the measured shapes; zero where there is none
    spaces: tuple[tuple[int, ...], ...]  # computed modes on whose space each measured shape is projected


def pair_modes(
    frequencies: np.ndarray, shapes: np.ndarray, measured: ModalData, groups: Sequence[tuple[int, ...]]
) -> Paired:
    """Pair n computed modes with the m of `ModalData`; frequencies (n,) [Hz], shapes (n, n_sensors) in any scale.

    Pairs are assigned so that the sum of 1 - MAC, with a weak term in the frequencies, is least. Modes without a shape
    are paired by their number. `groups` are modes that are close to each other (`ModalData.groups`).
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    clusters, counts = close_groups(frequencies, _COINCIDENT), measured.has_shape.sum(axis=0)
    members = {mode: cluster for cluster in clusters for mode in cluster}
    lengths = np.linalg.norm(shapes, axis=-1, keepdims=True)
    normed = shapes / np.where(lengths > 0.0, lengths, 1.0)
    cosines = measured.known_shapes @ normed.T
    similar = np.square(cosines)
    for group in groups:  # the largest MAC between the spaces of close measured and of coincident modes
        for k, there in enumerate(measured.has_shape):
            modes = [mode for mode in group if there[mode]]
            for cluster in clusters if modes else ():
                if len(group) + len(cluster) > 2 and normed[list(cluster)].any():  # else no sensor sees it
                    spaces = (orth(each.T, _SAME) for each in (measured.known_shapes[k, modes], normed[list(cluster)]))
                    similar[np.ix_([k], modes, cluster)] = np.linalg.norm(next(spaces).T @ next(spaces), 2) ** 2
    cost = np.abs(np.log(frequencies / measured.mean_frequencies[:, None])) * _FREQUENCY_WEIGHT
    cost += 1.0 - similar.sum(axis=0) / np.maximum(counts, 1)[:, None]
    for mode in np.flatnonzero(counts == 0):
        cost[mode] = _FORCED
        cost[mode, measured.mode_numbers[mode] - 1] = 0.0
    columns = linear_sum_assignment(cost)[1]
    spaces, projected = [()] * len(columns), np.empty(measured.known_shapes.shape)
    for group in map(list, groups):
        columns[group] = columns[group][np.argsort(frequencies[columns[group]], kind="stable")]
        space = tuple(sorted({each for column in columns[group] for each in members[int(column)]}))
        for mode in group:
            basis, spaces[mode], target = normed[list(space)], space, measured.known_shapes[:, mode]
            if len(space) == 1:
                projected[:, mode] = cosines[:, mode, space] * basis
            else:
                projected[:, mode] = (basis.T @ np.linalg.lstsq(basis.T, target.T, rcond=None)[0]).T
    assurance = np.where(counts > 0, np.square(projected).sum(axis=(0, 2)) / np.maximum(counts, 1), np.nan)
    return Paired(columns, assurance, frequencies[columns], projected, tuple(spaces))


class _Containing:
    """A model that contains another one, with its optional members, or those of `own` if the model has them."""

    path_dependent = False

    def __init__(self, model: Model, **own: Any) -> None:
        self.model, self.parameter_names = model, tuple(model.parameter_names)
        for name in ("nominal", "nominal_units", "parameter_units", "time_limit", *own):
            if getattr(model, name, None) is not None:
                setattr(self, name, own.get(name, getattr(model, name)))
        if hasattr(model, "code_parts") or is_of_user(type(model).__module__):
            self.code_parts = partial(code_within, model)


class ModesWithSlope(_Containing):
    """Modes at 20 °C, with the slope as the last parameter and as one more channel."""

    def __init__(self, model: Model) -> None:
        super().__init__(model, jacobian=self._differentiate, simulate_together=self._together)
        self.dt, self.n_steps = model.dt, model.n_steps
        self.channels = *model.channels, Channel(SLOPE, "dimensionless", "1")
        self.parameter_names += (SLOPE,)
        self.parameter_units = dict(getattr(model, "parameter_units", {})) | {SLOPE: "1/K"}
        self.fingerprint = digest(type(self).__name__, model.fingerprint)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) at the parameters (n_parameters,)."""
        return np.vstack([self.model.simulate(theta[:-1]), np.full(self.n_steps, theta[-1])])

    def _together(self, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
        batch = self.model.simulate_together(thetas[:, :-1], pool)
        slopes = np.broadcast_to(thetas[:, -1:, None], (len(thetas), 1, self.n_steps))
        return SimulationBatch(np.concatenate([batch.response, slopes], axis=1), batch.reasons)

    def _differentiate(self, theta: np.ndarray) -> np.ndarray:
        found = np.zeros((len(theta), len(self.channels), self.n_steps))
        found[:-1, :-1], found[-1, -1] = self.model.jacobian(theta[:-1]), 1.0
        return found


class PairedModes(_Containing):
    """Model of the measured modes, the modes of another model paired with them; a call is a statistic of that one.

    Each measured mode is a channel. Its samples are, for each identification, the computed frequency as a multiple of
    the measured one, and the projection of the measured shape on the computed one, at all sensors: smooth functions of
    the parameters as long as the pairing stays, as emulators and searches need.
    """

    of_response = True  # as a statistic
    dt = 1.0

    def __init__(self, model: Model, data: ModalData) -> None:
        super().__init__(model, jacobian=self._differentiate)
        self.data, self.groups, self._there = data, data.groups(), ~np.isnan(data.frequencies)
        modes = model.model if isinstance(model, ModesWithSlope) else model
        names = [channel.name for channel in modes.channels]
        if modes.channels[0].dimension != "frequency":
            raise ValueError(
                f"expected a model that has modes, whose first channel is a frequency; the channels of "
                f"{type(modes).__name__} are {', '.join(names)}: use FunctionModes, or modal_channels(sensors) and "
                "modal_response"
            )
        if unknown := [name for name in data.sensors if name not in names[1:]]:
            raise ValueError(
                f"the model has no sensors {', '.join(unknown)}; its sensors are {', '.join(names[1:]) or 'none'}: "
                "rename them, or leave them out (read_modal_data(sensors=)); in a TOML file, columns = "
                '{sensor = "its column"}'
            )
        if max(data.n_modes, *np.where(data.has_shape.any(axis=0), 0, data.mode_numbers)) > model.n_steps:
            raise ValueError(
                f"the model has {model.n_steps} modes, and {data.n_modes} were measured, with the numbers "
                f"{data.mode_numbers}: compute more modes (n_modes), twice as many as were measured"
            )
        self._rows = [names.index(name) for name in data.sensors]
        # frequencies with a covariance are compared in coordinates in which their errors are independent
        self.frequency_cv, self._whitening = data.frequency_cv, np.eye(data.n_modes)
        if data.covariance is not None:
            factor = np.linalg.cholesky(data.covariance / np.outer(data.mean_frequencies, data.mean_frequencies))
            self.frequency_cv = np.diag(factor).copy()
            self._whitening = self.frequency_cv[:, None] * np.linalg.inv(factor)
        has_slope = data.temperatures is not None and isinstance(model, ModesWithSlope)
        self._warmer = data.temperatures - _REFERENCE if has_slope else np.zeros(data.n_sets)
        self.channels = tuple(Channel(f"mode {number}", "dimensionless", "1") for number in data.mode_numbers)
        self.n_steps = data.n_sets * (1 + data.n_sensors)
        text = " of ".join(filter(None, ["natural frequencies and mode shapes", data.description]))
        values, axis = self._joined(self._there.astype(float), data.known_shapes), "frequency, then shape"
        self.measurements = Measurements(self.channels, self.dt, values, text, axis=axis)

    def __repr__(self) -> str:
        arrays = map(array_digest, (self._whitening, self._warmer))
        return f"{type(self).__name__}({digest(self.data.fingerprint, repr(self.groups), *arrays)})"

    def __call__(self, residuals: np.ndarray, modes: np.ndarray) -> np.ndarray:
        """Statistic (n_numbers,) of modes (1 + n_sensors, n_modes): `sums` of the residuals of the paired ones."""
        return self.sums(self.response(modes) - self.measurements.values)

    def sums(self, residuals: np.ndarray) -> np.ndarray:
        """Sums of squares (m + 2 m n_sets,) of residuals (m, n_steps): of each mode, each frequency, and each shape."""
        squares = np.square(residuals).reshape(len(residuals), self.data.n_sets, -1)
        frequencies, shapes = squares[:, :, 0], squares[:, :, 1:].sum(axis=2)
        return np.concatenate([(frequencies + shapes).sum(axis=1), frequencies.ravel(), shapes.ravel()])

    @property
    def fingerprint(self) -> str:
        """Digest of the model, the data and the groups of close modes."""
        return digest(self.model.fingerprint, repr(self))

    def factors(self, modes: np.ndarray) -> np.ndarray:
        """Factors (..., n_sets) of frequencies by temperature, of modes (..., 1 + n_sensors, n_modes)."""
        return 1.0 + modes[..., -1, :1] * self._warmer

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (m, n_sets (1 + n_sensors)) at the parameters (n_parameters,)."""
        return self.response(np.asarray(self.model.simulate(np.asarray(theta, dtype=float))))

    def response(self, modes: np.ndarray) -> np.ndarray:
        """Response (m, n_sets (1 + n_sensors)) of modes (1 + n_sensors, n_modes), a response of the other model."""
        paired = self.pair(modes)
        return self._joined(self._ratios(paired.frequencies) * self.factors(modes)[:, None], paired.shapes)

    def pair(self, modes: np.ndarray) -> Paired:
        """Pair modes (1 + n_sensors, n_modes), a response of the model, with the measured ones."""
        if not (modes[0] > 0.0).all():
            raise SimulationFailed(f"natural frequencies must be positive; they are {modes[0]} Hz")
        paired = pair_modes(modes[0], modes[self._rows].T, self.data, self.groups)
        if (paired.frequencies >= ABSENT).any():
            raise SimulationFailed(
                f"the model has {np.count_nonzero(modes[0] < ABSENT)} modes, fewer than the measured modes "
                f"{self.data.mode_numbers} need"
            )
        return paired

    def _ratios(self, frequencies: np.ndarray) -> np.ndarray:
        """Frequencies (..., m) as multiples (..., n_sets, m) of the measured ones; zero where there is none."""
        return np.where(self._there, frequencies[..., None, :] / self.data.frequencies, 0.0)

    def _joined(self, ratios: np.ndarray, shapes: np.ndarray) -> np.ndarray:
        """Response (..., m, n_steps) of ratios (..., n_sets, m) and shapes (..., n_sets, m, n_sensors)."""
        blocks = np.concatenate([(ratios @ self._whitening.T)[..., None], shapes], axis=-1)
        return np.moveaxis(blocks, -3, -2).reshape(*blocks.shape[:-3], len(self.channels), self.n_steps)

    def _differentiate(self, theta: np.ndarray) -> np.ndarray:
        """Derivatives (n_parameters, m, n_steps) of the response while the pairing stays."""
        theta = np.asarray(theta, dtype=float)
        modes, slopes = self.model.simulate(theta), np.asarray(self.model.jacobian(theta))
        paired = self.pair(modes)
        shapes = np.zeros((len(slopes), *paired.shapes.shape))
        for mode, space in enumerate(paired.spaces):
            basis, turned = modes[np.ix_(self._rows, space)], slopes[:, self._rows][:, :, list(space)]
            inverse, target = np.linalg.pinv(basis), self.data.known_shapes[:, mode]
            # y = B c with c = B+ t: y' = (I - B B+) B' c + (B+)^T B'^T (t - y)
            moved = turned @ (inverse @ target.T)
            moved -= basis @ (inverse @ moved)
            shapes[:, :, mode] = moved.swapaxes(1, 2) + (target - paired.shapes[:, mode]) @ turned @ inverse
        ratios = self._ratios(slopes[:, 0, paired.columns]) * self.factors(modes)[:, None]
        ratios += self._ratios(paired.frequencies) * (self.factors(slopes) - 1.0)[..., None]
        return self._joined(ratios, shapes)
