"""Guides: objects that know where the posterior is, and propose independent draws there.

A sampler with a guide needs no sequence of tempering stages (`samplers.tempering.guided`). A guide may be anything with
a normalised density: a Laplace approximation, a normalising flow, a mixture fitted to an earlier run, or an emulator of
the model. It need not be exact, since every draw is evaluated and weighted.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..estimates.importance import KnownDensity
from ..finding import Finding
from ..judgement.guides import find_missing_part


class GuideSession(NamedTuple):
    """Functions and random numbers that a sampler provides to its guide."""

    random: np.random.RandomState  #: the sampler's random generator
    #: ``remember(key, compute)`` returns the list of arrays that ``compute()`` returns, and stores it in the record of
    #: the run under `key` (str). A repeated run gets the stored arrays without a call of `compute`, for equal keys the
    #: arrays that were stored first. ``remember(key)`` returns None where nothing is stored.
    remember: Callable[..., list[np.ndarray] | None]
    #: ``fits(n)``: whether n more simulations fit into the limit. To be called before each batch of simulations; if
    #: False, the guide makes none and returns.
    fits: Callable[[float], bool]
    #: ``remaining()``: simulations left, inf without a limit. Decisions that depend on it, except to stop, are to be
    #: stored with `remember`: otherwise a run that is continued with a larger limit cannot repeat its first part.
    remaining: Callable[[], float]


class Guide(ABC):
    """Base class of guides: independent draws near the posterior, with their density.

    `draw` and `log_density` are required.

    Attributes
    ----------
    findings : sequence of Finding
        Reasons why parts of the posterior may be missing, such as modes that were not searched for; their severity
        limits the verdict. By default one, that this is not known: set it to () if the guide is known to miss nothing.
    basis : str
        How parts of the posterior were searched for, as a clause of the verdict.
    simulations : float
        Simulations made by `prepare` and `refine`; parts of a simulation count as fractions.
    known_density : KnownDensity, optional
        A density close to the posterior with known expectations, such as an emulated posterior, as it is now
        (`samplers.estimates.importance.KnownDensity`). It makes expectations under the posterior more accurate
        (`samplers.estimates.control_variates`).
    observe : callable, optional
        ``observe(coords, session)`` is called with points (n, ndim) directly before they are evaluated, so that a guide
        can simulate and keep what `log_prob_fn` does not return. Requires ``vectorize=True``.
    fingerprint : str
        Identity of the guide: a run is resumed only with the same fingerprint.

    Examples
    --------
    A normal density near the posterior, which is not refined:

    >>> class Normal(Guide):
    ...     findings = ()  # there are no other modes
    ...     mean, sd = samples.mean(axis=0), 1.5 * samples.std(axis=0)
    ...     def draw(self, n, random):
    ...         return random.normal(self.mean, self.sd, size=(n, len(self.mean)))
    ...     def log_density(self, coords):
    ...         z = (coords - self.mean) / self.sd
    ...         return -0.5 * np.sum(z**2 + np.log(2.0 * np.pi * self.sd**2), axis=1)
    >>> guided = SMCSampler(50, posterior.ndim, posterior, vectorize=True, guide=Normal(), seed=1)
    >>> state = guided.run_mcmc(None, 1)
    >>> bool(guided.simulations < 1000 and abs(guided.log_evidence - sampler.log_evidence) < 1.0)
    True
    """

    findings: Sequence[Finding] = (find_missing_part("it is not known whether the posterior has other modes"),)
    basis = ""
    simulations = 0.0
    known_density: KnownDensity | None = None
    observe: Callable | None = None

    @abstractmethod
    def draw(self, n: int, random: np.random.RandomState, /) -> np.ndarray:
        """Independent draws (n, ndim), all inside the support of the prior."""

    @abstractmethod
    def log_density(self, coords: np.ndarray, /) -> np.ndarray:
        """Logarithm (n,) of the normalised density of `draw` at points (n, ndim); -inf is allowed."""

    def prepare(self, session: GuideSession, /) -> Generator | None:
        """A costly search before the first draw; may be a generator.

        An item that is a function without arguments is called, and its result is sent back; each other item advances
        the progress bar.
        """
        return None

    def refine(self, coords: np.ndarray, log_prob: np.ndarray, session: GuideSession, /) -> Iterator[None] | None:
        """Learn from the latest draws (n, ndim) and their log-probabilities (n,), -inf where an evaluation failed.

        May be a generator, as `prepare`.
        """
        return None

    def check(self, log_prob_fn: Callable, /) -> None:
        """Raise ValueError if the guide was made for another density than the sampler."""
        return None

    def fresh(self) -> "Guide":
        """A guide in the state before `prepare`: a sampler works on it, and never changes the given guide."""
        return copy.deepcopy(self)

    def frozen(self) -> Callable[[np.ndarray], np.ndarray]:
        """A function like `log_density` that does not change when the guide learns: by default, of a deep copy."""
        return copy.deepcopy(self).log_density

    @property
    def fingerprint(self) -> str:
        """The name of the class."""
        return type(self).__name__


def checked_draws(guide: Guide, n: int, random: np.random.RandomState, ndim: int) -> np.ndarray:
    """Draws (n, ndim) of a guide; ValueError for any other shape."""
    coords = np.atleast_2d(np.asarray(guide.draw(n, random), dtype=float))  # one draw of scipy has a shape (ndim,)
    if coords.shape != (n, ndim) or not np.all(np.isfinite(coords)):
        raise ValueError(
            f"guide.draw({n}, random) must return {n} finite points of {ndim} parameters; got shape {coords.shape}"
            f"{'' if coords.shape != (n, ndim) else ' with infinite or NaN numbers'}"
        )
    return coords


def checked_density(guide: Guide, coords: np.ndarray) -> np.ndarray:
    """Log-density (n,) of a guide; ValueError for any other shape, NaN or +inf."""
    values = np.atleast_1d(np.asarray(guide.log_density(coords.copy()), dtype=float))
    if values.shape != (len(coords),) or np.any(np.isnan(values) | (values == np.inf)):
        raise ValueError(
            f"guide.log_density must return one number per point, {len(coords)} in all, neither NaN nor +inf; got "
            f"shape {values.shape}{'' if values.shape != (len(coords),) else ' with NaN or +inf'}"
        )
    return values


def check_guide(guide: Any, log_prob_fn: Callable, vectorize: bool) -> None:
    """Raise ValueError if an object is no guide, cannot observe, or was made for another density."""
    if not isinstance(guide, Guide):
        raise ValueError(
            "guide must be an object of a class derived from samplers.Guide, with the methods draw(n, random) and "
            f"log_density(coords); got {type(guide).__name__}"
        )
    if guide.observe is not None and not vectorize:
        raise ValueError(
            "this guide simulates the points before they are evaluated (it has a method observe), so they must be "
            "evaluated in this process: pass vectorize=True, and a pool to the posterior instead of to the sampler"
        )
    guide.check(log_prob_fn)
