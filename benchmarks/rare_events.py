"""Subset simulation against closed forms, a series system, and Monte Carlo of the bundled column.

`rare_events`: linear limit states of 2, 10 and 100 standard normal parameters, a series system of four branches, and
posteriors (a correlated normal density, and gamma-distributed parameters), each over seeds. The rows are the mean
estimate over the exact probability, its scatter over seeds (coefficient of variation) and the stated one, the share of
95 % intervals that hold the exact value, and the number of simulations. The control states errors as if the points of a
level were independent.

`rare_column`: probability that the peak displacement of the bundled column exceeds a threshold over its prior, by
subset simulation with several seeds and by Monte Carlo.
"""

import numpy as np
from scipy import stats

from fe_likelihoods import problems
from samplers import subset_simulation
from tests.tempering.rare import correlated, four_branches, four_branches_exact, gammas, linear, summarise

from .rows import Row

__all__ = ["rare_column", "rare_events"]


def rare_events(repeats: int = 1, seeds: int = 100) -> list[Row]:
    """Means, scatter, stated errors and coverage over seeds."""
    rows = []

    def add(case: str, runs: list, exact: float) -> None:
        ratios, stated, inside = summarise(runs, exact)
        n, scatter = len(runs), ratios.std()
        naive = np.sqrt(np.mean([np.sum((1.0 - run.shares) / (points * run.shares)) for run in runs]))
        rows.append(Row("mean over exact", case, ratios.mean(), "", f"+- {scatter / np.sqrt(n):.3f}"))
        rows.append(Row("coefficient of variation", case, scatter, "", f"+- {scatter / np.sqrt(2 * n):.3f}"))
        rows.append(Row("the stated one", case, stated, "", f"control: {naive:.2f}"))
        rows.append(Row("95 % interval holds the probability", case, 100.0 * inside.mean(), "%"))
        rows.append(Row("simulations", case, np.mean([run.simulations for run in runs]), ""))

    for points in (1000, 4000):
        for ndim in (2, 10, 100):
            for probability in (1e-3, 1e-4, 1e-6):
                limit, each = stats.norm.isf(probability), range(repeats * seeds)
                runs = [subset_simulation(linear, limit, ndim, n=points, seed=seed) for seed in each]
                add(f"linear, {ndim} parameters, {probability:g}, n={points}", runs, probability)
    points, exact = 1000, four_branches_exact()
    runs = [subset_simulation(four_branches, 0.0, 2, seed=seed) for seed in range(repeats * seeds)]
    add(f"four branches, {exact:.4g}", runs, exact)
    for case, density in (("normal, 3 parameters", correlated), ("gamma, 10 parameters", gammas)):
        for exact in (1e-3, 1e-5):
            limit, options = density.threshold(exact), {"log_prob_fn": density.log_prob}
            runs = [
                subset_simulation(density.quantity, limit, initial=density.draws(points, seed), seed=seed, **options)
                for seed in range(repeats * seeds)
            ]
            add(f"posterior: {case}, {exact:g}", runs, exact)
    return rows


def rare_column(repeats: int = 1, threshold: float = 0.08, simulations: int = 10_000, seeds: int = 4) -> list[Row]:
    """Subset simulation and Monte Carlo of the bundled column, under its prior and its motion of ten seconds."""
    posterior = problems.bridge_column(data="short")
    column = posterior.likelihood.model
    prior = posterior.prior.subset(column.parameter_names)

    def drift(points: np.ndarray) -> np.ndarray:
        return np.abs(column.simulate_batch(prior.from_normal(points)).response[:, 1]).max(axis=1)

    rows, case = [], f"peak displacement above {threshold:g} m"
    for seed in range(repeats * seeds):
        run = subset_simulation(drift, threshold, prior.dim, n=500, seed=seed)
        note = f"95 % {run.lower:.2g} to {run.upper:.2g}, {run.simulations} simulations"
        rows.append(Row("subset simulation", f"{case}, seed {seed}", run.probability, "", note))
    random = np.random.default_rng(0)
    parts = [drift(random.standard_normal((500, prior.dim))) for _ in range(max(simulations // 500, 1))]
    share = np.mean(np.concatenate(parts) > threshold)
    note = f"+- {np.sqrt(share * (1.0 - share) / (500 * len(parts))):.1g}, {500 * len(parts)} simulations"
    return [*rows, Row("Monte Carlo", case, float(share), "", note)]
