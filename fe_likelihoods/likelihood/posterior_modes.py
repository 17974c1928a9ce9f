"""Modes of a posterior with their Laplace approximations: the search of guides, refined in the parameters themselves.

The search (`fe_likelihoods.emulation.modes`) maximises the density of standard normal coordinates. Here the response is
taken as linear around each of its ends,

    y(theta) = y_0 + sum_k J_k (theta_k - theta_0k),

and the density of the parameters is maximised with it, until the top stays: one simulation each time, in which a
rank-one correction of J takes up what was not linear (Broyden 1965), unless the model has derivatives. With the Hessian
H of minus the logarithm of the density, the covariance is H^-1 and the evidence exp(top) (2 pi)^(d/2) det(H)^(-1/2). A
parameter at a bound has no curvature; beside the bound the density falls exponentially, so its factor is one over the
slope.
"""

from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from ..emulation.modes import Mode, find_modes
from ..simulation.model import SimulationFailed, derivatives_batch, has_jacobian
from ..text_tables import text_table
from .likelihood import FELikelihood

if TYPE_CHECKING:
    import pandas

__all__ = ["PosteriorMode", "PosteriorModes", "posterior_modes"]

_DIFFERENCE = 0.1  # step of differences of responses, in standard deviations: 1 % of the curvature's effect on a fit
_HESSIAN_STEP = 0.01  # of differences of gradients, in standard deviations
_GAIN = 0.02  # of the log-probability, below which the next step is the last: 0.2 standard deviations before it
_MOST_ROUNDS = 8  # oscillators, modal data and the bridges took 1 to 4


class PosteriorMode(NamedTuple):
    """One mode of a posterior.

    Attributes
    ----------
    parameters : (ndim,) float
        The most probable parameters around: a local maximum of `Posterior.log_prob`.
    log_prob : float
        `Posterior.log_prob` there, with a simulation.
    covariance : (ndim, ndim) float
        Laplace approximation, for a response that is linear within the mode; zero for parameters at a bound.
    log_evidence : float
        Logarithm of the evidence of this mode in the same approximation.
    at_bounds : tuple of str
        Parameters that are at a bound of their prior.
    converged : bool
        False if the log-probability could still rise by more than 0.02 before the last simulation, or the density has
        no maximum there.
    """

    parameters: np.ndarray
    log_prob: float
    covariance: np.ndarray
    log_evidence: float
    at_bounds: tuple[str, ...]
    converged: bool


class PosteriorModes(NamedTuple):
    """All modes that a search found, the one with the largest evidence first; printed as a table.

    Attributes
    ----------
    modes : tuple of PosteriorMode
    parameter_names : tuple of str
    simulations : int
        Simulations run; a call of the model's ``jacobian`` counts as one.
    finished : bool
        False if a limit ended the search, so that modes may be missing.
    """

    modes: tuple[PosteriorMode, ...]
    parameter_names: tuple[str, ...]
    simulations: int
    finished: bool

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence, the sum over the modes."""
        return float(logsumexp([mode.log_evidence for mode in self.modes])) if self.modes else -np.inf

    def to_dataframe(self) -> "pandas.DataFrame":
        """The modes as rows of a `pandas.DataFrame`: parameters, their standard deviations, log_prob, log_evidence."""
        import pandas

        rows = []
        for mode in self.modes:
            sd = np.sqrt(np.diag(mode.covariance))
            row = dict(zip(self.parameter_names, mode.parameters, strict=True))
            row |= {f"sd_{name}": each for name, each in zip(self.parameter_names, sd, strict=True)}
            rows.append(row | {name: getattr(mode, name) for name in ("log_prob", "log_evidence", "converged")})
        return pandas.DataFrame(rows)

    def __str__(self) -> str:
        rows = [["parameter", *(f"mode {k + 1}" for k in range(len(self.modes)))]]
        for k, name in enumerate(self.parameter_names):
            ends = [(mode.parameters[k], np.sqrt(mode.covariance[k, k])) for mode in self.modes]
            rows.append([name, *(f"{value:.4g} +- {sd:.2g}" for value, sd in ends)])
        rows.append(["log-probability", *(f"{mode.log_prob:.2f}" for mode in self.modes)])
        shares = np.exp([mode.log_evidence - self.log_evidence for mode in self.modes])
        rows.append(["share of the evidence", *(f"{share:.2g}" for share in shares)])
        rows.append(["converged", *("yes" if mode.converged else "no" for mode in self.modes)])
        return text_table(rows)


class _Linear:
    """A model (`Model`) whose response is linear around parameters."""

    def __init__(self, model: Any, at: np.ndarray, response: np.ndarray, slopes: np.ndarray) -> None:
        self.parameter_names, self.channels, self.dt = tuple(model.parameter_names), model.channels, model.dt
        self.n_steps, self.fingerprint = model.n_steps, "linear"
        self.at, self.response, self.slopes = at, response, slopes

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) at parameters (n_parameters,)."""
        return self.response + np.tensordot(theta - self.at, self.slopes, 1)

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """Derivatives (n_parameters, n_channels, n_steps), the same everywhere."""
        return self.slopes


def posterior_modes(
    posterior: Any, starts: int = 12, seed: Any = None, max_simulations: float | None = None
) -> PosteriorModes:
    """Modes of a `Posterior`, see `Posterior.mode`; ValueError as `Posterior.guide`."""
    before = posterior.likelihood.simulations
    search = find_modes(posterior, starts, seed, max_simulations)
    refined: list[PosteriorMode] = []
    for mode in search.modes:
        found = _refined(posterior, mode)
        same = [k for k, other in enumerate(refined) if _no_valley_between(posterior, found, other)]
        for k in reversed(same):
            found = max(found, refined.pop(k), key=lambda each: each.log_prob)
        refined.append(found)
    refined.sort(key=lambda each: -each.log_evidence)
    names = tuple(posterior.parameter_names)
    return PosteriorModes(tuple(refined), names, posterior.likelihood.simulations - before, search.finished)


def _no_valley_between(posterior: Any, one: PosteriorMode, other: PosteriorMode) -> bool:
    """Whether the log-probability on the line between two modes stays above the lower one: then they are one."""
    shares = np.array([0.25, 0.5, 0.75])[:, None]
    between = posterior.log_prob(one.parameters + shares * (other.parameters - one.parameters))
    return bool((between >= min(one.log_prob, other.log_prob)).all())


def _refined(posterior: Any, mode: Mode) -> PosteriorMode:
    """The top of the density of the parameters around a mode of the standard normal coordinates."""
    prior, bounds = posterior.prior, posterior.prior.bounds
    widths = np.sqrt(np.diag(mode.covariance))
    z = prior.to_normal(mode.parameters)
    ends = [np.diag(prior.from_normal(z + sign * np.diag(widths))) for sign in (0.5, -0.5)]
    sd = np.maximum(ends[0] - ends[1], 1e-9 * np.abs(mode.parameters))
    x, tangents = np.clip(mode.parameters, *bounds.T), _tangents(posterior.likelihood, mode.parameters, sd)
    value, gain = posterior.log_prob(x), np.inf
    for _ in range(_MOST_ROUNDS):
        linear = _linear_posterior(posterior, tangents)
        new = _top(linear, x, sd, bounds)
        gain = linear.log_prob(new) - value
        shorter = (x + share * (new - x) for share in (1.0, 0.5, 0.25, 0.125))  # too far for the linear response?
        reached = next(((y, each) for each in shorter if (y := posterior.log_prob(each)) > value), None)
        if reached is None:
            break
        value, x = reached
        if gain < _GAIN:
            break
        tangents = _tangents(posterior.likelihood, x, sd, tangents)
    return _laplace(linear, x, float(value), sd, bounds, bool(mode.converged and gain < _GAIN))


def _tangents(likelihood: Any, x: np.ndarray, sd: np.ndarray, before: Sequence[_Linear] = ()) -> list[_Linear]:
    """Responses and derivatives of all data sets at parameters (ndim,).

    Where a model has no derivatives, they are differences, or a rank-one correction of those at the point `before`.
    """
    found = []
    for (part, columns), old in zip_longest(likelihood.parts(), before):
        d, slopes = part.simulator.n_structural, None if old is None else old.slopes
        at, steps = x[columns][:d], _DIFFERENCE * sd[columns][:d]
        (response,) = _responses(part, at[None])
        if has_jacobian(part.model):
            slopes = derivatives_batch(part.model, at[None], part.simulator.pool)[0]
        elif old is None:
            others, reasons = part.simulate(at + np.diag(steps))
            if (failed := np.array([bool(reason) for reason in reasons])).any():  # beside failures: behind
                steps[failed] *= -1.0
                others[failed] = _responses(part, at + np.diag(steps)[failed])
            slopes = (others - response) / steps[:, None, None]
        elif (step := at - old.at).any():
            missed = response - old.response - np.tensordot(step, slopes, 1)
            slopes = slopes + step[:, None, None] * missed / (step @ step)
        found.append(_Linear(part.model, at, response, slopes))
    return found


def _responses(part: Any, thetas: np.ndarray) -> np.ndarray:
    batch = part.simulate(thetas)
    if reason := next(filter(None, batch.reasons), ""):
        raise SimulationFailed(f"a simulation beside a mode failed: {reason}")
    return batch.response


def _linear_posterior(posterior: Any, tangents: Sequence[_Linear]) -> Any:
    """The posterior with linear models in place of its own: nothing is simulated."""
    parts = {
        key: FELikelihood(tangent, part.measurements, part.noise)
        for (key, part), tangent in zip(posterior.likelihood.likelihoods.items(), tangents, strict=True)
    }
    return type(posterior)(posterior.likelihood.with_likelihoods(parts), posterior.prior)


def _top(linear: Any, x: np.ndarray, sd: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Most probable parameters (ndim,) of a posterior with linear responses, from a point."""
    from scipy.optimize import minimize  # slow to import

    found = minimize(
        lambda z: (linear.negative_log_prob(z * sd), -linear.grad_log_prob(z * sd) * sd),
        x / sd,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds / sd[:, None],
        options={"ftol": 1e-14, "gtol": 1e-6},
    )
    return np.clip(found.x * sd, *bounds.T)


def _laplace(
    linear: Any, x: np.ndarray, value: float, sd: np.ndarray, bounds: np.ndarray, converged: bool
) -> PosteriorMode:
    gradient = linear.grad_log_prob(x)
    room = np.abs(bounds - x[:, None]) <= _HESSIAN_STEP * sd[:, None]
    outwards = np.array([-1.0, 1.0])[None] * gradient[:, None] > 0.0
    at_bound = (room & outwards).any(axis=1)
    free = np.flatnonzero(~at_bound)
    steps = _HESSIAN_STEP * sd[free]
    slopes = linear.grad_log_prob(
        np.concatenate([x + sign * np.eye(len(x))[free] * steps[:, None] for sign in (1, -1)])
    )
    hessian = -(slopes[: len(free), free] - slopes[len(free) :, free]) / (2.0 * steps[:, None])
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T) * np.outer(sd[free], sd[free]))
    proper = bool((values > 0.0).all())
    values = np.where(values > 0.0, values, 1.0)
    covariance = np.zeros((len(x), len(x)))
    covariance[np.ix_(free, free)] = (vectors / values) @ vectors.T * np.outer(sd[free], sd[free])
    log_evidence = value + 0.5 * (len(free) * np.log(2.0 * np.pi) - np.log(values).sum()) + np.log(sd[free]).sum()
    log_evidence -= np.log(np.abs(gradient[at_bound])).sum()
    names = tuple(name for name, bound in zip(linear.parameter_names, at_bound, strict=True) if bound)
    return PosteriorMode(x, value, covariance, float(log_evidence), names, converged and proper)
