"""Whether failed evaluations border on the posterior, so that they may end it instead of the data.

A failed simulation counts as impossible. Far from the posterior that changes nothing. Among the final points, however,
it cuts off a part of the posterior, and no weight, evidence or move shows it: all of them describe the density that is
left.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from .population import Doubt

__all__ = ["EvaluatedPoints", "NearFailures", "check_failed_region", "failures_near"]

FEWEST_NEAR = 3  # failures among the samples
LARGE_SHARE_NEAR = 0.02  # of the evaluated points among the samples
INSIDE = 0.99  # share of the samples that are closer to their mean than the region that counts as theirs
# The latest points are those near the posterior.
KEPT_POINTS = 20_000


class NearFailures(NamedTuple):
    """Evaluated points in the region of the posterior.

    Attributes
    ----------
    failed : int
        Number of failures there.
    evaluated : int
        Number of all distinct points there.
    known : bool
        Whether they are known to be failures; otherwise a log-probability of -inf may have another cause.
    """

    failed: int
    evaluated: int
    known: bool = True

    @property
    def borders(self) -> bool:
        """Whether failures border on the samples, so that they may end the posterior."""
        return self.failed >= FEWEST_NEAR and self.failed > LARGE_SHARE_NEAR * self.evaluated


def failures_near(samples: np.ndarray, failed: np.ndarray, succeeded: np.ndarray) -> NearFailures:
    """Failures in the region of samples of the posterior, and all distinct points there.

    The region is an ellipsoid about the mean of the samples with their covariance, which holds 99 % of them.

    Parameters
    ----------
    samples : (n, k) float
        Samples of the posterior.
    failed, succeeded : (m, k) float, (l, k) float
        Points that failed and that did not.
    """
    # parameters may differ by many orders of magnitude
    mean, sd = samples.mean(axis=0), samples.std(axis=0)
    sd = np.where(sd > 0.0, sd, 1.0)
    inverse = np.linalg.pinv(np.atleast_2d(np.cov((samples - mean) / sd, rowvar=False)), hermitian=True)

    def distances(points: np.ndarray) -> np.ndarray:
        offsets = (points - mean) / sd
        return np.einsum("ij,jk,ik->i", offsets, inverse, offsets)

    limit = np.quantile(distances(samples), INSIDE)
    number = int(np.count_nonzero(distances(np.unique(failed, axis=0)) <= limit)) if len(failed) else 0
    successes = np.unique(np.concatenate([succeeded, samples]), axis=0)
    return NearFailures(number, number + int(np.count_nonzero(distances(successes) <= limit)))


class EvaluatedPoints:
    """The latest evaluated points of a run, with what came of each: a finite value, -inf or an error."""

    FINITE, IMPOSSIBLE, FAILED = range(3)

    def __init__(self) -> None:
        self._batches: deque[tuple[np.ndarray, np.ndarray]] = deque()
        self._count = 0

    def add(self, coords: np.ndarray, log_prob: np.ndarray, failed: list[int]) -> None:
        """Enter points (n, ndim) with their log-probabilities, and the rows of those that raised errors or gave NaN."""
        kinds = np.where(log_prob > -np.inf, self.FINITE, self.IMPOSSIBLE)
        kinds[failed] = self.FAILED
        self._batches.append((coords, kinds))
        self._count += len(coords)
        while self._count - len(self._batches[0][0]) >= KEPT_POINTS:
            self._count -= len(self._batches.popleft()[0])

    def near(self, samples: np.ndarray, columns: np.ndarray, counts_failures: bool) -> NearFailures:
        """Failures in the region of samples (n, ndim).

        Parameters
        ----------
        samples : (n, ndim) float
            Samples of the posterior.
        columns : (k,) int
            The parameters that a simulation depends on.
        counts_failures : bool
            Whether the log-density counts failures by itself. All values of -inf are failures then; otherwise they may
            have another cause, which matters only where there are too few errors.
        """
        if not any(np.any(kinds > self.FINITE) for _, kinds in self._batches):
            return NearFailures(0, 0)
        coords = np.concatenate([each for each, _ in self._batches])[:, columns]
        kinds = np.concatenate([each for _, each in self._batches])
        fewest = self.IMPOSSIBLE if counts_failures else self.FAILED
        found = failures_near(samples[:, columns], coords[kinds >= fewest], coords[kinds == self.FINITE])
        if found.borders or counts_failures:
            return found
        impossible = failures_near(samples[:, columns], coords[kinds > self.FINITE], coords[kinds == self.FINITE])
        return impossible._replace(known=False) if impossible.borders else found


def check_failed_region(near: NearFailures) -> list[Doubt]:
    """A doubt if failures border on the final points: grave if they are known to be failures."""
    if not near.borders:
        return []
    where = f"in the region of the final points, {near.failed} of {near.evaluated} evaluated points"
    if near.known:
        message = (
            f"{where} failed: the failures, not the data, end the posterior there, so means and standard deviations "
            "may be wrong. Mend the model there, or exclude the region by the prior if it is impossible"
        )
    else:
        message = (
            f"{where} have a log-probability of -inf, and whether these are failed simulations is not known. If they "
            "are, they end the posterior, not the data: mend the model there. If not, let log_prior exclude them"
        )
    return [Doubt(message, near.known)]
