r"""Estimate of the evaluations and the wall time of a run, from a few timed evaluations.

A model of the tempering stages gives a range for the number of evaluations. From one stage to the next, beta grows by a
factor g. For a Gaussian posterior in d dimensions, the share :math:`(\sqrt{2 g - 1} / g)^d` of the effective sample
size is kept. Annealing by moves keeps a given share of the walkers, which determines g. The growth of recycling was
measured on Gaussian posteriors: :math:`\ln g = \min(1.7, 2.9 d^{-0.55})`. The number of stages is
:math:`-\ln \beta_1 / \ln g`; the first exponent :math:`\beta_1` is inversely proportional to the spread of the
log-likelihood over the prior. The constants are means over study `expected` of docs/results.rst.

The wall time is the number of evaluations times the mean duration, divided by the number of workers.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .settings import Settings, as_whole_number
from .smc import SMCSampler
from .tempered import TemperedSampler
from .tempering.recycling import DRAWS_PER_TARGET, search_draws, smallest_target

__all__ = ["CostEstimate", "as_duration", "estimate_cost", "expected_evaluations"]

# Recycling: draws per stage, and evaluations at beta = 1 per walker, which include repeated checks and final moves.
DRAWS_PER_STAGE = DRAWS_PER_TARGET * 1.15
AT_THE_END = (0.6, 8.0)
# Annealing by moves: sweeps per stage with 100 walkers per dimension, and the increase with fewer walkers.
SWEEPS_AT_100 = 3.0
MORE_SWEEPS = 2.2


class CostEstimate(NamedTuple):
    """Expected cost of a run until beta = 1 is reached. ``str`` gives a small table.

    Attributes
    ----------
    title : str
        Sampler, number of walkers and number of parameters.
    workers : int
        Number of simultaneous evaluations.
    seconds : (runs,) float
        Durations of the timed evaluations [s].
    evaluated, failures, cached : int
        Evaluations made for the estimate, evaluations that returned -inf, and evaluations that needed no simulation (0
        for a posterior whose ``report()`` has no number of simulations).
    fewest, most : float
        Range of the evaluations of the posterior, without sweeps over fast parameters, which need no simulation. Each
        step at beta = 1 needs one more per walker.
    """

    title: str
    workers: int
    seconds: np.ndarray
    evaluated: int
    failures: int
    cached: int
    fewest: float
    most: float

    def time_of(self, *evaluations: float) -> str:
        """Wall time of one or two numbers of evaluations with all workers busy, as text.

        Without ``asynchronous=True``, a run also waits for the longest evaluation of every batch.
        """
        return as_duration(*(n * float(self.seconds.mean()) / self.workers for n in evaluations))

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        low, high = (int(float(f"{n:.2g}")) for n in (self.fewest, self.most))
        seconds = f"mean {self.seconds.mean():.3g} s, {self.seconds.min():.3g} to {self.seconds.max():.3g} s"
        rows = {
            self.title: "",
            f"one evaluation ({self.evaluated} made, {len(self.seconds)} timed)": seconds,
            "evaluations": f"about {low} to {high}",
            f"wall time, {self.workers} worker{'s' if self.workers > 1 else ''}": self.time_of(self.fewest, self.most),
        }
        rows |= {"failed evaluations": str(self.failures)} if self.failures else {}
        rows |= {"note": f"{self.cached} points were cached; the times include them"} if self.cached else {}
        width = max(map(len, rows))
        return "\n".join(f"{name:{width}}  {value}".rstrip() for name, value in rows.items())


def as_duration(*seconds: float) -> str:
    """One or two durations as text, in a unit that suits the larger one: "about 2.1 to 3.4 h"."""
    units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
    size, unit = next(((size, unit) for size, unit in units if seconds[-1] >= 2.0 * size), (1.0, "s"))
    texts = [f"{value / size:.2g}" if value < 99.5 * size else f"{value / size:.0f}" for value in seconds]
    return f"about {' to '.join(dict.fromkeys(texts))} {unit}"


def estimate_cost(
    posterior: Callable,
    nwalkers: int = 500,
    sampler: type[TemperedSampler] = SMCSampler,
    workers: int | None = None,
    runs: int = 3,
    seed: int | None = None,
    **settings: Any,
) -> CostEstimate:
    """Time a few evaluations, and estimate the cost of a run.

    One point is evaluated without timing, because the first evaluation may include a job queue, the start of processes,
    or a compilation. Then `runs` points are timed, one after another. All are draws of the prior. A sampler with the
    same `seed` starts from them, so a posterior with a cache does not repeat them. The range is too low for many
    posteriors with heavy tails (``docs/results``), and for models that take longer near the posterior.

    Parameters
    ----------
    posterior : callable
        Log-posterior of a point (ndim,), with ``ndim``, ``log_prior`` and ``sample_prior``.
    nwalkers : int
        Number of walkers.
    sampler : type
        `SMCSampler` or `TMCMCSampler`.
    workers : int, optional
        Number of simultaneous evaluations in the run. Default: the workers of the posterior's pool, or 1.
    runs : int
        Number of timed evaluations, at least 2.
    seed : int, optional
        Seed of the run. By default the draws differ from call to call.
    **settings
        Settings of the sampler, such as ``recycle=False``.

    Raises
    ------
    ValueError
        For impossible arguments, or if fewer than two evaluations have a finite log-probability.

    Examples
    --------
    >>> cost = estimate_cost(posterior, workers=4, seed=1)
    >>> bool(0 < cost.fewest < cost.most)
    True
    """
    runs = as_whole_number("runs", runs)
    if runs < 2:
        raise ValueError(f"runs must be at least 2, since one duration has no spread; got {runs}")
    if workers is not None and as_whole_number("workers", workers) < 1:
        raise ValueError(f"workers must be at least 1; got {workers}")
    if missing := [name for name in ("ndim", "log_prior", "sample_prior") if not hasattr(posterior, name)]:
        raise ValueError(f"estimate_cost needs a posterior with {', '.join(missing)}; got {type(posterior).__name__}")
    ndim = as_whole_number("ndim", posterior.ndim)
    chosen = sampler(nwalkers, ndim, posterior, vectorize=True, seed=0, **settings).settings  # checks the arguments
    random = np.random.RandomState(seed)
    draws = np.asarray(posterior.sample_prior(max(nwalkers, runs + 1), random), dtype=float)  # as the sampler's draws
    report = getattr(posterior, "report", dict)
    before = report().get("simulations")
    values, seconds = np.empty(runs + 1), np.empty(runs + 1)
    for i, point in enumerate(draws[: runs + 1]):
        start = time.perf_counter()
        values[i], seconds[i] = float(np.ravel(posterior(point))[0]), time.perf_counter() - start
    finite = np.isfinite(values)
    if finite.sum() < 2:
        raise ValueError(
            f"{len(finite) - finite.sum()} of {len(finite)} draws of the prior have a log-probability of -inf, and the "
            "estimate needs two finite ones: check the model at these points, or time more with runs="
        )
    log_prior = np.array([float(np.ravel(posterior.log_prior(x))[0]) for x in draws[: runs + 1]])
    workers = int(workers or _workers_of(posterior))
    spread = float(np.std(values[finite] - log_prior[finite], ddof=1))
    beta = min(1.0, (3.5 if chosen.recycle else 1.3) / max(spread, 1e-9))
    return CostEstimate(
        f"{sampler.__name__}, {nwalkers} walkers, {ndim} parameters",
        workers,
        seconds[1:],
        len(values),
        int((~finite).sum()),
        0 if before is None else max(len(values) - (report()["simulations"] - before), 0),
        *expected_evaluations(chosen, nwalkers, ndim, beta),
    )


def _workers_of(posterior: Any) -> int:
    """Number of points that the pool of a posterior evaluates at once."""
    if not callable(getattr(posterior, "evaluation_queue", None)):
        return 1
    queue = posterior.evaluation_queue()
    workers = queue.workers or 1
    queue.close()
    return workers


def expected_evaluations(settings: Settings, nwalkers: int, ndim: int, beta: float) -> tuple[float, float]:
    """Fewest and most evaluations of a run whose first stage has the exponent `beta` > 0."""
    if settings.recycle:
        left = -np.log(beta) / min(1.7, 2.9 * ndim**-0.55)
        per_stage = DRAWS_PER_STAGE * smallest_target(nwalkers, ndim)
        stages = left * (per_stage + search_draws(nwalkers) / max(left, 1.0))
        low, high = ((2.0 + end) * nwalkers for end in AT_THE_END)
        return 0.65 * stages + low, 1.4 * stages + high
    kept = min(max(settings.target(float(nwalkers), nwalkers) / nwalkers, 0.01), 0.99)
    per_dimension = kept ** (2.0 / ndim)  # per_dimension g^2 - 2 g + 1 = 0
    growth = np.log((1.0 + np.sqrt(1.0 - per_dimension)) / per_dimension)
    sweeps = SWEEPS_AT_100 + MORE_SWEEPS * np.log(100.0 * ndim / nwalkers)
    sweeps = float(np.clip(sweeps, settings.min_moves, settings.max_moves))
    if settings.chains == "leaders":
        sweeps = settings.burn_in + 1.0
    stages = np.ceil(-np.log(beta) / max(growth, 0.01)) * nwalkers * sweeps
    return 0.65 * stages + 2.0 * nwalkers, 1.8 * stages + 3.0 * nwalkers
