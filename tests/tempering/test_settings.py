"""A setting changes the run or is refused: it is never ignored."""

import re
from dataclasses import fields, replace

import emcee
import numpy as np
import pytest

from samplers import (
    CHING_CHEN_2007,
    RAMANCHA_2022_LITERAL,
    GuidedSettings,
    MixtureMove,
    RecyclingSettings,
    Settings,
    SMCSampler,
    TemperedSampler,
    TMCMCSampler,
)
from tests.contract.targets import Box, Gaussian
from tests.simulated_cluster import SimulatedCluster

PATHS = {
    "recycling": (SMCSampler, {"recycle": True}),
    "closing sweeps": (SMCSampler, {"recycle": True, "recycling": RecyclingSettings(closing_sweeps=True)}),
    "moves": (SMCSampler, {"recycle": False}),
    "equal chains": (TMCMCSampler, {}),
    "chains from leaders": (TMCMCSampler, {"chains": "leaders"}),
    "leaders, recycling": (
        TemperedSampler,
        {"chains": "leaders", "recycle": True, "recycling": RecyclingSettings(closing_sweeps=True)},
    ),
}
# per setting: another value, and what else is given so that it can act at all
CHANGES = {
    "ess_ratio": (0.8, {}),
    "ess_rule": ("declining", {}),
    "ess_floor": (30.0, {"ess_rule": "declining"}),
    "coefficient_of_variation": (0.5, {}),
    "resampling": ("multinomial", {}),
    "min_moves": (7, {}),
    "max_moves": (3, {"max_correlation": 1e-6}),
    "max_correlation": (1e-6, {}),
    "chains": ("leaders", {}),
    "burn_in": (2, {"chains": "leaders"}),
    "fast_sweeps": (4, {}),
    "recycle": (None, {}),  # the other value than that of the path
    "recycling": (RecyclingSettings(target_share=0.6), {}),
    "runs": (2, {}),
    "guided": (GuidedSettings(trusted_share=0.6), {}),
    "check_draws": (0, {}),
    "max_failure_share": (0.0, {}),
    "asynchronous": (True, {}),
}
ACTS = {
    "recycling": {"fast_sweeps", "recycle", "recycling", "runs", "check_draws", "asynchronous"},
    "closing sweeps": {"min_moves", "max_moves", "max_correlation", "fast_sweeps"}
    | {"recycling", "runs", "check_draws", "asynchronous"},
    "moves": {"ess_ratio", "ess_rule", "ess_floor", "resampling", "min_moves", "max_moves", "max_correlation"}
    | {"fast_sweeps", "recycle", "check_draws"},
    "equal chains": {"coefficient_of_variation", "resampling", "min_moves", "max_moves", "max_correlation", "chains"}
    | {"burn_in", "fast_sweeps", "check_draws"},
    "chains from leaders": {"coefficient_of_variation", "resampling", "burn_in", "fast_sweeps", "check_draws"},
    "leaders, recycling": {"burn_in", "fast_sweeps", "recycling", "runs", "check_draws", "asynchronous"},
}


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_docstring_lists_every_setting_with_its_default(Sampler):
    entries = re.findall(r"^ {4}(\w+) : (.*)$", Sampler.__doc__, re.MULTILINE)
    stated = {
        name: None if kind.endswith(", optional") else eval(kind.split(", default ")[1])
        for name, kind in entries
        if name in CHANGES
    }
    usable = set(CHANGES) - set(Sampler.unused_settings) - ({"recycle"} if Sampler is TMCMCSampler else set())
    assert stated == {field.name: field.default for field in fields(Settings) if field.name in usable}


class Target(Gaussian):
    """A sharp Gaussian with a fast parameter; optionally, some of its points fail."""

    fast_parameters = (2,)

    def __init__(self, fails=False, **target):
        super().__init__(**target)
        self.fails = fails

    def __call__(self, x):
        log_prob = super().__call__(x)
        return np.where(x[..., 1] < -1.5, np.nan, log_prob)[()] if self.fails else log_prob


def outcome(Sampler, posterior=None, nwalkers=60, **kwargs):
    """Everything that a run returns except wall times; the error of a run that stops."""
    posterior = Target(sd=0.02) if posterior is None else posterior
    sampler = Sampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=3, **kwargs)
    try:
        sampler.run_mcmc(None, 1)
    except RuntimeError as error:
        return str(error)
    stages = [stage._replace(seconds=0.0) for stage in sampler.ladder]
    return sampler.get_chain().tobytes(), stages, sampler.log_evidence_check


class TwoModes(Box):
    """Modes of very different widths, and failing points between them."""

    def __init__(self):
        super().__init__([0, 0], [1, 1], self._log_likelihood)

    def _log_likelihood(self, x):
        wide, narrow = (np.sum(((x - centre) / width) ** 2, axis=-1) for centre, width in ((0.3, 0.1), (0.8, 0.03)))
        return np.logaddexp(-0.5 * wide, 3.0 - 0.5 * narrow)


RECYCLING_CHANGES = {
    "target_share": (0.6, {}),
    "points_per_dimension": (10.0, {}),
    "draws_per_target": (2.0, {}),
    "fresh_share": (1.0, {}),
    "max_components": (1, {}),
    "even_share": (0.0, {}),
    "max_basins": (0, {}),
    "basin_share": (0.3, {}),
    "search_draws": (1.0, {}),
    "max_basin_rounds": (0, {}),
    "draws_per_basin": (5, {}),
    "min_yield": (0.99, {"patience": 2}),
    "patience": (2, {"min_yield": 0.99}),
    "max_rounds": (2, {}),
    "max_checks": (1, {"max_evidence_difference": 0.0}),
    "trusted_yield": (0.95, {}),
    "high_yield": (1.0, {}),
    "max_evidence_difference": (0.0, {}),
    "closing_sweeps": (True, {}),
}


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("name", [field.name for field in fields(RecyclingSettings)])
def test_every_constant_of_the_recycling_changes_the_run(name):
    value, needed = RECYCLING_CHANGES[name]
    nwalkers = 24 if name == "high_yield" else 100  # so few that the shape of the tail is unknown
    plain = RecyclingSettings(**needed)
    posterior = Gaussian(6, sd=1e-3) if name == "fresh_share" else TwoModes()  # sharp, so that draws are worth little
    runs = [
        outcome(SMCSampler, posterior, nwalkers, recycle=True, recycling=settings)
        for settings in (plain, replace(plain, **{name: value}))
    ]
    assert runs[0] != runs[1]


@pytest.mark.parametrize(
    "settings",
    [
        {"target_share": 0.0},
        {"fresh_share": 1.1},
        {"even_share": -0.1},
        {"patience": 0},
        {"max_components": 1.5},
        {"max_basins": -1},
        {"basin_share": 1.1},
        {"search_draws": -1.0},
        {"search_draws": np.inf},
        {"search_draws": "3"},
        {"max_basin_rounds": 0.5},
        {"draws_per_basin": 0},
        {"points_per_dimension": 0.0},
        {"draws_per_target": 0.0},
        {"closing_sweeps": 1},
        {"max_evidence_difference": -1.0},
    ],
    ids=str,
)
def test_impossible_constants_of_the_recycling(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        RecyclingSettings(**settings)


def test_the_changes_cover_all_settings():
    assert set(CHANGES) == {field.name for field in fields(Settings)}


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", CHANGES)
def test_a_setting_changes_the_run_or_is_refused(name, path):
    Sampler, given = PATHS[path]
    value, needed = CHANGES[name]
    value = not given.get("recycle", False) if name == "recycle" else value
    posterior = Target(sd=0.02, fails=name == "max_failure_share")
    if name == "asynchronous":  # on five workers, of which the one with the longest run is the last
        posterior = SimulatedCluster(posterior, 5, lambda x: 2.0 + np.cos(50.0 * x[:, 0]))
    if name in needed or given.get(name) == value:
        pytest.skip("the path has this value")
    try:
        # the correlations of few walkers are so large by chance that all sweeps are made
        walkers = 150 if path == "closing sweeps" else 60
        plain = outcome(Sampler, posterior, walkers, **given | needed)
        changed = outcome(Sampler, posterior, walkers, **given | needed | {name: value})
    except ValueError as error:
        assert "cannot act here" in str(error) and any(word in str(error) for word in (name, *needed))
        acts = False
    else:
        assert plain != changed
        acts = True
    assert acts == (name in ACTS[path] or name == "max_failure_share")


@pytest.mark.parametrize("settings", [{"ess_ratio": 0.95}, {"resampling": "multinomial"}, {"ess_rule": "declining"}])
def test_settings_of_moves_with_300_walkers_are_refused_with_advice(settings):
    """From 250 walkers on recycling is the default, and these would act only if it failed."""
    with pytest.raises(ValueError, match="pass recycle=False"):
        SMCSampler(300, 3, Gaussian(), vectorize=True, **settings)
    SMCSampler(300, 3, Gaussian(), vectorize=True, recycle=False, **settings)


@pytest.mark.parametrize(
    "settings, match",
    [
        ({"check_draws": 50, "recycle": True}, "check_draws"),
        ({"max_correlation": 0.1, "min_moves": 5, "max_moves": 5}, "never decides"),
        ({"fast_sweeps": 5}, "no fast_parameters"),
        ({"chains": "leaders"}, "TMCMCSampler"),
        ({"ess_ratio": 0.6, "coefficient_of_variation": 2.0}, "cannot act here"),
    ],
    ids=str,
)
def test_more_that_cannot_act(settings, match):
    with pytest.raises(ValueError, match=match):
        SMCSampler(60, 3, Gaussian(), vectorize=True, **settings)


@pytest.mark.parametrize(
    "settings",
    [
        {"check_draws": 2.5},
        {"check_draws": True},
        {"burn_in": 1.5},
        {"min_moves": 2.0},
        {"max_moves": 5.5},
        {"fast_sweeps": True},
        {"recycling": {"patience": True}},
        {"recycle": "no"},
        {"recycle": 1},
    ],
    ids=str,
)
def test_a_setting_of_another_type_is_refused(settings):
    name = next(iter(settings))
    with pytest.raises(ValueError, match="patience" if name == "recycling" else name):
        Settings(**{k: RecyclingSettings(**v) if k == "recycling" else v for k, v in settings.items()})


@pytest.mark.parametrize(("nwalkers", "ndim"), [(60.0, 3), (60, 3.0), (60, True), ("60", 3)])
def test_the_size_of_the_ensemble_is_whole_numbers(nwalkers, ndim):
    posterior = Gaussian()
    with pytest.raises(ValueError, match="must be a whole number"):
        SMCSampler(nwalkers, ndim, posterior)
    assert posterior.calls == 0


def test_numpy_numbers_are_settings(tmp_path):
    """They are stored in the journal too, which is JSON."""
    whole = np.int64
    sampler = SMCSampler(
        whole(60),
        whole(3),
        Gaussian(),
        vectorize=True,
        min_moves=whole(2),
        max_moves=np.uint8(5),
        check_draws=whole(30),
        recycle=np.False_,
        backend=emcee.backends.HDFBackend(str(tmp_path / "run.h5")),
    )
    sampler.run_mcmc(None, 1)
    assert sampler.settings == Settings(max_moves=5, check_draws=30, recycle=False)
    assert type(sampler.settings.max_moves) is int and sampler.settings.recycle is False


@pytest.mark.parametrize(
    "moves",
    [
        emcee.moves.StretchMove(),
        [emcee.moves.GaussianMove(0.01), emcee.moves.DEMove()],
        [(emcee.moves.GaussianMove(0.01), 0.9), (emcee.moves.DESnookerMove(), 0.1)],
    ],
    ids=["stretch", "list", "weighted"],
)
def test_chains_from_leaders_refuse_moves_of_several_walkers(moves):
    with pytest.raises(ValueError, match='need several walkers.*chains="equal"'):
        TMCMCSampler(60, 3, Gaussian(), chains="leaders", moves=moves)
    TMCMCSampler(60, 3, Gaussian(), moves=moves)


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_chains_from_leaders_take_other_moves_of_emcee():
    _, stages, _ = outcome(TMCMCSampler, chains="leaders", moves=emcee.moves.GaussianMove(1e-4))
    assert stages[-1].beta == 1.0


def test_settings_as_an_object_as_keywords_and_as_a_preset():
    expected = outcome(SMCSampler, ess_ratio=0.7, max_moves=4)
    assert outcome(SMCSampler, settings=Settings(ess_ratio=0.7, max_moves=4)) == expected
    assert outcome(SMCSampler, settings=Settings(ess_ratio=0.3, max_moves=4), ess_ratio=0.7) == expected
    sampler = SMCSampler(300, 3, Gaussian(), **RAMANCHA_2022_LITERAL)
    assert sampler.settings == Settings(
        recycle=False, **{k: v for k, v in RAMANCHA_2022_LITERAL.items() if k in CHANGES and k != "recycle"}
    )
    assert TMCMCSampler(300, 3, Gaussian(), **CHING_CHEN_2007).settings.chains == "leaders"
    with pytest.raises(TypeError, match="unexpected keyword argument 'essratio'.*ess_ratio"):
        SMCSampler(60, 3, Gaussian(), essratio=0.7)
    with pytest.raises(ValueError, match="settings must be"):
        SMCSampler(60, 3, Gaussian(), settings={"ess_ratio": 0.7})


def test_a_coefficient_of_variation_of_one_is_an_ess_ratio_of_a_half():
    assert outcome(TMCMCSampler) == outcome(TMCMCSampler, coefficient_of_variation=1.0)
    assert outcome(TMCMCSampler) == outcome(TemperedSampler, moves=MixtureMove(), ess_ratio=0.5)


def test_defaults_of_the_samplers():
    posterior, moves = Gaussian(), emcee.moves.StretchMove()
    assert TMCMCSampler(300, 3, posterior).settings == replace(Settings(), recycle=False)
    assert SMCSampler(300, 3, posterior).settings == replace(Settings(), recycle=True)
    assert SMCSampler(300, 3, posterior, moves=moves).settings == replace(Settings(), recycle=False)
