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

_NO_RECYCLING = "TMCMCSampler does not recycle: use SMCSampler"
_COV = "TMCMCSampler chooses beta by the coefficient of variation: pass coefficient_of_variation"


class TMCMCSampler(TemperedSampler):
    """Transitional Markov chain Monte Carlo sampler.

    Parameters
    ----------
    nwalkers, ndim, log_prob_fn, pool, moves, args, kwargs, backend, vectorize, blobs_dtype, parameter_names
        As in `emcee.EnsembleSampler`, in the same order. By default `moves` is `samplers.moves.kernels.MixtureMove`.
    log_prior_fn : callable, optional
        Log-density of the normalised prior, called like `log_prob_fn` but without `args` and `kwargs`, always in this
        process. By default ``log_prob_fn.log_prior``.
    log_likelihood_fn : callable, optional
        Log-likelihood, in place of `log_prob_fn`, which is then None. It is called in the same way, and may return
        blobs; the log-prior is added to its values. Its attributes count as those of `log_prob_fn`.
    start_density : callable, optional
        Normalised log-density that the initial state is drawn from, if that is not the prior, called like
        `log_prior_fn`; finite wherever the log-prior is. The annealing then leads from it to the posterior.
    guide : Guide, optional
        An object that proposes draws near the posterior, such as ``posterior.guide()`` (`samplers.tempering.guide`).
        Its weighted draws replace the annealing, and the sweeps at beta = 1 are proposals of the guide. Where its draws
        cannot be trusted, recycling starts from them, with a `SamplingWarning`.
    max_simulations : float, optional
        Largest number of simulations. Where it is reached, the posterior is estimated from the points that are known,
        and `verdict` says what the estimate is worth. The run goes on when `max_simulations` is increased and
        `run_mcmc` is called again.
    seed : int or array of int, optional
        Seed of the run. By default it is drawn from NumPy's global generator (``np.random.seed``). The random state of
        a backend that contains a chain takes precedence.
    coefficient_of_variation : float, optional
        Coefficient of variation of the incremental weights, which determines the next exponent. By default 1, which is
        an effective sample size of half the number of walkers.
    resampling : str or callable, default "systematic"
        Name of a scheme in `samplers.tempering.resampling`, or a function of (weights, random) that returns indices.
    chains : {"equal", "leaders"}, default "equal"
        With "equal", every resampled point is moved equally often. With "leaders", a chain grows from each distinct
        resampled point, one step per copy of it; each point is then moved `burn_in` + 1 times. Moves that need many
        walkers, such as emcee's stretch move, need "equal".
    burn_in : int, default 0
        Steps of a chain before its points count; with "leaders" only.
    min_moves : int, default 2
        Smallest number of sweeps of the ensemble per stage; with "equal" only, as the next two settings.
    max_moves : int, default 7
        Largest number of these sweeps; equal to `min_moves` for a fixed number.
    max_correlation : float, default 0.15
        Between these two numbers, moving stops once the correlation of every parameter and of the log-likelihood with
        their values after the resampling is below this value, or decreases no further.
    fast_sweeps : int, default 2
        Sweeps over the fast parameters after every move, where `log_prob_fn` has an attribute ``fast_parameters``; 0
        for none.
    guided : GuidedSettings, default GuidedSettings()
        Constants of the rounds of a guide; with `guide` only.
    check_draws : int, optional
        Evaluations for an estimate of the evidence that is independent of the annealing. By default as many as there
        are walkers; 0 for no such estimate.
    max_failure_share : float, default 0.5
        The run stops with an error when more than this share of the evaluations have failed by an exception or by NaN
        (a returned -inf is not a failure); 0 stops at the first failure.
    settings : samplers.Settings, optional
        These settings as one object; keywords take precedence.

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
            "recycling": _NO_RECYCLING + ", or pass guide=",
            "runs": _NO_RECYCLING,
            "asynchronous": "moves wait for all points that they propose: use SMCSampler",
        }
    )

    how_to_recycle = _NO_RECYCLING

    @classmethod
    def _choose(cls, settings: Settings, moves: Any, nwalkers: int) -> tuple[bool, Any]:
        if settings.recycle:
            raise ValueError(f"recycle=True cannot act here: {_NO_RECYCLING}")
        return False, MixtureMove() if moves is None else moves
