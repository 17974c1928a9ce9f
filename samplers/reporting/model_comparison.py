"""Model comparison: posterior probabilities of models from their evidences (``docs/theory/evidence``)."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import expit, logsumexp, ndtri

from .summary import is_tempered, log_posterior_of

if TYPE_CHECKING:
    import pandas


def compare_models(models: Mapping[str, Any]) -> "pandas.DataFrame":
    """Posterior probabilities of models for the same data, with equal prior probabilities.

    Other prior probabilities are added to the log-evidences of pairs, as logarithms.

    Parameters
    ----------
    models : mapping of str to (sampler or tuple of float)
        For each name a sampler that has run (any object with ``log_evidence`` and ``log_evidence_error``), or a pair
        (log-evidence, standard error). Prior and likelihood must be normalised, and the measurements the same.

    Returns
    -------
    pandas.DataFrame
        A row per model, the most probable one first: ``log_evidence`` and its standard ``error``, posterior
        ``probability`` with the ends ``lower`` and ``upper`` of its 95 % interval, from the log-odds, and the
        ``verdict`` on the run, empty for a pair of numbers.

    Examples
    --------
    >>> print(compare_models({"elastic": (-120.3, 0.1), "inelastic": (-118.9, 0.1)}))
               log_evidence  error  probability     lower     upper verdict
    model
    inelastic        -118.9    0.1     0.802184  0.754511  0.842531
    elastic          -120.3    0.1     0.197816  0.157469  0.245489
    """
    import pandas  # slow to import

    if not isinstance(models, Mapping) or len(models) < 2:
        raise ValueError(f"compare_models needs a mapping with two models or more, by name; got {models!r}")
    digests = {name: getattr(log_posterior_of(model), "data_fingerprint", None) for name, model in models.items()}
    known = {name: digest for name, digest in digests.items() if digest is not None}
    if len(set(known.values())) > 1:
        raise ValueError(
            f"the evidences of {', '.join(known)} are of different measurements and cannot be compared: give all "
            "models the same measurements"
        )
    log_evidence, error = np.array([_evidence(name, model) for name, model in models.items()]).T

    odds, odds_error = np.empty((2, len(models)))
    for k in range(len(models)):  # d logit(p_k) / d log Z_j = delta_kj - (1 - delta_kj) p_j / (1 - p_k)
        rest = logsumexp(np.delete(log_evidence, k))
        odds[k] = log_evidence[k] - rest
        share = np.exp(np.delete(log_evidence, k) - rest)
        odds_error[k] = math.hypot(error[k], *(share * np.delete(error, k)))
    reach = ndtri(0.975) * odds_error
    columns = {
        "log_evidence": log_evidence,
        "error": error,
        "probability": expit(odds),
        "lower": expit(odds - reach),
        "upper": expit(odds + reach),
        "verdict": [each.verdict.status if is_tempered(each) else "" for each in models.values()],
    }
    found = pandas.DataFrame(columns, index=pandas.Index(models, name="model"))
    return found.sort_values("probability", ascending=False, kind="stable")


def _evidence(name: str, model: Any) -> tuple[float, float]:
    pair = (model.log_evidence, model.log_evidence_error) if hasattr(model, "log_evidence_error") else model
    with suppress(TypeError, ValueError):
        value, error = map(float, pair)
        if math.isfinite(value) and 0.0 <= error < math.inf:
            return value, error
    raise ValueError(
        f"model {name!r}: expected a sampler that has run, or two finite numbers, the second not negative; got {pair!r}"
    )
