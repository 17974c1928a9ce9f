"""An emcee sampler that anneals draws of the prior to the posterior before it samples.

`TemperedSampler` is an `emcee.EnsembleSampler` whose ``sample`` first carries prior draws to beta = 1
(`samplers.tempering.anneal`). Then emcee's own loop continues, so the chain contains states of the posterior only, and
everything that emcee does with a chain works unchanged. Each walker carries (log_prob, log_prior, blobs) as the blobs
of an emcee State, whose log_prob is the tempered density: any emcee move works below beta = 1, and a change of beta
needs no evaluation. Private attributes of emcee in use, ``_random``, ``_moves``, ``_weights`` and ``_previous_state``,
are pinned by `tests.contract.test_emcee_contract`.
"""

import copy
import inspect
import json
import logging
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from .chain import Chain, open_record
from .emcee_names import EnsembleSampler, State
from .estimates.importance import EvidenceCheck
from .evaluation.asynchronous import AsynchronousEvaluator, check_asynchronous
from .evaluation.evaluator import Evaluator, unpack
from .evaluation.user_target import Target
from .evaluation.values import most_common_reasons
from .interrupts import deferred_interrupts, interrupts_end_the_run
from .judgement.checks import check_end, check_likelihood, check_prior
from .judgement.failures import KEPT_POINTS, judged_failures
from .judgement.verdict import (
    CONVERGED,
    describe_early_stop,
    independent_points,
    judge,
    lost_simulations,
    with_lost_record,
)
from .moves.population_moves import RandomWalkMove, describe, guide_move, with_fast_sweeps, without_unfitted
from .record import BudgetExhausted, EvaluatedBatch, Incomplete, RunStart, as_limit
from .reporting.progress import Progress
from .reports import AnnealingResult, Report, Restart, Stage, warn
from .results import RunResults
from .settings import Settings, as_whole_number, check_arguments
from .tempering.anneal import anneal
from .tempering.guide import Guide, check_guide
from .tempering.guided import lend
from .tempering.mutation import MoveSchedule, check_moves
from .tempering.population import Population, check_size

logger = logging.getLogger(__name__)


class TemperedSampler(RunResults, EnsembleSampler):
    """emcee's ensemble sampler, preceded by annealing from the prior to the posterior.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        As in `emcee.EnsembleSampler`, in the same order. `moves` are the mutation kernels, which are copied; a random
        walk by default. If `log_prob_fn` has ``fast_parameters``, each move is followed by `fast_sweeps` sweeps over
        them (not with a `pool` and ``vectorize=False``, since workers do not cache simulations). A point for which
        `log_prob_fn` raises an exception or returns NaN counts as -inf and is recorded (`failures`). Points outside the
        support of the prior are not evaluated. Blobs that are numbers are stored as floats, others as objects, or as
        `blobs_dtype` says; blobs that this type cannot hold exactly are refused. With an emcee `HDFBackend`, a killed
        run continues (`run_mcmc`).
    log_prior_fn : callable, optional
        Log-density of the normalised prior. It takes the same kind of argument as `log_prob_fn` (a point; a batch with
        `vectorize`; a dict with `parameter_names`) but not `args` and `kwargs`. By default ``log_prob_fn.log_prior``.
        It is always called in this process.
    log_likelihood_fn : callable, optional
        Log-likelihood, in place of `log_prob_fn`, which is then None. It is called in the same way, and may return
        blobs; the log-prior is added to its values. Its attributes are used like attributes of `log_prob_fn`.
    guide : Guide, optional
        An object that proposes draws near the posterior (`samplers.tempering.guide`). Its weighted draws replace the
        annealing, the first stored step is walkers resampled from them, and later ones are proposals of the guide. If
        the draws cannot be trusted, the run is "not usable", with a `SamplingWarning`.
    max_simulations : float, optional
        Largest number of simulations (`simulations`). When it is reached, the posterior is estimated from the known
        points, the final walkers are stored as one step if the chain is empty, and a `SamplingWarning` says so; see
        `verdict`. To continue, set the attribute `max_simulations` to a larger number, or make a new sampler with the
        same file, and call `run_mcmc` again: the result equals a run with the larger number from the start.
    seed : int or array of int, optional
        Seed of the run. By default it is drawn from NumPy's global generator, so that ``np.random.seed`` determines
        the run, and two samplers never share a stream. A file that contains a run keeps its seed: another seed has no
        effect, with a warning in the log.
    **settings
        Settings of the annealing by name; `samplers.settings.Settings` has their names, meanings and defaults.

    Attributes
    ----------
    settings : Settings
        The settings in use.
    seed : int, array of int or None
        The seed that this object was given.
    guide : Guide or None
        A copy of the given guide that learns from this run; None before the run or without a guide.

    Raises
    ------
    ValueError
        For settings that cannot act or have impossible values, an `ndim` that is not ``log_prob_fn.ndim``, fewer than
        2 ndim walkers, no log-prior, or moves of emcee that need several walkers with ``chains="leaders"``.
    TypeError
        For a keyword that is not a setting.
    """

    def __init__(
        self,
        nwalkers,
        ndim,
        log_prob_fn,
        pool=None,
        moves=None,
        args=None,
        kwargs=None,
        backend=None,
        vectorize=False,
        blobs_dtype=None,
        parameter_names=None,
        *,
        log_prior_fn: Callable | None = None,
        log_likelihood_fn: Callable | None = None,
        guide: Guide | None = None,
        max_simulations: float | None = None,
        seed: int | None = None,
        **settings: Any,
    ):
        nwalkers, ndim = as_whole_number("nwalkers", nwalkers), as_whole_number("ndim", ndim)
        check_arguments(pool, backend, seed)
        if unknown := settings.keys() - (names := [each.name for each in fields(Settings)]):
            text = f"{type(self).__name__}() got an unexpected keyword argument {min(unknown)!r}; arguments are "
            *others, _ = inspect.signature(TemperedSampler).parameters
            raise TypeError(f"{text}{', '.join(others)}, and the settings {', '.join(names)}")
        functions = log_prob_fn, log_likelihood_fn, log_prior_fn
        self._target = target = Target(*functions, ndim, args, kwargs, vectorize, blobs_dtype)
        self.log_prior_fn = target.log_prior_fn
        check_size(nwalkers, ndim)
        settings, moves = self._chosen(settings, moves)
        # with 40 normal parameters, 7 sweeps leave means off by 0.57 standard deviations, 60 by 0.04
        most_moves = Settings.max_moves + 3 * max(ndim - 20, 0)
        self.settings = given = Settings(**{"max_moves": most_moves} | settings)
        self._given_guide, self.guide, self.seed = guide, None, seed
        self._guided: np.ndarray | None = None  # the walkers (nwalkers, ndim) as the draws of the guide have left them
        if guide is not None:
            check_guide(guide, target.function, vectorize)

        self._record = open_record(backend, nwalkers, ndim, target.slow_parameters)
        self._record.limit = as_limit(max_simulations)
        self._must_repeat = reopened = self._record.start is not None  # the annealing, from the record
        self._previous_state = None
        same = pool, copy.deepcopy(moves), args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        try:
            super().__init__(nwalkers, ndim, target.function, *same)
        except AssertionError as error:  # emcee's test of the names
            raise ValueError(
                f"parameter_names must be a list of {ndim} different names, or a dict of names with their indices, "
                f"with vectorize=False; got {parameter_names!r}: {error}"
            ) from error
        self._chain = Chain(self.backend)
        self._result, self._verdict = self._chain.result, self._chain.verdict
        self._must_compare = reopened or self.backend.iteration > 0
        known = np.inf if self._record.path is None else self._record.simulations
        self._lost = lost_simulations(self._verdict, known)
        check_moves(self._moves, given.chains)
        self._fast = target.fast_parameters if pool is None or vectorize else ()
        followed = with_fast_sweeps(self._moves, self._fast, ndim, given.fast_sweeps)
        # each annealing begins with copies of these
        self._first_moves = copy.deepcopy(followed), self._weights
        self._moves = followed
        if (given.ess_floor or 0.0) >= nwalkers:
            raise ValueError(f"ess_floor={given.ess_floor} must be below nwalkers={nwalkers}")
        target.parameter_names = self.parameter_names if self.params_are_named else None
        common = target, self._record, nwalkers, given.max_failure_share
        if given.asynchronous:
            check_asynchronous(target, pool, guide is None and bool(given.recycle))
            self._evaluator: Evaluator = AsynchronousEvaluator(*common)
        else:
            self._evaluator = Evaluator(*common)
        known = self._record.latest() if reopened else None
        if known and self._record.start.header["log_prob_fn"] == getattr(target.function, "fingerprint", None):
            target.recall(known)
        self._seed = None if seed is None else np.ravel(seed).tolist()
        # also drawn where it is not used, so that a script draws the same numbers after a restart
        stream = np.random.randint(2**32, size=8, dtype=np.uint32) if seed is None else seed  # noqa: NPY002
        if reopened and self._seed not in (None, stored := self._record.start.header["seed"]):
            logger.warning(
                "%s contains a run with seed=%s: seed=%s has no effect", self.backend.filename, stored, self._seed
            )
        elif self.backend.random_state is None:
            self._random.seed(stream)

    @classmethod
    def _chosen(cls, settings: dict[str, Any], moves: Any) -> tuple[dict[str, Any], Any]:
        """The given settings, with the settings that this sampler chooses, and the moves."""
        return {"recycle": False} | settings, RandomWalkMove() if moves is None else moves

    def __getstate__(self):
        # emcee removes the pool from the living sampler here; remove it from the copy only
        return {**self.__dict__, "pool": None}

    def reset(self):
        """Clear the chain, as in emcee: burn in, reset, and continue with None or the last State."""
        if hasattr(self, "_chain"):
            if not self._must_repeat:
                state = self._previous_state
            else:  # the annealing of a file, whose chain may end with an estimate that is replaced
                state = None if self._chain.provisional else self._chain.last_state()
            self._chain.clear_chain(state)
        else:  # emcee initialises a new backend
            super().reset()

    # ------------------------------------------------------------------ running

    def run_mcmc(self, initial_state, nsteps, **kwargs):
        """Anneal to beta = 1 if that has not been done, then make `nsteps` steps at beta = 1.

        With an emcee `HDFBackend`, a new sampler with the file of a run continues the run, as in emcee, and its results
        equal a run that was never interrupted, to the last bit: the annealing is repeated from the record, without an
        evaluation. A script that is restarted calls ``run_mcmc(None, max(0, nsteps - sampler.iteration))``.

        Parameters
        ----------
        initial_state : (nwalkers, ndim) float, State or None
            Draws of the prior, or a State of this sampler to go on from. None: the last state if there is one, else
            draws of ``log_prob_fn.sample_prior(nwalkers, random)``. Points that cannot be draws of the prior, such as a
            ball near the posterior, are refused with a ValueError (`samplers.evaluation.starts`).
        nsteps : int
            Number of steps stored in the chain; 0 for the annealing only.
        **kwargs
            Arguments of `sample`.

        Returns
        -------
        emcee.State
            The last state.

        Raises
        ------
        KeyboardInterrupt
            At Ctrl-C, even if a library has set a handler that raises something else, as dask_jobqueue does.
        SystemExit
            If the function calls ``sys.exit`` in this process. In a worker process this is a failed evaluation.

        Examples
        --------
        >>> sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
        >>> state = sampler.run_mcmc(None, 2)
        >>> state = sampler.run_mcmc(None, 1)  # a step more
        >>> sampler.iteration
        3
        """
        state = None
        with interrupts_end_the_run():
            for each in self.sample(initial_state, iterations=nsteps, **kwargs):
                state = each
        return State(self._previous_state, copy=True) if state is None else state

    def sample(
        self,
        initial_state,
        log_prob0=None,
        rstate0=None,
        blobs0=None,
        iterations=1,
        tune=False,
        skip_initial_state_check=False,
        thin_by=1,
        thin=None,
        store=True,
        progress=False,
        progress_kwargs=None,
    ) -> Iterator[State]:
        """Advance the chain as a generator: emcee's ``sample``, preceded by the annealing if it is needed.

        The arguments are as in emcee, with `initial_state` as in `run_mcmc`.
        """
        if iterations is None and store:
            raise ValueError("'store' must be False when 'iterations' is None")
        if int(thin_by if thin is None else thin) <= 0:
            raise ValueError("Invalid thinning argument")
        if iterations is not None and (iterations := as_whole_number("nsteps", iterations)) < 0:
            raise ValueError(f"nsteps must be 0 or more; got {iterations} (the chain has {self.iteration} steps)")
        state = None if initial_state is None else State(initial_state, copy=True)
        for name, value in (("log_prob", log_prob0), ("random_state", rstate0), ("blobs", blobs0)):
            if value is not None:
                setattr(state, name, value)
        if self._record.is_stale:
            raise ValueError(
                f"another sampler has written to {self._place} since this sampler was made or last ran, so this one "
                "does not know the chain: make the sampler again, which goes on from the file"
            )
        self._evaluator.pool = self.pool
        arguments = {"tune": tune, "thin_by": thin_by, "thin": thin, "store": store, "iterations": iterations}
        bar = {"progress": progress, "progress_kwargs": progress_kwargs}
        provisional, evaluations, random_state = self._chain.provisional, self.evaluations, self._random.get_state()
        with self._chain.whole():
            try:
                state = self._first_state(state, skip_initial_state_check)
                failures, skip = self.failure_count, skip_initial_state_check
                if isinstance(state, RunStart):
                    start_of_run, stored, skip = state, self._chain.last_state(), True
                    try:
                        with self._annealing(start_of_run, stored, bar) as (steps, take), suppress(StopIteration):
                            answer = None
                            while True:
                                population, report = steps.send(answer)
                                # the search of a guide asks for a function to be called: it is no part of the stack
                                answer = report() if callable(report) else take(population, report)
                        state = self._annealed(population, stored)
                    except Incomplete:
                        state = self._go_on_without_annealing(stored)
                if store and provisional and not self._chain.provisional:
                    arguments["iterations"] = iterations = iterations + 1  # in place of the provisional step
                with deferred_interrupts():
                    self._previous_state = State(state, copy=True)  # where the next call goes on after an interrupt
                    self._must_repeat = self._must_repeat and bool(self._result.ended)
                self._moves = without_unfitted(self._moves)
                self._evaluator.typed(EvaluatedBatch(state.coords, state.log_prob, state.blobs, {}))
                if store:
                    self._chain.trim()
                ended, stored, new = self._must_repeat, State(state, copy=True), 0
                # walkers resampled from a guide's draws are the first step: moves would replace them by as good ones
                untouched = self._guided is not None and np.array_equal(state.coords, self._guided)
                if untouched and store and iterations and not ended and self.backend.iteration == 0:
                    stored.random_state = self.random_state
                    with deferred_interrupts():
                        self._chain.store_step(stored, True)
                        self._chain.step_stored()
                    arguments["iterations"], new = iterations - 1, 1
                    yield State(stored, copy=True)
                steps = () if ended else super().sample(state, skip_initial_state_check=skip, **arguments)
                per_step = 1 if thin else int(thin_by)
                sweeps = None if iterations is None else (iterations - new) * per_step
                shown = Progress(bar, self._evaluator, self._target.function, "sweeps at beta = 1", sweeps)
                try:
                    with shown:
                        for advanced in steps:
                            shown.step(per_step)
                            new += 1
                            with deferred_interrupts():
                                self._previous_state = stored = State(advanced, copy=True)
                                if store:
                                    self._chain.step_stored()
                            self._record.drop_old_points(KEPT_POINTS)
                            yield State(stored, copy=True)  # a move that exceeds the limit may change `advanced`
                except BudgetExhausted:
                    ended = True
                missing = 0 if iterations is None else iterations - new
                self._judge(missing, stored.coords)
                if ended:
                    yield from self._end_early(stored, new, missing, store)
            except Exception as error:
                self._undo(random_state)
                if self.evaluations > evaluations:  # not for an argument that was refused
                    if reasons := self._failed[1]:
                        error.add_note(f"Failures: {reasons}.")
                    error.add_note(self._kept)
                raise
            except (KeyboardInterrupt, SystemExit):
                with deferred_interrupts():
                    self._undo(random_state)
                logger.warning("interrupted: %s", self._kept)
                raise
        if self.failure_count > failures:
            warn(
                f"{self.failure_count - failures} evaluations failed and count as impossible "
                f"({most_common_reasons(reason for _, reason in self._record.failed[failures:])}); see failures"
            )

    @property
    def _made(self) -> str:
        """What a run has made so far, in words."""
        searched = f"{made:.0f} simulations of the guide, " if (made := self._record.of_guides) else ""
        return f"{searched}{self.evaluations} evaluations and {self.iteration} steps"

    @property
    def _kept(self) -> str:
        """What remains of a run that ends by an exception or an interrupt, and where."""
        where = "this process" if self._record.path is None else f"{self._record.path} and {self.backend.filename}"
        return f"{self._made} are kept in {where}. The same call goes on from there."

    def _undo(self, random_state: tuple) -> None:
        """Remove incomplete results: a part of a step, and the draws of a run that has not begun."""
        self._chain.undo_half_a_step()
        if self._record.start is None:  # the next call makes the same draws
            self._random.set_state(random_state)

    def _end_early(self, stored: State, new: int, missing: int, store: bool) -> Iterator[State]:
        """Finish a call that the limit of simulations has ended after `new` steps; `stored` is the last step."""
        self.random_state = stored.random_state
        if store and missing > 0 and self.backend.iteration == 0:
            self._chain.store_step(stored, False, provisional=True)
        text = describe_early_stop(self.verdict, self._record.limit, self._result, new, missing)
        # only steps at beta = 1 are missing in a converged run: nothing to be warned of
        logger.info(text) if self.verdict.status == CONVERGED else warn(text)
        if new == 0 and missing > 0:
            yield stored

    def _judge(self, missing: int, coords: np.ndarray) -> None:
        """Store the verdict on an annealing by this object, or keep the verdict of the backend."""
        if self._result.independent_points is not None or self._verdict is None:
            latest = self._record.latest(KEPT_POINTS)
            self._near = None if latest is None else judged_failures(latest, coords, self._target)
            numbers = self.nwalkers, self.ndim, self.simulations
            names = tuple(self._target.names)
            self._verdict = judge(self._result, *numbers, missing, self._failed[0], self._near, names)
        else:  # an annealing that could not be made again
            self._verdict = self._verdict._replace(simulations=self.simulations)
        self._verdict = with_lost_record(self._verdict, self._lost)
        self._chain.result, self._chain.verdict = self._result, self._verdict
        self._chain.write()

    def compute_log_prob(self, coords):
        """Log-probability and blobs of points (n, ndim), as in emcee; -inf for NaN and outside the prior's support."""
        self._evaluator.pool = self.pool
        return unpack(self._evaluator.evaluate(coords))

    # ------------------------------------------------------------------ where a call begins

    def _first_state(self, given: State | None, skip_check: bool) -> State | RunStart:
        """The state at beta = 1 from which a call continues, or the start of the annealing that comes first."""
        if self._record.start is not None and self._chain.was_reset:
            self.reset()
        self._open_record()
        if self._chain.provisional:
            self._chain.clear_chain()
        start, previous = self._record.start, self._previous_state
        if start is not None and self._must_repeat:
            known = [each.coords for each in (start, previous) if each is not None]
            if given is not None and not any(np.array_equal(given.coords, coords) for coords in known):
                raise ValueError(
                    f"{self._place} contains a run from other draws of the prior: pass None as initial_state to go on "
                    "with it, or use another file; backend.reset(nwalkers, ndim) discards it"
                )
            if self._record.path is not None:  # a user who waits sees that the time spent is not lost
                logger.warning("Going on with %s: %s are stored", self.backend.filename, self._made)
            return start
        if given is None or (start is not None and np.array_equal(given.coords, start.coords)):
            given = previous  # a cell, or a script, that is started again with the same draws goes on
        if given is None:
            return self._new_start(State(self._target.sample_prior(self.nwalkers, self._random)), skip_check, True)
        if previous is not None and given.log_prob is None and np.array_equal(given.coords, previous.coords):
            given.log_prob, given.blobs = copy.deepcopy((previous.log_prob, previous.blobs))
        if given.log_prob is not None and self._result.finished:
            return given
        if start is not None or self.backend.iteration > 0:
            path = None if start is not None else self._record.path
            lost = "" if path is None else f" (the record of the run, {path}, is missing or empty: put it back)"
            raise ValueError(
                f"the chain has {self.iteration} steps that were not annealed from these points{lost}: pass None to "
                "add to them, make a new sampler for other draws of the prior, or use another file for a chain of emcee"
            )
        return self._new_start(given, skip_check)

    def _open_record(self) -> None:
        """Lock the record of a file; once, a ValueError if another posterior or other settings made the stored run."""
        if self._record.start is not None:
            self._record.open()
        if self._must_compare and (found := self._differences(self._record.start)):
            raise ValueError(
                f"{self._place} contains another run: {'; '.join(found)}. Use another file or backend, or "
                "backend.reset(nwalkers, ndim)"
            )
        self._must_compare = False

    def _differences(self, start: RunStart | None) -> list[str]:
        """How the stored run differs from a run of this sampler, as text: in its settings, or in values of a function
        without a fingerprint at the best known point.
        """
        close = {"rtol": 1e-9, "atol": 1e-9}
        if start is not None:
            stored, ours = start.header, self._header()
            if changed := [key for key in ours if stored.get(key) != ours[key]]:
                found = [f"{key} was {stored.get(key)}, is {ours[key]}" for key in changed]
                if changed[0] == "log_prob_fn":  # a guide has the same fingerprint
                    found[0] += ": its model, data, noise or prior differ, or another line of the module with the model"
                return found
            if not np.isclose(float(np.sum(self._target.log_prior(start.coords))), stored["log_prior"], **close):
                return ["the log-prior of the draws that it started from differs"]
        else:
            said = "%s has no record: the chain goes on from its last step, and other settings cannot be noticed"
            logger.warning(said, self._place)
        known = self._record.latest() or self._previous_state
        if getattr(self._target.function, "fingerprint", None) is not None or known is None:
            return []
        best = int(np.argmax(np.where(np.isfinite(known.log_prob), known.log_prob, -np.inf)))
        coords, log_prob = known.coords[best], known.log_prob[best]
        if not np.isfinite(log_prob):
            return []
        answers = list(self._target.answers(coords[None], self.pool))
        found = self._target.evaluated(coords[None], answers[0] if self._target.vectorize else answers).log_prob[0]
        if np.isclose(log_prob, found, equal_nan=True, **close):
            return []
        return [f"log_prob_fn was {log_prob:.10g} at {coords}, is {found:.10g}"]

    @property
    def _place(self) -> str:
        """Where the chain is, for messages."""
        return getattr(self.backend, "filename", "the backend in memory")

    def _header(self) -> dict:
        """The start of this run, in the form that JSON returns.

        The function and the guide are identified by their attributes ``fingerprint``; a guide without one by its class,
        a function without one not at all.
        """
        moves, probabilities = self._first_moves
        header = {
            "log_prob_fn": getattr(self._target.function, "fingerprint", None),
            "sampler": type(self).__name__,
            "log_likelihood_fn": "used" if self._target.is_likelihood else None,
            "blobs_dtype": None if self._target.blobs_dtype is None else str(np.dtype(self._target.blobs_dtype)),
            **asdict(self.settings),
            "moves": [describe(move) for move in moves],
            "probabilities": [float(probability) for probability in probabilities],
            "guide": None if self._given_guide is None else self._given_guide.fingerprint,
        }
        return json.loads(json.dumps(header))

    def _new_start(self, state: State, skip_check: bool, is_drawn: bool = False) -> RunStart:
        """Draws of the prior, checked and entered in the record."""
        coords = np.asarray(state.coords, dtype=float)
        log_prior = self._target.check_start(coords, self.nwalkers, skip_check, is_drawn)
        self.random_state = state.random_state
        run = {"run": uuid.uuid4().hex, "seed": self._seed, "log_prior": float(np.sum(log_prior))}
        start = RunStart(self._header() | run, coords, self.random_state)
        self._record.begin(start)
        self._chain.begin(run["run"])
        if state.log_prob is not None:
            known = EvaluatedBatch(coords, np.asarray(state.log_prob, dtype=float), state.blobs, {})
            self._record.evaluated(self._evaluator.typed(known))
        return start

    # ------------------------------------------------------------------ annealing

    @contextmanager
    def _annealing(self, start: RunStart, stored: State | None, bar: dict) -> Iterator[tuple]:
        """The steps of an annealing from draws of the prior, and a function that takes what they report.

        `stored` is the last state at beta = 1 if the run is made again.
        """
        self._result, self._verdict, self._must_repeat = AnnealingResult(), None, True
        self.random_state = start.random_state
        self._record.use(None)
        schedule, guided = MoveSchedule(*copy.deepcopy(self._first_moves)), None
        self._moves, self._weights = schedule
        self._evaluator.remember = remember = self._record.remembering()
        if self._given_guide is not None:
            self.guide = self._given_guide.fresh()
            guided = self.guide, lend(self.guide, self._random, remember, self._record)
        self._record.is_complete = stored is not None
        population = Population(0.0, start.coords, None, float(self.nwalkers))
        since = begun = time.perf_counter(), self._evaluator.evaluations
        try:
            with (
                closing(self._evaluator),
                Progress(bar, self._evaluator, self._target.function, "annealing") as progress,
            ):

                def take(population: Population, report: Report) -> None:
                    nonlocal since
                    if isinstance(report, Stage):
                        seconds, made = time.perf_counter() - since[0], self._evaluator.evaluations - since[1]
                        report = report._replace(seconds=seconds, evaluations=made)
                        since = time.perf_counter(), self._evaluator.evaluations
                    elif isinstance(report, Restart):  # the first stage takes what the stages before it took
                        since = begun
                    elif isinstance(report, EvidenceCheck):
                        since = since[0], since[1] + report.evaluations  # these belong to no stage
                    self._result = self._result.add(report, population.founders)
                    progress.show(self._result, population, report)

                yield anneal(population, self._evaluator, self._random, schedule, self.settings, guided), take
        finally:
            self._record.is_complete = False

    def _annealed(self, population: Population, stored: State | None) -> State:
        """The state at beta = 1 that an annealing has led to, or the last `stored` state of a run made again."""
        result, weighted = self._result, self._result.weighted
        first = self._record.latest()
        coords, log_prob = first.coords[: self.nwalkers], first.log_prob[: self.nwalkers]  # of the prior, or of a guide
        log_prior = self._target.log_prior(coords)
        said = check_end(result, population.coords) + check_likelihood(log_prob, log_prior)
        said += check_prior(coords, log_prior) if self.guide is None else list(self.guide.findings)
        for finding in said:
            self._result = self._result.add(finding, population.founders)
        basis = "" if self.guide is None else self.guide.basis
        independent = independent_points(result, population.coords)
        self._result = self._result._replace(basis=basis, independent_points=independent)
        ended = bool(result.ended)
        self._guided = population.coords.copy() if weighted is not None and weighted.guided and not ended else None
        if self._guided is not None:
            moves = with_fast_sweeps([guide_move(self.guide)], self._fast, self.ndim, self.settings.fast_sweeps)
            schedule = MoveSchedule(moves, np.ones(1))
            schedule.calibrate(population.coords, np.full(self.nwalkers, 1.0 / self.nwalkers))
            self._moves, self._weights = schedule
        self._judge(0, population.coords)
        if not ended and self._record.path is None:  # the annealing is not made again in this process
            self._record.close()
        if stored is not None and not ended:
            self.random_state = stored.random_state
            return stored
        log_prob, blobs = unpack(population.records)
        state = State(population.coords, log_prob=log_prob, blobs=blobs, random_state=self.random_state)
        if not ended:
            self._chain.write(state)
        return state

    def _go_on_without_annealing(self, stored: State) -> State:
        """The last stored state of a run whose annealing cannot be made again, with the results that are stored."""
        warn(
            f"the annealing in {self._place} cannot be made again: another processor, or another version of NumPy or "
            "SciPy, computes other bits, or its record has lost points. The chain goes on from its last stored state, "
            "with its stored results, by differential evolution instead of moves that were fitted to the annealing"
        )
        self._result, self._verdict, self._near = self._chain.result, self._chain.verdict, None
        self._record.use(None)
        self.random_state = stored.random_state
        self._moves, self._weights = copy.deepcopy(self._first_moves)
        return stored
