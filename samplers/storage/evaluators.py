"""The evaluators of a sampler: of its posterior and of the coarse model, from the functions that the user gave."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from ..tempering.budget import Budget
from .asynchronous import AsynchronousEvaluator, EvaluationQueue
from .checkpoint import Checkpoint
from .evaluation import CallingConvention, Evaluator, FailureLimit
from .first_evaluations import FirstEvaluations
from .pool_queue import PoolQueue, can_submit
from .returned_values import ErrorCapturing
from .user_functions import UserFunctions

__all__ = ["check_asynchronous", "make_evaluators"]


def make_evaluators(
    functions: UserFunctions,
    coarse_log_prob_fn: Callable | None,
    arguments: tuple[Sequence, Mapping],
    convention: CallingConvention,
    checkpoint: Checkpoint,
    limit: FailureLimit,
    budget: Budget,
    asynchronous: bool = False,
    queue: Callable[[], EvaluationQueue] | None = None,
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
    asynchronous : bool
        Whether points of the posterior arrive in any order (`samplers.storage.asynchronous`).
    queue : callable, optional
        Opens the queue of a posterior in place of its method `evaluation_queue`.
    """
    captured = ErrorCapturing(functions.function, *arguments, convention.vectorize)
    options = {
        "budget": budget,
        "name": functions.name,
        "check": FirstEvaluations(functions, any(arguments), convention.blobs_dtype is not None),
        "start_density": functions.start_density,
    }
    common = captured, functions.log_prior, convention, checkpoint, limit
    if asynchronous:
        opened = partial(_open_queue, functions.function, captured, convention, queue)
        fine: Evaluator = AsynchronousEvaluator(*common, **options, open_queue=opened)
    else:
        fine = Evaluator(*common, **options)
    if coarse_log_prob_fn is None:
        return fine, None
    function = ErrorCapturing(coarse_log_prob_fn, *arguments, convention.vectorize)
    start_density = functions.start_density
    return fine, Evaluator(function, functions.log_prior, convention, keep_blobs=False, start_density=start_density)


def check_asynchronous(function: Callable, pool: Any, vectorize: bool) -> None:
    """Raise ValueError where points cannot be submitted one by one."""
    if _has_queue(function, pool) and vectorize or can_submit(pool) and not vectorize:
        return
    raise ValueError(
        "asynchronous=True needs points that can be submitted one by one: pass a posterior that has the method "
        "evaluation_queue (Posterior of fe_likelihoods, with its own pool) and vectorize=True, or a function of one "
        "point and a pool with submit (an executor of concurrent.futures or mpi4py, a dask client) or apply_async "
        f"(multiprocessing.Pool); got {type(function).__name__}, pool={type(pool).__name__}, vectorize={vectorize}"
    )


def _has_queue(function: Callable, pool: Any) -> bool:
    """Whether a function has a queue of its own, and is not to be sent to a pool."""
    return pool is None and callable(getattr(function, "evaluation_queue", None))


def _open_queue(
    function: Callable,
    captured: ErrorCapturing,
    convention: CallingConvention,
    queue: Callable[[], EvaluationQueue] | None,
    pool: Any,
) -> EvaluationQueue:
    """The queue of a posterior, or one of a pool."""
    if _has_queue(function, pool):
        return function.evaluation_queue() if queue is None else queue()
    if pool is None:
        raise ValueError("this sampler was begun with a pool, which is not stored with it: set its attribute pool")
    return PoolQueue(captured, pool, convention.as_points)
