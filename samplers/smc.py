"""Sequential Monte Carlo behind emcee's interface.

Del Moral, Doucet & Jasra (2006), doi:10.1111/j.1467-9868.2006.00553.x, with the adaptation that has become usual: the
next exponent by the effective sample size, resampling at every stage, proposals fitted to the weighted population, and
moves until the population is nearly uncorrelated with its resampled start. The settings of papers are in
`samplers.presets`.

Tempering has a limit that no setting removes: of several modes of similar mass, one that is much narrower than the
others has little mass at small beta, and is lost unless draws of the prior happen to lie in it (Woodard, Schmidler &
Huber 2009, doi:10.1214/EJP.v14-638). Where such modes are possible, compare runs with more walkers.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from .moves.kernels import MixtureMove
from .tempered import TemperedSampler
from .tempering.settings import Settings

__all__ = ["SMCSampler"]

FEWEST_TO_RECYCLE = 250
_TMCMC = "SMCSampler does not use it: pass it to TMCMCSampler"


class SMCSampler(TemperedSampler):
    """Sequential Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        As in `emcee.EnsembleSampler`, in the same order. By default `moves` is
        `samplers.moves.kernels.MixtureMove`: three kernels from a mixture fitted to every stage.
    log_prior_fn, seed
        As in `TemperedSampler`.
    coarse_log_prob_fn : callable, optional
        A cheaper `log_prob_fn` to anneal on first, such as ``posterior.coarse``. The result is that of `log_prob_fn`; a
        `SamplingWarning` says where the coarse model did not help. Requires recycling.
    recycle : bool, optional
        Anneal by recycling every evaluated point (`samplers.tempering.adaptive_importance`), and by moves where its
        result cannot be trusted. By default yes with 250 walkers or more and no `moves` given: with fewer walkers, a
        mode can be lost unnoticed, and recycling often fails.
    recycling : RecyclingSettings, optional
        Constants of the recycling.
    ess_ratio, ess_rule, ess_floor, resampling : optional
        Choice of beta and resampling; with ``recycle=False`` only. See `samplers.tempering.settings.Settings`.
    min_moves, max_moves, max_correlation : optional
        How long points are moved at each beta, as there; with recycling, at beta = 1.
    fast_sweeps, check_draws, max_failure_share : optional
        As there.
    settings : Settings, optional
        Settings as one object; keywords take precedence.

    Raises
    ------
    ValueError
        For a setting that cannot act, such as ``ess_ratio=0.9`` with recycling. If recycling cannot be trusted, the
        annealing by moves that follows uses the defaults.

    Examples
    --------
    >>> sampler = SMCSampler(500, posterior.ndim, posterior, vectorize=True)
    >>> sampler.run_mcmc(None, 10)
    >>> sampler.get_chain(flat=True), sampler.log_evidence, sampler.log_evidence_error
    """

    unused_settings: Mapping[str, str] = MappingProxyType(
        {"chains": _TMCMC, "burn_in": _TMCMC, "coefficient_of_variation": _TMCMC + ", or use ess_ratio"}
    )

    @classmethod
    def _choose(cls, settings: Settings, moves: Any, nwalkers: int) -> tuple[bool, Any]:
        recycle = moves is None and nwalkers >= FEWEST_TO_RECYCLE if settings.recycle is None else settings.recycle
        return recycle, MixtureMove() if moves is None else moves
