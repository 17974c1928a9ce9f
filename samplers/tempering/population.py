"""What annealing passes on and reports: populations, stages, sweeps.

`samplers.tempering.anneal.anneal` yields pairs of a `Population`, which the next step needs, and a `Report`, which a
reader wants to see.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from emcee.ensemble import walkers_independent

from .evidence_check import EvidenceCheck
from .flights import Flight

__all__ = [
    "Density",
    "Doubt",
    "GuideTick",
    "GuidedRound",
    "GuidedStart",
    "Halt",
    "Population",
    "Report",
    "Restart",
    "Stage",
    "Sweep",
    "check_size",
    "check_start",
]


class Density(Protocol):
    """A posterior density with its prior, as annealing evaluates it.

    Attributes
    ----------
    evaluations : int
        Number of points evaluated so far.
    workers : int
        Number of points that are evaluated at once, if `submit` returns without waiting; else 0.
    map : callable
        How an emcee move that evaluates points by itself maps a function over them: ``map`` or ``pool.map``.
    """

    evaluations: int
    workers: int

    @property
    def map(self) -> Callable: ...

    def evaluate(self, coords: np.ndarray) -> np.ndarray:
        """Records (n,) of points (n, ndim), with the fields log_prob, log_prior and, where there are any, blobs."""

    def evaluate_observed(self, coords: np.ndarray, observe: Callable[[np.ndarray], None]) -> np.ndarray:
        """As `evaluate`, but `observe` is called with the points directly before they are evaluated.

        Needed only for a guide with a method `observe`.
        """

    def submit(self, coords: np.ndarray) -> Flight:
        """Begin to evaluate points (n, ndim); a synchronous density returns when all are evaluated.

        With a limit of simulations, the first points that fit are submitted.
        """

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior: (n,) bool."""


class Population(NamedTuple):
    """Points at one beta.

    Attributes
    ----------
    beta : float
        Tempering exponent, 0 for draws of the prior and 1 for draws of the posterior.
    coords : (n, ndim) float
        The points.
    records : (n,) structured array, or None
        Fields log_prob, log_prior and, where there are any, blobs. None: the points have not been evaluated.
    effective_sample_size : float
        Of the weights that led to this population.
    founders : tuple of (n,) int
        See `samplers.tempering.genealogy.trace_founders`; empty before the first resampling.
    log_weights : (n,) float, optional
        Logarithms of the weights at `beta`; None for equally weighted points.
    """

    beta: float
    coords: np.ndarray
    records: np.ndarray | None
    effective_sample_size: float
    founders: tuple[np.ndarray, ...] = ()
    log_weights: np.ndarray | None = None


def check_size(nwalkers: int, ndim: int) -> None:
    """Raise ValueError for too few walkers or parameters."""
    if ndim < 1 or nwalkers < 2 * ndim:
        raise ValueError(
            "a population must span the parameters: at least 2 ndim walkers and one parameter are needed, some "
            f"hundreds of walkers are usual; got nwalkers={nwalkers} for ndim={ndim}"
        )


def check_start(coords: np.ndarray, nwalkers: int, ndim: int, skip_independence: bool) -> None:
    """Raise ValueError unless points have the shape (nwalkers, ndim) and, if that is wanted, span the parameters."""
    if coords.shape != (nwalkers, ndim):
        raise ValueError(
            f"incompatible input dimensions: initial_state must be ({nwalkers}, {ndim}) draws of the prior; got "
            f"{coords.shape}"
        )
    if not skip_independence and not walkers_independent(coords):
        raise ValueError(
            "Initial state has a large condition number: the walkers must be finite and linearly independent, as draws "
            "of the prior are"
        )


class Stage(NamedTuple):
    """A finished tempering stage.

    Attributes
    ----------
    beta : float
        Tempering exponent of the stage, 0 < beta <= 1.
    effective_sample_size : float
        Of the incremental weights that led to this stage.
    acceptance : float
        Share of the proposals of this stage that were accepted.
    moves : int
        Sweeps of the whole ensemble made at this beta, without those over fast parameters; 0 for a stage of recycling.
    distinct_ancestors : int
        Number of different points that survived the resampling.
    log_evidence_increment : float
        Logarithm of the mean incremental weight.
    log_evidence_error : float
        Standard error of the sum of the increments so far.
    evaluations : int
        Points for which ``log_prob_fn`` was called in this stage (the first stage includes the draws of the prior).
        Sweeps over fast parameters count, so this can exceed the number of simulations. Entered by the sampler.
    seconds : float
        Wall time of the stage [s]. Entered by the sampler.
    """

    beta: float
    effective_sample_size: float
    acceptance: float
    moves: int
    distinct_ancestors: int
    log_evidence_increment: float
    log_evidence_error: float
    evaluations: int = 0
    seconds: float = 0.0


class Sweep(NamedTuple):
    """One sweep of the ensemble, or one stage of recycling: a tick of the progress bar.

    Attributes
    ----------
    acceptance : float
        Share of the proposals that were accepted; of recycling, the yield of the latest draws.
    """

    acceptance: float


class GuideTick(NamedTuple):
    """A tick of the progress bar while a guide is in use.

    Attributes
    ----------
    phase : str
        What the guide does: "search", "round 3", or "after round 3" while it learns.
    simulations : float
        Simulations so far.
    target : int
        Effective sample size that is wanted of all rounds; that of the population is the present one.
    finished : bool
        Whether a batch is finished; False where a phase begins.
    """

    phase: str
    simulations: float
    target: int
    finished: bool


class Restart(NamedTuple):
    """Annealing starts again: the stages reported so far are void.

    Attributes
    ----------
    reason : str
        Why their result cannot be trusted.
    """

    reason: str


class GuidedRound(NamedTuple):
    """A round of draws of a guide.

    Attributes
    ----------
    draws : int
        Number of draws.
    effective_share : float
        Effective sample size of their weights divided by their number.
    pareto_shape : float
        Pareto shape of their largest weights; inf for too few weights.
    log_evidence, log_evidence_error : float
        Log-evidence of all rounds so far, and its standard error.
    effective_sample_size : float
        Of the weights of all rounds so far.
    """

    draws: int
    effective_share: float
    pareto_shape: float
    log_evidence: float
    log_evidence_error: float
    effective_sample_size: float


class GuidedStart(NamedTuple):
    """Result of the rounds of a guide.

    Attributes
    ----------
    doubt : str
        Why the draws of the guide are not used as draws of the posterior; empty if they are.
    shortfall : str
        What the rounds did not reach although their draws are used, or that the tails of the guide are too light; empty
        for neither.
    pareto_shape : float
        Pareto shape of the largest weights of all rounds.
    """

    doubt: str
    shortfall: str
    pareto_shape: float

    @property
    def used(self) -> bool:
        """Whether the population consists of draws of the guide."""
        return not self.doubt


class Doubt(NamedTuple):
    """A reason to doubt the result.

    Attributes
    ----------
    message : str
        What was found, and what to do.
    grave : bool
        Whether the numbers may be wrong by more than their stated errors.
    """

    message: str
    grave: bool


class Halt(NamedTuple):
    """The limit of simulations ended the annealing.

    Attributes
    ----------
    beta : float
        Tempering exponent of the points from which the population was made; 1 after a complete annealing.
    points : int
        Number of points from which the population was made.
    effective_sample_size : float
        Of their weights at beta = 1.
    pareto_shape : float
        Pareto shape of the largest of these weights.
    complete : bool
        Whether the annealing was complete; only moves or a check at beta = 1 are then missing.
    from_guide : bool
        Whether the points are the draws of a guide.
    """

    beta: float
    points: int
    effective_sample_size: float
    pareto_shape: float
    complete: bool = False
    from_guide: bool = False


Report = Stage | Sweep | GuideTick | Restart | EvidenceCheck | GuidedRound | GuidedStart | Halt | Doubt
