"""Kinds of the noise in the TOML file, independent runs, and damaged files of a run."""

import numpy as np
import pytest
import xarray
from click.testing import CliRunner

from fe_likelihoods import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.main import NOT_USABLE, main
from fe_likelihoods.command.make_posterior import make_problem
from tests.command.test_command import OSCILLATOR, ROOT, call, folder, write_oscillator  # noqa: F401

SIGMAS = 'sigma_acceleration = "half-normal(0.1 g)"\nsigma_displacement = "half-normal(5 mm)"\n'
PLAIN = OSCILLATOR.replace(SIGMAS, "")
SENSOR = 'sensor = {acceleration = "0.01 g", displacement = 0.001}\n'
SI = {"acceleration": 0.0980665, "displacement": 0.001}


def problem_of(folder, noise):  # noqa: F811
    (folder / "oscillator.toml").write_text(f"{PLAIN}[noise]\n{noise}")
    return make_problem(read_job("oscillator.toml"))


@pytest.mark.parametrize(
    ("keys", "parameters", "options"),
    [
        (SENSOR, "sigma_{}", {}),
        ('kind = "autoregressive"\n' + SENSOR, "sigma_{} rho_{}", {}),
        ('groups = "all"\n' + SENSOR, "sigma", {}),
        ('shares_of = "measured"\n', "share_{}", {"sensor": None, "window": None}),
        ('shares_of = "measured"\nwindow = "1.5 s"\n' + SENSOR, "share_{}", {"window": 1.5}),
        ('shares_of = "response"\nwindow = 1.0\nlocal = 0.5\n' + SENSOR, "share_{}", {"window": 1.0, "local": 0.5}),
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
            expected.append(pattern.replace("{}", channel))
    assert list(noise.parameter_names) == expected
    assert set(problem.assumed) == set(noise.parameter_names)
    point = problem.posterior.prior.mean()
    assert np.isfinite(likelihood.log_likelihood(point)) and np.isfinite(problem.posterior(point[None])).all()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('kind = "autoregresive"', "got 'autoregresive'; did you mean autoregressive?"),
        ('kind = "autoregressive"\ngroups = "all"', '[noise] groups: the kind "autoregressive" has no such key'),
        ('shares_of = "response"\nwindow = "1 g"\n' + SENSOR, "[noise] window: expected a number in s"),
        ("groups = true\n" + SENSOR, "[noise] groups: expected one of channel, all, event"),
        ('sensor = {acceleration = "1 mm"}', "[noise] sensor: acceleration: expected a number in m/s"),
        ('sensor = {accelaration = "1 g"}', "sensor: accelaration: unknown channel; did you mean acceleration?"),
        ('sensor = {acceleration = "-1 g"}', "[noise] sensor: acceleration: expected a standard deviation"),
        (
            'sensor = "1 g"',
            '[noise] sensor: expected a table of number with unit, such as {top = "0.01 g"}',
        ),
    ],
)
def test_wrong_keys_of_the_noise_are_named(folder, keys, message):  # noqa: F811
    (folder / "oscillator.toml").write_text(f"{PLAIN}[noise]\n{keys}\n")
    output = call("run", "oscillator.toml", "--quiet", code=1)
    assert output.startswith("Error: oscillator.toml: ") and message in output
    assert not (folder / "results-oscillator").exists()


def test_a_noise_without_a_guide_is_told_before_the_run(folder):  # noqa: F811
    (folder / "oscillator.toml").write_text(f'{PLAIN}[noise]\nshares_of = "response"\nwindow = "1 s"\n{SENSOR}')
    output = call("run", "oscillator.toml", "--quiet", code=1)
    assert "[sampler]" in output and "guide" in output and not (folder / "results-oscillator").exists()


@pytest.mark.slow
def test_independent_runs_are_chains(folder):  # noqa: F811
    chains = {}
    for name, keys in {"both": "chains = 2", "second": "seed = 2"}.items():
        changed = OSCILLATOR.replace("walkers = 20\nsteps = 2\nguide = true", f"walkers = 40\nsteps = 2\n{keys}")
        (folder / "oscillator.toml").write_text(changed)
        result = CliRunner().invoke(main, ["run", "oscillator.toml", "--quiet", "--out", name])
        assert result.exit_code in (0, NOT_USABLE), result.output
        with xarray.open_dataset(f"{name}/posterior.nc", group="posterior") as stored:
            chains[name] = stored["stiffness"].values
    assert chains["both"].shape[0] == 2 and chains["second"].shape[0] == 1
    np.testing.assert_array_equal(chains["both"][1], chains["second"][0])
    assert not np.array_equal(*chains["both"])
    summary = (folder / "both" / "summary.txt").read_text()
    assert "2 independent runs: r_hat at most" in summary and "log-evidences" in summary
    CliRunner().invoke(main, ["report", "both"])
    assert (folder / "both" / "summary.txt").read_text() == summary


def test_a_damaged_file_of_a_run_is_named(folder):  # noqa: F811
    """A damaged chain is made again from its record (tests of the samplers)."""
    write_oscillator(folder)
    (folder / "oscillator.toml").write_text(OSCILLATOR)
    CliRunner().invoke(main, ["run", "oscillator.toml", "--quiet", "--out", "r"])
    for name in ("origin.json", "settings.toml"):
        path = folder / "r" / name
        whole = path.read_bytes()
        path.write_bytes(damaged := whole[: len(whole) // 2])
        said = call("run", "oscillator.toml", "--quiet", "--out", "r", code=1)
        assert f"{name}" in said and "in r is damaged (" in said
        assert name in call("report", "r", code=1) and path.read_bytes() == damaged
        path.write_bytes(whole)
