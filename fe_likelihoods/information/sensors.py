r"""Which sensor would tell most: expected information of sensors before they measure.

With the derivatives J of the responses by standard normal coordinates of the prior (`Prior.from_normal`), the weights W
of the measurements and the precision A of what is known already (the identity for a prior), the information of a set of
sensors, and the variance of a target with the gradient g that they leave, are

.. math::

   I = \tfrac{1}{2} \log \frac{\det(A + J^T W J)}{\det A}, \qquad v = g^T (A + J^T W J)^{-1} g,

averaged over draws of the parameters. Both are exact for a linear model with Gaussian noise. For other models this is
the expected information gain of a Laplace approximation at the true parameters (Q. Long, M. Scavino, R. Tempone, S.
Wang, 2013, Fast estimation of expected information gains for Bayesian experimental designs based on Laplace
approximations, Computer Methods in Applied Mechanics and Engineering 259, 24-39, doi:10.1016/j.cma.2013.02.017). For
structures see C. Papadimitriou (2004), Optimal sensor placement methodology for parametric identification of structural
systems, Journal of Sound and Vibration 278, 923-947, doi:10.1016/j.jsv.2003.10.063.

The linearisation leaves out several modes, curved ridges, and what a measurement tells where derivatives vanish. The
noise is white, known, and independent between channels; errors of the model are not part of it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.posterior import Posterior
from ..prediction.quantities import ChannelQuantity, evaluator
from ..priors.distributions import Distribution
from ..priors.points import as_rows
from ..priors.priors import Prior
from ..signals.channels import Channel
from ..simulation.model import Model, derivatives_batch, has_jacobian, most_responses, simulate_batch
from ..text_tables import number, text_table
from .identifiability import FEWEST, MAP_STEP

SHARE = 0.05  # of the channel's RMS, the default noise
STEP = 0.1  # of differences, in standard deviations


class Slopes(NamedTuple):
    """Derivatives of responses by standard normal coordinates at m points; NaN where a simulation failed."""

    products: np.ndarray  # (m, n_channels, d, d) sums over samples of products of two derivatives [SI²]
    mean_squares: np.ndarray  # (m, n_channels) of the responses [SI²]
    gradients: np.ndarray  # (m, d) of the target [SI]; zero without one


class SensorRanking(NamedTuple):
    """Expected information of sensors, averaged over draws; ``str`` is a table, `plot_ranking` a figure.

    Attributes
    ----------
    chosen : tuple of str
        The k sensors of the greedy choice, the best first.
    alone : (n,) float
        Expected information of each of the n `candidates`, without the other candidates [nat].
    information : (k,) float
        Information of the first sensors together [nat]; its steps are `gains`.
    lead : (k,) float
        What the next best candidate would have been worse by: information [nat], or share of the target's variance; NaN
        where no candidate was left. A lead of less than two errors does not decide.
    left : dict of str to (k,) float
        Share of each parameter's standard deviation that is left with the first sensors [-], as a root mean square.
    target_left : (k,) float
        Share of the target's variance that is left with the first sensors [-]; NaN without a target.
    errors : dict of str to ndarray
        Standard errors over the draws of "alone", "gains", "information", "lead" and "target_left".
    precisions : dict of str to (d, d) float
        What each candidate tells of the standard normal coordinates of the prior: J^T W J, averaged over the draws.
        Precisions of several sensors add.
    counts : dict of str to int
        "draws" that were used, "failed" draws that were left out because a simulation failed, and "simulations".
    """

    chosen: tuple[str, ...]
    alone: np.ndarray
    information: np.ndarray
    lead: np.ndarray
    left: dict[str, np.ndarray]
    target_left: np.ndarray
    errors: dict[str, np.ndarray]
    precisions: dict[str, np.ndarray]
    counts: dict[str, int]

    @property
    def candidates(self) -> tuple[str, ...]:
        """Names of all candidates."""
        return tuple(self.precisions)

    @property
    def gains(self) -> np.ndarray:
        """Information (k,) that each chosen sensor adds to those before it [nat]."""
        return np.diff(self.information, prepend=0.0)

    def __str__(self) -> str:
        with_target = bool(np.isfinite(self.target_left).all())
        scale = 100.0 if with_target else 1.0  # of a lead
        columns = {"gain [nat]": ("gains", 1.0), "together [nat]": ("information", 1.0)}
        columns |= {"variance left [%]": ("target_left", 100.0)} if with_target else {}
        columns |= {"lead [%]" if with_target else "lead [nat]": ("lead", scale)}
        rows = [["sensor", "alone [nat]", *columns]]
        for k, name in enumerate(self.chosen):
            i = self.candidates.index(name)
            row = [name, _with_error(self.alone[i], self.errors["alone"][i])]
            for what, factor in columns.values():
                row.append(_with_error(factor * getattr(self, what)[k], factor * self.errors[what][k]))
            rows.append(row)
        left = ", ".join(f"{name} {100.0 * shares[-1]:.2g} %" for name, shares in self.left.items())
        failed, counts = "", self.counts
        if counts["failed"]:
            failed = f"; {counts['failed']} more were left out, because their simulation failed"
        lines = [
            f"{len(self.chosen)} of {len(self.candidates)} sensors, from derivatives at {counts['draws']} draws "
            f"({counts['simulations']} simulations{failed})",
            text_table(rows),
            f"Standard deviations left with all of them: {left}",
        ]
        return "\n".join(lines)

    __repr__ = __str__


def _with_error(value: float, error: float) -> str:
    return number(value) if np.isnan(error) else f"{number(value)} ± {number(error, 2)}"


def information_of(precision: np.ndarray, products: np.ndarray) -> np.ndarray:
    """Information (...) [nat] that measurements with weighted products J^T W J (..., d, d) add to a precision (..., d,
    d).
    """
    return 0.5 * (np.linalg.slogdet(precision + products)[1] - np.linalg.slogdet(precision)[1])


def variance_of(precision: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Variance (...) of a target with gradients (..., d) under a precision (..., d, d)."""
    return np.einsum("...i,...i->...", gradients, np.linalg.solve(precision, gradients[..., None])[..., 0])


def slopes_at(
    model: Model,
    prior: Prior,
    coords: np.ndarray,
    steps: np.ndarray,
    target: Callable[[np.ndarray], Any] | None = None,
    pool: Any = None,
) -> Slopes:
    """Derivatives of responses at standard normal coordinates (m, d), from d + 1 simulations for each of them.

    They are forward differences by `steps` (m, d); a model with ``jacobian`` takes one simulation and one call of it
    for each point. `target` maps a response (n_channels, n_steps) [SI] to a number. Raises ValueError if it is not one
    number, or ``jacobian`` fails (`fe_likelihoods.simulation.model.derivatives_batch`).
    """
    m, d = coords.shape
    n_channels, n_steps = len(model.channels), model.n_steps
    products, squares = np.full((m, n_channels, d, d), np.nan), np.full((m, n_channels), np.nan)
    gradients = np.full((m, d), np.nan)
    unit = np.vstack([np.zeros(d), np.eye(d)])
    points = prior.from_normal((coords[:, None] + unit * steps[:, None]).reshape(-1, d)).reshape(m, d + 1, d)
    size = max(1, most_responses(model) // (d + 1))
    for start in range(0, m, size):
        part = slice(start, start + size)
        if has_jacobian(model):
            responses = _linearised(model, prior, coords[part], steps[part], pool)
        else:
            batch = simulate_batch(model, points[part].reshape(-1, d), pool)
            responses = batch.response.reshape(-1, d + 1, n_channels, n_steps)
        for k, response in enumerate(responses, start):
            if not np.isfinite(response).all():
                continue
            by = (response[1:] - response[0]) / steps[k][:, None, None]
            products[k] = np.einsum("ict,jct->cij", by, by)
            squares[k] = np.square(response[0]).mean(axis=1)
            values = np.zeros(d + 1) if target is None else np.array([_number(target(each)) for each in response])
            gradients[k] = (values[1:] - values[0]) / steps[k]
    return Slopes(products, squares, gradients)


def _linearised(model: Model, prior: Prior, coords: np.ndarray, steps: np.ndarray, pool: Any) -> np.ndarray:
    """Responses (m, d + 1, n_channels, n_steps) at points and one step away, by the model's own derivatives."""
    thetas, unit = prior.from_normal(coords), MAP_STEP * np.eye(coords.shape[1])
    ahead, behind = (
        prior.from_normal((coords[:, None] + sign * unit).reshape(-1, len(unit))).reshape(-1, *unit.shape)
        for sign in (1.0, -1.0)
    )
    responses = simulate_batch(model, thetas, pool).response
    good = np.isfinite(responses).all(axis=(1, 2))
    changes = np.full((len(coords), len(unit), *responses.shape[1:]), np.nan)
    by_theta = derivatives_batch(model, thetas[good], pool)
    changes[good] = np.einsum("nzp,npct->nzct", (ahead - behind)[good] / (2.0 * MAP_STEP), by_theta)
    changes *= steps[:, :, None, None]
    return responses[:, None] + np.concatenate([np.zeros_like(changes[:, :1]), changes], axis=1)


def _number(value: Any) -> float:
    if np.size(value) != 1:
        raise ValueError(
            f'target must be one number of the response, such as peak("top"); got an array of shape {np.shape(value)}'
        )
    return float(np.squeeze(value))


def rank_sensors(
    model: Model,
    prior: Posterior | Prior | Mapping[str, Distribution],
    candidates: Sequence[str] | None = None,
    *,
    target: ChannelQuantity | Callable[[np.ndarray], float] | None = None,
    target_model: Model | None = None,
    samples: Any = None,
    installed: Sequence[str] = (),
    n_sensors: int | None = None,
    noise: float | Mapping[str, float] = SHARE,
    effective_samples: float | Mapping[str, float] | None = None,
    draws: int = 20,
    step: float = STEP,
    seed: int = 1,
    pool: Any = None,
) -> SensorRanking:
    """Rank sensors by what they are expected to tell, before they measure.

    Sensors are chosen one after the other: each time the candidate that adds most information to those chosen before,
    or, with a target, leaves the smallest expected variance of the target. Without a target, the information of the
    chosen set is at least 63 % of the best set's information (G. L. Nemhauser, L. A. Wolsey, M. L. Fisher (1978),
    Mathematical Programming 14, 265-294, doi:10.1007/BF01588971).

    Parameters
    ----------
    model : Model
        One simulation gives the responses of all candidates, such as an `RCColumn` with ``outputs=``.
    prior : Posterior, Prior, or mapping of parameter names to distributions
        With at least the parameters of the model; others, such as the noise, are left out.
    candidates : sequence of str, optional
        Names of channels of the model. Default: all that are not installed.
    target : ChannelQuantity or callable, optional
        The number that the measurements shall tell: ``peak("displacement")``, or a function of the response
        (n_channels, n_steps) [SI] of `target_model`.
    target_model : Model, optional
        A model with the same parameters, such as ``model.with_record(design)``. Default: the model.
    samples : (n, d) or (n, ndim) array_like, or named values of shape (n,), optional
        Samples of what is known already: structural parameters, or all parameters of the prior. Derivatives are taken
        at some of them, and what is known is their covariance. Default: the prior.
    installed : sequence of str
        Channels of the model that measure in any case.
    n_sensors : int, optional
        Number of sensors to choose. Default: six, or all candidates if there are fewer.
    noise : float or mapping of str to float
        Standard deviation of the noise: a share of the channel's RMS over all draws, or values [SI] by the name of the
        channel or the part of the name before the ``@``. Default: 5 % of the RMS, which makes all sensors equally
        precise.
    effective_samples : float or mapping of str to float, optional
        Number of independent samples that a channel is worth, if errors are correlated in time
        (`residual_checks(...).n_effective`), for all channels or by name as for `noise`. Default: all samples.
    draws : int
        Number m of draws. It takes m (d + 1) simulations of d parameters, and as many of a `target_model`; of a model
        with a method ``jacobian``, m simulations and m calls of it, which count as simulations.
    step : float
        Step of the differences, in standard deviations of what is known; for a model with ``jacobian``, of the target's
        differences.
    seed : int
        Seed of the draws.
    pool : object with ``map(function, items)``, optional
        Runs the simulations.

    Returns
    -------
    SensorRanking

    Raises
    ------
    ValueError
        If a name is unknown, a noise level or a number is missing or not positive, the target is not one number, or
        simulations of all draws but one fail.

    Notes
    -----
    What the linearisation leaves out, and which noise is assumed, is in `fe_likelihoods.information.sensors`.

    Examples
    --------
    >>> building = LinearStructure(frame, record)
    >>> storeys = {name: LogNormal(1.0, 0.2) for name in building.parameter_names}
    >>> print(rank_sensors(building, storeys, draws=20))  # doctest: +SAMPLED
    2 of 2 sensors, from derivatives at 20 draws (100 simulations)
    sensor    alone [nat]     gain [nat]  together [nat]     lead [nat]
    roof     2.81 ± 0.068   2.81 ± 0.068    2.81 ± 0.068  0.502 ± 0.023
    floor 1  2.31 ± 0.071  0.948 ± 0.024    3.76 ± 0.091              -
    Standard deviations left with all of them: stiffness_1 24 %, stiffness_2 59 %, damping_1 22 %, damping_2 99 %
    """
    given = getattr(prior, "prior", prior)
    given = given if isinstance(given, Prior) else Prior(given)
    known = given.subset(model.parameter_names)
    names = [channel.name for channel in model.channels]
    if unknown := [name for name in (*(candidates or ()), *installed) if name not in names]:
        raise ValueError(f"unknown channels {', '.join(unknown)}; the channels of the model are {', '.join(names)}")
    candidates = [name for name in (names if candidates is None else candidates) if name not in installed]
    if not candidates or len(set(candidates)) < len(candidates):
        raise ValueError(f"candidates must be different channels that are not installed; got {candidates}")
    n_sensors = min(6, len(candidates)) if n_sensors is None else n_sensors
    if not (1 <= n_sensors <= len(candidates) and draws >= 2 and step > 0.0):
        raise ValueError(
            f"n_sensors must be from 1 to {len(candidates)}, draws at least 2, and step positive; got {n_sensors}, "
            f"{draws} and {step}"
        )
    levels = _by_channel(noise, model.channels, "noise")
    counts = model.n_steps if effective_samples is None else effective_samples
    independent = np.minimum(_by_channel(counts, model.channels, "effective_samples") / model.n_steps, 1.0)
    coords, precision = _draw(known, given, samples, draws, seed)
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    steps = step * sd * np.where(coords > 0.0, -1.0, 1.0)  # towards the median, where the prior has its parameters
    function, other = None, model if target_model is None else target_model
    if target is not None:
        if tuple(other.parameter_names) != tuple(model.parameter_names):
            raise ValueError(
                f"target_model must have the parameters of the model, {', '.join(model.parameter_names)}; got "
                f"{', '.join(other.parameter_names)}"
            )
        function = evaluator(target, other.channels, other.dt, other.n_steps).function
        if function is None:
            raise ValueError(f'target must be one number of the response, such as peak("top"); got {target!r}')
    slopes = slopes_at(model, known, coords, steps, function if other is model else None, pool)
    gradients, simulations = slopes.gradients, draws * (2 if has_jacobian(model) else known.dim + 1)
    if function is not None and other is not model:
        gradients = slopes_at(other, known, coords, steps, function, pool).gradients
        simulations += draws * (2 if has_jacobian(other) else known.dim + 1)
    good = np.isfinite(slopes.mean_squares).all(axis=1) & np.isfinite(gradients).all(axis=1)
    if good.sum() < 2:
        raise ValueError(
            f"expected at least two draws whose {known.dim + 1} simulations all succeed; got {good.sum()} of {draws}: "
            "narrow the prior, or see why simulations fail (check_model)"
        )
    rms = np.sqrt(slopes.mean_squares[good].mean(axis=0))
    levels = levels if isinstance(noise, Mapping) else levels * rms  # zero for a share of a channel without response
    weights = independent * np.where(rms > 0.0, 1.0 / np.where(levels > 0.0, levels, np.inf) ** 2, 0.0)
    products = slopes.products[good] * weights[:, None, None]
    start = precision + products[:, [names.index(name) for name in installed]].sum(axis=1)
    places = [names.index(name) for name in candidates]
    counts = {"draws": int(good.sum()), "failed": int(draws - good.sum()), "simulations": simulations}
    ranking, left = _choose(products[:, places], start, gradients[good], n_sensors, target is not None)
    return ranking._replace(
        chosen=tuple(candidates[i] for i in ranking.chosen),
        left=dict(zip(known.names, (left / sd).T, strict=True)),
        precisions=dict(zip(candidates, products[:, places].mean(axis=0), strict=True)),
        counts=counts,
    )


def _draw(known: Prior, given: Prior, samples: Any, draws: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal coordinates (draws, d) of draws, and the precision (d, d) of what is known in them."""
    rng = np.random.default_rng(seed)
    if samples is None:
        return rng.standard_normal((draws, known.dim)), np.eye(known.dim)
    names = given.names if isinstance(samples, Mapping) or np.shape(samples)[-1:] == (given.dim,) else known.names
    if isinstance(samples, Mapping) and set(samples) == set(known.names):
        names = known.names
    rows = as_rows(samples, names)[:, [names.index(name) for name in known.names]]
    fewest = max(FEWEST * known.dim, draws)
    if len(rows) < fewest:
        raise ValueError(
            f"expected at least {fewest} samples, for {known.dim} parameters and {draws} draws; "
            f"got {len(rows)}: give all samples of the run, sampler.get_chain(flat=True)"
        )
    coords = known.to_normal(rows)
    coords = coords[np.isfinite(coords).all(axis=1)]
    covariance = np.atleast_2d(np.cov(coords, rowvar=False))
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise ValueError(
            "expected samples with a positive definite covariance, within the bounds of the prior; got samples that "
            "do not differ: give all samples of the run, sampler.get_chain(flat=True)"
        )
    return coords[rng.choice(len(coords), draws, replace=False)], np.linalg.inv(covariance)


def _by_channel(given: float | Mapping[str, float], channels: Sequence[Channel], what: str) -> np.ndarray:
    """A positive number (n_channels,) for every channel, by its name or the part before the ``@``."""
    names = [channel.name for channel in channels]
    if isinstance(given, Mapping):
        if unknown := set(given) - set(names) - {name.partition("@")[0] for name in names}:
            raise ValueError(f"{what} has the unknown channels {', '.join(unknown)}; known are {', '.join(names)}")
        values = [given.get(name, given.get(name.partition("@")[0], np.nan)) for name in names]
    else:
        values = [given] * len(names)
    values = np.array(values, dtype=float)
    if wrong := [name for name, value in zip(names, values, strict=True) if not value > 0.0]:
        raise ValueError(f"{what} must be a positive number for every channel; give one for {', '.join(wrong)}")
    return values


def _mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over draws (m, ...) and its standard error."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


def _ratio_and_error(values: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratio of the means over draws of values (m, ...) to the mean of `whole` (m,), and its standard error."""
    ratio = values.mean(axis=0) / whole.mean()
    deviations = (values - np.multiply.outer(whole, ratio)) / whole.mean()
    return ratio, deviations.std(axis=0, ddof=1) / np.sqrt(len(values))


def _choose(
    products: np.ndarray, start: np.ndarray, gradients: np.ndarray, n_sensors: int, by_target: bool
) -> tuple[SensorRanking, np.ndarray]:
    """Greedy choice from weighted products (m, n, d, d), a precision (m, d, d) and gradients (m, d) of the target.

    `chosen` of the result are numbers of candidates; standard deviations (k, d) of the coordinates follow it.
    """
    n, before = products.shape[1], variance_of(start, gradients)
    if by_target and not before.mean() > 0.0:
        raise ValueError("expected a target that depends on the parameters; it does not change at any draw")
    precision, rest, chosen, left = start, list(range(n)), [], []
    alone = np.zeros(n), np.zeros(n)
    steps: dict[str, list] = {"gains": [], "information": [], "lead": [], "target_left": []}
    for _ in range(n_sensors):
        added = information_of(precision[:, None], products[:, rest])
        variances = variance_of(precision[:, None] + products[:, rest], gradients[:, None])
        alone = _mean_and_error(added) if not chosen else alone
        value = -variances / before.mean() if by_target else added
        order = np.argsort(-value.mean(axis=0), kind="stable")
        best = int(order[0])
        pair = value[:, best] - value[:, order[1]] if len(order) > 1 else np.full(len(value), np.nan)
        steps["lead"].append(_mean_and_error(pair))
        steps["gains"].append(_mean_and_error(added[:, best]))
        share = _ratio_and_error(variances[:, best], before) if by_target else (np.nan, np.nan)
        steps["target_left"].append(share)
        precision = precision + products[:, rest[best]]
        chosen.append(rest.pop(best))
        steps["information"].append(_mean_and_error(information_of(start, precision - start)))
        left.append(np.sqrt(np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2).mean(axis=0)))
    means, errors = {}, {"alone": alone[1]}
    for name, found in steps.items():
        means[name], errors[name] = np.transpose(found)
    means.pop("gains")
    ranking = SensorRanking(
        chosen=tuple(chosen), alone=alone[0], left={}, errors=errors, precisions={}, counts={}, **means
    )
    return ranking, np.array(left)
