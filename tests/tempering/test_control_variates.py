"""Expectations from few draws and a known density: errors that cover, and what a poor known density does."""

import numpy as np
import pytest
from scipy import stats

from samplers.estimates.control_variates import signed_sample
from samplers.estimates.importance import KnownDensity, Round, add_round, pool_rounds
from samplers.judgement.verdict import judge
from tests.contract.targets import Box, Gaussian
from tests.tempering.guides import FixedGuide
from tests.tempering.test_guided import laplace, run

NDIM, POOL, LOG_EVIDENCE = 3, 2000, 4.0
LOW = stats.norm.ppf(0.05)
POSTERIOR = stats.multivariate_normal(np.zeros(NDIM))
WIDE = stats.multivariate_t(np.zeros(NDIM), 1.5 * np.eye(NDIM), df=5)


def rounds_of(rng, n, number, shift=0.1, scale=1.1, posterior=POSTERIOR):
    """Rounds of draws from .85 known + .15 wide, for a standard normal posterior with the evidence exp(4)."""
    normal, made = stats.multivariate_normal(np.full(NDIM, shift), scale**2 * np.eye(NDIM)), []

    def density(coords):
        return np.logaddexp(np.log(0.85) + normal.logpdf(coords), np.log(0.15) + WIDE.logpdf(coords))

    for _ in range(number):
        of_known = (rng.random(n) < 0.85)[:, None]
        coords = np.where(of_known, normal.rvs(n, random_state=rng), WIDE.rvs(n, random_state=rng))
        log_q = density(coords)
        log_p = posterior.logpdf(coords) + LOG_EVIDENCE
        known = KnownDensity(normal.logpdf, normal.rvs(POOL, random_state=rng), np.full(POOL, 1.0 / POOL), 0.0)
        records = np.zeros(n, dtype=[("log_prob", float)])
        records["log_prob"] = log_p
        latest = Round(
            coords, records, log_p - log_q, known, known.log_density(coords) - log_q, density, log_q[:, None]
        )
        made = add_round(made, latest)
    return made


def signed_of(rounds):
    """The signed sample of rounds."""
    return signed_sample(rounds, pool_rounds(rounds))


@pytest.mark.slow
@pytest.mark.parametrize("n, number, shift, scale", [(30, 1, 0.1, 1.1), (30, 2, 0.3, 0.8)])
def test_errors_cover(n, number, shift, scale, rng):
    scores = {name: [] for name in ("mean", "sd", "tail", "log Z")}
    for _ in range(150):
        sample = signed_of(rounds_of(rng, n, number, shift, scale))
        for name, found, truth in (
            ("mean", sample.expectation(), 0.0),
            ("sd", sample.standard_deviation(), 1.0),
            ("tail", sample.expectation(lambda x: x < LOW), 0.05),
        ):
            scores[name].append((found.value - truth) / found.error)
        scores["log Z"].append((sample.log_evidence - LOG_EVIDENCE) / sample.log_evidence_error)
    for name, score in scores.items():
        # 150 independent samples: a share of .95 has a standard error of .018; a standard deviation that is not
        # determined (NaN, a variance too low by more than its error) covers nothing
        covered = np.mean(np.abs(score) < 2.0)
        assert covered > 0.90, (name, covered)
        # errors may be too large, but not useless
        assert np.sqrt(np.nanmean(np.square(score))) > 0.3, name


def test_a_round_without_failures_does_not_count_more(rng):
    """A sixth of the known density fails: rounds that did not see it agree with that density, and are wrong by log 6/5.

    Weighted by the differences of their own draws, they would make the evidence too large by .07 on average.
    """

    class Fails:
        def logpdf(self, x):
            return np.where(x[:, 0] > stats.norm.isf(1.0 / 6.0), -np.inf, POSTERIOR.logpdf(x))

    scores, values = [], []
    for _ in range(200):
        sample = signed_of(rounds_of(rng, 12, 4, 0.0, 1.0, Fails()))
        values.append(np.exp(sample.log_evidence - LOG_EVIDENCE) - 5.0 / 6.0)
        scores.append((sample.log_evidence - LOG_EVIDENCE - np.log(5.0 / 6.0)) / sample.log_evidence_error)
    assert abs(np.mean(values)) < 4.0 * np.std(values) / np.sqrt(len(values))
    assert np.mean(np.abs(scores) < 2.0) > 0.9


def test_few_draws_are_worth_many(rng):
    """30 draws with a known density that is off by 5 %: means as accurate as from several hundred independent draws."""
    errors = [signed_of(rounds_of(rng, 30, 1, 0.05, 1.0)).expectation().value for _ in range(100)]
    assert np.sqrt(np.mean(np.square(errors))) < 1.0 / np.sqrt(300.0)
    # the chain of the same draws
    plain = [pool_rounds(rounds_of(rng, 30, 1, 0.05, 1.0)) for _ in range(100)]
    means = [np.exp(found.log_weights - found.log_evidence) @ found.coords for found in plain]
    assert np.sqrt(np.mean(np.square(means))) > 3.0 * np.sqrt(np.mean(np.square(errors)))


def test_control_a_known_density_that_is_not_the_density_of_its_points(rng):
    """Negative control: points that are not from the known density make the estimate wrong by many errors."""
    made = [r._replace(known=r.known._replace(coords=r.known.coords + 0.5)) for r in rounds_of(rng, 100, 1, scale=1.0)]
    found = signed_of(made).expectation()
    assert np.all(np.abs(found.value) > 5.0 * found.error)


def test_exact_knowledge_leaves_the_error_of_its_points(rng):
    sample = signed_of(rounds_of(rng, 30, 1, 0.0, 1.0))
    assert sample.weights.sum() == pytest.approx(1.0)
    assert np.allclose(sample.weights[sample.rounds > 0], 0.0, atol=1e-15)
    assert sample.log_evidence == pytest.approx(LOG_EVIDENCE, abs=1e-12)
    assert np.allclose(sample.expectation().error, 1.0 / np.sqrt(POOL), rtol=0.1)
    assert np.allclose(sample.standard_deviation().error, 1.0 / np.sqrt(2.0 * POOL), rtol=0.1)


def test_rounds_without_knowledge_are_left_out(rng):
    made = rounds_of(rng, 30, 2)
    without = [r._replace(known=None, log_known=None) for r in made]
    assert signed_of(without) is None
    elsewhere = made[0]._replace(log_known=np.full(30, -np.inf))
    impossible = made[0]._replace(log_weights=np.full(30, -np.inf))
    alone = signed_of([made[1]._replace(log_densities=made[1].log_densities[:, 1:])])
    for other in (without[0], elsewhere, impossible):
        assert np.array_equal(signed_of([other, made[1]]).weights, alone.weights)


def test_wrong_arguments(rng):
    sample = signed_of(rounds_of(rng, 30, 1))
    for wrong in (lambda coords: 1.0, lambda coords: coords[0]):
        with pytest.raises(ValueError, match=r"each of the 2030 points, .* got an array of shape"):
            sample.expectation(wrong)
    with pytest.raises(ValueError, match="finite numbers; .* are not"):
        sample.expectation(lambda coords: np.where(coords[:, 0] > 0.0, np.inf, 1.0))


def test_a_variance_below_its_error_is_no_standard_deviation(rng):
    """Weights of both signs can make a variance negative: no number is stated then, and the verdict says so."""
    sample = signed_of(rounds_of(rng, 30, 1))
    far = sample.coords.copy()
    # a draw in a tail that the known density does not have: the largest weights make the variance positive
    for row in (np.argmin(sample.weights), np.argmax(np.where(sample.rounds > 0, sample.weights, -1.0))):
        far[:, 1] = sample.coords[:, 1]
        far[row, 1] = 1e3
        found = sample._replace(coords=far).standard_deviation()
        assert np.isnan(found.value).tolist() == [False, True, False]
        assert np.isnan(found.error).tolist() == [False, True, False]
    posterior = Gaussian(3)
    sampler = run(posterior, laplace(posterior, scale=1.3, guide=KnowingGuide), nwalkers=50, seed=2)
    before = judge(sampler._result, 50, 3, 100)
    assert not any("is not determined" in reason for reason in before.reasons)
    after = judge(sampler._result._replace(signed=sample._replace(coords=far)), 50, 3, 100, names=["E", "fy", "b"])
    assert any("standard deviation of fy is not determined" in reason for reason in after.reasons)


class KnowingGuide(FixedGuide):
    """A guide that knows a density of the posterior's shape, a tenth of a standard deviation away."""

    def __init__(self, posterior, *args):
        super().__init__(posterior, *args)
        normal = stats.multivariate_normal(posterior.mean + 0.1 * posterior.sd, np.diag(posterior.sd**2))
        points = normal.rvs(POOL, random_state=np.random.RandomState(5))
        self.known_density = KnownDensity(normal.logpdf, points, np.full(POOL, 1.0 / POOL), 0.0)


def test_a_sampler_uses_what_its_guide_knows():
    posterior = Gaussian(3)
    covariances = [np.diag((1.3 * posterior.sd) ** 2)]
    runs = {}
    for Guide in (FixedGuide, KnowingGuide):
        runs[Guide] = run(posterior, Guide(posterior, posterior.mean, covariances), nwalkers=50, seed=2)
    plain, knowing = runs[FixedGuide], runs[KnowingGuide]
    assert plain.signed_sample is None
    assert np.array_equal(plain.get_chain(), knowing.get_chain())  # the chain has exact weights in both
    found = knowing.signed_sample.expectation()
    assert np.all(np.abs(found.value - posterior.mean) < 4.0 * found.error)
    assert np.all(found.error < 0.5 * knowing.mean_error())
    assert knowing.log_evidence_error < 0.7 * plain.log_evidence_error
    assert abs(knowing.log_evidence - posterior.log_evidence) < 4.0 * knowing.log_evidence_error


def two_modes(shares, n=POOL):
    """Normal densities of standard deviation .1 about 1 and -1, with points of equal weight."""
    parts = [stats.multivariate_normal(np.full(2, centre), 0.01) for centre in (1.0, -1.0)]
    points = [
        p.rvs(int(share * n), random_state=np.random.RandomState(3)) for p, share in zip(parts, shares, strict=True)
    ]

    def log_density(coords):
        with np.errstate(divide="ignore"):
            return np.logaddexp.reduce([np.log(w) + p.logpdf(coords) for w, p in zip(shares, parts, strict=True)])

    points = np.concatenate(points)
    return KnownDensity(log_density, points, np.full(len(points), 1.0 / len(points)), 0.0)


class GrowingGuide(FixedGuide):
    """Knows one of two modes, and not how probable it is, and the other one after the first round."""

    def __init__(self, posterior):
        super().__init__(posterior, [[1.0, 1.0]], [0.012 * np.eye(2)])
        self.known_density = two_modes([1.0, 0.0])._replace(log_density_error=0.3)

    def refine(self, coords, log_prob, session):
        both = np.array([[1.0, 1.0], [-1.0, -1.0]])
        super().__init__(self.posterior, both, [0.012 * np.eye(2)] * 2)
        self.known_density = two_modes([0.5, 0.5])


def test_rounds_that_missed_a_part_of_the_posterior_do_no_harm():
    exact = two_modes([0.5, 0.5])
    box = Box([-4.0, -4.0], [4.0, 4.0], lambda x: exact.log_density(np.atleast_2d(x)).reshape(np.shape(x)[:-1]))
    sampler = run(box, GrowingGuide(box), seed=4)
    error = sampler.log_evidence + np.log(64.0)
    assert abs(error) < 4.0 * sampler.log_evidence_error + 1e-9 < 0.4
    assert sampler.verdict.status == "converged"


class UncoveringGuide(FixedGuide):
    """Knows one of many equal modes, and one more after each round, as along a ridge that the draws follow slowly."""

    def __init__(self, posterior, modes, known=1):
        parts = [stats.multivariate_normal([centre, 0.0], 0.01) for centre in range(known)]

        def log_density(coords):
            return np.logaddexp.reduce([part.logpdf(coords) for part in parts]) - np.log(known)

        points = np.concatenate([part.rvs(1000, random_state=np.random.RandomState(3)) for part in parts])
        super().__init__(posterior, [part.mean for part in parts], [0.012 * np.eye(2)] * known)
        self.known_density = KnownDensity(log_density, points, np.full(len(points), 1.0 / len(points)), 0.0)
        self.modes = modes

    def refine(self, coords, log_prob, session):
        self.__init__(self.posterior, self.modes, min(len(self.parts) + 1, self.modes))


@pytest.mark.parametrize(("modes", "refused"), [(10, False), (60, True)])
def test_a_density_that_still_grows_is_followed_or_refused(modes, refused):
    ends = [-4.0, -4.0], [modes + 4.0, 4.0]
    whole = UncoveringGuide(Box(*ends, lambda x: 0.0), modes, modes).known_density
    box = Box(*ends, lambda x: whole.log_density(np.atleast_2d(x)).reshape(np.shape(x)[:-1]))
    sampler = run(box, UncoveringGuide(box, modes), seed=4)
    error = sampler.log_evidence + np.log(8.0 * (modes + 8.0))
    assert (abs(error) > 4.0 * sampler.log_evidence_error + 1e-9) == refused
    assert (sampler.verdict.status == "not usable") == refused
    assert ("larger than its draws" in str(sampler.verdict)) == refused
