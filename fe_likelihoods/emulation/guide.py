"""A guide to the posterior: draws near it, and their density, from few simulations (``docs/theory/guided``).

Draws come from the emulated posterior q_e (absent before there are enough runs), and, which bounds weights where the
emulator is wrong or does not reach, from a wide t mixture q_t around the modes. Every simulation, including the search,
trains the emulators.
"""

import copy
import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from samplers.evaluation.values import most_common_reasons
from samplers.finding import Finding
from samplers.judgement.guides import (
    check_draws_in_memory,
    check_ends,
    check_excluded_runs,
    check_tops,
    check_unseen_modes,
    find_missing_part,
)
from samplers.proposals.mixture import DOF, draw, log_density
from samplers.tempering.guide import Guide

from .density import EmulatedPosterior, Region, around, student_mixture
from .emulator import ResponseEmulator
from .levenberg_marquardt import TOLERANCE
from .modes import LOOSEST, ModeSearch, Search, check_starts, draw_starts
from .target import ResponseTarget, Steps, at_once

logger = logging.getLogger(__name__)

_WIDE_SHARE = 0.10  # of the draws: weights are bounded by its inverse (not measured)
_WIDENED = 1.5  # of the wide components: variances over those of their regions
_FEWEST_CACHED = 10_000  # simulations that the likelihood must cache in memory
_MOST_RUNS = 300  # that train the emulator of a region
_DEPTH = 40.0, 8.0  # log-density below the best within which runs train an emulator: constant, per dimension


class ResponseGuide(Guide):
    """Draws near the posterior of a likelihood whose responses are known; made by `Posterior.guide`, with its example.

    Attributes
    ----------
    search : ModeSearch, optional
        Result of the search for modes; None before it.
    """

    def __init__(self, posterior: Any, starts: int = 12) -> None:
        starts = check_starts(starts)
        fewest = min(part.simulator.memory_cache.most for part, _ in posterior.likelihood.data_sets())
        if fewest < _FEWEST_CACHED:
            raise ValueError(
                f"a guide needs a likelihood with memory_rows of {_FEWEST_CACHED} or more, so that no simulation is "
                f"run twice; got {fewest}"
            )
        self._target = ResponseTarget(posterior)
        self._posterior, self._starts = posterior, starts
        self.search: ModeSearch | None = None
        self._spent, self._searching = 0.0, None  # simulations of searches that have ended, and the one that has not
        self._excess = -np.inf  # log-density of a draw above all modes
        self._regions: list[Region] = []
        self._emulated: EmulatedPosterior | None = None
        d = self._target.ndim
        self._wide = student_mixture(np.ones(1), np.zeros((1, d)), np.eye(d)[None], np.inf)  # the prior, without modes

    @property
    def simulations(self) -> float:
        """Simulations run by the guide: parts of a record are fractions, a call of a ``jacobian`` counts as one."""
        return self._spent + (0.0 if self._searching is None else self._searching.spent)

    def check(self, log_prob_fn: Callable) -> None:
        """Raise ValueError if a sampler evaluates another object: every draw would be simulated twice."""
        if getattr(log_prob_fn, "__self__", log_prob_fn) is not self._posterior:
            raise ValueError(
                "the guide belongs to another posterior object than the one that is sampled, so every draw would be "
                f"simulated twice: pass the same posterior to the sampler, and its guide(); got {log_prob_fn!r}"
            )

    def fresh(self) -> "ResponseGuide":
        """A guide of the same posterior that has not searched yet."""
        return ResponseGuide(self._posterior, self._starts)

    @property
    def fingerprint(self) -> str:
        """Identity of the guide: a sampler resumes a run only with an equal one."""
        derivatives = ", derivatives" if self._target.data.differentiable else ""
        return f"{type(self).__name__}({self._posterior.fingerprint}, starts={self._starts}{derivatives})"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Why parts of the posterior may be missing."""
        search = self.search
        if search is None:
            return ()
        reasons = {
            "the budget ended the search for modes": not search.finished,
            "no start of the search led to a mode: the simulations of all starts fail": not search.modes,
            "the search for modes ended before the top of a mode": not all(mode.converged for mode in search.modes),
        }
        found = [find_missing_part(text) for text, is_true in reasons.items() if is_true][:1]
        if len(search.modes) > 1:
            found += check_unseen_modes(search.unseen_share, search.ended, len(search.modes))
        else:
            found += check_ends(search.ended, len(search.ends), self._starts, search.grown)
        found += check_tops(self._excess)
        if self._emulated is not None:
            found += check_draws_in_memory(self._emulated.effective_share)
            found += check_excluded_runs(*self._emulated.of_runs)
        return tuple(found)

    @property
    def basis(self) -> str:
        """What a verdict without such findings rests on."""
        if self.search is None or not self.search.modes:
            return ""
        n, modes = self.search.ended, len(self.search.modes)
        missed = 1.0 - 0.05 ** (1.0 / n)
        return (
            f"{n} starts led to {modes} mode{'s' if modes > 1 else ''}; with 95 % probability, they would have found "
            f"any mode to which more than {100.0 * missed:.0f} % of such starts lead"
        )

    # ------------------------------------------------------------------ what a sampler calls

    def prepare(self, session: Any) -> Steps:
        """Search for modes; yields as `Search.run`."""
        starts = draw_starts(self._target, self._starts, session.random)
        yield from self._search(starts, session)
        archive = self._target.archive
        if self.search.finished and len(archive.numbers) == 0:
            reasons = most_common_reasons(self._target.posterior.report()["failure_reasons"])
            raise RuntimeError(f"all simulations of the search failed (see report()): {reasons}")
        if len(archive.numbers) > 1 and not np.ptp(archive.statistics, axis=0).any():
            raise ValueError(
                f"expected responses that depend on the parameters; all {len(archive.numbers)} simulations of the "
                f"search gave the same one. Check where the model reads {', '.join(self._target.data.parameter_names)} "
                "and whether an old file of results is read"
            )
        self._emulate(session.random)

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Independent draws (n, ndim) of the parameters, inside the support of the prior."""
        shares, draws, _ = zip(*self._parts(), strict=True)
        drawn = [draw(k, random) for draw, k in zip(draws, random.multinomial(n, shares), strict=True)]
        return self._target.parameters(random.permutation(np.concatenate(drawn)))

    def log_density(self, parameters: np.ndarray) -> np.ndarray:
        """Normalised log-density (n,) of the draws at parameters (n, ndim)."""
        return self._target.density_of_parameters(self._log_density, parameters)

    def frozen(self) -> Callable[[np.ndarray], np.ndarray]:
        """`log_density` as it is now: what it depends on is replaced when the guide learns, not changed."""
        return copy.copy(self).log_density

    def observe(self, parameters: np.ndarray, session: Any) -> None:
        """Simulate the responses of points (n, ndim) that are evaluated next, or take cached ones, and keep them."""
        d = self._target.n_structural
        at_once(self._target.run(self._target.coordinates(parameters)[:, :d], session.remember, parameters[:, :d]))

    def refine(self, parameters: np.ndarray, log_prob: np.ndarray, session: Any) -> Steps:
        """Learn from evaluated points (n, ndim): new emulators, and where an ascent ended below its top and a point is
        far above, the top that an ascent from there leads to.
        """
        coords, volume = self._target.with_volume(parameters)
        heights, modes = np.where(np.isfinite(log_prob), log_prob - volume, -np.inf), self.search.modes
        top = max((mode.log_density for mode in modes), default=np.inf)
        self._excess = max(self._excess, float(heights.max()) - top)
        if check_tops(self._excess) and not all(mode.converged for mode in modes):
            yield from self._search(coords[[np.argmax(heights)], : self._target.n_structural], session, LOOSEST)
        self._emulate(session.random)

    # ------------------------------------------------------------------ parts

    def _search(self, starts: np.ndarray, session: Any, tolerance: float = TOLERANCE) -> Steps:
        """Search from starts (n, n_structural), see `Search`, or go on where an earlier search ended below its top."""
        searching = self._searching = Search(self._target, starts, session, tolerance)
        try:
            found = yield from searching.run(min(self._starts, len(starts)))
        finally:  # also one that raised an error is counted; none is kept, since its session cannot be pickled
            self._spent, self._searching = self.simulations, None
        if (earlier := self.search) is not None:
            if not found.modes:
                return
            led = [-1 if mode.converged else 0 for mode in earlier.modes] + [-1]
            ends = tuple(led[end] for end in earlier.ends)
            found, self._excess = found._replace(ends=ends, grown=earlier.grown, simulations=self._spent), -np.inf
        self.search = found
        self._regions = [Region(mode.coords, mode.covariance, None, mode.log_evidence) for mode in found.modes]

    def _emulate(self, random: np.random.RandomState) -> None:
        """Fit emulators to all runs, and the emulated posterior; the earlier ones stay if runs do not span a region."""
        if not self._regions:
            return
        try:
            regions = [self._fit_region(k) for k in range(len(self._regions))]
            self._emulated = EmulatedPosterior(self._target, regions, random)
            self._regions, self.known_density = self._emulated.regions, self._emulated.known_density
        except np.linalg.LinAlgError as error:
            logger.info("no emulators could be fitted, or no draws of them made: %s", error)
        self._wide = around(self._regions, _WIDENED, DOF)

    def _fit_region(self, k: int) -> Region:
        """A region with an emulator of its nearest runs."""
        target, region, mode = self._target, self._regions[k], self.search.modes[k]
        d, archive = target.n_structural, target.archive
        coords, noise = archive.coords, np.repeat(mode.coords[None, d:], len(archive.numbers), axis=0)
        density = target.log_likelihood(archive.statistics, noise) + target.log_prior(coords)
        inverses = [np.linalg.inv(each.covariance[:d, :d]) for each in self._regions]
        apart = [coords - each.centre[:d] for each in self._regions]
        distances = [np.einsum("ni,ij,nj->n", *each) for each in zip(apart, inverses, apart, strict=True)]
        rows = np.flatnonzero(np.argmin(distances, axis=0) == k)
        rows = rows[np.argsort(-density[rows])]
        rows = rows[density[rows] > density[rows].max(initial=-np.inf) - _DEPTH[0] - _DEPTH[1] * d][:_MOST_RUNS]
        if len(rows) < d + 4:
            raise np.linalg.LinAlgError(f"a mode has {len(rows)} runs")
        best = archive.statistics[rows[0]]
        slopes = target.slopes(best, target.fit_noise(best, mode.coords[d:]).coords)
        covariance = region.covariance[:d, :d]
        return region._replace(emulator=ResponseEmulator(target, rows, region.centre[:d], covariance, slopes))

    def _parts(self) -> list[tuple[float, Callable, Callable]]:
        """Shares of the draws, and functions of coordinates that they are from: draws and log-density."""
        wide = partial(draw, self._wide), partial(log_density, self._wide)
        if self._emulated is None:
            return [(1.0, *wide)]
        return [(_WIDE_SHARE, *wide), (1.0 - _WIDE_SHARE, self._emulated.draw, self._emulated.normalised)]

    def _log_density(self, coords: np.ndarray) -> np.ndarray:
        return np.logaddexp.reduce([np.log(share) + density(coords) for share, _, density in self._parts()])
