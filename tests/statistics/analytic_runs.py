"""Runs of the samplers on analytic posteriors, compared with the truth.

A run is *doubted* if it issued a `SamplingWarning` or if its verdict is not "converged". It is *lost* if the share of a
mode differs from the truth by more than 0.15, or, without modes, if its log-evidence is off by more than four stated
errors and 0.5, or a mean by more than four stated errors and a quarter of the standard deviation.
"""

import itertools
import warnings
from typing import Any, NamedTuple

import numpy as np

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from tests.statistics import analytic_posteriors as targets

SAMPLERS = {"SMC": SMCSampler, "TMCMC": TMCMCSampler}
LOST_SHARE = 0.15
FAR = 4.0
DIMENSIONS = (4, 7, 10)
SEPARATIONS = (3.0, 6.0, 10.0, 18.0, 30.0)
MASS_RATIOS = (1.0, 3.0, 10.0)
SINGLE = {
    "narrow": targets.narrow_mode,
    "shapes": targets.three_shapes,
    "sharp": targets.gaussian,
    "banana": targets.banana,
    "rotated": targets.rotated_banana,
    "rosenbrock": targets.rosenbrock,
    "bounds": targets.bounds,
    "student": targets.student,
    "rough1": lambda seed: targets.rough(seed, 1.0),
    "rough2": lambda seed: targets.rough(seed, 2.0),
    "rough3": lambda seed: targets.rough(seed, 3.0),
}


class Cell(NamedTuple):
    """One line of the table: a family, its parameter (ratio of volumes, or dimension), a sampler and its walkers."""

    family: str
    parameter: float
    sampler: str
    walkers: int

    @property
    def name(self) -> str:
        """Name of the posterior in the table."""
        if self.family in ("two", "three"):
            return f"{self.family} modes, volumes 1:{self.parameter:g}"
        return f"Gaussian, {self.parameter:g}-D" if self.family == "growth" else self.family


def _posterior(cell: Cell, seed: int) -> targets.Posterior:
    """The posterior of one run. Modes: the combinations follow each other in a fixed random order."""
    if cell.family in SINGLE:
        return SINGLE[cell.family](seed)
    if cell.family == "growth":
        return targets.gaussian(seed, int(cell.parameter))
    combinations = list(itertools.product(DIMENSIONS, SEPARATIONS, MASS_RATIOS, ("normal", "box")))
    chosen = np.random.RandomState(0).permutation(len(combinations))[seed % len(combinations)]
    ndim, separation, mass_ratio, prior = combinations[chosen]
    count = 2 if cell.family == "two" else 3
    return targets.modes(seed, count, ndim, separation, mass_ratio, cell.parameter, prior)


def run(cell: Cell, seed: int, steps: int = 5, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Errors of a run with a chain of `steps`, and what it said; the seed is of both."""
    posterior = _posterior(cell, seed)
    sampler = SAMPLERS[cell.sampler](
        cell.walkers, posterior.ndim, posterior, vectorize=True, seed=1000 + seed, **(settings or {})
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sampler.run_mcmc(None, steps)
    warned = [str(each.message) for each in caught if issubclass(each.category, SamplingWarning)]
    chain = sampler.get_chain(flat=True)
    mean_error = np.maximum(sampler.mean_error(), 1e-300)
    found: dict[str, Any] = {
        **cell._asdict(),
        "ndim": posterior.ndim,
        "evaluations": sampler.evaluations,
        "log_evidence_error": sampler.log_evidence - posterior.log_evidence,
        "stated_error": sampler.log_evidence_error,
        "mean_z": ((chain.mean(axis=0) - posterior.mean) / mean_error).tolist(),
        "mean_off": ((chain.mean(axis=0) - posterior.mean) / posterior.sd).tolist(),
        "sd_ratio": (chain.std(axis=0) / posterior.sd).tolist(),
        "warnings": warned,
        "status": sampler.verdict.status,
    }
    if posterior.responsibilities is not None:
        shares = posterior.responsibilities(chain).mean(axis=0)
        found |= {"shares": shares.tolist(), "true_shares": posterior.shares.tolist()}
    return found


def is_doubted(found: dict[str, Any]) -> bool:
    """Whether a run has said that its result is doubtful."""
    return bool(found["warnings"]) or found["status"] != "converged"


def is_lost(found: dict[str, Any]) -> bool:
    """Whether the result of a run is wrong: the shares of the modes, or without modes the evidence or a mean."""
    if "shares" in found:
        return bool(np.max(np.abs(np.subtract(found["shares"], found["true_shares"]))) > LOST_SHARE)
    of_means = (np.abs(found["mean_z"]) > FAR) & (np.abs(found["mean_off"]) > 0.25)
    return abs(found["log_evidence_error"]) > max(FAR * found["stated_error"], 0.5) or bool(np.any(of_means))
