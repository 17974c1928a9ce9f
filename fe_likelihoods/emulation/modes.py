"""Modes of a posterior, by ascents from several starts on growing parts of the record.

A model is first fitted to the start of its record, from all starts, and then to longer parts, from the distinct ends so
far (`fe_likelihoods.emulation.levenberg_marquardt`). The misfit of short parts is smoother, because errors in a period
have had less time to add up to a phase. There the prior is centred on each start, so that starts keep their differences
in parameters without effect on the early part. A model with ``first(seconds)`` simulates these parts alone, and the
record is said to grow; of another one, all parts use the same simulations of the whole record.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import ndtri

from samplers.judgement.guides import DOUBTED_SHARE, HIGHER
from samplers.tempering.guide import GuideSession

from ..text_tables import text_table
from .levenberg_marquardt import FIRST_DIFFERENCE, TOLERANCE, Ascent, Climb, axes_of
from .target import ResponseTarget, Runs, Steps, at_once, nothing_stored

LOOSEST = 5.0  # largest gain that may be left on a short part of the record, or at the top of a rough likelihood
_FLATTEST = 0.2  # smallest curvature of the Laplace approximation: five times the variance of the prior
_STEP = 1e-4  # of the derivatives of parameters by coordinates
# Shares of the Arias intensity at which the parts of the record end. On whole records alone, two runs on the isolated
# bridge took 308 and 306 simulations instead of 153 and 152.
_SHARES = 0.03, 0.1, 0.3, 0.6


class Mode(NamedTuple):
    """A mode of the posterior, in standard normal coordinates, with its Laplace approximation."""

    parameters: np.ndarray  #: (ndim,) all parameters at the mode of the density in standard normal coordinates
    parameter_covariance: np.ndarray  #: (ndim, ndim) Laplace approximation of their covariance
    coords: np.ndarray  #: (ndim,) the mode in standard normal coordinates
    covariance: np.ndarray  #: (ndim, ndim) covariance of the coordinates in the Laplace approximation
    log_density: float  #: log-density of the coordinates at the mode, without the evidence's normalisation
    log_evidence: float  #: evidence of the mode in the Laplace approximation, which can be wrong by several units
    converged: bool  #: False if the ascent stopped before the top


class ModeSearch(NamedTuple):
    """Result of a search for modes; printed as a table."""

    modes: tuple[Mode, ...]  #: distinct modes, the one with the largest evidence first
    #: mode in which each start ended, -1 where it ended in none (a start that failed, or a mode of no weight)
    ends: tuple[int, ...]
    #: simulations run, parts of a record counted as fractions; a call of the model's ``jacobian`` counts as one
    simulations: float
    finished: bool  #: False if `max_simulations` ended the search
    #: whether it simulated short parts of the record alone, where most starts are given up, in right runs as well
    grown: bool = False
    parameter_names: tuple[str, ...] = ()  #: names of all parameters

    def __str__(self) -> str:
        rows = [["parameter", *(f"mode {k + 1}" for k in range(len(self.modes)))]]
        for k, name in enumerate(self.parameter_names):
            ends = ((mode.parameters[k], np.sqrt(mode.parameter_covariance[k, k])) for mode in self.modes)
            rows.append([name, *(f"{value:.4g} +- {sd:.2g}" for value, sd in ends)])
        rows.append(["log-evidence", *(f"{mode.log_evidence:.2f}" for mode in self.modes)])
        rows.append(["share", *(f"{np.exp(mode.log_evidence - self.log_evidence):.2g}" for mode in self.modes)])
        rows.append(["converged", *("yes" if mode.converged else "no" for mode in self.modes)])
        return text_table(rows)

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence, the sum over the modes; -inf without a mode."""
        return float(np.logaddexp.reduce([mode.log_evidence for mode in self.modes], initial=-np.inf))

    @property
    def ended(self) -> int:
        """Number of starts that led to a mode."""
        return sum(end >= 0 for end in self.ends)

    @property
    def unseen_share(self) -> float:
        """Share of further starts that are expected to lead to modes not seen yet: the share of starts alone in a mode.

        I. J. Good (1953), Biometrika 40, 237-264, eq. 9, with modes as species, among the starts that have reached one.
        """
        return sum(self.ends.count(number) == 1 for number in range(len(self.modes))) / max(self.ended, 1)


def laplace(target: ResponseTarget, end: Ascent) -> Mode:
    """Laplace approximation at the end of an ascent: its Gauss-Newton Hessian, and differences of a third of a standard
    deviation along the noise parameters, which hardly move the best structural ones. Nothing is simulated.
    """
    noise = max(end.noise, target.fit_noise(end.statistics), key=lambda fit: fit.log_density)
    n, steps = target.n_noise, np.full(target.n_noise, 1.0 / 3.0)
    for _ in range(5):  # steps follow from the curvature itself
        moves, curvature = np.diag(steps), np.zeros((n, n))
        for a, b in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
            points = noise.coords + (a * moves[:, None] + b * moves).reshape(n * n, n)
            curvature -= a * b / 4.0 * target.noise_density(end.statistics, points).reshape(n, n)
        curvature /= np.outer(steps, steps)
        steps = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 0.1)) / 3.0
    values, vectors = np.linalg.eigh(block_diag(end.hessian, 0.5 * (curvature + curvature.T)))
    values = np.maximum(values, _FLATTEST)
    at, covariance = np.concatenate([end.coords, noise.coords]), (vectors / values) @ vectors.T
    top = noise.log_density + float(target.log_prior(end.coords))
    log_evidence = top + 0.5 * target.ndim * float(np.log(2.0 * np.pi)) - 0.5 * float(np.log(values).sum())
    ahead, behind = (target.parameters(at + sign * _STEP * np.eye(target.ndim)) for sign in (1.0, -1.0))
    tangents = (ahead - behind) / (2.0 * _STEP)
    spread = tangents.T @ covariance @ tangents
    return Mode(target.parameters(at[None])[0], spread, at, covariance, top, log_evidence, end.gain_left < LOOSEST)


class _OutOfBudget(Exception):
    """The next simulations of a search do not fit in its budget."""


class _Part(NamedTuple):
    """A part of the record, with the ends found on it by the numbers of their starts."""

    target: ResponseTarget
    share: float
    ends: dict[int, Ascent]


class Search:
    """Search from starts (n, n_structural) [standard normal coordinates], on growing parts of the record if possible.
    `spent` are the simulations so far; ascents leave less than a `tolerance` of log-density to gain. A search that goes
    on with the runs and derivatives of an earlier one is on the whole record.
    """

    def __init__(self, target: ResponseTarget, starts: np.ndarray, session: Any, tolerance: float = TOLERANCE) -> None:
        self._target, self._starts, self._session, self._tolerance, self.spent = target, starts, session, tolerance, 0.0
        parts = [*(() if len(target.archive) else target.first_parts(_SHARES)), target]
        self._parts = [_Part(part, part.n_steps / target.n_steps, {}) for part in parts]
        self._grown = self._parts[0].share < 1.0
        self.standing_for: list[int] = []  # start that has taken the place of each that has begun; -1 for none

    def run(self, starts: int) -> Steps:
        """Returns a `ModeSearch`; yields functions that simulate, and is sent their results, and None after each batch.

        As many `starts` begin, and further ones until as many have reached a mode (on a growing record, where most are
        given up, half of them, once), and while many are alone in one; on the whole record if all fail on the first
        part.
        """
        begin, following, finished = 0, starts, True
        while True:
            try:
                self.standing_for.extend(range(begin, following))
                yield from self._ascend(range(begin, following))
            except _OutOfBudget:
                finished = False
            if finished and len(self._parts) > 1 and not self._parts[0].ends:
                self._parts, self._grown, begin, self.standing_for = self._parts[-1:], False, 0, []
                continue
            search = self._found(finished)
            half = (starts + 1) // 2
            enough = starts if not search.grown else half if begin == 0 else 0
            missing = max(enough - search.ended, half if search.unseen_share > DOUBTED_SHARE else 0)
            if not finished or missing <= 0 or following == len(self._starts):
                return search
            # a search is worth nothing without draws after it
            (allowed,) = self._session.remember(
                "starts", lambda: [np.array(self._session.remaining() > 2 * self.spent)]
            )
            if not allowed:
                return search
            begin, following = following, min(following + missing, len(self._starts))

    def _ascend(self, numbers: range) -> Steps:
        """Ascents from starts on all parts of the record."""
        small = FIRST_DIFFERENCE * np.eye(self._target.n_structural) if self._grown else None
        fronts = {k: (self._starts[k], small) for k in numbers}
        for place, part in enumerate(self._parts):
            whole = part.target is self._target
            # one ascent leads: others often lead to its end, which costs them no derivatives
            order, leading = list(fronts), 1 if place or not self._grown else len(fronts)
            for wave in (order[:leading], order[leading:]):
                ascents = {}
                for k in wave:
                    start, steps = fronts[k]
                    centre = np.zeros(self._target.n_structural) if whole else start
                    derivatives = [] if self._grown else self._target.archive.derivatives
                    alone = self._grown and not whole
                    climb = Climb(part.target, derivatives, k, centre, part.ends, whole, alone)
                    loose = min(TOLERANCE / part.share, LOOSEST) if self._grown else LOOSEST
                    least = self._tolerance if whole else loose
                    ascents[k] = climb.run(start, steps, least)
                yield from self._side_by_side(part, ascents)
            wide = self._grown and place == len(self._parts) - 2
            ends = {k: part.ends[k] for k in fronts if k in part.ends}
            fronts = {
                k: (end.coords, axes_of(end, FIRST_DIFFERENCE) if wide else small)
                for k, end in sorted(ends.items(), key=lambda each: -each[1].value)
            }

    def _side_by_side(self, part: _Part, ascents: dict[int, Any]) -> Steps:
        """Run ascents, by their numbers, to their ends: all their requests together are one batch."""
        answers: dict[int, Any] = dict.fromkeys(ascents)
        while answers:
            waiting: dict[int, np.ndarray] = {}
            for number, answer in answers.items():
                try:
                    waiting[number] = ascents[number].send(answer)
                except StopIteration as end:
                    self.standing_for[number] = end.value
            slopes = [number for number, each in waiting.items() if each.ndim == 1]
            points = [number for number in waiting if number not in slopes]
            answers, sizes = {}, [len(waiting[number]) for number in points]
            # derivatives at a point count as one simulation
            coords = np.concatenate([np.empty((0, self._target.n_structural)), *(waiting[number] for number in points)])
            simulations = part.share * (len(slopes) + part.target.new_points(coords))
            if not self._session.fits(simulations):
                raise _OutOfBudget
            self.spent += simulations
            if slopes:
                at = np.array([waiting[number] for number in slopes])
                found = yield from part.target.derivatives(at, self._session.remember)
                answers |= dict(zip(slopes, found, strict=True))
            if points:
                runs = yield from part.target.run(coords, self._session.remember)
                columns = (np.split(column, np.cumsum(sizes)[:-1]) for column in runs)
                answers |= {number: Runs(*each) for number, *each in zip(points, *columns, strict=True)}
            yield None

    def _found(self, finished: bool) -> ModeSearch:
        """The modes at the ends on the whole record, and which of them each start led to."""
        ends = self._parts[-1].ends
        modes = sorted(((laplace(self._target, end), k) for k, end in ends.items()), key=lambda m: -m[0].log_evidence)
        kept = [(mode, k) for mode, k in modes if mode.log_evidence > modes[0][0].log_evidence - HIGHER]
        led = []
        for k in range(len(self.standing_for)):
            for _ in self.standing_for:  # two starts may stand for each other, one of them on an earlier part
                k = k if k < 0 or k in ends else self.standing_for[k]
            led.append(next((number for number, (_, start) in enumerate(kept) if start == k), -1))
        names, grown = tuple(self._target.posterior.parameter_names), self._grown
        return ModeSearch(tuple(mode for mode, _ in kept), tuple(led), self.spent, finished, grown, names)


def draw_starts(target: ResponseTarget, n: int, random: Any) -> np.ndarray:
    """Starts (m, n_structural) in standard normal coordinates, of which a search begins with the first n: the median of
    the prior, and a Latin hypercube of n - 1. One of n further starts follows; none for n = 1.
    """
    d = target.n_structural
    blocks = [np.zeros((1, d))]
    for size in (n - 1, n) if n > 1 else ():
        columns = [random.permutation(size) + random.uniform(size=size) for _ in range(d)]
        blocks.append(ndtri(np.column_stack(columns) / size))
    return np.concatenate(blocks)


def check_starts(starts: Any) -> int:
    """A number of starts as int; ValueError for anything but a whole number of at least one."""
    if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
        raise ValueError(f"starts must be a whole number of at least one; got {starts!r}")
    return int(starts)


def find_modes(
    posterior: Any,
    starts: int = 12,
    seed: Any = None,
    max_simulations: float | None = None,
    tolerance: float = TOLERANCE,
    show: Callable[[float], None] = lambda spent: None,
) -> ModeSearch:
    """The modes of a posterior, see `Posterior.mode`; ascents leave less than a `tolerance` of log-density to gain, and
    `show` is called with the simulations so far after each batch.
    """
    starts = check_starts(starts)
    target = ResponseTarget(posterior)
    limit = np.inf if max_simulations is None else float(max_simulations)
    random = np.random.default_rng(seed)
    session = GuideSession(random, nothing_stored, lambda n: search.spent + n <= limit, lambda: limit - search.spent)
    search = Search(target, draw_starts(target, starts, random), session, tolerance)
    return at_once(search.run(starts), lambda: show(search.spent))
