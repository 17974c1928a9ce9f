"""Log-likelihood of model and noise parameters, given measurements.

The steps are: structural parameters to the response of the model, response to the sums of squared residuals J per
channel, J and the noise parameters to the log-likelihood. (A noise may need more numbers than J, its statistic of the
residuals, see `fe_likelihoods.noise.gaussian`.) A `Simulator` runs and caches the simulations
(`fe_likelihoods.likelihood.simulator`). The equations are on the page ``docs/theory/likelihood.rst``.
"""

import copy
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..noise.gaussian import GaussianNoise
from ..noise.protocol import Noise, noise_of_part, noise_statistic, noise_under
from ..noise.sufficient_statistics import count_samples
from ..priors.points import as_rows, complete_repr
from ..signals.channels import Comparison, Measurements
from ..signals.records import DisplacementHistory, events_of, growing_durations
from ..signals.sampling import SAME_TIME
from ..simulation.model import Model, SimulationBatch, first_part
from .check_inputs import check_model, check_noise, match_measurements
from .simulator import Simulator
from .sum_of_data_sets import SumOfDataSets

__all__ = ["FELikelihood"]


class FELikelihood(SumOfDataSets):
    """Log-likelihood of structural parameters and noise parameters, given measurements.

    Calling the object is `log_likelihood`.

    Parameters
    ----------
    model : Model
        Computes the response from structural parameters (see `fe_likelihoods.simulation.model`).
    measurements : Measurements, or mapping of str to Measurements
        For a model whose excitation is `Events`: measurements of single events, by their names; pauses and events
        without measurements are not compared (`Events.join`). Otherwise measurements of the model's channels (matched
        by name, in any order), up to the end of the model's response. NaN marks missing samples, which are left out. A
        channel may have its own step and start: the response is interpolated at the times of its samples, without a
        filter (`fe_likelihoods.signals.channels`).
    noise : Noise, optional
        `GaussianNoise`, `AutoregressiveNoise`, or any object with the protocol `Noise`. Default: `GaussianNoise` of the
        model's channels.
    pool : int, or object with ``map(function, items)``, optional
        Runs the simulations in parallel: a number of local processes, a dask.distributed client, an executor or a pool
        (see `fe_likelihoods.simulation.executors`). Without it, simulations run in this process: compiled models on
        threads, others one after the other. It is not pickled with the likelihood.
    memory_rows : int
        Number of simulations whose statistics are cached in memory (about 250 bytes each), failures included, so that
        they are not simulated again; 0 for none. The contents are not pickled with the likelihood: every process caches
        its own simulations.
    memory_bytes : int
        Largest size of the responses cached in memory [bytes], at 8 bytes per channel and sample: responses that
        `simulate` returned, as for a guide. The oldest are dropped. `with_noise` and `first` share them; they are not
        pickled. The default holds 1300 responses of two channels of 12 800 samples, more than a run with a guide needs.
    cache : SimulationCache or path, optional
        Cache on disk, used after the one in memory: simulations of earlier runs and of other processes are not run
        again. With a pool, simulations are stored as they arrive, so that a killed run loses only what runs. Without
        one, or with a pool that has ``map`` only, a batch is simulated in chunks of a
        few seconds that are stored one by one. The responses of `simulate` are stored as well, up to the
        `max_response_bytes` of the cache.

    Attributes
    ----------
    parameter_names : tuple of str
        Names of the structural parameters, then of the noise parameters.
    fast_parameters : tuple of int
        Indices of the parameters whose change needs no simulation: the noise parameters.
    simulator : Simulator
        Runs, counts and caches the simulations.
    n_samples : int or (n_channels,) ndarray
        Number of samples that are compared, in each channel if these differ.
    simulations, cache_hits, disk_hits, failures, ...
        The entries of `report`.
    shortened : list of FELikelihood
        Likelihoods of first parts of the measurements, see `first`.

    Raises
    ------
    ValueError
        If a member of `Model` is missing, if the channels or the durations of model and measurements differ, or the
        channels of the noise, if samples are missing and the noise has no rule for them, if parameter names repeat, if
        `pool` is neither a number nor has ``map`` or ``gather``, if the model cannot be sent to its processes, or if
        the file of the cache cannot be used.

    Warns
    -----
    UserWarning
        If noise is a share of the level in only a part of the motion, because samples are missing.

    Examples
    --------
    >>> likelihood = FELikelihood(model, measurements)
    >>> likelihood.parameter_names
    ('stiffness', 'damping', 'sigma_acceleration', 'sigma_displacement')
    >>> true, nominal = likelihood.log_likelihood([[1.1, 0.9, 0.5, 0.02], [1.0, 1.0, 0.5, 0.02]])
    >>> bool(true > nominal)
    True
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements | Mapping[str, Measurements],
        noise: Noise | None = None,
        pool: Any = None,
        *,
        memory_rows: int = 100_000,
        memory_bytes: int = 2**28,
        cache: SimulationCache | str | os.PathLike | None = None,
    ) -> None:
        check_model(model)
        if isinstance(measurements, Mapping):  # of single events
            measurements = events_of(model).join(measurements)
        measurements = match_measurements(model, measurements)
        noise = GaussianNoise(model.channels) if noise is None else noise
        check_noise(model, noise)
        self.noise = noise_of_part(noise_under(noise, model), measurements)
        structural, others = tuple(model.parameter_names), tuple(self.noise.parameter_names)
        self.parameter_names = structural + others
        if len(set(self.parameter_names)) != len(self.parameter_names):
            raise ValueError(f"the names of model and noise must differ; got {', '.join(self.parameter_names)}")
        self._columns = {"": list(range(len(self.parameter_names)))}
        self.fast_parameters = tuple(self._columns[""][len(structural) :])
        options = {"pool": pool, "cache": cache, "memory_rows": memory_rows, "memory_bytes": memory_bytes}
        self.simulator = self._make_simulator(model, measurements, **options)
        self.n_samples = count_samples(getattr(self.measured, "values", self.measured))
        self.shortened: list[FELikelihood] = []

    def _make_simulator(self, model: Model, measurements: Measurements, **options: Any) -> Simulator:
        return Simulator(model, measurements, noise_statistic(self.noise), **options)

    def __getstate__(self) -> dict:
        return self.__dict__ | {"shortened": []}

    @property
    def likelihoods(self) -> dict[str, "FELikelihood"]:
        """This likelihood, under an empty name."""
        return {"": self}

    @property
    def model(self) -> Model:
        """The model."""
        return self.simulator.model

    @property
    def measurements(self) -> Measurements:
        """The measurements, in the order of the model's channels."""
        return self.simulator.measurements

    @property
    def measured(self) -> np.ndarray | Comparison:
        """What responses are compared with: values (n_channels, n_steps), or a `Comparison` if samples are missing."""
        return self.simulator.measured

    def first(self, seconds: float) -> "FELikelihood":
        """The likelihood of the first part of the measurements, for models that can be shortened (`first_part`).

        Noise, pool, limits, cache on disk and the responses in memory are kept; counts start at zero. `shortened` keeps
        the result, for reports of all simulations.

        Parameters
        ----------
        seconds : float
            Time of the last sample [s]; between two samples, the earlier one is the last.

        Returns
        -------
        FELikelihood

        Raises
        ------
        ValueError
            If the model cannot be shortened, or the time is not within the measurements.

        Examples
        --------
        >>> likelihood.first(5.0).n_samples
        101
        """
        measurements = self.measurements.trim(0.0, seconds)
        # the time of a sample, which leaves no doubt about the length of the response
        steps = math.ceil(measurements.end / self.model.dt - SAME_TIME)
        model = first_part(self.model, min(steps, self.model.n_steps - 1) * self.model.dt)
        self.shortened.append(self._with(model, measurements, self.noise))
        return self.shortened[-1]

    def first_parts(self, shares: Sequence[float]) -> list["FELikelihood"]:
        """The likelihoods of the first parts of the measurements, up to shares of their Arias intensity.

        Those of a model without ``first`` have missing samples instead. None where channels are not simultaneous, or
        samples are not along time, or the test is static: no errors of a period add up to a phase there.
        """
        static = isinstance(getattr(self.model, "loading", None), DisplacementHistory)
        if static or not self.measurements.is_history or not self.measurements.simultaneous:
            return []
        found, measured = [], self.measurements
        steps = np.nan_to_num(np.diff(measured.values, axis=1))  # because a residual displacement is not motion
        for seconds in growing_durations(steps, measured.dt, shares)[:-1] if steps.any() else ():
            later = measured.dt * np.arange(measured.values.shape[1]) > seconds + SAME_TIME
            values = np.where(later, np.nan, measured.values)
            # a channel that is still at rest, or has no sample in this part, says nothing of its noise
            if not np.nan_to_num(values).any(axis=1).all():
                continue
            if hasattr(self.model, "first"):
                found.append(self.first(measured.start + seconds))
            else:
                found.append(self._with(self.model, dataclasses.replace(measured, values=values), self.noise))
        return found

    def residuals_of(self, response: np.ndarray) -> np.ndarray:
        """Measured minus simulated response (n_channels, n_steps) [SI], in the order of the model's channels.

        NaN where a sample is missing. Nothing is simulated.

        Examples
        --------
        >>> likelihood.residuals_of(model.simulate([1.1, 0.9])).shape
        (2, 200)
        """
        response = np.asarray(response, dtype=float)
        if isinstance(self.measured, Comparison):
            return -self.measured.residuals(response)
        return self.measurements.values - response

    def misfit(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared residuals (n, n_channels) [SI unit squared] at structural parameters; NaN for failures."""
        return self.simulator.statistics(thetas)[:, : self.measurements.n_channels]

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) at structural parameters, which are cached, see `Simulator.run`."""
        return self.run(thetas)[1]

    def run(self, thetas: np.ndarray) -> tuple[np.ndarray, SimulationBatch]:
        """Statistics (n, n_numbers) and responses at structural parameters, see `Simulator.run`."""
        return self.simulator.run(as_rows(thetas, self.model.parameter_names), full=True)

    def of_statistics(self, rows: np.ndarray, misfit: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) of points (n, ndim) from the statistics (n, n_numbers) of their simulations.

        -inf where the simulation failed, or where the noise parameters are impossible.
        """
        values = self.noise.log_likelihood(misfit, self.n_samples, rows[:, self.simulator.n_structural :])
        simulated = np.isfinite(misfit).all(axis=1)
        usable = simulated & (values < np.inf)  # neither NaN nor infinite
        if usable.all():
            return values
        if (wrong := simulated & ~usable).any():
            for row in np.flatnonzero(wrong & self.possible(rows)):
                reason = f"the log-likelihood of the noise is {values[row]}"
                self.simulator.failures.add(rows[row, : self.simulator.n_structural], reason)
        return np.where(usable, values, -np.inf)

    def possible(self, rows: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) is finite and has possible noise parameters; nothing is simulated."""
        possible = np.isfinite(rows).all(axis=1)
        if self.fast_parameters:
            # statistics of zero (a perfect fit) show before any simulation which noise parameters are possible
            perfect = np.zeros((len(rows), self.simulator.n_numbers))
            noise = rows[:, self.simulator.n_structural :]
            possible &= ~np.isneginf(self.noise.log_likelihood(perfect, self.n_samples, noise))
        return possible

    def density_parts(self) -> list[str]:
        """Fingerprint of the statistics, and class, parameters and repr of the noise."""
        noise = self.noise
        return [self.simulator.fingerprint, type(noise).__qualname__, *noise.parameter_names, complete_repr(noise)]

    def with_noise(self, noise: Noise) -> "FELikelihood":
        """The same likelihood with another noise.

        Model, measurements, pool, limits, cache on disk and the responses in memory are kept; counts start
        at zero.
        """
        return self._with(self.model, self.measurements, noise)

    def _with(self, model: Model, measurements: Measurements, noise: Noise) -> "FELikelihood":
        own = self.simulator
        options = {"memory_rows": own.memory_cache.most, "memory_bytes": own.response_memory.most}
        other = copy.copy(self)
        FELikelihood.__init__(other, model, measurements, noise, own.pool, cache=own.cache, **options)
        other.simulator.response_memory = own.response_memory
        other.simulator.share_trust(own)
        return other
