"""Transitional Markov chain Monte Carlo behind emcee's interface.

Ching & Chen (2007), doi:10.1061/(ASCE)0733-9399(2007)133:7(816): the next exponent is the one at which the coefficient
of variation of the weights is 1, and chains grow from resampled leaders by a random walk with a fraction of the
weighted covariance. As published, with one step per point at a fixed scale, it can collapse on a sharp posterior; these
settings are `samplers.presets.CHING_CHEN_2007`. By default every point is moved until the population is nearly
uncorrelated with its resampled start, by walks whose scale follows their acceptance and by draws that cross between
modes: after Betz, Papaioannou & Straub (2016), doi:10.1061/(ASCE)EM.1943-7889.0001066, and BASIS (Angelikopoulos,
Papadimitriou & Koumoutsakos 2012, doi:10.1063/1.4757266), whose chains have equal lengths, so that all processors of a
pool are busy.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from .moves.kernels import MixtureMove
from .tempered import TemperedSampler
from .tempering.settings import Settings

__all__ = ["TMCMCSampler"]

_COV = "TMCMCSampler chooses beta by the coefficient of variation: pass coefficient_of_variation"


class TMCMCSampler(TemperedSampler):
    """Transitional Markov chain Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        As in `emcee.EnsembleSampler`, in the same order. By default `moves` is `samplers.moves.kernels.MixtureMove`.
    log_prior_fn, seed
        As in `TemperedSampler`.
    coefficient_of_variation : float, optional
        Coefficient of variation of the incremental weights, which determines the next exponent; 1 by default.
    chains : {"equal", "leaders"}, optional
        Whether all points are moved equally often, or chains grow from leaders. Moves that need many walkers, such as
        emcee's stretch move, need "equal".
    burn_in : int, optional
        Steps of a chain before its points count; with "leaders" only.
    min_moves, max_moves, max_correlation : optional
        How long points are moved at each beta; with "equal" only.
    resampling, fast_sweeps, check_draws, max_failure_share : optional
        As in `samplers.tempering.settings.Settings`.
    settings : Settings, optional
        Settings as one object; keywords take precedence.

    Raises
    ------
    ValueError
        For a setting that cannot act, such as ``burn_in=5`` with equal chains.

    Examples
    --------
    >>> sampler = TMCMCSampler(1000, posterior.ndim, posterior, vectorize=True)
    >>> sampler.run_mcmc(None, 10)
    """

    unused_settings: Mapping[str, str] = MappingProxyType(
        {
            **dict.fromkeys(("ess_ratio", "ess_rule", "ess_floor"), _COV),
            "recycling": "TMCMCSampler does not recycle: use SMCSampler",
        }
    )

    @classmethod
    def _choose(cls, settings: Settings, moves: Any, nwalkers: int) -> tuple[bool, Any]:
        if settings.recycle:
            raise ValueError("recycle=True cannot act here: TMCMCSampler does not recycle: use SMCSampler")
        return False, MixtureMove() if moves is None else moves
