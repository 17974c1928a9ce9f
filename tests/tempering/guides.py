"""Guides for tests: a t distribution with an optional share of the prior, and a mixture that learns from the draws."""

import hashlib
from functools import partial

import numpy as np
from scipy import stats

from samplers import Guide
from samplers.estimates.weights import coarse_weights, effective_sample_size
from samplers.judgement.guides import find_missing_part
from samplers.proposals.mixture import draw, fit_mixture, log_density


class FixedGuide(Guide):
    """Multivariate t distributions of given weights, and a share of the prior; draws outside the support are repeated.

    The density is normalised over the support by the share of the draws that lie inside it, from many draws.
    """

    dof = 6.0
    findings = ()

    def __init__(self, posterior, means, covariances, weights=None, prior_share=0.0):
        self.posterior, self.prior_share = posterior, prior_share
        self.parts = [
            stats.multivariate_t(mean, np.asarray(c) * (self.dof - 2.0) / self.dof, df=self.dof)
            for mean, c in zip(np.atleast_2d(means), np.atleast_3d(covariances), strict=True)
        ]
        self.weights = np.full(len(self.parts), 1.0 / len(self.parts)) if weights is None else np.asarray(weights)
        self._normalise()

    def _normalise(self):
        self.log_inside = float(np.log(np.mean(self._inside(self._draw_parts(20_000, np.random.RandomState(0))))))

    def _inside(self, coords):
        return np.asarray(self.posterior.log_prior(coords)) > -np.inf

    def _draw_parts(self, n, random):
        part = random.choice(len(self.parts), size=n, p=self.weights)
        coords = np.stack([np.atleast_2d(p.rvs(size=n, random_state=random)).reshape(n, -1) for p in self.parts])
        return coords[part, np.arange(n)]

    def draw(self, n, random):
        found = np.empty((0, self.posterior.ndim))
        while len(found) < n:
            coords = self._draw_parts(n, random)
            found = np.concatenate([found, coords[self._inside(coords)]])
        from_prior = random.uniform(size=n) < self.prior_share
        return np.where(from_prior[:, None], self.posterior.sample_prior(n, random), found[:n])

    def _log_parts(self, coords):
        logs = [np.log(w) + np.atleast_1d(p.logpdf(coords)) for w, p in zip(self.weights, self.parts, strict=True)]
        return np.logaddexp.reduce(logs)

    def log_density(self, coords):
        total = self._log_parts(coords) - self.log_inside
        if self.prior_share == 0.0:
            return total
        prior = np.log(self.prior_share) + self.posterior.log_prior(coords)
        return np.logaddexp(np.log1p(-self.prior_share) + total, prior)


class LearningGuide(FixedGuide):
    """Starts as a `FixedGuide`; a mixture fitted to all draws then replaces most of it.

    The draws are weighted by the densities that they came from. One draw in five still comes from the start.
    """

    start_share = 0.2

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.mixture, self.coords, self.log_weights, self.refinements = None, [], [], 0
        self.known = {}

    def _draw_parts(self, n, random):
        start = super()._draw_parts(n, random)
        if self.__dict__.get("mixture") is None:
            return start
        return np.where((random.uniform(size=n) < self.start_share)[:, None], start, draw(self.mixture, n, random))

    def _log_parts(self, coords):
        start = super()._log_parts(coords)
        if self.mixture is None:
            return start
        fitted = np.log1p(-self.start_share) + log_density(self.mixture, coords)
        return np.logaddexp(fitted, np.log(self.start_share) + start)

    def log_density(self, coords):
        """Kept for draws that arrive when the density has changed."""
        values = super().log_density(coords)
        for row, value in zip(coords, values, strict=True):
            self.known.setdefault(row.tobytes(), value)
        return values

    def refine(self, coords, log_prob, session):
        self.refinements += 1
        alive = log_prob > -np.inf
        self.coords.append(coords[alive])
        self.log_weights.append(log_prob[alive] - np.array([self.known[row.tobytes()] for row in coords[alive]]))
        points, log_weights = np.concatenate(self.coords), np.concatenate(self.log_weights)
        if effective_sample_size(log_weights) > 3 * (points.shape[1] + 1):
            self.mixture = fit_mixture(points, coarse_weights(log_weights))
            self._normalise()
        yield


class SearchingGuide(LearningGuide):
    """Evaluates the posterior by itself: three batches of eight before the first draw, and one after each round."""

    batch = 8

    def __init__(self, posterior):
        super().__init__(posterior, posterior.mean, [np.diag((2.5 * posterior.sd) ** 2)])
        self.simulations, self.findings, self.found, self.seen = 0.0, [], [], []

    def fresh(self):
        """A posterior with a cache would be copied otherwise."""
        return type(self)(self.posterior)

    def search(self, session):
        if not session.fits(self.batch):
            self.findings = [find_missing_part("the search was not finished")]
            return
        points = self.posterior.sample_prior(self.batch, session.random)
        found = session.remember(digest("search", points))
        if found is None:  # the sampler calls the function
            values = yield partial(self.posterior, points)
            found = session.remember(digest("search", points), lambda: [np.asarray(values)])
        (values,) = found
        self.simulations += self.batch
        self.found.append(values.max())

    def prepare(self, session):
        for _ in range(3):
            yield from self.search(session)
            yield

    def observe(self, coords, session):
        (values,) = session.remember(digest("observe", coords), lambda: [coords.sum(axis=1)])
        self.seen.append(values)

    def refine(self, coords, log_prob, session):
        assert np.array_equal(np.concatenate(self.seen)[-len(coords) :], coords.sum(axis=1))
        yield from self.search(session)
        yield from super().refine(coords, log_prob, session)


def digest(what, coords):
    return what + hashlib.sha256(np.ascontiguousarray(coords)).hexdigest()


class DrawsOf(Guide):
    """A guide that does not learn; `rvs` is a function of the number of draws and the random state."""

    findings = ()

    def __init__(self, rvs, logpdf):
        self.rvs, self.logpdf = rvs, logpdf

    def draw(self, n, random):
        return self.rvs(n, random)

    def log_density(self, x):
        return np.atleast_1d(self.logpdf(x))
