"""Statistics of a quantity that are accumulated while responses arrive in batches."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..noise.draws import SampleNoise
from ..simulation.model import is_collapse, split_seconds
from .model_error import ModelError
from .streaming import RetainedResults, RunningMoments

__all__ = ["Accumulator"]


@dataclass(eq=False)
class Accumulator:
    """Evaluates a quantity of responses and accumulates its statistics, by result and by sample.

    A result is the value of the quantity for one response. Without noise, equal samples share one result. With noise,
    every sample has its own.
    """

    members: list[np.ndarray]  # sample indices for each distinct theta
    noise: SampleNoise | ModelError | None  # None: without noise
    evaluate: Callable[[np.ndarray], np.ndarray] | None  # of a response (n_channels, n_steps) [SI]; None for histories
    rows: list[int] | None  # of the response whose histories are wanted, or None
    result_of_sample: np.ndarray  # (n,)
    probabilities: tuple[float, ...]  # of the quantiles
    memory_bytes: int | None  # of the retained results [bytes]; None: no limit
    seeds: np.random.SeedSequence  # of the noise and of the choice of retained samples
    moments: RunningMoments = field(default_factory=RunningMoments)  # of histories without noise
    noise_variance: RunningMoments = field(default_factory=RunningMoments)  # of histories; per step for some noises
    retained: RetainedResults | None = None  # results for quantiles
    failed: list[np.ndarray] = field(default_factory=list)  # indices of samples that are left out
    collapsed: list[np.ndarray] = field(default_factory=list)  # indices of samples whose structure collapsed
    reasons: Counter = field(default_factory=Counter)  # samples left out per reason, without durations
    shape: tuple[int, ...] | None = None  # of a result; None until it is known

    def allocate(self, shape: tuple[int, ...]) -> None:
        """Allocate memory for retained results, once the shape of a result is known."""
        self.shape = shape
        histories = self.rows is not None
        if histories and not self.probabilities:
            return
        # Numbers are retained whatever the limit; arrays without quantiles only if all of them fit.
        limit = None if shape == () else self.memory_bytes
        n_results = int(self.result_of_sample.max()) + 1
        fits = limit is None or 8 * int(np.prod(shape)) * n_results <= limit
        if not self.probabilities and not fits:
            return
        rng = np.random.default_rng(np.random.SeedSequence(self.seeds.entropy, spawn_key=(0,)))
        dtype = np.float32 if histories and not fits else np.float64
        self.retained = RetainedResults(self.result_of_sample, shape, dtype, limit, rng)

    def add(self, start: int, responses: np.ndarray, reasons: list[str]) -> None:
        """Add responses (m, n_channels, n_steps) [SI] of the distinct thetas from index `start` on.

        The reasons say why each simulation failed, empty for a success.
        """
        members = self.members[start : start + len(responses)]
        usable = []
        for j, reason in enumerate(reasons):
            if reason:
                self._leave_out(members[j], reason)
            else:
                usable.append(j)
        if not usable:
            return
        if self.rows is not None:
            every = len(usable) == len(responses) and self.rows == list(range(responses.shape[1]))
            histories = responses if every else responses[np.ix_(usable, self.rows)]
            self._add_histories(start, histories, usable, members, responses)
        elif self.noise is None:
            values = [self._value(responses[j]) for j in usable]
            self._add_values(values, [start + j for j in usable], [members[j] for j in usable])
        else:
            for j in usable:
                values = [self._value(responses[j] + self._noise(i, responses[j])) for i in members[j]]
                self._add_values(values, list(members[j]), [np.array([i]) for i in members[j]])

    def _add_histories(
        self,
        start: int,
        histories: np.ndarray,
        usable: list[int],
        members: Sequence[np.ndarray],
        responses: np.ndarray,
    ) -> None:
        self.moments.add(histories, np.array([len(members[j]) for j in usable]))
        if self.noise is None:
            if self.retained is not None:
                self.retained.add(start + np.array(usable), histories)
            return
        if self.noise.of_response is not None:
            for j in usable:
                for i in members[j]:
                    variance = np.square(self.noise.of_response(self.noise.deviations[i], responses[j])[self.rows])
                    self.noise_variance.add(variance[None], np.ones(1))
        else:
            samples = np.concatenate([members[j] for j in usable])
            self.noise_variance.add(np.square(self.noise.deviations[samples][..., self.rows]), np.ones(len(samples)))
        if self.retained is None:
            return
        for history, j in zip(histories, usable, strict=True):
            for i in members[j]:
                if i in self.retained:
                    # Noise is drawn for all channels, so that it does not depend on which channels are wanted.
                    noise = self._noise(i, responses[j])
                    self.retained.add(np.array([i]), (history + noise[self.rows])[None])

    def _add_values(self, values: list[np.ndarray], results: list[int], members: list[np.ndarray]) -> None:
        finite = [bool(np.isfinite(value).all()) for value in values]
        for usable, samples in zip(finite, members, strict=True):
            if not usable:
                self._leave_out(samples, "the quantity is not finite")
        if any(finite):
            rows = np.array([value for value, usable in zip(values, finite, strict=True) if usable])
            counts = np.array([len(samples) for samples, usable in zip(members, finite, strict=True) if usable])
            self.moments.add(rows, counts)
            if self.retained is not None:
                self.retained.add(np.array(results)[finite], rows)

    def _value(self, response: np.ndarray) -> np.ndarray:
        value = np.asarray(self.evaluate(response), dtype=float)
        if self.shape is None:
            self.allocate(value.shape)
        if value.shape != self.shape:
            raise ValueError(f"quantity must return one shape for every response; got {self.shape}, then {value.shape}")
        return value

    def _noise(self, sample: int, response: np.ndarray) -> np.ndarray:
        # Each sample has its own random stream, so that its noise depends neither on batches nor on failures.
        rng = np.random.default_rng(np.random.SeedSequence(self.seeds.entropy, spawn_key=(1, int(sample))))
        return self.noise.draw(int(sample), response.shape[1], rng, response)

    def _leave_out(self, samples: np.ndarray, reason: str) -> None:
        self.failed.append(samples)
        if is_collapse(reason):
            self.collapsed.append(samples)
        self.reasons[split_seconds(reason)[0]] += len(samples)
