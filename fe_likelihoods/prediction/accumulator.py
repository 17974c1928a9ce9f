"""Mean, variance and quantiles of a quantity over samples, from responses that arrive in batches.

Mean and variance need one pass, over differences to the first response: "mean square minus squared mean" of the values
themselves loses digits. Quantiles need the values. See ``docs/theory/prediction.rst``.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from ..noise.draws import SampleNoise
from .model_error import ModelError
from .quantities import Evaluator

__all__ = ["Accumulator", "RunningMoments"]

_IN_DOUBLE = 2**29  # bytes of histories; larger ones are kept in single precision, which has seven digits
_MOST = 2**32  # bytes in single precision: 500 samples of 20 channels with 100 000 steps
_CHUNK = 2**18  # values that are sorted at once


class RunningMoments:
    """Running mean (None before the first sample) and variance of `count` equally shaped arrays."""

    def __init__(self) -> None:
        self.count, self._first, self._sum, self._squares = 0.0, None, 0.0, 0.0

    def add(self, values: np.ndarray, counts: np.ndarray) -> None:
        """Add results `values` (m, ...) that stand for `counts` (m,) samples each."""
        self._first = values[0].copy() if self._first is None else self._first
        self.count += float(counts.sum())
        with np.errstate(over="ignore"):  # unstable responses may have an infinite variance
            shifted = values - self._first
            self._sum = self._sum + np.tensordot(counts, shifted, axes=1)
            self._squares = self._squares + np.tensordot(counts, np.square(shifted, out=shifted), axes=1)

    @property
    def mean(self) -> np.ndarray | None:
        """Mean, shape (...)."""
        return None if self._first is None else self._first + self._sum / self.count

    @property
    def variance(self) -> np.ndarray:
        """Mean squared deviation from the mean, shape (...)."""
        with np.errstate(over="ignore", invalid="ignore"):
            variance = np.maximum(self._squares / self.count - np.square(self._sum / self.count), 0.0)
        return np.where(np.isfinite(self._squares), variance, np.inf)


class Accumulator:
    """Evaluates a quantity of responses and keeps its values: one per response, with noise one per sample.

    `members` are the sample indices of each distinct parameter set; histories are kept if `keep`, for their quantiles.
    """

    def __init__(
        self,
        quantity: Evaluator,
        members: Sequence[np.ndarray],
        noise: SampleNoise | ModelError | None,
        keep: bool,
        entropy: int,
        n_steps: int,
    ) -> None:
        self.quantity, self.members, self.noise, self.keep = quantity, members, noise, keep
        n = sum(len(each) for each in members)
        self.result_of_sample = np.arange(n)  # with noise
        if noise is None:
            for row, each in enumerate(members):
                self.result_of_sample[each] = row
        self.moments = RunningMoments()  # of histories without the noise
        self.noise_variance = RunningMoments()  # of histories; per step for some noises
        self.failed: list[np.ndarray] = []  # indices of samples that are left out
        self.collapsed: list[np.ndarray] = []  # indices of samples whose structure collapsed
        self.reasons: Counter = Counter()  # samples left out per reason, without durations
        self.shape: tuple[int, ...] | None = None  # of a value; None until it is known
        self._entropy = entropy
        shape = quantity.shape if quantity.rows is None else (len(quantity.rows), n_steps)
        if shape is not None:
            self._allocate(shape)

    def _allocate(self, shape: tuple[int, ...]) -> None:
        """Memory for the values, once their shape is known; ValueError for histories beyond the limit."""
        self.shape, histories = shape, self.quantity.rows is not None
        if histories and not self.keep:
            return
        n = self.result_of_sample.max() + 1
        values = n * int(np.prod(shape))
        if histories and 4 * values > _MOST:
            raise ValueError(
                f"quantiles of these histories need {4e-9 * values:.1f} GB, at most {1e-9 * _MOST:.1f} are used: "
                "predict fewer channels, take fewer samples, or use quantiles=() for mean and variance only"
            )
        dtype = np.float32 if histories and 8 * values > _IN_DOUBLE else np.float64
        self._kept = np.empty((n, *shape), dtype=dtype)

    def add(self, start: int, responses: np.ndarray, reasons: list[str]) -> None:
        """Add responses (m, n_channels, n_steps) [SI] of the distinct parameters from index `start` on.

        The reasons say why each simulation failed, empty for a success.
        """
        members, rows = self.members[start : start + len(responses)], self.quantity.rows
        usable = np.array([j for j, reason in enumerate(reasons) if not reason], dtype=int)
        for j, reason in enumerate(reasons):
            if reason:
                self._leave_out(members[j], reason)
        if not len(usable):
            return
        if rows is not None:
            every = len(usable) == len(responses) and rows == list(range(responses.shape[1]))
            histories = responses if every else responses[np.ix_(usable, rows)]
            self.moments.add(histories, np.array([len(members[j]) for j in usable]))
            if self.noise is not None:
                self._add_noisy(histories, responses[usable], [members[j] for j in usable])
            elif self.keep:
                self._keep(start + usable, histories)
        elif self.noise is None:
            values = [self._value(responses[j]) for j in usable]
            self._add_values(values, start + usable, [members[j] for j in usable])
        else:
            for j in usable:
                values = [self._value(responses[j] + self._noise(i, responses[j])) for i in members[j]]
                self._add_values(values, members[j], [np.array([i]) for i in members[j]])

    def _add_noisy(self, histories: np.ndarray, responses: np.ndarray, members: list[np.ndarray]) -> None:
        """Variance of the noise, and a draw of it for each sample, for all channels whichever are wanted."""
        rows, noise = self.quantity.rows, self.noise
        if noise.of_response is None:
            samples = np.concatenate(members)
            self.noise_variance.add(np.square(noise.deviations[samples][..., rows]), np.ones(len(samples)))
        for history, response, samples in zip(histories, responses, members, strict=True):
            for i in samples:
                if noise.of_response is not None:
                    variance = np.square(noise.of_response(noise.deviations[i], response)[rows])
                    self.noise_variance.add(variance[None], np.ones(1))
                if self.keep:
                    self._keep([i], (history + self._noise(i, response)[rows])[None])

    def _add_values(self, values: list[np.ndarray], results: np.ndarray, members: list[np.ndarray]) -> None:
        finite = np.array([bool(np.isfinite(value).all()) for value in values])
        for usable, samples in zip(finite, members, strict=True):
            if not usable:
                self._leave_out(samples, "the quantity is not finite")
        if finite.any():
            rows = np.array(values)[finite]
            self.moments.add(rows, np.array([len(samples) for samples in members])[finite])
            self._keep(np.asarray(results)[finite], rows)

    def _keep(self, results: Sequence[int], values: np.ndarray) -> None:
        largest = float(np.finfo(self._kept.dtype).max)  # unstable responses stay finite in single precision
        self._kept[results] = np.clip(values, -largest, largest)

    def _value(self, response: np.ndarray) -> np.ndarray:
        value = np.asarray(self.quantity.function(response), dtype=float)
        if self.shape is None:
            self._allocate(value.shape)
        if value.shape != self.shape:
            raise ValueError(f"quantity must return one shape for every response; got {self.shape}, then {value.shape}")
        return value

    def _noise(self, sample: int, response: np.ndarray) -> np.ndarray:
        # Each sample has its own random stream, so that its noise depends neither on batches nor on failures.
        rng = np.random.default_rng(np.random.SeedSequence(self._entropy, spawn_key=(1, int(sample))))
        return self.noise.draw(int(sample), response.shape[1], rng, response)

    def _leave_out(self, samples: np.ndarray, reason: str) -> None:
        self.failed.append(samples)
        if reason.startswith("collapse"):
            self.collapsed.append(samples)
        self.reasons[reason] += len(samples)

    def values_of(self, samples: np.ndarray) -> np.ndarray:
        """Values (m, ...) of samples that did not fail."""
        return self._kept[self.result_of_sample[samples]]

    def quantiles(self, samples: np.ndarray, probabilities: Sequence[float]) -> np.ndarray:
        """Quantiles (n_probabilities, ...) over samples that did not fail.

        The k-th of n ordered samples is the quantile k / (n + 1), so a further sample lies inside a band with the
        probability of the band; by numpy's default, 20 samples have bands of 90 % that hold 81 %. Hyndman & Fan (1996),
        The American Statistician 50, 361-365, definition 6.
        """
        kept = self._kept.reshape(len(self._kept), -1)
        results, out = self.result_of_sample[samples], np.empty((len(probabilities), kept.shape[1]))
        columns = max(1, _CHUNK // len(results))
        for start in range(0, kept.shape[1], columns):
            part = slice(start, start + columns)
            out[:, part] = np.quantile(kept[results, part].astype(float), probabilities, axis=0, method="weibull")
        return out.reshape(len(probabilities), *self.shape)
