"""Results of a tempered run: evaluations, failures, the stages, the evidence and Monte Carlo errors."""

from textwrap import shorten

import numpy as np

from .estimates.control_variates import SignedSample
from .estimates.genealogy import standard_error_of_mean, student_factor
from .estimates.importance import EvidenceCheck
from .evaluation.values import most_common_reasons
from .judgement.checks import OF_SHARES
from .judgement.clusters import Cluster, error_between_modes, find_clusters
from .judgement.failures import NearFailures
from .judgement.verdict import Verdict
from .record import as_limit
from .reports import GuidedRound, Stage

LONGEST_REASON = 200  # characters


class RunResults:
    """Base class of `samplers.tempered.TemperedSampler`: results after a run, and the limit to go on with."""

    _near: NearFailures | None = None

    @property
    def evaluations(self) -> int:
        """Points for which `log_prob_fn` was called, by this object and by an interrupted run that it continues."""
        return self._record.count

    @property
    def failure_count(self) -> int:
        """Number of evaluations that failed, by an exception or by NaN, and counted as -inf."""
        return len(self._record.failed)

    @property
    def _failed(self) -> tuple[str, str]:
        """How many simulations failed, without a guide's search, and the most frequent reasons; empty without any."""
        failed = {self._record.keys(each["parameters"][None])[0]: each["reason"] for each in self.failures}
        text = f"{len(failed)} of {len(self._record.simulated)} simulations" if failed else ""
        return text, most_common_reasons(failed.values())

    @property
    def failures(self) -> list[dict]:
        """``{"parameters": array (ndim,), "reason": str}`` of the failed points, without a guide's search."""
        failed = self._record.failed + self._record.counted
        return [{"parameters": parameters, "reason": reason} for parameters, reason in failed]

    @property
    def ladder(self) -> tuple[Stage, ...]:
        """Sequence of tempering stages of the last annealing; empty before it."""
        return self._result.ladder

    @property
    def log_evidence(self) -> float:
        """Log-evidence: `log_evidence_ladder` or `log_evidence_check`, by the smaller error."""
        return self._result.evidence[0]

    @property
    def log_evidence_error(self) -> float:
        """Standard error of `log_evidence`, from this run alone; at least half of what the two estimates differ by."""
        return self._result.evidence[1]

    @property
    def log_evidence_ladder(self) -> float:
        """Log-evidence by tempering: the sum of the increments over all stages."""
        return self._result.log_evidence_ladder

    @property
    def log_evidence_check(self) -> EvidenceCheck | None:
        """The evidence by importance sampling after the annealing; None with a guide, or if the limit ended the run."""
        self._result.require_finished()
        return self._result.check

    @property
    def founders(self) -> np.ndarray:
        """Founder (nwalkers,) of each walker: walkers with the same number are copies that have been moved since
        (`samplers.estimates.genealogy`); all different if they are not known.
        """
        founders = self._result.founders
        return np.arange(self.nwalkers) if founders is None else founders

    @property
    def _parents(self) -> np.ndarray:
        """Founders (nwalkers,) by the last resampling alone; all different if they are not known."""
        parents = self._result.parents
        return np.arange(self.nwalkers) if parents is None else parents

    @property
    def prior_draws(self) -> np.ndarray | None:
        """Draws of the prior (nwalkers, ndim) from which the run was annealed; None without a record of it."""
        return None if self._record.start is None else self._record.start.coords

    def mean_error(self, discard: int = 0, thin: int = 1) -> np.ndarray:
        """Monte Carlo standard errors (ndim,) of the mean over ``get_chain(discard, thin)``, from this run alone.

        Copies made by the latest resamplings, the autocorrelation of the chain (`samplers.estimates.genealogy`) and the
        errors of the shares of modes (`samplers.judgement.clusters`) are accounted for. For few `founders`, the errors
        are multiplied by a quantile of Student's t, so that two errors contain the true mean with 95 % probability.
        Where walkers and reliable weighted draws of several parts of the posterior (`log_evidence_check`) differ by
        more than both errors, the walkers have the error that is missing. If `founders` are not known, each walker
        counts as independent. Dependence between walkers, as by emcee's stretch move, a lost mode, and moves that did
        not move are not accounted for: after a `SamplingWarning` the errors are too small.

        Examples
        --------
        >>> bool(np.all(sampler.mean_error() < 0.3 * samples.std(axis=0)))
        True
        """
        chain, check = self._chain_of(discard, thin), self._result.check
        error = self._error_of_mean(chain, chain)
        if check is None or check.mean is None or not check.reliable:
            return error
        apart = np.square(chain.mean(axis=(0, 1)) - check.mean) - np.square(check.mean_error)
        return np.sqrt(np.maximum(np.square(error), apart))

    def sd_error(self, discard: int = 0, thin: int = 1) -> np.ndarray:
        """Monte Carlo standard errors (ndim,) of the standard deviations over ``get_chain(discard, thin)``.

        Those of `mean_error`, for the mean of the squared deviations: the error of a variance is 2 sd times the error
        of the standard deviation. Heavy tails that the chain has not met are not accounted for.
        """
        chain = self._chain_of(discard, thin)
        apart = chain - chain.mean(axis=(0, 1))
        sd = np.sqrt(np.square(apart).mean(axis=(0, 1)))
        return 0.5 * self._error_of_mean(chain, np.square(apart)) / np.where(sd > 0.0, sd, 1.0)

    def _chain_of(self, discard: int, thin: int) -> np.ndarray:
        """The chain (nsteps, nwalkers, ndim); ValueError if it has no step."""
        chain = self.get_chain(discard=discard, thin=thin)
        if not len(chain):
            raise ValueError(f"expected discard below the number of stored steps; got discard={discard}")
        return chain

    def _error_of_mean(self, chain: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Standard errors (k,) of the mean of values (nsteps, nwalkers, k) at the points of a chain.

        With Student's t for few founders, and with the errors of the shares of modes.
        """
        shares = np.unique(self.founders, return_counts=True)[1] / self.nwalkers
        errors = standard_error_of_mean(values, self.founders)
        if len(shares) > 1:
            errors = errors * student_factor(1.0 / np.sum(shares**2) - 1.0)
        if not self._result.finished:  # a chain that was not annealed
            return errors
        error = self._result.error_by_resampling
        return np.hypot(errors, error_between_modes(chain, values, self._parents, error))

    @property
    def rounds(self) -> tuple[GuidedRound, ...]:
        """Rounds of the guide in the last annealing of this object; empty without a guide."""
        return self._result.rounds

    @property
    def signed_sample(self) -> SignedSample | None:
        """Expectations under the posterior; None if the guide knows no density, or the draws alone are more accurate.

        ``sampler.signed_sample.expectation(function)`` gives an expectation and its standard error.
        """
        return self._result.signed

    @property
    def max_simulations(self) -> float | None:
        """Largest number of simulations, for the next call; None for no limit."""
        return self._record.limit

    @max_simulations.setter
    def max_simulations(self, value: float | None) -> None:
        self._record.limit = as_limit(value)

    @property
    def simulations(self) -> float:
        """Simulations of this run, also before an interrupt: distinct evaluated points, plus simulations by the guide.

        Points that differ only in ``log_prob_fn.fast_parameters`` count once.
        """
        return self._record.simulations

    @property
    def simulations_of_guides(self) -> float:
        """The part of `simulations` that guides have made for their search; first parts of a record are fractions."""
        return self._record.of_guides

    @property
    def verdict(self) -> Verdict:
        """Verdict on the result, with reasons; ``print(sampler.verdict)`` gives sentences."""
        if self._verdict is None:
            raise ValueError("there is no verdict before a run: call run_mcmc first")
        return self._verdict

    @property
    def modes(self) -> tuple[Cluster, ...]:
        """Modes in which the chain has points, with shares and their standard errors, the largest first."""
        lost = sum(each.numbers.get(OF_SHARES, 0.0) for each in self.verdict.findings)
        if self.iteration == 0:
            raise ValueError("modes are found in a chain, which is empty: call run_mcmc with one step or more")
        return find_clusters(self.get_chain(), self.founders, self._parents, self._result.error_by_resampling, lost)

    def describe(self) -> str:
        """One sentence on the result: status, modes, evidence, effective sample size and failures.

        Examples
        --------
        >>> sampler.describe()
        'Converged: one mode; log-evidence ... +- ...; effective sample size ...; no failed simulations.'
        """
        (log_evidence, error), modes, (failed, reasons) = self._result.evidence, self.modes, self._failed
        shares = ", ".join(f"{mode.share:.2f} +- {mode.share_error:.2g}" for mode in modes)
        failed = f"{failed} failed ({shorten(reasons, LONGEST_REASON)})" if failed else "no failed simulations"
        return (
            f"{self.verdict.status.capitalize()}: "
            f"{'one mode' if len(modes) == 1 else f'{len(modes)} modes with shares {shares}'}; log-evidence "
            f"{log_evidence:.2f} +- {error:.2g}; effective sample size {self.verdict.effective_sample_size:.0f}; "
            f"{failed}."
        )
