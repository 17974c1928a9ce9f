"""Choice of stored simulations that cover the space of the parameters."""

import numpy as np

from .rows import StoredSimulation

__all__ = ["choose_rows"]

LARGEST = 3  # rows with the largest misfits, and failed rows next to succeeded ones


def choose_rows(rows: list[StoredSimulation], n: int, rng: np.random.Generator) -> list[StoredSimulation]:
    """Rows that show a change of the model in a part of the space.

    The space is divided into n cells with equal numbers of rows, by medians. Each cell gives one row: a special one if
    there is any, otherwise one at random. A change that concerns a share p of the rows is then missed with a
    probability of at most (1 - p)^n, as with n rows at random, and less if the changed part is connected.

    Parameters
    ----------
    rows : list of StoredSimulation
        The latest first.
    n : int
        Number of rows that are chosen.
    rng : numpy.random.Generator

    Returns
    -------
    list of StoredSimulation
        The special rows first: the latest, corners, failed next to succeeded ones, largest misfits; then the others in
        random order.
    """
    if len(rows) <= n:
        return list(rows)
    thetas = np.array([row.theta for row in rows])
    scale = np.ptp(thetas, axis=0)
    thetas = (thetas - thetas.min(axis=0)) / np.where(scale > 0.0, scale, 1.0)
    special = _special(thetas, rows)
    rank = {row: place for place, row in enumerate(special)}
    chosen = []
    for cell in _cells(np.arange(len(rows)), thetas, n, rng):
        first = min(cell, key=lambda row: rank.get(row, len(rows)))
        chosen.append(int(first) if first in rank else int(rng.choice(cell)))
    order = {row: rank.get(row, len(rows) + place) for place, row in enumerate(rng.permutation(chosen).tolist())}
    return [rows[row] for row in sorted(chosen, key=order.__getitem__)]


def _special(thetas: np.ndarray, rows: list[StoredSimulation]) -> list[int]:
    """Indices of special rows, without repetitions, those of each kind in turn."""
    failed = np.array([bool(row.reason) for row in rows])
    extremes = [end for column in thetas.T for end in (int(column.argmin()), int(column.argmax()))]
    sums = np.array([np.nan if row.reason or row.misfit is None else np.sum(row.misfit) for row in rows])
    largest = np.argsort(np.where(np.isfinite(sums), -sums, np.inf), kind="stable")[:LARGEST]
    boundary = []
    if failed.any() and not failed.all():
        inside, outside = np.flatnonzero(failed)[:200], np.flatnonzero(~failed)
        distance = np.array([np.square(thetas[outside] - thetas[row]).sum(axis=1).min() for row in inside])
        boundary = inside[np.argsort(distance, kind="stable")[:LARGEST]].tolist()
    return list(dict.fromkeys([0, *boundary, *largest.tolist(), *extremes]))


def _cells(rows: np.ndarray, thetas: np.ndarray, n: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Parts of some rows, divided along the widest of the parameters; of equally wide ones, along one at random."""
    if n == 1:
        return [rows]
    width = np.ptp(thetas[rows], axis=0)
    axis = int(rng.choice(np.flatnonzero(width >= width.max())))
    ordered = rows[np.argsort(thetas[rows, axis], kind="stable")]
    left = n // 2
    cut = min(max(round(len(rows) * left / n), left), len(rows) - (n - left))
    return [*_cells(ordered[:cut], thetas, left, rng), *_cells(ordered[cut:], thetas, n - left, rng)]
