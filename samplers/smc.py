"""Sequential Monte Carlo behind emcee's interface.

Del Moral, Doucet & Jasra (2006), doi:10.1111/j.1467-9868.2006.00553.x, with the adaptation that has become usual: the
next exponent by the effective sample size, resampling at every stage, proposals fitted to the weighted population, and
moves until the population is nearly uncorrelated with its resampled start. The settings of papers are in
`samplers.presets`.

Tempering has a limit that no setting removes: of several modes of similar mass, one that is much narrower than the
others has little mass at small beta, and is lost unless draws of the prior happen to lie in it (Woodard, Schmidler &
Huber 2009, doi:10.1214/EJP.v14-638). Where such modes are possible, use more walkers, or ``runs=2``.
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
    log_prior_fn : callable, optional
        Log-density of the normalised prior, called like `log_prob_fn` but without `args` and `kwargs`, always in this
        process. By default ``log_prob_fn.log_prior``.
    log_likelihood_fn : callable, optional
        Log-likelihood, in place of `log_prob_fn`, which is then None. It is called in the same way, and may return
        blobs; the log-prior is added to its values. Its attributes count as those of `log_prob_fn`.
    start_density : callable, optional
        Normalised log-density that the initial state is drawn from, if that is not the prior, called like
        `log_prior_fn`; finite wherever the log-prior is. The annealing then leads from it to the posterior.
    coarse_log_prob_fn : callable, optional
        A cheaper `log_prob_fn` to anneal on first, such as ``posterior.coarse``. The result is that of `log_prob_fn`; a
        `SamplingWarning` says where the coarse model did not help. Requires recycling.
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
    recycle : bool, optional
        Anneal by recycling every evaluated point (`samplers.tempering.adaptive_importance`), and by moves where its
        result cannot be trusted. By default yes with 250 walkers or more and no `moves` given: with fewer walkers, a
        mode can be lost unnoticed, and recycling often fails.
    recycling : RecyclingSettings, default RecyclingSettings()
        Constants of the recycling.
    runs : int, default 1
        Number of runs of recycling from the same draws of the prior. Their points are used together at the end, and a
        difference in the evidence, a mean or the share of a mode is reported. Two runs cost up to twice the
        evaluations of the annealing, and lose a mode only if both do.
    guided : GuidedSettings, default GuidedSettings()
        Constants of the rounds of a guide; with `guide` only.
    ess_ratio : float, default 0.5
        Effective sample size wanted of each stage, as a share of the number of walkers (`ess_rule` "constant") or of
        the previous stage's target ("declining"); between 0 and 1. Without recycling only, as the next three settings.
    ess_rule : {"constant", "declining"}, default "constant"
        What `ess_ratio` refers to.
    ess_floor : float, default 0.0
        Lower limit of the declining target.
    resampling : str or callable, default "systematic"
        Name of a scheme in `samplers.tempering.resampling`, or a function of (weights, random) that returns indices.
    min_moves : int, default 2
        Smallest number of sweeps of the ensemble per stage; with recycling, see `RecyclingSettings.closing_sweeps`.
    max_moves : int, default 7
        Largest number of these sweeps; equal to `min_moves` for a fixed number.
    max_correlation : float, default 0.15
        Between these two numbers, moving stops once the correlation of every parameter and of the log-likelihood with
        their values after the resampling is below this value, or decreases no further.
    fast_sweeps : int, default 2
        Sweeps over the fast parameters after every move, where `log_prob_fn` has an attribute ``fast_parameters``; 0
        for none.
    check_draws : int, optional
        Evaluations for an estimate of the evidence that is independent of the annealing. By default as many as there
        are walkers; 0 for no such estimate.
    max_failure_share : float, default 0.5
        The run stops with an error when more than this share of the evaluations have failed by an exception or by NaN
        (a returned -inf is not a failure); 0 stops at the first failure.
    asynchronous : bool, default False
        With recycling or a guide, propose the next points while the last ones run, so that no worker waits for the
        slowest point of a batch; for long runs of unequal length. Needs a `Posterior` of fe_likelihoods with a pool of
        its own and ``vectorize=True``, or a `pool` that takes single points. Proposals then depend on the order in
        which points arrive, which the journal of a file repeats; beta grows when all draws but the latest have arrived,
        and estimates are made of complete batches or rounds only.
    settings : samplers.Settings, optional
        These settings as one object; keywords take precedence.

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

    how_to_recycle = (
        f"use more walkers or pass recycle=True (it is on by default with {FEWEST_TO_RECYCLE} walkers or more and no "
        "moves given)"
    )

    @classmethod
    def _choose(cls, settings: Settings, moves: Any, nwalkers: int) -> tuple[bool, Any]:
        recycle = moves is None and nwalkers >= FEWEST_TO_RECYCLE if settings.recycle is None else settings.recycle
        return recycle, MixtureMove() if moves is None else moves
