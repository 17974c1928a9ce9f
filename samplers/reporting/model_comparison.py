"""Model comparison: posterior probabilities of models from their evidences (``docs/theory/evidence``)."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, logsumexp, ndtri

from .summary import aligned, is_tempered, log_posterior_of


class ModelComparison(NamedTuple):
    """Comparison of models, one entry per model, in the order given. ``str`` gives a table with the verdicts.

    Attributes
    ----------
    names : tuple of str
        Names of the models.
    log_evidence, log_evidence_error : ndarray, shape (n,)
        Log-evidences and their standard errors.
    probability : ndarray, shape (n,)
        Posterior probabilities of the models, with equal prior probabilities.
    lower, upper : ndarray, shape (n,)
        95 % intervals of the posterior probabilities, from the log-odds.
    summaries : tuple of str
        ``sampler.verdict.summary`` of each model; empty for a pair of numbers.
    """

    names: tuple[str, ...]
    log_evidence: np.ndarray
    log_evidence_error: np.ndarray
    probability: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    summaries: tuple[str, ...]

    def __str__(self) -> str:
        table = [("model", "log evidence", "difference", "probability", "95 % interval")]
        for k in np.argsort(-self.probability, kind="stable"):
            table.append(
                (
                    self.names[k],
                    f"{self.log_evidence[k]:.3f} +- {self.log_evidence_error[k]:.3f}",
                    f"{self.log_evidence[k] - self.log_evidence.max():.3f}",
                    f"{self.probability[k]:.4g}",
                    f"{self.lower[k]:.4g} ... {self.upper[k]:.4g}",
                )
            )
        said = [f"{name}: {text}" for name, text in zip(self.names, self.summaries, strict=True) if text]
        return "\n".join([*aligned(table), *said])

    __repr__ = __str__


def compare_models(models: Mapping[str, Any]) -> ModelComparison:
    """Posterior probabilities of models for the same data, with equal prior probabilities.

    Other prior probabilities are added to the log-evidences of pairs, as logarithms.

    Parameters
    ----------
    models : mapping of str to (sampler or tuple of float)
        For each name a sampler that has run (any object with ``log_evidence`` and ``log_evidence_error``), or a pair
        (log-evidence, standard error). Prior and likelihood must be normalised, and the measurements the same.

    Returns
    -------
    ModelComparison

    Examples
    --------
    >>> print(compare_models({"elastic": (-120.3, 0.1), "inelastic": (-118.9, 0.1)}))
    model           log evidence  difference  probability      95 % interval
    inelastic  -118.900 +- 0.100       0.000       0.8022  0.7545 ... 0.8425
    elastic    -120.300 +- 0.100      -1.400       0.1978  0.1575 ... 0.2455
    """
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
    said = (each.verdict.summary if is_tempered(each) and each.iteration else "" for each in models.values())
    shares = expit(odds), expit(odds - reach), expit(odds + reach)
    return ModelComparison(tuple(models), log_evidence, error, *shares, tuple(said))


def _evidence(name: str, model: Any) -> tuple[float, float]:
    pair = (model.log_evidence, model.log_evidence_error) if hasattr(model, "log_evidence_error") else model
    with suppress(TypeError, ValueError):
        value, error = map(float, pair)
        if math.isfinite(value) and 0.0 <= error < math.inf:
            return value, error
    raise ValueError(
        f"model {name!r}: expected a sampler with log_evidence and log_evidence_error, or a pair of numbers, which are "
        f"finite, and the error not negative; got {pair!r}"
    )
