"""Transitional Markov chain Monte Carlo behind emcee's interface.

Ching & Chen (2007), doi:10.1061/(ASCE)0733-9399(2007)133:7(816): the next exponent is the one at which the coefficient
of variation of the weights is 1, and chains grow from resampled leaders by a random walk with a share of the weighted
covariance. As published, one step a point at a fixed scale, it can collapse on a sharp posterior; those settings are
`samplers.presets.CHING_CHEN_2007`. By default every point is moved until it has forgotten its leader, by walks whose
scale follows their acceptance and by draws that cross between modes: after Betz, Papaioannou & Straub (2016),
doi:10.1061/(ASCE)EM.1943-7889.0001066, and BASIS (Angelikopoulos, Papadimitriou & Koumoutsakos 2012,
doi:10.1063/1.4757266), whose chains are equally long, so that all processors of a pool are busy.
"""

from collections.abc import Callable

from .moves.kernels import MixtureMove
from .tempered import TemperedSampler
from .tempering.settings import Settings

__all__ = ["TMCMCSampler"]


class TMCMCSampler(TemperedSampler):
    """Transitional Markov chain Monte Carlo sampler.

    >>> sampler = TMCMCSampler(1000, posterior.ndim, posterior, vectorize=True)
    >>> sampler.run_mcmc(None, 10)

    Parameters
    ----------
    nwalkers ... parameter_names : as in `emcee.EnsembleSampler`, in its order. Without `moves`, those of
        `samplers.moves.kernels.MixtureMove`.
    log_prior_fn, seed : as in `TemperedSampler`.
    coefficient_of_variation : float — of the incremental weights, which sets the next exponent.
    chains, burn_in : as in `samplers.tempering.settings.Settings`. Moves that need many walkers, such as emcee's stretch move,
        need chains="equal".
    resampling, min_moves, max_moves, max_correlation, fast_sweeps, check_draws, max_failure_share : as in
        `samplers.tempering.settings.Settings`.
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
        seed: int | None = None,
        coefficient_of_variation: float = 1.0,
        chains: str = "equal",
        burn_in: int = 0,
        resampling: str | Callable = "systematic",
        min_moves: int = 2,
        max_moves: int = 7,
        max_correlation: float = 0.15,
        fast_sweeps: int = 2,
        check_draws: int | None = None,
        max_failure_share: float = 0.5,
    ):
        if not 0.0 < coefficient_of_variation < float("inf"):
            raise ValueError(f"coefficient_of_variation must be positive and finite; got {coefficient_of_variation}")
        super().__init__(
            nwalkers,
            ndim,
            log_prob_fn,
            pool=pool,
            moves=MixtureMove() if moves is None else moves,
            args=args,
            kwargs=kwargs,
            backend=backend,
            vectorize=vectorize,
            blobs_dtype=blobs_dtype,
            parameter_names=parameter_names,
            log_prior_fn=log_prior_fn,
            seed=seed,
            settings=Settings(
                # n weights of this coefficient of variation are worth n / (1 + variation^2) points
                ess_ratio=1.0 / (1.0 + coefficient_of_variation**2),
                resampling=resampling,
                chains=chains,
                burn_in=burn_in,
                min_moves=min_moves,
                max_moves=max_moves,
                max_correlation=max_correlation,
                fast_sweeps=fast_sweeps,
                check_draws=check_draws,
                max_failure_share=max_failure_share,
            ),
        )
