"""References for posteriors of expensive models: importance sampling that starts at the known modes.

Synthetic data have a known truth, so the search for the modes, the difficult part for a sampler, is left out. From
every given start, least squares finds the mode and its Gaussian approximation. Then rounds of draws from a mixture of
Student-t components follow, fitted to all earlier draws (Cornuet, Marin, Mira & Robert 2012,
doi:10.1111/j.1467-9469.2011.00756.x). The second half of the rounds is drawn from the last fit, and only these draws,
which had no part in it, give the result: draws that shaped the proposals that they are weighted with make log Z too
small, by 0.07 for ten parameters. A few thousand simulations give log Z to 0.03. Nothing of `samplers` is used. A mode
without a start is not in the result.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.special import gammaln

from tests.statistics.brute_force import Reference

__all__ = ["by_importance", "by_reciprocals", "find_mode"]

_FREEDOM = 6.0
_DIFFERENCE = 1e-3  # relative step of the finite differences
_PRIOR_WEIGHT = 1e-3  # of a proposal that is the prior


class _Component(NamedTuple):
    weight: float
    mean: np.ndarray
    factor: np.ndarray  # Cholesky factor of the scale matrix

    def draw(self, n, rng, freedom=_FREEDOM):
        z = rng.standard_normal((n, len(self.mean))) / np.sqrt(rng.chisquare(freedom, n) / freedom)[:, None]
        return self.mean + z @ self.factor.T

    def logpdf(self, x, freedom=_FREEDOM):
        d = len(self.mean)
        squares = np.square(np.linalg.solve(self.factor, (x - self.mean).T)).sum(axis=0)
        constant = gammaln(0.5 * (freedom + d)) - gammaln(0.5 * freedom) - 0.5 * d * np.log(freedom * np.pi)
        constant -= np.log(np.diag(self.factor)).sum()
        return constant - 0.5 * (freedom + d) * np.log1p(squares / freedom)


class _Proposal:
    """Mixture of components, and the prior with a small weight."""

    def __init__(self, components, prior):
        self.components, self.prior = components, prior
        self.weights = (
            np.array([c.weight for c in components]) * (1.0 - _PRIOR_WEIGHT) / sum(c.weight for c in components)
        )

    def draw(self, n, rng):
        counts = rng.multinomial(n, np.append(self.weights, _PRIOR_WEIGHT))
        parts = [c.draw(k, rng) for c, k in zip(self.components, counts[:-1], strict=True)]
        return np.concatenate([*parts, self.prior.rvs(int(counts[-1]), rng)])

    def logpdf(self, x, freedom=_FREEDOM):
        parts = [np.log(w) + c.logpdf(x) for w, c in zip(self.weights, self.components, strict=True)]
        return np.logaddexp.reduce([*parts, np.log(_PRIOR_WEIGHT) + self.prior.logpdf(x)], axis=0)


def _lag_one(rows: np.ndarray) -> np.ndarray:
    """Correlation of successive residuals (n_channels, 1)."""
    before, after = rows[:, :-1], rows[:, 1:]
    return ((before * after).sum(axis=1) / np.square(before).sum(axis=1))[:, None]


def find_mode(posterior: Any, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mode of the structural parameters near a start, and the Gaussian covariance there, both by least squares.

    The parameters of the noise are estimated from the residuals, at the start and again at each mode found with them:
    one standard deviation per channel, and for autoregressive noise the lag-one correlation.
    """
    likelihood = posterior.likelihood
    d = len(likelihood.model.parameter_names)
    priors = list(posterior.prior.distributions.values())[:d]
    moments = np.array([prior.moments for prior in priors])
    bounds = np.array([prior.bounds for prior in priors]).T
    correlated = any(name.startswith("rho") for name in posterior.parameter_names)

    def whitened(rows: np.ndarray, rho: np.ndarray) -> np.ndarray:
        first = rows[:, :1]
        return np.concatenate([first, (rows[:, 1:] - rho * rows[:, :-1]) / np.sqrt(1.0 - rho**2)], axis=1)

    def noise(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = likelihood.residuals(theta)
        rho = np.clip(_lag_one(rows), -0.999, 0.999) if correlated else np.zeros((len(rows), 1))
        return rho, np.sqrt(np.square(whitened(rows, rho)).mean(axis=1))

    def residuals(theta: np.ndarray, rho: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        rows = whitened(likelihood.residuals(theta), rho) / sigma[:, None]
        return np.concatenate([rows.ravel(), (theta - moments[:, 0]) / moments[:, 1]])

    theta = np.asarray(start, dtype=float)[:d]
    for _ in range(4 if correlated else 2):
        args = noise(theta)
        found = least_squares(
            residuals, theta, bounds=bounds, diff_step=_DIFFERENCE, args=args, ftol=1e-6, xtol=1e-5, max_nfev=20
        )
        theta = found.x
    return theta, np.linalg.inv(found.jac.T @ found.jac)


def _with_noise(posterior: Any, theta: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add the parameters of white or autoregressive noise, estimated from the residuals, to a Gaussian."""
    names = posterior.parameter_names[len(theta) :]
    if not names:
        return theta, covariance
    residuals = posterior.likelihood.residuals(theta)
    n, sigma = residuals.shape[1], residuals.std(axis=1)
    correlated = any(name.startswith("rho") for name in names)
    means, deviations = [], []
    for i, name in enumerate(names):
        row = residuals[i % len(residuals)]
        rho = float(_lag_one(row[None])[0, 0]) if correlated else 0.0
        if name.startswith("rho"):
            means.append(rho)
            deviations.append(max(0.01, np.sqrt((1.0 - rho**2) / n)))
        else:
            means.append(sigma[i % len(residuals)])
            deviations.append(1.2 * means[-1] * np.sqrt((1.0 + rho) / (1.0 - rho) / (2.0 * n)))
    whole = np.zeros((len(theta) + len(names),) * 2)
    whole[: len(theta), : len(theta)] = covariance
    whole[len(theta) :, len(theta) :] = np.diag(np.square(deviations))
    return np.append(theta, means), whole


def _refit(x, weights, labels, rng) -> list[_Component]:
    """Components of the mixture from weighted points, mode by mode: expectation-maximisation from a few starts."""
    d, components = x.shape[1], []
    for mode in np.unique(labels[weights > 0.0]):
        inside = (labels == mode) & (weights > 0.0)
        points, w = x[inside], weights[inside]
        share, w = w.sum(), w / w.sum()
        ess = 1.0 / np.square(w).sum()
        k = int(np.clip(ess / (8 * (d + 1)), 1, 6))
        mean = w @ points
        whole = (points - mean).T @ ((points - mean) * w[:, None])
        scale = np.sqrt(np.diag(whole)) + 1e-12
        if ess < 2 * d:
            continue
        centres = points[rng.choice(len(points), k, p=w)]
        factors = [np.linalg.cholesky(whole + 1e-9 * np.diag(scale**2))] * k
        shares = np.full(k, 1.0 / k)
        for _ in range(15):
            logs = np.stack(
                [
                    np.log(s) - 0.5 * np.square(np.linalg.solve(f, (points - c).T)).sum(0) - np.log(np.diag(f)).sum()
                    for s, c, f in zip(shares, centres, factors, strict=True)
                ]
            )
            membership = np.exp(logs - np.logaddexp.reduce(logs, axis=0)) * w
            shares = np.maximum(membership.sum(axis=1), 1e-6)
            centres = (membership @ points) / shares[:, None]
            factors = []
            for one, centre in zip(membership, centres, strict=True):
                c = (points - centre).T @ ((points - centre) * one[:, None]) / one.sum()
                shrink = min(0.9, 3.0 * (d + 1) / (ess * one.sum()))
                factors.append(np.linalg.cholesky((1.0 - shrink) * c + shrink * whole + 1e-9 * np.diag(scale**2)))
        components += [_Component(share * s, c, 1.1 * f) for s, c, f in zip(shares, centres, factors, strict=True)]
        components.append(_Component(0.1 * share, mean, 1.5 * np.linalg.cholesky(whole + 1e-9 * np.diag(scale**2))))
    return components


def _soften(log_weights: np.ndarray, wanted: float) -> np.ndarray:
    """Weights to the power of the largest beta, up to one, whose effective sample size is the wanted one.

    A few large weights must not decide a fit.
    """

    def weights(beta: float) -> np.ndarray:
        w = np.where(log_weights > -np.inf, np.exp(beta * (log_weights - log_weights.max())), 0.0)
        return w / w.sum()

    low, high = 0.0, 1.0
    if 1.0 / np.square(weights(1.0)).sum() >= wanted:
        return weights(1.0)
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 1.0 / np.square(weights(middle)).sum() > wanted else (low, middle)
    return weights(low)


def by_importance(
    posterior: Any,
    starts: np.ndarray,
    *,
    draws: int = 400,
    rounds: int = 8,
    seed: int = 1,
    labels: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Reference:
    """Reference of a posterior whose modes are near known points.

    Parameters
    ----------
    posterior : Posterior
    starts : (n_modes, d) float
        Structural parameters near every mode.
    draws, rounds : int
        Draws per round, and number of rounds; the result is that of the second half of them.
    seed : int
        Seed of the draws.
    labels : callable, optional
        Function of points (n, ndim) that returns the number of the mode (n,).

    Returns
    -------
    Reference
    """
    rng = np.random.default_rng([seed, 13])
    components = []
    for start in np.atleast_2d(starts):
        mean, covariance = _with_noise(posterior, *find_mode(posterior, start))
        components.append(_Component(1.0, mean, 1.2 * np.linalg.cholesky(covariance)))
    proposals, points, values = [], np.empty((0, posterior.ndim)), np.empty(0)
    label = (lambda x: np.zeros(len(x), dtype=int)) if labels is None else labels
    adapting, log_weights = max(rounds // 2, 1), np.empty(0)
    for number in range(rounds):
        if number == adapting:  # from here on, the last fit stays, and the draws that shaped it are left out
            softened = _soften(log_weights, max(60.0, 10.0 * posterior.ndim))
            components = _refit(points, softened, label(points), rng) or components
            proposals, points, values = [], np.empty((0, posterior.ndim)), np.empty(0)
        proposal = _Proposal(components, posterior.prior)
        proposals.append(proposal)
        new = proposal.draw(draws, rng)
        points, values = np.concatenate([points, new]), np.concatenate([values, posterior(new)])
        density = np.logaddexp.reduce([one.logpdf(points) for one in proposals], axis=0) - np.log(len(proposals))
        log_weights = values - density
        if number < adapting - 1:
            softened = _soften(log_weights, max(60.0, 10.0 * posterior.ndim))
            components = _refit(points, softened, label(points), rng) or components
    return _weighted(points, log_weights, label)


def by_reciprocals(
    posterior: Any, start: np.ndarray, *, draws: int = 20_000, rounds: int = 5, seed: int = 1
) -> Reference:
    """Reference of a posterior of positive parameters with one mode that is nearly normal in their reciprocals.

    With dozens of stiffnesses, a mixture that is fitted to the parameters loses its draws (an effective sample size of
    40 from 12 000 draws in 20 dimensions); in reciprocals one component suffices. Only the last round gives the result.

    Parameters
    ----------
    posterior : Posterior
        Without noise parameters.
    start : (d,) float
        Point near the mode.
    draws, rounds, seed : int
        Draws per round, number of rounds, seed.

    Returns
    -------
    Reference
    """
    rng = np.random.default_rng([seed, 17])
    mode, covariance = find_mode(posterior, start)
    component = _Component(1.0, 1.0 / mode, np.linalg.cholesky(covariance / np.outer(mode, mode) ** 2))
    for number in range(rounds):
        reciprocals = component.draw(draws, rng, 20.0 * len(mode))
        points = 1.0 / reciprocals
        log_weights = posterior(points) + 2.0 * np.log(np.abs(points)).sum(axis=1)
        log_weights -= component.logpdf(reciprocals, 20.0 * len(mode))
        if number < rounds - 1:
            w = _soften(log_weights, max(60.0, 10.0 * len(mode)))
            mean = w @ reciprocals
            factor = np.linalg.cholesky((reciprocals - mean).T @ (w[:, None] * (reciprocals - mean)))
            component = _Component(1.0, mean, 1.03 * factor)
    return _weighted(points, log_weights, lambda x: np.zeros(len(x), dtype=int))


def _weighted(points: np.ndarray, log_weights: np.ndarray, label: Callable[[np.ndarray], np.ndarray]) -> Reference:
    """Reference from weighted draws."""
    weights = np.exp(log_weights - log_weights.max())
    ess = weights.sum() ** 2 / (weights**2).sum()
    log_evidence = float(log_weights.max() + np.log(weights.mean()))
    w = weights / weights.sum()
    mean = w @ points
    variance = w @ (points - mean) ** 2
    sd = np.sqrt(variance)
    modes = label(points)[:, None] == np.arange(label(points).max() + 1)
    shares = w @ modes

    def error_of(centred: np.ndarray) -> np.ndarray:
        return np.sqrt(np.square(w) @ np.square(centred))

    return Reference(
        log_evidence,
        float(np.sqrt(max(1.0 / ess - 1.0 / len(w), 0.0))),
        mean,
        error_of(points - mean),
        sd,
        error_of((points - mean) ** 2 - variance) / (2.0 * sd),
        shares,
        error_of(modes - shares),
        float(ess),
        len(w),
    )
