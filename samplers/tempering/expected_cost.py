r"""Evaluations that an annealing still needs: a model of its stages, to be read as a range.

From a stage to the next, beta grows by a factor g. Of a Gaussian posterior in d dimensions, a share
:math:`(\sqrt{2 g - 1} / g)^d` of the effective sample size is left after the growth. Annealing by moves keeps a stated
share of the walkers, which gives g. Recycling keeps a share that depends on its own draws; its growth was measured on
Gaussian posteriors: :math:`\ln g = \min(1.7, 2.9 d^{-0.55})`. Once stages are known, their mean growth replaces this.

The number of stages is the logarithm of one over beta divided by the logarithm of g. The first beta is inversely
proportional to the spread of the log-likelihood over the prior. What the stages cost follows from the settings, and
what follows at beta = 1 was measured. The constants are means over ``python -m tests.benchmarks expected``, which also
shows how well the model predicts posteriors that it was not made from.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .population import Stage
from .settings import Settings

__all__ = ["Expected", "expected_growth", "expected_left", "first_beta"]

# Recycling: rounds of draws per stage, and evaluations at beta = 1, as multiples of the number of walkers. These are
# many where the check with fresh draws is repeated, or the points are moved at the end.
ROUNDS_PER_STAGE = 1.15
AT_THE_END = (0.6, 1.8, 8.0)
# Annealing by moves: sweeps per stage with 100 walkers per dimension, and how many more with fewer.
SWEEPS_AT_100 = 3.0
MORE_SWEEPS = 2.2


class Expected(NamedTuple):
    """A number of evaluations.

    Attributes
    ----------
    low, likely, high : float
        A range, made to hold for about 80 % of the runs, and a number in it.
    """

    low: float
    likely: float
    high: float


def expected_growth(settings: Settings, nwalkers: int, ndim: int, recycling: bool) -> float:
    """Logarithm of the factor by which beta is expected to grow from stage to stage.

    Parameters
    ----------
    settings : Settings
        Settings of the annealing.
    nwalkers, ndim : int
        Numbers of walkers and parameters.
    recycling : bool
        Whether the annealing recycles; else it moves.
    """
    if recycling:
        return float(min(1.7, 2.9 * ndim**-0.55))
    kept = min(max(settings.target(float(nwalkers), nwalkers) / nwalkers, 0.01), 0.99)
    # kept^(2/ndim) g^2 - 2 g + 1 = 0
    per_dimension = kept ** (2.0 / ndim)
    return float(np.log((1.0 + np.sqrt(1.0 - per_dimension)) / per_dimension))


def first_beta(log_likelihoods: Sequence[float], recycling: bool) -> float:
    """Expected beta of the first stage, from log-likelihoods of a few draws of the prior; finite ones count."""
    finite = [value for value in log_likelihoods if np.isfinite(value)]
    spread = float(np.std(finite, ddof=1)) if len(finite) > 1 else 0.0
    return min(1.0, (3.5 if recycling else 1.3) / spread) if spread > 0.0 else 1.0


def expected_left(
    settings: Settings, nwalkers: int, ndim: int, recycling: bool, beta: float, stages: Sequence[Stage] = ()
) -> Expected:
    """Evaluations that the annealing needs after a stage.

    Parameters
    ----------
    settings, nwalkers, ndim, recycling
        As in `expected_growth`.
    beta : float
        That of the latest stage, above 0.
    stages : sequence of Stage
        The finished stages. Their growth and their evaluations replace the expected ones, which count as one stage.
    """
    steps = np.diff(np.log([stage.beta for stage in stages if stage.beta < 1.0]))
    growth = (expected_growth(settings, nwalkers, ndim, recycling) + np.sum(steps)) / (1 + len(steps))
    left, check = -np.log(beta) / max(growth, 0.01), nwalkers if settings.check_draws is None else settings.check_draws
    made = [stage.evaluations for stage in stages[1:]]  # the first stage has the draws of the prior as well
    if recycling:
        options = settings.recycling
        target = max(options.target_share * nwalkers, options.points_per_dimension * (ndim + 1.0))
        per_stage = ROUNDS_PER_STAGE * options.draws_per_target * target
        per_stage += options.search_draws * nwalkers / max(left + len(made), 1.0)
        low, likely, high = (end * nwalkers + check for end in AT_THE_END)
    else:
        sweeps = SWEEPS_AT_100 + MORE_SWEEPS * np.log(100.0 * ndim / nwalkers)
        per_stage = nwalkers * float(np.clip(sweeps, settings.min_moves, settings.max_moves))
        left, low, likely, high = np.ceil(left), check, check, nwalkers + check
    of_stages = left * (per_stage + sum(made)) / (1 + len(made))
    return Expected(0.65 * of_stages + low, of_stages + likely, (1.4 if recycling else 1.8) * of_stages + high)
