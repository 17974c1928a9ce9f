"""Residual histories of all data sets of a likelihood as those of one, with the channels of all.

The responses of all models at the same parameters are one response, and a statistic that is quadratic in the residuals
of each data set is quadratic in all residuals. Modes and emulators therefore need no code for several data sets. Data
sets of fewer samples are filled up with residuals of zero, which no statistic counts.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..noise.protocol import noise_title
from ..noise.sufficient_statistics import check_quadratic, needs_response, sums_of_squares
from ..signals.channels import Comparison, measured_values
from ..simulation.model import derivatives_batch, has_jacobian, most_responses

_MANY = 10_000  # runs of a pool whose size is not known


class _DataSet(NamedTuple):
    """One data set."""

    likelihood: Any
    structural: list[int]  # places of its parameters among all structural parameters
    noise: list[int]  # places of its parameters among all noise parameters
    rows: tuple[slice, slice]  # its channels and samples among all
    numbers: slice  # its rows among all statistics
    statistic: Callable[[np.ndarray], np.ndarray]  # of its residuals

    def slopes(self, thetas: np.ndarray) -> np.ndarray:
        """Derivatives (n, d, n_channels, n_samples) of the residuals by the parameters, by the model's ``jacobian``."""
        model, measured = self.likelihood.model, self.likelihood.measured
        found = derivatives_batch(model, thetas[:, self.structural], self.likelihood.simulator.pool)
        if isinstance(measured, Comparison):
            found = [[measured.at_samples(np.ascontiguousarray(each)) for each in rows] for rows in found]
            found = np.where(measured.missing, 0.0, found)
        return -found


class Histories:
    """Residuals of `shape` (n_channels, n_samples) of a likelihood's data sets, and the `statistic` of all residuals;
    ValueError if that is not quadratic. `differentiable`: all models know derivatives; `together`: runs whose responses
    are in memory at once.
    """

    def __init__(self, likelihood: Any) -> None:
        n_structural = likelihood.ndim - len(likelihood.fast_parameters)
        self.parameter_names = tuple(likelihood.parameter_names[:n_structural])
        self._parts: list[_DataSet] = []
        channels = samples = numbers = 0
        for part, columns in likelihood.data_sets():
            statistic, values, own = _statistic_of(part), measured_values(part.measured), part.simulator.n_structural
            check_quadratic(statistic, values)
            places = list(columns[:own]), [place - n_structural for place in columns[own:]]
            rows = slice(channels, channels + len(values)), slice(values.shape[1])
            sums = slice(numbers, numbers + part.simulator.n_numbers)
            self._parts.append(_DataSet(part, *places, rows, sums, statistic))
            channels, samples, numbers = rows[0].stop, max(samples, rows[1].stop), sums.stop
        self.shape = channels, samples
        # white noise keeps its fast way: zeros add nothing to a sum of squares
        white = all(part.statistic is sums_of_squares for part in self._parts)
        self.statistic = sums_of_squares if white else self._statistic
        models = [part.likelihood.model for part in self._parts]
        self.differentiable = all(map(has_jacobian, models))
        self.kinds = " or ".join(dict.fromkeys(type(model).__name__ for model in models))
        self.identity = json.dumps(
            [[each.model.fingerprint, each.measurements.fingerprint, at] for each, at, *_ in self._parts]
        )
        pools = [part.likelihood.simulator.pool for part in self._parts]
        workers = [1 if pool is None else getattr(pool, "n_workers", None) or _MANY for pool in pools]
        self.together = max(*workers, *map(most_responses, models))

    def _statistic(self, residuals: np.ndarray) -> np.ndarray:
        return np.concatenate([part.statistic(residuals[part.rows]) for part in self._parts])

    def log_likelihood(self, statistics: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) of statistics (n, n_numbers) at noise parameters (n, n_noise)."""
        return sum(
            part.likelihood.noise.log_likelihood(
                statistics[:, part.numbers], part.likelihood.n_samples, parameters[:, part.noise]
            )
            for part in self._parts
        )

    def simulate(self, thetas: np.ndarray) -> list[np.ndarray]:
        """Residuals (n, n_channels, n_samples) in single precision, statistics (n, n_numbers) and reasons of failures,
        a list in JSON. A point that fails in one model, with NaN, is not simulated by the later ones.
        """
        reasons = [""] * len(thetas)
        residuals = np.zeros((len(thetas), *self.shape), np.float32)
        statistics = np.full((len(thetas), self._parts[-1].numbers.stop), np.nan)
        left = np.arange(len(thetas))
        for part in self._parts:
            residuals[:, *part.rows] = np.nan
            own = thetas[np.ix_(left, part.structural)]
            statistics[left, part.numbers], batch = part.likelihood.run(own)
            for row, response, reason in zip(left, *batch, strict=True):
                reasons[row] = reason
                if not reason:
                    with np.errstate(over="ignore"):
                        residuals[row, *part.rows] = np.nan_to_num(part.likelihood.residuals_of(response))
            left = left[[not reason for reason in batch.reasons]]
        return [residuals, statistics, np.frombuffer(json.dumps(reasons).encode(), dtype=np.uint8)]

    def derivatives(self, thetas: np.ndarray) -> list[np.ndarray]:
        """Derivatives (n, n_structural, n_channels, n_samples) of the residuals, in single precision as these."""
        found = np.zeros((*thetas.shape, *self.shape), np.float32)
        for part in self._parts:
            found[:, part.structural, *part.rows] = part.slopes(thetas)
        return [found]

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache what an earlier run has found, as `Simulator.recall`."""
        left = np.arange(len(thetas))
        for part in self._parts:
            own = statistics[left, part.numbers]
            good = np.isfinite(own).all(axis=1)
            known = ["" if fine else reasons[row] for row, fine in zip(left, good, strict=True)]
            part.likelihood.simulator.recall(thetas[np.ix_(left, part.structural)], own, known)
            left = left[good]


def _known_part(statistic: Callable, missing: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """A statistic of residuals, which are zero where a sample is missing, for a noise that expects NaN there."""
    return statistic(np.where(missing, np.nan, residuals))


def _statistic_of(likelihood: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Statistic of residuals that are zero where a sample is missing; ValueError if it cannot be emulated."""
    measured, statistic = likelihood.measured, getattr(likelihood.noise, "statistic", None) or sums_of_squares
    if needs_response(statistic):
        raise ValueError(
            f"the level of {noise_title(likelihood.noise)} depends on the response, so the posterior cannot be "
            "emulated from residuals: sample without a guide, or use GaussianNoise without shares_of, or "
            "AutoregressiveNoise"
        )
    if isinstance(measured, Comparison) and statistic is not sums_of_squares:
        return partial(_known_part, statistic, measured.missing)
    return statistic
