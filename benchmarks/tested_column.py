"""Cyclic tests of four reinforced-concrete columns: calibrations of first halves, and each column from the others.

One sample in six and all turning points; the data are in the folder ``measured/rc_column_cyclic`` of the reference
material (``FE_SHARED``). Their forces are base moments divided by the height, so that the geometry is linear: the
log-evidence is 10 to 47 higher than with forces that P-Delta reduces.
"""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

import fe_likelihoods as fe
from fe_likelihoods.prediction.quantities import find_failure
from samplers import SMCSampler
from tests.models.tested_columns import read_column

from .rows import Row
from .targets import SHARED

__all__ = ["HISTORIES", "column", "next_columns"]

HISTORIES = "2013_Hose_SRPH1", "2017_Lehman_415", "2019_Lehman_1015", "2020_Lehman_407"
SPREADS = {"Ec": 0.3, "ft": 0.5, "fc": 0.2, "Es": 0.1, "fy": 0.08, "Esh": 0.5, "penetration": 0.5}


def column(history: str, seed: int = 1, to_failure: bool = False) -> fe.Posterior:
    """Posterior of a column by the name of its file: of its first half, or until it fails; `seed` changes nothing."""
    read, force, stop = read_column(SHARED / "measured" / "rc_column_cyclic", f"{history}.csv", 6)
    whole = replace(read, parameters=tuple(SPREADS), fatigue=None, units=(("force", "kip"),))
    moved, source = whole.loading.displacement, whole.loading.source
    stop = find_failure(force, moved) if to_failure else stop
    model = whole.with_record(fe.DisplacementHistory(history, moved[:stop], source))
    measured = fe.Measurements(model.channels, model.dt, force[None, :stop], history)
    noise = fe.GaussianNoise(model.channels, shares_of="measured")
    prior = {name: fe.TruncatedNormal(1.0, spread) for name, spread in SPREADS.items()}
    return fe.Posterior(fe.FELikelihood(model, measured, noise), prior | {"share_force": fe.HalfNormal(0.3)})


def next_columns(walkers: int = 50) -> Iterator[Row]:
    """Simulations of four calibrations; then peaks between zero displacements of each column, from the other three."""
    stored = {}
    for name in HISTORIES:
        posterior = column(name)
        guide = posterior.guide()
        run = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=1, guide=guide, max_simulations=800)
        run.run_mcmc(None, 1, progress=False)
        stored[name] = fe.StoredPosterior.from_run(run, posterior)
        note = f"{run.verdict.status}; log-evidence {run.log_evidence:.2f} +- {run.log_evidence_error:.2f}"
        yield Row("simulations", name, float(run.verdict.simulations), "", note)
    varying = {name: fe.Varying(fe.LogNormal(1.0, spread), fe.HalfNormal(spread)) for name, spread in SPREADS.items()}
    varying["share_force"] = fe.Varying(fe.LogNormal(0.1, 0.7), fe.HalfNormal(0.5))
    for name in HISTORIES:
        population = fe.HierarchicalPosterior({k: each for k, each in stored.items() if k != name}, varying)
        run = SMCSampler(120, population.ndim, population, vectorize=True, seed=1, min_moves=10, max_moves=30)
        run.run_mcmc(None, 2, progress=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hierarchy = fe.Hierarchy(population, run.get_chain(flat=True))
        yield _predicted(name, hierarchy.new_test(200, posterior.parameter_names, rng=1))


def _predicted(name: str, draws: dict[str, np.ndarray]) -> Row:
    """Share of the measured peaks in intervals of 90 %, and the errors of the median history."""
    posterior = column(name, to_failure=True)
    model, force = posterior.likelihood.model, posterior.likelihood.measurements.values
    sides = np.flatnonzero(np.diff(np.sign(model.loading.displacement)) != 0) + 1
    parts = [slice(*each) for each in pairwise([0, *sides, force.shape[1]])]

    def peaks(response: np.ndarray) -> np.ndarray:
        return np.array([np.abs(response[0, part]).max() for part in parts])

    settings = {"quantiles": (0.05, 0.25, 0.5, 0.75, 0.95), "noise": "model", "seed": 1, "progress": False}
    found = fe.propagate(posterior, draws, quantity={"peaks": peaks, "history": None}, **settings)
    low, lower, _, upper, high = found["peaks"].quantiles
    inside = [np.mean((a <= peaks(force)) & (peaks(force) <= b)) for a, b in ((low, high), (lower, upper))]
    errors = [fe.rrmse(each[0], force[0]) for each in (found["history"].quantile(0.5), model.simulate(np.ones(7)))]
    note = f"in 50 %: {100 * inside[1]:.0f}; ends {np.median(high / low):.2f}; "
    note += f"RRMSE {errors[0]:.3f}, nominal {errors[1]:.3f}"
    return Row("peaks in 90 %", f"{name} from three others", 100.0 * float(inside[0]), "%", note)
