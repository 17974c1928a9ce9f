"""The log-likelihood of a model's parameters and of the noise, given measurements.

Parameters go to the model, its response to sums of squared residuals J, J and the noise's parameters to a number. (A
noise may need some numbers more than J: its statistic of the residuals, see `fe_likelihoods.probability.noise`.) The middle of
this chain, `FELikelihood.statistics`, is the only place where simulations are asked for: it decides which rows are run,
counts them, records those that fail, and remembers what came out.
"""

import hashlib
import logging
import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Measurements
from ..simulation.disk_cache import SimulationCache
from ..simulation.executors import as_executor
from ..simulation.memory_cache import MisfitMemory, distinct_keys
from ..simulation.model import Model, SimulationFailed, misfit_batch, misfit_of_responses, simulate_batch, split_seconds
from ..simulation.source_digest import simulation_fingerprint
from .noise import GaussianNoise

__all__ = ["FELikelihood", "TooManyFailures", "as_points"]

logger = logging.getLogger(__name__)

_RECORDED_FAILURES = 1000
_RECORDED_REASONS = 100
_OTHER_REASONS = "other reasons"
_SECONDS_PER_CHUNK = 5.0  # of simulations, before they are stored
_ROUNDS_PER_CHUNK = 8  # of each worker: those who wait for the last one idle for half a round in the mean
_RESPONSE_VALUES = 2**23  # responses held at once where they are kept: 64 MiB
_FEW_SIMULATIONS = 20


class TooManyFailures(RuntimeError):
    """More simulations failed than the stated share: what was simulated is kept, no more is."""


def as_points(x: Any, names: Sequence[str]) -> np.ndarray:
    """One point or many, as an array.

    Parameters
    ----------
    x : array_like (ndim,) or (n, ndim), or a mapping of every name to its value or its (n,) values
        Mappings are what emcee passes with ``parameter_names=``, and nautilus with its own prior.
    names : sequence of str
        Names of the ndim parameters, in order.

    Returns
    -------
    ndarray[ndim] or ndarray[n, ndim]

    Raises
    ------
    ValueError
        If the length or the names do not fit.
    """
    if isinstance(x, Mapping):
        if set(x) != set(names):
            raise ValueError(f"expected a value for each of {', '.join(names)}; got the names {', '.join(map(str, x))}")
        x = np.stack([np.asarray(x[name], dtype=float) for name in names], axis=-1)
    points = np.asarray(x, dtype=float)
    if points.ndim not in (1, 2) or points.shape[-1] != len(names):
        raise ValueError(
            f"expected one value for each of the {len(names)} parameters {', '.join(names)}, in an array of shape "
            f"({len(names)},) or (n, {len(names)}); got shape {points.shape}"
        )
    return points


class FELikelihood:
    """Log-likelihood of structural parameters and noise, given measurements.

    Parameters
    ----------
    model : Model
        Turns structural parameters into the response (see `fe_likelihoods.simulation.model`).
    measurements : Measurements
        The model's channels (matched by name, in any order) at the model's step and length.
    noise : optional
        A noise of `fe_likelihoods.probability.noise`, or anything with ``parameter_names`` and ``log_likelihood(misfit, n_steps,
        parameters)``; by default `GaussianNoise` of the model's channels. One that needs more of the residuals than
        their sums of squares has a ``statistic`` too (`fe_likelihoods.simulation.model.Statistic`).
    pool : int, or an object with ``map(function, items)``, optional
        Runs the simulations, as many at once as it has workers: a number of processes of this machine, a client of
        dask.distributed, an executor or a pool (see `fe_likelihoods.simulation.executors`). Without it they run in this process:
        the compiled models on threads, others one after the other. It does not travel when the likelihood is pickled.
    memory : int
        Number of simulations whose misfits are remembered (some 250 bytes each), so that none of them is run again,
        those that failed included; 0 for none. What is remembered does not travel when the likelihood is pickled: every
        process remembers what it simulated itself.
    cache : SimulationCache or path, optional
        Simulations on disk, asked after the memory: those of earlier runs and of other processes are not run again, and
        a killed run loses no more than the last seconds. A batch is then simulated in chunks of some seconds, stored
        one by one; through a pool whose number of workers cannot be told, in one piece.
    max_failure_share : float
        Once more than this share of the simulations failed, of 20 or more, no more are run: asking for one raises
        `TooManyFailures`. 1 for never.

    Attributes
    ----------
    parameter_names : tuple of str
        The model's, then the noise's.
    fast_parameters : tuple of int
        Indices of the parameters whose change costs no simulation: the noise's.
    simulations : int
        Simulations run by this object in this process.
    cache_hits : int
        Rows whose misfit was remembered instead.
    disk_hits : int
        How many of those rows came from the cache on disk.
    failure_count : int
        How many simulations failed, those that the cache on disk told included.
    failures : list of dict
        ``{"parameters": {name: value}, "reason": str}`` of the first thousand failures, and their duration, "seconds",
        where it is known.
    failure_reasons : dict of str to int
        How often each reason occurred, whatever the duration.
    seconds : float
        Wall time spent in simulations [s].

    Raises
    ------
    ValueError
        If channels, step or length of model and measurements or the noise's channels differ, parameter names repeat,
        the pool is none, the model cannot be sent to its processes, or the file of the cache cannot be used.
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        noise: Any = None,
        pool: Any = None,
        *,
        memory: int = 100_000,
        cache: SimulationCache | str | os.PathLike | None = None,
        max_failure_share: float = 1.0,
    ) -> None:
        if not 0.0 <= max_failure_share <= 1.0:
            raise ValueError(f"FELikelihood: max_failure_share must lie in [0, 1]; got {max_failure_share!r}")
        self.model = model
        self.measurements = _matched(model, measurements)
        self.noise = GaussianNoise(model.channels) if noise is None else noise
        _check_channels(model, self.noise)
        self._statistic = getattr(self.noise, "statistic", None)
        n_channels = self.measurements.n_channels
        self._width = n_channels if self._statistic is None else len(self._statistic(self.measurements.values))
        self.pool = as_executor(pool, model)
        self.max_failure_share = max_failure_share
        self.parameter_names = tuple(model.parameter_names) + tuple(self.noise.parameter_names)
        if len(set(self.parameter_names)) != len(self.parameter_names):
            raise ValueError(f"the names of model and noise must differ; got {', '.join(self.parameter_names)}")
        self._n_structural = len(model.parameter_names)
        self.fast_parameters = tuple(range(self._n_structural, len(self.parameter_names)))
        self._memory = MisfitMemory(memory)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self._model_fingerprint = None if cache is None else model.fingerprint
        self._key = None if cache is None else f"{self.fingerprint} {simulation_fingerprint(model, self._statistic)}"
        self._chunk = 1
        self.simulations = 0
        self.cache_hits = 0
        self.disk_hits = 0
        self.failure_count = 0
        self.failures: list[dict] = []
        self.failure_reasons: Counter[str] = Counter()
        self.seconds = 0.0

    def __getstate__(self) -> dict:
        return self.__dict__ | {"pool": None}

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    @property
    def fingerprint(self) -> str:
        """Digest of all that is kept of a simulation depends on: model, measurements, the noise's statistic."""
        text = f"{self.model.fingerprint} {self.measurements.fingerprint}"
        if self._statistic is not None:
            text += f" {self._statistic.__module__}.{self._statistic.__qualname__}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def misfit(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared residuals: the first columns of `statistics`.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.

        Returns
        -------
        (n, n_channels) float : [SI unit of the channel, squared]; NaN where there is no usable simulation.
        """
        return self.statistics(thetas)[:, : self.measurements.n_channels]

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """What the noise needs of the residuals: for white noise their sums of squares.

        Equal rows are simulated once, remembered ones not again, and rows that are not finite not at all.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.

        Returns
        -------
        (n, n_numbers) float : NaN where there is no usable simulation.
        """
        thetas = as_points(thetas, self.model.parameter_names)
        thetas = thetas if thetas.ndim == 2 else thetas[None]
        if np.isfinite(thetas).all():
            return self._statistics(thetas)
        result = np.full((len(thetas), self._width), np.nan)
        finite = np.isfinite(thetas).all(axis=1)
        if finite.any():
            result[finite] = self._statistics(thetas[finite])
        return result

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Measured less simulated response at one set of parameters: one simulation, neither counted nor kept.

        Parameters
        ----------
        theta : (n_structural,) or (ndim,) float
            Structural parameters; those of the noise may follow.

        Returns
        -------
        (n_channels, n_steps) float : [SI], in the order of the model's channels.

        Raises
        ------
        ValueError
            For another number of parameters.
        SimulationFailed
            If the simulation fails.
        """
        theta = np.asarray(theta, dtype=float)
        if theta.shape not in ((self._n_structural,), (self.ndim,)):
            raise ValueError(
                f"residuals are those of one set of parameters, of shape ({self._n_structural},) or ({self.ndim},) "
                f"with the noise's; got shape {theta.shape}"
            )
        response, (reason,) = simulate_batch(self.model, theta[None, : self._n_structural])
        if reason:
            raise SimulationFailed(reason)
        return self.measurements.values - response[0]

    def _statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Of finite rows. A single row that is remembered must not cost ten microseconds: few calls of numpy."""
        keys, distinct = distinct_keys(thetas)
        misfit, known = self._memory.look_up(keys, self._width)
        if all(known):
            self.cache_hits += len(thetas)
        else:
            known = np.array(known)
            new, on_disk = ~known, np.zeros(len(keys), dtype=bool)
            misfit[new], on_disk[new] = self._obtain([key for key, is_new in zip(keys, new, strict=True) if is_new])
            self.disk_hits += int(on_disk[distinct].sum())
            self.cache_hits += int((known | on_disk)[distinct].sum())
        return misfit if len(keys) == len(thetas) else misfit[distinct]

    def log_likelihood(self, x: Any) -> np.ndarray | float:
        """Log-likelihood of structural parameters followed by the noise's.

        Parameters
        ----------
        x : array_like (ndim,) or (n, ndim), or named values (see `as_points`)

        Returns
        -------
        float or (n,) float : -inf where a simulation fails, where the noise's parameters are impossible (nothing is
        simulated there) and where x is not finite; never NaN.
        """
        points = as_points(x, self.parameter_names)
        rows = np.atleast_2d(points)
        thetas, noise = np.split(rows, [self._n_structural], axis=1)
        n_steps = self.measurements.n_steps
        possible = np.isfinite(rows).all(axis=1)
        if self.fast_parameters:
            # a perfect fit tells which noise parameters are possible at all, before anything is simulated
            perfect = np.zeros((len(rows), self._width))
            possible &= ~np.isneginf(self.noise.log_likelihood(perfect, n_steps, noise))
        result = np.full(len(rows), -np.inf)
        if possible.any():
            misfit = self.statistics(thetas[possible])
            values = self.noise.log_likelihood(misfit, n_steps, noise[possible])
            usable = values < np.inf  # neither NaN nor infinite
            simulated = np.isfinite(misfit).all(axis=1)
            for row in np.flatnonzero(simulated & ~usable):
                self._record(thetas[possible][row], f"the log-likelihood of the noise is {values[row]}")
            result[possible] = np.where(simulated & usable, values, -np.inf)
        return result if points.ndim == 2 else float(result[0])

    def with_noise(self, noise: Any) -> "FELikelihood":
        """The same with another noise: model, measurements, pool, cache and bounds stay; counts and memory are new."""
        other = FELikelihood(
            self.model,
            self.measurements,
            noise,
            memory=self._memory.rows,
            cache=self.cache,
            max_failure_share=self.max_failure_share,
        )
        other.pool = self.pool
        return other

    def _obtain(self, keys: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
        """Statistics of rows that are not in memory, and which of them came from disk; the others are simulated."""
        thetas = np.frombuffer(b"".join(keys), dtype=float).reshape(len(keys), -1).copy()
        shape = len(keys), self._width
        misfit, on_disk = np.full(shape, np.nan), np.zeros(len(keys), dtype=bool)
        if self.cache is not None:
            misfit, reasons, on_disk = self.cache.look_up(self._key, thetas, shape[1], self.measurements.n_steps)
            for row in np.flatnonzero(on_disk):
                if reasons[row]:
                    self._record(thetas[row], reasons[row])
            self._memory.store([keys[row] for row in np.flatnonzero(on_disk)], misfit[on_disk])
        left = np.flatnonzero(~on_disk)
        least, most = self._chunk_limits(len(left)) if len(left) else (0, 0)
        while len(left):
            size = max(least, min(most, self._chunk))
            rows, left = left[:size], left[size:]
            start = time.perf_counter()
            misfit[rows] = self._simulate(thetas[rows])
            # not at once: the first ones may have failed in no time
            self._chunk = min(4 * size, 1 + int(_SECONDS_PER_CHUNK * len(rows) / (time.perf_counter() - start)))
            self._memory.store([keys[row] for row in rows], misfit[rows])
        return misfit, on_disk

    def _chunk_limits(self, n: int) -> tuple[int, int]:
        """How many of n simulations are run before they are stored, at least (all workers are busy) and at most."""
        if self.cache is None:
            return n, n
        most = max(1, _RESPONSE_VALUES // self.measurements.values.size) if self.cache.responses else n
        if self.pool is not None:
            workers = self.pool.n_workers or n
        elif hasattr(self.model, "misfit_batch") or hasattr(self.model, "simulate_batch"):
            workers = os.cpu_count() or 1
        else:
            return 1, most
        return min(_ROUNDS_PER_CHUNK * workers, most), most

    def _simulate(self, thetas: np.ndarray) -> np.ndarray:
        # asked before and not after a batch, so that what was simulated is remembered
        known = self.simulations + self.disk_hits
        if known >= _FEW_SIMULATIONS and self.failure_count > self.max_failure_share * known:
            (reason, count), *_ = self.failure_reasons.most_common(1)
            raise TooManyFailures(
                f"{self.failure_count} of {known} simulations failed, {count} because of {reason!r}, where "
                f"a share of {self.max_failure_share:g} is allowed: see failures and report(). Mend the model, "
                "narrow the prior, or allow for more with max_failure_share"
            )
        start = time.perf_counter()
        measured = self.measurements.values
        batch = None
        if self.cache is not None and self.cache.responses:
            batch = simulate_batch(self.model, thetas, self.pool)
            misfit, reasons = misfit_of_responses(self.model, batch, measured, self._statistic)
        else:
            misfit, reasons = misfit_batch(self.model, thetas, measured, self.pool, self._statistic)
        seconds = time.perf_counter() - start
        self.seconds += seconds
        self.simulations += len(thetas)
        for theta, reason in zip(thetas, reasons, strict=True):
            if reason:
                self._record(theta, reason)
        if self.cache is not None:
            if self.model.fingerprint != self._model_fingerprint:
                raise ValueError(
                    "the model has changed since the likelihood was made (its fingerprint is another one), and its "
                    "simulations cannot be kept with the old ones: make a new likelihood"
                )
            self.cache.store(self._key, thetas, self.measurements.n_steps, misfit, reasons, seconds)
            if batch is not None:
                self.cache.store_responses(self.model, thetas, batch.response)
        return misfit

    def _record(self, theta: np.ndarray, reason: str) -> None:
        parameters = dict(zip(self.model.parameter_names, theta.tolist(), strict=True))
        reason, seconds = split_seconds(reason)
        if not self.failure_count:
            logger.warning(
                "a simulation failed and counts as impossible: %s at %s; further ones are only counted, see report()",
                reason,
                parameters,
            )
        self.failure_count += 1
        if len(self.failures) < _RECORDED_FAILURES:
            self.failures.append({"parameters": parameters, "reason": reason})
            if seconds is not None:
                self.failures[-1]["seconds"] = seconds
        known = reason in self.failure_reasons or len(self.failure_reasons) < _RECORDED_REASONS
        self.failure_reasons[reason if known else _OTHER_REASONS] += 1


def _check_channels(model: Model, noise: Any) -> None:
    """ValueError where a noise is of other channels than the model's."""
    ours, theirs = (
        [c.name for c in channels] for channels in (model.channels, getattr(noise, "channels", model.channels))
    )
    if ours != theirs:
        raise ValueError(
            f"the noise is of the channels {', '.join(theirs)}, the model's are {', '.join(ours)}: make the noise with "
            "model.channels"
        )


def _matched(model: Model, measurements: Measurements) -> Measurements:
    """The measurements in the order of the model's channels, or ValueError with advice where the two do not fit."""
    expected = [channel.name for channel in model.channels]
    got = [channel.name for channel in measurements.channels]
    if sorted(expected) != sorted(got):
        raise ValueError(
            f"the model's channels are {', '.join(expected)}, the measurements' are {', '.join(got)}; "
            "choose the common ones with Measurements.select(names) and in the model"
        )
    matched = measurements if expected == got else measurements.select(expected)
    for ours, theirs in zip(model.channels, matched.channels, strict=True):
        words = [channel.quantity.split()[:-1] for channel in (ours, theirs)]
        if ours.dimension != theirs.dimension or (all(words) and words[0] != words[1]):
            raise ValueError(
                f"channel {ours.name!r} is {ours.quantity!r} in the model and {theirs.quantity!r} in the measurements"
            )
    if abs(matched.dt - model.dt) > 1e-9 * model.dt:
        raise ValueError(
            f"the model's response has a step of {model.dt} s, the measurements have {matched.dt} s; make them equal "
            "with Record.resample(dt) on the excitation or Measurements.decimate(factor)"
        )
    if matched.n_steps != model.n_steps:
        raise ValueError(
            f"the model's response has {model.n_steps} samples, the measurements have {matched.n_steps}; make them "
            "equal with Record.trim(start, stop) and Measurements.trim(start, stop)"
        )
    return matched
