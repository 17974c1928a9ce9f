r"""Which computed mode a measured mode is, and how far they differ.

The scale and the sign of a mode shape are arbitrary. With the best scale
:math:`a = \phi \cdot \hat\phi / \phi \cdot \phi` the residual of a measured shape is

.. math:: r = \hat\phi - a \phi, \qquad |r|^2 = |\hat\phi|^2 (1 - \mathrm{MAC}), \qquad
   \mathrm{MAC} = \frac{(\phi \cdot \hat\phi)^2}{(\phi \cdot \phi) (\hat\phi \cdot \hat\phi)}.

Modes are paired by their shapes, never by their order, because the order changes with the parameters and local modes of
a model lie between global ones. Where two measured frequencies are close, an identification finds the plane of the two
shapes, and not the shapes in it. The measured shapes are then compared with their projections on the plane of the two
computed shapes, and the frequencies by their order in the pair.

References
----------
R. J. Allemang, The modal assurance criterion: twenty years of use and abuse, Sound and Vibration 37(8), 2003, 14-23.
E. Simoen, G. De Roeck, G. Lombaert, Dealing with uncertainty in model updating for damage assessment: a review,
Mechanical Systems and Signal Processing 56, 2015, 123-149, doi:10.1016/j.ymssp.2014.11.001.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import orth

__all__ = ["Paired", "close_groups", "pair_modes"]

_FREQUENCY_WEIGHT = 0.1  # of |log(f / measured f)| beside 1 - MAC: decides only where the shapes hardly do
_COINCIDENT = 1e-6  # relative difference of computed frequencies whose shapes are any basis of their space
_SAME = 1e-6  # smallest singular value of shapes that the sensors tell apart, as a share of the largest
_FORCED = 1e3  # cost of any pairing but the one by number


def close_groups(frequencies: Sequence[float], close: float) -> tuple[tuple[int, ...], ...]:
    """Groups of modes whose frequencies follow each other at ratios below 1 + `close`, in ascending order."""
    order, ordered = np.argsort(frequencies, kind="stable"), np.sort(frequencies)
    starts = np.flatnonzero(ordered[1:] >= (1.0 + close) * ordered[:-1]) + 1
    return tuple(tuple(each.tolist()) for each in np.split(order, starts))


class Paired(NamedTuple):
    """Computed modes at the measured ones."""

    columns: np.ndarray  # (m,) numbers of the computed modes, from 0
    assurance: np.ndarray  # (m,) modal assurance, the mean of the sets; with a space of modes where they are close
    frequencies: np.ndarray  # (m,) [Hz]
    shapes: np.ndarray  # (n_sets, m, n_sensors) projections of the measured shapes; zero where there is none
    spaces: tuple[tuple[int, ...], ...]  # computed modes on whose space each measured shape is projected


def pair_modes(frequencies: np.ndarray, shapes: np.ndarray, measured: Any, groups: Sequence[tuple[int, ...]]) -> Paired:
    """Pair n computed modes with the m of `ModalData`; frequencies (n,) [Hz], shapes (n, n_sensors) in any scale.

    Pairs are assigned so that the sum of 1 - MAC, with a weak term in the frequencies, is least. Modes without a shape
    are paired by their number. `groups` are modes that are close to each other (`ModalData.groups`).
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    clusters, counts = close_groups(frequencies, _COINCIDENT), measured.has_shape.sum(axis=0)
    members = {mode: cluster for cluster in clusters for mode in cluster}
    lengths = np.linalg.norm(shapes, axis=-1, keepdims=True)
    normed = shapes / np.where(lengths > 0.0, lengths, 1.0)
    cosines = measured.known_shapes @ normed.T
    similar = np.square(cosines)
    for group in groups:  # the largest MAC between the spaces of close measured and of coincident modes
        for k, there in enumerate(measured.has_shape):
            modes = [mode for mode in group if there[mode]]
            for cluster in clusters if modes else ():
                if len(group) + len(cluster) > 2 and normed[list(cluster)].any():  # else no sensor sees it
                    spaces = (orth(each.T, _SAME) for each in (measured.known_shapes[k, modes], normed[list(cluster)]))
                    similar[np.ix_([k], modes, cluster)] = np.linalg.norm(next(spaces).T @ next(spaces), 2) ** 2
    cost = np.abs(np.log(frequencies / measured.mean_frequencies[:, None])) * _FREQUENCY_WEIGHT
    cost += 1.0 - similar.sum(axis=0) / np.maximum(counts, 1)[:, None]
    for mode in np.flatnonzero(counts == 0):
        cost[mode] = _FORCED
        cost[mode, measured.mode_numbers[mode] - 1] = 0.0
    columns = linear_sum_assignment(cost)[1]
    spaces: list[tuple[int, ...]] = [()] * len(columns)
    projected = np.empty(measured.known_shapes.shape)
    for group in groups:
        modes = list(group)
        columns[modes] = columns[modes][np.argsort(frequencies[columns[modes]], kind="stable")]
        space = tuple(sorted({each for mode in modes for each in members[int(columns[mode])]}))
        for mode in modes:
            spaces[mode] = space
            if len(space) == 1:
                projected[:, mode] = cosines[:, mode, space] * normed[list(space)]
            else:
                basis = normed[list(space)].T
                projected[:, mode] = (basis @ np.linalg.lstsq(basis, measured.known_shapes[:, mode].T, rcond=None)[0]).T
    assurance = np.where(counts > 0, np.square(projected).sum(axis=(0, 2)) / np.maximum(counts, 1), np.nan)
    return Paired(columns, assurance, frequencies[columns], projected, tuple(spaces))
