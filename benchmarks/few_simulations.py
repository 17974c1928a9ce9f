"""Posteriors from a few hundred simulations: samplers with a budget on problems whose answers are known.

The references of the problems are stored in ``few_simulations_references.json``, each with its method: importance
sampling from the known modes or by one annealing per mode, a long run of the default sampler, or quadrature. The code
that made them is at the git tag ``studies-0.3``. No simulation is shared between references and runs.

Methods: ``guide`` is ``SMCSampler(100, ndim, posterior, vectorize=True, guide=posterior.guide(), max_simulations=N)``,
``default`` the sampler with 500 walkers and without budget.

Columns: simulations of the whole record (parts count as fractions) up to the weighted draws and with the first sweep
of the walkers, effective sample size, errors against the reference (of means in posterior standard deviations), and a
judgement: "WRONG" is a result that does not lie within its own errors although its verdict is better than "not usable".
"""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import Posterior

from .few_simulations_problems import PROBLEMS
from .guided_runs import compare, run

__all__ = ["few_simulations", "reference_of"]

FILE = Path(__file__).with_name("few_simulations_references.json")
METHODS = ("guide", "default")
DEFAULT = ("few_samples", "two_modes", "banana", "oscillator", "column4", "twin")


class Run(NamedTuple):
    """One line of the table."""

    problem: str
    seed: int
    method: str
    budget: int
    judgement: str
    verdict: str = ""
    weighted: float | None = None
    simulations: float | None = None
    ESS: float | None = None
    log_Z: float | None = None
    stated: float | None = None
    error: float | None = None
    in_stated: float | None = None
    means: float | None = None
    sd: float | None = None
    share: float | None = None
    wall_s: float | None = None


def few_simulations(
    repeats: int,
    problems: tuple[str, ...] = DEFAULT,
    budgets: tuple[int, ...] = (200, 500),
    methods: tuple[str, ...] = ("guide",),
) -> Iterator[Run]:
    """One row per problem, method, budget and seed.

    Parameters
    ----------
    repeats : int
        Number of seeds, of data and sampler.
    problems : tuple of str
        Names in `PROBLEMS`.
    budgets : tuple of int
        Largest numbers of simulations.
    methods : tuple of str
        Some of `METHODS`.
    """
    for name in _known(problems, tuple(PROBLEMS)):
        for method in _known(methods, METHODS):
            for budget in budgets if method != "default" else (0,):
                for seed in range(1, repeats + 1):
                    yield _one(name, method, budget, seed)


def _known(names: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
    if unknown := set(names) - set(known):
        raise ValueError(f"expected names among {', '.join(known)}; got {', '.join(sorted(unknown))}")
    return names


def _one(name: str, method: str, budget: int, seed: int) -> Run:
    posterior = PROBLEMS[name].posterior(seed)
    known = reference_of(name, seed, posterior)
    if method == "default":
        outcome = run(posterior, seed, None, guided=False, nwalkers=500)
    else:
        outcome = run(posterior, seed, budget)
    start = name, seed, method, budget
    if outcome.failed:
        return Run(*start, outcome.failed)
    errors = None if known is None else compare(outcome, known, PROBLEMS[name].labels)
    cost = outcome.weighted, outcome.simulations, outcome.effective_sample_size
    evidence = outcome.log_evidence, outcome.log_evidence_error
    if errors is None:
        row = Run(*start, "no reference", outcome.status, *cost, *evidence)
    else:
        against = errors.log_evidence, errors.log_evidence_z, errors.mean, errors.sd, errors.share
        row = Run(*start, errors.judgement, outcome.status, *cost, *evidence, *against)
    return row._replace(wall_s=outcome.seconds)


# ---------------------------------------------------------------- references


def reference_of(name: str, seed: int, posterior: Posterior) -> Any:
    """Reference of a problem and seed, or None. It is of the posterior: data may differ in their last bits."""
    if PROBLEMS[name].exact is not None:
        return PROBLEMS[name].exact(posterior)
    entry = load().get(f"{name.removesuffix('_jacobian')} {seed}")  # derivatives do not change a posterior
    if entry is None:
        return None
    return SimpleNamespace(**{key: np.array(v) if isinstance(v, list) else v for key, v in entry.items()})


def load() -> dict[str, dict[str, Any]]:
    """The stored references."""
    return json.loads(FILE.read_text())
