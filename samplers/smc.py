"""The two samplers of the package behind emcee's interface (``docs/theory/tempering``, ``docs/theory/recycling``).

Tempering has a limit that no setting removes: among modes with similar masses, a mode that is much narrower than the
others has little mass at small beta, and is lost unless draws of the prior happen to lie in it (Woodard, Schmidler &
Huber 2009, doi:10.1214/EJP.v14-638). If such modes are possible, use more walkers.

Transitional Markov chain Monte Carlo as published (Ching & Chen 2007), with steps of a fixed scale, is biased, and can
collapse on a sharp posterior; its settings are `samplers.presets.CHING_CHEN_2007`. By default every chain has a burn-in
and scales are adapted to the acceptance (Betz, Papaioannou & Straub 2016), and the moves are `MixtureMove`, since a
random walk alone gives separate modes wrong shares.
"""

from typing import Any

from .moves.population_moves import MixtureMove
from .tempered import TemperedSampler
from .tempering.mutation import needs_many_walkers

OF_MOVES = {"ess_ratio", "ess_floor", "resampling", "min_moves", "max_moves", "max_correlation"}
# Steps of a chain from a leader before its points count: without them the shares of the points are biased.
BURN_IN = 4


class SMCSampler(TemperedSampler):
    """Sequential Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, ..., seed, **settings
        As in `samplers.tempered.TemperedSampler`, with its errors. By default `moves` is
        `samplers.moves.population_moves.MixtureMove`: three kernels from a mixture fitted to every stage.
    recycle : bool, optional
        Anneal by recycling every evaluated point (`samplers.tempering.recycling`), and by moves if the result cannot be
        trusted. Default: True, unless `moves` or a setting of moves is given (`ess_ratio` to `max_correlation`).

    Examples
    --------
    >>> sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
    >>> state = sampler.run_mcmc(None, 3)
    >>> sampler.get_chain(flat=True).shape
    (300, 4)
    >>> sampler.verdict.status
    'converged'
    >>> print(f"{sampler.log_evidence:.1f} +- {sampler.log_evidence_error:.2g}")  # doctest: +SAMPLED
    376.1 +- 0.053
    """

    @classmethod
    def _chosen(cls, settings: dict[str, Any], moves: Any) -> tuple[dict[str, Any], Any]:
        if settings.get("recycle") is None:
            settings = settings | {"recycle": moves is None and not OF_MOVES & set(settings)}
        return settings, MixtureMove() if moves is None else moves


class TMCMCSampler(TemperedSampler):
    """Transitional Markov chain Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, ..., seed, **settings
        As in `samplers.tempered.TemperedSampler`, with its errors. By default `moves` is
        `samplers.moves.population_moves.MixtureMove`.
    chains : {"leaders", "equal"}
        As in `samplers.settings.Settings`. By default "leaders", but "equal" with moves of emcee that need many
        walkers, such as the stretch move; "equal" moves all points in one batch, which keeps a pool busy.
    burn_in : int, default 4
        Steps of a chain before its points count; with "leaders" only. With 0, the algorithm is as published.

    Examples
    --------
    >>> sampler = TMCMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
    >>> state = sampler.run_mcmc(None, 3)
    >>> sampler.get_chain().shape  # steps, walkers, parameters
    (3, 100, 4)
    """

    @classmethod
    def _chosen(cls, settings: dict[str, Any], moves: Any) -> tuple[dict[str, Any], Any]:
        settings = {"chains": "equal" if needs_many_walkers(moves) else "leaders", "recycle": False} | settings
        if settings["chains"] == "leaders":
            settings.setdefault("burn_in", BURN_IN)
        return settings, MixtureMove() if moves is None else moves
