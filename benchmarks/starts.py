"""Power and false alarms of the tests of the initial state (`samplers.evaluation.starts`).

The power is the share of balls that are refused: points with a standard deviation of 0.001 to 0.5 times that of the
prior, half of them about the centre of the prior, half about a draw of it. A false alarm is a start that consists of
draws of the prior and is refused.
"""

import itertools

import numpy as np

from tests.tempering.priors import PRIORS, LogNormal, Prior, Uniform, ball, refused

from .rows import Row

__all__ = ["starts"]

SCALES = (0.001, 0.01, 0.1, 0.3, 0.5)
NAMES = {"draws": "with sample_prior", "density": "with log_prior_fn only"}


def starts(repeats: int) -> list[Row]:
    """Rows of power and false alarms; 8 balls per prior and row, and 40 honest starts per prior, for each repeat."""
    random, rows = np.random.RandomState(1), []
    for ndim, n, by, scale in itertools.product((2, 7), (24, 50, 100, 250), NAMES, SCALES):
        if by == "density" and n < 50:
            continue
        found = [
            bool(refused(ball(make(ndim), n, scale, random, k % 2 == 0), make(ndim), by, seed=k))
            for make, k in itertools.product((Prior, Uniform, LogNormal), range(8 * repeats))
        ]
        case = f"ball of {scale:g} sd, {n} walkers, {ndim} parameters, {NAMES[by]}"
        rows.append(Row("power", case, 100.0 * float(np.mean(found)), "%", f"{len(found)} balls"))
    for by in NAMES:
        found = []
        for make, ndim, n, k in itertools.product(PRIORS, (2, 7), (24, 60, 100, 250), range(5 * repeats)):
            prior = make(ndim)
            found.append(bool(refused(prior.draw(n, random), prior, by, seed=k)))
        rows.append(Row("false alarms", NAMES[by], float(np.sum(found)), "starts", f"of {len(found)}"))
    return rows
