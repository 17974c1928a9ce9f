"""Whether failed evaluations border on the posterior, so that they, not the data, may end it.

A failed simulation counts as impossible. Next to the final points it cuts off a part of the posterior, which no weight,
evidence or move reveals; scattered among successful points, failures hardly change mean and standard deviation.
"""

from typing import Any, Literal, NamedTuple

import numpy as np

from ..finding import CARE, FALSE_ALARM, WRONG, Finding

# A failure adjoins the samples if it is one of the evaluated points that are nearest to a sample. With 20 points and at
# least 5 failures, those 6 standard deviations beside a bent ridge rarely count, and those at an edge do.
NEAREST = 20  # or all evaluated points per sample, if these are more
FEWEST_ADJOINING = 5  # as many points about each are looked at, which tell scattered failures from a region of them
LEAST_ADJOINING = 0.08  # in the ellipsoid, by the share of all points there; at 0, 43 of 60 right bends are refused
# Share of the evaluated points among the samples, from which failures are many, unless by chance (`FALSE_ALARM`). Cut
# off 1, 1.3 and 1.6 standard deviations beside the mode, 15, 12 and 7 of 16 runs each are then refused and the others
# doubted, none at 2; with a chance of 0.05, 16, 15 and 10, and 2.
LARGE_SHARE_NEAR = 0.02
INSIDE = 0.99  # share of the samples inside the ellipsoid that counts as their region
KEPT_POINTS = 20_000  # the latest points are those near the posterior


class NearFailures(NamedTuple):
    """Evaluated points in the region of the posterior, without repetitions."""

    failed: int  # in the ellipsoid about the mean of the samples that holds 99 % of the samples
    evaluated: int  # all points there
    adjoining: int = 0  # failures, there or not, among the points nearest to the samples
    scattered: bool = False  # the points about these failures fail no more often than other points among the samples
    nearest: int = 0  # points, failed or not, that are nearest to the samples

    @property
    def place(self) -> Literal["away", "beside", "border"]:
        """Where the failures are: "away" from the samples, if fewer than 5 failures adjoin them, or failures are
        scattered among successful points and at most 2 % of the points in the ellipsoid; at their "border", if more
        than 2 % failed, not scattered and not by chance, and enough failures adjoin the samples; else "beside" them.
        """
        if self.adjoining < FEWEST_ADJOINING:
            return "away"
        if self.scattered:
            return "beside" if self.failed > LARGE_SHARE_NEAR * self.evaluated else "away"
        from scipy.stats import binom  # slow to import

        is_large = binom.sf(self.failed - 1, self.evaluated, LARGE_SHARE_NEAR) < FALSE_ALARM
        # of failures beside a bent posterior, far fewer adjoin the samples than of the other points in the ellipsoid
        adjoin = self.adjoining * self.evaluated > LEAST_ADJOINING * self.failed * self.nearest
        return "border" if is_large and adjoin else "beside"


def failures_near(samples: np.ndarray, failed: np.ndarray, succeeded: np.ndarray) -> NearFailures:
    """Failures in the region of posterior samples (n, k), and all distinct points there.

    `failed` (m, k) and `succeeded` (l, k) are evaluated points. Fewer than k + 1 different samples have no region, and
    give no points.
    """
    distinct = np.unique(samples, axis=0)
    if len(distinct) <= samples.shape[1]:
        return NearFailures(0, 0)
    # parameters may differ by many orders of magnitude
    mean, sd = samples.mean(axis=0), samples.std(axis=0)
    sd = np.where(sd > 0.0, sd, 1.0)
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov((samples - mean) / sd, rowvar=False)))
    used = values > 1e-12 * values.max()
    root = vectors[:, used] / np.sqrt(values[used])

    def white(points: np.ndarray) -> np.ndarray:
        return (points.reshape(-1, len(mean)) - mean) / sd @ root

    successes = np.unique(np.concatenate([succeeded.reshape(-1, len(mean)), samples]), axis=0)
    points = np.concatenate([white(np.unique(failed, axis=0)), white(successes)])
    has_failed = np.arange(len(points)) < len(points) - len(successes)
    inside = np.square(points).sum(axis=1) <= np.quantile(np.square(white(samples)).sum(axis=1), INSIDE)
    number, evaluated = int(np.count_nonzero(inside & has_failed)), int(np.count_nonzero(inside))
    from scipy.spatial import cKDTree  # both are slow to import
    from scipy.stats import binom

    tree = cKDTree(points)
    # long chains evaluate many points per sample, all of them closer than the next sample
    count = max(NEAREST, evaluated // len(distinct))
    nearest = np.unique(tree.query(white(distinct), k=min(count + 1, len(points)))[1])
    adjoining = nearest[has_failed[nearest]]
    if len(adjoining) == 0:
        return NearFailures(number, evaluated)
    about = tree.query(points[adjoining], k=min(FEWEST_ADJOINING + 1, len(points)))[1][:, 1:]
    by_chance = binom.isf(FALSE_ALARM, about.size, number / evaluated)
    return NearFailures(number, evaluated, len(adjoining), bool(has_failed[about].sum() <= by_chance), len(nearest))


def judged_failures(evaluated: Any, final_coords: np.ndarray, target: Any) -> NearFailures:
    """Failures in the region of a run's final points (n, ndim), among the latest 20 000 of the `evaluated` points, by
    the parameters that a simulation depends on. If the `target` knows failures by itself, all -inf are failures,
    except outside its support.
    """
    coords, log_prob = evaluated.coords[-KEPT_POINTS:], evaluated.log_prob[-KEPT_POINTS:]
    failed, impossible = np.isnan(log_prob), log_prob == -np.inf
    if not np.any(failed | impossible):
        return NearFailures(0, 0)
    rows = np.flatnonzero(impossible)
    ruled_out = rows[~target.may_be_positive(coords[rows])]
    coords, failed, impossible = (np.delete(each, ruled_out, axis=0) for each in (coords, failed, impossible))
    slow, either = target.slow_parameters, failed | impossible
    coords, counted = coords[:, slow], either if target.knows_failures else failed
    return failures_near(final_coords[:, slow], coords[counted], coords[~either])


def check_failed_region(near: NearFailures) -> list[Finding]:
    """A finding if failures adjoin the final points: severe if they end the posterior there."""
    if near.place == "away":
        return []
    text = (
        f"{near.failed} of {near.evaluated} evaluated points in the region of the final points failed, and "
        f"{near.adjoining} failed points adjoin the final points"
    )
    action = "Mend the model there, or exclude the region by the prior if it is impossible."
    if near.place == "border":
        text += ": the failures, not the data, end the posterior there, so means and standard deviations may be wrong."
        return [Finding("Failures border on the samples", WRONG, text, action)]
    text += (
        ". Means and standard deviations are right if these failures are scattered, and too small if the posterior "
        "goes on where they are."
    )
    return [Finding("Failures beside the samples", CARE, text, action)]
