"""Modes: against a general optimiser, for every noise; two modes; failures; budgets; growing records."""

import hashlib
import warnings
from functools import partial

import numpy as np
import pytest
from scipy.optimize import minimize

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    LogNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
    Uniform,
    problems,
)
from fe_likelihoods.emulation.modes import Mode, ModeSearch, find_modes
from fe_likelihoods.emulation.target import ResponseTarget
from samplers import SamplingWarning
from samplers.judgement.guides import DOUBTED_SHARE

from .problems import (
    CHANNELS,
    DT,
    N_STEPS,
    acts_late,
    free_vibration,
    guided,
    late_response,
    misleading,
    noisy,
    symmetric,
    vibration,
)


def _log_density(posterior, coords):
    """Log-density in standard normal coordinates, by the posterior itself."""
    target = ResponseTarget(posterior)
    x = target.parameters(coords[None])
    return float((posterior.log_likelihood(x) + target.log_prior(coords[None]))[0])


@pytest.mark.parametrize(
    "noise",
    [
        *("marginal", "autoregressive", "sensor"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("white", "shared", "effective")),
    ],
)
def test_the_mode_is_the_one_of_a_general_optimiser(noise):
    posterior = vibration(noise)
    search = find_modes(posterior, starts=3, seed=1)
    mode = search.modes[0]
    assert mode.converged and search.finished and 0 in list(search.ends)
    assert mode.log_density == pytest.approx(_log_density(posterior, mode.coords), abs=1e-3)
    scale = np.sqrt(np.diag(mode.covariance))
    found = minimize(
        lambda u: -_log_density(posterior, mode.coords + scale * u), np.zeros(posterior.ndim), method="Nelder-Mead",
        options={"maxiter": 800, "xatol": 1e-3, "fatol": 1e-3},
    )  # fmt: skip
    assert mode.log_density > -found.fun - 0.5
    assert np.abs(found.x).max() < 1.5


@pytest.mark.parametrize("noise", ["marginal", "autoregressive"])
def test_the_covariance_is_the_inverse_of_the_hessian(noise):
    posterior = vibration(noise)
    mode = find_modes(posterior, starts=1, seed=1).modes[0]
    factor = np.linalg.cholesky(mode.covariance)
    here = _log_density(posterior, mode.coords)
    for k in range(posterior.ndim):
        step = 0.5 * factor[:, k]
        drop = here - 0.5 * sum(_log_density(posterior, mode.coords + sign * step) for sign in (1.0, -1.0))
        assert drop == pytest.approx(0.125, rel=0.25)


def _equal_modes(n):
    """A parameter c whose n values (k + 1/2) / n give the same response, and one parameter that is identified."""
    time = 0.02 * np.arange(100)

    def respond(theta):
        angle = 2.0 * np.pi * n * theta[1]
        return (theta[0] * np.sin(3.0 * time) + 0.3 * np.cos(angle) * np.cos(7.0 * time) + 0.3 * np.sin(angle))[None]

    channels = [Channel("top", "displacement", "m")]
    model = FunctionModel(respond, ("a", "c"), channels, 0.02, 100, version=f"{n} modes")
    noise = 0.02 * np.random.default_rng(n).standard_normal((1, 100))
    measured = Measurements(channels, 0.02, model.simulate(np.array([1.0, 0.5 / n])) + noise)
    prior = {"a": Uniform(0.0, 2.0), "c": Uniform(0.0, 1.0), "sigma_top": Uniform(0.005, 0.5)}
    return Posterior(FELikelihood(model, measured), prior)


@pytest.mark.parametrize("n", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 6))])
def test_starts_are_added_until_few_unseen_modes_are_expected(n):
    """And until as many as were asked for have reached one."""
    found = [find_modes(_equal_modes(n), seed=seed) for seed in range(1, 6)]
    for search in found:
        most = len(search.ends) == 24
        assert len(search.ends) <= 24 and (most or (search.unseen_share <= DOUBTED_SHARE and search.ended >= 12))
    # a share of DOUBTED_SHARE is expected to be missed: of 30, 1.5 with a standard deviation of 1.2
    assert sum(len(search.modes) for search in found) >= 5 * n - (4 if n == 6 else 0)


def _two_storeys(others=0, derivatives=True):
    """Two storeys that can be exchanged; `others` are parameters of a second channel, and with them, a jacobian."""
    time, squared = 0.02 * np.arange(250), (2.0 * np.pi) ** 2
    waves = 1e-3 * np.sin(2.0 * np.pi * np.outer(1 + np.arange(others), time) / 5.0)

    def respond(theta):
        lower, upper = 9.0 * squared * theta[:2]
        values, vectors = np.linalg.eigh([[lower + upper, -upper], [-upper, upper]])
        omega = np.sqrt(np.maximum(values, 1e-9))[:, None]
        each = (vectors.sum(axis=0) * vectors[1])[:, None] * omega * np.exp(-0.03 * omega * time)
        roof = 1e-3 * (each * np.sin(omega * time)).sum(axis=0)
        return np.array([roof, (theta[2:] + 0.3 * theta[2:] ** 2) @ waves])[: 2 if others else 1]

    def slopes(theta):
        return np.array([respond(theta + step) - respond(theta - step) for step in 1e-6 * np.eye(2 + others)]) / 2e-6

    names = ["k1", "k2", *(f"c{k}" for k in range(others))]
    channels = [Channel(name, "displacement", "mm") for name in ("roof", "base")[: 2 if others else 1]]
    jacobian = slopes if others and derivatives else None
    model = FunctionModel(respond, names, channels, 0.02, 250, version=f"storeys {others}", jacobian=jacobian)
    clean = model.simulate(np.array([2.0, 0.7, *np.linspace(0.7, 1.3, others)]))
    sigma = 0.3 * np.sqrt(np.mean(clean**2, axis=1))
    values = clean + sigma[:, None] * np.random.default_rng(3).standard_normal(clean.shape)
    prior = {"k1": LogNormal(1.2, 0.5), "k2": LogNormal(1.0, 0.5)}
    prior |= {name: TruncatedNormal(1.0, 0.3) for name in names[2:]}
    prior |= {f"sigma_{c.name}": HalfNormal(3.0 * s) for c, s in zip(channels, sigma, strict=True)}
    return Posterior(FELikelihood(model, Measurements(channels, 0.02, values, "SYNTHETIC")), prior)


@pytest.mark.slow  # 15 seconds
def test_both_orders_of_two_storeys_are_found():
    """A quarter of the starts that end leads to one mode. Six lost it in 6 of 30 searches, eleven in 1 of 40."""
    found = [len(find_modes(_two_storeys(), seed=seed).modes) for seed in range(10)]
    assert found.count(2) >= 9  # a rate of .2 lets this pass in a third of the cases, one of .025 in 98 of 100


@pytest.mark.parametrize("others", [6, pytest.param(13, marks=pytest.mark.slow)])
def test_derivatives_of_their_own_lead_starts_to_both_orders(others):
    """With derivatives that ascents share, 3 of 16 searches find both."""
    posterior = _two_storeys(others).marginal()
    assert [len(find_modes(posterior, seed=seed).modes) for seed in (1, 2, 3)] == [2, 2, 2]


@pytest.mark.slow  # 20 seconds
@pytest.mark.parametrize("others", [6, 13])
def test_both_orders_are_found_without_derivatives(others):
    """On whole records, with secants to the runs of all ascents, 2 of 16 searches found both."""
    posterior = _two_storeys(others, derivatives=False).marginal()
    found = [len(find_modes(posterior, seed=seed).modes) for seed in range(1, 11)]
    assert found.count(2) >= 7


@pytest.mark.parametrize("difference", [0.4, pytest.param(0.7, marks=pytest.mark.slow)])
def test_two_straight_ridges_are_two_modes(difference):
    """Only (a - b)^2 is identified. With wrong derivatives at first, steps cost hundreds, which is no roughness; and
    from the saddle a = b, lines lead up to both modes."""
    time, channels = 0.02 * np.arange(100), [Channel("top", "displacement", "m")]
    function = partial(_of_squared_difference, time)
    model = FunctionModel(function, ("a", "b"), channels, 0.02, 100, version="two ridges")
    noise = 0.05 * np.random.default_rng(1).standard_normal((1, 100))
    measured = Measurements(channels, 0.02, model.simulate(np.array([difference, 0.0])) + noise)
    prior = {"a": TruncatedNormal(0.0, 1.0, -np.inf), "b": TruncatedNormal(0.0, 1.0, -np.inf)}
    posterior = Posterior(FELikelihood(model, measured), prior | {"sigma_top": HalfNormal(0.2)})
    for seed in range(6):
        ends = [mode.parameters[0] - mode.parameters[1] for mode in find_modes(posterior, seed=seed).modes]
        assert sorted(ends) == pytest.approx([-difference, difference], abs=0.05)


def _of_squared_difference(time, theta):
    return (np.square(theta[0] - theta[1]) * np.cos(6.0 * time))[None]


@pytest.mark.parametrize(
    ("ends", "grown", "severity"),
    [((0,) * 5, False, "care"), ((0,) * 6, False, None), ((0,), True, "care"), ((0,) * 2, True, None)]
    + [((0, 0, 1, 1), False, None), ((0,) * 9 + (1,), False, "care"), ((0, 0, 1, 2), False, "care")],
)
def test_modes_that_few_starts_led_to_are_doubted(ends, grown, severity):
    """With one mode, by the number of starts that led to it; with several, by those that are alone in one."""
    guide = _equal_modes(1).guide()
    modes = (Mode(np.zeros(3), np.eye(3), np.zeros(3), np.eye(3), 0.0, 0.0, True),) * len(set(ends))
    guide.search = ModeSearch(modes, ends + (-1,) * 12, 100.0, True, grown)
    found = [each for each in guide.findings if "not found" in each.text]
    assert [each.severity for each in found] == ([] if severity is None else [severity])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_curved_ridge_is_sampled_whole_or_doubted(seed):
    """Only a^2 + b^2 is identified: the posterior is a ring, and the Laplace approximation at one point is short."""
    time, channels = 0.02 * np.arange(200), [Channel("top", "displacement", "m")]

    def respond(theta):
        return np.cos(2.0 * np.pi * np.sqrt(1.0 + np.square(theta).sum()) * time)[None]

    model = FunctionModel(respond, ("a", "b"), channels, 0.02, 200, version="ring")
    noise = 0.02 * np.random.default_rng(5).standard_normal((1, 200))
    measured = Measurements(channels, 0.02, model.simulate(np.array([0.8, 0.6])) + noise)
    prior = {"a": Uniform(-2.0, 2.0), "b": Uniform(-2.0, 2.0), "sigma_top": Uniform(0.005, 0.5)}
    posterior = Posterior(FELikelihood(model, measured), prior)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        sampler = guided(posterior, 600, seed=seed, walkers=60)
    whole = np.allclose(sampler.get_chain(flat=True)[:, :2].std(axis=0), np.sqrt(0.5), rtol=0.2)
    assert whole or sampler.verdict.status != "converged"


def test_a_mode_that_fits_exactly_is_found_where_the_noise_is_known():
    model = FunctionModel(free_vibration, ["stiffness", "damping"], CHANNELS, DT, N_STEPS)
    exact = Measurements(CHANNELS, DT, model.simulate(np.array([1.0, 1.0])), "SYNTHETIC")
    prior = {"stiffness": Uniform(0.5, 1.5), "damping": Uniform(0.5, 1.5)}  # their medians fit exactly
    posterior = Posterior(FELikelihood(model, exact), prior | {"sigma_top": 2e-3, "sigma_base": 5.0})
    assert find_modes(posterior, seed=1).modes[0].parameters == pytest.approx([1.0, 1.0], abs=1e-3)


def test_a_failing_start_leads_nowhere_and_failing_steps_are_shortened():
    def fails_near_the_median(theta):
        if abs(theta[0] - 1.0) < 0.02 or theta[1] > 1.3:
            raise RuntimeError("diverged")
        return free_vibration(theta)

    search = find_modes(vibration(function=fails_near_the_median), starts=4, seed=2)
    assert search.ends[0] == -1 and len(search.modes) == 1
    assert search.modes[0].parameters == pytest.approx([1.2, 0.8], abs=0.05)


def test_a_model_that_needs_the_whole_record_is_searched_on_it():
    def needs_the_end(theta, phase):
        if phase[-1] < 0.9:
            raise RuntimeError("the record is too short")
        return late_response(theta, phase)

    search = find_modes(acts_late(respond=needs_the_end), starts=3, seed=1)
    assert search.modes and all(mode.converged for mode in search.modes)


def test_a_channel_that_is_at_rest_at_first_denies_no_part_of_the_record():
    time, channels = DT * np.arange(N_STEPS), (CHANNELS[0], Channel("roof", "displacement", "mm"))

    def pulse(theta):
        later = np.maximum(time - 2.0, 0.0)
        return np.stack([0.05 * np.sin(9.0 * np.sqrt(theta[0]) * each) for each in (time, later)])

    model = FunctionModel(pulse, ["stiffness"], channels, DT, N_STEPS)
    values = noisy(model, np.array([1.2]), np.array([2e-3, 2e-3])).values * np.array([time >= 0.0, time > 2.0])
    sigmas = {"sigma_top": HalfNormal(0.01), "sigma_roof": HalfNormal(0.01)}
    likelihood = FELikelihood(model, Measurements(channels, DT, values)).marginal(sigmas)
    search = find_modes(Posterior(likelihood, {"stiffness": TruncatedNormal(1.0, 0.3)}), seed=1)
    assert len(search.modes) == 1 and abs(search.modes[0].parameters[0] - 1.2) < 0.01


def test_a_search_in_which_everything_fails_finds_nothing():
    def fails(theta):
        raise RuntimeError("diverged")

    posterior = vibration(function=fails)
    search = find_modes(posterior, starts=3, seed=2)
    assert search.simulations == posterior.report()["simulations"]
    assert search.modes == () and set(search.ends) == {-1} and search.finished


@pytest.mark.slow
def test_parts_of_the_record_count_as_fractions():
    posterior = problems.isolated_bridge().marginal()
    search = find_modes(posterior, starts=4, seed=1)
    assert len(search.modes) == 1 and search.ends[0] == 0 and set(search.ends) <= {0, -1}
    whole = posterior.report()["simulations"]
    assert whole < search.simulations < 300


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_starts_that_differ_only_in_what_the_end_of_the_record_determines_stay_apart(seed):
    search = find_modes(acts_late(seed), seed=seed)
    assert sorted(round(float(mode.parameters[2])) for mode in search.modes) == [-1, 1]
    shares = [mode.log_evidence for mode in search.modes]
    assert shares[0] == pytest.approx(shares[1], abs=1.0)  # ascents stop when 0.5 is left to gain


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_search_leaves_the_axis_of_symmetry(seed, first):
    """The prior's median lies on it: a point without a gradient, lower than the modes on both sides."""
    search = find_modes(symmetric(first=first), seed=seed)
    assert sorted(round(mode.parameters[0], 1) for mode in search.modes) == [-1.2, 1.2]
    alone = find_modes(symmetric(first=first), starts=1, seed=seed)
    assert [round(abs(mode.parameters[0]), 1) for mode in alone.modes] == [1.2]


def test_later_starts_leave_the_mode_of_the_first_one():
    """Eight parameters, one of which acts by its square."""
    time = np.linspace(0.0, 1.0, 300)

    def respond(theta):
        linear = sum(a * np.sin((20.0 + 7.0 * j) * time + 0.3 * a * time) for j, a in enumerate(theta[1:]))
        return (linear + 0.3 * theta[0] ** 2 * np.cos(33.0 * time))[None]

    names = ["offset", *(f"a{j}" for j in range(7))]
    model = FunctionModel(respond, names, [Channel("top", "displacement", "mm")], DT, 300)
    prior = {name: TruncatedNormal(1.0, 0.3) for name in names}
    prior["offset"] = TruncatedNormal(0.0, 1.0, lower=-4.0, upper=4.0)
    simulations = []
    for seed in range(1, 5):
        measured = noisy(model, np.array([1.2, *np.linspace(0.8, 1.2, 7)]), np.array([0.1]), seed)
        posterior = Posterior(FELikelihood(model, measured), prior | {"sigma_top": HalfNormal(0.3)})
        search = find_modes(posterior.marginal(), seed=seed)
        assert sorted(round(mode.parameters[0]) for mode in search.modes) == [-1, 1]
        simulations.append(search.simulations)
    assert np.mean(simulations) < 140


def _rough(theta, size, key):
    """The response times 1 + `size` * jump, with an independent jump between -1 and 1 in each cell of a lattice.

    A cell is a 200th of the posterior's standard deviation of the stiffness, so that all steps of a search see
    independent jumps; a change of the last bit changes the cell of one point in 1e9. A sine of a large multiple of the
    parameters is as rough, but each step of a search multiplies the last bit by the multiple.
    """
    cells = np.floor(1e7 * np.asarray(theta)).astype(np.int64)
    digest = hashlib.blake2b(cells.tobytes() + bytes([key]), digest_size=4).digest()
    return free_vibration(theta) * (1.0 + size * (int.from_bytes(digest, "little") / 2.0**31 - 1.0))


@pytest.mark.slow
@pytest.mark.parametrize(("size", "cases", "most"), [(2e-4, 5, 3), (4e-4, 30, 13)])
def test_a_rough_likelihood_rarely_splits_a_mode_and_prolongs_no_search(size, cases, most):
    """Jumps of 2e-4 of the response are jumps of the log-density by about 0.5, and jumps of 4e-4 by 2.

    Two modes were found in 0 of 20 searches with 2e-4, and in 3 of 20 with 6e-4. If 5 % and 15 % are split, more than
    `most` are split with a probability below 1e-4.
    """
    smooth = find_modes(vibration(), seed=2).simulations
    searches = [find_modes(vibration(function=partial(_rough, size=size, key=k)), seed=k) for k in range(cases)]
    assert sum(len(search.modes) > 1 for search in searches) <= most
    assert np.median([search.simulations for search in searches]) < 2.0 * smooth


def test_an_end_that_fits_only_the_first_part_worse_is_kept():
    """The model is not exact in its first part: there another region fits better, which the rest excludes."""
    search = find_modes(misleading(), seed=1)
    assert search.modes[0].parameters[0] == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("noise", ["white", "marginal"])
def test_measurements_without_noise_have_no_posterior(noise):
    """The likelihood of a half-normal error grows without bound at the truth."""
    posterior = vibration(noise)
    likelihood = posterior.likelihood
    exact = noisy(likelihood.model, sd=np.zeros(2))
    with pytest.raises(ValueError, match="exactly at .*LogNormal"):
        find_modes(Posterior(FELikelihood(likelihood.model, exact, likelihood.noise), posterior.prior), seed=1)


def test_channels_of_very_different_sizes():
    """A displacement in metres with a small noise, and a force in newtons."""
    channels = (Channel("top", "displacement", "mm"), Channel("base", "force", "kN"))
    time = np.linspace(0.0, 1.0, 100)
    model = FunctionModel(
        lambda theta: [1e-5 * theta[0] * np.sin(9.0 * time), 1e7 * theta[0] * theta[1] * np.cos(7.0 * time)],
        ["a", "b"], channels, 0.01, 100,
    )  # fmt: skip
    noise = np.array([[5e-8], [5e4]]) * np.random.default_rng(1).standard_normal((2, 100))
    measured = Measurements(channels, 0.01, model.simulate(np.array([1.2, 0.9])) + noise)
    prior = {"a": Uniform(0.5, 2.0), "b": Uniform(0.5, 2.0), "sigma_top": Uniform(1e-9, 1e-6)}
    prior["sigma_base"] = Uniform(1e3, 1e6)
    mode = find_modes(Posterior(FELikelihood(model, measured), prior), starts=2, seed=1).modes[0]
    assert mode.converged and mode.parameters[:2] == pytest.approx([1.2, 0.9], rel=0.01)
