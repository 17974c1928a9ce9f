"""The evaluators of a sampler: of its posterior and of the coarse model, from the functions that the user gave."""

from collections.abc import Callable, Mapping, Sequence

from ..tempering.budget import Budget
from .checkpoint import Checkpoint
from .evaluation import CallingConvention, Evaluator, FailureLimit
from .first_evaluations import FirstEvaluations
from .returned_values import ErrorCapturing
from .user_functions import UserFunctions

__all__ = ["make_evaluators"]


def make_evaluators(
    functions: UserFunctions,
    coarse_log_prob_fn: Callable | None,
    arguments: tuple[Sequence, Mapping],
    convention: CallingConvention,
    checkpoint: Checkpoint,
    limit: FailureLimit,
    budget: Budget,
) -> tuple[Evaluator, Evaluator | None]:
    """The evaluator of the posterior, and that of the coarse model or None.

    Parameters
    ----------
    functions : UserFunctions
        What the user gave.
    coarse_log_prob_fn : callable, optional
        Log-posterior of the coarse model.
    arguments : (sequence, mapping)
        Further arguments of the functions, by position and by name.
    convention, checkpoint, limit, budget
        As in `samplers.storage.evaluation.Evaluator`; the coarse model has the convention only.
    """
    fine = Evaluator(
        ErrorCapturing(functions.function, *arguments, convention.vectorize),
        functions.log_prior,
        convention,
        checkpoint,
        limit,
        budget=budget,
        name=functions.name,
        check=FirstEvaluations(functions, any(arguments), convention.blobs_dtype is not None),
        start_density=functions.start_density,
    )
    if coarse_log_prob_fn is None:
        return fine, None
    function = ErrorCapturing(coarse_log_prob_fn, *arguments, convention.vectorize)
    start_density = functions.start_density
    return fine, Evaluator(function, functions.log_prior, convention, keep_blobs=False, start_density=start_density)
