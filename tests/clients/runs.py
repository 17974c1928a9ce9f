"""Runs of all clients on the posterior of `problem`, in the form that the table of clients documents.

Settings are small, so that a run takes seconds. Starting points are drawn where the posterior is not zero, because
several clients refuse others. Each client is imported inside its function.
"""

import logging
import random
import tempfile
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import Posterior
from fe_likelihoods.adapters import to_bilby, to_pymc

from .problem import finite, starts_of
from .scoring import Found, chains, replicates, weighted


def _emcee(posterior: Posterior, seed: int) -> Found:
    import emcee

    np.random.seed(seed)  # noqa: NPY002 - emcee draws from the global stream
    sampler = emcee.EnsembleSampler(48, posterior.ndim, posterior, vectorize=True)
    sampler.run_mcmc(starts_of(posterior, 48), 500)
    return chains(sampler.get_chain(discard=100).swapaxes(0, 1))


def _zeus(posterior: Posterior, seed: int) -> Found:
    import zeus

    np.random.seed(seed)  # noqa: NPY002 - zeus draws from the global streams of numpy and of Python
    random.seed(seed)
    sampler = zeus.EnsembleSampler(16, posterior.ndim, posterior, vectorize=True, verbose=False)
    sampler.run_mcmc(starts_of(posterior, 16), 250, progress=False)
    return chains(sampler.get_chain(discard=50).swapaxes(0, 1))


def _dynesty(posterior: Posterior, seed: int) -> Found:
    import dynesty

    sampler = dynesty.NestedSampler(
        posterior.log_likelihood,
        posterior.prior_transform,
        posterior.ndim,
        nlive=250,
        bound="single",
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(print_progress=False)
    found = sampler.results
    return weighted(found.samples, found.importance_weights(), found.logz[-1], found.logzerr[-1])


def _nautilus(posterior: Posterior, seed: int) -> Found:
    import nautilus

    prior = nautilus.Prior()
    for name, distribution in posterior.prior.distributions.items():
        prior.add_parameter(name, distribution)
    sampler = nautilus.Sampler(prior, posterior.log_likelihood, vectorized=True, n_live=250, n_networks=1, seed=seed)
    sampler.run(n_eff=1000)
    samples, log_weights, _ = sampler.posterior()
    return weighted(samples, np.exp(log_weights), sampler.log_z, 1.0 / np.sqrt(sampler.n_eff))


def _pints(posterior: Posterior, seed: int) -> Found:
    import pints

    class LogPosterior(pints.LogPDF):
        def n_parameters(self) -> int:
            return posterior.ndim

        def __call__(self, x: np.ndarray) -> float:
            return posterior(x)

    np.random.seed(seed)  # noqa: NPY002 - pints draws from the global stream
    starts = list(starts_of(posterior, 8))
    controller = pints.MCMCController(LogPosterior(), 8, starts, method=pints.DifferentialEvolutionMCMC)
    controller.set_max_iterations(1200)
    controller.set_log_to_screen(False)
    return chains(controller.run()[:, 400:])


def _bilby(posterior: Posterior, seed: int) -> Found:
    import bilby

    logging.getLogger("bilby").setLevel(logging.ERROR)
    bilby.core.utils.random.seed(seed)
    likelihood, priors = to_bilby(posterior)
    with tempfile.TemporaryDirectory() as folder:
        result = bilby.run_sampler(
            likelihood,
            priors,
            sampler="dynesty",
            nlive=250,
            sample="unif",
            bound="single",
            outdir=folder,
            save=False,
            resume=False,
            check_point=False,
            check_point_plot=False,
            print_progress=False,
        )
    found = result.nested_samples
    return weighted(
        found[posterior.parameter_names].to_numpy(),
        found["weights"].to_numpy(),
        result.log_evidence,
        result.log_evidence_err,
    )


def _ultranest(posterior: Posterior, seed: int) -> Found:
    import ultranest

    np.random.seed(seed)  # noqa: NPY002 - ultranest draws from the global stream
    sampler = ultranest.ReactiveNestedSampler(
        posterior.parameter_names, partial(finite, posterior), posterior.prior_transform, vectorized=True
    )
    logging.getLogger("ultranest").setLevel(logging.WARNING)  # its constructor sets the most detailed level
    result = sampler.run(min_num_live_points=250, show_status=False, viz_callback=False)
    found = result["weighted_samples"]
    return weighted(np.array(found["points"]), np.array(found["weights"]), result["logz"], result["logzerr"])


def _pocomc(posterior: Posterior, seed: int) -> Found:
    import pocomc

    runs = []
    for repetition in range(6):  # without its flow, pocomc gives no error of the evidence: use the scatter of runs
        np.random.seed(10 * seed + repetition)  # noqa: NPY002 - the prior is drawn from the global stream
        sampler = pocomc.Sampler(
            posterior.prior,
            partial(finite, posterior),
            vectorize=True,
            random_state=10 * seed + repetition,
            n_active=64,
            n_effective=256,
            precondition=False,  # training a flow takes minutes, and gains nothing in four dimensions
        )
        sampler.run(n_total=1024, progress=False)
        samples, weights, _, _ = sampler.posterior()
        runs.append(weighted(samples, weights, sampler.evidence()[0], np.nan))
    return replicates(runs)


def _pymc_smc(posterior: Posterior, seed: int) -> Found:
    import pymc

    with to_pymc(posterior):
        trace = pymc.sample_smc(
            500, chains=8, cores=1, random_seed=seed, progressbar=False, compute_convergence_checks=False
        )
    samples = np.stack([trace.posterior[name].values for name in posterior.parameter_names], axis=-1)
    runs = []
    evidences = trace.sample_stats["log_marginal_likelihood"].values.ravel()  # one list of stages per chain
    for draws, stages in zip(samples, evidences, strict=True):
        stages = np.array(stages, dtype=float)  # NaN before the last stage
        runs.append(weighted(draws, np.ones(len(draws)), stages[np.isfinite(stages)][-1], np.nan))
    return replicates(runs)


def _pymc_chains(posterior: Posterior, seed: int, draws: int, tune: int, step: Callable | None = None) -> Any:
    """Trace of four chains by a step method, or by the one that PyMC chooses."""
    import pymc

    starts = [dict(zip(posterior.parameter_names, x, strict=True)) for x in starts_of(posterior, 4, seed)]
    with to_pymc(posterior):
        return pymc.sample(
            draws,
            tune=tune,
            step=None if step is None else step(),
            initvals=starts,
            chains=4,
            cores=1,
            random_seed=seed,
            progressbar=False,
            compute_convergence_checks=False,
        )


def _pymc_mcmc(posterior: Posterior, seed: int) -> Found:
    import pymc

    trace = _pymc_chains(posterior, seed, 4000, 3000, pymc.DEMetropolisZ)
    return chains(np.stack([trace.posterior[name].values for name in posterior.parameter_names], axis=-1))


def _pymc_nuts(posterior: Posterior, seed: int) -> Found:
    trace = _pymc_chains(posterior, seed, 500, 500)
    assert "tree_depth" in trace.sample_stats  # NUTS
    return chains(np.stack([trace.posterior[name].values for name in posterior.parameter_names], axis=-1))


class Client(NamedTuple):
    """The module to import, the command that installs it, and the run."""

    module: str
    install: str
    run: Callable[[Posterior, int], Found]


_TEST, _CLIENTS, _MAKE = "pip install '.[test]'", "pip install '.[clients]'", "make clients"
CLIENTS = {
    "emcee": Client("emcee", "pip install .", _emcee),
    "zeus": Client("zeus", _TEST, _zeus),
    "dynesty": Client("dynesty", _TEST, _dynesty),
    "nautilus": Client("nautilus", _TEST, _nautilus),
    "pints": Client("pints", _TEST, _pints),
    "bilby": Client("bilby", _TEST, _bilby),
    "ultranest": Client("ultranest", _CLIENTS, _ultranest),
    "pymc-smc": Client("pymc", _CLIENTS, _pymc_smc),
    "pymc-mcmc": Client("pymc", _CLIENTS, _pymc_mcmc),
    "pymc-nuts": Client("pymc", _CLIENTS, _pymc_nuts),
    "pocomc": Client("pocomc", _MAKE, _pocomc),
}
