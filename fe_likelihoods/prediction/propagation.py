"""Uncertainty propagation: what the uncertainty of the parameters means for a response.

A quantity g of the response (a history, a peak, anything computed from it) has under the posterior the mean and the
variance ::

    E[g]   = integral of g(theta) p(theta | data)     ~  1/N sum_j g(theta_j)
    Var[g] = E[g^2] - E[g]^2                          ~  1/N sum_j (g(theta_j) - E[g])^2

(equations 9 to 13 of the isolated bridge's paper), estimated over samples theta_j of the posterior. The samples are
simulated batch by batch; equal ones, which resampling makes many of, once. Mean and variance come from all of them in
one pass, quantiles from as many as fit into a given memory. What failed is counted, named and left out.

References
----------
Papadimitriou, Beck & Katafygiotis (2001), Updating robust reliability using structural test data, Probabilistic
Engineering Mechanics 16(2), 103-113, doi:10.1016/S0266-8920(00)00012-6
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from ..signals.channels import Channel, Measurements
from ..signals.error_measures import rrmse, sum_of_squares
from ..signals.sampling import same_sampling
from ..simulation.model import SimulationFailed, simulate_batch
from .accumulator import Gathered, distinct_rows, members_of, parts_of, split_samples
from .quantities import Quantity, evaluator

__all__ = ["Prediction", "fit_measures", "propagate"]

logger = logging.getLogger(__name__)

_BATCH_VALUES = 2**22  # response values in one batch: 32 MiB
_LARGEST_BATCH = 256


@dataclass(frozen=True, eq=False)
class Prediction:
    """Moments and quantiles of a quantity over samples of the parameters; `shape` is the quantity's, values are SI.

    Attributes
    ----------
    mean, variance : (*shape) float — of histories the shape is (n_channels, n_steps), of a peak ().
    standard_error : (*shape) float — Monte-Carlo error of `mean`: standard deviation / sqrt(effective sample size).
    probabilities : tuple of float — of the quantiles.
    quantiles, quantile_error : (n_probabilities, *shape) float — and their Monte-Carlo errors.
    values : (n_samples, *shape) float, or None — the quantity of every sample in their order, without those that
        failed; None for histories, and for arrays that did not fit into the memory.
    n_samples : int — samples that mean and variance are of.
    n_quantile : int — samples that the quantiles are of: fewer where not all fitted into the memory.
    effective_sample_size : float — independent samples that they were taken to be worth.
    failed : (n_failed,) int — indices of the given samples that are left out, because their simulation failed or
        their quantity is not finite.
    failure_reasons : dict of str to int — samples left out for each reason.
    channels : tuple of Channel — channels of the histories, or those whose quantities the values are; () for a
        function of the whole response.
    dt : float or None — step of the histories [s]; None for other quantities.
    noise : bool — whether the noise of the measurement is included.
    """

    mean: np.ndarray
    variance: np.ndarray
    standard_error: np.ndarray
    probabilities: tuple[float, ...]
    quantiles: np.ndarray
    quantile_error: np.ndarray
    values: np.ndarray | None
    n_samples: int
    n_quantile: int
    effective_sample_size: float
    failed: np.ndarray
    failure_reasons: dict[str, int]
    channels: tuple[Channel, ...] = ()
    dt: float | None = None
    noise: bool = False

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation, (*shape)."""
        return np.sqrt(self.variance)

    @property
    def n_failed(self) -> int:
        """Samples left out."""
        return len(self.failed)

    @property
    def time(self) -> np.ndarray:
        """Times of the samples of the histories, from zero, (n_steps,) [s]; ValueError for other quantities."""
        self._need_histories()
        return np.arange(self.mean.shape[1]) * self.dt

    def quantile(self, probability: float) -> np.ndarray:
        """The quantile (*shape) of one of the `probabilities`; ValueError for another one."""
        if probability not in self.probabilities:
            raise ValueError(
                f"no quantile {probability!r} in this prediction, it has {self.probabilities}: propagate with "
                f"quantiles=(..., {probability!r})"
            )
        return self.quantiles[self.probabilities.index(probability)]

    def rrmse(self, measurements: Measurements, part: slice = slice(None)) -> np.ndarray:
        """Relative root mean square error of the mean, per channel [-].

        Root of sum (mean - measured)^2 / sum measured^2 over the samples of the history, or of a part of it.

        Returns
        -------
        (n_channels,) float : in the order of `channels`.

        Raises
        ------
        ValueError
            If the prediction has no histories, or the measurements lack a channel or differ in step or length, or a
            measured channel is zero.
        """
        measured = self._measured(measurements)[:, part]
        return rrmse(self.mean[:, part], measured, [channel.name for channel in self.channels])

    def coverage(
        self, measurements: Measurements, lower: float = 0.05, upper: float = 0.95, part: slice = slice(None)
    ) -> np.ndarray:
        """Share of the measured samples between two quantiles, per channel [-]; of a part of the history, if wanted.

        A prediction with noise should have about ``upper - lower``; one without bounds the response, not what a sensor
        reads, and has less. Same result and errors as `rrmse`; ValueError too where a quantile is not there.
        """
        if not lower < upper:
            raise ValueError(f"coverage needs lower < upper; got {lower} and {upper}")
        measured = self._measured(measurements)
        inside = (self.quantile(lower) <= measured) & (measured <= self.quantile(upper))
        return inside[:, part].mean(axis=1)

    def check_sampling(self, measurements: Measurements) -> None:
        """Raise ValueError if measurements have another time step or number of samples than the histories."""
        self._need_histories()
        n_steps = self.mean.shape[1]
        if not same_sampling(self.dt, n_steps, measurements.dt, measurements.n_steps):
            raise ValueError(
                f"the prediction has {n_steps} samples at {self.dt} s, the measurements have {measurements.n_steps} at "
                f"{measurements.dt} s; make them equal with Measurements.trim and Measurements.decimate"
            )

    def _need_histories(self) -> None:
        if self.dt is None:
            raise ValueError("this needs the histories of channels: propagate with quantity=None or names of channels")

    def _measured(self, measurements: Measurements) -> np.ndarray:
        """Measured values (n_channels, n_steps) in the order of `channels`."""
        self._need_histories()
        chosen = measurements.select([channel.name for channel in self.channels])
        for ours, theirs in zip(self.channels, chosen.channels, strict=True):
            if ours.dimension != theirs.dimension:
                raise ValueError(
                    f"channel {ours.name!r} is {ours.quantity!r} here, {theirs.quantity!r} in the measurements"
                )
        self.check_sampling(measurements)
        return chosen.values


def propagate(
    posterior_or_model: Any,
    samples: Any,
    *,
    quantity: Quantity = None,
    record: Any = None,
    noise: bool = False,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    effective_sample_size: float | None = None,
    batch: int | None = None,
    memory: int | None = 512 * 2**20,
    pool: Any = None,
    seed: int | None = None,
    progress: bool = True,
) -> Prediction:
    """Prediction of a quantity from samples of the parameters.

    Parameters
    ----------
    posterior_or_model : Posterior, FELikelihood or Model
    samples : (n, ndim) float, or named values (n,)
        Equally weighted samples: all parameters of the posterior (``sampler.get_chain(flat=True)``), or, without
        noise, the structural ones alone. Of a posterior whose noise is integrated out: what `Posterior.draw_noise`
        returns.
    quantity : optional
        None: the histories of all channels. A channel's name, or several: their histories. ``peak(name)`` and its like
        (`fe_likelihoods.prediction.quantities`), or several. Or any function of the response (n_channels, n_steps) [SI] that
        returns a number or an array of one shape; an exception that it raises is passed on.
    record : optional
        Another excitation: that of ``model.with_record(record)``.
    noise : bool
        Predict what a sensor would read: the response plus the noise of each sample, with the correlation in time that
        the noise has. Of histories, mean and variance
        are exact in the noise (the law of total variance adds the mean of its variance) and quantiles use one draw a
        sample; for any other quantity one draw a sample is added to the response.
    quantiles : sequence of float in (0, 1) — () for none.
    effective_sample_size : float, optional
        Independent samples that the given ones are worth, for the Monte-Carlo errors. Default: their number, as if they
        were independent (as in the paper), which is too hopeful for the copies and chains of a sampler.
    batch : int, optional — simulations at once; by default as many as 32 MiB of responses, at most 256
        (16 where they run one by one).
    memory : int, optional
        Bound [bytes] of what is kept for quantiles; beside it go some batches. Histories are kept in single precision
        (seven digits) where they do not fit otherwise, and what does not fit even so is left out at random:
        `Prediction.n_quantile` says how much is left. None: no bound. Single numbers are always kept all.
    pool : optional — as in `FELikelihood`, whose pool is the default.
    seed : int, optional — of the noise and of the choice of samples for quantiles; the result depends on neither
        `batch` nor `pool`, but for round-off.
    progress : bool — show a progress bar.

    Returns
    -------
    Prediction

    Raises
    ------
    ValueError
        Before any simulation: samples of another width, none, or not finite; unknown channels; noise without a
        posterior, without its parameters or with impossible ones; a model that knows no other record; settings out of
        range. Later: a function that returns arrays of different shapes.
    SimulationFailed
        If every simulation fails.
    """
    model, noise_model, pool = parts_of(posterior_or_model, pool)
    thetas, sample_noise = split_samples(model, noise_model, samples, noise)
    n = len(thetas)
    probabilities = _probabilities(quantiles)
    if effective_sample_size is None:
        effective_sample_size = n
    if not (np.isfinite(effective_sample_size) and effective_sample_size > 0.0):
        raise ValueError(f"effective_sample_size must be a positive number; got {effective_sample_size!r}")
    if batch is not None and not (isinstance(batch, (int, np.integer)) and batch >= 1):
        raise ValueError(f"batch must be a whole number of simulations, 1 or more; got {batch!r}")
    if memory is not None and not memory >= 0:
        raise ValueError(f"memory must be a number of bytes, or None for no bound; got {memory!r}")
    if record is not None:
        if not hasattr(model, "with_record"):
            raise ValueError(
                f"{type(model).__name__} knows no other record: give it a method with_record(record) that returns the "
                "same model under another excitation"
            )
        model = model.with_record(record)
    evaluate = evaluator(quantity, model.channels)

    distinct, result_of_theta = distinct_rows(thetas)
    try:
        seeds = np.random.SeedSequence(seed)
    except (TypeError, ValueError) as error:
        raise ValueError(f"seed must be a whole number, zero or more, or None; got {seed!r}") from error
    gathered = Gathered(
        members=members_of(result_of_theta, len(distinct)),
        noise=sample_noise,
        evaluate=evaluate.function,
        rows=evaluate.rows,
        result_of_sample=np.arange(n) if noise else result_of_theta,
        probabilities=probabilities,
        memory=memory,
        seeds=seeds,
    )
    response_size = len(model.channels) * model.n_steps
    if evaluate.rows is not None:
        gathered.prepare((len(evaluate.rows), model.n_steps))
    if batch is None:
        # runs one by one show their progress the sooner the fewer there are in a batch
        together = pool is not None or hasattr(model, "simulate_batch")
        batch = max(1, min(_BATCH_VALUES // response_size, _LARGEST_BATCH if together else 16))
    with tqdm(total=n, disable=not progress, unit="sample", desc="propagate") as bar:
        for start in range(0, len(distinct), batch):
            responses, reasons = simulate_batch(model, distinct[start : start + batch], pool)
            gathered.add(start, responses, reasons)
            bar.update(sum(len(members) for members in gathered.members[start : start + batch]))
    return _prediction(gathered, n, effective_sample_size, evaluate.channels, model.dt)


def _prediction(gathered: Gathered, n: int, effective: float, channels: tuple[Channel, ...], dt: float) -> Prediction:
    failed = np.sort(np.concatenate(gathered.failed)) if gathered.failed else np.zeros(0, dtype=int)
    worst = "; ".join(f"{count}: {reason}" for reason, count in gathered.reasons.most_common(3))
    if len(failed) == n:
        raise SimulationFailed(f"nothing to predict from, all {n} samples failed ({worst})")
    if len(failed):
        logger.warning("%d of %d samples failed and are left out of the prediction (%s)", len(failed), n, worst)
    used = np.setdiff1d(np.arange(n), failed, assume_unique=True)
    effective = effective * len(used) / n
    histories, noise, kept = gathered.rows is not None, gathered.noise is not None, gathered.kept
    variance = gathered.moments.variance
    error = np.sqrt(variance / effective)
    if histories and noise:
        variance = variance + gathered.noise_variance.mean[:, None]
    probabilities, n_quantile = gathered.probabilities, 0 if kept is None else kept.n_samples
    if probabilities and n_quantile == 0:
        logger.warning("no quantiles: all samples chosen for them failed; give more memory")
        probabilities = ()
    if probabilities:
        # a random part of the samples adds its own error to that of all of them
        part = 1.0 / (1.0 / effective + 1.0 / n_quantile - 1.0 / len(used))
        quantiles, quantile_error = kept.quantiles(probabilities, part)
        if n_quantile < len(used):
            logger.warning("quantiles are of %d of %d samples, as many as fit into memory", n_quantile, len(used))
    else:
        quantiles = quantile_error = np.zeros((0, *gathered.shape))
    whole = not histories and kept is not None and kept.complete
    return Prediction(
        mean=gathered.moments.mean,
        variance=variance,
        standard_error=error,
        probabilities=probabilities,
        quantiles=quantiles,
        quantile_error=quantile_error,
        values=kept.values_of(gathered.result_of_sample[used]) if whole else None,
        n_samples=len(used),
        n_quantile=n_quantile if probabilities else 0,
        effective_sample_size=float(effective),
        failed=failed,
        failure_reasons=dict(gathered.reasons),
        channels=channels,
        dt=dt if histories else None,
        noise=noise,
    )


def fit_measures(posterior: Any, samples: Any) -> np.ndarray:
    """How far each sample's response is from the measured one: sum (simulated - measured)^2 / sum measured^2.

    No response is kept: these are misfits, and those that the posterior remembers are not simulated again.

    Parameters
    ----------
    posterior : Posterior or FELikelihood
    samples : (n, ndim) float, or named values — all parameters, or the structural ones alone.

    Returns
    -------
    (n, n_channels) float : in the order of the model's channels [-]; a row of a failed simulation is NaN.

    Raises
    ------
    ValueError
        As `propagate`; also without measurements, or where a measured channel is zero.
    """
    likelihood = getattr(posterior, "likelihood", posterior)
    if not hasattr(likelihood, "measurements"):
        raise ValueError(f"fit_measures needs a posterior or a likelihood with measurements; got {posterior!r}")
    measurements = likelihood.measurements
    power = sum_of_squares(measurements.values, [channel.name for channel in measurements.channels])
    model, noise, _ = parts_of(posterior, None)
    thetas, _ = split_samples(model, noise, samples, False)
    return likelihood.misfit(thetas) / power


def _probabilities(quantiles: Sequence[float]) -> tuple[float, ...]:
    try:
        probabilities = tuple(float(p) for p in quantiles)
    except TypeError as error:
        raise ValueError(f"quantiles must be a sequence of probabilities; got {quantiles!r}") from error
    if not all(0.0 < p < 1.0 for p in probabilities) or len(set(probabilities)) != len(probabilities):
        raise ValueError(f"quantiles must be different probabilities between 0 and 1; got {quantiles!r}")
    return probabilities
