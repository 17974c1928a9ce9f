"""Settings of the annealing from the prior to the posterior, checked when they are made.

Every default is written here, once. A setting that cannot act on the chosen path is refused (`refuse_unused`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any

import numpy as np

from .resampling import RESAMPLING

__all__ = [
    "GuidedSettings",
    "RecyclingSettings",
    "Settings",
    "as_whole_number",
    "changed_settings",
    "combine_settings",
    "refuse_unused",
]


def as_whole_number(name: str, value: Any) -> int:
    """A value as int: a NumPy integer is converted, so that it can be stored as JSON.

    Parameters
    ----------
    name : str
        What the value is called in the message.
    value : int or NumPy integer
        The value.

    Raises
    ------
    ValueError
        If the value is a bool or not of an integer type; 60.0 is refused too.
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{name} must be a whole number (int); got {value!r}")
    return int(value)


# Larger numbers of draws in one batch are a mistake: annealing by moves needs fewer evaluations.
MOST_SEARCH_DRAWS = 1000.0


@dataclass(frozen=True)
class RecyclingSettings:
    """Constants of adaptive importance sampling (`samplers.tempering.adaptive_importance`).

    The *target* is the effective sample size wanted at each beta: ``max(target_share * n, points_per_dimension *
    (ndim + 1))`` for annealing that starts from n points. The *yield* of a round is the effective sample size of its
    fresh draws divided by their number. Values without a reference are our choice, from trials on posteriors with
    known answers.

    Attributes
    ----------
    target_share : float
        Target as a share of the number of starting points. A small target allows large steps of beta; the fresh draws
        of a round then restore the effective sample size.
    points_per_dimension : float
        Smallest target per dimension (and one more). With fewer than five effective points per dimension, the
        covariances of the fitted mixture cannot be estimated.
    draws_per_target : float
        Draws of a round, as a multiple of the target.
    search_draws : float
        Further draws, as a multiple of the number of starting points, spread evenly over the stages below beta = 1. A
        narrow mode that holds one point in a thousand while beta is small is found only if a draw meets it: of modes
        with a ratio of volumes of 100, 500 starting points and no such draws miss one in 30 % of the runs; with them,
        in 6 %. Steps of beta do not become larger by them. Only annealing from the prior makes them.
    fresh_share : float
        A beta is left once the draws made at it have an effective sample size of this share of the target. Among many
        old points some have large weights by chance; where the likelihood is rough, annealing that follows these points
        ends in a local mode.
    max_components : int
        Largest number of components of a proposal.
    even_share : float
        Share of a proposal's weight that is spread evenly over its components, so that a component of small weight
        receives draws too.
    max_basins : int
        Largest number of components that are added to a proposal for parts of the target that it does not explain
        (`samplers.proposals.basins`); 0 for none. They keep narrow modes, which have little mass at small beta.
    basin_share : float
        Smallest share of the draws for such a component.
    max_basin_rounds, draws_per_basin : int
        Before the check at beta = 1, parts of the target that the last fit does not explain are explored, this many
        times at most, with this number of draws for each of them.
    min_yield : float
        Recycling is given up when the mean yield of the last `patience` rounds is smaller. Moves then need fewer
        evaluations.
    patience : int
        Number of rounds over which the yield is averaged for `min_yield`.
    max_rounds : int
        Recycling is given up after this number of rounds without a check at beta = 1.
    max_checks : int
        Largest number of checks with fresh draws at beta = 1. Draws that contradict a fit also improve it, so a failed
        check is repeated.
    trusted_yield : float
        Smallest yield of the check for which the result is used.
    high_yield : float
        Yield of the check at which the Pareto shape of its weights is no longer required to be below 0.7 (Vehtari et
        al. 2024, JMLR 25(72)): the weights are even, and the shape of so short a tail is uncertain.
    max_evidence_difference : float
        Largest difference between the log-evidence of the check and that of the earlier points for which the result
        is used.
    closing_sweeps : bool
        Move the resampled draws of beta = 1 by `min_moves` to `max_moves` sweeps in any case. By default they are moved
        only where less than 90 % of the resampled points are distinct, or where the proposal describes the posterior
        poorly (`samplers.tempering.diagnostics.fits_poorly`): else they are independent draws already.
    """

    target_share: float = 0.2
    points_per_dimension: float = 5.0
    draws_per_target: float = 3.0
    search_draws: float = 3.0
    fresh_share: float = 0.75
    max_components: int = 8
    even_share: float = 0.25
    max_basins: int = 3
    basin_share: float = 0.1
    max_basin_rounds: int = 4
    draws_per_basin: int = 30
    min_yield: float = 0.03
    patience: int = 6
    max_rounds: int = 200
    max_checks: int = 4
    trusted_yield: float = 0.25
    high_yield: float = 0.5
    max_evidence_difference: float = 0.25
    closing_sweeps: bool = False

    def __post_init__(self):
        for name in ("target_share", "fresh_share"):
            value = vars(self)[name]
            if not 0.0 < value <= 1.0:
                raise ValueError(f"{name} must lie in (0, 1]; got {value}")
        for name in ("even_share", "basin_share", "min_yield", "trusted_yield", "high_yield"):
            value = vars(self)[name]
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1]; got {value}")
        for name in ("max_components", "patience", "max_rounds", "max_checks", "draws_per_basin"):
            value = as_whole_number(name, vars(self)[name])
            if value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1; got {value}")
            object.__setattr__(self, name, value)
        for name in ("max_basins", "max_basin_rounds"):
            value = as_whole_number(name, vars(self)[name])
            if value < 0:
                raise ValueError(f"{name} must be a whole number, 0 for none; got {value}")
            object.__setattr__(self, name, value)
        if not isinstance(self.closing_sweeps, bool | np.bool_):
            raise ValueError(f"closing_sweeps must be True or False; got {self.closing_sweeps!r}")
        object.__setattr__(self, "closing_sweeps", bool(self.closing_sweeps))
        if not self.draws_per_target > 0.0:
            raise ValueError(f"draws_per_target must be positive; got {self.draws_per_target}")
        if not isinstance(self.search_draws, Real) or not 0.0 <= self.search_draws <= MOST_SEARCH_DRAWS:
            raise ValueError(
                f"search_draws is a multiple of the number of walkers from 0 to {MOST_SEARCH_DRAWS:g}; got "
                f"{self.search_draws!r}"
            )
        if not self.points_per_dimension > 0.0:
            raise ValueError(f"points_per_dimension must be positive; got {self.points_per_dimension}")
        if not self.max_evidence_difference >= 0.0:
            raise ValueError(f"max_evidence_difference must not be negative; got {self.max_evidence_difference}")


@dataclass(frozen=True)
class GuidedSettings:
    """Constants of the rounds of a guide (`samplers.tempering.guided`).

    The *effective share* of a round is the effective sample size of its weights divided by the number of its draws.
    Values without a reference are our choice, from trials on posteriors with known answers.

    Attributes
    ----------
    first_round_share : float
        Draws of the first round, as a share of the number of walkers: few, since the guide may still be poor.
    round_share : float
        Draws of each later round, as a share of the number of walkers. After a trusted round, a round has as many draws
        as are expected to suffice.
    fewest_draws : int
        Smallest number of draws of a round. The Pareto shape cannot be estimated from fewer than 25.
    trusted_share : float
        Smallest effective share of a round that is trusted.
    largest_pareto_shape : float
        The Pareto shape of the weights of a trusted round is below this value: then their variance is finite.
    short_tail_share : float
        Effective share at which a round of fewer than 100 draws is trusted whatever its Pareto shape, which is
        uncertain for so few draws.
    most_rounds : int
        Largest number of rounds.
    hopeless_rounds : int
        The guide is given up when the mean effective share of this number of rounds is below `hopeless_share`.
    hopeless_share : float
        See `hopeless_rounds`.
    usable_share : float
        After the last round, the draws are used in spite of rounds that were not trusted if the last round has at least
        this effective share, all rounds together have an effective sample size of the number of walkers, and the Pareto
        shape of their weights is below 0.7 (Vehtari et al. 2024, JMLR 25(72)).
    """

    first_round_share: float = 0.3
    round_share: float = 0.6
    fewest_draws: int = 25
    trusted_share: float = 0.5
    largest_pareto_shape: float = 0.5
    short_tail_share: float = 0.75
    most_rounds: int = 20
    hopeless_rounds: int = 4
    hopeless_share: float = 0.03
    usable_share: float = 0.1

    def __post_init__(self):
        for name in ("first_round_share", "round_share", "trusted_share", "short_tail_share", "usable_share"):
            if not 0.0 < vars(self)[name] <= 1.0:
                raise ValueError(f"{name} must lie in (0, 1]; got {vars(self)[name]}")
        for name in ("fewest_draws", "most_rounds", "hopeless_rounds"):
            value = as_whole_number(name, vars(self)[name])
            if value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1; got {value}")
            object.__setattr__(self, name, value)
        if not 0.0 <= self.hopeless_share <= 1.0:
            raise ValueError(f"hopeless_share must lie in [0, 1]; got {self.hopeless_share}")
        if not 0.0 < self.largest_pareto_shape <= 0.7:
            raise ValueError(
                f"largest_pareto_shape must lie in (0, 0.7], since weights of a larger shape have no useful mean; got "
                f"{self.largest_pareto_shape}"
            )


@dataclass(frozen=True)
class Settings:
    """Settings of a tempered sampler.

    Attributes
    ----------
    ess_ratio : float
        Effective sample size wanted of each stage, as a share of the number of walkers (`ess_rule` "constant") or of
        the previous stage's target ("declining"); between 0 and 1.
    ess_rule : {"constant", "declining"}
        What `ess_ratio` refers to.
    ess_floor : float
        Lower limit of the declining target.
    coefficient_of_variation : float, optional
        Coefficient of variation wanted of the incremental weights of each stage. It takes the place of `ess_ratio`: n
        weights with this coefficient have an effective sample size of n / (1 + coefficient²).
    resampling : str or callable
        Name of a scheme in `samplers.tempering.resampling`, or a function of (weights, random) that returns indices.
    min_moves, max_moves : int
        Smallest and largest number of sweeps of the ensemble per stage; equal for a fixed number. With recycling, of
        the closing sweeps (`RecyclingSettings.closing_sweeps`).
    max_correlation : float
        Between these two numbers, moving stops once the correlation of every parameter and of the log-likelihood with
        their values after the resampling is below this value, or decreases no further.
    chains : {"equal", "leaders"}
        With "equal", every resampled point is moved equally often. With "leaders", a chain grows from each distinct
        resampled point, one step per copy of it; each point is then moved `burn_in` + 1 times.
    burn_in : int
        With "leaders", steps of a chain before its points count.
    fast_sweeps : int
        Sweeps over the fast parameters after every move, where `log_prob_fn` has an attribute ``fast_parameters``
        (`samplers.moves.fast_parameters`); 0 for none.
    recycle : bool, optional
        Anneal by adaptive importance sampling over all evaluated points (`samplers.tempering.adaptive_importance`), and
        by moves only where its result cannot be trusted. None leaves the choice to the sampler.
    recycling : RecyclingSettings
        Constants of the recycling.
    runs : int
        Number of runs of recycling from the same draws of the prior, whose points are used together at the end. A
        difference between them is reported: one of them has then lost a part of the posterior.
    guided : GuidedSettings
        Constants of the rounds of a guide.
    check_draws : int, optional
        Evaluations for an estimate of the evidence that is independent of the annealing. None: as many as there are
        walkers; 0: no such estimate.
    max_failure_share : float
        The run stops with an error when more than this share of the evaluations have failed by an exception or by NaN
        (a returned -inf is not a failure); 0 stops at the first failure.
    asynchronous : bool
        Whether points are evaluated without waiting for the slowest of each batch, for long runs of unequal length on
        many workers. Recycling, or a guide, then proposes the next points while the last ones run. The result depends
        on the order of arrival, in the choice of the proposals; every estimate is made of complete batches. Moves wait
        as before.
    """

    ess_ratio: float = 0.5
    ess_rule: str = "constant"
    ess_floor: float = 0.0
    coefficient_of_variation: float | None = None
    resampling: str | Callable = "systematic"
    min_moves: int = 2
    max_moves: int = 7
    max_correlation: float = 0.15
    chains: str = "equal"
    burn_in: int = 0
    fast_sweeps: int = 2
    recycle: bool | None = None
    recycling: RecyclingSettings = RecyclingSettings()
    runs: int = 1
    guided: GuidedSettings = GuidedSettings()
    check_draws: int | None = None
    max_failure_share: float = 0.5
    asynchronous: bool = False

    def __post_init__(self):
        if not isinstance(self.asynchronous, bool | np.bool_):
            raise ValueError(f"asynchronous must be True or False; got {self.asynchronous!r}")
        object.__setattr__(self, "asynchronous", bool(self.asynchronous))
        for name in ("min_moves", "max_moves", "burn_in", "fast_sweeps", "check_draws"):
            if name != "check_draws" or self.check_draws is not None:
                object.__setattr__(self, name, as_whole_number(name, vars(self)[name]))
        object.__setattr__(self, "runs", as_whole_number("runs", self.runs))
        if self.runs < 1:
            raise ValueError(f"runs must be a whole number of at least 1; got {self.runs}")
        if self.recycle is not None and not isinstance(self.recycle, bool | np.bool_):
            raise ValueError(f"recycle must be True, False or None; got {self.recycle!r}")
        object.__setattr__(self, "recycle", None if self.recycle is None else bool(self.recycle))
        if not 0.0 < self.ess_ratio < 1.0:
            raise ValueError(f"ess_ratio must lie between 0 and 1 (both excluded); got {self.ess_ratio}")
        if self.ess_rule not in ("constant", "declining"):
            raise ValueError(f'ess_rule must be "constant" or "declining"; got {self.ess_rule!r}')
        if not self.ess_floor >= 0.0:
            raise ValueError(f"ess_floor must not be negative; got {self.ess_floor}")
        variation = self.coefficient_of_variation
        if variation is not None and not 0.0 < variation < float("inf"):
            raise ValueError(f"coefficient_of_variation must be positive and finite; got {variation}")
        if not callable(self.resampling) and self.resampling not in RESAMPLING:
            raise ValueError(f"resampling must be a function or one of {sorted(RESAMPLING)}; got {self.resampling!r}")
        if not 1 <= self.min_moves <= self.max_moves:
            raise ValueError(f"1 <= min_moves <= max_moves is needed; got {self.min_moves} and {self.max_moves}")
        if not 0.0 < self.max_correlation <= 1.0:
            raise ValueError(f"max_correlation must lie in (0, 1]; got {self.max_correlation}")
        if self.chains not in ("equal", "leaders"):
            raise ValueError(f'chains must be "equal" or "leaders"; got {self.chains!r}')
        if self.burn_in < 0:
            raise ValueError(f"burn_in must not be negative; got {self.burn_in}")
        if self.fast_sweeps < 0:
            raise ValueError(f"fast_sweeps must be a whole number, 0 for none; got {self.fast_sweeps}")
        if not isinstance(self.recycling, RecyclingSettings):
            raise ValueError(f"recycling must be a RecyclingSettings; got {self.recycling!r}")
        if not isinstance(self.guided, GuidedSettings):
            raise ValueError(f"guided must be a GuidedSettings; got {self.guided!r}")
        if self.check_draws is not None and self.check_draws < 0:
            raise ValueError(f"check_draws must not be negative; got {self.check_draws}")
        if not 0.0 <= self.max_failure_share <= 1.0:
            raise ValueError(f"max_failure_share must lie in [0, 1]; got {self.max_failure_share}")

    @property
    def resample(self) -> Callable:
        """The resampling scheme."""
        return self.resampling if callable(self.resampling) else RESAMPLING[self.resampling]

    def target(self, last_target: float, n_walkers: int) -> float:
        """Effective sample size wanted of a stage, from that of the previous stage (n_walkers before the first)."""
        variation = self.coefficient_of_variation
        ratio = self.ess_ratio if variation is None else 1.0 / (1.0 + variation**2)
        return max(ratio * (n_walkers if self.ess_rule == "constant" else last_target), self.ess_floor)


def combine_settings(sampler: str, settings: Settings | None, overrides: Mapping[str, Any]) -> Settings:
    """Settings of which single ones are replaced.

    Parameters
    ----------
    sampler : str
        Name of the sampler's class in messages.
    settings : Settings, optional
        The settings; the defaults if None.
    overrides : mapping
        Single settings by name.

    Raises
    ------
    TypeError
        If a name is not a setting.
    ValueError
        If `settings` are not `Settings`, or a value is impossible.
    """
    if settings is not None and not isinstance(settings, Settings):
        raise ValueError(f"settings must be a samplers.Settings; got {settings!r}")
    names = [field.name for field in fields(Settings)]
    unknown = set(overrides) - set(names)
    if unknown:
        raise TypeError(
            f"{sampler}() got an unexpected keyword argument {min(unknown)!r}; settings are {', '.join(names)}"
        )
    return replace(Settings() if settings is None else settings, **overrides)


def changed_settings(settings: Settings) -> tuple[str, ...]:
    """Names of the settings that differ from their defaults."""
    return tuple(field.name for field in fields(settings) if vars(settings)[field.name] != field.default)


def refuse_unused(
    settings: Settings, recycles: bool, fast_sweeps_act: bool, unused: Mapping[str, str], guided: bool = False
) -> None:
    """Raise an error for a setting that differs from its default but cannot act on the chosen path.

    With recycling, the settings that only its fallback on moves would use are refused as well: a run should not depend
    on them by accident.

    Parameters
    ----------
    settings : Settings
        As the user gave them.
    recycles : bool
        Whether the annealing is by recycling.
    fast_sweeps_act : bool
        Whether there are fast parameters to sweep over.
    unused : mapping of str to str
        Names of settings that the sampler never uses, with what to do.
    guided : bool
        Whether there is a guide.

    Raises
    ------
    ValueError
        With the name of the setting, why it cannot act, and what to do.
    """
    reasons = dict(unused)
    if settings.ess_rule == "constant":
        reasons.setdefault("ess_floor", 'it is the lower limit of a declining target: pass ess_rule="declining" too')
    if settings.coefficient_of_variation is not None:
        reasons.setdefault("ess_ratio", "coefficient_of_variation takes its place: pass one of them")
    if settings.chains == "equal":
        reasons.setdefault("burn_in", 'it belongs to chains="leaders"')
    else:
        for name in ("min_moves", "max_moves", "max_correlation"):
            reasons.setdefault(name, 'with chains="leaders" each point is moved burn_in + 1 times: pass burn_in')
    if settings.min_moves == settings.max_moves:
        reasons.setdefault("max_correlation", "min_moves and max_moves are equal, so it never decides")
    if settings.fast_sweeps > 0 and not fast_sweeps_act:
        reasons.setdefault(
            "fast_sweeps",
            "log_prob_fn has no fast_parameters beside slow ones, or a pool without vectorize=True evaluates it in "
            "workers that cache nothing",
        )
    if guided:
        reasons.pop("recycling", None)
        reasons["runs"] = "the runs begin with draws of the prior, not with those of a guide: pass one of them"
    else:
        reasons.setdefault("guided", "it belongs to a guide: pass guide= too")
    if recycles and not settings.recycling.closing_sweeps:
        for name in ("min_moves", "max_moves", "max_correlation", "burn_in"):
            reasons.setdefault(
                name,
                "the draws of recycling are moved only where too many of them are copies: pass "
                "recycling=RecyclingSettings(closing_sweeps=True), or recycle=False",
            )
    if recycles:
        for name in ("ess_ratio", "ess_rule", "ess_floor", "coefficient_of_variation", "resampling"):
            reasons.setdefault(
                name,
                "it belongs to annealing by moves, and recycling is on (the default of SMCSampler with 250 walkers or "
                "more and no moves given): pass recycle=False",
            )
        if settings.check_draws != 0:
            reasons.setdefault(
                "check_draws",
                "the check of recycling takes as many draws as there are walkers: pass 0 for none, or recycle=False",
            )
    elif not guided:
        reasons.setdefault("recycling", "the annealing is by moves: pass recycle=True")
        reasons.setdefault("runs", "it belongs to recycling, and the annealing is by moves: pass recycle=True")
    if not recycles and not guided:
        reasons["asynchronous"] = "moves wait for all points that they propose: pass recycle=True"
    for name in changed_settings(settings):
        if name in reasons:
            raise ValueError(f"{name}={vars(settings)[name]!r} cannot act here: {reasons[name]}")
