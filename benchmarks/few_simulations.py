"""Posteriors from a few hundred simulations: samplers with a budget on problems whose answers are known.

The problems are the small posteriors of `tests.statistics.hard_posteriors`, whose references are found by brute force
(ten seconds each, kept in ``results/few_simulations.json``), and those of `few_simulations_problems`, whose references
are our own results and take minutes to hours. They are kept in ``few_simulations_references.json``, and
`references` makes those that are missing. No simulation is shared between references and runs.

Methods: ``guide`` is ``SMCSampler(100, ndim, posterior, vectorize=True, guide=posterior.guide(), max_simulations=N)``,
``default`` the sampler with 500 walkers and without budget. PyVBMC (Acerbi 2018, arXiv:1810.05558) and GPry (El Gammal
et al. 2023, doi:10.1088/1475-7516/2023/10/021) fit a Gaussian process to the log-density and sample the fit, without a
correction. They need an environment of their own::

    python -m venv .venv-few-simulations
    .venv-few-simulations/bin/pip install --editable . pyvbmc gpry
    .venv-few-simulations/bin/python -m benchmarks few_simulations methods=PyVBMC,GPry budgets=200,500

Columns: simulations of the whole record (parts count as fractions) up to the weighted draws and with the first sweep
of the walkers, effective sample size, errors against the reference (of means in posterior standard deviations), and a
judgement: "WRONG" is a result that does not lie within its own errors although its verdict is better than "not usable".
"""

import importlib.util
import json
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import Posterior
from samplers import SMCSampler
from tests.statistics.brute_force import Reference, reference
from tests.statistics.guided_runs import Outcome, compare, run
from tests.statistics.hard_posteriors import CASES

from .few_simulations_peers import PEERS
from .few_simulations_problems import PROBLEMS, Problem
from .importance_reference import by_importance, by_reciprocals
from .processes import in_process
from .rows import Row

__all__ = ["coverage", "few_simulations", "reference_of", "references"]

FILE = Path(__file__).with_name("few_simulations_references.json")
BRUTE_FORCE = Path("results") / "few_simulations.json"
METHODS = ("guide", "default", *PEERS)
DEFAULT = ("few_samples", "two_modes", "banana", "oscillator", "column4", "twin")
OF_COVERAGE = ("oscillator", "smooth", "few_samples", "two_modes", "banana", "bounds", "rough", "failing_scattered")
DATA_SETS = 4
LONG = 8  # sweeps at beta = 1 of a reference by the default sampler


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
    own_CPU_s: float | None = None


class Coverage(NamedTuple):
    """One line of the table of `coverage`: counts of verdicts, percentages, means.

    Alarms are warnings and the verdict "not usable": `false_alarms` counts them in the `right` runs, `missed` counts
    the other runs without any.
    """

    problem: str
    budget: int
    runs: int
    failed: int
    not_usable: int
    usable: int
    converged: int
    log_Z_covered: float | None
    means_covered: float | None
    simulations: float | None
    ESS: float | None
    right: int
    false_alarms: int
    missed: int


def few_simulations(
    repeats: int,
    problems: tuple[str, ...] = DEFAULT,
    budgets: tuple[int, ...] = (200, 500),
    methods: tuple[str, ...] = ("guide",),
    limit: float = 900.0,
) -> Iterator[Run]:
    """One row per problem, method, budget and seed.

    Parameters
    ----------
    repeats : int
        Number of seeds, of data and sampler.
    problems : tuple of str
        Names in `CASES` and `PROBLEMS`.
    budgets : tuple of int
        Largest numbers of simulations.
    methods : tuple of str
        Some of `METHODS`.
    limit : float
        Wall time of a run of another program [s].
    """
    for name in _known(problems, (*CASES, *PROBLEMS)):
        for method in _known(methods, METHODS):
            for budget in budgets if method != "default" else (0,):
                for seed in range(1, repeats + 1):
                    missing = PROBLEMS[name].needs() if name in PROBLEMS else ""
                    if method in PEERS and importlib.util.find_spec(PEERS[method].module) is None:
                        missing = f"not installed: {PEERS[method].install}"
                    if missing:
                        yield Run(name, seed, method, budget, missing)
                        break
                    yield _one(name, method, budget, seed, limit)


def _known(names: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
    if unknown := set(names) - set(known):
        raise ValueError(f"expected names among {', '.join(known)}; got {', '.join(sorted(unknown))}")
    return names


def _posterior(name: str, seed: int) -> tuple[Posterior, Any]:
    """Posterior, and the function that gives the number of the mode of samples."""
    if name in CASES:
        return CASES[name].posterior(seed, name), CASES[name].label
    return PROBLEMS[name].posterior(seed), PROBLEMS[name].labels


def _one(name: str, method: str, budget: int, seed: int, limit: float) -> Run:
    posterior, labels = _posterior(name, seed)
    known = reference_of(name, seed, posterior)
    if method in PEERS:
        outcome = in_process(peer_run, method, name, seed, budget, limit=limit)
        outcome = Outcome(failed=outcome["reason"]) if isinstance(outcome, dict) else outcome
    elif method == "default":
        outcome = run(posterior, seed, None, guided=False, nwalkers=500)
    else:
        outcome = run(posterior, seed, budget)
    start = name, seed, method, budget
    if outcome.failed:
        return Run(*start, outcome.failed)
    errors = None if known is None else compare(outcome, known, labels)
    cost = outcome.weighted, outcome.simulations, outcome.effective_sample_size
    evidence = outcome.log_evidence, outcome.log_evidence_error
    if errors is None:
        row = Run(*start, "no reference", outcome.status, *cost, *evidence)
    else:
        against = errors.log_evidence, errors.log_evidence_z, errors.mean, errors.sd, errors.share
        row = Run(*start, errors.judgement, outcome.status, *cost, *evidence, *against)
    return row._replace(wall_s=outcome.seconds, own_CPU_s=outcome.overhead)


def peer_run(method: str, name: str, seed: int, budget: int) -> Outcome:
    """Run another program on a problem."""
    return PEERS[method].run(_posterior(name, seed)[0], seed, budget)


def coverage(
    repeats: int,
    problems: tuple[str, ...] = OF_COVERAGE,
    budgets: tuple[int, ...] = (200, 500, 2000),
    runs: int = 40,
) -> Iterator[Coverage]:
    """How often two standard errors of log Z, and of each mean, contain the truth; it should be in 90 % of the runs.

    Four data sets, and a new seed of the sampler with each run. A run whose verdict is "not usable" makes no claim: it
    is counted, but not in the coverage. No verdict "converged" should be of a run that was wrong.
    """
    for name in _known(problems, (*CASES, *PROBLEMS)):
        for budget in budgets:
            yield _coverage(name, budget, runs * repeats)


def _coverage(name: str, budget: int, runs: int) -> Coverage:
    status, evidence, means, simulations, effective = [], [], [], [], []
    right = false_alarms = missed = 0
    for seed in range(1, runs + 1):
        data = 1 + seed % DATA_SETS
        posterior, labels = _posterior(name, data)
        known = reference_of(name, data, posterior)
        if known is None:
            raise ValueError(f"no reference of {name}, seed {data}: python -m benchmarks few_simulations_references")
        outcome = run(posterior, 1000 + seed, budget)
        errors = compare(outcome, known, labels)
        status.append("failed" if outcome.failed else outcome.status)
        alarm = bool(outcome.failed or outcome.warnings or outcome.status == "not usable")
        right += not (outcome.failed or errors.wrong)
        false_alarms += alarm and not (outcome.failed or errors.wrong)
        missed += errors.wrong and not alarm
        if outcome.failed or outcome.status == "not usable":
            continue
        evidence.append(100.0 * (abs(errors.log_evidence_z) < 2.0))
        error = np.hypot(outcome.mean_error, known.mean_error)
        means.append(100.0 * np.mean(np.abs(outcome.mean - known.mean) < 2.0 * error))
        simulations.append(outcome.simulations)
        effective.append(outcome.effective_sample_size)
    counts = (status.count(each) for each in ("failed", "not usable", "usable", "converged"))
    averages = (float(np.mean(each)) if each else None for each in (evidence, means, simulations, effective))
    return Coverage(name, budget, runs, *counts, *averages, right, false_alarms, missed)


# ---------------------------------------------------------------- references


def reference_of(name: str, seed: int, posterior: Posterior) -> Any:
    """Reference of a problem and seed, or None; ValueError if the data are not those it was made with."""
    if name in CASES:
        return _by_brute_force(name, seed)
    if PROBLEMS[name].exact is not None:
        return PROBLEMS[name].exact(posterior)
    entry = load().get(key_of(name, seed))
    if entry is None:
        return None
    if entry["data"] != posterior.data_fingerprint:
        raise ValueError(
            f"the reference of {name}, seed {seed}, was made with other data: delete it from {FILE.name} and run "
            "`python -m benchmarks few_simulations_references`"
        )
    return SimpleNamespace(**{key: np.array(v) if isinstance(v, list) else v for key, v in entry.items()})


def _by_brute_force(name: str, seed: int) -> Reference:
    """Reference of a small posterior, computed once."""
    kept = json.loads(BRUTE_FORCE.read_text()) if BRUTE_FORCE.exists() else {}
    key = f"{name} {seed}"
    if key not in kept:
        kept[key] = [np.asarray(value).tolist() for value in reference(CASES[name], seed)]
        BRUTE_FORCE.parent.mkdir(parents=True, exist_ok=True)
        BRUTE_FORCE.write_text(json.dumps(kept))
    return Reference(*[np.array(value) if isinstance(value, list) else value for value in kept[key]])


def load() -> dict[str, dict[str, Any]]:
    """The stored references."""
    return json.loads(FILE.read_text())


def key_of(name: str, seed: int) -> str:
    """Key of a problem and seed: measured data have one reference, and derivatives do not change a posterior."""
    return f"{name.removesuffix('_jacobian')} {1 if PROBLEMS[name].measured else seed}"


def references(repeats: int, problems: tuple[str, ...] = tuple(PROBLEMS)) -> Iterator[Row]:
    """Make the references that are missing, of the seeds from 1 to `repeats`: hours."""
    for name in _known(problems, tuple(PROBLEMS)):
        for seed in range(1, repeats + 1):
            if missing := PROBLEMS[name].needs():
                yield Row("reference", f"{name}, seed {seed}", None, "", missing)
                break
            if PROBLEMS[name].exact is None and key_of(name, seed) not in load():
                yield _make_reference(name, PROBLEMS[name], seed)


def _make_reference(name: str, problem: Problem, seed: int) -> Row:
    posterior, start = problem.posterior(seed), time.perf_counter()
    if problem.reciprocals:
        method = "importance sampling in reciprocals from the known mode"
        found = by_reciprocals(posterior, problem.starts(posterior)[0], draws=problem.reference_draws, seed=seed)
    elif problem.reference_draws:
        method = "importance sampling from the known modes"
        found = by_importance(
            posterior,
            problem.starts(posterior),
            draws=problem.reference_draws,
            rounds=problem.reference_rounds,
            seed=seed,
            labels=problem.labels,
        )
    else:
        method = f"default SMCSampler, {problem.walkers} walkers, {LONG} sweeps"
        found = _long_run(posterior, problem, seed)
    if posterior.ndim == 2:
        method, found = "quadrature", _quadrature(posterior, found)
    entry = {
        key: _rounded(value) if np.ndim(value) else (round(value, 6) if np.isfinite(value) else None)
        for key, value in found._asdict().items()
    }
    report = posterior.report()
    entry |= {
        "data": posterior.data_fingerprint,
        "parameters": posterior.parameter_names,
        "simulations": report["simulations"],
        "failures": report["failure_count"],
        "method": method,
    }
    lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in sorted((load() | {key_of(name, seed): entry}).items())]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    note = f"+- {found.log_evidence_error:.3f}; {method}; {report['simulations']} simulations, "
    note += f"{time.perf_counter() - start:.0f} s"
    return Row("reference: log-evidence", f"{name}, seed {seed}", float(found.log_evidence), "", note)


def _rounded(values: Any) -> Any:
    return np.asarray([float(f"{value:.6g}") for value in np.ravel(values)]).tolist()


def _quadrature(posterior: Posterior, about: Reference, points: int = 141, reach: float = 7.0) -> Reference:
    """The same by the midpoint rule for two parameters, `reach` standard deviations about the mean."""
    axes = [mean + sd * np.linspace(-reach, reach, points) for mean, sd in zip(about.mean, about.sd, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    values = posterior(grid)
    weights = np.exp(values - values.max())
    area = np.prod([axis[1] - axis[0] for axis in axes])
    w = weights / weights.sum()
    mean = w @ grid
    none = np.zeros(2)
    return about._replace(
        log_evidence=float(values.max() + np.log(weights.sum() * area)),
        log_evidence_error=0.0,
        mean=mean,
        mean_error=none,
        sd=np.sqrt(w @ (grid - mean) ** 2),
        sd_error=none,
        effective_sample_size=float("inf"),
        draws=len(grid),
    )


def _long_run(posterior: Posterior, problem: Problem, seed: int) -> Reference:
    """Reference from the default sampler; errors as the sampler reports them."""
    sampler = SMCSampler(problem.walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, LONG)
    samples = sampler.get_chain(flat=True)
    error, sd = sampler.mean_error(), samples.std(axis=0)
    n = float((sd / error).min() ** 2)  # effective sample size of the worst mean
    label = np.zeros(len(samples), dtype=int) if problem.labels is None else problem.labels(samples)
    shares = np.bincount(label) / len(label)
    return Reference(
        float(sampler.log_evidence),
        float(sampler.log_evidence_error),
        samples.mean(axis=0),
        error,
        sd,
        sd / np.sqrt(2.0 * n),
        shares,
        np.sqrt(shares * (1.0 - shares) / n),
        n,
        len(samples),
    )
