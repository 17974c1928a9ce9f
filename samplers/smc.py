"""Sequential Monte Carlo behind emcee's interface (``docs/theory/tempering``, ``docs/theory/recycling``).

Tempering has a limit that no setting removes: among modes with similar masses, a mode that is much narrower than the
others has little mass at small beta, and is lost unless draws of the prior happen to lie in it (Woodard, Schmidler &
Huber 2009, doi:10.1214/EJP.v14-638). If such modes are possible, use more walkers.
"""

from typing import Any

from .moves.population_moves import MixtureMove
from .tempered import TemperedSampler

FEWEST_TO_RECYCLE = 150
OF_MOVES = {"ess_ratio", "ess_rule", "ess_floor", "resampling", "min_moves", "max_moves", "max_correlation"}


class SMCSampler(TemperedSampler):
    """Sequential Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, ..., log_prior_fn, log_likelihood_fn, guide, max_simulations, seed
        As in `samplers.tempered.TemperedSampler`, in the same order. By default `moves` is
        `samplers.moves.population_moves.MixtureMove`: three kernels from a mixture fitted to every stage.
    recycle : bool, optional
        Anneal by recycling every evaluated point (`samplers.tempering.recycling`), and by moves if the result cannot be
        trusted. Default: True with 150 walkers or more, unless `moves` or a setting of annealing by moves is given
        (`ess_ratio` to `max_correlation`). With fewer walkers, a mode can be lost unnoticed, and recycling often fails.
    asynchronous
        As in `samplers.settings.Settings`; it needs recycling.
    ess_ratio, ess_rule, ess_floor, resampling, min_moves, max_moves, max_correlation
        Settings of annealing by moves, as in `samplers.settings.Settings`.
    fast_sweeps, max_failure_share
        As in `samplers.settings.Settings`.

    Raises
    ------
    ValueError
        For an impossible value, or for `asynchronous` without recycling.
    TypeError
        For a keyword that is not a setting.

    Examples
    --------
    >>> sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
    >>> state = sampler.run_mcmc(None, 3)
    >>> sampler.get_chain(flat=True).shape
    (300, 4)
    >>> sampler.verdict.status
    'converged'
    >>> print(f"{sampler.log_evidence:.1f} +- {sampler.log_evidence_error:.2g}")  # doctest: +SAMPLED
    376.1 +- 0.089
    """

    @classmethod
    def _chosen(cls, settings: dict[str, Any], moves: Any, nwalkers: int) -> tuple[dict[str, Any], Any]:
        if settings.get("recycle") is None:
            recycle = moves is None and not OF_MOVES & set(settings) and nwalkers >= FEWEST_TO_RECYCLE
            settings = settings | {"recycle": recycle}
        return settings, MixtureMove() if moves is None else moves
