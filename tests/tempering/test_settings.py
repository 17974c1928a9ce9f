"""Every setting that a sampler has changes its run; a setting that it does not have, or that cannot act, is refused."""

import functools
from dataclasses import replace

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_LITERAL
from samplers.settings import Settings
from samplers.smc import BURN_IN
from tests.contract.targets import Gaussian
from tests.simulated_cluster import SimulatedCluster

PATHS = {
    "recycling": (SMCSampler, {"recycle": True}),
    "moves": (SMCSampler, {"recycle": False}),
    "equal chains": (TMCMCSampler, {"chains": "equal"}),
    "chains from leaders": (TMCMCSampler, {"chains": "leaders"}),
}
# per setting: another value, and what else is given so that it can act at all
CHANGES = {
    "ess_ratio": (0.8, {}),
    "ess_floor": (10.0, {}),
    "resampling": ("multinomial", {}),
    "min_moves": (7, {}),
    "max_moves": (3, {"max_correlation": 1e-6}),
    "max_correlation": (1e-6, {}),
    "chains": ("leaders", {}),
    "burn_in": (3, {"chains": "leaders"}),
    "fast_sweeps": (4, {}),
    "recycle": (None, {}),  # the other value than that of the path
    "max_failure_share": (0.0, {}),
    "asynchronous": (True, {}),
}
ACTS = {
    "recycling": {"fast_sweeps", "recycle", "asynchronous"},
    "moves": {"ess_ratio", "ess_floor", "resampling", "min_moves", "max_moves", "max_correlation"}
    | {"fast_sweeps", "recycle"},
    "equal chains": {"ess_ratio", "resampling", "min_moves", "max_moves", "max_correlation", "chains"}
    | {"burn_in", "fast_sweeps"},
    "chains from leaders": {"ess_ratio", "resampling", "burn_in", "fast_sweeps"}
    | {"min_moves", "max_moves", "max_correlation"},
}


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
    sampler = Sampler(nwalkers, posterior.ndim, posterior, **{"vectorize": True, "seed": 3, **kwargs})
    try:
        sampler.run_mcmc(None, 1)
    except RuntimeError as error:
        return str(error)
    stages = [stage._replace(seconds=0.0) for stage in sampler.ladder]
    return sampler.get_chain().tobytes(), stages, sampler.log_evidence_check


@functools.cache
def usual(path, needed):
    """The outcome of a run without another setting."""
    Sampler, given = PATHS[path]
    return outcome(Sampler, **given | dict(needed))


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize(("path", "name"), [(path, name) for path in PATHS for name in sorted(ACTS[path])])
def test_a_setting_changes_the_run(name, path):
    Sampler, given = PATHS[path]
    value, needed = CHANGES[name]
    value = not given.get("recycle", False) if name == "recycle" else value
    posterior, before = Target(sd=0.02), usual(path, tuple(needed.items()))
    if name == "asynchronous":  # on five workers, of which the one with the longest run is the last
        given = given | {"pool": SimulatedCluster(5, lambda x: 2.0 + np.cos(50.0 * x[0])), "vectorize": False}
        before = outcome(Sampler, posterior, **given)
    assert outcome(Sampler, posterior, **given | needed | {name: value}) != before


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("path", PATHS)
def test_the_share_of_failures_stops_the_run(path):
    Sampler, given = PATHS[path]
    stopped, finished = (
        outcome(Sampler, Target(sd=0.02, fails=True), max_failure_share=s, **given) for s in (0.0, 1.0)
    )
    assert isinstance(stopped, str) and not isinstance(finished, str)


@pytest.mark.parametrize(
    ("Sampler", "settings", "match"),
    [
        (SMCSampler, {"asynchronous": True, "recycle": False}, "asynchronous=True cannot act here"),
        (SMCSampler, {"ess_floor": 60.0}, "must be below nwalkers=60"),
        (SMCSampler, {"pool": 4}, "pool must be an object with a method map"),
        (SMCSampler, {"backend": "run.h5"}, "backend must be a backend of emcee"),
        (TMCMCSampler, {"seed": 1.5}, "seed must be a whole number"),
        (SMCSampler, {"parameter_names": ["a", "a", "b"], "vectorize": False}, "a list of 3 different names"),
        (SMCSampler, {"parameter_names": ["a", "b", "c"]}, "names with their indices, with vectorize=False"),
        (TMCMCSampler, {"burn_in": 2, "chains": "equal"}, 'chains="leaders"'),
        (TMCMCSampler, {"chains": "leaders", "moves": emcee.moves.StretchMove()}, 'several walkers.*chains="equal"'),
        (TMCMCSampler, {"chains": "leaders", "moves": [(emcee.moves.DEMove(), 1.0)]}, "need several walkers"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_a_setting_that_cannot_act_is_refused(Sampler, settings, match):
    with pytest.raises(ValueError, match=match):
        Sampler(60, 3, Gaussian(), **{"vectorize": True} | settings)


@pytest.mark.parametrize(
    "settings",
    [
        *({"ess_ratio": value} for value in (0.0, 1.0, np.nan)),
        *({name: value} for name in ("fast_sweeps",) for value in (-1, 1.5, True)),
        {"ess_floor": -1.0},
        {"resampling": "wheel"},
        {"min_moves": 0},
        {"min_moves": 2.0},
        {"min_moves": 5, "max_moves": 4},
        {"max_correlation": 0.0},
        {"chains": "long"},
        {"burn_in": -1},
        {"burn_in": 1.5},
        {"recycle": "no"},
        {"recycle": 1},
    ],
    ids=str,
)
def test_an_impossible_setting_is_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Settings(**settings)


@pytest.mark.parametrize(("nwalkers", "ndim"), [(60.0, 3), (60, 3.0), (60, True), ("60", 3)])
def test_the_size_of_the_ensemble_is_whole_numbers(nwalkers, ndim):
    posterior = Gaussian()
    with pytest.raises(ValueError, match="must be a whole number"):
        SMCSampler(nwalkers, ndim, posterior)
    assert posterior.calls == 0


def test_numpy_numbers_are_settings(tmp_path):
    """They are stored in the record too, as JSON."""
    whole = np.int64
    sampler = SMCSampler(
        whole(60),
        whole(3),
        Gaussian(),
        vectorize=True,
        min_moves=whole(2),
        max_moves=np.uint8(5),
        recycle=np.False_,
        backend=emcee.backends.HDFBackend(str(tmp_path / "run.h5")),
    )
    sampler.run_mcmc(None, 1)
    assert sampler.settings == Settings(max_moves=5, recycle=False)
    assert type(sampler.settings.max_moves) is int and sampler.settings.recycle is False


def test_settings_as_keywords_and_as_a_preset():
    sampler = SMCSampler(300, 3, Gaussian(), **RAMANCHA_2022_LITERAL)
    assert sampler.settings == Settings(
        recycle=False, **{k: v for k, v in RAMANCHA_2022_LITERAL.items() if k in CHANGES and k != "recycle"}
    )
    assert TMCMCSampler(300, 3, Gaussian(), **CHING_CHEN_2007).settings.chains == "leaders"
    with pytest.raises(TypeError, match="unexpected keyword argument 'essratio'.*vectorize.*guide.*ess_ratio"):
        SMCSampler(60, 3, Gaussian(), essratio=0.7)


def test_defaults_of_the_samplers():
    posterior, moves = Gaussian(), emcee.moves.StretchMove()
    leaders = replace(Settings(), recycle=False, chains="leaders", burn_in=BURN_IN)
    assert TMCMCSampler(300, 3, posterior).settings == leaders
    assert TMCMCSampler(300, 3, posterior, moves=moves).settings == replace(Settings(), recycle=False)
    assert SMCSampler(6, 3, posterior).settings == replace(Settings(), recycle=True)
    for settings in ({"ess_ratio": 0.95}, {"resampling": "multinomial"}):
        assert not SMCSampler(300, 3, posterior, **settings).settings.recycle
    assert SMCSampler(300, 3, posterior, moves=moves).settings == replace(Settings(), recycle=False)
