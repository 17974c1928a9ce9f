"""Transitional Markov chain Monte Carlo behind emcee's interface (``docs/theory/tempering``).

The published algorithm (Ching & Chen 2007), with steps of a fixed scale, is biased, and can collapse on a sharp
posterior; its settings are `samplers.presets.CHING_CHEN_2007`. By default every chain has a burn-in and scales are
adapted to the acceptance (Betz, Papaioannou & Straub 2016), and the moves are `MixtureMove`, since a random walk alone
gives separate modes wrong shares.
"""

from typing import Any

from .moves.population_moves import MixtureMove
from .tempered import TemperedSampler
from .tempering.mutation import needs_many_walkers

# Steps of a chain from a leader before its points count: without them the shares of the points are biased.
BURN_IN = 4
OF_SWEEPS = ("min_moves", "max_moves", "max_correlation")


class TMCMCSampler(TemperedSampler):
    """Transitional Markov chain Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, ..., log_prior_fn, log_likelihood_fn, guide, max_simulations, seed
        As in `samplers.tempered.TemperedSampler`, in the same order. By default `moves` is
        `samplers.moves.population_moves.MixtureMove`.
    chains : {"leaders", "equal"}
        As in `samplers.settings.Settings`. By default "leaders", but "equal" with moves of emcee that need many
        walkers, such as the stretch move; "equal" moves all points in one batch, which keeps a pool busy.
    burn_in : int, default 4
        Steps of a chain before its points count; with "leaders" only. With 0, the algorithm is as published.
    ess_ratio, resampling, min_moves, max_moves, max_correlation, fast_sweeps, max_failure_share
        As in `samplers.settings.Settings`.

    Raises
    ------
    ValueError
        For an impossible value, or for a setting that cannot act, such as ``max_moves=5`` with ``burn_in=0``.
    TypeError
        For a keyword that is not a setting.

    Examples
    --------
    >>> sampler = TMCMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
    >>> state = sampler.run_mcmc(None, 3)
    >>> sampler.get_chain().shape  # steps, walkers, parameters
    (3, 100, 4)
    """

    @classmethod
    def _chosen(cls, settings: dict[str, Any], moves: Any, nwalkers: int) -> tuple[dict[str, Any], Any]:
        settings = {"chains": "equal" if needs_many_walkers(moves) else "leaders", "recycle": False} | settings
        if settings["chains"] == "leaders":
            settings.setdefault("burn_in", BURN_IN)
            if settings["burn_in"] == 0 and (idle := [name for name in OF_SWEEPS if name in settings]):
                raise ValueError(
                    f"{idle[0]} cannot act with burn_in=0, which makes no sweeps after the chains, as published: pass "
                    'burn_in of 1 or more, or chains="equal"'
                )
        return settings, MixtureMove() if moves is None else moves
