"""Each event predicted from the others: the population without it, and the scores of its prediction."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..events.hierarchy_result import Hierarchy
from ..events.leave_one_out import without_each
from ..text_tables import NamedResults, number
from ..units import from_si
from .new_event import predict_new_event
from .prediction import Prediction
from .quantities import Quantity
from .scores import HistoryScores, QuantityScores, share_within

__all__ = ["HeldOutScore", "HeldOutScores", "LeftOutTests", "leave_one_out"]


class HeldOutScore(NamedTuple):
    """How well an event is predicted from the other ones."""

    scores: HistoryScores | QuantityScores  # against the event's measurements
    log_density: float  # predictive, of all its data, see `LeftOut`; NaN without its evidence
    prediction: Prediction

    @property
    def cells(self) -> dict[str, str]:
        """The scores as texts by headings: per number, or per channel for histories."""
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
                found[f"{channel.name} in band"] = f"{scores.coverage[k]:.1%}"
        return found | {"log density": number(self.log_density, 5)}

    def __str__(self) -> str:
        return f"{self.scores}\nlog density of the data of the event: {number(self.log_density, 5)}"


class HeldOutScores(NamedResults):
    """Scores by event; ``print`` gives a row per event, and how many numbers are within their intervals."""

    def __str__(self) -> str:
        lines = [super().__str__()]
        of_numbers = [each.scores for each in self.values() if isinstance(each.scores, QuantityScores)]
        for k, name in enumerate(of_numbers[0].names if of_numbers else ()):
            pit = [each.pit[k] for each in of_numbers]
            shares = "; ".join(f"within {level:.0%}, {share_within(pit, level)}" for level in (0.9, 0.5))
            lines.append(f"{name}: {shares} (intervals of 95 % for the share in further events)")
        return "\n".join(lines)

    __repr__ = __str__


class LeftOutTests(NamedResults):
    """The population without each test, `LeftOut` by name; ``print`` gives a table."""

    def scores(
        self,
        posteriors: Mapping[str, Any],
        *,
        quantity: Quantity = None,
        seed: int = 0,
        **options: Any,
    ) -> HeldOutScores:
        """Predict each event from the others, under its own excitation, and score it with its measurements.

        Parameters
        ----------
        posteriors : mapping of str to Posterior
            The posterior of every event of the hierarchy, with its model and its measurements.
        quantity : optional
            As for `predict_new_event`: numbers such as ``peak(channel)``, or histories (default).
        seed : int
            Seed of the draws; each event has draws of its own.
        **options
            Further options of `predict_new_event`, such as ``noise=`` and ``n=``.

        Returns
        -------
        HeldOutScores
            A dict of str to HeldOutScore.

        Raises
        ------
        ValueError
            If a posterior is missing, and as `predict_new_event` and `Prediction.score`.
        """
        if missing := [name for name in self if name not in posteriors]:
            raise ValueError(f"scores: posteriors of {', '.join(map(repr, missing))} are missing")
        found = HeldOutScores()
        for (name, each), own_seed in zip(self.items(), np.random.SeedSequence(seed).spawn(len(self)), strict=True):
            given = {"model": posteriors[name], "quantity": quantity, "seed": int(own_seed.generate_state(1)[0])}
            prediction = predict_new_event(each.hierarchy, posteriors, None, **given, **options)
            scores = prediction.score(posteriors[name].likelihood.measurements)
            found[name] = HeldOutScore(scores, each.log_density, prediction)
        return found


def leave_one_out(hierarchy: Hierarchy, *, seed: int = 0) -> LeftOutTests:
    """Leave each test out of a hierarchical model in turn. No simulation is run.

    The population without the test is sampled anew, by `samplers.SMCSampler` with 500 walkers and four steps.

    Parameters
    ----------
    hierarchy : Hierarchy
        Population of two tests or more.
    seed : int
        Seed of the sampler.

    Returns
    -------
    LeftOutTests
        A dict of str to `LeftOut`. Its method ``scores(posteriors, quantity=...)`` predicts each test from the others
        and scores it.

    Raises
    ------
    ValueError
        For a hierarchy of a single test, with fewer different hyper-samples than twice the number of parameters, or
        with hyper-samples that are impossible under the data of a test.

    Warns
    -----
    UserWarning
        If a predictive density is not known.

    Examples
    --------
    >>> left_out = leave_one_out(hierarchy, seed=1)
    >>> print(left_out.scores(posteriors, quantity=peak("displacement")))
    event   displacement [cm]  90% interval of displacement  PIT of displacement  log density
    north ...
    middle ...
    south ...
    """
    return LeftOutTests(without_each(hierarchy, seed))
