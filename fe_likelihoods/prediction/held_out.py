"""Scores of predicted events: each calibrated event predicted from the others, and compared with its measurements."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..events.leave_one_out import LeftOut
from ..events.ratios import EventRatios
from ..likelihood.posterior import Posterior
from ..text_tables import NamedResults, number
from ..units import from_si
from .new_event import predict_new_event
from .prediction import Prediction
from .quantities import Quantity
from .score_tables import HistoryScores, QuantityScores

__all__ = ["HeldOutScore", "score_left_out"]


class HeldOutScore(NamedTuple):
    """How well an event is predicted from the other ones.

    Attributes
    ----------
    scores : HistoryScores or QuantityScores
        Scores of the prediction against the event's measurements.
    log_density : float
        Log predictive density of all data in the event, see `LeftOut`; NaN without the event's evidence.
    prediction : Prediction
        The prediction; its number of samples is the number of simulations.
    """

    scores: HistoryScores | QuantityScores
    log_density: float
    prediction: Prediction

    @property
    def cells(self) -> dict[str, str]:
        """The scores as texts by headings, for `score_left_out`: per number, or per channel for histories."""
        scores, found = self.scores, {}
        if isinstance(scores, QuantityScores):
            for k, (name, unit) in enumerate(zip(scores.names, scores.units, strict=True)):
                ends = scores.lower[k], scores.upper[k]
                shown = [each if unit == "SI" else from_si(each, unit) for each in (scores.measured[k], *ends)]
                measured, lower, upper = map(number, shown)
                found |= {f"{name} [{unit}]": measured, f"{scores.level:.0%} interval of {name}": f"{lower} to {upper}"}
                found[f"PIT of {name}"] = number(scores.pit[k], 2)
        else:
            for k, channel in enumerate(scores.channels):
                found |= {f"RRMSE of {channel.name}": f"{scores.rrmse[k]:.1%}"}
                found[f"interval score of {channel.name} [{channel.unit}]"] = number(
                    from_si(scores.interval_score[k], channel.unit)
                )
                found[f"strong part of {channel.name} in band"] = f"{scores.coverage_strong[k]:.1%}"
        return found | {"log density": number(self.log_density, 5)}

    def __str__(self) -> str:
        return f"{self.scores}\nlog density of the data of the event: {number(self.log_density, 5)}"


def score_left_out(
    left_out: Mapping[str, LeftOut],
    posteriors: Mapping[str, Posterior],
    *,
    quantity: Quantity = None,
    ratios: Mapping[str, ArrayLike] | None = None,
    noise: bool = False,
    n: int = 500,
    seed: int = 0,
    **options: Any,
) -> NamedResults:
    """Predict each event from the others, under its own excitation, and score it with its measurements.

    Parameters
    ----------
    left_out : mapping of str to LeftOut
        Result of `leave_one_out`, or some of it.
    posteriors : mapping of str to Posterior
        The posterior for each of these events, with its model and its measurements.
    quantity : optional
        As for `propagate`: numbers such as ``peak(channel)``, or histories (default).
    ratios : mapping of str to array_like, optional
        The `event_ratio` of each event, by name; each prediction is corrected with the ratios of the other events, two
        or more.
    noise, n, options
        As for `predict_new_event`; `n` simulations for each event.
    seed : int
        Seed of the draws; each event has draws of its own.

    Returns
    -------
    dict of str to HeldOutScore
        ``print`` gives a table with a row per event.

    Raises
    ------
    ValueError
        If a posterior or a ratio is missing, and as `predict_new_event` and `Prediction.score`.
    """
    for what, given in (("posteriors", posteriors), ("ratios", left_out if ratios is None else ratios)):
        if missing := [name for name in left_out if name not in given]:
            raise ValueError(f"score_left_out: {what} of {', '.join(map(repr, missing))} are missing")
    seeds = np.random.SeedSequence(seed).spawn(len(left_out))
    found = NamedResults()
    for (name, each), own_seed in zip(left_out.items(), seeds, strict=True):
        others = None
        if ratios is not None:
            others = EventRatios([ratios[other] for other in each.hierarchy.posterior.tests if other in ratios])
        prediction = predict_new_event(
            each.hierarchy,
            posteriors[name],
            None,
            quantity=quantity,
            ratios=others,
            noise=noise,
            n=n,
            seed=int(own_seed.generate_state(1)[0]),
            **options,
        )
        scores = prediction.score(posteriors[name].likelihood.measurements)
        found[name] = HeldOutScore(scores, each.log_density, prediction)
    return found
