"""Several likelihoods with parameters in common, as one likelihood that has all their channels.

Data sets are independent given the parameters, so their log-likelihoods are added. The responses of all models at the
same parameters are one response with the channels of all, and a statistic that is quadratic in the residuals of each
data set is quadratic in all residuals. Modes and emulators therefore need no code for several data sets. Data sets of
fewer steps are filled up with residuals of zero, which no statistic counts.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..noise.protocol import noise_title
from ..noise.statistics import needs_response, sums_of_squares
from ..signals.comparison import Comparison
from ..simulation.model import SimulationBatch

__all__ = ["TIME_SHIFTS", "StackedLikelihood", "is_joint", "stack"]

TIME_SHIFTS = (
    "a guide cannot emulate time shifts of channels: sample without a guide, or estimate the lags with align and "
    "correct the measurements with Measurements.shift"
)


def stack(likelihood: Any) -> Any:
    """The likelihood itself if it has a model, else a `StackedLikelihood` of its data sets, also of a single one."""
    return StackedLikelihood(likelihood, likelihood.parts()) if is_joint(likelihood) else likelihood


def is_joint(likelihood: Any) -> bool:
    """Whether a likelihood is a `JointLikelihood`, whose parts have a model each."""
    return not hasattr(likelihood, "model")


class _StackedModel(NamedTuple):
    """What modes and emulators read of a model."""

    parameter_names: tuple[str, ...]
    channels: tuple[Any, ...]
    dt: float
    n_steps: int
    fingerprint: str


class _Part(NamedTuple):
    """One data set."""

    likelihood: Any
    structural: list[int]  # places of its parameters among all structural parameters
    noise: list[int]  # places of its parameters among all noise parameters
    channels: slice  # its rows among all channels
    numbers: slice  # its rows among all statistics
    statistic: Callable[[np.ndarray], np.ndarray]  # of its residuals


class _StackedNoise:
    """The noises of all data sets."""

    def __init__(self, parts: Sequence[_Part]) -> None:
        self._parts = parts
        # white noise keeps its fast way: zeros add nothing to a sum of squares
        white = all(part.statistic is sums_of_squares for part in parts)
        self.statistic = sums_of_squares if white else self._statistic

    def _statistic(self, residuals: np.ndarray) -> np.ndarray:
        own = (residuals[part.channels, : part.likelihood.model.n_steps] for part in self._parts)
        return np.concatenate([part.statistic(each) for part, each in zip(self._parts, own, strict=True)])

    def log_likelihood(self, statistics: np.ndarray, n_samples: Sequence[Any], parameters: np.ndarray) -> np.ndarray:
        """Sum (n,) of the log-likelihoods for statistics (n, n_numbers) at noise parameters (n, n_noise)."""
        return sum(
            part.likelihood.noise.log_likelihood(statistics[:, part.numbers], samples, parameters[:, part.noise])
            for part, samples in zip(self._parts, n_samples, strict=True)
        )


class StackedLikelihood:
    """What a guide needs of a likelihood, for several data sets: likelihoods, and the places of their parameters.

    ValueError if a data set has missing samples, times of its own or time shifts, or a noise whose level depends on the
    response.
    """

    def __init__(self, joint: Any, parts: Sequence[tuple[Any, Sequence[int]]]) -> None:
        names = joint.parameter_names[: joint.ndim - len(joint.fast_parameters)]
        found, channels, numbers = [], 0, 0
        for likelihood, columns in parts:
            if isinstance(likelihood.measured, Comparison) and likelihood.measured.lags is not None:
                raise ValueError(TIME_SHIFTS)
            if isinstance(likelihood.measured, Comparison):
                raise ValueError(
                    "a guide of a JointLikelihood needs data sets that have all samples at the steps of their models: "
                    "resample the measurements, or sample without a guide"
                )
            if needs_response(statistic := getattr(likelihood.noise, "statistic", None) or sums_of_squares):
                raise ValueError(
                    f"the level of {noise_title(likelihood.noise)} depends on the response, so the posterior cannot "
                    'be emulated from residuals: sample without a guide, or use level="si"'
                )
            own, width = len(likelihood.model.parameter_names), len(statistic(likelihood.measured))
            rows, sums = channels + len(likelihood.measured), numbers + width
            noise = [place - len(names) for place in columns[own:]]
            found.append(
                _Part(likelihood, list(columns[:own]), noise, slice(channels, rows), slice(numbers, sums), statistic)
            )
            channels, numbers = rows, sums
        self._parts, self._n_numbers = found, numbers
        self._first = parts[0][0]
        n_steps = max(part.likelihood.model.n_steps for part in found)
        fingerprint = hashlib.blake2b(
            json.dumps([[part.likelihood.model.fingerprint, part.structural] for part in found]).encode(),
            digest_size=16,
        ).hexdigest()
        all_channels = tuple(channel for part in found for channel in part.likelihood.model.channels)
        self.model = _StackedModel(tuple(names), all_channels, self._first.model.dt, n_steps, fingerprint)
        self.noise, self.n_samples = _StackedNoise(found), tuple(part.likelihood.n_samples for part in found)
        self.measured = self._filled([part.likelihood.measured[None] for part in found], 1)[0]

    @property
    def simulator(self) -> "StackedLikelihood":
        """Runs and recalls the simulations of all models: this object."""
        return self

    def _filled(self, arrays: Sequence[np.ndarray], n: int) -> np.ndarray:
        """Histories (n, n_channels, n_steps) of all data sets, zero after the end of each."""
        filled = np.zeros((n, len(self.model.channels), self.model.n_steps))
        for part, array in zip(self._parts, arrays, strict=True):
            filled[:, part.channels, : array.shape[-1]] = array
        return filled

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses of all models; a point that fails in one is not simulated by the later ones."""
        reasons = [""] * len(thetas)
        arrays = []
        for part in self._parts:
            left = np.flatnonzero([not reason for reason in reasons])
            response = np.full((len(thetas), *part.likelihood.measured.shape), np.nan)
            if len(left) > 0:
                batch = part.likelihood.simulate(thetas[np.ix_(left, part.structural)])
                response[left] = batch.response
                for row, reason in zip(left, batch.reasons, strict=True):
                    reasons[row] = reason
            arrays.append(response)
        return SimulationBatch(self._filled(arrays, len(thetas)), reasons)

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) of all data sets; NaN where a simulation failed."""
        result = np.full((len(thetas), self._n_numbers), np.nan)
        left = np.arange(len(thetas))
        for part in self._parts:
            if len(left) > 0:
                result[left, part.numbers] = part.likelihood.simulator.statistics(thetas[np.ix_(left, part.structural)])
                left = left[np.isfinite(result[left, part.numbers]).all(axis=1)]
        return result

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache what an earlier run has found, as `Simulator.recall`."""
        left = np.arange(len(thetas))
        for part in self._parts:
            own = statistics[left, part.numbers]
            good = np.isfinite(own).all(axis=1)
            known = ["" if fine else reasons[row] for row, fine in zip(left, good, strict=True)]
            part.likelihood.simulator.recall(thetas[np.ix_(left, part.structural)], own, known)
            left = left[good]
