"""PyVBMC and GPry on a posterior with a budget of evaluations, for `benchmarks.few_simulations`.

Settings are the defaults of the other program, except the number of evaluations. PyVBMC has the prior's bounds (the
quantiles of 1e-12 where these are infinite) and starts at its median; it stops by itself when it has converged, often
before the budget. GPry has a uniform prior, in the box of the quantiles of 1e-4, and draws its first points between
the quantiles of 16 and 84 %.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tests.statistics.guided_runs import Outcome

__all__ = ["PEERS", "Peer"]

LOWEST = -1e5  # log-density where it is -inf: the others need a finite number
DRAWS = 4000  # from the fit


class _Counted:
    """The posterior as a function of one point that is counted and never infinite."""

    def __init__(self, posterior: Any) -> None:
        self.posterior, self.calls = posterior, 0

    def __call__(self, x: np.ndarray) -> float:
        self.calls += 1
        return max(float(self.posterior.log_prob(np.asarray(x, dtype=float).ravel())), LOWEST)


def _limits(posterior: Any) -> dict[str, np.ndarray]:
    """Median, bounds, and quantiles of the prior, (ndim,) each: 16 and 84 % (plausible), 0.01 and 99.99 %."""
    distributions = posterior.prior.distributions.values()
    bounds = np.array([d.bounds for d in distributions])
    levels = (1e-12, 1e-4, 0.16, 0.5, 0.84, 1.0 - 1e-4, 1.0 - 1e-12)
    quantile = {u: np.array([float(d.ppf(u)) for d in distributions]) for u in levels}
    return {
        "median": quantile[0.5],
        "low": np.where(np.isfinite(bounds[:, 0]), bounds[:, 0], quantile[1e-12]),
        "high": np.where(np.isfinite(bounds[:, 1]), bounds[:, 1], quantile[1.0 - 1e-12]),
        "least": quantile[1e-4],
        "most": quantile[1.0 - 1e-4],
        "plausible_low": quantile[0.16],
        "plausible_high": quantile[0.84],
    }


def _pyvbmc(posterior: Any, seed: int, budget: int) -> Outcome:
    from pyvbmc import VBMC

    target, at = _Counted(posterior), _limits(posterior)
    sampler = VBMC(
        target,
        *(at[key][None] for key in ("median", "low", "high", "plausible_low", "plausible_high")),
        options={"max_fun_evals": budget, "display": "off"},
        seed=seed,
    )
    fit, results = sampler.optimize()
    samples = np.asarray(fit.sample(DRAWS)[0])
    status = f"{results['convergence_status']}, r {float(results['r_index']):.2f}"
    return _approximate(samples, target.calls, results["elbo"], results["elbo_sd"], status)


def _approximate(samples: np.ndarray, calls: int, log_evidence: Any, error: Any, status: str) -> Outcome:
    """Outcome of a method that samples its own fit."""
    sd = samples.std(axis=0)
    return Outcome(
        log_evidence=float(log_evidence),
        log_evidence_error=float(error),
        mean=samples.mean(axis=0),
        mean_error=sd / np.sqrt(len(samples)),
        sd=sd,
        samples=samples,
        effective_sample_size=float(len(samples)),
        simulations=float(calls),
        status=status,
    )


def _gpry(posterior: Any, seed: int, budget: int) -> Outcome:
    from gpry import Runner

    target, at, d = _Counted(posterior), _limits(posterior), posterior.ndim
    low, high = np.maximum(at["low"], at["least"]), np.minimum(at["high"], at["most"])
    volume = np.log(high - low).sum()  # its prior is uniform in the box: its log Z is that of the density times this
    runner = Runner(
        lambda x: target(x) + volume,
        np.stack([low, high], axis=1).tolist(),
        ref_bounds=np.stack([at["plausible_low"], at["plausible_high"]], axis=1).tolist(),
        params=[f"x{i}" for i in range(d)],
        options={"max_total": budget, "max_initial": min(budget, int(30 * d**1.5))},
        seed=seed,
        verbose=1,
    )
    runner.run()
    runner.generate_mc_sample()
    draws = runner.last_mc_samples()
    weights = np.ones(len(draws["X"])) if draws["w"] is None else np.asarray(draws["w"])
    rng = np.random.default_rng(seed)
    samples = np.asarray(draws["X"])[rng.choice(len(weights), DRAWS, p=weights / weights.sum())]
    status = "converged" if runner.has_converged else "not converged"
    return _approximate(samples, target.calls, *runner.last_mc_logZ(), status)


class Peer(NamedTuple):
    """Module of another program, the function that runs it, and how to install it."""

    module: str
    run: Callable[[Any, int, int], Outcome]
    install: str


PEERS = {
    "PyVBMC": Peer("pyvbmc", _pyvbmc, "pip install pyvbmc"),
    "GPry": Peer("gpry", _gpry, "pip install gpry"),
}
