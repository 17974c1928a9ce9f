"""What the tutorials on real measurements share: where the data are, three noises for one model, honest tables."""

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods.probability.likelihood import FELikelihood
from fe_likelihoods.probability.noise import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.probability.posterior import Posterior
from fe_likelihoods.probability.priors import Distribution, Prior, Uniform
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.simulation.model import Model
from samplers import SMCSampler
from samplers.reporting.summary import summary

FAST = bool(os.environ.get("FAST"))
BESIDE = Path(os.environ.get("FE_SHARED", Path(__file__).resolve().parents[2] / "shared")) / "measured"
NOISES = ("white", "n_eff") if FAST else ("white", "AR(1)", "n_eff")
COLOURS = {"white": "#8a8f98", "AR(1)": "#d9822b", "n_eff": "#1f5a8c"}


class Run(NamedTuple):
    """A posterior and its draws."""

    posterior: Posterior
    sampler: SMCSampler
    draws: np.ndarray


def arguments(description: str, out: str) -> argparse.ArgumentParser:
    """Options that these tutorials have in common."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--data", type=Path, help=f"folder that holds the downloaded files, at any depth (default: {BESIDE})"
    )
    parser.add_argument("--walkers", type=int, default=40 if FAST else 300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(out))
    return parser


def find(folder: Path | None, pattern: str, source: str) -> Path:
    """The one file of this kind in a folder, at any depth; without it the tutorial ends, and says where it is from."""
    looked_in = BESIDE if folder is None else folder
    found = sorted(looked_in.rglob(pattern)) if looked_in.is_dir() else []
    if found:
        if FAST:
            print("REDUCED SETTING (FAST): few walkers; expect a rough posterior, or one mode where there are two")
        return found[0]
    message = f"NO DATA: no file {pattern} in {looked_in}; get it from {source}, and name its folder with --data"
    if folder is not None:
        raise SystemExit(message)
    print(message)  # nobody asked for this folder: whoever runs all tutorials goes on with the next one
    raise SystemExit(0)


def sampled(
    model: Model,
    measured: Measurements,
    prior: Mapping[str, Distribution],
    scale: Mapping[str, Distribution],
    noise: str,
    effective: Sequence[float] | None,
    args: argparse.Namespace,
    walkers: int | None = None,
) -> Run:
    """Draws of the posterior of one model under one of the `NOISES`; `scale` are the priors of the sigmas."""
    walkers = args.walkers if walkers is None else walkers
    if noise == "AR(1)":
        kind, more = AutoregressiveNoise(model.channels), {f"rho_{c.name}": Uniform(0.0, 1.0) for c in model.channels}
    else:
        kind, more = GaussianNoise(model.channels, effective_samples=effective if noise == "n_eff" else None), {}
    posterior = Posterior(FELikelihood(model, measured, kind), Prior({**prior, **scale, **more}))
    settings = {"max_moves": 4} if walkers < 250 else {}
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=args.seed, **settings)
    sampler.run_mcmc(None, 4, progress=False)
    return Run(posterior, sampler, sampler.get_chain(flat=True))


def residuals(run: Run) -> np.ndarray:
    """Measured less simulated at the posterior mean, (n_channels, n_steps) [SI]."""
    return run.posterior.likelihood.residuals(run.draws.mean(axis=0))


def posterior_table(runs: Mapping[str, Run]) -> str:
    """Mean and standard deviation of every parameter under every noise."""
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
    """From 5 to 95 % of the sum of squares."""
    share = np.cumsum(history**2) / np.sum(history**2)
    return slice(int(np.searchsorted(share, 0.05)), int(np.searchsorted(share, 0.95)) + 1)
