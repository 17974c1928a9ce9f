"""The user's functions: the posterior as one function or as prior and likelihood, and optional attributes."""

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from ..interrupts import raise_if_it_ends_the_run
from .starts import SEED, compare_with_draws, draws_to_compare, spread_by_metropolis

__all__ = ["OptionalAttributes", "UserFunctions"]

logger = logging.getLogger(__name__)


class OptionalAttributes(NamedTuple):
    """Optional attributes of a user's log-posterior or log-likelihood."""

    log_prior: Callable | None  # of a point or a batch
    sample_prior: Callable | None  # function of (n, random) that returns draws (n, ndim) of the prior
    report: Callable[[], Mapping[str, Any]] | None  # returns a dictionary, such as {"simulations": 120}
    # Whether points (n, ndim), always an array, may have a positive density, (n,) bool, as far as is known without a
    # simulation. A value of -inf at other points is not a failed simulation.
    possible: Callable[[np.ndarray], np.ndarray] | None
    # Indices of parameters whose change needs no simulation, such as noise levels: points that differ only in these
    # count as one simulation.
    fast_parameters: Sequence[int]
    ndim: int | None
    parameter_names: Sequence[str]

    @classmethod
    def of(cls, function: Callable) -> "OptionalAttributes":
        """Read the attributes of a function."""
        found = (getattr(function, name, None) for name in ("log_prior", "sample_prior", "report", "possible"))
        return cls(
            *found,
            getattr(function, "fast_parameters", ()),
            getattr(function, "ndim", None),
            getattr(function, "parameter_names", ()),
        )

    def slow_parameters(self, ndim: int) -> list[int]:
        """Indices of the parameters that a simulation depends on; all parameters if none is slow."""
        fast = set(self.fast_parameters)
        return [j for j in range(ndim) if j not in fast] or list(range(ndim))

    @property
    def counts_failures(self) -> bool:
        """Whether the function counts failed simulations by itself, so that -inf at a possible point is a failure."""
        return self.failure_count is not None

    @property
    def failure_count(self) -> int | None:
        """Number of failed simulations by the count of the function; None if it does not count them."""
        found = self.report() if callable(self.report) else None
        return int(found["failure_count"]) if isinstance(found, Mapping) and "failure_count" in found else None

    def may_be_positive(self, coords: np.ndarray) -> np.ndarray:
        """Whether points (n, ndim) may have a positive density, as bool (n,), by `possible`; True if unknown."""
        unknown = np.ones(len(coords), dtype=bool)
        if not callable(self.possible) or len(coords) == 0:
            return unknown
        before = sys.exception()
        try:
            found = np.asarray(self.possible(coords.copy()))
        except Exception as error:
            raise_if_it_ends_the_run(error, before)
            logger.warning("the verdict takes all points as possible, since the method possible failed: %r", error)
            return unknown
        if found.shape != (len(coords),) or found.dtype != bool:
            logger.warning(
                "the verdict takes all points as possible: the method possible must return bool of shape (%d,); got "
                "%s of shape %s",
                len(coords),
                found.dtype,
                found.shape,
            )
            return unknown
        return found

    def check_ndim(self, ndim: int, name: str) -> None:
        """Raise ValueError if the function states another number of parameters than `ndim`."""
        if isinstance(self.ndim, Integral) and self.ndim != ndim:
            names = f" ({', '.join(map(str, self.parameter_names))})" if self.parameter_names else ""
            raise ValueError(f"ndim is {ndim}, but {name} has {self.ndim} parameters{names}: pass ndim={self.ndim}")


class UserFunctions(NamedTuple):
    """The log-posterior or log-likelihood of a user (`name` says which), the log-prior, and optional attributes."""

    name: str
    function: Callable
    log_prior: Callable
    optional: OptionalAttributes

    @classmethod
    def of(
        cls,
        log_prob_fn: Callable | None,
        log_likelihood_fn: Callable | None,
        log_prior_fn: Callable | None,
    ) -> "UserFunctions":
        """Check and combine the arguments of a sampler.

        Raises ValueError unless exactly one of `log_prob_fn` and `log_likelihood_fn` is given and a log-prior is known,
        or if `log_prob_fn` is a method called log_likelihood.
        """
        if (log_prob_fn is None) == (log_likelihood_fn is None):
            given = "neither" if log_prob_fn is None else "both"
            raise ValueError(
                "exactly one of log_prob_fn (log-prior plus log-likelihood) and log_likelihood_fn must be given; got "
                f"{given}. To pass a log-likelihood, use SMCSampler(nwalkers, ndim, None, log_likelihood_fn=..., "
                "log_prior_fn=...)"
            )
        name = "log_likelihood_fn" if log_prob_fn is None else "log_prob_fn"
        function = log_likelihood_fn if log_prob_fn is None else log_prob_fn
        if not callable(function):
            raise ValueError(f"{name} must be callable; got {function!r}")
        owner = getattr(function, "__self__", None)
        if name == "log_prob_fn" and owner is not None and function == getattr(owner, "log_likelihood", None):
            raise ValueError(
                "log_prob_fn is the method log_likelihood, which lacks the log-prior: the evidence would be wrong. "
                "Pass None as log_prob_fn, and the method as log_likelihood_fn=; or pass the object itself"
            )
        optional = OptionalAttributes.of(function)
        log_prior = optional.log_prior if log_prior_fn is None else log_prior_fn
        if not callable(log_prior):
            raise ValueError(
                f"annealing starts from the prior: pass log_prior_fn, or a {name} with a method log_prior (a posterior "
                f"object itself, not its bound method); got {log_prior!r}"
            )
        return cls(name, function, log_prior, optional)

    @property
    def is_likelihood(self) -> bool:
        """Whether the log-prior must be added to what `function` returns."""
        return self.name == "log_likelihood_fn"

    def described(self) -> dict:
        """Entries in the header of a run besides fingerprints; None for unused functions."""
        return {"log_likelihood_fn": "used" if self.is_likelihood else None}

    def draw_prior(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim) of the prior; ValueError without `sample_prior`."""
        if self.optional.sample_prior is None:
            raise ValueError(
                f"initial_state is None and {self.name} has no method sample_prior(n, random): pass {n} draws of the "
                "prior"
            )
        return np.array(self.optional.sample_prior(n, random), dtype=float)

    def check_start(self, coords: np.ndarray, log_prior: Callable[[np.ndarray], np.ndarray]) -> None:
        """Raise ValueError for points (n, ndim) that cannot be draws of the prior (`samplers.evaluation.starts`).

        `log_prior` is a function of points (n, ndim) that returns (n,).
        """
        fresh, names = self._fresh_draws(*coords.shape), list(self.optional.parameter_names or ())
        if fresh is None:
            reason, compared = spread_by_metropolis(coords, log_prior), ""
        else:
            reason, compared = compare_with_draws(coords, fresh, names), f"compared with {len(fresh)} fresh draws, "
        if not reason:
            return
        known = "None, so that the sampler draws the prior" if fresh is not None else "draws of the prior"
        raise ValueError(
            f"initial_state must consist of draws of the prior; got points that cannot be: {compared}{reason}. "
            f"The evidence would be wrong. Pass {known}, not points near the posterior. If they are draws of the "
            "prior, its log-density is another one: a constant without bounds has no draws. To continue a chain, pass "
            "None, or the State that run_mcmc returned"
        )

    def _fresh_draws(self, n: int, ndim: int) -> np.ndarray | None:
        """Draws of the prior to compare n points with; None if there are none."""
        if self.optional.sample_prior is None:
            return None
        state, count = np.random.get_state(), draws_to_compare(n)  # noqa: NPY002
        before = sys.exception()
        try:
            fresh = np.asarray(self.optional.sample_prior(count, np.random.RandomState(SEED)), dtype=float)
        except Exception as error:
            raise_if_it_ends_the_run(error, before)
            logger.warning("initial_state is tested without fresh draws, since sample_prior failed: %r", error)
            return None
        finally:
            np.random.set_state(state)  # noqa: NPY002  a sample_prior that uses the global generator changes no run
        if fresh.shape != (count, ndim) or not np.all(np.isfinite(fresh)):
            logger.warning(
                "initial_state is tested without fresh draws: sample_prior(%d, random) must return finite numbers of "
                "shape %s; got shape %s",
                count,
                (count, ndim),
                fresh.shape,
            )
            return None
        return fresh
