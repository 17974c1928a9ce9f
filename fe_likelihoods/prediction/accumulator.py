"""What goes into a prediction, checked, and what is kept of its simulations while they come in, batch by batch."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..probability.likelihood import as_points
from ..simulation.executors import as_executor
from ..simulation.memory_cache import distinct_keys
from .streaming import Kept, Moments

__all__ = ["Gathered", "distinct_rows", "members_of", "parts_of", "split_samples"]


def parts_of(thing: Any, pool: Any) -> tuple[Any, Any, Any]:
    """Model, noise (None for a bare model; with its parameters, where they were integrated out) and pool."""
    likelihood = getattr(thing, "likelihood", thing)
    if hasattr(likelihood, "measurements") and hasattr(likelihood, "model"):
        pool = getattr(likelihood, "pool", None) if pool is None else as_executor(pool, likelihood.model)
        return likelihood.model, getattr(likelihood.noise, "noise", likelihood.noise), pool
    if not (hasattr(thing, "simulate") and hasattr(thing, "parameter_names")):
        raise ValueError(f"expected a Posterior, an FELikelihood or a model with simulate(theta); got {thing!r}")
    return thing, None, as_executor(pool, thing)


class SampleNoise(NamedTuple):
    """The noise of every sample: `deviations` (n, n_channels) [SI], and the correlation of successive errors, `lag_one`
    (n, n_channels), None for white noise."""

    deviations: np.ndarray
    lag_one: np.ndarray | None

    def draw(self, sample: int, n_steps: int, stream: np.random.Generator) -> np.ndarray:
        """Errors (n_channels, n_steps) [SI] of one sample."""
        errors = stream.standard_normal((self.deviations.shape[1], n_steps))
        if self.lag_one is not None:
            from scipy.signal import lfilter  # where used: slow to import, and rarely needed

            for row, rho in zip(errors, self.lag_one[sample], strict=True):
                # e_t = rho e_{t-1} + sqrt(1 - rho^2) z_t, with the first one as large as all others
                row[1:] *= np.sqrt((1.0 - rho) * (1.0 + rho))
                row[:] = lfilter([1.0], [1.0, -rho], row)
        return self.deviations[sample][:, None] * errors


def split_samples(model: Any, noise_model: Any, samples: Any, noise: bool) -> tuple[np.ndarray, SampleNoise | None]:
    """Structural parameters (n, n_structural), and the noise of each sample if it is wanted."""
    structural = tuple(model.parameter_names)
    names = structural + (() if noise_model is None else tuple(noise_model.parameter_names))
    if noise and noise_model is None:
        raise ValueError("noise=True needs the posterior, whose samples have the noise's parameters; got a model")
    width = len(samples) if isinstance(samples, Mapping) else np.shape(samples)[-1:]
    alone = not noise and width in (len(structural), (len(structural),))
    try:
        points = as_points(samples, structural if alone else names)
    except TypeError as error:
        raise ValueError(f"samples must be numbers, (n, {len(names)}): {error}") from error
    if points.ndim != 2 or len(points) == 0:
        raise ValueError(
            f"expected samples of shape (n, {len(names)}), as sampler.get_chain(flat=True) gives; got {points.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(
            f"samples must be finite: {bad.size} of {len(points)} are not, the first is sample {bad[0]}: "
            f"{points[bad[0]]}; leave them out"
        )
    thetas = points[:, : len(structural)]
    if not noise:
        return thetas, None
    if not hasattr(noise_model, "standard_deviations"):
        raise ValueError(
            f"{type(noise_model).__name__} cannot be drawn from: give it a method standard_deviations(parameters (n, "
            "n_parameters)) that returns (n, n_channels) in SI"
        )
    deviations = np.asarray(noise_model.standard_deviations(points[:, len(structural) :]), dtype=float)
    if deviations.shape != (len(points), len(model.channels)) or not np.all((deviations > 0) & (deviations < np.inf)):
        raise ValueError(
            f"the noise needs a positive standard deviation for each of {len(points)} samples and "
            f"{len(model.channels)} channels; got shape {deviations.shape}, smallest {deviations.min(initial=np.inf)}"
        )
    if not hasattr(noise_model, "lag_one_correlations"):
        return thetas, SampleNoise(deviations, None)
    lag_one = np.asarray(noise_model.lag_one_correlations(points[:, len(structural) :]), dtype=float)
    if lag_one.shape != deviations.shape or not np.all(np.abs(lag_one) < 1.0):
        raise ValueError(
            f"the noise needs a correlation between -1 and 1 for each of {len(points)} samples and "
            f"{len(model.channels)} channels; got shape {lag_one.shape}, largest {np.abs(lag_one).max(initial=0.0)}"
        )
    return thetas, SampleNoise(deviations, lag_one)


@dataclass(eq=False)
class Gathered:
    """What is left of the simulations while they come in.

    A result is what is computed from one response; with noise every sample has its own, else equal samples share one.
    """

    members: list[np.ndarray]  # indices of the samples of each distinct theta
    noise: SampleNoise | None
    evaluate: Callable[[np.ndarray], np.ndarray]
    rows: list[int] | None  # channels whose histories are wanted
    result_of_sample: np.ndarray
    probabilities: tuple[float, ...]
    memory: int | None
    seeds: np.random.SeedSequence
    moments: Moments = field(default_factory=Moments)
    noise_variance: Moments = field(default_factory=Moments)
    kept: Kept | None = None
    failed: list[np.ndarray] = field(default_factory=list)
    reasons: Counter = field(default_factory=Counter)
    shape: tuple[int, ...] | None = None

    def prepare(self, shape: tuple[int, ...]) -> None:
        """Room for what is kept, once the shape of a result is known."""
        self.shape = shape
        histories = self.rows is not None
        if histories and not self.probabilities:
            return
        # numbers are kept whatever the memory; of arrays without quantiles, what fits
        bound = None if shape == () else self.memory
        fits = bound is None or self._bytes(shape) <= bound
        if not self.probabilities and not fits:
            return
        rng = np.random.default_rng(np.random.SeedSequence(self.seeds.entropy, spawn_key=(0,)))
        self.kept = Kept(self.result_of_sample, shape, np.float32 if histories and not fits else np.float64, bound, rng)

    def _bytes(self, shape: tuple[int, ...]) -> int:
        return 8 * int(np.prod(shape)) * (int(self.result_of_sample.max()) + 1)

    def add(self, start: int, responses: np.ndarray, reasons: list[str]) -> None:
        """Enter the responses of the distinct thetas from `start` on."""
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
            self._add_histories(start, responses if every else responses[np.ix_(usable, self.rows)], usable, members)
        elif self.noise is None:
            values = [self._value(responses[j]) for j in usable]
            self._add_values(values, [start + j for j in usable], [members[j] for j in usable])
        else:
            for j in usable:
                values = [self._value(responses[j] + self._noise(i, responses.shape[2])) for i in members[j]]
                self._add_values(values, list(members[j]), [np.array([i]) for i in members[j]])

    def _add_histories(
        self, start: int, histories: np.ndarray, usable: list[int], members: Sequence[np.ndarray]
    ) -> None:
        self.moments.add(histories, np.array([len(members[j]) for j in usable]))
        if self.noise is None:
            if self.kept is not None:
                self.kept.add(start + np.array(usable), histories)
            return
        everyone = np.concatenate([members[j] for j in usable])
        self.noise_variance.add(np.square(self.noise.deviations[everyone][:, self.rows]), np.ones(len(everyone)))
        if self.kept is None:
            return
        for history, j in zip(histories, usable, strict=True):
            for i in members[j]:
                if i in self.kept:
                    # drawn for all channels: what one of them reads does not depend on which others are asked for
                    noise = self._noise(i, history.shape[1])
                    self.kept.add(np.array([i]), (history + noise[self.rows])[None])

    def _add_values(self, values: list[np.ndarray], results: list[int], members: list[np.ndarray]) -> None:
        finite = [bool(np.isfinite(value).all()) for value in values]
        for fine, who in zip(finite, members, strict=True):
            if not fine:
                self._leave_out(who, "the quantity is not finite")
        if any(finite):
            rows = np.array([value for value, fine in zip(values, finite, strict=True) if fine])
            counts = np.array([len(who) for who, fine in zip(members, finite, strict=True) if fine])
            self.moments.add(rows, counts)
            if self.kept is not None:
                self.kept.add(np.array(results)[finite], rows)

    def _value(self, response: np.ndarray) -> np.ndarray:
        value = np.asarray(self.evaluate(response), dtype=float)
        if self.shape is None:
            self.prepare(value.shape)
        if value.shape != self.shape:
            raise ValueError(f"quantity must return one shape for every response; got {self.shape}, then {value.shape}")
        return value

    def _noise(self, sample: int, n_steps: int) -> np.ndarray:
        # a stream a sample: neither batches nor failures change what it gets
        stream = np.random.default_rng(np.random.SeedSequence(self.seeds.entropy, spawn_key=(1, int(sample))))
        return self.noise.draw(int(sample), n_steps, stream)

    def _leave_out(self, members: np.ndarray, reason: str) -> None:
        self.failed.append(members)
        self.reasons[reason] += len(members)


def distinct_rows(thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in the order of their first appearance, and which of them each row is."""
    keys, result = distinct_keys(thetas)
    return np.frombuffer(b"".join(keys), dtype=float).reshape(len(keys), -1).copy(), np.array(result)


def members_of(result_of_theta: np.ndarray, n_results: int) -> list[np.ndarray]:
    """Which rows are each of the distinct ones."""
    order = np.argsort(result_of_theta, kind="stable")
    return np.split(order, np.cumsum(np.bincount(result_of_theta, minlength=n_results))[:-1])
