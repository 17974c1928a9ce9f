"""Shares of the response that grow with the deformation that a test imposes: density, calibration, other tests."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    Channel,
    DisplacementHistory,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    Steel,
    TruncatedNormal,
    propagate,
)
from fe_likelihoods.noise.response_level import imposed_deformation
from tutorials.steel_coupon import SteelCoupon

FORCE = (Channel("force", "lateral force", "kN"),)
HEIGHT, WINDOW, SENSOR, GROWTH = 2.0, 12.0, 50.0, 0.5
SHARE = 0.1


@dataclass(frozen=True)
class Specimen:
    """A cantilever whose force saturates at a drift of 1 %."""

    loading: DisplacementHistory
    height: float = HEIGHT
    dt: float = 1.0
    path_dependent: bool = False

    parameter_names = ("strength",)
    channels = FORCE

    @property
    def n_steps(self):
        return int(round((self.loading.n_steps - 1) / self.dt)) + 1

    @property
    def fingerprint(self):
        return f"{self.loading.fingerprint} {self.height} {self.dt}"

    @property
    def deformation(self):
        return np.interp(self.dt * np.arange(self.n_steps), np.arange(self.loading.n_steps), self.loading.displacement)

    def simulate(self, theta):
        return theta[0] * 1e4 * np.tanh(100.0 * self.deformation / self.height)[None]

    def with_record(self, record):
        return Specimen(record, self.height, self.dt)

    def followed_by(self, record, rest):
        """The history, a pause at its last displacement, and another history."""
        pause = np.full(round(rest), self.loading.displacement[-1])
        joined = np.concatenate([self.loading.displacement, pause, record.displacement])
        return self.with_record(DisplacementHistory("joined", joined))

    def first(self, seconds):
        return self.with_record(DisplacementHistory("part", self.loading.displacement[: round(seconds) + 1]))


def cycles(drift, n=240, height=HEIGHT):
    """Twenty cycles that grow to a drift."""
    step = np.arange(n)
    return DisplacementHistory("test", height * drift * (step / n) * np.sin(2.0 * np.pi * 20.0 * step / n))


def noise_of(specimen, **options):
    settings = {"window": WINDOW, "sensor": [SENSOR], "growth": GROWTH, "deformation": 0.01 * specimen.height}
    return GaussianNoise(FORCE, level="response", **settings | options)


def without_growth():
    return GaussianNoise(FORCE, level="response", window=WINDOW, sensor=[SENSOR])


def deviations(specimen, theta, share, local=0.25, first=0):
    """From the definitions, with loops, of the response from the step `first` on."""
    force, time = specimen.simulate(theta)[0, first:], specimen.dt * np.arange(specimen.n_steps - first)
    parts = np.floor(time / (WINDOW / 3.0) + 1e-9)
    reached = [np.abs(specimen.deformation[: j + 1]).max() for j in range(first, specimen.n_steps)]
    found = np.empty(len(force))
    for k, this in enumerate(parts):
        drift = np.interp((this + 0.5) * WINDOW / 3.0, time, reached) / specimen.height
        envelope = np.mean(force[np.abs(parts - this) <= 1] ** 2)
        level = (1.0 - local) * np.mean(force**2) + local * envelope
        found[k] = SENSOR**2 + share**2 * level * (drift / 0.01) ** (2.0 * GROWTH)
    return np.sqrt(found)


def measured_of(specimen, share, rng, theta=(1.0,)):
    sd = deviations(specimen, theta, share)
    return Measurements(FORCE, specimen.dt, specimen.simulate(theta) + sd * rng.standard_normal(specimen.n_steps))


def posterior_of(specimen, measured, **options):
    likelihood = FELikelihood(specimen, measured, noise_of(specimen, **options))
    return Posterior(likelihood, {"strength": TruncatedNormal(1.0, 0.2), "share_force": HalfNormal(0.3)})


def test_the_likelihood_is_the_multivariate_normal_density_with_and_without_gaps(rng):
    specimen = Specimen(cycles(0.04))
    measured = measured_of(specimen, SHARE, rng)
    likelihood = FELikelihood(specimen, measured, noise_of(specimen))
    for theta, share in ((0.8, 0.05), (1.0, 0.1), (1.2, 0.4)):
        sd = deviations(specimen, [theta], share)
        normal = stats.multivariate_normal(specimen.simulate([theta])[0], np.diag(sd**2))
        assert likelihood([theta, share]) == pytest.approx(normal.logpdf(measured.values[0]), rel=1e-11)
    # other settings need no other simulations, and are another density
    assert likelihood.simulations == 3
    without = likelihood.with_noise(without_growth())
    assert without.density_parts() != likelihood.density_parts() and without.fingerprint == likelihood.fingerprint
    assert abs(without([1.0, 0.1]) - likelihood([1.0, 0.1])) > 10.0
    # samples that are missing have no factor; the deformation is known there all the same
    gaps = measured.values.copy()
    gaps[0, 100:130] = np.nan
    found = FELikelihood(specimen, Measurements(FORCE, 1.0, gaps), noise_of(specimen, local=0.0))
    there, force = ~np.isnan(gaps[0]), specimen.simulate([1.0])[0]
    ratio = np.sqrt(np.mean(force[there] ** 2) / np.mean(force**2))
    sd = deviations(specimen, [1.0], SHARE * ratio, local=0.0)[there]
    expected = stats.norm.logpdf(gaps[0, there], force[there], sd).sum()
    assert found([1.0, SHARE]) == pytest.approx(expected, rel=1e-10)
    terms = found.noise.log_densities(force - gaps, force[None], np.array([SHARE]))
    assert terms.sum() == pytest.approx(expected, rel=1e-10)


def test_the_density_integrates_to_one_over_the_measurements():
    specimen = Specimen(DisplacementHistory("two", [0.01, -0.03]))
    noise = GaussianNoise(FORCE, level="response", window=3.0, sensor=[SENSOR], deformation=0.02, growth=0.5)
    simulated = specimen.simulate([1.0])
    noise = FELikelihood(specimen, Measurements(FORCE, 1.0, simulated), noise).noise
    sd = noise.response_deviations(np.array([0.3]), simulated)[0]
    assert sd[1] > 1.2 * sd[0]
    axes = [centre + each * np.linspace(-8.0, 8.0, 61) for centre, each in zip(simulated[0], sd, strict=True)]
    area = np.prod([axis[1] - axis[0] for axis in axes])
    density = [
        np.exp(noise.log_densities(simulated - [[one, two]], simulated, np.array([0.3])).sum())
        for one in axes[0]
        for two in axes[1]
    ]
    assert area * np.sum(density) == pytest.approx(1.0, abs=1e-6)


def test_calibrated_parameters_have_uniform_ranks(rng):
    """Simulation-based calibration on a grid, with exact posteriors; without the growth the share is too small."""
    specimen, repeats = Specimen(cycles(0.04)), 100
    axes = np.linspace(0.8, 1.2, 31), np.linspace(0.02, 0.3, 29)
    ranks = {growth: np.empty((repeats, 2)) for growth in (GROWTH, 0.0)}
    for k in range(repeats):
        places = [rng.integers(len(axis)) for axis in axes]
        theta, share = (axis[place] for axis, place in zip(axes, places, strict=True))
        measured = measured_of(specimen, share, rng, (theta,))
        for growth, found in ranks.items():
            likelihood = FELikelihood(specimen, measured, noise_of(specimen, growth=growth))
            statistics = np.repeat(likelihood.simulator.statistics(axes[0][:, None]), len(axes[1]), axis=0)
            shares = np.tile(axes[1][:, None], (len(axes[0]), 1))
            values = likelihood.noise.log_likelihood(statistics, specimen.n_steps, shares)
            weights = np.exp(values - values.max()).reshape(len(axes[0]), len(axes[1]))
            for j, place in enumerate(places):
                marginal = weights.sum(axis=1 - j) / weights.sum()
                found[k, j] = marginal[:place].sum() + rng.uniform() * marginal[place]
    for j in range(2):
        assert stats.kstest(ranks[GROWTH][:, j], "uniform").pvalue > 1e-3, j
    assert stats.kstest(ranks[0.0][:, 1], "uniform").pvalue < 1e-6


def test_predictions_of_a_larger_test_cover_errors_that_grow(rng):
    """Twins whose errors grow, calibrated up to a drift of 1 %, of a specimen twice as high up to 4 %."""
    calibrated = Specimen(cycles(0.01))
    other = Specimen(cycles(0.04, 480, 2.0 * HEIGHT), 2.0 * HEIGHT)
    grid = np.linspace(0.005, 0.4, 80)
    coverage, score = {}, {}
    for growth in (GROWTH, 0.0):
        coverage[growth], score[growth] = np.empty(20), np.empty(20)
    for k in range(20):
        measured, truth = measured_of(calibrated, SHARE, rng), measured_of(other, SHARE, rng)
        for growth in (GROWTH, 0.0):
            noise = FELikelihood(calibrated, measured, noise_of(calibrated, growth=growth)).noise
            statistics = noise.statistic(calibrated.simulate([1.0]) - measured.values, calibrated.simulate([1.0]))
            values = noise.log_likelihood(np.tile(statistics, (len(grid), 1)), 240, grid[:, None])
            shares = rng.choice(grid, 200, p=np.exp(values - values.max()) / np.exp(values - values.max()).sum())
            posterior = posterior_of(other, truth, growth=growth)
            samples = np.column_stack([np.ones(200), shares])
            found = propagate(posterior, samples, noise=True, seed=k, progress=False).score(truth)
            coverage[growth][k], score[growth][k] = found.coverage[0], found.interval_score[0]
    for growth in (GROWTH, 0.0):
        print(growth, coverage[growth].mean(), "interval score [N]:", score[growth].mean())
    error = coverage[GROWTH].std() / np.sqrt(20)
    assert abs(coverage[GROWTH].mean() - 0.9) < 4.0 * error + 0.01  # 0.01: quantiles of 200 samples
    assert coverage[0.0].mean() < 0.8 and (score[0.0] > score[GROWTH]).all()


def test_another_record_has_its_own_deformation(rng):
    """`propagate` with record=, and the error of the model alone."""
    specimen = Specimen(cycles(0.02))
    posterior = posterior_of(specimen, measured_of(specimen, SHARE, rng))
    samples, larger = np.array([[1.0, SHARE]] * 2), cycles(0.06, 360)
    expected = deviations(Specimen(larger), (1.0,), SHARE)
    found = propagate(posterior, samples, record=larger, noise=True, progress=False, calibrated=())
    np.testing.assert_allclose(found.sd[0], expected, rtol=1e-9)
    own = propagate(posterior, samples, noise=True, progress=False)
    np.testing.assert_allclose(own.sd[0], deviations(specimen, (1.0,), SHARE), rtol=1e-9)
    model = propagate(posterior, samples, record=larger, noise="model", progress=False, calibrated=())
    np.testing.assert_allclose(model.sd[0] ** 2, expected**2 - SENSOR**2, rtol=1e-9)
    with pytest.raises(
        ValueError, match=r"deformation= is for a model under an imposed deformation.*leave deformation"
    ):
        noise_of(specimen).under(_Shaken())


@pytest.mark.parametrize("rest", [7.0, 10.0, 12.0])  # steps; parts begin at the start of the record, not of the test
def test_a_test_that_follows_keeps_the_deformation_of_the_test_before(rest, rng):
    """`propagate` with from_state="end": a smaller history after the larger one, with errors of the larger drift."""
    specimen, smaller = Specimen(cycles(0.04)), cycles(0.02, 100)
    posterior = posterior_of(specimen, measured_of(specimen, SHARE, rng))
    options = {"record": smaller, "noise": True, "progress": False, "calibrated": ()}
    found = propagate(posterior, np.array([[1.0, SHARE]] * 2), from_state="end", rest=rest, **options).sd[0]
    joined = specimen.followed_by(smaller, rest)
    expected = deviations(joined, (1.0,), SHARE, first=joined.n_steps - len(found))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    fresh = propagate(posterior, np.array([[1.0, SHARE]] * 2), **options).sd[0]  # control: its own deformation alone
    assert len(fresh) == len(found) and np.all(fresh < found / 1.3)


class _Shaken:
    dt, n_steps, parameter_names, channels = 1.0, 10, ("a",), FORCE


def test_parts_of_a_test_time_steps_and_joint_likelihoods(rng):
    specimen = Specimen(cycles(0.04))
    measured = measured_of(specimen, SHARE, rng)
    likelihood = FELikelihood(specimen, measured, noise_of(specimen))
    first = likelihood.first(100.0)
    short = Specimen(DisplacementHistory("part", specimen.loading.displacement[:101]))
    sd = deviations(short, (1.0,), SHARE)
    expected = stats.norm.logpdf(measured.values[0, :101], short.simulate([1.0])[0], sd).sum()
    assert first([1.0, SHARE]) == pytest.approx(expected, rel=1e-10)
    # half the time step: the parts are those of the time
    fine = Specimen(specimen.loading, dt=0.5)
    levels = noise_of(fine).under(fine).response_deviations(np.array([SHARE]), fine.simulate([1.0]), 0.5)
    np.testing.assert_allclose(levels[0], deviations(fine, (1.0,), SHARE), rtol=1e-9)
    np.testing.assert_allclose(levels[0, ::2], deviations(specimen, (1.0,), SHARE), rtol=0.05)
    # specimens of two sizes have the share in common, each with its own deformation
    tall = Specimen(cycles(0.04, height=5.0), 5.0)
    other = FELikelihood(tall, measured_of(tall, SHARE, rng), noise_of(tall))
    joint = JointLikelihood({"short": likelihood, "tall": other})
    assert joint([1.0, SHARE]) == pytest.approx(likelihood([1.0, SHARE]) + other([1.0, SHARE]), rel=1e-12)
    drifts = [each.noise.excited.reached[-1] / each.model.height for each in (likelihood, other)]
    assert drifts[0] == pytest.approx(drifts[1])
    with pytest.raises(ValueError, match="needs the times of the samples"):
        noise_of(specimen).response_deviations(np.array([SHARE]), specimen.simulate([1.0]), 1.0)


def test_deformations_that_a_test_imposes():
    history = cycles(0.02)
    steel = Steel(fy=450e6, fu=650e6, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
    for model in (Specimen(history), SteelCoupon(history.displacement, steel)):
        np.testing.assert_array_equal(imposed_deformation(model), history.displacement)
    assert imposed_deformation(_Shaken()) is None
    assert GaussianNoise(FORCE, level="response", window=1.0, sensor=[1.0], deformation=1.0).growth == 0.25
