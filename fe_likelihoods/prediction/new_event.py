r"""Prediction of an event that the structure has not seen yet, from several events that it has.

Parameters of a structure differ from event to event: frequency and damping change with the amplitude, the season and
the years. The posterior of one event, or the common posterior of all, is narrower than these differences. The
prediction of a new event therefore draws its parameters from the population of the events (`Hierarchy.new_test`), and
corrects quantities such as peaks by the ratio of measured to fitted values in the calibration events:

.. math:: g_\mathrm{new} = r_\mathrm{new}\, g(\theta_\mathrm{new}), \qquad
   \ln r_\mathrm{new} \sim t_\nu\!\left(m,\ s \sqrt{1 + 1 / K}\right).

Equations are on the page ``docs/theory/prediction.rst``.
"""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..probability.hierarchy import Hierarchy
from ..signals.records import Record
from .inputs import part_of, read_source
from .prediction import Prediction
from .propagation import propagate
from .quantities import ChannelQuantity, Quantity, measured_quantity
from .streaming import quantiles_with_errors

__all__ = ["EventRatios", "event_ratio", "predict_new_event"]

_LARGEST_IMPOSSIBLE = 0.01  # share of draws with an impossible noise without a warning


@dataclass(frozen=True, eq=False)
class EventRatios:
    r"""Ratios of measured to fitted values in several events, and the distribution of the ratio in a new event.

    Parameters
    ----------
    values : (n_events,) or (n_events, n_quantities) array_like
        Positive ratios, one row per calibration event, see `event_ratio`.
    prior_sd : float
        Guess of the standard deviation of the logarithm of the ratio between events, made before these events.
    prior_events : float
        Number of events that this guess is worth; 0 for none. Where there is one event only, the ratio of a new one
        depends on the guess, which must then be given.

    Raises
    ------
    ValueError
        If a ratio is not positive, the guess is not, or neither two events nor a guess are given.

    Notes
    -----
    The logarithms of the ratios are normal with unknown mean and variance. With a flat prior of the mean and a scaled
    inverse chi-squared prior of the variance (`prior_events` degrees of freedom, scale `prior_sd`), the logarithm of
    the ratio of a new event has Student's t distribution (Gelman et al. 2013, section 3.2-3.3) with

    .. math:: \nu = \nu_0 + K - 1, \qquad s^2 = \frac{\nu_0 s_0^2 + \sum_k (\ln r_k - m)^2}{\nu}

    degrees of freedom, the mean m of the K logarithms as its center and the scale :math:`s \sqrt{1 + 1 / K}`.

    References
    ----------
    A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd
    edition, Chapman and Hall/CRC.

    Examples
    --------
    >>> EventRatios([0.95, 1.08, 0.99, 1.04]).factor(0.9)  # ends of the 90 % interval: median times or divided by this
    """

    values: ArrayLike
    prior_sd: float = 0.1
    prior_events: float = 0.0

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float)
        if values.ndim not in (1, 2) or not values.size or not ((values > 0.0) & (values < np.inf)).all():
            raise ValueError(f"EventRatios: expected positive ratios, one row per event; got {self.values!r}")
        if not (0.0 < self.prior_sd < np.inf and 0.0 <= self.prior_events < np.inf):
            raise ValueError(
                "EventRatios: prior_sd must be positive and prior_events zero or more; got "
                f"{self.prior_sd!r} and {self.prior_events!r}"
            )
        if len(values) < 2 and not self.prior_events:
            raise ValueError(
                "EventRatios: one event does not show how ratios differ between events; give a guess of their standard "
                "deviation, such as prior_sd=0.15, and the number of events that it is worth, prior_events=3"
            )
        object.__setattr__(self, "values", values)

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of Student's t distribution."""
        return self.prior_events + len(self.values) - 1.0

    @property
    def median(self) -> np.ndarray:
        """Median of the ratio of a new event, of the shape of one row: the geometric mean of the ratios."""
        return np.exp(np.log(self.values).mean(axis=0))

    @property
    def scale(self) -> np.ndarray:
        """Scale of the t distribution of the logarithm of the ratio of a new event."""
        logs = np.log(self.values)
        squares = np.square(logs - logs.mean(axis=0)).sum(axis=0) + self.prior_events * self.prior_sd**2
        return np.sqrt(squares / self.degrees_of_freedom * (1.0 + 1.0 / len(logs)))

    def factor(self, level: float = 0.9) -> np.ndarray:
        """Ratio of the upper end of the central interval of a level to the median; the lower end is as far below."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"EventRatios.factor: level must be between 0 and 1; got {level!r}")
        from scipy.stats import t

        return np.exp(t.ppf(0.5 + 0.5 * level, self.degrees_of_freedom) * self.scale)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw ratios of a new event, shape (n,) or (n, n_quantities); independent between quantities."""
        return self.median * np.exp(self.scale * rng.standard_t(self.degrees_of_freedom, (n, *self.values.shape[1:])))


def event_ratio(
    posterior: Any, samples: Any, quantity: ChannelQuantity | list[ChannelQuantity], part: str | None = None
) -> np.ndarray:
    """Ratio of the measured to the fitted value of a quantity in the event that a posterior was calibrated with.

    Parameters
    ----------
    posterior : Posterior, FELikelihood or JointLikelihood
        The likelihood with the measurements of the event.
    samples : (n, ndim) array_like, or named values of shape (n,)
        Posterior samples of this event.
    quantity : ChannelQuantity or list of ChannelQuantity
        Such as ``peak("deck")``.
    part : str, optional
        As for `propagate`.

    Returns
    -------
    ndarray, shape () or (n_quantities,)
        Measured value divided by the median of the response of the samples, without noise: the error of the model in
        this quantity where the model fits best.

    Raises
    ------
    ValueError
        As `propagate`, if there are no measurements or samples of the channel are missing, and if a value is not
        positive.
    """
    likelihood, rows = part_of(posterior, samples, part, False)
    source = read_source(likelihood)
    if source.likelihood is None:
        raise ValueError(f"event_ratio needs a posterior or a likelihood with measurements; got {posterior!r}")
    measured = measured_quantity(quantity, source.likelihood.measurements)
    fitted = propagate(likelihood, rows, quantity=quantity, quantiles=(0.5,), progress=False).quantile(0.5)
    if not ((measured > 0.0) & (fitted > 0.0)).all():
        raise ValueError(f"event_ratio needs positive values; measured {measured}, fitted {fitted}")
    return measured / fitted


def predict_new_event(
    hierarchy: Hierarchy,
    posterior_or_model: Any,
    record: Record | Any,
    *,
    quantity: Quantity = None,
    ratios: EventRatios | None = None,
    noise: bool = False,
    n: int = 500,
    seed: int | None = None,
    **options: Any,
) -> Prediction:
    """Predict an event that is not among those of a hierarchical model.

    Parameters
    ----------
    hierarchy : Hierarchy
        The population of the parameters of the calibration events. Its varying and common parameters must contain those
        of the model, unless their priors are the same in all events.
    posterior_or_model : Posterior, FELikelihood or Model
        The model to predict with, such as the posterior of one of the events; with a noise for ``noise=True``.
    record : Record, or sequence of Record
        Excitation of the new event.
    quantity : optional
        As for `propagate`. Default: the histories of all channels.
    ratios : EventRatios, optional
        Ratios of measured to fitted values of the quantity in the calibration events, for numbers such as
        ``peak(name)`` or several of them. The prediction is that of the measured value.
    noise : bool
        Whether histories are predicted with noise. The parameters of the noise must be varying, common, or have the
        same prior in all events. Shares of the response (`RelativeNoise`) transfer between events, levels in SI units
        do not.
    n : int
        Number of draws, each one simulation. Draws with an impossible noise, such as a share of 1 or more, are left
        out.
    seed : int, optional
        Seed of the draws of parameters, ratios and noise.
    **options
        Further options of `propagate`, such as ``quantiles=`` and ``from_state=``.

    Returns
    -------
    Prediction
        Its spread contains that between events.

    Raises
    ------
    ValueError
        As `Hierarchy.new_test` and `propagate`; if ratios are given for histories, together with noise (they contain
        the errors already), or for another number of quantities.

    Warns
    -----
    UserWarning
        As `Hierarchy.new_test`, and if more than 1 % of the draws have an impossible noise.

    Examples
    --------
    >>> ratios = EventRatios([event_ratio(posteriors[name], chains[name], peak("deck")) for name in posteriors])
    >>> predict_new_event(hierarchy, posterior, record, quantity=peak("deck"), ratios=ratios)
    """
    source = read_source(posterior_or_model)
    names = list(source.model.parameter_names)
    if noise:
        if source.noise is None:
            raise ValueError("predict_new_event: noise=True needs a posterior; got a model")
        names += source.noise.parameter_names
    if ratios is not None:
        several = (quantity,) if isinstance(quantity, ChannelQuantity) else quantity
        numbers = callable(quantity) or (
            isinstance(several, list | tuple) and all(isinstance(each, ChannelQuantity) for each in several)
        )
        if not numbers or noise:
            raise ValueError(
                "predict_new_event: ratios are for numbers such as peak(channel) and contain the error of the "
                "measurements already: give quantity=peak(channel), and noise=False"
            )
    parameters, drawn, errors = np.random.SeedSequence(seed).spawn(3)
    draws = hierarchy.new_test(n, names, np.random.default_rng(parameters))
    if noise:
        draws = _possible(draws, source.noise)
    settings = {"progress": False} | options
    prediction = propagate(
        posterior_or_model,
        draws,
        record=record,
        quantity=quantity,
        noise=noise,
        seed=int(errors.generate_state(1)[0]),
        **settings,
    )
    return prediction if ratios is None else _corrected(prediction, ratios, np.random.default_rng(drawn))


def _possible(draws: dict[str, np.ndarray], noise: Any) -> dict[str, np.ndarray]:
    """Leave out draws whose noise is impossible: a population has no bounds, shares of the response have."""
    if not hasattr(noise, "standard_deviations"):
        return draws
    deviations = noise.standard_deviations(np.stack([draws[name] for name in noise.parameter_names], axis=1))
    possible = (deviations > 0.0).all(axis=1)
    if possible.mean() < 1.0 - _LARGEST_IMPOSSIBLE:
        warnings.warn(
            f"predict_new_event: {1.0 - possible.mean():.0%} of the draws have an impossible noise, such as a share of "
            "the response of 1 or more, and are left out: if this is not rare, use a noise with levels in SI units, or "
            "a narrower prior of the spread between events",
            stacklevel=3,
        )
    return {name: values[possible] for name, values in draws.items()}


def _corrected(prediction: Prediction, ratios: EventRatios, rng: np.random.Generator) -> Prediction:
    """The prediction times draws of the ratio of a new event."""
    if prediction.values is None or ratios.values.shape[1:] != prediction.mean.shape:
        raise ValueError(
            f"predict_new_event: expected ratios (n_events, ...) of a quantity of shape {prediction.mean.shape}; got "
            f"{ratios.values.shape}"
        )
    values = prediction.values * ratios.draw(len(prediction.values), rng)
    effective = prediction.effective_sample_size
    quantiles, errors = quantiles_with_errors(
        values.reshape(len(values), -1), np.ones(len(values), dtype=int), prediction.probabilities, effective
    )
    shape = (len(prediction.probabilities), *prediction.mean.shape)
    return replace(
        prediction,
        mean=values.mean(axis=0),
        variance=values.var(axis=0),
        standard_error=values.std(axis=0) / np.sqrt(effective),
        quantiles=quantiles.reshape(shape),
        quantile_error=errors.reshape(shape),
        values=values,
        noise=True,
    )
