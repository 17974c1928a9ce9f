"""What a cache on disk has of a model, for tests."""

import numpy as np

from fe_likelihoods.cache.rows import reason_of


def stored_outcomes(cache, model, thetas):
    """Responses or reasons of failures that are stored for a model; None where nothing is stored."""
    shape = len(model.channels), model.n_steps
    rows = cache.look_up(model.fingerprint, np.asarray(thetas), shape[0] * shape[1]).rows
    return [row and (reason_of(row) if row.reason else np.frombuffer(row.value).reshape(shape)) for row in rows]


def store_outcomes(cache, model, thetas, reasons):
    """Store failures of a model for any measurements."""
    cache.store(model.fingerprint, thetas, np.zeros((len(thetas), 0)), reasons, of_model=True)
