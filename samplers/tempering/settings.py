"""How a ladder is climbed: the settings shared by the tempered samplers, checked when they are made."""

from collections.abc import Callable
from dataclasses import dataclass

from .resampling import RESAMPLING

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """How the ladder is climbed.

    Attributes
    ----------
    ess_ratio : float — the effective sample size wanted of each stage, as a share: of the number of walkers
        (`ess_rule` "constant") or of the last stage's target ("declining"), 0 < ess_ratio < 1.
    ess_rule : "constant" or "declining".
    ess_floor : float — the declining target stops there.
    resampling : name of a scheme in `samplers.tempering.resampling`, or a function of (weights, random) that returns indices.
    min_moves, max_moves : int — sweeps of the ensemble a stage; equal for a fixed number.
    max_correlation : float — between the two, moving stops once the correlation of every parameter and of the
        log-likelihood with the resampled start is below this, or falls no further.
    chains : "equal", every resampled point is moved as long as the others, or "leaders", a chain grows from each
        distinct one, as many steps as it was drawn (then the number of moves is `burn_in` + 1).
    burn_in : int — steps of a chain before its points count, with "leaders".
    fast_sweeps : int — sweeps after every move over the parameters whose change costs no simulation, where
        `log_prob_fn` has an attribute ``fast_parameters`` with their indices (`samplers.moves.fast_parameters`); 0 for none.
    recycle : bool — climb by importance sampling over every point evaluated (`samplers.tempering.adaptive_importance`), and by moves only
        where that may not be trusted.
    check_draws : int, optional — evaluations spent at the end on an evidence independent of the ladder; by default as
        many as there are walkers, none with 0.
    max_failure_share : float — the run stops with an error once more than this share of the evaluations failed (by an
        exception or by NaN; a returned -inf is no failure); 0 stops at the first one.
    """

    ess_ratio: float = 0.5
    ess_rule: str = "constant"
    ess_floor: float = 0.0
    resampling: str | Callable = "systematic"
    min_moves: int = 2
    max_moves: int = 7
    max_correlation: float = 0.15
    chains: str = "equal"
    burn_in: int = 0
    fast_sweeps: int = 2
    recycle: bool = False
    check_draws: int | None = None
    max_failure_share: float = 0.5

    def __post_init__(self):
        if not 0.0 < self.ess_ratio < 1.0:
            raise ValueError(f"ess_ratio must lie between 0 and 1 (both excluded); got {self.ess_ratio}")
        if self.ess_rule not in ("constant", "declining"):
            raise ValueError(f'ess_rule must be "constant" or "declining"; got {self.ess_rule!r}')
        if not self.ess_floor >= 0.0:
            raise ValueError(f"ess_floor must not be negative; got {self.ess_floor}")
        if not callable(self.resampling) and self.resampling not in RESAMPLING:
            raise ValueError(f"resampling must be a function or one of {sorted(RESAMPLING)}; got {self.resampling!r}")
        if not 1 <= self.min_moves <= self.max_moves:
            raise ValueError(f"1 <= min_moves <= max_moves is needed; got {self.min_moves} and {self.max_moves}")
        if not 0.0 < self.max_correlation <= 1.0:
            raise ValueError(f"max_correlation must lie in (0, 1]; got {self.max_correlation}")
        if self.chains not in ("equal", "leaders"):
            raise ValueError(f'chains must be "equal" or "leaders"; got {self.chains!r}')
        if not self.burn_in >= 0:
            raise ValueError(f"burn_in must not be negative; got {self.burn_in}")
        if not isinstance(self.fast_sweeps, int) or self.fast_sweeps < 0:
            raise ValueError(f"fast_sweeps must be a whole number, 0 for none; got {self.fast_sweeps!r}")
        if self.check_draws is not None and not self.check_draws >= 0:
            raise ValueError(f"check_draws must not be negative; got {self.check_draws}")
        if not 0.0 <= self.max_failure_share <= 1.0:
            raise ValueError(f"max_failure_share must lie in [0, 1]; got {self.max_failure_share}")

    @property
    def resample(self) -> Callable:
        """The resampling scheme itself."""
        return self.resampling if callable(self.resampling) else RESAMPLING[self.resampling]

    def target(self, last_target: float, n_walkers: int) -> float:
        """Effective sample size wanted of a stage, from that of the stage before (n_walkers before the first)."""
        base = n_walkers if self.ess_rule == "constant" else last_target
        return max(self.ess_ratio * base, self.ess_floor)
