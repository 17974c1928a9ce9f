"""Evidence for strain penetration into the foundation, from the first halves of four cyclic column tests.

The length of strain penetration (`RCColumn`, argument ``penetration``) is zero ("rigid"), the slip of the bars at yield
divided by their yield strain, both from the table of properties ("table"), or free, as a multiple of that length with a
normal prior of mean 1 and standard deviation 0.5 ("free"). The six other parameters have the priors of
`benchmarks.tested_column`.

One sample in twelve is kept, with which the residuals of Lehman 415 are nearly white: evidence of more samples would
count correlated errors as independent ones, and state the differences too large by a factor. The rows of "lag-one
correlation" say how far this holds for the other columns. White noise, standard deviation integrated out.

The posteriors are bent. A guide needs about a thousand simulations; where its verdict is "not usable", the moves
without recycling take its place, with about thirteen thousand.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fe_likelihoods import FELikelihood, GaussianNoise, HalfNormal, Posterior, RCColumn, residual_checks
from samplers import SMCSampler

from . import tested_column
from .measured_transfer import skipped
from .rows import Row
from .tested_column import HISTORY, PRIOR, PROPERTIES, SIGMA, first_half, specimens

__all__ = ["evidence"]

_EVERY = 12
_WALKERS = 300


class _Run(NamedTuple):
    """Log-evidence with its standard error, verdict, simulations, mean of the penetration and lag-one correlation."""

    log_evidence: float
    error: float
    status: str
    simulations: int
    mean: np.ndarray
    sd: np.ndarray
    lag_one: float


def evidence(repeats: int = 1) -> list[Row]:
    """Log-evidence of three lengths of strain penetration, per column and seed."""
    folder = tested_column.FOLDER.name
    if rows := skipped("strain_penetration", *(f"{folder}/{file}" for file in (HISTORY, PROPERTIES))):
        return rows
    rows = []
    for tested in specimens(_EVERY).specimens:
        model, measured = first_half(tested)
        for seed in range(1, repeats + 1):
            rigid = None
            for label, variant in _variants(model).items():
                run = _sample(variant, measured, seed)
                rigid = rigid or run
                case = f"{tested.name}, {label}, seed {seed}"
                note = f"+- {run.error:.2f}, {run.status}, {run.simulations} simulations"
                rows.append(Row("log-evidence", case, run.log_evidence, "", note))
                if run is not rigid:
                    error = np.hypot(run.error, rigid.error)
                    rows.append(Row("minus rigid", case, run.log_evidence - rigid.log_evidence, "", f"+- {error:.2f}"))
                note = f"residuals of {measured.n_steps} samples at the posterior mean"
                rows.append(Row("lag-one correlation", case, run.lag_one, "", note))
                if "penetration" in variant.parameters:
                    i, length = variant.parameters.index("penetration"), variant.penetration
                    note = f"+- {length * run.sd[i]:.3f} m; {run.mean[i]:.2f} +- {run.sd[i]:.2f} of the table's"
                    rows.append(Row("penetration", case, length * run.mean[i], "m", note))
    return rows


def _variants(model: RCColumn) -> dict[str, RCColumn]:
    others = tuple(name for name in model.parameters if name != "penetration")
    table = f"table ({model.penetration:.3f} m)"
    return {
        "rigid": replace(model, penetration=0.0, parameters=others),
        table: replace(model, parameters=others),
        "free": model,
    }


def _sample(model: RCColumn, measured, seed: int) -> _Run:
    prior = {name: PRIOR[name] for name in model.parameters} | {"sigma_force": HalfNormal(SIGMA)}
    posterior = Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()
    for settings in ({"guide": posterior.guide()}, {"recycle": False}):
        sampler = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
        sampler.run_mcmc(None, 2, progress=False)
        if sampler.verdict.status != "not usable":
            break
    samples = sampler.get_chain(flat=True)
    mean = samples.mean(axis=0)
    residuals = measured.values - model.simulate(mean[: len(model.parameters)])
    return _Run(
        sampler.log_evidence,
        sampler.log_evidence_error,
        sampler.verdict.status,
        posterior.report()["simulations"],
        mean,
        samples.std(axis=0),
        float(residual_checks(residuals).lag_one[0]),
    )
