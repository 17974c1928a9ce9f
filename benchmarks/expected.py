"""How well the expected number of evaluations predicts runs (`samplers.cost.expected_evaluations`).

The constants of the model were chosen by Gaussian posteriors; the others are those of
`tests.statistics.analytic_posteriors`. A prediction is made before the run, from the log-likelihoods of three draws of
the prior, and after every stage.
"""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.cost import expected_evaluations, first_beta
from tests.statistics import analytic_posteriors as targets

from .rows import Row

__all__ = ["expected"]

GAUSSIANS = [(ndim, width) for ndim in (2, 5, 10, 15) for width in (0.3, 0.03, 0.003)]
GROUPS: dict[str, list[Callable[[int], Any]]] = {
    "Gaussian": [lambda seed, n=ndim, w=width: targets.gaussian(seed, n, w) for ndim, width in GAUSSIANS],
    "others": [
        targets.banana,
        targets.bounds,
        targets.student,
        targets.rosenbrock,
        targets.rotated_banana,
        targets.three_shapes,
        targets.narrow_mode,
        lambda seed: targets.rough(seed, 1.0),
    ],
}
RUNS = ((SMCSampler, 1000), (SMCSampler, 500), (SMCSampler, 250), (SMCSampler, 100), (TMCMCSampler, 500))


def predictions(posterior: Any, sampler_type: type, nwalkers: int, seed: int) -> Iterator[tuple[bool, bool, float]]:
    """Whether a prediction was made before the run, whether it held, and true over likely number of evaluations."""
    draws = posterior.sample_prior(3, np.random.RandomState(seed + 1000))
    values = posterior(draws) - posterior.log_prior(draws)
    sampler = sampler_type(nwalkers, posterior.ndim, posterior, vectorize=True, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        sampler.run_mcmc(None, 0)
    recycling, ladder = bool(sampler.settings.recycle), sampler.ladder
    choice = sampler.settings, nwalkers, posterior.ndim
    for known in range(len(ladder)):
        beta = ladder[known - 1].beta if known else first_beta(values, recycling)
        range_ = expected_evaluations(*choice, beta)
        left = sampler.evaluations - (sum(stage.evaluations for stage in ladder[:known]) if known else nwalkers)
        yield known == 0, range_.low <= left <= range_.high, left / range_.likely


def _rows(case: str, found: list[tuple[bool, bool, float]]) -> Iterator[Row]:
    for first, what in ((True, "before the run"), (False, "after a stage")):
        some = [(held, ratio) for before, held, ratio in found if before is first]
        if some:
            low, middle, high = np.quantile([ratio for _, ratio in some], (0.1, 0.5, 0.9))
            note = f"true / likely: median {middle:.2f}, 80 % from {low:.2f} to {high:.2f}; {len(some)} predictions"
            yield Row(f"predictions that held, {what}", case, 100.0 * float(np.mean([h for h, _ in some])), "%", note)


def expected(repeats: int, walkers: tuple[int, ...] = (1000, 500, 250, 100)) -> list[Row]:
    """Share of the predictions that held, by posterior and sampler."""
    rows: list[Row] = []
    for group, makers in GROUPS.items():
        for sampler_type, nwalkers in RUNS:
            if nwalkers not in walkers:
                continue
            found = [
                each
                for seed in range(repeats)
                for make in makers
                for each in predictions(make(seed), sampler_type, nwalkers, seed)
            ]
            rows += _rows(f"{group}, {sampler_type.__name__}, {nwalkers} walkers", found)
    return rows
