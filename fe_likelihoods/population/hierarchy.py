"""Result of a hierarchical model of several tests: the population, and the parameters of a new test.

`Hierarchy` combines a `HierarchicalPosterior` with samples of its hyper-parameters, which any sampler has drawn. It
checks where the stored posteriors do not suffice, and draws the parameters of a further test.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..checks.finding import labelled, warn
from ..priors.distributions import RandomState, as_generator
from ..priors.points import as_points, complete_repr
from ..text_tables import number, text_table
from .hierarchical_posterior import HierarchicalPosterior
from .reweighting import check_hierarchy

__all__ = ["Hierarchy"]


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
    Predictions for a further test carry ...
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

    def __str__(self) -> str:
        rows = [("hyper-parameter", "mean", "sd", "5 %", "95 %", "error of one test")]
        columns = [
            self.samples.mean(axis=0),
            self.samples.std(axis=0),
            *np.quantile(self.samples, [0.05, 0.95], axis=0),
        ]
        errors = [""] * self.posterior.ndim
        errors[1 : 2 * len(self.posterior.varying) : 2] = [number(each, 2) for each in self._errors()]
        for name, *each, error in zip(self.posterior.parameter_names, *columns, errors, strict=True):
            rows.append((name, *map(number, each), error))
        first = f"Population of {len(self.posterior.tests)} tests, {len(self.samples)} samples"
        return "\n".join(
            [
                f"{first}: {', '.join(self.posterior.tests)}",
                text_table(rows),
                "Predictions for a further test carry the spread between the tests (predict_new_event). "
                "It contains what posteriors lack that are too narrow (residual_checks).",
                *labelled(self.checks.findings),
            ]
        )

    __repr__ = __str__

    def new_test(
        self,
        n: int,
        names: Sequence[str] | None = None,
        rng: RandomState = None,
        covariates: Mapping[str, float] | None = None,
    ) -> dict[str, np.ndarray]:
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
        covariates : mapping of str to float, optional
            Conditions of the test, for parameters with `Varying.slopes`. Default: their means over the tests.

        Returns
        -------
        dict of str to (n,) float
            Accepted as samples by `propagate`.

        Raises
        ------
        ValueError
            If a name is unknown, the priors of a parameter differ between the tests, or a covariate is missing.

        Examples
        --------
        >>> sorted(hierarchy.new_test(100, rng=1))
        ['damping', 'stiffness']
        """
        if not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"new_test: n must be a whole number, 1 or more; got {n!r}")
        generator, posterior = as_generator(rng), self.posterior
        rows = generator.permutation(np.resize(generator.permutation(len(self.samples)), n))
        center, sd = posterior.population(self.samples[rows], covariates)
        varying = len(posterior.varying)
        center[:, :varying] += sd * generator.standard_normal((n, varying))
        draws = posterior.scales.from_scale(center)
        own = [*posterior.varying, *posterior.common]
        found = dict(zip(own, draws.T, strict=True))
        for name in () if names is None else [name for name in names if name not in own]:
            found[name] = self._prior_draws(name, n, generator)
        return found if names is None else {name: found[name] for name in names}

    def median_test(self, covariates: Mapping[str, float] | None = None) -> dict[str, float]:
        """Parameters in the middle of the population: medians of the varying parameters, and the common ones.

        Parameters
        ----------
        covariates : mapping of str to float, optional
            As for `new_test`.

        Returns
        -------
        dict of str to float
            Population centers, averaged over the hyper-samples on the scales of the populations: the geometric mean of
            medians for the scale "log".
        """
        center, _ = self.posterior.population(self.samples, covariates)
        names = [*self.posterior.varying, *self.posterior.common]
        return dict(zip(names, self.posterior.scales.from_scale(center.mean(axis=0)).tolist(), strict=True))

    def _errors(self) -> np.ndarray:
        """Median over the tests of the posterior standard deviations (n_varying,), on the scales of the population."""
        errors = []
        for each in self.posterior.described.values():
            weights = np.exp(each.log_weights) / np.exp(each.log_weights).sum()
            errors.append(np.sqrt(weights @ np.square(each.points - weights @ each.points)))
        return np.median(errors, axis=0)[: len(self.posterior.varying)]

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
