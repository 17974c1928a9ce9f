"""Two events on the column: both at once, and the posterior of the first one as the prior of the second.

A reduced column (20 strips, a short part of the record at twice its step, three parameters) is tested by EQ1 and, after
it has cracked, by an EQ2 of 0.8 times its strength, with synthetic noise of 5 %. The evidence of EQ1 plus that of EQ2
given EQ1 is compared with that of both, and so are means and standard deviations. The second step simulates EQ1, the
pause and EQ2, and compares EQ2 only.
"""

import numpy as np

from fe_likelihoods import (
    Events,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    RCColumn,
    TruncatedNormal,
    fit_mixture,
)
from fe_likelihoods.problems import bridge_column_data
from samplers import SMCSampler

from .rows import Row

__all__ = ["sequential"]

_TRUTH = np.array([0.8, 1.2, 1.3])


def sequential(repeats: int = 3, walkers: int = 500) -> list[Row]:
    """Differences between the two ways, one row per quantity, for `repeats` seeds of the samplers."""
    record = bridge_column_data().record.trim(8.0, 11.0).resample(2.0 / 256)
    events = Events([record, record.scale(0.8)], rest=1.0, names=["EQ1", "EQ2"])
    column = RCColumn.lhpost(events, mesh=20, parameters=("Ec", "ft", "a0"))
    rng = np.random.default_rng(15)
    measured, scale = {}, {}
    for name, response in events.split(column.simulate(_TRUTH)).items():
        scale[name] = 0.05 * response.std(axis=1)
        noise = scale[name][:, None] * rng.standard_normal(response.shape)
        measured[name] = Measurements(column.channels, events.dt, response + noise)
    names = column.parameter_names
    structural = Prior({name: TruncatedNormal(1.0, 0.4) for name in names})
    sigmas = {
        f"sigma_{channel.name}_{event}": HalfNormal(3.0 * scale[event][row])
        for event in events.names
        for row, channel in enumerate(column.channels)
    }

    def run(data: dict, prior: dict, seed: int) -> SMCSampler:
        likelihood = FELikelihood(column, data, noise=GaussianNoise(column.channels, groups="event"))
        levels = {name: sigmas[name] for name in likelihood.parameter_names[len(names) :]}
        posterior = Posterior(likelihood, Prior(prior | levels))
        sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 4, progress=False)
        return sampler

    rows = []
    for seed in range(repeats):
        both = run(measured, structural.distributions, seed)
        # EQ1 alone is a part of the same simulation; the pause and EQ2 are not compared
        first = run({"EQ1": measured["EQ1"]}, structural.distributions, 100 + seed)
        own = Prior(structural.distributions | {name: sigmas[name] for name in sigmas if name.endswith("EQ1")})
        mixture = fit_mixture(first.get_chain(flat=True), own, names, effective_sample_size=walkers)
        second = run({"EQ2": measured["EQ2"]}, {mixture.names: mixture}, 200 + seed)
        error = float(np.sqrt(sum(s.log_evidence_error**2 for s in (both, first, second)) + mixture.fit_error**2))
        difference = first.log_evidence + second.log_evidence - both.log_evidence
        note = (
            f"log Z {first.log_evidence:.2f} + {second.log_evidence:.2f} against {both.log_evidence:.2f}; "
            f"fit error {mixture.fit_error:.3f}, {len(mixture.weights)} components; stated error {error:.3f}"
        )
        rows.append(Row(f"log Z in two steps, seed {seed}", "", difference, "", note))
        draws = [sampler.get_chain(flat=True)[:, : len(names)] for sampler in (both, second)]
        sd = draws[0].std(axis=0)
        shift, ratio = (draws[1].mean(axis=0) - draws[0].mean(axis=0)) / sd, draws[1].std(axis=0) / sd
        note = f"sd ratios {np.round(ratio, 3).tolist()}; sd of EQ1 alone / both "
        note += f"{np.round(first.get_chain(flat=True)[:, : len(names)].std(axis=0) / sd, 2).tolist()}"
        rows.append(Row(f"largest shift of a mean, seed {seed}", "", float(np.abs(shift).max()), "sd", note))
    return rows
