"""The posterior: prior times likelihood, as one object that any Bayesian client can call.

There is no common interface among samplers, but one object answers them all: a density of an array (one point or
many), its two factors apart, a map from the unit cube, draws of the prior, and the names of the parameters. Two
promises make it safe to hand to them: a value is a finite number or -inf, whatever happens in a simulation, and
nothing is simulated where the prior is zero.
"""

import hashlib
import json
import re
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from .likelihood import FELikelihood, as_points
from .marginal_noise import MarginalNoise
from .priors import Distribution, Prior, RandomState

__all__ = ["Posterior"]

_ALMOST_INFINITE = 1e100  # less likely than anything, and far from overflow when differences of it are squared


def _description(thing: Any) -> str:
    """The ``repr`` of something, complete and the same in every process, or ValueError."""
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        text = repr(thing)
    if re.search(r"\bat 0x[0-9a-fA-F]+", text):
        raise ValueError(
            f"a fingerprint needs a repr that says what {type(thing).__qualname__} is, not where it lies: make it a "
            f"frozen dataclass or give it a __repr__ of all its values; got {text}"
        )
    return text


class Posterior:
    """Posterior density of structural parameters and noise.

    Every density takes a point (ndim,) and returns a float, or n points (n, ndim) and returns (n,). Named values are
    understood as well (see `fe_likelihoods.probability.likelihood.as_points`). Calling the object is `log_prob`.

    Parameters
    ----------
    likelihood : FELikelihood
    prior : Prior, or a mapping of names to distributions
        Of exactly the likelihood's parameters, in any order.
    coarse : Posterior, optional
        A cheaper posterior of the same parameters (of the first part of a record, say), for samplers that climb on it
        first: ``SMCSampler(..., coarse_log_prob_fn=posterior.coarse)``.

    Raises
    ------
    ValueError
        If the names of prior and likelihood, or of the coarse posterior, differ; the message lists both.

    Examples
    --------
    >>> posterior = Posterior(FELikelihood(model, measurements), prior)
    >>> sampler = emcee.EnsembleSampler(32, posterior.ndim, posterior, vectorize=True)
    >>> sampler.run_mcmc(posterior.sample_prior(32), 1000)
    """

    def __init__(
        self,
        likelihood: FELikelihood,
        prior: Prior | Mapping[str, Distribution],
        coarse: "Posterior | None" = None,
    ) -> None:
        self.likelihood = likelihood
        prior = prior if isinstance(prior, Prior) else Prior(prior)
        self.prior = prior.reorder(likelihood.parameter_names)
        if coarse is not None and tuple(coarse.parameter_names) != self.prior.names:
            raise ValueError(
                f"the coarse posterior must have the parameters {', '.join(self.prior.names)}, in this order; "
                f"it has {', '.join(coarse.parameter_names)}"
            )
        self.coarse = coarse

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return self.prior.dim

    @property
    def parameter_names(self) -> list[str]:
        """Structural parameters first, then the noise's: a list, as emcee, arviz and corner want it."""
        return list(self.prior.names)

    @property
    def fast_parameters(self) -> tuple[int, ...]:
        """Indices of the parameters whose change costs no simulation."""
        return self.likelihood.fast_parameters

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of all that the density depends on: likelihood, noise and prior.

        It is the same in another process. The coarse posterior does not enter.

        Raises
        ------
        ValueError
            If the noise or a distribution is of a class whose ``repr`` does not say what it is.
        """
        noise = self.likelihood.noise
        parts = [self.likelihood.fingerprint, type(noise).__qualname__, *noise.parameter_names, _description(noise)]
        for name, distribution in self.prior.distributions.items():
            parts += [name, type(distribution).__qualname__, _description(distribution)]
        return hashlib.blake2b(json.dumps(parts).encode(), digest_size=16).hexdigest()

    def __call__(self, x: Any) -> np.ndarray | float:
        """Same as `log_prob`."""
        return self.log_prob(x)

    def log_prob(self, x: Any) -> np.ndarray | float:
        """Log-prior plus log-likelihood: the posterior density up to the evidence."""
        points, log_prior, log_likelihood = self._evaluate(x)
        total = log_prior + log_likelihood
        return total if points.ndim == 2 else float(total[0])

    def log_prior(self, x: Any) -> np.ndarray | float:
        """Normalised log-density of the prior: -inf outside its support and where x is NaN."""
        return self.prior.logpdf(as_points(x, self.prior.names))

    def log_likelihood(self, x: Any) -> np.ndarray | float:
        """Log-likelihood: -inf also outside the prior's support, where nothing is simulated."""
        points, _, log_likelihood = self._evaluate(x)
        return log_likelihood if points.ndim == 2 else float(log_likelihood[0])

    def finite_log_likelihood(self, x: Any) -> np.ndarray | float:
        """`log_likelihood` with -1e100 for -inf: for clients that refuse infinities, or leave such points out.

        ultranest stops at an infinite value; bilby and pocomc draw such a point of the prior again, so that their
        evidence is too large by the share of the prior in which simulations fail.
        """
        return np.maximum(self.log_likelihood(x), -_ALMOST_INFINITE)[()]

    def negative_log_prob(self, x: Any) -> np.ndarray | float:
        """Minus `log_prob` with 1e100 for inf, for minimisers, whose differences of two infinities are NaN."""
        return np.minimum(-self.log_prob(x), _ALMOST_INFINITE)[()]

    def prior_transform(self, u: np.ndarray) -> np.ndarray:
        """From the unit cube to the parameters, (ndim,) or (n, ndim), as nested samplers ask."""
        return self.prior.transform(u)

    def sample_prior(self, n: int, rng: RandomState = None) -> np.ndarray:
        """Draws of the prior, (n, ndim); `rng` is a seed, a generator, or None for NumPy's global stream."""
        return self.prior.rvs(n, rng)

    def sample_start(self, n: int, rng: RandomState = None) -> np.ndarray:
        """Draws of the prior where the posterior is not zero, (n, ndim): where walkers can start.

        Several clients refuse a start of probability zero, which a draw of the prior is where its simulation fails.

        Raises
        ------
        ValueError
            If hardly any simulation succeeds: fewer than n of 100 n, or of 1000 where these are more.
        """
        rng = np.random.default_rng(rng) if isinstance(rng, int | np.integer) else rng
        found = np.empty((0, self.ndim))
        for _ in range(max(100, -(-1000 // n))):
            points = self.sample_prior(n, rng)
            found = np.concatenate([found, points[np.isfinite(self.log_prob(points))]])
            if len(found) >= n:
                return found[:n]
        raise ValueError(
            f"sample_start: the posterior is zero at nearly all draws of the prior ({len(found)} points found of {n} "
            "asked for); report() has the reasons: mend the model or narrow the prior"
        )

    def marginal(self) -> "Posterior":
        """The same posterior with the standard deviations of its white noise integrated out.

        It has the structural parameters alone, at the same evidence, and a coarse posterior of its own if this one has
        one. `draw_noise` gives the standard deviations back. An evaluation costs some microseconds more, and some
        hundred for a single row; what it saves are the simulations of samplers that search fewer dimensions.

        Raises
        ------
        ValueError
            If the noise is not white, has a known sensor, or is integrated out already.
        """
        names, noise = self.parameter_names, self.likelihood.noise
        n_structural = len(self.likelihood.model.parameter_names)
        priors = {name: self.prior.distributions[name] for name in names[n_structural:]}
        structural = {name: self.prior.distributions[name] for name in names[:n_structural]}
        return Posterior(
            self.likelihood.with_noise(MarginalNoise(noise, priors)),
            structural,
            None if self.coarse is None else self.coarse.marginal(),
        )

    def draw_noise(self, x: Any, rng: RandomState = None) -> dict[str, np.ndarray]:
        """Samples of all parameters from samples of the structural ones, where the noise is integrated out.

        One draw of the standard deviations for each sample, given its misfit; those that are remembered, in memory or
        in the cache, are not simulated again.

        Parameters
        ----------
        x : (n, ndim) float, or named values — samples of this posterior.
        rng : seed, generator or None — as in `sample_prior`.

        Returns
        -------
        dict of str to (n,) float : structural parameters, then the noise's; `fe_likelihoods.prediction.propagation.propagate` takes
            it as samples.

        Raises
        ------
        ValueError
            If the noise has not been integrated out (its parameters are in the samples), or a simulation fails or fits
            without an error.
        """
        noise = self.likelihood.noise
        if not isinstance(noise, MarginalNoise):
            raise ValueError(
                f"the noise's parameters {', '.join(noise.parameter_names)} are in the samples of this posterior; they "
                "are drawn where they have been integrated out, see marginal()"
            )
        points = np.atleast_2d(as_points(x, self.prior.names))
        misfit = self.likelihood.misfit(points)
        sigmas = noise.draw(misfit, self.likelihood.measurements.n_steps, rng)
        names = (*self.prior.names, *noise.noise.parameter_names)
        return dict(zip(names, np.hstack([points, sigmas]).T, strict=True))

    def report(self) -> dict:
        """What was simulated so far, by this object in this process.

        Returns
        -------
        dict
            ``simulations``, ``cache_hits`` (rows whose misfit was remembered instead), ``disk_hits`` (how many of them
            came from the cache on disk), ``failures`` (list of ``{"parameters", "reason"}``, and ``"seconds"`` where
            known, the first thousand), ``failure_count``, ``failure_reasons`` (count of each), ``seconds`` (wall time
            in simulations).
        """
        return {
            "simulations": self.likelihood.simulations,
            "cache_hits": self.likelihood.cache_hits,
            "disk_hits": self.likelihood.disk_hits,
            "failures": list(self.likelihood.failures),
            "failure_count": self.likelihood.failure_count,
            "failure_reasons": dict(self.likelihood.failure_reasons),
            "seconds": self.likelihood.seconds,
        }

    def _evaluate(self, x: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points as given, and the log-prior (n,) and log-likelihood (n,) of their rows."""
        points = as_points(x, self.prior.names)
        log_prior = np.atleast_1d(self.prior.logpdf(points))
        log_likelihood = np.full(len(log_prior), -np.inf)
        inside = log_prior > -np.inf
        if inside.any():
            log_likelihood[inside] = self.likelihood.log_likelihood(np.atleast_2d(points)[inside])
        return points, log_prior, log_likelihood
