"""A guide to the posterior: draws near it, and their density, from few simulations.

`ResponseGuide` has the methods that a sampler of the package `samplers` expects of a guide. Its draws come from

    q = (1 - a - b - c) q_e + a q_t + b prior + c q_w,

the emulated posterior q_e (`fe_likelihoods.emulation.density`), a wide t mixture q_t around the modes, and the prior.
q_t and the prior bound the weights posterior / q where the emulator is wrong or does not reach. Before there are enough
runs for an emulator, q_e is absent. Every simulation, including the search for modes, trains the emulators. Where the
response has jumps, no smooth emulator describes it: after a round with uneven weights, a share c comes from a mixture
q_w fitted to all weighted draws.

The equations are on the page ``docs/theory/guided.rst``.
"""

import copy
import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from samplers.estimates.importance import KnownDensity
from samplers.estimates.weights import effective_sample_size, normalised_weights
from samplers.finding import Finding
from samplers.judgement.guides import (
    check_draws_in_memory,
    check_ends,
    check_excluded_runs,
    check_tops,
    check_unseen_modes,
    find_missing_part,
)
from samplers.proposals.mixture import Mixture, draw, fit_mixture, log_density

from .density import EmulatedPosterior, Region, factor_of, student_mixture, tempered
from .emulator import ResponseEmulator, TrainingSet, fit_emulator
from .modes import (
    MOST_STARTS,
    ModeSearch,
    check_starts,
    counted,
    draw_starts,
    ended,
    enough,
    search_modes,
    unseen_share,
)
from .target import SCALES, ResponseTarget, at_once

__all__ = ["ResponseGuide"]

logger = logging.getLogger(__name__)

_WIDE_SHARE, _PRIOR_SHARE = 0.10, 0.05
_WIDE_SHARE_ALONE = 0.9  # before there is an emulator
# Share of a mixture fitted to all weighted draws, after a round with a smaller effective share than `_EVEN`, from twice
# `_ENOUGH` draws per dimension on. For a cyclic test whose response has jumps, draws of a mixture fitted to 600 draws
# of the posterior have an effective share of .31, and draws of emulators of .05 to .16.
_FITTED_SHARE, _EVEN, _ENOUGH = 0.4, 0.5, 6.0
_WIDE_FREEDOM = 5.0
_WIDENED = 1.5  # variances of the wide components, as multiples of their regions' variances
_SHARE_OF_MODES = 0.25  # of the wide mixture around the modes that were found, the rest around the emulated means
_SMALLEST_WEIGHT = 0.1  # of a component of the wide mixture, over their number
_FEWEST_CACHED = 10_000  # simulations that the likelihood must cache in memory
_FEWEST_RUNS = 1.0, 4.0  # training runs that an emulator needs: per dimension, and in addition
_MOST_RUNS = 300
_WITHIN = 36.0  # squared Mahalanobis distance per dimension within which runs train the emulator of a region
_DEPTH = 40.0, 8.0  # log-density below the best within which runs train an emulator: constant, per dimension
_ALWAYS = 5  # best runs per dimension that train in any case
_LARGE = 10.0  # error of an emulated log-likelihood, beyond which its size does not matter
_CLEARLY = 0.75  # ratio of such errors at which the emulators take a function of the parameters


class ResponseGuide:
    """Draws near the posterior of a likelihood whose responses are known.

    Made by `Posterior.guide`.

    Parameters
    ----------
    posterior : Posterior
        Its noise must use statistics that are quadratic in the residuals.
    starts : int
        Starts of the search for modes that shall lead to one: the median of the prior, and draws of it.

    Attributes
    ----------
    search : ModeSearch, optional
        Result of the search for modes; None before it.
    simulations : float
        Simulations run by the guide itself, parts of a record counted as fractions; a call of the model's ``jacobian``
        counts as one.

    Examples
    --------
    >>> guide = posterior.guide(starts=6)
    >>> guided = SMCSampler(40, posterior.ndim, posterior, vectorize=True, guide=guide, seed=1)
    """

    # a response does not depend on how long its simulation takes
    learns_from_parts = True

    def __init__(self, posterior: Any, starts: int = 6) -> None:
        starts = check_starts(starts)
        fewest = min(part.simulator.memory_cache.most for part, _ in posterior.likelihood.parts())
        if fewest < _FEWEST_CACHED:
            raise ValueError(
                f"a guide needs a likelihood with memory_rows of {_FEWEST_CACHED} or more, so that no simulation is "
                f"run twice; got {fewest}"
            )
        self._target = ResponseTarget(posterior)
        self._posterior, self._starts = posterior, starts
        self.search: ModeSearch | None = None
        self.simulations, self.highest = 0.0, -np.inf  # the highest log-density of a draw
        self._regions: list[Region] = []
        self._emulated: EmulatedPosterior | None = None
        self._wide: Mixture | None = None
        self._fitted: Mixture | None = None  # to weighted draws

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
        derivatives = ", derivatives" if self._target.differentiable else ""
        return f"{type(self).__name__}({self._posterior.fingerprint}, starts={self._starts}{derivatives})"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Why parts of the posterior may be missing."""
        search = self.search
        if search is None:
            return ()
        if not search.finished:
            found = [find_missing_part("the budget ended the search for modes")]
        elif not search.modes:
            found = [find_missing_part("no start of the search led to a mode: the simulations of all starts fail")]
        elif not all(mode.converged for mode in search.modes):
            found = [find_missing_part("the search for modes ended before the top of a mode")]
        else:
            found = []
        if len(search.modes) > 1:
            found += check_unseen_modes(unseen_share(search), ended(search), len(search.modes))
        else:
            made = len(search.ends)
            wanted = enough(search, self._starts) if made < MOST_STARTS * self._starts else self._starts
            found += check_ends(ended(search), made, wanted, search.grown)
        found += check_tops(self.highest - max((mode.log_density for mode in search.modes), default=np.inf))
        if self._emulated is not None:
            found += check_draws_in_memory(self._emulated.largest_weight)
            found += check_excluded_runs(*self._emulated.of_runs)
        return tuple(found)

    @property
    def basis(self) -> str:
        """What a verdict without such findings rests on."""
        if self.search is None or not self.search.modes:
            return ""
        n, modes = ended(self.search), len(self.search.modes)
        missed = 1.0 - 0.05 ** (1.0 / n)
        return (
            f"{n} starts led to {modes} mode{'s' if modes > 1 else ''}; with 95 % probability, they would have found "
            f"any mode to which more than {100.0 * missed:.0f} % of such starts lead"
        )

    @property
    def emulators(self) -> tuple[ResponseEmulator, ...]:
        """Emulators in use, one per mode."""
        return tuple(region.emulator for region in self._regions if region.emulator is not None)

    @property
    def known_density(self) -> KnownDensity | None:
        """The emulated posterior, whose expectations cost no simulation; None before there is an emulator."""
        return None if self._emulated is None else self._emulated.known_density

    # ------------------------------------------------------------------ what a sampler calls

    def prepare(self, session: Any) -> Iterator[None]:
        """Search for modes; yields as `search_modes`."""
        starts = draw_starts(self._target, self._starts, session.random)
        search = search_modes(self._target, starts, session.remember, session.fits, self._starts, session.remaining)
        self.search = yield from counted(search, self._spend)
        modes = self.search.modes
        self._regions = [Region(mode.coords, mode.covariance, None, mode.log_evidence) for mode in modes]
        if modes:
            self._wide = self._wide_mixture()
        archive = self._target.archive
        runs = archive.numbers
        if len(runs) > 1 and all(np.array_equal(*map(archive.residuals, (runs[0], other))) for other in runs):
            raise ValueError(
                f"expected responses that depend on the parameters; all {len(runs)} simulations of the search "
                f"gave the same one. Check where the model reads {', '.join(self._target.model.parameter_names)}, "
                "and whether an old file of results is read"
            )
        self._emulate(session.random)

    def evaluation_queue(self) -> Any:
        """The queue of the posterior, which keeps the responses for `observe`."""
        return self._posterior.evaluation_queue(responses=True)

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Independent draws (n, ndim) of the parameters, inside the support of the prior."""
        emulated, prior, *shares = self._shares()
        # as many draws of each part as its share says, rounded at random: fewer chance differences than by lot
        ends = np.floor(n * np.cumsum([0.0, emulated, *shares, prior]) + random.random_sample()).astype(int)
        parts = np.diff(np.minimum(ends, n + ends[0]))
        coords = [random.standard_normal((parts[-1], self._target.ndim))]
        for mixture, count in zip((self._wide, self._fitted), parts[1:-1], strict=True):
            if count:
                coords.append(draw(mixture, count, random))
        if parts[0]:
            coords.append(self._emulated.draw(parts[0], random))
        return self._target.parameters(random.permutation(np.concatenate(coords)))

    def log_density(self, parameters: np.ndarray) -> np.ndarray:
        """Normalised log-density (n,) of the draws at parameters (n, ndim)."""
        return self._target.density_of_parameters(self._log_density, parameters)

    def frozen(self) -> Callable[[np.ndarray], np.ndarray]:
        """`log_density` as it is now: what it depends on is replaced when the guide learns, not changed."""
        return copy.copy(self).log_density

    def observe(self, parameters: np.ndarray, session: Any) -> None:
        """Simulate the responses of points (n, ndim) that are evaluated next, or take cached ones, and keep them."""
        structural = parameters[:, : self._target.n_structural]
        coords = self._target.coordinates(parameters)[:, : self._target.n_structural]
        at_once(self._target.run(coords, session.remember, structural))

    def refine(self, parameters: np.ndarray, log_prob: np.ndarray, session: Any) -> None:
        """Learn from evaluated points (n, ndim): new emulators."""
        alive = np.isfinite(log_prob)
        coords = self._target.coordinates(parameters)
        heights = log_prob - self._posterior.log_prior(parameters) + self._target.log_prior(coords)
        self.highest = max(self.highest, float(np.max(heights[alive], initial=-np.inf)))
        latest = np.where(alive, np.where(alive, log_prob, 0.0) - self.log_density(parameters), -np.inf)
        drawn = session.weighted()
        fitted = None if drawn is None else self._fit_draws(latest, *drawn)
        self._emulate(session.random)
        self._fitted = fitted

    # ------------------------------------------------------------------ parts

    def _emulate(self, random: np.random.RandomState) -> None:
        """Fit emulators to all runs, and the emulated posterior."""
        self._fit_in_best_scale()
        ready = [region for region in self._regions if region.emulator is not None]
        if ready and len(ready) == len(self._regions):
            try:
                self._emulated = EmulatedPosterior(self._target, self._regions, random)
            except np.linalg.LinAlgError as error:
                logger.info("no draws of the emulated posterior could be made: %s", error)
                return
            self._regions = self._emulated.regions
            self._wide = self._wide_mixture()

    def _fit_in_best_scale(self) -> None:
        """Fit emulators; of logarithms or reciprocals if these predict left-out runs clearly better than parameters.

        A ridge of equal products is straight in logarithms, and flexibilities of springs add; other responses are often
        closer to linear in parameters. The few runs of a first fit cannot always tell: on a ridge that was emulated in
        parameters to the end, rounds grew along it by a part each, and 2 of 20 were wrong.
        """
        earlier, fits = (self._target, self._regions), []
        for scale in SCALES:
            self._target, self._regions = earlier[0].in_scale(scale), list(earlier[1])
            self._fit_emulators()
            if all(emulator.target is self._target for emulator in self.emulators):
                error = self._left_out_error() * (_CLEARLY if scale == SCALES[0] else 1.0)
                fits.append((error, self._target, self._regions))
        self._target, self._regions = min(fits, key=lambda fit: fit[0])[1:] if fits else earlier

    def _left_out_error(self) -> float:
        """Mean error of the log-likelihood of runs that the emulators were not fitted to, each at most `_LARGE`."""
        errors = []
        for region, mode in zip(self._regions, self.search.modes, strict=True):
            if region.emulator is not None:
                predicted, true = (
                    self._target.log_likelihood(
                        each, np.repeat(mode.coords[None, self._target.n_structural :], len(each), 0)
                    )
                    for each in region.emulator.left_out_statistics()
                )
                errors.append(np.minimum(np.abs(predicted - true), _LARGE).mean())
        return float(np.mean(errors)) if errors else np.inf

    def _spend(self, simulations: float) -> None:
        self.simulations += simulations

    def _shares(self) -> tuple[float, float, float, float]:
        """Shares of the emulated posterior, the prior, the wide mixture and the fitted one in the draws."""
        if self._wide is None:
            return 0.0, 1.0, 0.0, 0.0
        if self._emulated is None:
            return 0.0, 1.0 - _WIDE_SHARE_ALONE, _WIDE_SHARE_ALONE, 0.0
        fitted = 0.0 if self._fitted is None else _FITTED_SHARE
        return 1.0 - _WIDE_SHARE - _PRIOR_SHARE - fitted, _PRIOR_SHARE, _WIDE_SHARE, fitted

    def _log_density(self, coords: np.ndarray) -> np.ndarray:
        share, prior, *shares = self._shares()
        total = np.log(prior) + self._target.log_prior(coords)
        for mixture, part in zip((self._wide, self._fitted), shares, strict=True):
            if part > 0.0:
                total = np.logaddexp(total, np.log(part) + log_density(mixture, coords))
        if self._emulated is not None:
            emulated = self._emulated.log_density(coords) - self._emulated.log_evidence
            total = np.logaddexp(total, np.log(share) + emulated)
        return total

    def _fit_draws(self, latest: np.ndarray, parameters: np.ndarray, log_weights: np.ndarray) -> Mixture | None:
        """A wide mixture around weighted draws (n, ndim), if the log-weights (m,) of the latest ones are uneven."""
        enough = _ENOUGH * self._target.ndim
        if effective_sample_size(latest) >= _EVEN * len(latest) or len(log_weights) < 2.0 * enough:
            return None
        weights = normalised_weights(tempered(log_weights, enough))
        fitted = fit_mixture(self._target.coordinates(parameters), weights, len(self._regions))
        wider = np.sqrt(_WIDENED)
        return fitted._replace(roots=wider * fitted.roots, inverses=fitted.inverses / wider)

    def _wide_mixture(self) -> Mixture:
        shares = np.array([region.log_evidence for region in self._regions])
        weights = np.exp(shares - shares.max())
        weights = (1.0 - _SMALLEST_WEIGHT) * weights / weights.sum() + _SMALLEST_WEIGHT / len(weights)
        # the modes themselves as well: where an emulator is wrong, so are the moments that it gives
        centres = [*(region.centre for region in self._regions), *(mode.coords for mode in self.search.modes)]
        covariances = [
            *(region.covariance for region in self._regions),
            *(mode.covariance for mode in self.search.modes),
        ]
        factors = [factor_of(_WIDENED * covariance) for covariance in covariances]
        weights = np.concatenate([(1.0 - _SHARE_OF_MODES) * weights, _SHARE_OF_MODES * weights])
        return student_mixture(weights, centres, factors, _WIDE_FREEDOM)

    def _distances(self, coords: np.ndarray) -> np.ndarray:
        """Squared Mahalanobis distances (n_regions, n) of structural coordinates (n, d)."""
        d = self._target.n_structural
        rows = []
        for region in self._regions:
            inverse = np.linalg.inv(np.linalg.cholesky(region.covariance[:d, :d]))
            rows.append(np.square((coords - region.centre[:d]) @ inverse.T).sum(axis=1))
        return np.array(rows)

    def _fit_emulators(self) -> None:
        archive, d = self._target.archive, self._target.n_structural
        if not self._regions or not len(archive):
            return
        coords, statistics = archive.coords, archive.statistics
        distances = self._distances(coords)
        nearest = np.argmin(distances, axis=0)
        for k, region in enumerate(self._regions):
            rows = np.flatnonzero((nearest == k) & (distances[k] < _WITHIN * d))
            if len(rows) < _FEWEST_RUNS[0] * d + _FEWEST_RUNS[1]:
                continue
            noise = self.search.modes[k].coords[d:]
            density = self._target.log_likelihood(statistics[rows], np.repeat(noise[None], len(rows), axis=0))
            density = density + self._target.log_prior(coords[rows])
            best = rows[np.argmax(density)]
            # runs where the last emulator was wrong as well: left out, it would be wrong there again
            expected = (
                density if region.emulator is None else np.fmax(density, self._expected(region, coords[rows], noise))
            )
            order = np.argsort(-expected)
            good = expected[order] > density.max() - _DEPTH[0] - _DEPTH[1] * d
            good[: _ALWAYS * d] = True
            rows = rows[order[good][:_MOST_RUNS]]
            if len(rows) < _FEWEST_RUNS[0] * d + _FEWEST_RUNS[1]:
                continue
            residuals = archive.residuals(archive.numbers[best]).astype(float)
            scales = np.sqrt(np.square(residuals).mean(axis=1)) + 1e-12 * np.abs(self._target.measured).max(axis=1)
            training = TrainingSet(coords[rows], archive.numbers[rows])
            slopes = self._target.slopes(statistics[best], self._target.fit_noise(statistics[best], noise).coords)
            centre, covariance = region.centre[:d], region.covariance[:d, :d]
            try:
                emulator = fit_emulator(self._target, training, centre, covariance, scales, slopes, region.emulator)
            except np.linalg.LinAlgError as error:  # runs that do not span the parameters: the earlier fit stays
                logger.info("no emulator could be fitted to %d runs: %s", len(rows), error)
                continue
            self._regions[k] = region._replace(emulator=emulator)

    def _expected(self, region: Region, coords: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Log-density (n,) at structural coordinates (n, d) by the emulator of a region."""
        full = np.column_stack([coords, np.repeat(noise[None], len(coords), axis=0)])
        scaled = region.emulator.target.scaled(full)
        return region.emulator.log_likelihood(scaled) + self._target.log_prior(coords)
