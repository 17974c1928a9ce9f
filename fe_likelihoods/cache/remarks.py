"""Remarks of models about their simulations, kept in the cache on disk: a law was continued beyond its range.

A built-in model says once, as a warning, that a simulation was beyond the range of its laws. A later process that takes
the simulations from the cache would hear nothing. Therefore the text is stored beside the rows, under the key of the
model, and is repeated as a warning when rows of this model are first used in another process.
"""

import logging

from ..simulation.model import Model
from .simulation_cache import SimulationCache

__all__ = ["repeat_remark_of", "store_remark_of"]

logger = logging.getLogger(__name__)

_repeated: set[tuple[str, str]] = set()  # by file and model, in this process


def store_remark_of(model: Model, cache: SimulationCache) -> None:
    """Store the attribute `range_remark` of a model, if it has one."""
    if text := getattr(model, "range_remark", ""):
        cache.store_remark(model, text)


def repeat_remark_of(model: Model, cache: SimulationCache | None) -> None:
    """Log the stored remark of a model, once per process and not where the model has made one itself."""
    if cache is None or not hasattr(model, "range_remark"):
        return
    place = str(cache.path), model.fingerprint
    if place in _repeated:
        return
    _repeated.add(place)
    text = cache.look_up_remark(model)
    if text and not model.range_remark:
        logger.warning("simulations of this model in %s: %s", cache.path, text)
