"""Each event predicted from the others: the population without it, and the scores of its prediction."""

import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..population.hierarchical_posterior import HierarchicalPosterior
from ..population.hierarchy import Hierarchy
from .new_event import predict_new_event
from .prediction import Prediction
from .quantities import Quantity
from .scores import HistoryScores, QuantityScores, share_within

_WALKERS, _STEPS = 500, 4  # of a new run; means of the hyper-parameters have errors of 0.05 standard deviations


class HeldOutScore(NamedTuple):
    """How well an event is predicted from the other ones."""

    scores: HistoryScores | QuantityScores  # against the event's measurements
    prediction: Prediction

    def __str__(self) -> str:
        return str(self.scores)


class HeldOutScores(dict[str, HeldOutScore]):
    """Scores by event; ``print`` shows the table of each, and how many numbers are within their intervals."""

    def __str__(self) -> str:
        lines = [f"{name}\n{each}" for name, each in self.items()]
        of_numbers = [each.scores for each in self.values() if isinstance(each.scores, QuantityScores)]
        for k, name in enumerate(of_numbers[0].names if of_numbers else ()):
            pit = [each.pit[k] for each in of_numbers]
            shares = "; ".join(f"within {p:.0%}, {share_within(pit, p)}" for p in (0.9, 0.5))
            lines.append(f"{name}: {shares} (intervals of 95 % for the share in further events)")
        return "\n".join(lines)

    __repr__ = __str__


class LeftOutTests(dict[str, Hierarchy]):
    """The population without each test, by its name; `covariates` belong to the test that is left out."""

    covariates: Mapping[str, Mapping[str, float]] = MappingProxyType({})

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
            given["covariates"] = self.covariates.get(name)
            prediction = predict_new_event(each, posteriors, None, **given, **options)
            scores = prediction.score(posteriors[name].likelihood.measurements)
            found[name] = HeldOutScore(scores, prediction)
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
        A dict of str to `Hierarchy`. Its method ``scores(posteriors, quantity=...)`` predicts each test from the others
        and scores it.

    Raises
    ------
    ValueError
        For a hierarchy of a single test.

    Examples
    --------
    >>> left_out = leave_one_out(hierarchy, seed=1)
    >>> print(left_out.scores(posteriors, quantity=peak("displacement")))
    north
    quantity      unit  measured  median  90% interval ...
    displacement    cm ...
    middle
    ...
    """
    if len(tests := hierarchy.posterior.tests) < 2:
        raise ValueError(f"leave_one_out needs two tests or more; got {', '.join(map(repr, tests))}")
    rng, found = np.random.default_rng(seed), LeftOutTests()
    found.covariates = {name: each.covariates for name, each in tests.items()}
    for name in tests:
        rest = hierarchy.posterior.without(name)
        samples = _sample(rest, int(rng.integers(2**31)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what limits the tests was said of all of them; checks have the rest
            found[name] = Hierarchy(rest, samples, seed)
    return found


def _sample(posterior: HierarchicalPosterior, seed: int) -> np.ndarray:
    """Samples (n, ndim) of a posterior of hyper-parameters."""
    from samplers import SMCSampler

    run = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed)
    run.run_mcmc(None, _STEPS)
    return run.get_chain(flat=True)
