"""Other samplers on the same targets, counted and scored in the same way. The library itself never imports them.

Every run has its own process and ``limit`` seconds of wall time, which include imports and compilation (on a busy
machine more runs are stopped). A row says so if a run was stopped, failed or warned, or if the sampler is not
installed. All runs take about twenty minutes for each of the ``--repeats``. Settings are the defaults of the other
sampler, except:

* emcee and zeus: 100 walkers from the prior, 1000 steps of which the second half counts; no evidence.
* PyMC ``sample_smc``: one chain of 2000 draws in one process (2000 is its default, and what our chains hold).
* pocomc: defaults (256 active particles, 512 effective, 4096 samples), with its normalising flow and without.
* dynesty: the static sampler, 500 live points (its default).

emcee, zeus and pocomc evaluate the likelihood in batches, PyMC and dynesty point by point: their CPU time per
evaluation includes one call from Python each, and that of PyMC its compilation.

On Python 3.11 with numpy 2.4 all of them can share one environment. PyMC limits numba (pytensor 2.38 needs 0.65.1 or
older), so the times of compiled kernels are those of an older numba. pocomc needs torch even without its flow, by
default gigabytes with CUDA, and is therefore not in the extra: install the CPU build of torch (see
https://pytorch.org/get-started) and then ``pip install pocomc``.
"""

import importlib.util
import logging
import random
import time
import warnings
from collections.abc import Callable
from multiprocessing.sharedctypes import RawValue
from typing import Any, NamedTuple

import emcee
import numpy as np

from .processes import in_process
from .rows import Row
from .targets import Target, as_row, errors, target_named

__all__ = ["PEERS", "Peer", "rows", "run_emcee", "run_peer"]

WALKERS, STEPS = 100, 1000
DRAWS = 2000  # of PyMC
LIVE_POINTS = 500  # of dynesty


class _Outcome(NamedTuple):
    samples: np.ndarray
    weights: np.ndarray | None = None
    log_evidence: float | None = None
    log_evidence_error: float | None = None


def _prior_stream(seed: int) -> np.random.RandomState:
    """Random numbers independent of those of a sampler that is seeded with `seed`."""
    return np.random.RandomState([seed, 1])


def run_emcee(target: Target, seed: int) -> _Outcome:
    """Run emcee's stretch move from draws of the prior."""
    stream = np.random.RandomState(seed)
    start = target.sample_prior(WALKERS, stream)
    sampler = emcee.EnsembleSampler(WALKERS, target.ndim, target, vectorize=True)
    sampler.random_state = stream.get_state()
    sampler.run_mcmc(start, STEPS)
    return _Outcome(sampler.get_chain(flat=True, discard=STEPS // 2))


def _zeus(target: Target, seed: int) -> _Outcome:
    import zeus

    np.random.seed(seed)  # noqa: NPY002 - zeus draws from the global streams of numpy and of Python
    random.seed(seed)
    start = target.sample_prior(WALKERS, _prior_stream(seed))
    sampler = zeus.EnsembleSampler(WALKERS, target.ndim, target, vectorize=True, verbose=False)
    sampler.run_mcmc(start, STEPS, progress=False)
    return _Outcome(sampler.get_chain(flat=True, discard=STEPS // 2))


def _pymc(target: Target, seed: int) -> _Outcome:
    import pymc
    import pytensor.tensor as pt
    from pytensor.graph.op import Op

    logging.getLogger("pymc").setLevel(logging.WARNING)

    class LogLikelihood(Op):
        itypes, otypes = [pt.dvector], [pt.dscalar]

        def perform(self, node, inputs, outputs):
            outputs[0][0] = np.array(target.log_likelihood(inputs[0][None])[0])

    kinds = {
        "tn": lambda name, a, b: pymc.TruncatedNormal(name, a, b, lower=0.0),
        "hn": lambda name, a, b: pymc.HalfNormal(name, a),
        "u": lambda name, a, b: pymc.Uniform(name, a, b),
        "ln": lambda name, a, b: pymc.LogNormal(name, a, b),
    }
    names = [f"x{i}" for i in range(target.ndim)]
    with pymc.Model():
        x = [kinds[kind](name, a, b) for name, (kind, a, b) in zip(names, target.prior, strict=True)]
        pymc.Potential("log_likelihood", LogLikelihood()(pt.stack(x)))
        trace = pymc.sample_smc(
            DRAWS, chains=1, cores=1, random_seed=seed, progressbar=False, compute_convergence_checks=False
        )
    samples = np.stack([trace.posterior[name].values.ravel() for name in names], axis=1)
    by_stage = trace.sample_stats["log_marginal_likelihood"].values[0]  # of the only chain
    return _Outcome(samples, log_evidence=float(by_stage[-1]))


def _dynesty(target: Target, seed: int) -> _Outcome:
    import dynesty

    sampler = dynesty.NestedSampler(
        lambda x: float(target.log_likelihood(x[None])[0]),
        target.prior_transform,
        target.ndim,
        nlive=LIVE_POINTS,
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(print_progress=False)
    found = sampler.results
    return _Outcome(found.samples, found.importance_weights(), found.logz[-1], found.logzerr[-1])


class _PocoPrior:
    """The prior in the form that pocomc needs."""

    def __init__(self, target: Target, seed: int):
        self.bounds = np.array([(a, b) if kind == "u" else (0.0, np.inf) for kind, a, b in target.prior])
        self.dim, self.logpdf = target.ndim, target.log_prior
        self._target, self._random = target, _prior_stream(seed)

    def rvs(self, size=1):
        return self._target.sample_prior(size, self._random)


def _pocomc(target: Target, seed: int, flow: bool = True) -> _Outcome:
    import pocomc

    sampler = pocomc.Sampler(
        _PocoPrior(target, seed),
        target.log_likelihood,
        target.ndim,
        vectorize=True,
        precondition=flow,
        random_state=seed,
    )
    sampler.run(progress=False)
    samples, weights, _, _ = sampler.posterior()
    log_evidence, error = sampler.evidence()
    return _Outcome(samples, weights, float(log_evidence), None if error is None else float(error))


def _pocomc_no_flow(target: Target, seed: int) -> _Outcome:
    return _pocomc(target, seed, flow=False)


class Peer(NamedTuple):
    """Module of another sampler, the function that runs it, and how to install it."""

    module: str
    run: Callable[[Target, int], _Outcome]
    install: str = "pip install '.[peers]'"


_POCOMC = "pip install torch (its CPU build is small), then pocomc"
PEERS = {
    "emcee, stretch move": Peer("emcee", run_emcee),
    "zeus": Peer("zeus", _zeus),
    "PyMC, sample_smc": Peer("pymc", _pymc),
    "dynesty": Peer("dynesty", _dynesty),
    "pocomc": Peer("pocomc", _pocomc, _POCOMC),
    "pocomc, no flow": Peer("pocomc", _pocomc_no_flow, _POCOMC),
}


def _work(peer: str, name: str, seed: int, count: Any) -> dict:
    """Run a sampler, and return its cost and errors."""
    target = target_named(name)
    target.count = count
    start = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        outcome = PEERS[peer].run(target, seed)
    seconds = time.process_time() - start
    run = {"microseconds": 1e6 * seconds / target.evaluations}
    run |= errors(target, outcome.samples, outcome.weights)
    if outcome.log_evidence is not None:
        run["evidence"] = outcome.log_evidence - target.log_evidence
    if outcome.log_evidence_error is not None:
        run["error"] = outcome.log_evidence_error
    return run | {"warned": any(issubclass(warning.category, UserWarning) for warning in caught)}


def run_peer(peer: str, name: str, seed: int, limit: float) -> dict:
    """One run in its own process, stopped after the time limit [s]."""
    count = RawValue("q", 0)
    run = in_process(_work, peer, name, seed, count, limit=limit)
    return {"evaluations": count.value} | run


def rows(repeats: int, targets: tuple[str, ...] = ("T1", "T2", "T3", "T4"), limit: float = 150.0) -> list[Row]:
    """One row for each sampler and target, in the form of `samplers.rows`; one row for a sampler not installed."""
    table = []
    for peer, (module, _, install) in PEERS.items():
        if importlib.util.find_spec(module) is None:
            table.append(Row(f"{peer}: evaluations", "", None, "", f"not installed: {install}"))
            continue
        for name in targets:
            table.append(as_row(peer, name, [run_peer(peer, name, seed, limit) for seed in range(1, repeats + 1)]))
    return table
