"""Modes of a posterior, by ascents from several starts on growing parts of the record.

A model that can be shortened (``first(seconds)``) is first fitted to the start of its record, from all starts, and then
to longer parts, from the distinct ends so far (`fe_likelihoods.emulation.levenberg_marquardt`). Short runs are cheap,
and their misfit is smoother, because errors in a period have had less time to add up to a phase. There the prior is
centred on each start, so that starts keep their differences in parameters without effect on the early part.
"""

from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple

import numpy as np

from samplers.judgement.guides import DOUBTED_SHARE

from .levenberg_marquardt import (
    FIRST_DIFFERENCE,
    TOLERANCE,
    Ascent,
    Jacobians,
    ascend,
    axes_of,
    complete,
    distinct_ends,
)
from .target import Remember, ResponseTarget, Steps, at_once, nothing_stored

__all__ = [
    "MOST_STARTS",
    "Mode",
    "ModeSearch",
    "check_starts",
    "counted",
    "draw_starts",
    "ended",
    "enough",
    "find_modes",
    "laplace",
    "search_modes",
    "unseen_share",
]

_NEGLIGIBLE = 15.0  # a mode whose log-evidence is lower than the largest by more than this is dropped
_LOOSEST = 5.0  # largest tolerance of a short part of the record
_THIRD = 1.0 / 3.0  # steps of second differences, in standard deviations
_ROUNDS_OF_STEPS = 4
_FLATTEST = 0.2  # smallest curvature of the Laplace approximation: five times the variance of the prior
_APART = 0.25  # prior standard deviations in one coordinate from which ends on a part of the record are different
_APART_OF_ALL = 2.0  # the same, times the number of starts
_FEW = 6  # parameters whose differences cost about as much as two steps
MOST_STARTS = 4  # times the number of the first ones
_DRAWN = 8  # the same for those of which the highest begin: a simulation each is cheaper than ascents given up
_HOPELESS = 1.6  # log-density per measured number below the best end of a part: residuals five times as large
_SHARES = 0.03, 0.1, 0.3, 0.6  # of the Arias intensity, at which the parts of the record end


class Mode(NamedTuple):
    """A mode of the posterior.

    Attributes
    ----------
    parameters : (ndim,) float
        All parameters at the mode of the density in standard normal coordinates.
    coords : (ndim,) float
        These coordinates.
    covariance : (ndim, ndim) float
        Covariance of the coordinates in the Laplace approximation.
    log_density : float
        Log-density of the coordinates at the mode, without the evidence's normalisation.
    log_evidence : float
        Evidence of the mode in the Laplace approximation, which can be wrong by several units.
    starts : tuple of int
        Starts that ended here.
    converged : bool
        False if the ascent stopped before the top.
    """

    parameters: np.ndarray
    coords: np.ndarray
    covariance: np.ndarray
    log_density: float
    log_evidence: float
    starts: tuple[int, ...]
    converged: bool


class ModeSearch(NamedTuple):
    """Result of a search for modes.

    Attributes
    ----------
    modes : tuple of Mode
        Distinct modes, the highest first.
    ends : tuple of int
        Mode in which each start ended, -1 where it ended in none (a start that failed, or a mode of no weight).
    simulations : float
        Simulations run, parts of a record counted as fractions; a call of the model's ``jacobian`` counts as one.
    finished : bool
        False if `max_simulations` ended the search.
    grown : bool
        Whether it began with the first part of the record, where most starts are given up, in right runs as well.
    low : int
        Tops of no weight at which starts ended.
    """

    modes: tuple[Mode, ...]
    ends: tuple[int, ...]
    simulations: float
    finished: bool
    grown: bool = False
    low: int = 0


def laplace(target: ResponseTarget, end: Ascent, starts: tuple[int, ...] = ()) -> Mode:
    """Laplace approximation at the end of an ascent, over structural and noise coordinates together.

    The residuals are taken as linear in the structural coordinates, so that nothing is simulated. The Hessian of the
    log-density is computed by central differences with steps of 1/3 standard deviation.
    """
    statistics = end.statistics
    noise = max(end.noise, target.fit_noise(statistics), key=lambda fit: fit.log_density)
    d, at = target.n_structural, np.concatenate([end.coords, noise.coords])
    forms = target.archive.forms(target.archive.weights([*end.slopes, end.run]))
    along, curved = 2.0 * forms[:-1, -1], forms[:-1, :-1]

    def log_density(coords: np.ndarray) -> np.ndarray:
        step = coords[:, :d] - end.coords
        linear = statistics + step @ along + np.einsum("nk,nl,kla->na", step, step, curved)
        return target.log_likelihood(np.maximum(linear, 0.0), coords[:, d:]) + target.log_prior(coords)

    steps = _THIRD / np.sqrt(np.concatenate([np.diag(end.hessian), np.ones(target.n_noise)]))
    unit = np.eye(target.ndim)
    for _ in range(_ROUNDS_OF_STEPS):  # noise parameters: the steps follow from the curvature itself
        ahead, behind, here = (log_density(at + sign * np.diag(steps)) for sign in (1.0, -1.0, 0.0))
        curvature = np.maximum((2.0 * here - ahead - behind) / steps**2, 0.1)
        steps = _THIRD / np.sqrt(curvature)
    pairs = [(i, j) for i in range(target.ndim) for j in range(i + 1)]
    corners = [
        log_density(np.array([at + a * steps[i] * unit[i] + b * steps[j] * unit[j] for i, j in pairs]))
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    mixed = -(corners[0] - corners[1] - corners[2] + corners[3]) / 4.0
    hessian = np.empty((target.ndim, target.ndim))
    for (i, j), value in zip(pairs, mixed, strict=True):
        hessian[i, j] = hessian[j, i] = value / (steps[i] * steps[j])
    finite = bool(np.isfinite(hessian).all())
    if not finite:  # an exact fit, or a likelihood beyond the range of numbers
        hessian = np.eye(target.ndim)
        hessian[:d, :d] = np.where(np.isfinite(end.hessian), end.hessian, np.eye(d))
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, _FLATTEST)
    covariance = (vectors / values) @ vectors.T
    top = float(log_density(at[None])[0])
    log_evidence = top + 0.5 * target.ndim * float(np.log(2.0 * np.pi)) - 0.5 * float(np.log(values).sum())
    parameters = target.parameters(at[None])[0]
    return Mode(parameters, at, covariance, top, log_evidence, starts, finite and end.converged)


class _Part(NamedTuple):
    """A part of the record, with the ends found on it by the numbers of their starts."""

    target: ResponseTarget
    share: float
    ends: dict[int, Ascent]
    jacobians: Jacobians


def search_modes(
    target: ResponseTarget,
    starts: np.ndarray,
    remember: Remember = nothing_stored,
    fits: Callable[[float], bool] = lambda _: True,
    first: int | None = None,
    remaining: Callable[[], float] = lambda: np.inf,
    shares: Sequence[float] = _SHARES,
) -> Steps:
    """Search from starts (n, n_structural) [standard normal coordinates], on growing parts of the record if possible.

    `first` starts begin (default: all). Further ones follow until enough have reached a mode (ascents that are given up
    may have been on their way to another one; on a growing record, some follow once), and while `unseen_share` is large
    (modes that one start alone led to say that others may have been missed). They begin in the order of their
    likelihoods, for which each of them is simulated once on the first part of the record: high ones are given up less
    often. If all fail there, which may be too short for the model, they begin on the whole record.

    `remember` stores responses for a resumed run, ``fits(n)`` says whether n more simulations of the whole record fit
    into the budget, and `remaining` how many are left of it. Yields functions that simulate, and is sent their results;
    and the cost of each batch when it is made, in simulations of the whole record.
    """
    first = len(starts) if first is None else first
    most = min(MOST_STARTS * first, len(starts))
    shortened = [*target.shortened(shares), target]
    parts = [_Part(part, part.n_steps / target.n_steps, {}, Jacobians()) for part in shortened]
    standing_for: list[int] = []  # start that has taken the place of each; -1 for none
    spent = 0.0

    def spend(cost: float) -> None:
        nonlocal spent
        spent += cost

    def affordable() -> list[np.ndarray]:  # the search is worth nothing without draws after it
        return [np.array(remaining() > 2.0 * spent)]

    begin, following = 0, first
    while True:
        fresh = range(begin, following)
        standing_for.extend(fresh)
        ascents = _ascend_from(parts, {k: starts[k] for k in fresh}, standing_for, remember, fits)
        finished = yield from counted(ascents, spend)
        search = _modes_of(parts, standing_for, spent, finished)
        few = enough(search, first) - ended(search) if begin == 0 or not search.grown else 0
        missing = max(few, _further(first) if unseen_share(search) > DOUBTED_SHARE else 0)
        if not finished or missing <= 0 or following == most or not remember("starts", affordable)[0]:
            return search
        if begin == 0:
            heights = yield from counted(_heights(parts[0], starts, remember, fits), spend)
            if heights is None:
                return search._replace(simulations=spent, finished=False)
            if len(parts) > 1 and np.isneginf(heights).all():
                whole = search_modes(target, starts, remember, fits, first, remaining, shares=())
                return (yield from counted(whole, spend))._replace(simulations=spent)
            starts = np.concatenate([starts[:following], starts[_in_order(starts, heights, following)]])
            most = min(most, len(starts))
            if following == most:  # every simulation has failed
                return search._replace(simulations=spent)
        begin, following = following, min(following + missing, most)


def _heights(part: _Part, starts: np.ndarray, remember: Remember, fits: Callable[[float], bool]) -> Steps:
    """Log-likelihoods (n,) of starts (n, n_structural) on the first part of the record; -inf where one failed.

    None if the budget ended it.
    """

    cost = part.share * part.target.new_points(starts)
    if not fits(cost):
        return None
    runs = yield from part.target.run(starts, remember)
    yield cost
    found = zip(runs.failed, runs.statistics, strict=True)
    return np.array([-np.inf if failed else part.target.fit_noise(each).log_density for failed, each in found])


def counted(steps: Steps, spend: Callable[[float], None]) -> Steps:
    """The steps of a search, and its result; `spend` is told the cost of each batch as soon as it is made."""
    answer = None
    while True:
        try:
            item = steps.send(answer)
        except StopIteration as end:
            return end.value
        if not callable(item):
            spend(item)
        answer = yield item


def _in_order(starts: np.ndarray, heights: np.ndarray, begun: int) -> np.ndarray:
    """Numbers of the starts (n, d) after the first ones that have `begun`, in the order in which they shall begin.

    Starts that have failed do not. The first ones are those without a higher start in a critical distance, in the unit
    cube of the prior's probabilities; then the others follow, the highest first. With this distance, each mode is
    reached, from a finite number of starts (multi-level single linkage: Rinnooy Kan & Timmer 1987, Math. Program. 39,
    57-78, eq. 8, with sigma = 4).
    """
    from scipy.special import gamma, ndtr

    n, d = starts.shape
    unit = ndtr(starts)
    critical = (gamma(1.0 + 0.5 * d) * 4.0 * np.log(n) / n) ** (1.0 / d) / np.sqrt(np.pi)
    near = np.linalg.norm(unit[:, None] - unit, axis=2) < critical
    covered = (near & (heights[None] > heights[:, None])).any(axis=1)
    order = begun + np.lexsort((-heights[begun:], covered[begun:]))
    return order[heights[order] > -np.inf]


def unseen_share(search: ModeSearch) -> float:
    """Share of further starts that are expected to lead to modes not seen yet: the share of starts alone in a mode.

    I. J. Good (1953), Biometrika 40, 237-264, eq. 9, with modes as species, among the starts that have reached one.
    """
    alone = sum(search.ends.count(number) == 1 for number in range(len(search.modes)))
    return alone / max(ended(search), 1)


def enough(search: ModeSearch, first: int) -> int:
    """Number of starts that shall lead to the modes found: `first` to one mode, and more to several ones.

    If as many starts lead to another mode as to each of k modes found, n starts miss it with the probability
    (k / (k + 1))^n, which shall be 1 / 2^first. Tops of no weight say that there may be two modes where one was found;
    on a growing record, most starts are given up before they reach one.
    """
    k = max(len(search.modes), 2 if search.low and not search.grown else 1)
    return int(np.ceil(first * np.log(2.0) / np.log((k + 1.0) / k) - 1e-9))


def ended(search: ModeSearch) -> int:
    """Number of starts that led to a mode."""
    return sum(end >= 0 for end in search.ends)


def _ascend_from(
    parts: list[_Part],
    starts: dict[int, np.ndarray],
    standing_for: list[int],
    remember: Remember,
    fits: Callable[[float], bool],
) -> Steps:
    """Ascents from starts, by their numbers, on all parts of the record; returns False if the budget ended them."""
    target, n = parts[-1].target, len(standing_for)
    small = FIRST_DIFFERENCE * np.eye(target.n_structural) if len(parts) > 1 else None
    fronts = {k: (start, small) for k, start in starts.items()}
    for part, following in zip(parts, [*parts[1:], None], strict=True):
        whole = part.target is target
        tolerance = TOLERANCE if whole else min(TOLERANCE / part.share, _LOOSEST)
        # many starts are close together, and none may be lost before the part of the record where they differ
        apart = np.inf if whole else min(_APART, _APART_OF_ALL / n)
        ascents = {
            k: ascend(
                part.target,
                part.jacobians if whole and target.n_structural > _FEW else Jacobians(),
                k,
                start,
                np.zeros(target.n_structural) if whole else start,
                part.ends,
                tolerance,
                apart,
                steps,
                whole,
            )
            for k, (start, steps) in fronts.items()
        }
        # the best end of the part before first: others often lead to it, which costs them no derivatives
        leading = len(ascents) if part is parts[0] else 1
        for wave in (list(ascents)[:leading], list(ascents)[leading:]):
            some = {k: ascents[k] for k in wave}
            if not (yield from complete(part.target, some, standing_for.__setitem__, remember, fits, part.share)):
                return False
        if not part.ends:
            break
        for k, other in distinct_ends(part.ends, apart).items():
            if k != other:
                standing_for[k] = other
                del part.ends[k]
        best = max(end.value for end in part.ends.values())
        # a model that is not exact may fit a part of the record best where it does not fit the whole one
        good = {
            k: e for k, e in part.ends.items() if k in fronts and e.value > best - _HOPELESS * part.target.measured.size
        }
        for k in fronts.keys() & part.ends.keys() - good.keys():
            standing_for[k] = -1
        ordered = sorted(good, key=lambda k: -part.ends[k].value)
        wide = following is not None and following.target is target
        fronts = {k: (good[k].coords, axes_of(good[k], FIRST_DIFFERENCE) if wide else small) for k in ordered}
    return True


def _modes_of(parts: list[_Part], standing_for: list[int], spent: float, finished: bool) -> ModeSearch:
    """The modes at the ends on the whole record, and which of them each start led to."""
    part = parts[-1]
    modes = sorted((laplace(part.target, end, (k,)) for k, end in part.ends.items()), key=lambda m: -m.log_evidence)
    low = [mode for mode in modes if mode.log_evidence <= modes[0].log_evidence - _NEGLIGIBLE]
    modes = modes[: len(modes) - len(low)]
    number_of = {mode.starts[0]: number for number, mode in enumerate(modes)}
    ends = tuple(number_of.get(_end_of(k, standing_for, part.ends), -1) for k in range(len(standing_for)))
    led = [tuple(k for k, end in enumerate(ends) if end == number) for number in range(len(modes))]
    modes = [mode._replace(starts=starts) for mode, starts in zip(modes, led, strict=True)]
    return ModeSearch(tuple(modes), ends, spent, finished, len(parts) > 1, sum(mode.converged for mode in low))


def _end_of(k: int, standing_for: Sequence[int], ends: Container[int]) -> int:
    """The start at whose end on the whole record a start has arrived; -1 for none.

    Two starts may stand for each other, one on the whole record and the other, in a later round, on a first part.
    """
    for _ in standing_for:
        if k < 0 or k in ends:
            break
        k = standing_for[k]
    return k


def _further(first: int) -> int:
    """Number of starts that follow together."""
    return max(first // 2, 1)


def draw_starts(target: ResponseTarget, n: int, random: Any) -> np.ndarray:
    """Starts (m, n_structural) in standard normal coordinates, of which a search begins with the first n.

    These are the median of the prior, then a Latin hypercube: every parameter has one start in each of n - 1 intervals
    of equal prior probability, in random order. A larger one follows, from which further starts are chosen; none for
    n = 1.
    """
    from scipy.special import ndtri

    d = target.n_structural
    blocks = [np.zeros((1, d))]
    for size in (n - 1, (_DRAWN - 1) * n) if n > 1 else ():
        columns = [random.permutation(size) + random.uniform(size=size) for _ in range(d)]
        blocks.append(ndtri(np.column_stack(columns) / size))
    return np.concatenate(blocks)


def check_starts(starts: Any) -> int:
    """A number of starts as int; ValueError for anything but a whole number of at least one."""
    if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
        raise ValueError(f"starts must be a whole number of at least one; got {starts!r}")
    return int(starts)


def find_modes(posterior: Any, starts: int = 6, seed: Any = None, max_simulations: float | None = None) -> ModeSearch:
    """Find the modes of a posterior from the responses of its model.

    Parameters
    ----------
    posterior : Posterior
        Any noise whose statistics are quadratic in the residuals, as all noises of this package are.
    starts : int
        Number of starts that shall lead to a mode: the median of the prior, and a Latin hypercube of its quantiles. At
        most four times as many begin.
    seed : int, optional
        Seed of the draws.
    max_simulations : float, optional
        Largest number of simulations; parts of a record count as fractions.

    Returns
    -------
    ModeSearch

    Raises
    ------
    ValueError
        If `starts` is not a whole number of at least one, or the noise is of another kind.

    Notes
    -----
    A mode that no start leads to is not found. The more starts, the better: of two modes to which equally many starts
    lead, six starts find both in 97 of 100 cases.

    Examples
    --------
    >>> from fe_likelihoods.emulation.modes import find_modes
    >>> found = find_modes(posterior, seed=1)
    >>> len(found.modes)
    1
    """
    starts = check_starts(starts)
    target = ResponseTarget(posterior)
    budget = np.inf if max_simulations is None else float(max_simulations)
    spent = 0.0

    def fits(simulations: float) -> bool:
        return spent + simulations <= budget

    drawn = draw_starts(target, starts, np.random.default_rng(seed))

    def spend(cost: float) -> None:
        nonlocal spent
        spent += cost

    search = search_modes(target, drawn, fits=fits, first=starts, remaining=lambda: budget - spent)
    return at_once(counted(search, spend))
