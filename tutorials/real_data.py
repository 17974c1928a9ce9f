"""Shared parts of the tutorials on real measurements: options, data files, one model under three noises, tables."""

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods import AutoregressiveNoise, FELikelihood, GaussianNoise, Measurements, Posterior, Prior, Uniform
from fe_likelihoods.priors.distributions import Distribution
from fe_likelihoods.simulation.model import Model
from samplers import SMCSampler, summary

FAST = bool(os.environ.get("FAST"))
NOISES = ("white", "n_eff") if FAST else ("white", "AR(1)", "n_eff")


class Run(NamedTuple):
    """A posterior, its sampler and its draws.

    Attributes
    ----------
    posterior : Posterior
        The posterior.
    sampler : SMCSampler
        The sampler after its run.
    draws : (n, ndim) float
        Draws from the posterior.
    """

    posterior: Posterior
    sampler: SMCSampler
    draws: np.ndarray


def add_common_options(parser: argparse.ArgumentParser, out: str) -> None:
    """Add the options that the tutorials on real measurements share; `out` is the default folder of the results."""
    parser.add_argument("--data", type=Path, help="required: folder of the downloaded files, searched at any depth")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sampler and of the predictions")
    parser.add_argument("--out", type=Path, default=Path(out), help="folder of the results")


def find_file(folder: Path | None, pattern: str, source: str) -> Path:
    """The first file that matches a pattern in a folder, at any depth.

    Raises
    ------
    SystemExit
        If no folder is given or it has no such file: the message names the source of the data.
    """
    if folder is None:
        raise SystemExit(f"--data is required: the folder that contains {pattern}. Download the data from {source}.")
    found = sorted(folder.rglob(pattern)) if folder.is_dir() else []
    if not found:
        raise SystemExit(f"NO DATA: no file {pattern} in {folder}. Download it from {source}; --data names its folder.")
    return found[0]


def sample_posterior(
    model: Model,
    measured: Measurements,
    prior: Mapping[str, Distribution],
    scale: Mapping[str, Distribution],
    noise: str,
    effective: Sequence[float] | None,
    walkers: int,
    seed: int,
) -> Run:
    """Sample the posterior of a model under one of the `NOISES` with SMC.

    Parameters
    ----------
    model : Model
        The model.
    measured : Measurements
        The measurements.
    prior : mapping of str to Distribution
        Priors of the structural parameters.
    scale : mapping of str to Distribution
        Priors of the noise standard deviations, one per channel.
    noise : {"white", "AR(1)", "n_eff"}
        Noise model.
    effective : sequence of float or None
        Effective number of samples per channel, for noise "n_eff".
    walkers : int
        Number of particles.
    seed : int
        Seed of the sampler.

    Returns
    -------
    Run
        Posterior, sampler and draws.
    """
    if noise == "AR(1)":
        kind, more = AutoregressiveNoise(model.channels), {f"rho_{c.name}": Uniform(0.0, 1.0) for c in model.channels}
    else:
        kind, more = GaussianNoise(model.channels, effective_samples=effective if noise == "n_eff" else None), {}
    posterior = Posterior(FELikelihood(model, measured, kind), Prior({**prior, **scale, **more}))
    settings = {"max_moves": 4} if walkers < 250 else {}
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
    sampler.run_mcmc(None, 4, progress=False)
    return Run(posterior, sampler, sampler.get_chain(flat=True))


def mean_residuals(run: Run) -> np.ndarray:
    """Measured minus simulated at the posterior mean, (n_channels, n_steps) [SI]."""
    return run.posterior.likelihood.residuals(run.draws.mean(axis=0))


def format_posteriors(runs: Mapping[str, Run]) -> str:
    """Mean and standard deviation of every parameter under every noise, as a table."""
    names = list(dict.fromkeys(name for run in runs.values() for name in run.posterior.parameter_names))
    rows = [f"{'parameter':<14}" + "".join(f"{label:>22}" for label in runs)]
    for name in names:
        cells = []
        for run in runs.values():
            own = run.posterior.parameter_names
            if name in own:
                moments = summary(run.draws, own)
                i = own.index(name)
                cells.append(f"{moments.mean[i]:.4f} +- {moments.sd[i]:.4f}")
            else:
                cells.append("-")
        rows.append(f"{name:<14}" + "".join(f"{cell:>22}" for cell in cells))
    simulations = [run.posterior.report()["simulations"] for run in runs.values()]
    rows.append(f"{'simulations':<14}" + "".join(f"{number:>22}" for number in simulations))
    return "\n".join(rows)


def strong_motion(history: np.ndarray) -> slice:
    """The samples between 5 and 95 % of the cumulative sum of squares of a history (n_steps,)."""
    share = np.cumsum(history**2) / np.sum(history**2)
    return slice(int(np.searchsorted(share, 0.05)), int(np.searchsorted(share, 0.95)) + 1)
