"""What a report needs of a finished run, read from the sampler and the posterior in one place.

A posterior of this package knows the units of its parameters, its prior and its data. A plain function knows none of
them; what is missing is empty or NaN here, and the report leaves it out.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from emcee import EnsembleSampler

from samplers import Verdict
from samplers.estimates.importance import EvidenceCheck

from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.parameters import Parameter
from ..priors.priors import Prior

__all__ = ["FinishedRun", "read_run"]

LONGEST_AUTOCORRELATION = 50.0  # iterations per autocorrelation time that emcee recommends


class FinishedRun(NamedTuple):
    """A run, as a report reads it.

    A tempered sampler is a subclass of emcee's sampler, with a ladder, an evidence and a verdict.
    """

    sampler: EnsembleSampler
    posterior: Any  # None if the sampler's log-density is a plain function
    likelihood: FELikelihood | JointLikelihood | None  # None without data of this package
    prior: Prior | None
    parameters: tuple[Parameter, ...]
    samples: np.ndarray  # (n, ndim) of the posterior [unit of the parameter]
    log_prob: np.ndarray  # (n,)
    mean_error: np.ndarray  # (ndim,) Monte Carlo standard error of the mean; NaN where it is not known
    sd_error: np.ndarray  # (ndim,) the same of the standard deviation
    effective_sample_size: float  # independent samples with the same error of the mean, the smallest
    truth: np.ndarray  # (ndim,), NaN where none is known
    discard: int  # iterations left out at the beginning of the chain
    tempered: bool
    verdict: Verdict | None
    check: EvidenceCheck | None  # independent estimate of the evidence
    autocorrelation_time: float  # the largest, of emcee's own sampler [iterations]; else NaN

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def is_inconclusive(self) -> bool:
        """Whether nothing can be said about the parameters: the verdict is "not usable", or the chain is too short."""
        if self.tempered:
            return self.verdict is not None and self.verdict.status == "not usable"
        return not self.sampler.iteration - self.discard >= LONGEST_AUTOCORRELATION * self.autocorrelation_time

    @property
    def n_modes(self) -> int:
        """Number of modes in which the run has points; one where that is not known."""
        return 1 if self.verdict is None else len(self.verdict.modes)

    @property
    def centre(self) -> np.ndarray:
        """The point that stands for the posterior (ndim,): its mean, or the best sample of several modes."""
        best = self.samples[int(np.argmax(self.log_prob))]
        return best if self.n_modes > 1 else self.samples.mean(axis=0)

    @property
    def centre_name(self) -> str:
        """What `centre` is, in words."""
        return "sample of highest posterior density" if self.n_modes > 1 else "posterior mean"


def read_run(
    sampler: EnsembleSampler,
    posterior: Any = None,
    *,
    names: Sequence[str] | None = None,
    truth: Mapping[str, float] | Sequence[float] | None = None,
    discard: int = 0,
) -> FinishedRun:
    """Read a finished run of this project or of emcee; `discard` as in `emcee.EnsembleSampler.get_chain`.

    By default the posterior is the sampler's log-density. Names are for a posterior without them; `truth` has true
    values of synthetic data, in the units of the samples. ValueError if the sampler has no chain, or names, true values
    or the posterior do not match it.
    """
    if not isinstance(sampler, EnsembleSampler):
        raise ValueError(
            f"report needs a sampler that has run (SMCSampler, TMCMCSampler or emcee.EnsembleSampler); got {sampler!r}"
        )
    if not 0 <= discard < sampler.iteration:
        raise ValueError(
            f"report needs a chain: the sampler has made {sampler.iteration} iterations, and discard={discard} leaves "
            "none. Call run_mcmc with one step or more, and discard fewer iterations"
        )
    posterior = getattr(sampler.log_prob_fn, "f", None) if posterior is None else posterior
    samples = sampler.get_chain(flat=True, discard=discard)
    parameters = _parameters(sampler, posterior, names)
    if len(parameters) != samples.shape[1]:
        raise ValueError(
            f"the chain has {samples.shape[1]} parameters, but the posterior or names= has {len(parameters)} "
            f"({', '.join(each.name for each in parameters)}): give the posterior that was sampled"
        )
    tempered = hasattr(sampler, "ladder") and bool(sampler.ladder)
    autocorrelation = np.nan if tempered else _autocorrelation_time(sampler, discard)
    mean_error, sd_error, size = _errors(sampler, samples, tempered, autocorrelation, discard)
    likelihood, prior = getattr(posterior, "likelihood", None), getattr(posterior, "prior", None)
    return FinishedRun(
        sampler=sampler,
        posterior=posterior,
        likelihood=likelihood if isinstance(likelihood, FELikelihood | JointLikelihood) else None,
        prior=prior if isinstance(prior, Prior) else None,
        parameters=parameters,
        samples=samples,
        log_prob=sampler.get_log_prob(flat=True, discard=discard),
        mean_error=mean_error,
        sd_error=sd_error,
        effective_sample_size=size,
        truth=_truth(truth, [each.name for each in parameters]),
        discard=discard,
        tempered=tempered,
        verdict=_verdict(sampler) if tempered else None,
        check=sampler.log_evidence_check if tempered else None,
        autocorrelation_time=autocorrelation,
    )


def _parameters(sampler: EnsembleSampler, posterior: Any, names: Sequence[str] | None) -> tuple[Parameter, ...]:
    if (described := getattr(posterior, "parameters", None)) is not None and names is None:
        return tuple(described)
    known = names or getattr(posterior, "parameter_names", None) or _names_of(sampler)
    return tuple(Parameter(str(name)) for name in known)


def _names_of(sampler: EnsembleSampler) -> list[str]:
    """Names that emcee's sampler was given, x0, x1, ... by default."""
    names = [f"x{i}" for i in range(sampler.ndim)]
    for name, places in (sampler.parameter_names if sampler.params_are_named else {}).items():
        places = np.atleast_1d(places)
        for k, place in enumerate(places):
            names[place] = name if len(places) == 1 else f"{name}_{k}"
    return names


def _verdict(sampler: EnsembleSampler) -> Verdict | None:
    """The verdict; None for a chain whose file has none."""
    try:
        return sampler.verdict
    except ValueError:
        return None


def _truth(truth: Mapping[str, float] | Sequence[float] | None, names: Sequence[str]) -> np.ndarray:
    if truth is None:
        return np.full(len(names), np.nan)
    if isinstance(truth, Mapping):
        if unknown := [name for name in truth if name not in names]:
            raise ValueError(f"truth has the unknown parameters {', '.join(unknown)}; known are {', '.join(names)}")
        return np.array([float(truth.get(name, np.nan)) for name in names])
    values = np.asarray(truth, dtype=float)
    if values.shape != (len(names),):
        raise ValueError(
            f"truth must be a mapping of names to values, or {len(names)} numbers in the order {', '.join(names)}; "
            f"got shape {values.shape}"
        )
    return values


def _autocorrelation_time(sampler: EnsembleSampler, discard: int) -> float:
    """Largest integrated autocorrelation time [iterations]; NaN where the chain is too short for any estimate."""
    with np.errstate(all="ignore"):
        times = sampler.get_autocorr_time(discard=discard, tol=0)
    return float(np.max(times)) if np.isfinite(times).all() else np.nan


def _errors(
    sampler: EnsembleSampler, samples: np.ndarray, tempered: bool, autocorrelation: float, discard: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Standard errors of means and standard deviations (ndim,), and the effective sample size of the worst parameter.

    For emcee's own sampler, those of as many independent draws.
    """
    spread = samples.std(axis=0)
    if tempered:
        error = sampler.mean_error(discard=discard)
        size = float(np.min((spread[error > 0.0] / error[error > 0.0]) ** 2, initial=len(samples)))
        return error, sampler.sd_error(discard=discard), size
    iterations = sampler.iteration - discard
    size = min(iterations * sampler.nwalkers / autocorrelation, float(len(samples)))  # min keeps a first NaN
    of_variance = np.square(samples - samples.mean(axis=0)).std(axis=0)
    return spread / np.sqrt(size), 0.5 * of_variance / np.where(spread > 0.0, spread, 1.0) / np.sqrt(size), float(size)
