"""Settings of the annealing from the prior to the posterior, checked when they are made.

Every default is defined only here. Constants that no user changes are beside their use.
"""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np

from .emcee_names import Backend
from .resampling import RESAMPLING


def as_whole_number(name: str, value: Any) -> int:
    """A value as int, so that it can be stored as JSON; ValueError for a bool and for floats such as 60.0."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{name} must be a whole number (int); got {value!r}")
    return int(value)


@dataclass(frozen=True)
class Settings:
    """Settings of a tempered sampler.

    Attributes
    ----------
    ess_ratio : float
        Wanted effective sample size of each stage, relative to the number of walkers; between 0 and 1. Papers on TMCMC
        give a coefficient of variation c of the weights instead: 1 / (1 + c²).
    ess_floor : float, optional
        If given, `ess_ratio` refers to the wanted size of the previous stage, which thus declines, down to this value.
    resampling : {"systematic", "multinomial"}
        Scheme of `samplers.resampling`.
    min_moves, max_moves : int
        Smallest and largest number of ensemble sweeps per stage; equal for a fixed number. The default of `max_moves`
        belongs to 20 parameters or fewer; samplers add 3 for each further parameter.
    max_correlation : float
        Between `min_moves` and `max_moves`, moving stops once the correlations of all parameters and the log-likelihood
        with their values after the resampling are below this value.
    chains : {"equal", "leaders"}
        With "equal", every resampled point is moved equally often. With "leaders", a chain grows from each distinct
        resampled point, one step per copy of it, and sweeps follow if the points are still correlated.
    burn_in : int
        With "leaders", steps of a chain before its points count; 0 for the published algorithm, without sweeps.
    fast_sweeps : int
        Sweeps over the fast parameters after every move, if `log_prob_fn` has an attribute ``fast_parameters``
        (`samplers.moves.population_moves`); 0 for none.
    recycle : bool, optional
        Anneal by adaptive importance sampling over all evaluated points (`samplers.tempering.recycling`), and by moves
        only if the result cannot be trusted. None leaves the choice to the sampler.
    max_failure_share : float
        The run stops with an error when more than this share of the evaluations have failed by an exception or by NaN
        (a returned -inf is not a failure); 0 stops at the first failure.
    asynchronous : bool
        Whether points are evaluated without waiting for the slowest of each batch, for long runs of unequal length on
        many workers. Recycling then proposes the next points while the last ones run. The choice of the
        proposals, and thus the result, depends on the order of arrival; every estimate is made from complete batches.
        Moves and guides wait for all points.

    Examples
    --------
    >>> SMCSampler(100, posterior.ndim, posterior, vectorize=True, min_moves=5).settings.min_moves
    5
    """

    ess_ratio: float = 0.5
    ess_floor: float | None = None
    resampling: str = "systematic"
    min_moves: int = 2
    max_moves: int = 7
    max_correlation: float = 0.15
    chains: str = "equal"
    burn_in: int = 0
    fast_sweeps: int = 2
    recycle: bool | None = None
    max_failure_share: float = 0.5
    asynchronous: bool = False

    def __post_init__(self):
        for name, value in [*vars(self).items()]:
            object.__setattr__(self, name, value.item() if isinstance(value, np.generic) else value)
        for name in ("min_moves", "max_moves", "burn_in", "fast_sweeps"):
            object.__setattr__(self, name, as_whole_number(name, vars(self)[name]))
        for name, possible, wanted in (
            ("asynchronous", isinstance(self.asynchronous, bool), "True or False"),
            ("recycle", isinstance(self.recycle, bool | None), "True, False or None"),
            ("ess_ratio", 0.0 < self.ess_ratio < 1.0, "between 0 and 1 (both excluded)"),
            ("ess_floor", self.ess_floor is None or self.ess_floor >= 0.0, "non-negative, or None"),
            ("resampling", self.resampling in RESAMPLING, f"in {[*RESAMPLING]}"),
            ("min_moves", 1 <= self.min_moves <= self.max_moves, f"between 1 and max_moves = {self.max_moves}"),
            ("max_correlation", 0.0 < self.max_correlation <= 1.0, "above 0 and at most 1"),
            ("chains", self.chains in ("equal", "leaders"), '"equal" or "leaders"'),
            ("burn_in", self.burn_in >= 0, "non-negative"),
            ("fast_sweeps", self.fast_sweeps >= 0, "a whole number, 0 for none"),
            ("max_failure_share", 0.0 <= self.max_failure_share <= 1.0, "between 0 and 1"),
        ):
            if not possible:
                raise ValueError(f"{name} must be {wanted}; got {vars(self)[name]!r}")
        if self.burn_in > 0 and self.chains == "equal":
            raise ValueError('burn_in belongs to chains="leaders": pass this too')

    @property
    def resample(self) -> Callable:
        """The resampling scheme."""
        return RESAMPLING[self.resampling]

    def target(self, last_target: float, n_walkers: int) -> float:
        """Wanted effective sample size of a stage, from the previous target (n_walkers before the first stage)."""
        if self.ess_floor is None:
            return self.ess_ratio * n_walkers
        return max(self.ess_ratio * last_target, self.ess_floor)


def check_arguments(pool: Any, backend: Any, seed: Any) -> None:
    """Raise ValueError for arguments that emcee or NumPy would refuse later or with an unclear error."""
    if pool is not None and not (hasattr(pool, "map") or hasattr(pool, "submit")):
        raise ValueError(f"pool must be an object with a method map, such as multiprocessing.Pool(4); got {pool!r}")
    if backend is not None and not isinstance(backend, Backend):
        raise ValueError(f"backend must be a backend of emcee, as emcee.backends.HDFBackend('run.h5'); got {backend!r}")
    if seed is not None and not all(isinstance(each, Integral) for each in np.ravel(seed)):
        raise ValueError(f"seed must be a whole number, several of them, or None; got {seed!r}")
