"""An emcee sampler that climbs from the prior to the posterior before it samples.

`TemperedSampler` is an `emcee.EnsembleSampler` whose ``sample`` first carries a population of draws of the prior up the
tempering ladder (see `samplers.tempering.weights`): choose the next beta, weigh, resample, move. Then emcee's own loop goes on at
beta = 1, so that the chain holds states of the posterior only, and everything emcee does with a chain works unchanged.

Each walker carries (log_prob, log_prior, blobs) as the blobs of an emcee State, whose log_prob is the tempered density:
any emcee move can work below beta = 1, and a change of beta costs no evaluation.

emcee's private names are touched in this module only.
"""

import copy
import functools
import logging
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from emcee import EnsembleSampler, State
from emcee.backends import HDFBackend
from emcee.ensemble import ndarray_to_list_of_dicts, walkers_independent
from emcee.pbar import get_progress_bar

from .moves.fast_parameters import with_fast_sweeps
from .moves.kernels import RandomWalkMove
from .storage.backends import JournaledBackend, read_check, read_ladder, write_check, write_stage
from .storage.compatibility import differences, header
from .storage.evaluation import ErrorCapturing, Failures, Memo, Records, log_probabilities, outcomes
from .storage.journal import Evaluated, Start
from .tempering.anneal import Tempering, climb
from .tempering.diagnostics import check_evidence, warn
from .tempering.evidence_check import EvidenceCheck
from .tempering.genealogy import standard_error_of_mean
from .tempering.settings import Settings
from .tempering.weights import Stage

__all__ = ["TemperedSampler"]

logger = logging.getLogger(__name__)


class TemperedSampler(EnsembleSampler):
    """emcee's ensemble sampler with a ladder from the prior to the posterior.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names :
        as in `emcee.EnsembleSampler`, in its order. `moves` are the mutation kernels, copied; by default a random walk.
        Where `log_prob_fn` has ``fast_parameters``, each is followed by ``settings.fast_sweeps`` (but not with a `pool`
        and without `vectorize`: workers forget what they simulated, so nothing is free there).
        A point for which `log_prob_fn` raises an exception or returns NaN counts as -inf and is recorded (`failures`);
        it is not called outside the support of the prior. With an emcee `HDFBackend` a journal is kept beside the file,
        and a run that was killed goes on from it (`run_mcmc`).
    coarse_log_prob_fn : callable, optional
        A cheaper version of `log_prob_fn` to climb on first, called in the same way (`samplers.tempering.multilevel`); a posterior
        may carry one as ``posterior.coarse``. Chain and evidence are those of `log_prob_fn` whatever it is. Its blobs
        are not kept; where it fails it counts as -inf. A run that goes on from its journal asks it again. It needs
        ``settings.recycle``.
    log_prior_fn : callable, optional
        Log density of the normalised prior, of the same kind of argument as `log_prob_fn` (a point; a batch with
        `vectorize`; a dict with `parameter_names`) but without `args` and `kwargs`. By default
        ``log_prob_fn.log_prior``. Always called in this process.
    seed : int or array of int, optional
        Seed of the run. By default one drawn from NumPy's global generator, so that ``np.random.seed`` governs and two
        samplers never share a stream. A backend with a chain brings its own random state, which goes before.
    settings : Settings

    Attributes
    ----------
    seconds : float — wall time spent by this object in finished climbs and sweeps [s].

    Raises
    ------
    ValueError
        For settings that cannot work, fewer than 2 ndim walkers, no log-prior, or a coarse model without recycling.
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
        coarse_log_prob_fn: Callable | None = None,
        seed: int | None = None,
        settings: Settings = Settings(),
    ):
        if not callable(log_prob_fn):
            raise ValueError(f"log_prob_fn must be callable; got {log_prob_fn!r}")
        if log_prior_fn is None:
            log_prior_fn = getattr(log_prob_fn, "log_prior", None)
        if not callable(log_prior_fn):
            raise ValueError(
                "tempering starts at the prior: pass log_prior_fn, or a log_prob_fn with a method log_prior"
                f" (a posterior object itself, not its bound method); got {log_prior_fn!r}"
            )
        if ndim < 1 or nwalkers < 2 * ndim:
            raise ValueError(
                f"a population must span the parameters: at least 2 ndim walkers and one parameter are needed, some "
                f"hundreds are usual; got nwalkers={nwalkers} for ndim={ndim}"
            )
        if settings.ess_floor >= nwalkers:
            raise ValueError(f"ess_floor={settings.ess_floor} must be below nwalkers={nwalkers}")
        if coarse_log_prob_fn is not None and not (callable(coarse_log_prob_fn) and settings.recycle):
            raise ValueError(
                "coarse_log_prob_fn must be callable, and the climb one by recycling (the default with 250 walkers or "
                f"more and no moves of your own); got {coarse_log_prob_fn!r} with recycle={settings.recycle}"
            )

        self.log_prior_fn = log_prior_fn
        self.coarse_log_prob_fn = coarse_log_prob_fn
        self.settings = settings
        if type(backend) is HDFBackend and not backend.read_only:
            backend = JournaledBackend.of(backend)
        self._contents = backend.contents if isinstance(backend, JournaledBackend) else None
        self._memo: Memo | None = None
        self._recorded: list[Stage] = []
        self._evaluations = 0
        self._failures = Failures()
        self._records = Records()
        self._coarse_failures = Failures()
        self._coarse_evaluations = 0
        self._ladder: list[Stage] = []
        self._check: EvidenceCheck | None = None
        self._generations: list[np.ndarray] = []
        self.seconds = 0.0
        self._previous_state = None
        self._summit = None
        super().__init__(
            nwalkers,
            ndim,
            log_prob_fn,
            pool=pool,
            moves=copy.deepcopy(RandomWalkMove() if moves is None else moves),
            args=args,
            kwargs=kwargs,
            backend=backend,
            vectorize=vectorize,
            blobs_dtype=blobs_dtype,
            parameter_names=parameter_names,
        )
        if pool is None or vectorize:
            free = getattr(log_prob_fn, "fast_parameters", ())
            self._moves = with_fast_sweeps(self._moves, free, ndim, settings.fast_sweeps)
        self._ladder = list(read_ladder(self.backend))
        self._check = read_check(self.backend)
        if self.backend.random_state is None:
            self._random.seed(np.random.randint(2**32, size=8, dtype=np.uint32) if seed is None else seed)  # noqa: NPY002

    def __getstate__(self):
        # emcee drops the pool of the living sampler here; drop it from the copy only
        return {**self.__dict__, "pool": None}

    # ------------------------------------------------------------------ results

    @property
    def evaluations(self) -> int:
        """Points handed to `log_prob_fn` by this object, and by the killed run that it goes on with.

        Those of fast sweeps are among them.
        """
        return self._evaluations

    @property
    def coarse_evaluations(self) -> int:
        """Points handed to `coarse_log_prob_fn` by this object."""
        return self._coarse_evaluations

    @property
    def failure_count(self) -> int:
        """How many of them failed, by an exception or by NaN, and counted as -inf."""
        return self._failures.count

    @property
    def failures(self) -> list[dict]:
        """``{"parameters": array (ndim,), "reason": str}`` of the first thousand failures."""
        return list(self._failures.kept)

    @property
    def ladder(self) -> tuple[Stage, ...]:
        """Stages of the last climb, in order; empty before it."""
        return tuple(self._ladder)

    @property
    def log_evidence(self) -> float:
        """Log of the evidence: of `log_evidence_ladder` and `log_evidence_check` the one of the smaller error."""
        return self._evidence()[0]

    @property
    def log_evidence_error(self) -> float:
        """Standard error of `log_evidence`, from this run alone.

        At least half the difference of the two estimates if they differ by more than three times their joint error.
        """
        return self._evidence()[1]

    @property
    def log_evidence_ladder(self) -> float:
        """Log of the evidence by the ladder: the sum of its increments."""
        return float(sum(stage.log_evidence_increment for stage in self._finished_ladder()))

    @property
    def log_evidence_check(self) -> EvidenceCheck | None:
        """The evidence by importance sampling after the climb; None without (``check_draws=0``)."""
        self._finished_ladder()
        return self._check

    def mean_error(self, discard: int = 0, thin: int = 1) -> np.ndarray:
        """Monte-Carlo standard errors (ndim,) of the means of ``get_chain(discard, thin)``, from this run alone.

        Copies made by the latest resamplings and the correlation along the chain are taken into account (see
        `samplers.tempering.genealogy`). A chain that goes on in another sampler without its journal has lost the record of its
        resampling: each walker then counts as independent of the others. Of moves that tie walkers together, such as
        emcee's stretch move, the ties are not seen. Nor can one run tell of a mode it lost, or of a climb whose moves
        did not move: after a `SamplingWarning` the errors are too small.
        """
        families = self._generations[0] if self._generations else np.arange(self.nwalkers)
        return standard_error_of_mean(self.get_chain(discard=discard, thin=thin), families)

    def _evidence(self) -> tuple[float, float]:
        value, error = self.log_evidence_ladder, self._ladder[-1].log_evidence_error
        check = self._check
        if check is None or not check.reliable:
            return value, error
        difference, joint = abs(value - check.log_evidence), np.hypot(error, check.error)
        if check.error < error:
            value, error = check.log_evidence, check.error
        return value, max(error, 0.5 * difference) if difference > 3.0 * joint else error

    def _finished_ladder(self) -> list[Stage]:
        if not self._on_top():
            reached = f"the ladder ends at beta = {self._ladder[-1].beta:.3g}" if self._ladder else "there is no ladder"
            raise ValueError(f"the evidence is known at beta = 1 and {reached}: call run_mcmc first")
        return self._ladder

    def _on_top(self) -> bool:
        return bool(self._ladder) and self._ladder[-1].beta == 1.0

    def reset(self):
        """Clear the chain, as in emcee. The ladder and the place at beta = 1 are kept: burn in, reset, go on."""
        super().reset()
        for index, stage in enumerate(self._ladder):
            write_stage(self.backend, index, stage)
        if self._check is not None:
            write_check(self.backend, self._check)

    # ------------------------------------------------------------------ running

    def run_mcmc(self, initial_state, nsteps, **kwargs):
        """Climb the ladder if that has not been done, then make `nsteps` sweeps at beta = 1.

        With an emcee `HDFBackend`, a new sampler on the file of a run that was killed goes on where it was, inside a
        stage or a sweep too, and ends bit for bit as it would have: pass None or the draws of the prior it began with.
        A call that was cut off is completed by the same call; any other number of steps is added to what is there.

        Parameters
        ----------
        initial_state : (nwalkers, ndim) draws of the prior, or None: go on from the last state if there is one, else
            draw ``log_prob_fn.sample_prior(nwalkers, random)``. After a climb, a State of this sampler (or the
            coordinates of its last one) goes on from there; any other coordinates start a new climb.
        nsteps : int — sweeps stored in the chain; 0 climbs only.
        **kwargs : of `sample`.

        Returns
        -------
        emcee.State — the last one.
        """
        if initial_state is None and self._previous_state is None:
            initial_state = self._last_or_prior()
        result = super().run_mcmc(initial_state, nsteps, **kwargs)
        if result is None:
            result = self._previous_state = self._summit
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
        """Advance the chain as a generator: emcee's ``sample``, preceded by the climb where one is due.

        The arguments are emcee's; `initial_state` is understood as in `run_mcmc`.
        """
        if iterations is None and store:
            raise ValueError("'store' must be False when 'iterations' is None")
        if int(thin_by if thin is None else thin) <= 0:
            raise ValueError("Invalid thinning argument")
        state = State(self._last_or_prior() if initial_state is None else initial_state, copy=True)
        for name, value in (("log_prob", log_prob0), ("random_state", rstate0), ("blobs", blobs0)):
            if value is not None:
                setattr(state, name, value)

        last = self._previous_state
        if state.log_prob is None and last is not None and np.array_equal(state.coords, last.coords):
            state.log_prob, state.blobs = copy.deepcopy((last.log_prob, last.blobs))

        failure_count, ended, made, start = self.failure_count, False, 0, time.perf_counter()
        bar = {"progress": progress, "progress_kwargs": progress_kwargs}
        try:
            if self._contents is not None:
                state, made = self._go_on(state, iterations, bar)
                iterations = None if iterations is None else iterations - made
                skip_initial_state_check = True
            elif self._climb_is_due(state):
                state = self._climb(state, skip_initial_state_check, bar)
                skip_initial_state_check = True
            self._summit = state
            if isinstance(self.backend, JournaledBackend) and store and not made:
                self.backend.call(iterations)
            self.seconds += time.perf_counter() - start
            start = time.perf_counter()
            for advanced in super().sample(
                state,
                iterations=iterations,
                tune=tune,
                skip_initial_state_check=skip_initial_state_check,
                thin_by=thin_by,
                thin=thin,
                store=store,
                **bar,
            ):
                self.seconds += time.perf_counter() - start
                yield advanced
                start = time.perf_counter()
            ended = True
        except GeneratorExit:  # whoever takes the states wants no more
            ended = True
            raise
        finally:
            # what was taken up serves this call only: a later climb is a new one, and no point is looked up any more
            self._memo, self._recorded = None, []
            if isinstance(self.backend, JournaledBackend):
                self.backend.flush()
                if ended and store:
                    self.backend.done()
            if self.failure_count > failure_count:
                warn(
                    f"{self.failure_count - failure_count} evaluations failed and count as impossible "
                    f"({self._failures.told()}); see failures"
                )

    def _go_on(self, state: State, iterations: int | None, bar: dict) -> tuple[State, int]:
        """Take up the run of the journal: climb from its start again, at no evaluation, and go to its last step.

        Returns
        -------
        state, and how many of the iterations wanted now it has made already.
        """
        contents = self._contents
        start, last = contents.start, contents.last
        if not any(np.array_equal(state.coords, known.coords) for known in (start, last) if known is not None):
            raise ValueError(
                f"{self.backend.filename} holds a run from other draws of the prior: pass None as initial_state to go "
                "on with it, or give another file; backend.reset(nwalkers, ndim) gives it up"
            )
        if differing := differences(self._header(), contents, self._log_prior, self._ask):
            raise ValueError(
                f"{self.backend.filename} holds another run, which cannot be continued here: {'; '.join(differing)}. "
                "Give what it was begun with, or another file"
            )
        self._contents = None
        self.backend.go_on(contents)
        self._memo = Memo(contents.evaluated)
        self._recorded = list(read_ladder(self.backend))
        self.random_state = start.random_state
        state = self._climb(State(start.coords, copy=True), True, bar)
        if last is not None:
            state = State(last.coords, log_prob=last.log_prob, blobs=last.blobs, random_state=last.random_state)
            self.random_state = last.random_state
            self._evaluations, self._failures = 0, Failures()
            for batch in contents.evaluated[: contents.before_last]:
                self._count(batch)
        asked_again = iterations is not None and iterations == contents.wanted
        return state, contents.made if asked_again else 0

    def _header(self) -> dict:
        """What this run is begun with."""
        fingerprint = getattr(self.log_prob_fn.f, "fingerprint", None)
        begun = header(self.nwalkers, self.ndim, fingerprint, self.settings, self._moves, self._weights)
        coarse = self.coarse_log_prob_fn
        name = None if coarse is None else getattr(coarse, "fingerprint", "one without a fingerprint")
        return begun | {"coarse_log_prob_fn": name}

    def _last_or_prior(self):
        """The state to start from when none is given."""
        if self._contents is not None:
            return State((self._contents.last or self._contents.start).coords, copy=True)
        if self._previous_state is not None:
            return self._previous_state
        if self.backend.iteration > 0:
            return self.get_last_sample()
        draw = getattr(self.log_prob_fn.f, "sample_prior", None)
        if draw is None:
            raise ValueError(
                "initial_state is None and log_prob_fn has no method sample_prior(n, random): "
                f"pass {self.nwalkers} draws of the prior"
            )
        return np.asarray(draw(self.nwalkers, self._random), dtype=float)

    def _climb_is_due(self, state: State) -> bool:
        """Whether a state is one of the prior; an error where that cannot be told."""
        known = state.log_prob is not None
        if self._on_top():
            return not known
        if known and self.backend.iteration > 0:
            raise ValueError(
                "the backend holds a chain without a finished ladder, so its states cannot be taken as draws of the "
                "prior: give an empty backend, or pass draws of the prior as initial_state"
            )
        return True

    # ------------------------------------------------------------------ evaluating

    def compute_log_prob(self, coords):
        """Log-probability and blobs of points (n, ndim), as in emcee; -inf for NaN and outside the prior's support."""
        return self._records.unpack(self._evaluate(coords))

    def _evaluate(self, coords: np.ndarray) -> np.ndarray:
        """Records (log_prob, log_prior[, blobs]) of points (n, ndim)."""
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_prior = self._log_prior(coords)
        inside = log_prior > -np.inf
        return self._records.evaluated(log_prior, inside, self._outcome(coords[inside]) if inside.any() else None)

    def _evaluate_coarse(self, coords: np.ndarray) -> np.ndarray:
        """Records (log_prob, log_prior) of points (n, ndim) under the coarse model; those that fail are impossible."""
        log_prior = self._log_prior(coords)
        inside = log_prior > -np.inf
        log_prob = np.full(len(coords), -np.inf)
        if inside.any():
            batch = self._ask(coords[inside], self.coarse_log_prob_fn)
            log_prob[inside] = batch.log_prob
            self._coarse_evaluations += len(batch.coords)
            self._coarse_failures.add(batch.coords, batch.reasons)
        return Records().pack(log_prob, log_prior)

    def _outcome(self, coords: np.ndarray) -> Evaluated:
        """What `log_prob_fn` gives for points (n, ndim): recalled from a killed run, or asked for and entered."""
        batch = None if self._memo is None else self._memo.recall(coords)
        if batch is None:
            batch = self._ask(coords)
            self._stop_if_too_many_fail(batch)
            if isinstance(self.backend, JournaledBackend):
                self.backend.evaluated(batch)
        self._count(batch)
        return batch

    def _count(self, batch: Evaluated) -> None:
        self._evaluations += len(batch.coords)
        self._failures.add(batch.coords, batch.reasons)

    def _ask(self, coords: np.ndarray, function: Callable | None = None) -> Evaluated:
        """Call `log_prob_fn`, or another function with its arguments, for points (n, ndim)."""
        fine = self.log_prob_fn
        guarded = ErrorCapturing(fine.f if function is None else function, fine.args, fine.kwargs)
        results = self._call(guarded.of_batch if self.vectorize else guarded, coords, self.pool)
        return Evaluated(coords, *outcomes(results, len(coords), self.blobs_dtype))

    def _stop_if_too_many_fail(self, batch: Evaluated) -> None:
        """RuntimeError if all points of a batch failed, or too large a share so far; such a batch is not stored."""
        n, most = len(batch.coords), self.settings.max_failure_share
        total, count = self._evaluations + n, self.failure_count + len(batch.reasons)
        broken = len(batch.reasons) == n >= self.ndim + 2
        if broken or (total >= self.nwalkers and count > most * total):
            share = f"all {n} evaluations of a batch" if broken else f"{count} of {total} evaluations"
            raise RuntimeError(
                f"{share} failed, where max_failure_share={most:g} of the run is allowed: "
                f"{batch.reasons[min(batch.reasons)]} at {batch.coords[min(batch.reasons)]}. What was evaluated before "
                "is kept (see failures), and a run with a backend in a file goes on from there once the cause is cured"
            )

    def _log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Log-prior of points (n, ndim); -inf for NaN."""
        log_prior, _ = log_probabilities(self._call(self.log_prior_fn, coords, None), len(coords), "log_prior_fn")
        return np.where(np.isnan(log_prior), -np.inf, log_prior)

    def _inside(self, coords: np.ndarray) -> np.ndarray:
        """Which of the points (n, ndim) lie in the support of the prior."""
        return self._log_prior(coords) > -np.inf

    def _call(self, function: Callable, coords: np.ndarray, pool: Any):
        """emcee's way to call a function of points: batch, pool or map; dictionaries for named parameters."""
        points = ndarray_to_list_of_dicts(coords, self.parameter_names) if self.params_are_named else coords
        if self.vectorize:
            return function(points)
        return list((map if pool is None else pool.map)(function, points))

    # ------------------------------------------------------------------ climbing

    def _climb(self, state: State, skip_check: bool, bar: dict) -> State:
        """Carry draws of the prior to beta = 1; the ladder is stored stage by stage."""
        self._mark = time.perf_counter(), self.evaluations
        self._check, self._ladder, self._generations = None, [], []
        records = self._enter(state, skip_check)
        labels = {"desc": "ladder", "unit": " sweeps", **(bar["progress_kwargs"] or {})}
        with get_progress_bar(bar["progress"], None, **labels) as shown:
            found = climb(
                state.coords,
                records,
                Tempering(
                    evaluate=self._evaluate,
                    evaluate_coarse=None if self.coarse_log_prob_fn is None else self._evaluate_coarse,
                    inside=self._inside,
                    random=self._random,
                    moves=self._moves,
                    shares=self._weights,
                    settings=self.settings,
                    map=map if self.pool is None else self.pool.map,
                    ladder=self._ladder,
                    enter=self._add_stage,
                    show=functools.partial(self._show, shown),
                ),
            )
        if self._coarse_failures.count:
            logger.warning(
                "%d of %d evaluations of the coarse model failed and count as impossible (%s)",
                self._coarse_failures.count,
                self._coarse_evaluations,
                self._coarse_failures.told(),
            )
        self._generations, self._check = found.generations, found.check
        if self._check is not None:
            write_check(self.backend, self._check)
            check_evidence(self.log_evidence_ladder, self._ladder[-1].log_evidence_error, self._check)
        log_prob, blobs = self._records.unpack(found.records)
        return State(found.coords, log_prob=log_prob, blobs=blobs, random_state=self.random_state)

    def _add_stage(self, apart: int = 0, **fields: float) -> None:
        """Enter a finished stage, and store it: it cost what was spent since the one before, but for those `apart`."""
        seconds, evaluations = self._mark
        self._mark = time.perf_counter(), self.evaluations
        stage = Stage(seconds=self._mark[0] - seconds, evaluations=self._mark[1] - evaluations - apart, **fields)
        if len(self._ladder) < len(self._recorded):
            recorded = self._recorded[len(self._ladder)]
            if recorded == stage._replace(seconds=recorded.seconds):  # climbed before: what it took then
                stage = recorded
        self._ladder.append(stage)
        write_stage(self.backend, len(self._ladder) - 1, stage)

    def _enter(self, state: State, skip_check: bool) -> np.ndarray | None:
        """Check draws of the prior and evaluate them: records of all walkers; None where a coarse model comes first."""
        if state.coords.shape != (self.nwalkers, self.ndim):
            raise ValueError(
                f"incompatible input dimensions: initial_state must be ({self.nwalkers}, {self.ndim}) draws of the "
                f"prior; got {state.coords.shape}"
            )
        if not skip_check and not walkers_independent(state.coords):
            raise ValueError(
                "Initial state has a large condition number: the walkers must be finite and linearly independent, as "
                "draws of the prior are"
            )
        self.random_state = state.random_state
        state.coords = np.asarray(state.coords, dtype=float)
        log_prior = self._log_prior(state.coords)
        outside = np.flatnonzero(log_prior == -np.inf)
        if len(outside) > 0:
            raise ValueError(
                f"{len(outside)} of {self.nwalkers} initial points lie outside the prior's support (log_prior -inf or "
                f"NaN), the first of them {state.coords[outside[0]]}: pass draws of the prior"
            )
        if isinstance(self.backend, JournaledBackend) and self._memo is None:
            self.backend.begin(self._header(), Start(state.coords, log_prior, self.random_state))
        if state.log_prob is None:
            return None if self.coarse_log_prob_fn is not None else self._evaluate(state.coords)
        log_prob, _ = log_probabilities(np.asarray(state.log_prob), self.nwalkers, "the initial state's log_prob")
        return self._records.pack(log_prob, log_prior, state.blobs)

    def _show(self, bar: Any, beta: float, ess: float, acceptance: float) -> None:
        """One sweep further on the progress bar."""
        if hasattr(bar, "set_postfix"):  # emcee's silent bar has only update
            figures = {"beta": f"{beta:.3g}", "ESS": f"{ess:.0f}", "acceptance": f"{acceptance:.2f}"}
            figures["evaluations"] = str(self.evaluations)
            if hasattr(self.log_prob_fn.f, "report"):
                simulations = self.log_prob_fn.f.report().get("simulations")
                if simulations is not None:
                    figures["simulations"] = str(simulations)
            bar.set_postfix(figures, refresh=False)
        bar.update(1)
