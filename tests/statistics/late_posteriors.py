"""Small posteriors that are decided late in the record, with models that can be shortened.

A search for modes on growing parts of the record sees nothing of the parameters that act late, or is led to a wrong
place, until it uses the whole record. Two cases are beyond the default search: few starts miss the narrow mode of
late_basin in some runs, and in all_misled, nearly all runs end at the wrong place. Such runs can be called converged.
"""

import numpy as np

from fe_likelihoods import TruncatedNormal, Uniform

from .case import HardPosterior

__all__ = ["LATE_CASES"]

_WHOLE = (0.0, 1.0)
_EARLY_PARAMETERS = {"a": TruncatedNormal(1.0, 0.3), "b": TruncatedNormal(1.0, 0.3)}
_BASIN = (0.56, 0.68)  # of c in the case late_basin


def _early(a, b):
    """Two features that act from the start of the record and determine a and b."""
    return a * b, b**1.5


def _wave(x):
    """The same response for five values of c, but for a small slope, which gives the modes different shares."""
    a, b, c = x.T
    angle = 10.0 * np.pi * (c - 0.1)
    return np.stack([*_early(a, b), 0.3 * np.sin(angle), 0.3 * np.cos(angle) * b, 0.01 * (c - 0.3)], axis=1)


def _wave_number(x):
    return np.clip(np.floor(5.0 * x[:, 2]), 0, 4).astype(int)


def _signs(x):
    """Responses that hardly depend on the signs of c, d and e."""
    a, b, c, d, e = x.T
    squares = 0.3 * c**2 * np.exp(0.2 * c), 0.3 * d**2 * np.exp(-0.3 * d), 0.3 * e**2
    return np.stack([*_early(a, b), *squares], axis=1)


def _signs_number(x):
    return (x[:, 2:5] > 0.0) @ np.array([1, 2, 4])


def _basin(x):
    """Two lines in c, one of them between two walls of the misfit, so that an ascent from outside does not enter."""
    a, b, c = x.T
    low, high = _BASIN
    inside = 1.0 / ((1.0 + np.exp((low - c) / 0.006)) * (1.0 + np.exp((c - high) / 0.006)))
    line = (1.0 - inside) * 0.1 * (c - 0.25) * b + inside * 0.2 * (c - 0.5 * (low + high))
    walls = np.exp(-0.5 * ((c - low) / 0.012) ** 2) + np.exp(-0.5 * ((c - high) / 0.012) ** 2)
    return np.stack([*_early(a, b), line, 0.4 * walls], axis=1)


def _in_basin(x):
    return ((x[:, 2] > _BASIN[0]) & (x[:, 2] < _BASIN[1])).astype(int)


def _misleading(x):
    """Two values of a, 0.8 and 1.4, give the last feature; the first one is that of 0.8, and the second one of 1.4."""
    a, b, c = x.T
    return np.stack([0.6 * (a - 0.8), 0.25 * (a - 1.4), b, c, 3.0 * (a - 0.8) * (a - 1.4) * c], axis=1)


def _near_the_wrong_value(x):
    return (x[:, 0] > 1.1).astype(int)


def _misled_by_the_start(what, window):
    """A case in which the first 30 % of the record fit best at a = 1.4, and the last 40 % exclude this value.

    `window` is that of the feature that both values of a give.
    """
    return HardPosterior(
        f"the first 30 % of the record fit best at a wrong value of a parameter, {what}",
        {"a": TruncatedNormal(1.1, 0.4), "b": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.3)},
        _misleading,
        [0.0, 0.0, 1.0, 1.0, 0.0],
        noise=0.03,
        n_steps=600,
        label=_near_the_wrong_value,
        n_modes=2,
        windows=[(0.6, 1.0), (0.0, 0.3), _WHOLE, _WHOLE, window],
    )


LATE_CASES = {
    "late_wave": HardPosterior(
        "five modes of one parameter, which acts in the last 30 % of the record",
        _EARLY_PARAMETERS | {"c": Uniform(0.0, 1.0)},
        _wave,
        [1.1, 1.0, 0.0, 0.3, 0.0],
        n_steps=300,
        label=_wave_number,
        n_modes=5,
        windows=[_WHOLE, _WHOLE, (0.7, 1.0), (0.7, 1.0), (0.7, 1.0)],
    ),
    "late_signs": HardPosterior(
        "eight modes: the signs of three parameters, which act in the last 40, 30 and 20 % of the record",
        _EARLY_PARAMETERS | {name: Uniform(-2.0, 2.0) for name in "cde"},
        _signs,
        [1.1, 1.0, 0.3, 0.3, 0.3],
        n_steps=300,
        label=_signs_number,
        n_modes=8,
        windows=[_WHOLE, _WHOLE, (0.6, 1.0), (0.7, 1.0), (0.8, 1.0)],
    ),
    "late_basin": HardPosterior(
        "a mode in 12 % of the prior, of a parameter that acts in the last 30 % of the record",
        _EARLY_PARAMETERS | {"c": Uniform(0.0, 1.0)},
        _basin,
        [1.1, 1.0, 0.0, 0.0],
        n_steps=300,
        label=_in_basin,
        n_modes=2,
        windows=[_WHOLE, _WHOLE, (0.7, 1.0), (0.7, 1.0)],
    ),
    "misleading": _misled_by_the_start("near which the whole record has a local maximum", _WHOLE),
    "all_misled": _misled_by_the_start("and the first 40 % have no other maximum", (0.4, 1.0)),
}
"""The cases by name."""
