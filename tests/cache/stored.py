"""What a cache on disk has, for tests."""

import numpy as np

from fe_likelihoods.cache.simulation_cache import pack_rows


def store(cache, fingerprint, thetas, values, reasons, of_model=False):
    """Store simulations of the latest generation."""
    cache.write(pack_rows(fingerprint, thetas, values, reasons, latest(cache, fingerprint), of_model=of_model))


def look_up(cache, fingerprint, thetas, width):
    """Outcomes of the latest generation: arrays (width,) or reasons of failures; None where nothing is stored."""
    rows = cache.look_up(fingerprint, np.asarray(thetas), width, latest(cache, fingerprint))
    return [row and (row.outcome if row.reason else np.frombuffer(row.value)) for row in rows]


def latest(cache, fingerprint):
    return next(iter(cache.generations_of(fingerprint)), 1)


def stored_outcomes(cache, model, thetas):
    """Responses or reasons of failures that are stored for a model; None where nothing is stored."""
    shape = len(model.channels), model.n_steps
    found = look_up(cache, model.fingerprint, thetas, shape[0] * shape[1])
    return [each.reshape(shape) if isinstance(each, np.ndarray) else each for each in found]


def store_outcomes(cache, model, thetas, reasons):
    """Store failures of a model for any measurements."""
    store(cache, model.fingerprint, thetas, np.zeros((len(thetas), 0)), reasons, of_model=True)
