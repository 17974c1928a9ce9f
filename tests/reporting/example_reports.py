"""Reports of four systems, to be looked at: ``python -m tests.reporting.example_reports FOLDER [NAME ...]``.

The bridge column, once with displacements in a wrong unit, the isolated bridge, and a steel frame in OpenSees. The data
are synthetic, and a guide is used, so that each takes a few minutes.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fe_likelihoods import FELikelihood, Posterior, problems, propagate, report
from samplers import SMCSampler
from tests import opensees_frame

__all__ = ["EXAMPLES", "make_report"]


def column() -> tuple[Posterior, np.ndarray]:
    """The bridge column, and the truth of its data."""
    posterior = problems.bridge_column(data="short")
    truth = problems.bridge_column_data("short").attributes["truth"]
    return posterior, np.array([truth[name] for name in posterior.parameter_names])


def wrong_unit() -> tuple[Posterior, np.ndarray]:
    """The bridge column with displacements in inches that were read as centimetres."""
    right, truth = column()
    likelihood = right.likelihood
    values = likelihood.measurements.values * np.array([[1.0], [1.0 / 2.54]])
    wrong = replace(likelihood.measurements, values=values)
    return Posterior(FELikelihood(likelihood.model, wrong, likelihood.noise), right.prior), truth


def bridge() -> tuple[Posterior, np.ndarray]:
    """The isolated bridge, and the truth of its data."""
    posterior = problems.isolated_bridge()
    truth = problems.ISOLATED_BRIDGE_TRUTH["twin"] | {"sigma": problems.ISOLATED_BRIDGE_NOISE["twin"]}
    return posterior, np.array([truth.get(name, np.nan) for name in posterior.parameter_names])


def opensees() -> tuple[Posterior, np.ndarray]:
    """A two-storey frame in OpenSees, and the truth of its data."""
    return opensees_frame.posterior(1), np.array(opensees_frame.TRUTH)


EXAMPLES: dict[str, Callable] = {"column": column, "wrong_unit": wrong_unit, "bridge": bridge, "opensees": opensees}


def make_report(name: str, folder: Path, walkers: int = 100, steps: int = 2) -> Path:
    """Sample one of the systems and write its report."""
    posterior, truth = EXAMPLES[name]()
    sampler = SMCSampler(
        walkers, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide(), max_simulations=1500
    )
    sampler.run_mcmc(None, steps, progress=True)
    prediction = propagate(posterior, sampler.get_chain(flat=True)[-40:], progress=False)
    measured = posterior.likelihood.measurements
    out = folder / f"{name}.html"
    return report(sampler, posterior, {"Response": prediction}, out, truth=truth, measured=measured)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", choices=[*EXAMPLES, []], default=[])
    arguments = parser.parse_args()
    for each in arguments.names or EXAMPLES:
        print(make_report(each, arguments.folder))
