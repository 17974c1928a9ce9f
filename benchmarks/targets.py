"""Four targets with known answers: cost of a sampler on them, and the errors of its result.

The targets are those of ``benchmarks/sampler_targets.py`` in the reference material (``FE_SHARED``): a mimic of the
posterior of the bridge column (T1), two modes in eleven dimensions (T2), two bananas (T3), a two-storey building (T4).
Evaluations are counted in the likelihood. Errors of means are in posterior standard deviations, errors of standard
deviations are relative; both are root mean squares over dimensions and seeds.
"""

import importlib.util
import os
from multiprocessing.sharedctypes import RawValue
from pathlib import Path

import numpy as np

from .rows import Row

__all__ = ["Target", "as_row", "errors", "target_named"]

SHARED = Path(os.environ.get("FE_SHARED", Path(__file__).resolve().parents[2] / "shared"))


class Target:
    """A target as a posterior and as the separate functions that some samplers need; it counts its evaluations."""

    def __init__(self, target: dict, log_density, transform):
        self.prior, self._log_likelihood = target["prior"], target["log_likelihood"]
        self.mean, self.sd, self.mode = target["mean"], target["sd"], target["mode"]
        self.log_evidence = target["log_evidence"]
        self._log_density, self._transform = log_density, transform
        self.ndim = len(self.prior)
        self.count = RawValue("q", 0)  # shared with the process that monitors a run

    @property
    def evaluations(self) -> int:
        """Points at which the likelihood was evaluated."""
        return self.count.value

    def log_prior(self, x: np.ndarray) -> np.ndarray:
        """(n, ndim) -> (n,), -inf outside the support."""
        return self._log_density(self.prior, x)

    def log_likelihood(self, x: np.ndarray) -> np.ndarray:
        """(n, ndim) -> (n,)."""
        self.count.value += len(x)
        return self._log_likelihood(x)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        log_prior = self.log_prior(x)
        inside = log_prior > -np.inf
        log_prob = np.full(len(x), -np.inf)
        log_prob[inside] = log_prior[inside] + self.log_likelihood(x[inside])
        return log_prob

    def prior_transform(self, u: np.ndarray) -> np.ndarray:
        """Map the unit cube to parameters, (..., ndim) -> (..., ndim)."""
        return self._transform(self.prior, u)

    def sample_prior(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws of the prior, (n, ndim)."""
        return self.prior_transform(random.random_sample((n, self.ndim)))


def _module():
    path = SHARED / "benchmarks" / "sampler_targets.py"
    if not path.exists():
        raise ValueError(f"the targets must be at {path}: set FE_SHARED to the folder of the reference material")
    spec = importlib.util.spec_from_file_location("sampler_targets", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def target_named(name: str) -> Target:
    """Target of a name, with its counter at zero."""
    module = _module()
    return Target(module.TARGETS[name](), module.prior_log_density, module.prior_transform)


def errors(target: Target, samples: np.ndarray, weights: np.ndarray | None = None) -> dict[str, float]:
    """Errors of a run's samples (n, ndim), weighted or not: ``z``, ``sd`` and, with two modes, ``weight``."""
    mean = np.average(samples, axis=0, weights=weights)
    sd = np.sqrt(np.average((samples - mean) ** 2, axis=0, weights=weights))
    found = {
        "z": np.sqrt(np.mean(((mean - target.mean) / target.sd) ** 2)),
        "sd": np.sqrt(np.mean((sd / target.sd - 1.0) ** 2)),
    }
    if target.mode is not None:
        found["weight"] = np.average(target.mode[0](samples), weights=weights) - target.mode[1]
    return found


def as_row(what: str, case: str, runs: list[dict]) -> Row:
    """One row for several runs: the mean number of evaluations, with the errors in the note.

    Every run has ``evaluations``. A run with a result has ``microseconds`` of CPU time per evaluation, the `errors`,
    whether it ``warned``, and optionally ``evidence`` (error of log Z) and ``error`` (standard error of log Z that the
    sampler reports). A run without a result has a ``reason``.
    """
    note = []
    answers = [run for run in runs if "reason" not in run]
    column = {key: np.array([run[key] for run in answers]) for key in (answers[0] if answers else ())}
    if answers:
        note.append(f"z {np.sqrt(np.mean(column['z'] ** 2)):.3f}")
        note.append(f"sd {100 * np.sqrt(np.mean(column['sd'] ** 2)):.1f} %")
    if "weight" in column:
        note.append(f"error of the mode's weight at most {np.max(np.abs(column['weight'])):.3f}")
    if "evidence" in column:
        reported = [f"({run['error']:.2f})" if "error" in run else "" for run in answers]
        pairs = zip(column["evidence"], reported, strict=True)
        note.append("log Z " + " ".join(f"{value:+.2f}{error}" for value, error in pairs))
    if answers:
        note.append(f"{column['microseconds'].mean():.1f} us CPU")
    for reason in dict.fromkeys(run["reason"] for run in runs if "reason" in run):
        note.append(f"{sum(run.get('reason') == reason for run in runs)} of {len(runs)} {reason}")
    if answers and column["warned"].any():
        note.append("warned")
    evaluations = np.mean([run["evaluations"] for run in runs])
    return Row(f"{what}: evaluations", case, evaluations, "", "; ".join(note))
