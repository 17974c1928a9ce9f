"""The target of a run: the user's functions, however they are to be called, as functions of arrays."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np

from ..emcee_names import ndarray_to_list_of_dicts, walkers_independent
from ..interrupts import Ended, SentFunction, interrupts_end_the_run
from ..record import EvaluatedBatch
from .pools import map_in
from .starts import not_of_the_prior
from .values import Caught, log_densities, outcomes

logger = logging.getLogger(__name__)


class Target:
    """`log_prior`, values and `sample_prior` of arrays of points, from the arguments of a sampler; ValueError for
    functions that cannot be sampled. `parameter_names` are as emcee has them; None: functions take arrays.
    """

    parameter_names: Mapping[str, Any] | None = None

    def __init__(
        self,
        log_prob_fn: Callable | None,
        log_likelihood_fn: Callable | None,
        log_prior_fn: Callable | None,
        ndim: int,
        args: Sequence | None = None,
        kwargs: Mapping[str, Any] | None = None,
        vectorize: bool = False,
        blobs_dtype: Any = None,
    ):
        if (log_prob_fn is None) == (log_likelihood_fn is None):
            given = "neither" if log_prob_fn is None else "both"
            raise ValueError(
                "exactly one of log_prob_fn (log-prior plus log-likelihood) and log_likelihood_fn must be given; got "
                f"{given}. To pass a log-likelihood, use SMCSampler(nwalkers, ndim, None, log_likelihood_fn=..., "
                "log_prior_fn=...)"
            )
        self.name = name = "log_likelihood_fn" if log_prob_fn is None else "log_prob_fn"
        self.function = function = log_likelihood_fn if log_prob_fn is None else log_prob_fn
        if not callable(function):
            raise ValueError(f"{name} must be callable; got {function!r}")
        owner = getattr(function, "__self__", None)
        if not self.is_likelihood and owner is not None and function == getattr(owner, "log_likelihood", None):
            raise ValueError(
                "log_prob_fn is the method log_likelihood, which lacks the log-prior: the evidence would be wrong. "
                "Pass None as log_prob_fn, and the method as log_likelihood_fn=; or pass the object itself"
            )
        self.log_prior_fn = getattr(function, "log_prior", None) if log_prior_fn is None else log_prior_fn
        if not callable(self.log_prior_fn):
            raise ValueError(
                f"annealing starts from the prior: pass log_prior_fn, or a {name} with a method log_prior (a posterior "
                f"object itself, not its bound method); got {self.log_prior_fn!r}"
            )
        self.ndim, self.vectorize, self.blobs_dtype = ndim, vectorize, blobs_dtype
        self.called = function, args, kwargs
        self.caught = Caught(*self.called, vectorize)
        self._owner = function if owner is None else owner  # of optional methods
        self.names = names = getattr(function, "parameter_names", None) or ()  # of the parameters, if it has them
        # indices of parameters whose change needs no simulation: points that differ in them count as one
        self.fast_parameters = getattr(function, "fast_parameters", ())
        stated = getattr(function, "ndim", None)
        if isinstance(stated, Integral) and stated != ndim:
            listed = f" ({', '.join(map(str, names))})" if names else ""
            raise ValueError(f"ndim is {ndim}, but {name} has {stated} parameters{listed}: pass ndim={stated}")

    @property
    def is_likelihood(self) -> bool:
        """Whether the log-prior is added to what `function` returns."""
        return self.name == "log_likelihood_fn"

    # ------------------------------------------------------------------ optional attributes of the function

    @property
    def slow_parameters(self) -> list[int]:
        """Indices of the parameters that a simulation depends on; all parameters if none is slow."""
        fast = set(self.fast_parameters)
        return [j for j in range(self.ndim) if j not in fast] or list(range(self.ndim))

    def may_be_positive(self, coords: np.ndarray) -> np.ndarray:
        """Whether points (n, ndim) may have a positive density, (n,) bool, by the method `possible` of the function,
        which knows this without a simulation; True if unknown.
        """
        possible = getattr(self.function, "possible", None)
        unknown = np.ones(len(coords), dtype=bool)
        return unknown if possible is None or len(coords) == 0 else unknown & np.asarray(possible(coords.copy()))

    @property
    def knows_failures(self) -> bool:
        """Whether the function gives reasons of failed simulations, so that -inf may be one of them."""
        return hasattr(self._owner, "failures_at")

    def recall(self, batch: EvaluatedBatch) -> None:
        """Tell a function that counts failures itself what an earlier process has evaluated, by `recall_failures`."""
        if hasattr(self._owner, "recall_failures"):
            told = np.isin(np.arange(len(batch.coords)), list(batch.reasons))
            rows = np.flatnonzero((batch.log_prob > -np.inf) | (told & ~batch.failed)).tolist()
            reasons = [batch.reasons.get(row, "") for row in rows]
            self._owner.recall_failures(self._as_columns(batch.coords[rows]), reasons)

    def _as_columns(self, coords: np.ndarray) -> Any:
        """Points (n, ndim) as an array, or as values by name."""
        named = self.parameter_names
        return coords if named is None else {name: coords[:, place] for name, place in named.items()}

    # ------------------------------------------------------------------ functions of arrays

    def as_points(self, coords: np.ndarray) -> Any:
        """Points (n, ndim) as functions take them: rows of an array, or dictionaries.

        They are copies, since a function may change its argument.
        """
        named = self.parameter_names
        return coords.copy() if named is None else ndarray_to_list_of_dicts(coords.copy(), named)

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Log-prior (n,) of points (n, ndim), always computed in this process; -inf for NaN."""
        points = self.as_points(coords)
        with interrupts_end_the_run():
            results = self.log_prior_fn(points) if self.vectorize else [self.log_prior_fn(point) for point in points]
        return log_densities(results, len(coords), "log_prior_fn")

    def answers(self, coords: np.ndarray, pool: Any = None) -> Iterator:
        """What the function returns for each of the points (n, ndim) in turn; with `vectorize`, for all at once."""
        points = self.as_points(coords)
        if self.vectorize:
            return map(self.caught, [points])
        if pool is None:
            return map(self.caught, points)
        return map(_unless_ended, map_in(pool)(SentFunction(self.caught), points))

    def evaluated(self, coords: np.ndarray, results: Any) -> EvaluatedBatch:
        """Log-posterior and blobs of points (n, ndim) from `answers`; ValueError if these are no log-densities."""
        log_prob, blobs, reasons = outcomes(results, len(coords), self.blobs_dtype, self.name)
        if self.is_likelihood:
            log_prob = log_prob + self.log_prior(coords)
        impossible = np.flatnonzero(log_prob == -np.inf)
        if len(impossible) > 0 and self.knows_failures:
            said = self._owner.failures_at(self._as_columns(coords[impossible]))
            reasons |= {int(row): text for row, text in zip(impossible, said, strict=True) if text}
        return EvaluatedBatch(coords, log_prob, blobs, reasons)

    def sample_prior(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim) of the prior; ValueError without the method of the function."""
        if not hasattr(self.function, "sample_prior"):
            text = f"initial_state is None and {self.name} has no method sample_prior(n, random)"
            raise ValueError(f"{text}: pass {n} draws of the prior")
        return np.array(self.function.sample_prior(n, random), dtype=float)

    def more_draws(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (m, ndim) of the prior: m is `n`, or 0 if the function or its object has no method for this prior."""
        known = self.log_prior_fn == getattr(self._owner, "log_prior", None)
        draw = getattr(self._owner, "sample_prior", None)
        return np.array(draw(n, random), dtype=float) if known and draw is not None else np.empty((0, self.ndim))

    def check_start(self, coords: np.ndarray, nwalkers: int, skip_check: bool, is_drawn: bool) -> np.ndarray:
        """Log-prior (n,) of the points (n, ndim) that a run starts from; ValueError if they are no draws of the prior.

        Points that the sampler has drawn (`is_drawn`) are not tested (`samplers.evaluation.starts`).
        """
        if coords.shape != (nwalkers, self.ndim):
            raise ValueError(
                f"incompatible input dimensions: initial_state must be ({nwalkers}, {self.ndim}) draws of the prior; "
                f"got {coords.shape}"
            )
        if not skip_check and not walkers_independent(coords):
            raise ValueError(
                "Initial state has a large condition number: the walkers must be finite and linearly independent, as "
                "draws of the prior are"
            )
        try:
            log_prior = self.log_prior(coords)
        except Exception as error:
            points = "an array (n, ndim) of points" if self.vectorize else "an array (ndim,), one point"
            if self.parameter_names is not None:
                points = "dictionaries of parameters by name (parameter_names)"
            raise ValueError(
                f"log_prior_fn failed with {error!r}. It is called as log_prob_fn is: with {points} "
                f"(vectorize={self.vectorize})"
            ) from error
        outside = np.flatnonzero(log_prior == -np.inf)
        if len(outside) > 0:
            raise ValueError(
                f"{len(outside)} of {len(coords)} initial points lie outside the prior's support (log_prior -inf or "
                f"NaN), the first of them {coords[outside[0]]}: pass draws of the prior"
            )
        if is_drawn or not (reason := not_of_the_prior(coords, self.log_prior)):
            return log_prior
        raise ValueError(
            f"initial_state must consist of draws of the prior; got points that cannot be: {reason}. The evidence "
            "would be wrong. Pass draws of the prior, or None if the function has sample_prior. If they are draws of "
            "the prior, its log-density is another one: a constant without bounds has no draws. To continue a chain, "
            "pass None, or the State that run_mcmc returned"
        )


def _unless_ended(answer: Any) -> Any:
    """An answer from a process of a pool; an error that ends the run is raised here."""
    if isinstance(answer, Ended):
        raise answer.error
    return answer
