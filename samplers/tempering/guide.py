"""Guides: objects that know where the posterior is, and propose independent draws there.

A sampler with a guide needs no sequence of tempering stages (`samplers.tempering.guided`). A guide may be anything with
a normalised density: a Laplace approximation, a normalising flow, a mixture fitted to an earlier run, or an emulator of
the model. It need not be exact, since every draw is evaluated and weighted.
"""

import copy
from collections.abc import Callable, Generator, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..judgement.guides import find_missing_part

__all__ = ["AdaptedGuide", "Guide", "GuideSession", "check_guide", "guide_fingerprint"]


UNKNOWN = "it has no attribute findings, so it is not known whether the posterior has other modes"
# The optional members of a guide (see `Guide`) that are not methods of the search, and their defaults. A guide that
# does not say whether parts of the posterior may be missing is doubted.
DEFAULTS = {
    "simulations": 0.0,
    "findings": (find_missing_part(UNKNOWN),),
    "basis": "",
    "observe": None,
    "learns_from_parts": False,
    "known_density": None,
}


class GuideSession(NamedTuple):
    """Functions and random numbers that a sampler provides to its guide.

    Attributes
    ----------
    random : RandomState
        The sampler's random generator.
    remember : callable
        ``remember(key, compute)`` returns the list of arrays that ``compute()`` returns, and stores it in the record
        of the run under `key` (str). A repeated run gets the stored arrays without a call of `compute`. For equal keys,
        the arrays that were stored first are returned first. ``remember(key)`` returns None where nothing is stored.
    fits : callable
        ``fits(n)``: whether n more simulations fit into the limit. To be called before each batch of simulations; if
        False, the guide makes none and returns.
    remaining : callable
        ``remaining()``: simulations left, inf without a limit. Decisions that depend on it, except to stop, are to be
        stored with `remember`: otherwise a run that is continued with a larger limit cannot repeat its first part.
    asynchronous : bool
        Whether draws arrive in any order, and new draws are made while earlier draws are still running.
    weighted : callable
        ``weighted()``: all draws (n, ndim) of complete rounds, and their log-weights (n,); None before the first.
    """

    random: np.random.RandomState
    remember: Callable[..., list[np.ndarray] | None]
    fits: Callable[[float], bool]
    remaining: Callable[[], float]
    asynchronous: bool
    weighted: Callable[[], tuple[np.ndarray, np.ndarray] | None] = lambda: None


class Guide(Protocol):
    """Independent draws near the posterior, with their density.

    `draw`, `log_density` and `refine` are required. A guide may have these members as well:

    ``prepare(session)``
        A generator that makes a costly search before the first draw. An item that is a function without arguments is
        called, and its result is sent back; each other item advances the progress bar.
    ``observe(coords, session)``
        Called with points (n, ndim) directly before they are evaluated, so that a guide can simulate and keep what
        `log_prob_fn` does not return. Requires ``vectorize=True``. In an asynchronous run it is called when they have
        been evaluated, a few at a time.
    ``evaluation_queue()``
        The queue for points in an asynchronous run, which replaces the queue of `log_prob_fn`, for a guide that keeps
        more than the value of an evaluation.
    ``learns_from_parts`` : bool
        Whether `refine` is to be called in an asynchronous run before all draws of a round have arrived. The first
        draws have short evaluations: a regression may learn from them, a density estimate may not. False by default.
    ``check(log_prob_fn)``
        Raises ValueError if the guide was made for another density than the sampler.
    ``fresh()``
        A new guide in the state before `prepare`. A sampler works on this new guide and never changes the given guide;
        without this method, it works on a deep copy.
    ``frozen()``
        A function like `log_density` that does not change when the guide learns; by default of a deep copy.
    ``simulations`` : float
        Simulations made by `prepare` and `refine`; parts of a simulation count as fractions.
    ``findings`` : sequence of Finding
        Reasons why parts of the posterior may be missing, such as modes that were not searched for
        (`samplers.judgement.guides.find_missing_part`); their severity limits the verdict. A missing attribute counts
        as a reason: set it to () if the guide is known to miss nothing.
    ``known_density`` : KnownDensity, optional
        A density close to the posterior with known expectations, such as an emulated posterior, as it is now
        (`samplers.estimates.importance.KnownDensity`). It makes expectations under the posterior more accurate
        (`samplers.estimates.control_variates`).
    ``basis`` : str
        How parts of the posterior were searched for, as a clause of the verdict.
    ``fingerprint`` : str
        Identity of the guide: a run is resumed only with the same fingerprint.

    Examples
    --------
    A normal density near the posterior, which is not refined:

    >>> class Normal:
    ...     findings = ()  # there are no other modes
    ...     mean, sd = samples.mean(axis=0), 1.5 * samples.std(axis=0)
    ...     def draw(self, n, random):
    ...         return random.normal(self.mean, self.sd, size=(n, len(self.mean)))
    ...     def log_density(self, coords):
    ...         z = (coords - self.mean) / self.sd
    ...         return -0.5 * np.sum(z**2 + np.log(2.0 * np.pi * self.sd**2), axis=1)
    ...     def refine(self, coords, log_prob, session):
    ...         pass
    >>> guided = SMCSampler(50, posterior.ndim, posterior, vectorize=True, guide=Normal(), seed=1)
    >>> state = guided.run_mcmc(None, 1)
    >>> bool(guided.simulations < 1000 and abs(guided.log_evidence - sampler.log_evidence) < 1.0)
    True
    """

    def draw(self, n: int, random: np.random.RandomState, /) -> np.ndarray:
        """Independent draws (n, ndim), all inside the support of the prior."""

    def log_density(self, coords: np.ndarray, /) -> np.ndarray:
        """Logarithm (n,) of the normalised density of `draw` at points (n, ndim); -inf is allowed."""

    def refine(self, coords: np.ndarray, log_prob: np.ndarray, session: GuideSession, /) -> Iterator[None] | None:
        """Learn from the latest draws (n, ndim) and their log-probabilities (n,), -inf where an evaluation failed.

        May be a generator, as `prepare`. In an asynchronous run, the draws may be from an
        earlier density, and the next draws may have been made already.
        """


class AdaptedGuide:
    """A fresh copy, `guide`, of a user's guide, with `DEFAULTS` for the members that it does not have."""

    def __init__(self, guide: Guide, ndim: int):
        fresh = getattr(guide, "fresh", None)
        self.guide = copy.deepcopy(guide) if fresh is None else fresh()
        self._ndim = ndim

    def __getattr__(self, name: str) -> Any:
        if name not in DEFAULTS:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        value, default = getattr(self.guide, name, DEFAULTS[name]), DEFAULTS[name]
        return value if default is None else type(default)(value)

    def prepare(self, session: GuideSession) -> Generator:
        """The search before the first draw."""
        prepare = getattr(self.guide, "prepare", None)
        yield from () if prepare is None else (prepare(session) or ())

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (n, ndim); ValueError for any other shape."""
        coords = np.asarray(self.guide.draw(n, random), dtype=float)
        if coords.shape != (n, self._ndim) or not np.all(np.isfinite(coords)):
            raise ValueError(
                f"guide.draw({n}, random) must return {n} finite points of {self._ndim} parameters; got shape "
                f"{coords.shape}{'' if coords.shape != (n, self._ndim) else ' with infinite or NaN numbers'}"
            )
        return coords

    def log_density(self, coords: np.ndarray) -> np.ndarray:
        """Log-density (n,); ValueError for any other shape, NaN or +inf."""
        values = np.asarray(self.guide.log_density(coords.copy()), dtype=float)
        if values.shape != (len(coords),) or np.any(np.isnan(values) | (values == np.inf)):
            raise ValueError(
                f"guide.log_density must return one number per point, {len(coords)} in all, neither NaN nor +inf; got "
                f"shape {values.shape}{'' if values.shape != (len(coords),) else ' with NaN or +inf'}"
            )
        return values

    def frozen(self) -> Callable[[np.ndarray], np.ndarray]:
        """The log-density as it is now, whatever the guide learns later."""
        frozen = getattr(self.guide, "frozen", None)
        if frozen is not None:
            return frozen()
        try:
            return copy.deepcopy(self.guide).log_density
        except Exception as error:
            raise ValueError(
                f"{type(self.guide).__name__} cannot be copied ({error}): give the guide a method frozen(), which "
                "returns a function like log_density that does not change when the guide learns"
            ) from error

    def refine(self, coords: np.ndarray, log_prob: np.ndarray, session: GuideSession) -> Generator:
        """Let the guide learn from the latest draws."""
        yield from self.guide.refine(coords, log_prob, session) or ()


def check_guide(guide: Any, log_prob_fn: Callable, vectorize: bool) -> None:
    """Raise ValueError if an object lacks a required method, cannot observe, or was made for another density."""
    missing = [name for name in ("draw", "log_density", "refine") if not callable(getattr(guide, name, None))]
    if missing:
        raise ValueError(
            f"a guide needs the methods draw(n, random), log_density(coords) and refine(coords, log_prob, session); "
            f"{type(guide).__name__} has no {', '.join(missing)}"
        )
    if getattr(guide, "observe", None) is not None and not vectorize:
        raise ValueError(
            "this guide simulates the points before they are evaluated (it has a method observe), so they must be "
            "evaluated in this process: pass vectorize=True, and a pool to the posterior instead of to the sampler"
        )
    check = getattr(guide, "check", None)
    if check is not None:
        check(log_prob_fn)


def guide_fingerprint(guide: Guide) -> str:
    """Identity of a guide: its attribute `fingerprint`, or else the name of its class."""
    return str(getattr(guide, "fingerprint", type(guide).__name__))
