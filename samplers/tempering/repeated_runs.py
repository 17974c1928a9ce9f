"""Several runs of recycling from the same draws of the prior: what they find together, and whether they agree.

The proposals of a run of adaptive importance sampling follow its own draws. A mode that no draw has met is missing in
all that follows, and nothing in this run shows it. A second run makes other draws. Where the two disagree, one of them
has lost a part of the posterior, and another part may be lost in both.

The runs share their points at the end only. Together, all their proposals and the prior are a mixture with a known
density, from which recycling continues to beta = 1: its weights count every point by what it could have been drawn
from, so the result contains whatever one of the runs has found (deterministic mixture weights, Owen & Zhou 2000, JASA
95(449), doi:10.1080/01621459.2000.10473909).
"""

from collections.abc import Sequence

import numpy as np

from ..proposals.mixture import Mixture, log_responsibilities
from .adaptive_importance import Recycled
from .archive import StartingDensity, starting_mixture
from .population import Doubt
from .population_check import LARGE_DIFFERENCE
from .weights import normalised_weights

__all__ = ["check_agreement", "pool_runs"]

# Differences of evidences and shares, and of means in many parameters, are reported beyond this many standard errors.
FAR, FAR_MEANS = 3.0, 4.0
ADVICE = (
    "The result contains what all runs have found. Where one run has lost a part of the posterior, all of them may "
    "have lost another: use more walkers"
)


def pool_runs(runs: Sequence[Recycled], n_prior: int) -> tuple[np.ndarray, np.ndarray, StartingDensity]:
    """All points of runs that have the same draws of the prior, and the density that they were drawn from.

    Parameters
    ----------
    runs : sequence of Recycled
        The runs; the first points of each are the draws of the prior.
    n_prior : int
        Number of draws of the prior.

    Returns
    -------
    coords, records : (n, ndim) float, (n,) structured array
        The points: the draws of the prior once, and those of all runs.
    start : StartingDensity
        Mixture of the prior and all proposals, by their numbers of draws.
    """
    first = runs[0].archive
    coords = np.concatenate([first.coords[:n_prior], *(run.archive.coords[n_prior:] for run in runs)])
    records = np.concatenate([first.records[:n_prior], *(run.archive.records[n_prior:] for run in runs)])
    proposals = [proposal for run in runs for proposal in run.proposals]
    return coords, records, starting_mixture(n_prior, proposals)


def check_agreement(runs: Sequence[Recycled], mixture: Mixture, inherited: float) -> list[Doubt]:
    """A doubt if runs differ in the evidence, the share of a part of the posterior, or a mean.

    Parameters
    ----------
    runs : sequence of Recycled
        The runs, each with weighted draws made at beta = 1.
    mixture : Mixture
        Mixture that was fitted to all points; its components are the parts.
    inherited : float
        Variance of the log-evidence from the weights by which the proposals of a run were chosen: one over their
        effective sample size.

    Returns
    -------
    list of Doubt
        Empty, or the most serious difference: of a share, else of the evidence, else of a mean.
    """
    shares, share_errors, means, mean_errors = [], [], [], []
    for run in runs:
        weights = normalised_weights(run.log_weights)
        parts = np.exp(log_responsibilities(mixture, run.coords))
        for values, centres, errors in ((parts, shares, share_errors), (run.coords, means, mean_errors)):
            centres.append(weights @ values)
            apart = (values - centres[-1]) ** 2
            errors.append(weights**2 @ apart + inherited * (weights @ apart))
    evidences = [run.log_evidence for run in runs]
    for a in range(len(runs)):
        for b in range(a + 1, len(runs)):
            name = f"the runs {a + 1} and {b + 1} of the annealing disagree"
            difference = np.abs(shares[a] - shares[b])
            limit = np.maximum(LARGE_DIFFERENCE, FAR * np.sqrt(share_errors[a] + share_errors[b]))
            if np.any(difference > limit):
                k = int(np.argmax(np.where(difference > limit, difference, 0.0)))
                found = f"the share {shares[a][k]:.2f} in one and {shares[b][k]:.2f} in the other"
                return [Doubt(f"{name}: a part of the posterior has {found}. {ADVICE}", True)]
            errors = np.array([runs[a].log_evidence_error, runs[b].log_evidence_error])
            if abs(evidences[a] - evidences[b]) > FAR * np.hypot(*errors):
                found = " and ".join(f"{evidences[k]:.2f} +- {runs[k].log_evidence_error:.2f}" for k in (a, b))
                return [Doubt(f"{name}: their log-evidences are {found}. {ADVICE}", True)]
            difference = np.abs(means[a] - means[b]) / np.sqrt(mean_errors[a] + mean_errors[b])
            if np.any(difference > FAR_MEANS):
                k = int(np.argmax(difference))
                found = f"their means of parameter {k} differ by {difference[k]:.1f} standard errors"
                return [Doubt(f"{name}: {found}. {ADVICE}", True)]
    return []
