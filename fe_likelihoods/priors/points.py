"""Points of a space of named parameters, and the text of an object that fingerprints are made of."""

import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def as_points(x: Any, names: Sequence[str]) -> np.ndarray:
    """One point (ndim,) or several (n, ndim) as an array, from an array_like or a mapping with a value, or n values,
    per name.

    emcee passes mappings with ``parameter_names=``, nautilus with its own prior. Raises ValueError if the number of
    values or the names are wrong.
    """
    if type(x) is not np.ndarray and isinstance(x, Mapping):
        if set(x) != set(names):
            raise ValueError(f"expected a value for each of {', '.join(names)}; got the names {', '.join(map(str, x))}")
        x = np.stack([np.asarray(x[name], dtype=float) for name in names], axis=-1)
    points = np.asarray(x, dtype=float)
    if points.ndim not in (1, 2) or points.shape[-1] != len(names):
        raise ValueError(
            f"expected one value for each of the {len(names)} parameters {', '.join(names)}, in an array of shape "
            f"({len(names)},) or (n, {len(names)}); got shape {points.shape}"
        )
    return points


def complete_repr(thing: Any) -> str:
    """The complete ``repr`` of an object, the same in every process; ValueError if it contains an address."""
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        text = repr(thing)
    if re.search(r"\bat 0x[0-9a-fA-F]+", text):
        raise ValueError(
            f"a fingerprint needs a repr that shows all values of {type(thing).__qualname__} instead of its address; "
            f"make it a frozen dataclass or give it a __repr__; got {text}"
        )
    return text


def as_rows(thetas: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Points in an array (n, ndim), also for one point; see `as_points`."""
    thetas = as_points(thetas, names)
    return thetas if thetas.ndim == 2 else thetas[None]
