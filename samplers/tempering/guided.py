"""Start from a guide: rounds of draws that are evaluated, weighted and used to refine the guide.

The density of a round is fixed before its draws are made, and each draw is weighted by this density
(`samplers.estimates.importance`). The rounds end with a *reliable* round: fresh draws with a good effective share and
Pareto shape. All rounds together must then have an effective sample size as large as the number of walkers, and their
draws must reach all of the posterior that the guide knows by then.

Draws that are submitted together are a `Batch`; they may arrive in any order. A batch becomes a round when all its
draws have arrived. Until then, its draws influence no weight, no share of a round and no decision: the first arrivals
have short evaluations, and are not a fair sample. They may train a guide with `learns_from_parts`, since the draws of
the next batch are weighted by their own density.

A part of the posterior that a guide never proposes is not seen by its draws. Guides with a share of the prior in their
density can find it; other guides depend on their search (`findings`). Constants without a reference were chosen by
trials on posteriors with known answers.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..budget import Budget
from ..estimates.control_variates import SignedSample, signed_sample
from ..estimates.importance import (
    FIRST_ROUND_SHARE,
    USABLE_SHARE,
    KnownDensity,
    PooledRounds,
    Round,
    add_round,
    log_mixture,
    pool_rounds,
    tails_are_light,
)
from ..estimates.pareto import LARGEST_SHAPE
from ..estimates.weights import normalised_weights
from ..judgement.rounds import (
    LARGEST_UNREACHED,
    LIGHT_TAILS,
    RELIABLE_SHARE,
    UNREACHED,
    UNSETTLED,
    all_impossible,
    describe_rounds,
    grown,
    hardly_reached,
    hopeless,
    is_even,
    is_reliable,
)
from ..reports import GuidedRound, GuideTick, Report
from .early_stop import StoppedEarly
from .guide import AdaptedGuide, GuideSession
from .pending_points import PendingPoints
from .population import Density, Population
from .recycling import most_running

__all__ = [
    "Batch",
    "Guidance",
    "RoundsOfGuide",
    "draw_rounds",
    "lend",
    "stopped_rounds",
]


# Draws in each later round, as a share of the number of walkers. After a reliable round, a round has as many draws as
# are expected to suffice.
ROUND_SHARE = 0.6
# Smallest number of draws in a round. The Pareto shape cannot be estimated from fewer than 25.
FEWEST_DRAWS = 25
# Largest number of rounds, and the number after which enough effective draws suffice: the response is rough then.
MOST_ROUNDS, PATIENT_ROUNDS = 20, 8


class Guidance(NamedTuple):
    """A guide, the session that a sampler provides to it, and the simulations so far with their limit."""

    guide: AdaptedGuide
    session: GuideSession
    budget: Budget


def lend(
    guide: AdaptedGuide, random: np.random.RandomState, remember: Callable, budget: Budget, asynchronous: bool
) -> Guidance:
    """A fresh guide with its session; its simulations count from now on."""
    budget.begin(guide)

    def remember_with_count(key: str, compute: Callable | None = None) -> list[np.ndarray] | None:
        arrays = remember(key)
        if arrays is None and compute is not None:
            arrays = remember(key, compute)
            budget.note()
        return arrays

    session = GuideSession(random, remember_with_count, budget.fits, lambda: budget.remaining, asynchronous)
    return Guidance(guide, session, budget)


class RoundsOfGuide(NamedTuple):
    """Result of `draw_rounds`: all draws `pooled`, their rounds, and the signed sample where its means are better.

    `reason` says why the draws cannot be used. `shortfall` says what was not reached although they can be used.
    `stopped`: the limit of simulations ended the rounds. `unreached` is the share of the guide's latest known density
    that the draws hardly reach, by which the evidence may be too small.
    """

    reason: str
    shortfall: str
    pooled: PooledRounds | None
    rounds: Sequence[Round]
    stopped: bool = False
    signed: SignedSample | None = None
    unreached: float = 0.0

    @property
    def evidence(self) -> tuple[float, float]:
        """Log-evidence and its standard error: the more accurate one of the pooled draws and the signed sample."""
        both = [each for each in (self.pooled, self.signed) if each is not None]
        found = min(both, key=lambda each: each.log_evidence_error)
        return found.log_evidence, float(np.hypot(found.log_evidence_error, self.unreached))


class Batch:
    """Draws of a guide, with the log-density (n,) that they were drawn from, as a function too, and what it knew."""

    def __init__(
        self, pending: PendingPoints, log_density: np.ndarray, function: Callable, known: KnownDensity | None = None
    ):
        self.pending, self._log_density, self._function, self._known = pending, log_density, function, known
        self._learned = np.zeros(len(pending.coords), dtype=bool)
        self._observed = pending.arrived.copy()

    def __len__(self) -> int:
        return len(self.pending.coords)

    @property
    def running(self) -> int:
        """Number of draws that have not arrived."""
        return self.pending.running

    @property
    def possible(self) -> bool:
        """Whether a draw with a finite log-probability has arrived."""
        return bool(np.any(self.pending.arrived_part()[1]["log_prob"] > -np.inf))

    def as_round(self) -> Round:
        """The draws as a round; all must have arrived."""
        coords, records = self.pending.arrived_part()
        log_prob = records["log_prob"]
        alive = log_prob > -np.inf
        log_density = self._log_density[self.pending.arrived]
        log_weights = np.where(alive, np.where(alive, log_prob, 0.0) - log_density, -np.inf)
        known = None if self._known is None else self._known.log_density(coords) - log_density
        return Round(coords, records, log_weights, self._known, known, self._function, log_density[:, None])

    def take_observable(self) -> np.ndarray:
        """Draws (m, ndim) that have arrived since the last call or the submission."""
        new = self.pending.arrived & ~self._observed
        self._observed |= new
        return self.pending.coords[new]

    def take_lesson(self, parts: bool) -> tuple[np.ndarray, np.ndarray]:
        """Draws (m, ndim) for the guide to learn from, and their log-probabilities (m,): each draw is taken once.

        `parts`: whether draws are taken before the whole batch has arrived.
        """
        coords, records = self.pending.arrived_part()
        new = ~self._learned[self.pending.arrived] & (parts or self.pending.complete)
        self._learned[np.flatnonzero(self.pending.arrived)[new]] = True
        return coords[new], records["log_prob"][new]

    @property
    def learned(self) -> bool:
        """Whether the guide has learned from all draws."""
        return bool(self._learned.all())


def submit_batch(coords: np.ndarray, density: Density, guide: AdaptedGuide, session: GuideSession) -> Batch:
    """Begin to evaluate draws (n, ndim) of the guide; a limit of simulations may allow only the first draws.

    Raises ValueError if the density of the guide is zero at one of its own draws.
    """
    log_density = guide.log_density(coords)
    if np.any(log_density == -np.inf):
        raise ValueError(
            f"guide.log_density is -inf at {int(np.sum(log_density == -np.inf))} of {len(coords)} draws of the guide: "
            "it must return the logarithm of the density that guide.draw draws from"
        )
    observe = guide.observe
    if observe is None or session.asynchronous:
        pending = density.submit(coords)
    else:
        pending = density.submit(coords, lambda points: observe(points, session))
    return Batch(pending, log_density[: len(pending.coords)], guide.frozen(), guide.known_density)


def let_arrive(
    batches: Sequence[Batch], most: int, density: Density, guide: AdaptedGuide, session: GuideSession
) -> None:
    """Wait until at most this number of draws in the latest batch is running, and none in earlier batches.

    The guide observes draws as they arrive, a few at a time, so that a killed run has kept nearly all draws.
    """
    while batches:
        running = [batch.running for batch in batches]
        if sum(running[:-1]) == 0 and running[-1] <= most:
            return
        density.wait(max(sum(running) - 1, 0))
        for batch in batches if guide.observe is not None else ():
            arrived = batch.take_observable()
            if len(arrived) > 0:
                guide.observe(arrived, session)


def draw_rounds(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    guidance: Guidance,
) -> Generator[tuple[Population, Report], None, RoundsOfGuide]:
    """Let the guide search, then draw, evaluate and refine until a fresh round is reliable.

    `population` are draws of the prior, as many as there are walkers, which are not evaluated. Yields them with the
    effective sample size of all rounds so far, and a tick of the progress bar, a round, or a function of the guide's
    search, whose result is sent back.
    """
    guide, session, budget = guidance
    session = session._replace(weighted=lambda: None if pooled is None else (pooled.coords, pooled.log_weights))
    size, population = len(population.coords), population._replace(effective_sample_size=0.0)
    rounds: list[Round] = []
    batches: list[Batch] = []  # of which draws are running
    lessons: list[Batch] = []  # of which the guide has not learned from all draws
    refused, pooled = False, None

    def tick(phase: str, finished: bool) -> tuple[Population, GuideTick]:
        return population, GuideTick(phase, budget.simulations, size, finished)

    def asked(steps: Generator, phase: str) -> Generator[tuple[Population, Any], Any, None]:
        answer = None
        with suppress(StopIteration):
            while True:
                item = steps.send(answer)
                answer = yield (population, item) if callable(item) else tick(phase, True)

    def judge(most: int) -> Generator[tuple[Population, Report], None, RoundsOfGuide | None]:
        """Let draws arrive; returns how the rounds end, or None if another round follows."""
        nonlocal population, pooled, rounds
        while True:
            let_arrive(batches, most, density, guide, session)
            outcome = None
            while batches and batches[0].pending.complete:
                rounds = add_round(rounds, batches.pop(0).as_round())
                pooled = pool_rounds(rounds)
                population = population._replace(effective_sample_size=pooled.effective_sample_size)
                yield population, _report(rounds[-1], pooled)
                yield tick(f"round {len(rounds)}", True)
                outcome = _outcome(rounds, pooled, size)
            if refused or budget.refused:  # a search that was cut short goes on first, if the limit is raised
                unreached = hardly_reached(partial(log_mixture, rounds), guide.known_density) if rounds else 0.0
                shortfall = "" if unreached <= LARGEST_UNREACHED else UNREACHED
                outcome = RoundsOfGuide("", shortfall, pooled, rounds, True, None, unreached)
            if not batches or (outcome is None and _too_few(rounds, batches, size, guide)):
                return outcome and _with_signed(outcome)
            most = 0  # submitted draws are part of the result

    yield tick("search", False)
    yield from asked(guide.prepare(session), "search")
    while True:
        yield tick(f"round {len(rounds) + len(batches) + 1}", False)
        coords = guide.draw(_next_size(rounds, batches, size), random)
        batch = submit_batch(coords, density, guide, session)
        refused = batch.pending.refused
        if len(batch) > 0:
            batches.append(batch)
            lessons.append(batch)
        outcome = yield from judge(0 if refused or budget.refused else most_running(density, len(coords)))
        # with the last round as well, a guide with a known density may learn that the posterior is larger
        final = outcome is not None and (outcome.stopped or outcome.reason or guide.known_density is None)
        if final:
            return outcome
        parts = [each.take_lesson(guide.learns_from_parts) for each in lessons]
        lessons = [each for each in lessons if not each.learned]
        points, log_prob = (np.concatenate(column) for column in zip(*parts, strict=True))
        if len(points) > 0:
            yield from asked(guide.refine(points, log_prob, session), f"after round {len(rounds)}")
        if outcome is not None:
            outcome = _with_signed(outcome)
            unreached = hardly_reached(partial(log_mixture, rounds), guide.known_density)
            if max(unreached, grown(outcome.pooled, rounds[-1].known, guide.known_density)) <= LARGEST_UNREACHED:
                return outcome._replace(unreached=unreached)
            if len(rounds) == MOST_ROUNDS:
                return outcome._replace(shortfall=UNSETTLED)
        if budget.refused:
            return (yield from judge(0))


def _with_signed(outcome: RoundsOfGuide) -> RoundsOfGuide:
    """With the signed sample of all rounds, if its means are more accurate than those of the pooled draws."""
    found, pooled = signed_sample(outcome.rounds, outcome.pooled), outcome.pooled
    if found is not None:
        weights = normalised_weights(pooled.log_weights)
        variance = weights @ np.square(pooled.coords - weights @ pooled.coords)
        relative = np.square(found.expectation().error) / np.maximum(variance, np.finfo(float).tiny)
        found = found if np.mean(relative) < 1.0 / pooled.effective_sample_size else None
    return outcome._replace(signed=found)


def _report(last: Round, pooled: PooledRounds) -> GuidedRound:
    """The report of a round, with all rounds before it."""
    return GuidedRound(
        len(last.coords),
        last.effective_share,
        last.pareto_shape,
        pooled.log_evidence,
        pooled.log_evidence_error,
        pooled.effective_sample_size,
    )


def _outcome(rounds: Sequence[Round], pooled: PooledRounds, size: int) -> RoundsOfGuide | None:
    """How the rounds end; None if they continue."""
    last, enough = rounds[-1], pooled.effective_sample_size >= size
    if enough and is_reliable(rounds) and is_even(pooled):
        light = tails_are_light([r for r in rounds if r.effective_share >= RELIABLE_SHARE])
        return RoundsOfGuide("", LIGHT_TAILS if light else "", pooled, rounds)
    if reason := hopeless(rounds):
        return RoundsOfGuide(reason, "", pooled, rounds)
    usable = enough and last.effective_share >= USABLE_SHARE and pooled.pareto_shape < LARGEST_SHAPE
    if len(rounds) < (PATIENT_ROUNDS if usable and is_even(pooled) else MOST_ROUNDS):
        return None
    shortfall = describe_rounds(last, pooled, len(rounds))
    return RoundsOfGuide("" if usable else shortfall, shortfall, pooled, rounds)


def _too_few(rounds: Sequence[Round], batches: Sequence[Batch], size: int, guide: AdaptedGuide) -> bool:
    """Whether more draws are made while some are running, since the running draws will not be enough.

    A guide that learns only from complete rounds would draw from the same density again.
    """
    if len(rounds) + len(batches) >= MOST_ROUNDS:
        return False
    if rounds and is_reliable(rounds):
        return _missing(rounds, batches, size) > 0.0
    return guide.learns_from_parts and (not all_impossible(rounds) or any(batch.possible for batch in batches))


def _missing(rounds: Sequence[Round], batches: Sequence[Batch], size: int) -> float:
    """Missing effective draws, if the running draws have the effective share of the last round."""
    expected = rounds[-1].effective_share * sum(len(batch) for batch in batches)
    return size - pool_rounds(rounds).effective_sample_size - expected


def _next_size(rounds: Sequence[Round], batches: Sequence[Batch], size: int) -> int:
    """Number of draws in the next batch; only the number of draws in the running `batches` matters."""
    first = max(FEWEST_DRAWS, int(np.ceil(FIRST_ROUND_SHARE * size)))
    if not rounds and not batches:
        return first
    if rounds and all_impossible(rounds):  # perhaps all simulations fail: find out with few more
        return FEWEST_DRAWS
    if rounds and is_reliable(rounds):
        missing = _missing(rounds, batches, size)
        return int(np.clip(np.ceil(missing / rounds[-1].effective_share), first, max(size, first)))
    return max(FEWEST_DRAWS, int(np.ceil(ROUND_SHARE * size)))


def stopped_rounds(found: RoundsOfGuide) -> StoppedEarly:
    """All rounds of a guide that end without usable draws or at the limit, as points to make a population from."""
    if found.pooled is None:
        nothing = Population(1.0, np.empty((0, 0)), np.empty(0), 0.0, (), np.empty(0))
        return StoppedEarly(nothing, float("-inf"), float("inf"), 1.0, from_guide=True)
    pooled = found.pooled
    known = Population(1.0, pooled.coords, pooled.records, pooled.effective_sample_size, (), pooled.log_weights)
    return StoppedEarly(known, *found.evidence, 1.0, from_guide=True)
