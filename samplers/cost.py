"""What a run will take, from a few timed evaluations before it.

The number of evaluations comes from `samplers.tempering.expected_cost`, with the spread of the log-likelihood at the
timed draws of the prior, which says where the tempering begins. The wall time follows from it by list scheduling:
evaluations are started in order, each on the first worker that is free. Their durations are log-normal, with the mean
and the spread of the timed ones. A synchronous run waits for the end of every batch.
"""

import heapq
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .reporting.progress import as_duration
from .smc import SMCSampler
from .tempered import TemperedSampler
from .tempering.expected_cost import Expected, expected_left, first_beta
from .tempering.settings import Settings, as_whole_number
from .timing import Draws, time_evaluations

__all__ = ["CostEstimate", "estimate_cost"]

REPETITIONS = 5  # of a scheduled batch
SIMULATIONS_OF_A_GUIDE = 500


class CostEstimate(NamedTuple):
    """What a run will take, until beta = 1 is reached.

    Attributes
    ----------
    sampler : str
        Name of the sampler.
    nwalkers, ndim, workers : int
        Numbers of walkers, of parameters, and of evaluations that run at once.
    seconds : (runs,) float
        Durations of the timed evaluations [s].
    evaluated : int
        Number of all evaluations that were made: those that started the workers, the timed ones, and cached ones.
    failures : int
        How many of these returned -inf.
    evaluations : Expected
        Evaluations of the posterior: the low and the high end of a range, and a number between. Sweeps over fast
        parameters, which need no simulation, do not count. Steps at beta = 1 come on top, with `nwalkers` each.
    synchronous : Expected
        Wall time [s] where every batch is waited for.
    asynchronous : Expected or None
        Wall time [s] with ``asynchronous=True``, at most the synchronous one; None without recycling.
    guide : str
        Duration of a run of 500 simulations with ``guide=posterior.guide()``; how many it needs is known only after its
        search. Empty for a posterior without a guide.
    cached : int
        How many of the evaluations needed no new simulation. They are not timed, unless all are cached. 0 for a
        posterior whose ``report()`` has no number of simulations.
    """

    sampler: str
    nwalkers: int
    ndim: int
    workers: int
    seconds: np.ndarray
    evaluated: int
    failures: int
    evaluations: Expected
    synchronous: Expected
    asynchronous: Expected | None
    guide: str
    cached: int = 0

    @property
    def any_simulated(self) -> bool:
        """Whether the durations are those of simulations, and not of points whose simulations are cached."""
        return self.evaluated > self.cached

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        first, last = self.seconds.min(), self.seconds.max()
        cached = f"{self.cached} cached, " if self.cached else ""
        rows = [
            (f"{self.sampler}, {self.nwalkers} walkers, {self.ndim} parameters", ""),
            (
                f"one evaluation ({self.evaluated} made, {cached}{len(self.seconds)} timed)",
                f"mean {self.seconds.mean():.3g} s, {first:.3g} to {last:.3g} s",
            ),
            ("evaluations", f"about {_rounded(self.evaluations.low)} to {_rounded(self.evaluations.high)}"),
            (f"wall time, {self.workers} worker{'s' if self.workers > 1 else ''}", _range(self.synchronous)),
        ]
        without = "only with recycling (SMCSampler, recycle=True)"
        rows.append(
            ("the same, asynchronous=True", without if self.asynchronous is None else _range(self.asynchronous))
        )
        if self.guide:
            rows.append(("with guide=posterior.guide()", self.guide))
        if self.failures:
            rows.append(("failed evaluations", f"{self.failures}"))
        if not self.any_simulated:
            rows.append(("note", "no point needed a simulation: the times are those of cached points"))
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:{width}}  {value}".rstrip() for name, value in rows)


def _rounded(number: float) -> int:
    return int(float(f"{number:.2g}"))


def _range(seconds: Expected) -> str:
    return as_duration(seconds.low, seconds.high)


def estimate_cost(
    posterior: Callable,
    nwalkers: int = 500,
    sampler: type[TemperedSampler] = SMCSampler,
    workers: int | None = None,
    runs: int = 3,
    seed: int | None = None,
    recycle: bool | None = None,
) -> CostEstimate:
    """Time a few evaluations, and estimate what a run will take; all settings but `recycle` are the defaults.

    First, the workers are started: one point for each of them, at most 8, is evaluated at the same time and not timed,
    because this may contain the wait in a job queue, the start of processes, or a compilation. This is repeated where
    more workers are there afterwards, and with one point for every worker, however many, where no point took more than
    a minute. Then `runs` points are timed.

    All points are draws of the prior. With the same `seed`, a sampler starts from these points, so that a
    posterior that caches its simulations does not repeat them. Points whose simulations are cached already, as after an
    earlier estimate with the same seed, are passed over, and further draws take their place. The estimate of the
    evaluations is a range, which held in 67 to 88 % of runs on posteriors that it was not made from
    (``python -m tests.benchmarks expected``). A posterior with heavy tails needs more. Evaluations that take longer
    near the posterior than over the prior are not foreseen.

    Parameters
    ----------
    posterior : callable
        Log-posterior of a point (ndim,), with ``ndim``, ``log_prior`` and ``sample_prior``. Where it has a method
        ``evaluation_queue``, the points are sent to its pool.
    nwalkers : int
        Number of walkers.
    sampler : type
        `SMCSampler` or `TMCMCSampler`.
    workers : int, optional
        Number of evaluations that run at once in the run to be estimated. By default that of the pool of the posterior
        after its start, or 1 if it has none or does not say.
    runs : int
        Number of timed evaluations, at least 2. They are made one after the other; or at the same time, where each
        point that started the workers took more than a minute, and as many workers were started.
    seed : int, optional
        Seed of the run to be estimated. By default the draws differ from call to call.
    recycle : bool, optional
        As for the sampler: `SMCSampler` recycles by default with 250 walkers or more.

    Returns
    -------
    CostEstimate
        Printed as a small table.

    Raises
    ------
    ValueError
        For impossible arguments, or where fewer than two of the evaluations have a finite log-probability.

    Examples
    --------
    >>> print(estimate_cost(posterior, workers=64, seed=1))
    """
    runs = as_whole_number("runs", runs)
    if runs < 2:
        raise ValueError(f"runs must be at least 2, since one duration has no spread; got {runs}")
    if workers is not None and as_whole_number("workers", workers) < 1:
        raise ValueError(f"workers must be at least 1; got {workers}")
    for name in ("ndim", "log_prior", "sample_prior"):
        if not hasattr(posterior, name):
            raise ValueError(f"estimate_cost needs a posterior with {name}; got {type(posterior).__name__} without it")
    ndim = as_whole_number("ndim", posterior.ndim)
    # also checks the arguments
    settings = sampler(nwalkers, ndim, posterior, vectorize=True, seed=0, recycle=recycle).settings
    random = np.random.RandomState(seed)
    n = max(nwalkers, runs + 1)
    draws = np.asarray(posterior.sample_prior(n, random), dtype=float)  # as those of the sampler
    made = time_evaluations(posterior, Draws(draws, lambda: posterior.sample_prior(n, random)), runs)
    log_prior = np.array([float(np.ravel(posterior.log_prior(x))[0]) for x in made.points])
    finite = np.isfinite(made.values)
    if finite.sum() < 2:
        raise ValueError(
            f"{len(finite) - finite.sum()} of {len(finite)} draws of the prior have a log-probability of -inf, and the "
            "estimate needs two finite ones: check the model at these points, or time more with runs="
        )
    recycling = bool(settings.recycle)
    beta = first_beta(made.values[finite] - log_prior[finite], recycling)
    left = expected_left(settings, nwalkers, ndim, recycling, beta)
    evaluations = Expected(*(nwalkers + value for value in left))
    workers, seconds = int(workers or made.workers or 1), made.seconds
    times = _wall_times(settings, evaluations, nwalkers, ndim, seconds, workers, recycling)
    return CostEstimate(
        sampler.__name__,
        nwalkers,
        ndim,
        workers,
        seconds,
        len(finite),
        int((~finite).sum()),
        evaluations,
        times[0],
        times[1],
        _of_guide(posterior, float(seconds.mean()), workers),
        made.cached,
    )


def _scheduled(lengths: np.ndarray, workers: int) -> float:
    """Time at which the last of some evaluations with given durations (n,) ends, on a number of workers."""
    free = [0.0] * workers
    for length in lengths:
        heapq.heapreplace(free, free[0] + float(length))
    return max(free)


def _wall_times(
    settings: Settings,
    evaluations: Expected,
    nwalkers: int,
    ndim: int,
    seconds: np.ndarray,
    workers: int,
    recycling: bool,
) -> tuple[Expected, Expected | None]:
    """Wall times [s] of a synchronous and of an asynchronous run."""
    spread = float(np.std(np.log(np.maximum(seconds, 1e-9)), ddof=1))
    random = np.random.default_rng(0)
    # the mean of the timed durations has an error of its own
    error = min(float(np.std(seconds, ddof=1) / np.mean(seconds)) / np.sqrt(len(seconds)), 0.5)
    factors = (1.0 - error, 1.0, 1.0 + error)

    def of_batch(size: float) -> float:
        lengths = random.lognormal(-0.5 * spread**2, spread, (REPETITIONS, max(round(size), 1)))
        return float(np.mean(seconds)) * float(np.mean([_scheduled(row, workers) for row in lengths]))

    if not recycling:
        batch = of_batch(nwalkers)
        return Expected(*(f * batch * n / nwalkers for f, n in zip(factors, evaluations, strict=True))), None
    options = settings.recycling
    size = options.draws_per_target * max(options.target_share * nwalkers, options.points_per_dimension * (ndim + 1.0))
    batch, whole = of_batch(size), of_batch(nwalkers)
    between = [max(n - 2.0 * nwalkers, 0.0) for n in evaluations]  # but the draws of the prior and of the check
    waiting = (f * (2.0 * whole + batch * n / size) for f, n in zip(factors, between, strict=True))
    # without barriers, all workers are busy until the check, which waits for all that came before it
    busy = float(np.mean(seconds)) / workers
    flowing = (f * (2.0 * whole + busy * n) for f, n in zip(factors, between, strict=True))
    # never longer than with barriers: `batch` is a mean of random durations, and can be below `busy * size` by chance
    synchronous = Expected(*waiting)
    return synchronous, Expected(*map(min, synchronous, flowing))


def _of_guide(posterior: Any, seconds: float, workers: int) -> str:
    """What can be said of a run with a guide; its number of simulations depends on what the search finds."""
    if not callable(getattr(posterior, "guide", None)):
        return ""
    try:
        posterior.guide()
    except ValueError:
        return ""
    wall = seconds * SIMULATIONS_OF_A_GUIDE / workers
    return f"not predicted; {SIMULATIONS_OF_A_GUIDE} simulations take {as_duration(wall, wall)}"
