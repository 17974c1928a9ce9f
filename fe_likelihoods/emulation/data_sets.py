"""The data sets of a likelihood, one or several, as one with the channels of all.

Data sets are independent given the parameters, so their log-likelihoods are added. The responses of all models at the
same parameters are one response, and a statistic that is quadratic in the residuals of each data set is quadratic in
all residuals. Modes and emulators therefore need no code for several data sets. Data sets of fewer samples are filled
up with residuals of zero, which no statistic counts.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..noise.protocol import noise_title
from ..noise.statistics import needs_response, sums_of_squares
from ..signals.comparison import Comparison, measured_values
from ..simulation.model import derivatives_batch, has_jacobian
from .quadratic import check_quadratic

__all__ = ["DataSets"]


class _Models(NamedTuple):
    """What modes and emulators read of a model, for several models."""

    parameter_names: tuple[str, ...]
    channels: tuple[Any, ...]
    dt: float
    n_steps: int
    fingerprint: str


class _WithoutMissing(NamedTuple):
    """A statistic of residuals, which are zero where a sample is missing, for a noise that expects NaN there."""

    statistic: Callable[[np.ndarray], np.ndarray]
    missing: np.ndarray

    def __call__(self, residuals: np.ndarray) -> np.ndarray:
        return self.statistic(np.where(self.missing, np.nan, residuals))


class _DataSet(NamedTuple):
    """One data set."""

    likelihood: Any
    structural: list[int]  # places of its parameters among all structural parameters
    noise: list[int]  # places of its parameters among all noise parameters
    channels: slice  # its rows among all channels
    samples: slice
    numbers: slice  # its rows among all statistics
    statistic: Callable[[np.ndarray], np.ndarray]  # of its residuals

    def residuals(self, responses: np.ndarray) -> np.ndarray:
        """Measured minus simulated responses (n, n_channels, n_samples); zero where a sample is missing."""
        measured = self.likelihood.measured
        if not isinstance(measured, Comparison):
            return measured - responses
        residuals = np.full((len(responses), *measured.values.shape), np.nan)
        for row, response in zip(residuals, responses, strict=True):
            if np.isfinite(response).all():
                row[:] = -measured.known_residuals(response)
        return residuals


class DataSets:
    """All data sets of an `FELikelihood` or a `JointLikelihood`; `model` is the only model, or what is read of several.

    `measured` are the values (n_channels, n_samples) [SI], `statistic` is that of the residuals, `with_gaps` says
    whether samples are missing or have times of their own, and `differentiable` whether all models know their
    derivatives. ValueError for statistics that are not quadratic in the residuals, or a noise whose level depends on
    the response.
    """

    def __init__(self, likelihood: Any) -> None:
        n_structural = likelihood.ndim - len(likelihood.fast_parameters)
        self._parts: list[_DataSet] = []
        channels = numbers = 0
        for part, columns in likelihood.parts():
            statistic, values = _statistic_of(part), measured_values(part.measured)
            check_quadratic(statistic, values)
            own, width = part.simulator.n_structural, part.simulator.n_numbers
            places = list(columns[:own]), [place - n_structural for place in columns[own:]]
            rows, sums = slice(channels, channels + len(values)), slice(numbers, numbers + width)
            self._parts.append(_DataSet(part, *places, rows, slice(values.shape[1]), sums, statistic))
            channels, numbers = rows.stop, sums.stop
        self._n_numbers = numbers
        likelihoods = [part.likelihood for part in self._parts]
        self.with_gaps = any(isinstance(each.measured, Comparison) for each in likelihoods)
        self.differentiable = all(has_jacobian(each.model) for each in likelihoods)
        self.kinds = " or ".join(dict.fromkeys(type(each.model).__name__ for each in likelihoods))
        if len(self._parts) == 1 and likelihood is likelihoods[0]:
            self.model = likelihood.model
            self.measured, self.statistic = measured_values(likelihood.measured), self._parts[0].statistic
            return
        text = json.dumps([[part.likelihood.model.fingerprint, part.structural] for part in self._parts])
        self.model = _Models(
            tuple(likelihood.parameter_names[:n_structural]),
            tuple(channel for each in likelihoods for channel in each.model.channels),
            likelihoods[0].model.dt,
            max(each.model.n_steps for each in likelihoods),
            hashlib.blake2b(text.encode(), digest_size=16).hexdigest(),
        )
        self.measured = np.zeros((channels, max(part.samples.stop for part in self._parts)))
        for part in self._parts:
            self.measured[part.channels, part.samples] = measured_values(part.likelihood.measured)
        # white noise keeps its fast way: zeros add nothing to a sum of squares
        white = all(part.statistic is sums_of_squares for part in self._parts)
        self.statistic = sums_of_squares if white else self._statistic

    def _statistic(self, residuals: np.ndarray) -> np.ndarray:
        return np.concatenate([part.statistic(residuals[part.channels, part.samples]) for part in self._parts])

    @property
    def identity(self) -> str:
        """Text that identifies the residuals at given parameters, besides the measured values at the model's steps."""
        gaps = (part.likelihood for part in self._parts if isinstance(part.likelihood.measured, Comparison))
        return self.model.fingerprint + "".join(each.measurements.fingerprint for each in gaps)

    def log_likelihood(self, statistics: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) of statistics (n, n_numbers) at noise parameters (n, n_noise)."""
        return sum(
            part.likelihood.noise.log_likelihood(
                statistics[:, part.numbers], part.likelihood.n_samples, parameters[:, part.noise]
            )
            for part in self._parts
        )

    def simulate(self, thetas: np.ndarray) -> list[np.ndarray]:
        """Residuals (n, n_channels, n_samples), statistics (n, n_numbers) and reasons of failures, a list in JSON.

        A point that fails in one model is not simulated by the later ones; its residuals and statistics are NaN.
        Residuals are rounded to single precision.
        """
        reasons = [""] * len(thetas)
        residuals = np.zeros((len(thetas), *self.measured.shape), np.float32)
        statistics = np.full((len(thetas), self._n_numbers), np.nan)
        left = np.arange(len(thetas))
        for part in self._parts:
            residuals[:, part.channels, part.samples] = np.nan
            if len(left) > 0:
                own, simulator = thetas[np.ix_(left, part.structural)], part.likelihood.simulator
                statistics[left, part.numbers], batch = simulator.run(own, full=True)
                with np.errstate(over="ignore"):
                    residuals[left, part.channels, part.samples] = part.residuals(batch.response)
                for row, reason in zip(left, batch.reasons, strict=True):
                    reasons[row] = reason
                left = left[[not reason for reason in batch.reasons]]
        return [residuals, statistics, np.frombuffer(json.dumps(reasons).encode(), dtype=np.uint8)]

    def derivatives(self, thetas: np.ndarray) -> np.ndarray:
        """Derivatives (n, n_structural, n_channels, n_steps) of the responses by the models' ``jacobian``.

        In single precision, as residuals.
        """
        found = np.zeros((*thetas.shape, len(self.measured), self.model.n_steps), np.float32)
        for part in self._parts:
            model = part.likelihood.model
            own = derivatives_batch(model, thetas[:, part.structural], part.likelihood.simulator.pool)
            found[:, part.structural, part.channels, : model.n_steps] = own
        return found

    def of_residuals(self, slopes: np.ndarray) -> np.ndarray:
        """Derivatives (n, d, n_channels, n_samples) of residuals, from derivatives (n, d, n_channels, n_steps)."""
        found = np.zeros((*slopes.shape[:2], *self.measured.shape))
        for part in self._parts:
            measured = part.likelihood.measured
            own = slopes[:, :, part.channels, : part.likelihood.model.n_steps]
            if isinstance(measured, Comparison):
                own = [[measured.at_samples(np.ascontiguousarray(each)) for each in rows] for rows in own]
                own = np.where(measured.missing, 0.0, own)
            found[:, :, part.channels, part.samples] = -own
        return found

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache what an earlier run has found, as `Simulator.recall`."""
        left = np.arange(len(thetas))
        for part in self._parts:
            own = statistics[left, part.numbers]
            good = np.isfinite(own).all(axis=1)
            known = ["" if fine else reasons[row] for row, fine in zip(left, good, strict=True)]
            part.likelihood.simulator.recall(thetas[np.ix_(left, part.structural)], own, known)
            left = left[good]


def _statistic_of(likelihood: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Statistic of residuals that are zero where a sample is missing; ValueError if it cannot be emulated."""
    measured, statistic = likelihood.measured, getattr(likelihood.noise, "statistic", None) or sums_of_squares
    if needs_response(statistic):
        raise ValueError(
            f"the level of {noise_title(likelihood.noise)} depends on the response, so the posterior cannot be "
            'emulated from residuals: sample without a guide, or use GaussianNoise with level="si", or '
            "AutoregressiveNoise"
        )
    if isinstance(measured, Comparison) and statistic is not sums_of_squares:
        return _WithoutMissing(statistic, measured.missing)
    return statistic
