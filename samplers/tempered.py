"""An emcee sampler that anneals draws of the prior to the posterior before it samples.

`TemperedSampler` is an `emcee.EnsembleSampler`. Its ``sample`` first carries a population of draws of the prior to
beta = 1 (`samplers.tempering.anneal`). Then emcee's own loop continues at beta = 1. So the chain contains states of the
posterior only, and everything that emcee does with a chain works unchanged.

Each walker carries (log_prob, log_prior, blobs) as the blobs of an emcee State, whose log_prob is the tempered density.
Therefore any emcee move works below beta = 1, and a change of beta needs no evaluation.

Three collaborators do the rest: `samplers.storage.evaluation.Evaluator` evaluates and counts,
`samplers.storage.checkpoint.Checkpoint` stores and resumes, `samplers.tempering.results.AnnealingResult` holds the
ladder and the evidence.
"""

import copy
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from emcee import EnsembleSampler, State

from .moves.fast_parameters import with_fast_sweeps
from .moves.guided import GuideMove
from .moves.kernels import RandomWalkMove, calibrate_move
from .moves.snooker import with_snooker_moves
from .reporting.progress import ANNEALING, Progress, get_progress_bar, show_sweeps
from .reporting.run_results import RunResults
from .storage.checkpoint import Checkpoint
from .storage.compatibility import SEED, header, warn_of_other_seed
from .storage.emcee_internals import get_moves, get_previous_state, get_random, set_moves, set_previous_state
from .storage.evaluation import CallingConvention, FailureLimit
from .storage.evaluators import check_asynchronous, make_evaluators
from .storage.journal import RunStart
from .storage.pool_queue import advise_on_pool
from .storage.recording import record
from .storage.resumption import PresentCall, Resumption
from .storage.script import Request, describe_options
from .storage.user_functions import UserFunctions
from .tempering.anneal import anneal
from .tempering.budget import Budget, BudgetExhausted, as_limit
from .tempering.diagnostics import warn
from .tempering.guide import AdaptedGuide, Guide, check_guide
from .tempering.guided import lend
from .tempering.multilevel import check_coarse
from .tempering.mutation import MoveSchedule, check_moves
from .tempering.population import Population, check_size, check_start
from .tempering.results import AnnealingResult
from .tempering.settings import Settings, as_whole_number, combine_settings, refuse_unused
from .tempering.verdict import describe_halt, independent_points, judge

__all__ = ["TemperedSampler"]

logger = logging.getLogger(__name__)


class TemperedSampler(Resumption, RunResults, EnsembleSampler):
    """emcee's ensemble sampler, preceded by annealing from the prior to the posterior.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        As in `emcee.EnsembleSampler`, in the same order. `moves` are the mutation kernels, which are copied; a random
        walk by default. Where `log_prob_fn` has ``fast_parameters``, each move is followed by `fast_sweeps` sweeps over
        them (not with a `pool` and ``vectorize=False``, since workers do not cache simulations). A point for which
        `log_prob_fn` raises an exception or returns NaN counts as -inf and is recorded (`failures`). Points outside the
        support of the prior are not evaluated. With an emcee `HDFBackend`, a journal is kept beside the file, and a
        run that was killed continues from it (`run_mcmc`).
    log_prior_fn : callable, optional
        Log-density of the normalised prior. It takes the same kind of argument as `log_prob_fn` (a point; a batch with
        `vectorize`; a dict with `parameter_names`) but not `args` and `kwargs`. By default ``log_prob_fn.log_prior``.
        It is always called in this process.
    log_likelihood_fn : callable, optional
        Log-likelihood, in place of `log_prob_fn`, which is then None. It is called in the same way, and may return
        blobs; the log-prior is added to its values. Its attributes count as those of `log_prob_fn`.
    start_density : callable, optional
        Normalised log-density that the initial state is drawn from, if that is not the prior, called like
        `log_prior_fn`; finite wherever the log-prior is. The annealing then leads from it to the posterior.
    coarse_log_prob_fn : callable, optional
        A cheaper version of `log_prob_fn` to anneal on first, called in the same way
        (`samplers.tempering.multilevel`); a posterior may provide one as ``posterior.coarse``. Chain and evidence are
        those of `log_prob_fn` in any case. Blobs of the coarse model are not kept, and its failures count as -inf. A
        run that is continued from its journal evaluates the coarse model again. Requires recycling.
    guide : Guide, optional
        An object that proposes draws near the posterior (`samplers.tempering.guide`). Its weighted draws replace the
        annealing, and the sweeps at beta = 1 are proposals of the guide. Where the draws cannot be trusted, recycling
        starts from them, with a `SamplingWarning`.
    max_simulations : float, optional
        Largest number of simulations (`simulations`). Where it is reached, the posterior is estimated from the points
        that are known, the state is stored once if the call has stored no step, and a `SamplingWarning` says so; see
        `verdict`. To go on, set the attribute `max_simulations` to a larger number, or make a new sampler with the same
        file, and call `run_mcmc` again: the result is that of a run with the larger number from the start. (A new
        sampler first evaluates a `log_prob_fn` without a `fingerprint` again at `nwalkers` points; these do not count.)
    seed : int or array of int, optional
        Seed of the run. By default it is drawn from NumPy's global generator, so that ``np.random.seed`` determines
        the run, and two samplers never share a stream. A file that contains a run keeps its seed: another one has no
        effect, with a warning in the log.
    settings : Settings, optional
        Settings of the annealing; `samplers.tempering.settings.Settings` has their names, meanings and defaults.
    **overrides
        Single settings by name, which take precedence over `settings`.

    Attributes
    ----------
    settings : Settings
        The settings in use.
    seconds : float
        Wall time spent by this object in annealing and sweeps [s].

    Raises
    ------
    ValueError
        For settings that cannot act or have impossible values, an `ndim` that is not ``log_prob_fn.ndim``, fewer than
        2 ndim walkers, no log-prior, a coarse model without recycling, or moves of emcee that need several walkers with
        ``chains="leaders"``.
    TypeError
        For a keyword that is not a setting.
    """

    # settings that a sampler never uses, and what to do instead
    unused_settings: Mapping[str, str] = MappingProxyType({})
    # what to do where recycling is needed and off
    how_to_recycle = "pass recycle=True"

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
        start_density: Callable | None = None,
        coarse_log_prob_fn: Callable | None = None,
        guide: Guide | None = None,
        max_simulations: float | None = None,
        seed: int | None = None,
        settings: Settings | None = None,
        **overrides: Any,
    ):
        functions = UserFunctions.of(log_prob_fn, log_likelihood_fn, log_prior_fn, start_density)
        self._functions, self._optional, self.log_prior_fn = functions, functions.optional, functions.log_prior
        nwalkers, ndim = as_whole_number("nwalkers", nwalkers), as_whole_number("ndim", ndim)
        self._optional.check_ndim(ndim, functions.name)
        check_size(nwalkers, ndim)
        given = combine_settings(type(self).__name__, settings, overrides)
        recycle, moves = self._choose(given, moves, nwalkers)
        self.settings = replace(given, recycle=recycle)
        if coarse_log_prob_fn is not None:
            off = f" and recycle=False: {self.how_to_recycle}" if given.recycle is False else f": {self.how_to_recycle}"
            check_coarse(coarse_log_prob_fn, recycle, f"{type(self).__name__} with {nwalkers} walkers{off}")
        self.coarse_log_prob_fn = coarse_log_prob_fn
        self._given_guide, self._guide = guide, None
        if guide is not None:
            check_guide(guide, functions.function, vectorize)

        self._budget = Budget(limit=as_limit(max_simulations))
        self._checkpoint = Checkpoint(backend, limited=max_simulations is not None)
        self._result, self._verdict = AnnealingResult(), None
        self._start_is_open = False
        self.seconds = 0.0
        set_previous_state(self, None)
        super().__init__(
            nwalkers,
            ndim,
            functions.function,
            pool=pool,
            moves=copy.deepcopy(moves),
            args=args,
            kwargs=kwargs,
            backend=self._checkpoint.backend,
            vectorize=vectorize,
            blobs_dtype=blobs_dtype,
            parameter_names=parameter_names,
        )
        check_moves(get_moves(self)[0], given.chains)
        own_moves = with_snooker_moves(get_moves(self)[0])
        fast = self._optional.fast_parameters if pool is None or vectorize else ()
        followed = with_fast_sweeps(own_moves, fast, ndim, self.settings.fast_sweeps)
        set_moves(self, followed)
        self._usual_moves: MoveSchedule | None = None  # those that the moves of a guide have replaced
        self._fast, self._first_moves = fast, copy.deepcopy(followed)
        self._budget.fast = self._optional.fast_parameters
        unused = dict(self.unused_settings)
        if coarse_log_prob_fn is not None:
            unused["runs"] = "the runs begin with draws of the prior, not with a coarse model: pass one of them"
        refuse_unused(given, recycle, followed != own_moves, unused, guide is not None)
        advise_on_pool(pool)
        if given.asynchronous:
            check_asynchronous(functions.function, pool, vectorize)
        if given.ess_floor >= nwalkers:
            raise ValueError(f"ess_floor={given.ess_floor} must be below nwalkers={nwalkers}")

        convention = CallingConvention(vectorize, self.parameter_names if self.params_are_named else None, blobs_dtype)
        limit = FailureLimit(self.settings.max_failure_share, nwalkers, ndim)
        queue = getattr(guide, "evaluation_queue", None)
        common = (self.log_prob_fn.args, self.log_prob_fn.kwargs), convention, self._checkpoint, limit, self._budget
        self._evaluator, self._coarse_evaluator = make_evaluators(
            functions, coarse_log_prob_fn, *common, self.settings.asynchronous, queue
        )
        self._drawn: np.ndarray | None = None  # a start that need not be tested
        self._result, self._verdict = self._checkpoint.stored_result(), self._checkpoint.stored_verdict()
        self._seed = None if seed is None else np.ravel(seed).tolist()
        if self._checkpoint.interrupted is not None:
            warn_of_other_seed(self.backend.filename, self._checkpoint.interrupted, self._seed)
        if self.backend.random_state is None:
            get_random(self).seed(np.random.randint(2**32, size=8, dtype=np.uint32) if seed is None else seed)  # noqa: NPY002

    @classmethod
    def _choose(cls, settings: Settings, moves: Any, nwalkers: int) -> tuple[bool, Any]:
        """Whether to recycle, and the moves."""
        return bool(settings.recycle), RandomWalkMove() if moves is None else moves

    def __getstate__(self):
        # emcee removes the pool from the living sampler here; remove it from the copy only
        return {**self.__dict__, "pool": None}

    def reset(self):
        """Clear the chain, as in emcee. Ladder and state at beta = 1 are kept: burn in, reset, continue."""
        self._leave_open_loop()
        super().reset()
        self._checkpoint.store_result(self._result, self._verdict)

    # ------------------------------------------------------------------ running

    def run_mcmc(self, initial_state, nsteps, **kwargs):
        """Anneal to beta = 1 if that has not been done, then make `nsteps` sweeps at beta = 1.

        With an emcee `HDFBackend`, a new sampler with the file of a killed run continues that run, even within a stage
        or a sweep, and gives the same results to the last bit: pass None or the draws of the prior that it started
        with. A call that was interrupted is completed by the same call; any other number of steps is added to the
        chain.

        Parameters
        ----------
        initial_state : (nwalkers, ndim) float, State or None
            Draws of the prior, or of `start_density`. None: continue from the last state if there is one, else draw
            ``log_prob_fn.sample_prior(nwalkers, random)``. After annealing, a State of this sampler (or the coordinates
            of its last one) is continued; other coordinates start a new annealing. Points that cannot be such draws,
            as a ball near the posterior, are refused with a ValueError (`samplers.tempering.starts`).
        nsteps : int
            Number of sweeps stored in the chain; 0 for the annealing only.
        **kwargs
            Arguments of `sample`.

        Returns
        -------
        emcee.State
            The last state.
        """
        self._start_is_open, self._runs_to_end = initial_state is None, True
        if initial_state is None and get_previous_state(self) is None:
            initial_state = self._last_or_prior()
        with self._interruptible():
            result = super().run_mcmc(initial_state, nsteps, **kwargs)
            if result is None:
                result = self._annealed_state
                set_previous_state(self, result)
            return result

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
        """Advance the chain as a generator: emcee's ``sample``, preceded by the annealing where it is needed.

        The arguments are those of emcee, with `initial_state` as in `run_mcmc`. With a file, a loop that is repeated
        by the same script gets its stored states once more, without an evaluation, then goes on unless it leaves.
        """
        if iterations is None and store:
            raise ValueError("'store' must be False when 'iterations' is None")
        if int(thin_by if thin is None else thin) <= 0:
            raise ValueError("Invalid thinning argument")
        self._leave_open_loop()
        state = State(self._last_or_prior() if initial_state is None else initial_state, copy=True)
        start_is_open, self._start_is_open = self._start_is_open or initial_state is None, False
        for name, value in (("log_prob", log_prob0), ("random_state", rstate0), ("blobs", blobs0)):
            if value is not None:
                setattr(state, name, value)

        last = get_previous_state(self)
        if state.log_prob is None and last is not None and np.array_equal(state.coords, last.coords):
            state.log_prob, state.blobs = copy.deepcopy((last.log_prob, last.blobs))

        self._evaluator.pool = self.pool
        start_is_open = start_is_open or np.array_equal(state.coords, self._returned)
        request = Request(iterations, state.coords, describe_options(thin_by, thin, tune, store))
        arguments = {"tune": tune, "thin_by": thin_by, "thin": thin, "store": store}
        arguments |= {"progress": progress, "progress_kwargs": progress_kwargs}
        yield from self._run_call(state, request, start_is_open, skip_initial_state_check, arguments)

    def _run_call(
        self, state: State, request: Request, is_open: bool, skip_check: bool, arguments: dict
    ) -> Iterator[State]:
        """Make, repeat or complete a call of `sample`; `is_open`: whether it was given no state."""
        present = self._begin_call(arguments["store"])
        try:
            if self._checkpoint.lost_journal:
                self._compare_last_state()
            present.find(request._replace(coords=None if is_open else request.coords))
            bar = {name: arguments.pop(name) for name in ("progress", "progress_kwargs")}
            if present.call is not None and present.call.complete:
                yield from self._repeat(present, bar)
            else:
                yield from self._advance(present, state, request, is_open, skip_check, arguments, bar)
        except BaseException as error:
            self._end_call(present, error)
            raise
        self._end_call(present)

    def _advance(
        self,
        present: PresentCall,
        state: State,
        request: Request,
        is_open: bool,
        skip_check: bool,
        arguments: dict,
        bar: dict,
    ) -> Iterator[State]:
        """Anneal where it is needed, and make the steps of a call that are not stored."""
        start, call, store, iterations = time.perf_counter(), present.call, arguments["store"], request.steps
        made = 0 if call is None else call.made
        state, is_known = self._first_state(state, call, is_open, skip_check, bar)
        self._annealed_state = state
        if call is not None:  # it was interrupted, or left by the user
            yield from self._repeat_steps(present, state)
            iterations = max(iterations - made * int(arguments["thin"] or 1), 0)
        elif store:
            self._checkpoint.begin_call(request)
        self.seconds += time.perf_counter() - start
        start = time.perf_counter()
        self._evaluator.evaluates_parts = False
        halted, advanced, stored, new = self._result.halt is not None, None, State(state, copy=True), 0
        check = {"skip_initial_state_check": skip_check or is_known}
        steps = () if halted else super().sample(state, iterations=iterations, **check, **arguments, progress=False)
        per_step = 1 if arguments["thin"] else int(arguments["thin_by"])
        sweeps = None if iterations is None else iterations * per_step
        shown = self._evaluator, self._functions.function, (self.nwalkers, self.ndim)
        try:
            for advanced in show_sweeps(steps, bar, sweeps, per_step, *shown):
                new += 1
                set_previous_state(self, State(advanced, copy=True))  # the next call without a state goes on here
                if self._budget.limit is not None:
                    stored = State(advanced, copy=True)
                    self._checkpoint.stepped(stored, store)
                self.seconds += time.perf_counter() - start
                present.complete = store and new == iterations
                yield advanced
                present.check_is_present()
                start = time.perf_counter()
        except BudgetExhausted:
            halted = True
        present.complete = store and not halted
        missing = 0 if iterations is None else iterations - new
        self._judge(missing, (stored if halted or advanced is None else advanced).coords)
        if halted:
            if advanced is not None:  # the move that exceeded the limit may have changed some of its walkers
                for name in State.__slots__:
                    setattr(advanced, name, getattr(stored, name))
            self.random_state = stored.random_state
            self._checkpoint.halt(stored, store and missing > 0 and not self._checkpoint.has_steps)
            warn(describe_halt(self.verdict, self._budget.limit, self._result, made + new, missing))
            if new == 0 and missing > 0:
                yield stored
        elif present.runs_to_end and not store:
            self._checkpoint.pass_call(request, state if advanced is None else advanced)

    def _judge(self, missing: int, coords: np.ndarray) -> None:
        """Store the verdict on an annealing of this object, or keep that of the backend."""
        if self._result.independent_points is not None or self._verdict is None:
            failed = f"{self.failure_count} of {self.evaluations} evaluations" if self.failure_count else ""
            numbers = self.nwalkers, self.ndim, self.simulations
            searched = self._budget.of_guides
            slow = self._budget.slow_columns(self.ndim)
            optional = self._optional
            self._near = self._evaluator.points.near(coords, slow, optional.counts_failures, optional.may_be_positive)
            self._verdict = judge(self._result, self.settings.guided, *numbers, missing, failed, searched, self._near)
            self._checkpoint.store_verdict(self._verdict)

    def compute_log_prob(self, coords):
        """Log-probability and blobs of points (n, ndim), as in emcee; -inf for NaN and outside the prior's support."""
        self._evaluator.pool = self.pool
        return self._evaluator.unpack(self._evaluator.evaluate(coords))

    def _last_or_prior(self):
        """The state to start from when none is given."""
        interrupted = self._checkpoint.interrupted
        if interrupted is not None:
            return State((interrupted.last or interrupted.start).coords, copy=True)
        if get_previous_state(self) is not None:
            return get_previous_state(self)
        if self.backend.iteration > 0:
            return self.get_last_sample()
        self._drawn = self._functions.draw_prior(self.nwalkers, get_random(self))
        return self._drawn

    def _needs_annealing(self, state: State) -> bool:
        """Whether a state consists of draws of the prior; ValueError where that is not known."""
        known = state.log_prob is not None
        if self._result.finished:
            return not known
        if known and self.backend.iteration > 0:
            raise ValueError(
                "the backend contains a chain without a finished ladder, so its states cannot be used as draws of the "
                "prior: give an empty backend, or pass draws of the prior as initial_state"
            )
        return True

    # ------------------------------------------------------------------ annealing

    def _header(self) -> dict:
        """What this run is started with."""
        functions, moves = (self._functions.function, self.coarse_log_prob_fn), self._usual_moves or get_moves(self)
        described = header(self.nwalkers, self.ndim, *functions, self.settings, *moves, self._given_guide)
        return described | self._functions.described()

    def _start(self, state: State, skip_check: bool) -> Population:
        """Draws of the prior, or of the start density, as a population, checked and entered in the journal."""
        check_start(state.coords, self.nwalkers, self.ndim, skip_check)
        self.random_state = state.random_state
        coords = np.asarray(state.coords, dtype=float)
        log_base = self._evaluator.log_base_of_start(coords)
        if not np.array_equal(coords, self._drawn):
            self._functions.check_start(coords, self._evaluator.log_base)
        self._prior_draws = coords if self._functions.start_density is None else None
        if self._checkpoint.wants_start:
            self._checkpoint.begin(self._header() | {SEED: self._seed}, RunStart(coords, log_base, self.random_state))
        records = None
        if state.log_prob is not None:
            records = self._evaluator.pack(state.log_prob, log_base, state.blobs)
        return Population(0.0, coords, records, float(self.nwalkers))

    def _anneal(self, state: State, skip_check: bool, bar: dict) -> State:
        """Carry draws of the prior to beta = 1; the ladder is stored stage by stage."""
        self._result, self._verdict, self._evaluator.evaluates_parts = AnnealingResult(), None, True
        population, coarse = self._start(state, skip_check), self._coarse_evaluator
        if coarse is not None:
            coarse.pool = self.pool
        if self._usual_moves is not None:
            set_moves(self, *self._usual_moves)
        schedule, guidance, self._usual_moves = MoveSchedule(*get_moves(self)), None, None
        if self._given_guide is not None:
            self._guide = AdaptedGuide(self._given_guide, self.ndim)
            lent = get_random(self), self._checkpoint.remember, self._budget, self.settings.asynchronous
            guidance = lend(self._guide, *lent)
        steps = anneal(population, self._evaluator, get_random(self), schedule, self.settings, coarse, guidance)
        unit = " evaluations" if guidance is None else " batches"
        labels = {"desc": ANNEALING, "unit": unit, **(bar["progress_kwargs"] or {})}
        known = None if coarse is not None or self.settings.runs > 1 or guidance is not None else self.settings
        seen = self._evaluator, labels["desc"], self._functions.function, known, (self.nwalkers, self.ndim)
        with (
            get_progress_bar(bar["progress"], None, **labels) as shown,
            closing(self._evaluator),
            Progress(shown, *seen, counts_points=guidance is None) as progress,
        ):
            for result, population, report in record(steps, self._evaluator, self._checkpoint):
                self._result = result
                progress.show(result, population, report)
        if coarse is not None and coarse.failures.count:
            failed = coarse.failures.count, coarse.evaluations, coarse.failures.most_common()
            logger.warning("%d of %d evaluations of the coarse model failed and count as impossible (%s)", *failed)
        self._result = self._result._replace(
            concerns=() if guidance is None else guidance.guide.concerns,
            basis="" if guidance is None else guidance.guide.basis,
            independent_points=independent_points(self._result, population.coords),
        )
        if self._result.start is not None and self._result.start.used:
            moves = with_fast_sweeps([GuideMove(self._guide)], self._fast, self.ndim, self.settings.fast_sweeps)
            calibrate_move(moves[0], population.coords, np.full(self.nwalkers, 1.0 / self.nwalkers))
            set_moves(self, moves, np.ones(1))
            self._usual_moves = schedule
        log_prob, blobs = self._evaluator.unpack(population.records)
        return State(population.coords, log_prob=log_prob, blobs=blobs, random_state=self.random_state)
