"""Estimate of the evaluations and the wall time of a run, from a few timed evaluations.

The number of evaluations is proportional to the number of walkers. The wall time is this number times the mean duration
of an evaluation, divided by the number of workers.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .settings import as_whole_number
from .smc import SMCSampler
from .tempered import TemperedSampler

__all__ = ["CostEstimate", "as_duration", "estimate_cost"]

# Evaluations per walker by recycling and by moves: 90 % of 753 and of 1120 runs on 41 posteriors of 2 to 20 parameters.
RECYCLING, MOVES = (10.0, 36.0), (13.0, 110.0)
# Normal posteriors in 30 and 40 dimensions took 56 and 80 per walker: the square of the number of parameters.
MANY_PARAMETERS = 20


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
    fewest, most : float
        Range of the evaluations of the posterior, without sweeps over fast parameters, which need no simulation. Each
        step at beta = 1 needs one more per walker.
    note : str
        Which of the evaluations failed, or needed no simulation; may be empty.
    """

    title: str
    workers: int
    seconds: np.ndarray
    fewest: float
    most: float
    note: str = ""

    def time_of(self, *evaluations: float) -> str:
        """Wall time of one or two numbers of evaluations with all workers busy, as text.

        Without ``asynchronous=True``, a run also waits for the longest evaluation of every batch.
        """
        return as_duration(*(n * float(self.seconds.mean()) / self.workers for n in evaluations))

    def __str__(self) -> str:
        low, high = (int(float(f"{n:.2g}")) for n in (self.fewest, self.most))
        seconds = f"mean {self.seconds.mean():.3g} s, {self.seconds.min():.3g} to {self.seconds.max():.3g} s"
        rows = {
            f"one evaluation ({len(self.seconds)} timed)": seconds,
            "evaluations": f"about {low} to {high}",
            f"wall time, {self.workers} worker{'s' if self.workers > 1 else ''}": self.time_of(self.fewest, self.most),
        }
        width = max(map(len, rows))
        table = [f"{name:{width}}  {value}" for name, value in rows.items()]
        return "\n".join([self.title, *table, *([self.note] if self.note else [])])

    __repr__ = __str__


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

    After a first evaluation, which may include a compilation, `runs` draws of the prior are timed. A sampler with the
    same `seed` starts from them, so a posterior with a cache does not repeat them. The range of evaluations held in
    90 % of the runs on 41 posteriors; the time is too low for models that take longer near the posterior.

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
    if as_whole_number("runs", runs) < 2 or as_whole_number("workers", workers or 1) < 1 or workers == 0:
        raise ValueError(f"runs must be at least 2, and workers must be at least 1; got {runs} and {workers}")
    if missing := [name for name in ("ndim", "sample_prior") if not hasattr(posterior, name)]:
        raise ValueError(f"estimate_cost needs a posterior with {', '.join(missing)}; got {type(posterior).__name__}")
    ndim = as_whole_number("ndim", posterior.ndim)
    chosen = sampler(nwalkers, ndim, posterior, vectorize=True, seed=0, **settings).settings  # checks the arguments
    random = np.random.RandomState(seed)
    draws = np.asarray(posterior.sample_prior(max(nwalkers, runs + 1), random), dtype=float)  # as the sampler's draws
    report = getattr(posterior, "report", dict)
    before = report().get("simulations", 0)
    values, seconds = np.empty(runs + 1), np.empty(runs + 1)
    for i, point in enumerate(draws[: runs + 1]):
        start = time.perf_counter()
        values[i], seconds[i] = float(np.ravel(posterior(point))[0]), time.perf_counter() - start
    failed = int(np.sum(~np.isfinite(values)))
    if failed > runs - 1:
        raise ValueError(
            f"{failed} of {runs + 1} draws of the prior have a log-probability of -inf, and the estimate needs two "
            "finite ones: check the model at these points, or time more with runs="
        )
    cached = max(runs + 1 - (report().get("simulations", runs + 1) - before), 0)
    notes = {"failed": failed, "were cached, and the times include them": cached}
    share = max(ndim / MANY_PARAMETERS, 1.0) ** 2 * nwalkers
    fewest, most = (share * each for each in (RECYCLING if chosen.recycle else MOVES))
    if workers is None and callable(getattr(posterior, "evaluation_queue", None)):
        queue = posterior.evaluation_queue()
        workers = queue.workers
        queue.close()
    title = f"{sampler.__name__}, {nwalkers} walkers, {ndim} parameters"
    note = "; ".join(f"{number} of {runs + 1} evaluations {what}" for what, number in notes.items() if number)
    return CostEstimate(title, int(workers or 1), seconds[1:], fewest, most, note)
