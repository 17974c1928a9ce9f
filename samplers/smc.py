"""Sequential Monte Carlo behind emcee's interface.

Del Moral, Doucet & Jasra (2006), doi:10.1111/j.1467-9868.2006.00553.x, with the adaptation usual since: the next
exponent by the effective sample size, resampling at every stage, proposals fitted to the weighted population, and as
many moves as it takes to forget the resampled start. The settings of papers are in `samplers.presets`.

Tempering has a limit that no setting lifts: of several modes of like mass, one much narrower than the others has hardly
any mass on the lower rungs, and is lost unless draws of the prior happen to meet it (Woodard, Schmidler & Huber 2009,
doi:10.1214/EJP.v14-638). Where such modes are possible, compare runs with more walkers.
"""

from collections.abc import Callable

from .moves.kernels import MixtureMove
from .tempered import TemperedSampler
from .tempering.settings import Settings

__all__ = ["SMCSampler"]

FEWEST_TO_RECYCLE = 250


class SMCSampler(TemperedSampler):
    """Sequential Monte Carlo sampler.

    >>> sampler = SMCSampler(500, posterior.ndim, posterior, vectorize=True)
    >>> sampler.run_mcmc(None, 10)
    >>> sampler.get_chain(flat=True), sampler.log_evidence, sampler.log_evidence_error

    Parameters
    ----------
    nwalkers ... parameter_names : as in `emcee.EnsembleSampler`, in its order. Without `moves`, those of
        `samplers.moves.kernels.MixtureMove`: three kernels from a mixture fitted to every stage.
    log_prior_fn, seed : as in `TemperedSampler`.
    coarse_log_prob_fn : callable, optional — a cheaper `log_prob_fn` to climb on first, such as ``posterior.coarse``
        (None: there is none). The answer is that of `log_prob_fn`; a `SamplingWarning` tells where it was no help.
    recycle : bool, optional — climb by recycling every evaluated point (`samplers.tempering.adaptive_importance`), and by moves where that
        may not be trusted. By default yes with 250 walkers or more and no `moves` given: with fewer, a mode can be lost
        unnoticed, and the fall back on moves is likely.
    ess_ratio, ess_rule, ess_floor, resampling, min_moves, max_moves, max_correlation : as in
        `samplers.tempering.settings.Settings`, for a climb by moves.
    fast_sweeps, check_draws, max_failure_share : as there.
    """

    def __init__(
        self,
        nwalkers,
        ndim,
        log_prob_fn,
        pool=None,
        moves=None,
        args=None,
        kwargs=None,
        backend=None,
        vectorize=False,
        blobs_dtype=None,
        parameter_names=None,
        *,
        log_prior_fn: Callable | None = None,
        coarse_log_prob_fn: Callable | None = None,
        seed: int | None = None,
        ess_ratio: float = 0.5,
        ess_rule: str = "constant",
        ess_floor: float = 0.0,
        resampling: str | Callable = "systematic",
        min_moves: int = 2,
        max_moves: int = 7,
        max_correlation: float = 0.15,
        fast_sweeps: int = 2,
        recycle: bool | None = None,
        check_draws: int | None = None,
        max_failure_share: float = 0.5,
    ):
        if recycle is None:
            recycle = moves is None and nwalkers >= FEWEST_TO_RECYCLE
        if moves is None:
            moves = MixtureMove()
        super().__init__(
            nwalkers,
            ndim,
            log_prob_fn,
            pool=pool,
            moves=moves,
            args=args,
            kwargs=kwargs,
            backend=backend,
            vectorize=vectorize,
            blobs_dtype=blobs_dtype,
            parameter_names=parameter_names,
            log_prior_fn=log_prior_fn,
            coarse_log_prob_fn=coarse_log_prob_fn,
            seed=seed,
            settings=Settings(
                ess_ratio=ess_ratio,
                ess_rule=ess_rule,
                ess_floor=ess_floor,
                resampling=resampling,
                min_moves=min_moves,
                max_moves=max_moves,
                max_correlation=max_correlation,
                fast_sweeps=fast_sweeps,
                recycle=recycle,
                check_draws=check_draws,
                max_failure_share=max_failure_share,
            ),
        )
