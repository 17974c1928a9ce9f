"""Kinds of the noise and emcee's sampler in the TOML file."""

import contextlib
import csv
import shutil

import emcee
import numpy as np
import pytest
import xarray
from click.testing import CliRunner

from fe_likelihoods import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.main import NOT_USABLE, main
from fe_likelihoods.command.models import make_problem
from tests.command.test_command import OSCILLATOR, ROOT, call, folder, write_oscillator  # noqa: F401
from tests.reporting.report_page import read_page

SIGMAS = 'sigma_acceleration = "half-normal(0.1 g)"\nsigma_displacement = "half-normal(5 mm)"\n'
PLAIN = OSCILLATOR.replace(SIGMAS, "")
SENSOR = 'sensor = {acceleration = "0.01 g", displacement = 0.001}\n'
SI = {"acceleration": 0.0980665, "displacement": 0.001}
EMCEE = OSCILLATOR.replace("walkers = 20\nsteps = 2\nguide = true", 'kind = "emcee"\nwalkers = 16\nsteps = 60')


def problem_of(folder, noise):  # noqa: F811
    (folder / "oscillator.toml").write_text(f"{PLAIN}[noise]\n{noise}")
    return make_problem(read_job("oscillator.toml"))


@pytest.mark.parametrize(
    ("keys", "parameters", "options"),
    [
        (SENSOR, "sigma_{}", {}),
        ('kind = "autoregressive"\n' + SENSOR, "sigma_{} rho_{}", {}),
        ('groups = "all"\n' + SENSOR, "sigma", {}),
        ('level = "measured"\n', "share_{}", {"sensor": None, "window": None}),
        ('level = "measured"\nwindow = "1.5 s"\n' + SENSOR, "share_{}", {"window": 1.5}),
        ('level = "response"\nwindow = 1.0\nlocal = 0.5\n' + SENSOR, "share_{}", {"window": 1.0, "local": 0.5}),
        ('groups = [1.0, 5.0]\nlevel = "response"\n' + SENSOR, "share_{}_band{1,2,3}", {"groups": (1.0, 5.0)}),
        ("groups = [2.0]\n", "sigma_{}_band{1,2}", {"sensor": None, "groups": (2.0,)}),
    ],
)
def test_noises_are_those_of_python(folder, keys, parameters, options):  # noqa: F811
    problem = problem_of(folder, keys)
    noise, likelihood = problem.posterior.likelihood.noise, problem.posterior.likelihood
    assert isinstance(noise, AutoregressiveNoise if "kind" in keys else GaussianNoise)
    for name, value in ({"sensor": (SI["acceleration"], SI["displacement"])} | options).items():
        assert getattr(noise, name) == (value if name != "sensor" or value is None else pytest.approx(value))
    expected = []
    for pattern in parameters.split():
        for channel in SI if "{}" in pattern else [""]:
            name, _, bands = pattern.replace("{}", channel).partition("{")
            expected += [name + band for band in bands.strip("}").split(",")]
    assert list(noise.parameter_names) == expected
    assert set(problem.assumed) == set(noise.parameter_names)
    point = problem.posterior.prior.mean()
    assert np.isfinite(likelihood.log_likelihood(point)) and np.isfinite(problem.posterior(point[None])).all()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('kind = "autoregresive"', "got 'autoregresive'; did you mean autoregressive?"),
        ('kind = "autoregressive"\ngroups = "all"', '[noise] groups: the kind "autoregressive" has no such key'),
        ('level = "response"\nwindow = "1 g"\n' + SENSOR, "[noise] window: expected a number in s"),
        ("groups = true\n" + SENSOR, "[noise] groups: expected a text in quotes, or a list of numbers"),
        ('marginal = true\nlevel = "measured"', "[noise] marginal() integrates out the standard deviations"),
        ('sensor = {acceleration = "1 mm"}', "[noise] sensor: acceleration: expected a number in m/s"),
        ('sensor = {accelaration = "1 g"}', "sensor: unknown channel 'accelaration'; did you mean acceleration?"),
        ('sensor = {acceleration = "-1 g"}', "[noise] sensor: acceleration: expected a standard deviation"),
        ('sensor = "1 g"', '[noise] sensor: expected numbers with units by name, such as {top = "0.01 g"}'),
    ],
)
def test_wrong_keys_of_the_noise_are_named(folder, keys, message):  # noqa: F811
    (folder / "oscillator.toml").write_text(f"{PLAIN}[noise]\n{keys}\n")
    output = call("run", "oscillator.toml", "--quiet", code=1)
    assert output.startswith("Error: oscillator.toml: ") and message in output
    assert not (folder / "results-oscillator").exists()


def test_a_noise_without_a_guide_is_told_before_the_run(folder):  # noqa: F811
    (folder / "oscillator.toml").write_text(f'{PLAIN}[noise]\nlevel = "response"\nwindow = "1 s"\n{SENSOR}')
    output = call("run", "oscillator.toml", "--quiet", code=1)
    assert "[sampler]" in output and "guide" in output and not (folder / "results-oscillator").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "sampler", ['kind = "smc"\nwalkers = 40\nsteps = 2', 'kind = "emcee"\nwalkers = 16\nsteps = 60']
)
def test_independent_runs_are_chains(folder, sampler):  # noqa: F811
    chains = {}
    for name, keys in {"both": "chains = 2", "second": "seed = 2"}.items():
        changed = OSCILLATOR.replace("walkers = 20\nsteps = 2\nguide = true", f"{sampler}\n{keys}")
        (folder / "oscillator.toml").write_text(changed)
        result = CliRunner().invoke(main, ["run", "oscillator.toml", "--quiet", "--out", name])
        assert result.exit_code in (0, NOT_USABLE), result.output
        with xarray.open_dataset(f"{name}/posterior.nc", group="posterior") as stored:
            chains[name] = stored["stiffness"].values
    assert chains["both"].shape[0] == 2 and chains["second"].shape[0] == 1
    np.testing.assert_array_equal(chains["both"][1], chains["second"][0])
    assert not np.array_equal(*chains["both"])
    summary = (folder / "both" / "summary.txt").read_text()
    assert "2 independent runs: r_hat at most" in summary and ("log-evidences" in summary) == ("smc" in sampler)
    CliRunner().invoke(main, ["report", "both"])
    assert (folder / "both" / "summary.txt").read_text() == summary


@pytest.mark.slow
def test_emcee_runs_and_goes_on_with_more_steps(folder):  # noqa: F811
    (folder / "oscillator.toml").write_text(EMCEE)
    assert "emcee makes 976 simulations" in call("check", "oscillator.toml")
    said = call("run", "oscillator.toml", "--quiet", "--out", "parts", code=3)
    assert "emcee gives neither an evidence nor a verdict" in said and "Not usable: the chain is shorter" in said
    assert "stages.txt" not in said and "report.html" in said and (folder / "parts" / "posterior.nc").is_file()
    assert "The chain is short" in read_page(folder / "parts" / "report.html").notes
    with open("parts/summary.csv", newline="") as file:
        rows = {row["parameter"]: row for row in csv.DictReader(file)}
    chain = emcee.backends.HDFBackend("parts/run.h5").get_chain(flat=True, discard=30)
    assert float(rows["stiffness [x nominal]"]["mean"]) == pytest.approx(chain[:, 0].mean(), rel=1e-9)
    (folder / "oscillator.toml").write_text(EMCEE.replace("steps = 60", "steps = 90\ndiscard = 50"))
    call("run", "oscillator.toml", "--quiet", "--out", "parts", code=3)
    call("run", "oscillator.toml", "--quiet", "--out", "whole", code=3)
    chains = [emcee.backends.HDFBackend(f"{name}/run.h5").get_chain() for name in ("parts", "whole")]
    assert chains[0].shape == (90, 16, 4)
    np.testing.assert_array_equal(*chains)
    assert (folder / "parts" / "summary.csv").read_text() == (folder / "whole" / "summary.csv").read_text()
    call("report", "parts", code=0)
    (folder / "oscillator.toml").write_text(EMCEE.replace("walkers = 16", "walkers = 18"))
    assert "[sampler] walkers differ" in call("run", "oscillator.toml", "--out", "parts", code=1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("steps = 60", "", "[sampler] steps: this key is missing; emcee needs the number of its iterations"),
        ("walkers = 16", "walkers = 15", "emcee needs an even number of 8 walkers or more, two per parameter; got 15"),
        ("steps = 60", "steps = 60\nguide = true", "[sampler] guide: emcee has no such setting"),
        ("steps = 60", "steps = 60\ndiscard = 60", "[sampler] discard: expected fewer than steps = 60; got 60"),
        ('kind = "emcee"', 'kind = "smc"\ndiscard = 3', "[sampler] discard: smc has no burn-in"),
        ('kind = "emcee"', 'kind = "mcmc"', "[sampler] kind: expected one of smc, tmcmc, emcee"),
        (
            "[prediction]",
            "[budget]\nmax_simulations = 90\n[prediction]",
            "[budget] max_simulations: emcee makes walkers",
        ),
    ],
)
def test_wrong_settings_of_emcee_are_named(folder, old, new, message):  # noqa: F811
    assert old in EMCEE
    (folder / "oscillator.toml").write_text(EMCEE.replace(old, new, 1))
    assert message in call("run", "oscillator.toml", "--quiet", code=1)
    assert not (folder / "results-oscillator").exists()


@pytest.fixture(scope="module")
def two_steps(tmp_path_factory):
    """A folder with the files in `r` of a run of two steps, and what the run said; tests copy it."""
    path = tmp_path_factory.mktemp("two_steps")
    write_oscillator(path)
    (path / "oscillator.toml").write_text(EMCEE.replace("steps = 60", "steps = 2"))
    with contextlib.chdir(path):
        return path, call("run", "oscillator.toml", "--quiet", "--out", "r", code=3)


@pytest.mark.parametrize("steps", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_chain_of_few_steps_is_told_after_its_tables(folder, steps, two_steps):  # noqa: F811
    """The autocorrelation time of so few steps is not a number."""
    folder, said = two_steps if steps == 2 else (folder, "")
    if steps == 1:
        (folder / "oscillator.toml").write_text(EMCEE.replace("steps = 60", "steps = 1"))
        said = call("run", "oscillator.toml", "--quiet", "--out", "r", code=3)
    assert "too few to estimate the autocorrelation time" in said and "Give more `steps`" in said
    assert "nan" not in said and (folder / "r" / "report.html").is_file()


@pytest.mark.parametrize(
    "name", ["run.h5", *(pytest.param(name, marks=pytest.mark.slow) for name in ("origin.json", "settings.toml"))]
)
def test_a_damaged_file_of_a_run_is_named(folder, name, two_steps):  # noqa: F811
    shutil.copytree(two_steps[0], folder, dirs_exist_ok=True)
    path = folder / "r" / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    before = path.read_bytes()
    said = call("run", "oscillator.toml", "--quiet", "--out", "r", code=1)
    assert f"r/{name} is damaged (" in said and "--overwrite" in said
    assert name in call("report", "r", code=1) and path.read_bytes() == before
    call("run", "oscillator.toml", "--quiet", "--out", "r", "--overwrite", code=3)
