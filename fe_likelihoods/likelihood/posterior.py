"""Posterior density: prior times likelihood, as one object that any Bayesian client can call.

Samplers have no common interface, but one object serves them all: a log-density of one or many points, its two factors,
a transform from the unit cube, draws of the prior, and the names of the parameters. Two properties hold for all
clients: a value is a finite number or -inf, also if a simulation fails, and nothing is simulated where the prior
density is zero.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from ..priors.distributions import Distribution, RandomState
from ..priors.points import as_points, complete_repr
from ..priors.priors import Prior
from ..simulation.failure_reasons import TransientReason
from ..simulation.model import has_jacobian
from .gradient import likelihood_gradient, slopes_along
from .in_threads import InThreads
from .joint import JointLikelihood
from .likelihood import FELikelihood
from .parameters import Parameter

if TYPE_CHECKING:
    from ..emulation.guide import ResponseGuide
    from ..emulation.modes import ModeSearch

__all__ = ["Posterior"]

_TOP = 1e-3  # log-density below the top of a mode: .04 standard deviations


class _Compiling(logging.Handler):
    """Passes the announcement that kernels are compiled to a function, instead of to the terminal."""

    def __init__(self, callback: Callable[..., None]) -> None:
        super().__init__(logging.WARNING)
        self._callback = callback

    def emit(self, record: logging.LogRecord) -> None:
        """Announce it."""
        self._callback(0.0, "compiling (once)")


class Posterior:
    """Posterior density of structural parameters and noise parameters.

    Every density takes one point (ndim,) and returns a float, or n points (n, ndim) and returns (n,). Mappings of
    parameter names to values are accepted as well. Calling the object is `log_prob`.

    Parameters
    ----------
    likelihood : FELikelihood, JointLikelihood or FunctionLikelihood
    prior : Prior, or mapping of parameter names to distributions
        It must have exactly the likelihood's parameters, in any order. A number instead of a distribution is the known
        value of a noise parameter, which is then no parameter of the posterior.

    Raises
    ------
    ValueError
        If the names of prior and likelihood differ; the message lists both.

    Examples
    --------
    >>> posterior = Posterior(likelihood, prior)
    >>> posterior.parameter_names
    ['stiffness', 'damping', 'sigma_acceleration', 'sigma_displacement']
    >>> log_density = posterior([1.1, 0.9, 0.1, 0.005])
    >>> posterior(posterior.sample_prior(5, rng=1)).shape  # many points at once
    (5,)
    """

    def __init__(
        self,
        likelihood: FELikelihood | JointLikelihood,
        prior: Prior | Mapping[str, Distribution],
    ) -> None:
        if isinstance(prior, Mapping):
            known = {name: float(value) for name, value in prior.items() if isinstance(value, Real)}
            likelihood = likelihood.with_known(known) if known else likelihood
            prior = {name: each for name, each in prior.items() if name not in known}
        self.likelihood = likelihood
        prior = prior if isinstance(prior, Prior) else Prior(prior)
        self.prior = prior.reorder(likelihood.parameter_names)

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return self.prior.dim

    @property
    def parameter_names(self) -> list[str]:
        """Structural parameters first, then noise parameters; a list, as emcee, arviz and corner expect."""
        return list(self.prior.names)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Units, nominal values and labels of the parameters, for tables and figures."""
        return self.likelihood.parameters

    @property
    def fast_parameters(self) -> tuple[int, ...]:
        """Indices of the parameters whose change needs no simulation."""
        return self.likelihood.fast_parameters

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of everything the density depends on: likelihood, noise and prior.

        It is the same in every process.

        Raises
        ------
        ValueError
            If the ``repr`` of the noise or of a distribution does not show its values.
        """
        parts = self.likelihood.density_parts()
        for name, distribution in self.prior.distributions.items():
            parts += [
                *([name] if isinstance(name, str) else name),
                type(distribution).__qualname__,
                complete_repr(distribution),
            ]
        return hashlib.blake2b(json.dumps(parts).encode(), digest_size=16).hexdigest()

    @property
    def data_fingerprint(self) -> str:
        """Hex digest of the measurements: evidences of posteriors with the same digest can be compared."""
        return self.likelihood.data_fingerprint

    def log_prob(self, x: Any) -> np.ndarray | float:
        """Log-prior plus log-likelihood: the posterior density up to the evidence.

        Examples
        --------
        >>> bool(posterior.log_prob([1.1, 0.9, 0.5, 0.02]) == posterior([1.1, 0.9, 0.5, 0.02]))
        True
        >>> posterior.log_prob([-1.0, 0.9, 0.5, 0.02])  # outside the prior: nothing is simulated
        -inf
        """
        points = as_points(x, self.prior.names)
        log_prior = self.prior.logpdf(points)
        return log_prior + self.likelihood.log_likelihood(points, log_prior > -np.inf)

    __call__ = log_prob

    def log_prior(self, x: Any) -> np.ndarray | float:
        """Normalised log-density of the prior: -inf outside its support and where x is NaN."""
        return self.prior.logpdf(as_points(x, self.prior.names))

    def log_likelihood(self, x: Any) -> np.ndarray | float:
        """Log-likelihood; -inf outside the support of the prior, where nothing is simulated."""
        points = as_points(x, self.prior.names)
        return self.likelihood.log_likelihood(points, self.prior.logpdf(points) > -np.inf)

    @property
    def is_differentiable(self) -> bool:
        """Whether `grad_log_prob` can be computed: all models know the derivatives of their response."""
        models = [part.model for part, _ in self.likelihood.data_sets()]
        return bool(models) and all(map(has_jacobian, models))

    def grad_log_prob(self, x: Any) -> np.ndarray:
        """Gradient of `log_prob`, for models that know the derivatives of their response (``jacobian``).

        Hamiltonian samplers and optimisers need it. A point costs one simulation, whose response is cached, and one
        call of the model's ``jacobian``.

        Parameters
        ----------
        x : array_like (ndim,) or (n, ndim), or mapping
            As for `log_prob`.

        Returns
        -------
        (ndim,) or (n, ndim) float
            By the units of the parameters. Zeros where `log_prob` is -inf.

        Raises
        ------
        ValueError
            If a model has no ``jacobian``, or it fails.

        Examples
        --------
        >>> posterior.grad_log_prob([1.1, 0.9, 0.5, 0.02]).shape
        (4,)
        """
        return self._gradient(x, True)

    def grad_log_likelihood(self, x: Any) -> np.ndarray:
        """Gradient of `log_likelihood`; see `grad_log_prob`, of which it is the part without the prior."""
        return self._gradient(x, False)

    def _gradient(self, x: Any, with_prior: bool) -> np.ndarray:
        if not self.is_differentiable:
            kinds = ", ".join(sorted({type(part.model).__name__ for part, _ in self.likelihood.data_sets()}))
            raise ValueError(
                "the gradient needs models with a method jacobian(theta), the derivatives (n_parameters, n_channels, "
                f"n_steps) of the response; got {kinds}: give FunctionModel jacobian=, or use a sampler that needs no "
                "gradient"
            )
        points = as_points(x, self.prior.names)
        rows = np.atleast_2d(points)
        gradient, bounds = np.zeros(rows.shape), self.prior.bounds
        inside = np.flatnonzero(self.possible(rows))
        if len(inside):
            ahead, behind = (self.prior.from_normal(half * np.eye(self.ndim)) for half in (0.5, -0.5))
            sd = np.diag(ahead - behind)  # of each parameter in the middle of the prior, about
            gradient[inside], good = likelihood_gradient(self.likelihood, rows[inside], sd, bounds)
            for k in inside[good] if with_prior else ():
                gradient[k] += slopes_along(self.prior.logpdf, rows[k], sd, bounds)
        return gradient if points.ndim == 2 else gradient[0]

    def possible(self, x: Any) -> np.ndarray | bool:
        """Whether the density may be positive, as far as prior and noise parameters tell; nothing is simulated.

        Elsewhere `log_prob` is -inf without a simulation, so that -inf is not a failure there. Samplers ask for it.
        """
        points = as_points(x, self.prior.names)
        rows = np.atleast_2d(points)
        possible = np.atleast_1d(self.prior.logpdf(rows)) > -np.inf
        possible[possible] = self.likelihood.possible(rows[possible])
        return possible if points.ndim == 2 else bool(possible[0])

    def prior_transform(self, u: np.ndarray) -> np.ndarray:
        """Map from the unit cube to the parameters, (ndim,) or (n, ndim), for nested samplers.

        Examples
        --------
        >>> posterior.prior_transform([0.5, 0.5, 0.5, 0.5]).round(3)  # medians of the prior
        array([1.   , 2.1  , 0.674, 0.034])
        """
        return self.prior.transform(u)

    def sample_prior(self, n: int, rng: RandomState = None) -> np.ndarray:
        """Draws of the prior.

        Parameters
        ----------
        n : int
        rng : int, numpy.random.Generator, numpy.random.RandomState or None
            A seed, a generator, or None for NumPy's global stream.

        Returns
        -------
        (n, ndim) float

        Examples
        --------
        >>> posterior.sample_prior(1000, rng=1).shape
        (1000, 4)
        """
        return self.prior.rvs(n, rng)

    def _check_models(self, what: str) -> None:
        """ValueError if the likelihood is a function without a model."""
        if not self.likelihood.data_sets():
            raise ValueError(
                f"{what} needs the responses of a model, and {type(self.likelihood).__name__} has none: describe the "
                "data by an FELikelihood, with FunctionModel for a model of your own"
            )

    def marginal(self) -> "Posterior":
        """The same posterior with the standard deviations of its white noise integrated out.

        Its parameters are the structural ones, and its evidence is the same.
        `draw_noise` draws the standard deviations afterwards. A sampler has fewer dimensions to search, which saves
        simulations; the quadrature costs a few microseconds per row, and about 100 for a single row.

        Raises
        ------
        ValueError
            If the noise is not white, has sensor noise, or is integrated out already.

        Examples
        --------
        >>> posterior.marginal().parameter_names
        ['stiffness', 'damping']
        """
        likelihood = self.likelihood.marginal(self.prior.distributions)
        return Posterior(likelihood, self.prior.subset(likelihood.parameter_names))

    def draw_noise(self, x: Any, rng: RandomState = None) -> dict[str, np.ndarray]:
        """Complete samples of all parameters from samples of the structural ones, for a `marginal` posterior.

        The standard deviations are drawn once per sample from their conditional posterior, given its misfit. Cached
        samples are not simulated again.

        Parameters
        ----------
        x : (n, ndim) float, or mapping
            Samples of this posterior.
        rng : int, numpy.random.Generator, numpy.random.RandomState or None
            As for `sample_prior`.

        Returns
        -------
        dict of str to (n,) float
            Structural parameters, then noise parameters; accepted as samples by
            `fe_likelihoods.prediction.propagation.propagate`.

        Raises
        ------
        ValueError
            If the noise is not integrated out (its parameters are in the samples), or if a simulation fails or fits
            exactly.

        Examples
        --------
        >>> marginal = posterior.marginal()
        >>> complete = marginal.draw_noise(samples[:, :2], rng=1)
        >>> sorted(complete)
        ['damping', 'sigma_acceleration', 'sigma_displacement', 'stiffness']
        """
        return self.likelihood.draw_noise(x, rng)

    def guide(self, starts: int = 12) -> "ResponseGuide":
        """A guide for samplers: finds the modes from the responses and emulates the responses around them.

        It reduces the simulations from thousands to hundreds: ``SMCSampler(..., guide=posterior.guide())``. The result
        does not depend on the guide, since every draw of the guide is simulated and weighted.

        Parameters
        ----------
        starts : int
            Starts of the search for modes that shall lead to a mode: the median of the prior, and a Latin hypercube of
            its quantiles. At most twice as many begin. A mode to which no start leads can be missed.

        Returns
        -------
        ResponseGuide

        Raises
        ------
        ValueError
            If `starts` is not a whole number of at least one, the likelihood caches too few simulations in memory, or
            the noise uses statistics that are not quadratic in the residuals.

        Notes
        -----
        The likelihood caches the responses that the guide requests, in memory and in the file of its cache, so another
        sampler with a guide repeats no simulation of them.

        Examples
        --------
        >>> guided = SMCSampler(40, posterior.ndim, posterior, vectorize=True, guide=posterior.guide(), seed=1)
        >>> state = guided.run_mcmc(None, 1)
        >>> bool(10 * guided.simulations < sampler.simulations)
        True
        """
        self._check_models("a guide")
        from ..emulation.guide import ResponseGuide  # scipy.special and scipy.optimize are slow to import

        return ResponseGuide(self, starts)

    def mode(
        self, starts: int = 12, seed: Any = None, max_simulations: float | None = None, progress: bool | str = False
    ) -> "ModeSearch":
        """The modes of the density: most probable parameters, Laplace covariances and evidences.

        The search of `guide`, with a few more simulations at each top. Responses are cached, so a sampler with a guide,
        or another search, repeats none of them.

        Parameters
        ----------
        starts : int
            As for `guide`.
        seed : int, Generator or RandomState, optional
            Of the starts.
        max_simulations : float, optional
            Limit of the search.
        progress : bool or str
            Whether to show the simulations so far, as in `run_mcmc`.

        Returns
        -------
        ModeSearch
            Print it for a table; ``modes[0].parameters`` are the most probable ones.

        Raises
        ------
        ValueError
            As `guide`.

        Notes
        -----
        Density and Laplace approximation are those of standard normal coordinates of the prior, in which it has no
        bounds. On a posterior that is curved or cut by a bound they are rough: sample with a guide. A mode that no
        start leads to is not found: one to which a third of the starts lead is missed by six starts in 9 of 100 cases,
        and by twelve in fewer than one.

        Examples
        --------
        >>> found = posterior.mode(seed=1)
        >>> len(found.modes), found.modes[0].converged
        (1, True)
        """
        self._check_models("the search for modes")
        from samplers.reporting.progress import open_bar

        from ..emulation.modes import find_modes  # scipy.special and scipy.optimize are slow to import

        with open_bar(progress, None, bar_format="{desc}: {n:.0f} simulations [{elapsed}]") as bar:

            def show(simulations: float, doing: str = "search") -> None:
                bar.set_description_str(doing, refresh=doing != "search")
                bar.update(simulations)

            show(0.0)
            bar.refresh()  # the first simulation may take long
            self.when_simulated(show if progress else None)
            try:
                return find_modes(self, starts, seed, max_simulations, _TOP, lambda spent: show(spent - bar.n))
            finally:
                self.when_simulated(None)

    def executor(self) -> InThreads:
        """An executor whose threads call this posterior, each for one point, and wait for its simulations.

        Samplers that propose points while others still run keep all workers of a pool busy with it.

        Examples
        --------
        >>> future = posterior.executor().submit(posterior, posterior.sample_prior(1)[0])
        >>> isinstance(future.result(), float)
        True
        """
        self._check_models("asynchronous work")
        return InThreads(self)

    def when_simulated(self, callback: Callable[..., None] | None) -> None:
        """Call a function with the number of points whose simulations have ended, for the progress of samplers.

        It is divided by the number of data sets; the function must not raise, and None ends the announcements. A batch
        without a pool and without a cache on disk is then run in parts of about 5 s. A compilation of kernels is
        announced as ``callback(0.0, "compiling (once)")``.
        """
        announces = logging.getLogger("fe_likelihoods.kernels.jit")  # of its first compilation
        announces.handlers = [each for each in announces.handlers if not isinstance(each, _Compiling)]
        if callback is not None:
            announces.addHandler(_Compiling(callback))
        parts = self.likelihood.data_sets()
        share = 1.0 / max(len(parts), 1)
        for likelihood, _ in parts:
            likelihood.simulator.when_simulated = None if callback is None else lambda n: callback(n * share)

    def failure(self, x: Any) -> tuple[str, float]:
        """Reason of a failed simulation at a point (ndim,) evaluated in this process, empty where there was none.

        And its log-density: -inf, or NaN if the cause is not the model, such as a worker that was killed. Samplers
        record both where they evaluate points in other processes.
        """
        (reason,) = self.likelihood.failures_at(x)
        return reason, np.nan if isinstance(reason, TransientReason) else -np.inf

    def failures_at(self, x: Any) -> list[str]:
        """Reasons of the failed simulations at points (n, ndim) evaluated in this process, empty for others.

        Samplers record them, since the log-probability is -inf there, as at impossible parameters.
        """
        return self.likelihood.failures_at(x)

    def recall_failures(self, x: Any, reasons: Sequence[str]) -> None:
        """Count what an earlier process has simulated at points (n, ndim), so that `report` has its failures.

        `reasons` come from `failures_at`. A sampler that goes on from a file calls this; points whose simulations
        are known here are not counted again.
        """
        self.likelihood.recall_failures(x, reasons)

    def report(self) -> dict:
        """Summary of the simulations that this object has requested in this process.

        Returns
        -------
        dict
            ``simulations``, ``verifications`` (rows of the cache on disk that were compared with a further simulation),
            ``unverified`` (rows that could not be compared, because the further simulation was stopped), ``cache_hits``
            (rows whose statistics were cached), ``disk_hits`` (how many of these came from the cache on disk),
            ``failures`` (list of ``{"parameters", "reason"}``, with ``"transient"`` where
            the cause is not the model; the first 1000), ``failure_count``, ``transient_failures`` (failures that a
            later run simulates again, see `FailureLog`), ``failure_reasons`` (count per reason), ``seconds`` (wall time
            of the simulations). For a `JointLikelihood` also ``likelihoods``, the report of each part.

        Examples
        --------
        >>> once = Posterior(FELikelihood(model, measurements), prior)
        >>> value = once([1.1, 0.9, 0.5, 0.02])
        >>> once.report()["simulations"]
        1
        """
        return self.likelihood.report()
