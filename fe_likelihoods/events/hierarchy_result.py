"""Result of a hierarchical model of several tests: the population, and the parameters of a new test.

`Hierarchy` combines a `HierarchicalPosterior` with samples of its hyper-parameters, which any sampler has drawn. It
checks where the stored posteriors do not suffice, and draws the parameters of a further test.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..checks.finding import labelled, warn
from ..checks.transfer import check_new_test
from ..priors.distributions import RandomState, as_generator
from ..priors.points import as_points, complete_repr
from ..text_tables import number, text_table
from .hierarchical_posterior import HierarchicalPosterior
from .reweighting import check_hierarchy

__all__ = ["Hierarchy"]

_MOSTLY_PRIOR = 0.7  # posterior to prior standard deviation of a spread, above which the data say little


class Hierarchy:
    """Parameter population over several tests.

    Parameters
    ----------
    posterior : HierarchicalPosterior
        Posterior density of the hyper-parameters.
    samples : (n, ndim) array_like, or mapping
        Posterior samples of the hyper-parameters, of equal weight (``sampler.get_chain(flat=True)``).
    seed : int
        Seed of the resampling for the errors.

    Attributes
    ----------
    posterior : HierarchicalPosterior
        As given.
    samples : ndarray[n, ndim]
        As given.
    checks : HierarchyChecks
        Effective sample sizes and errors of the stored posteriors; ``print(hierarchy.checks)`` is a table. Every
        finding in it is a warning as well.

    Raises
    ------
    ValueError
        If the samples have another dimension, are fewer than 20, or are impossible under the prior of the
        hyper-parameters.

    Examples
    --------
    >>> new = hierarchy.new_test(500, rng=1)
    >>> new["stiffness"].shape
    (500,)
    >>> print(hierarchy)
    Population of 3 tests, 200 samples: north, middle, south
    hyper-parameter ...
    median_stiffness ...
    sd_log_stiffness ...
    damping ...
    The tests differ in stiffness by ...
    """

    def __init__(self, posterior: HierarchicalPosterior, samples: Any, seed: int = 0) -> None:
        points = as_points(samples, posterior.parameter_names)
        if points.ndim != 2 or len(points) < 20:
            raise ValueError(
                f"Hierarchy expects 20 samples of the hyper-parameters or more, (n, {posterior.ndim}); got shape "
                f"{points.shape}"
            )
        if not np.isfinite(posterior.log_prior(points)).all():
            raise ValueError(
                "some samples of the hyper-parameters are impossible under their prior; give samples of "
                "this posterior, with its parameters in the order of parameter_names"
            )
        self.posterior, self.samples = posterior, points
        self.checks = check_hierarchy(posterior, points, seed)
        warn(self.checks.findings)

    def __repr__(self) -> str:
        return f"<Hierarchy: {len(self.samples)} samples of {self.posterior!r}>"

    def __str__(self) -> str:
        rows = [("hyper-parameter", "mean", "sd", "5 %", "95 %")]
        columns = [
            self.samples.mean(axis=0),
            self.samples.std(axis=0),
            *np.quantile(self.samples, [0.05, 0.95], axis=0),
        ]
        for name, *each in zip(self.posterior.parameter_names, *columns, strict=True):
            rows.append((name, *map(number, each)))
        first = f"Population of {len(self.posterior.tests)} tests, {len(self.samples)} samples"
        return "\n".join(
            [
                f"{first}: {', '.join(self.posterior.tests)}",
                text_table(rows),
                self.spread,
                *labelled(self.checks.findings),
            ]
        )

    @property
    def spread(self) -> str:
        """How much the tests differ in each varying parameter, and what follows for predictions, in one sentence.

        The standard deviation between the tests, with its interval of 90 %, beside the error of a single test (the
        median of their posterior standard deviations).
        """
        found, known = [], False
        for k, (name, varying) in enumerate(self.posterior.varying.items()):
            low, middle, high = np.quantile(self.samples[:, 2 * k + 1], [0.05, 0.5, 0.95])
            errors = []
            for each in self.posterior.described.values():
                weights, values = np.exp(each.log_weights), each.points[:, k]
                errors.append(np.sqrt(weights @ np.square(values - weights @ values) / weights.sum()))
            error = np.median(errors)
            unit = {"log": " %", "linear": ""}[varying.scale]
            factor = 100.0 if varying.scale == "log" else 1.0
            ends = f"{number(factor * low, 2)} to {number(factor * high, 2)}{unit}"
            prior = np.std(varying.sd.rvs(2000, random_state=0))
            by_prior = ", mostly by its prior" if np.std(self.samples[:, 2 * k + 1]) > _MOSTLY_PRIOR * prior else ""
            if low > error:
                known = True
                times = f"{middle / error:.{0 if middle > 9.95 * error else 1}f} times the error of one test"
                found.append(f"{name} by {number(factor * middle, 2)}{unit} ({ends}{by_prior}), {times}")
            else:
                found.append(f"{name} by no more than the error of one test shows ({ends}{by_prior})")
        what = "must carry" if known else "carry"
        return (
            f"The tests differ in {', '.join(found)}: predictions for a further one {what} this spread "
            "(predict_new_event). Posteriors under white noise are too narrow where residuals are correlated "
            "(residual_checks); the spread then contains what they lack."
        )

    def new_test(self, n: int, names: Sequence[str] | None = None, rng: RandomState = None) -> dict[str, np.ndarray]:
        """Draw the parameters of a further test: the predictive density of the population.

        The draws contain the uncertainty of the hyper-parameters and the spread between tests.

        Parameters
        ----------
        n : int
            Number of draws.
        names : sequence of str, optional
            Parameters to draw, in this order, such as ``model.parameter_names``. Default: the varying and the common
            ones. Others are drawn from their prior, which must be the same in all tests.
        rng : int, numpy.random.Generator, numpy.random.RandomState or None
            As for `Posterior.sample_prior`.

        Returns
        -------
        dict of str to (n,) float
            Accepted as samples by `propagate`.

        Raises
        ------
        ValueError
            If a name is unknown, or the priors of a parameter differ between the tests.

        Warns
        -----
        UserWarning
            If more than 1 % of the draws are outside the tests' prior bounds; the parameters are named.

        Examples
        --------
        >>> sorted(hierarchy.new_test(100, rng=1))
        ['damping', 'stiffness']
        """
        if not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"new_test: n must be a whole number, 1 or more; got {n!r}")
        generator, posterior = as_generator(rng), self.posterior
        rows = generator.permutation(np.resize(generator.permutation(len(self.samples)), n))
        center, sd = posterior.population(self.samples[rows])
        varying = len(posterior.varying)
        center[:, :varying] += sd * generator.standard_normal((n, varying))
        draws = posterior.scales.from_scale(center)
        own = [*posterior.varying, *posterior.common]
        outside = np.zeros(draws.shape, dtype=bool)
        for each in posterior.described.values():
            low, high = each.prior.bounds.T
            outside |= (draws < low) | (draws > high)
        shares = dict(zip(own, outside.mean(axis=0).tolist(), strict=True))
        warn(check_new_test(shares, float(outside.any(axis=1).mean())))
        found = dict(zip(own, draws.T, strict=True))
        for name in () if names is None else [name for name in names if name not in own]:
            found[name] = self._prior_draws(name, n, generator)
        return found if names is None else {name: found[name] for name in names}

    def median_test(self) -> dict[str, float]:
        """Parameters in the middle of the population: medians of the varying parameters, and the common ones.

        Returns
        -------
        dict of str to float
            Population centers, averaged over the hyper-samples on the scales of the populations: the geometric mean of
            medians for the scale "log".
        """
        center, _ = self.posterior.population(self.samples)
        names = [*self.posterior.varying, *self.posterior.common]
        return dict(zip(names, self.posterior.scales.from_scale(center.mean(axis=0)).tolist(), strict=True))

    def _prior_draws(self, name: str, n: int, rng: np.random.Generator) -> np.ndarray:
        """Prior draws of a parameter that belongs to each test alone."""
        priors = {}
        for test, stored in self.posterior.tests.items():
            if name not in stored.prior.names:
                raise ValueError(
                    f"new_test: test {test!r} has no parameter {name!r}; it has {', '.join(stored.prior.names)}"
                )
            part = stored.prior.subset([name])
            priors[complete_repr(part)] = part
        if len(priors) > 1:
            raise ValueError(
                f"new_test: the prior of {name} differs between the tests; leave it out of names and draw it yourself"
            )
        return next(iter(priors.values())).rvs(n, rng)[:, 0]
