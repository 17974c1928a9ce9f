"""Start from a guide: rounds of draws that are evaluated, weighted and used to refine the guide.

The density of a round is fixed before its draws are made, and each draw is weighted by it. The rounds end with a
*reliable* round: fresh draws with a good effective share and Pareto shape; all rounds together must then have an
effective sample size as large as the number of walkers, and reach all of the posterior that the guide knows by then. A
part that a guide never proposes is not seen: guides with a share of the prior can find it, others depend on their
search.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..estimates.control_variates import SignedSample, signed_sample, unreached_share
from ..estimates.importance import (
    PooledRounds,
    Round,
    add_round,
    joined,
    log_mixture,
    pool_rounds,
    tails_are_light,
)
from ..estimates.pareto import FEWEST_OF_TAIL, LARGEST_SHAPE
from ..estimates.weights import normalised_weights
from ..finding import CARE, WRONG, Finding
from ..judgement.rounds import (
    LARGEST_UNREACHED,
    LIGHT_TAILS,
    RELIABLE_SHARE,
    UNSETTLED,
    USABLE_SHARE,
    all_impossible,
    describe_rounds,
    find_unreached_part,
    grown,
    is_even,
    is_reliable,
)
from ..record import Record
from ..reports import GuidedRound, GuideTick, Report
from .guide import Guide, GuideSession, checked_density, checked_draws
from .population import Density, Population

# Draws in a round, as a share of the number of walkers: few, since the guide may still be poor: with 0.6 after the
# first, four runs on 30 stiffnesses take 1659 simulations instead of 1464. After a reliable round, a round has as many
# draws as are expected to suffice, and goes on if fewer than this are missing then.
ROUND_SHARE = 0.3
# Smallest number of draws in a round. The Pareto shape cannot be estimated from fewer than 25.
FEWEST_DRAWS = 5 * FEWEST_OF_TAIL
# Largest number of rounds, and the number after which enough effective draws suffice: the response is rough then.
MOST_ROUNDS, PATIENT_ROUNDS = 40, 16


def lend(guide: Guide, random: np.random.RandomState, remember: Callable, budget: Record) -> GuideSession:
    """The session of a guide, whose simulations count from now on."""
    budget.use(guide)
    return GuideSession(random, remember, partial(budget.fits, remember=remember), lambda: budget.remaining)


class RoundsOfGuide(NamedTuple):
    """Result of `draw_rounds`: all draws `pooled`, `rounds`, the signed sample where its means are better; `reason`
    says why the draws cannot be used, `findings` what they have not reached. `unreached` is the share of the latest
    known density that they hardly reach.
    """

    reason: str
    findings: tuple[Finding, ...]
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


def _evaluated(coords: np.ndarray, density: Density, guide: Guide, session: GuideSession) -> tuple[Round | None, bool]:
    """Draws (n, ndim) of the guide as a round; None without one, and whether the limit of simulations refused some.

    Raises ValueError if the density of the guide is zero at one of its own draws.
    """
    log_density = checked_density(guide, coords)
    if np.any(log_density == -np.inf):
        raise ValueError(
            f"guide.log_density is -inf at {int(np.sum(log_density == -np.inf))} of {len(coords)} draws of the guide: "
            "it must return the logarithm of the density that guide.draw draws from"
        )
    function, known = guide.frozen(), guide.known_density
    observe = () if guide.observe is None else (lambda points: guide.observe(points, session),)
    pending = density.submit(coords, *observe)
    coords, records = pending.arrived_part()
    if len(coords) == 0:
        return None, pending.refused
    log_density = log_density[: len(coords)]
    log_weights = records["log_prob"] - log_density
    log_known = None if known is None else known.log_density(coords) - log_density
    return Round(coords, records, log_weights, known, log_known, function, log_density[:, None]), pending.refused


def draw_rounds(
    population: Population, density: Density, guide: Guide, session: GuideSession
) -> Generator[tuple[Population, Report], None, RoundsOfGuide]:
    """Let the guide search, then draw, evaluate and refine until a fresh round is reliable.

    Yields the `population`, draws of the prior that are not evaluated, with a tick of the progress bar, a round, or a
    function of the guide's search, whose result is sent back.
    """
    budget, random = density.record, session.random
    size, population = len(population.coords), population._replace(effective_sample_size=0.0)
    rounds: list[Round] = []
    pooled = None

    def tick(phase: str) -> tuple[Population, GuideTick]:
        made = guide.simulations if phase == "search" else budget.simulations
        return population, GuideTick(phase, made, size)

    def asked(steps: Generator | None, phase: str) -> Generator[tuple[Population, Any], Any, None]:
        answer, steps = None, (iter(()) if steps is None else steps)
        with suppress(StopIteration):
            while True:
                item = next(steps) if answer is None else steps.send(answer)
                answer = yield (population, item) if callable(item) else tick(phase)

    yield tick("search")
    yield from asked(guide.prepare(session), "search")
    while True:
        yield tick(f"round {len(rounds) + 1}")
        n, latest, refused, outcome, before = max(_sizes(rounds, pooled, size)), None, False, None, rounds
        while n and not refused:  # a reliable round that misses its aim by less than a round goes on
            drawn = checked_draws(guide, n, random, population.coords.shape[1])
            part, refused = _evaluated(drawn, density, guide, session)
            if part is None:
                break
            latest = part if latest is None else joined(latest, part)
            rounds = add_round(before, latest)
            pooled = pool_rounds(rounds)
            few, missing = _sizes(rounds, pooled, size)
            n = missing * (missing < few)
        if latest is not None:
            population = population._replace(effective_sample_size=pooled.effective_sample_size)
            shares = len(latest.coords), latest.effective_share, latest.pareto_shape
            yield population, GuidedRound(*shares, *pooled[3:6])
            yield tick(f"round {len(rounds)}")
            outcome = _outcome(rounds, pooled, size)
        if refused or budget.refused:  # a search that was cut short goes on first, if the limit is raised
            break
        # with the last round as well, a guide whose known density describes the posterior may learn that this is larger
        if outcome is not None and (outcome[0] or guide.known_density is None or not is_reliable(rounds)):
            return _ended(rounds, pooled, *outcome)
        yield from asked(guide.refine(latest.coords, latest.records["log_prob"], session), f"after round {len(rounds)}")
        if outcome is not None:
            unreached = unreached_share(partial(log_mixture, rounds), guide.known_density)
            if max(unreached, grown(pooled, latest.known, guide.known_density)) <= LARGEST_UNREACHED:
                return _ended(rounds, pooled, *outcome, unreached)
            if len(rounds) == MOST_ROUNDS:
                return _ended(rounds, pooled, "", (find_unreached_part(UNSETTLED, WRONG),))
        if budget.refused:
            break
    unreached = 0.0 if pooled is None else unreached_share(partial(log_mixture, rounds), guide.known_density)
    findings = () if unreached <= LARGEST_UNREACHED else (find_unreached_part(UNSETTLED, WRONG),)
    return _ended(rounds, pooled, "", findings, unreached, True)


def _ended(
    rounds: Sequence[Round],
    pooled: PooledRounds | None,
    reason: str,
    findings: tuple[Finding, ...],
    unreached: float = 0.0,
    stopped: bool = False,
) -> RoundsOfGuide:
    """The result, with the signed sample if its means are more accurate than the means of the pooled draws."""
    signed = None if pooled is None else signed_sample(rounds, pooled)
    if signed is not None:
        weights = normalised_weights(pooled.log_weights)
        variance = weights @ np.square(pooled.coords - weights @ pooled.coords)
        relative = np.square(signed.expectation().error) / np.maximum(variance, np.finfo(float).tiny)
        signed = signed if np.mean(relative) < 1.0 / pooled.effective_sample_size else None
    return RoundsOfGuide(reason, findings, pooled, rounds, stopped, signed, unreached)


def _outcome(rounds: Sequence[Round], pooled: PooledRounds, size: int) -> tuple[str, tuple[Finding, ...]] | None:
    """Why the draws cannot be used, empty if they can, and findings, if the rounds end; None if they continue."""
    last, enough = rounds[-1], pooled.effective_sample_size >= size
    if enough and is_reliable(rounds) and is_even(pooled):
        light = tails_are_light([r for r in rounds if r.effective_share >= RELIABLE_SHARE])
        return "", (find_unreached_part(LIGHT_TAILS, CARE),) if light else ()
    if len(rounds) >= 2 and all_impossible(rounds):
        return f"none of their first {len(pooled.coords)} has a finite log-probability", ()
    usable = enough and last.effective_share >= USABLE_SHARE and pooled.pareto_shape < LARGEST_SHAPE
    if len(rounds) < (PATIENT_ROUNDS if usable and is_even(pooled) else MOST_ROUNDS):
        return None
    shortfall = describe_rounds(last, pooled, len(rounds))
    return ("", (find_unreached_part(shortfall, CARE),)) if usable else (shortfall, ())


def _sizes(rounds: Sequence[Round], pooled: PooledRounds | None, size: int) -> tuple[int, int]:
    """Smallest number of draws in the next round, and number that is missing after a reliable one."""
    few = max(FEWEST_DRAWS, int(np.ceil(ROUND_SHARE * size)))
    if not rounds or not is_reliable(rounds):
        # of a guide whose draws are all impossible, perhaps all simulations fail: find out with few more
        return FEWEST_DRAWS if rounds and all_impossible(rounds) else few, 0
    missing = np.ceil((size - pooled.effective_sample_size) / rounds[-1].effective_share)
    return few, int(np.clip(missing, 0, max(size, few)))
