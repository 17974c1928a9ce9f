"""A column of one's own: files with gaps and other times than the record, and the column of the template."""

import numpy as np
import pytest

from fe_likelihoods import Record, problems
from fe_likelihoods.command.job import parse_job, read_job
from fe_likelihoods.command.make_posterior import make_problem
from tests.command.test_command import ROOT

COLUMN = """
[model]
kind = "column"
height = "5000 mm"
mesh = 10
[model.concrete]
ec = "3320 ksi"
[record]
file = "base.csv"
units = "m/s2"
scale = 1.1
[measurements]
file = "top.csv"
columns = {displacement = "top [mm]"}
[priors]
Ec = "normal(1, 0.2)"
Es = "normal(1, 0.2)"
a0 = "normal(1, 0.6)"
a1 = "normal(1, 0.6)"
ft = "normal(1, 0.4)"
"""


@pytest.fixture
def column(tmp_path):
    """A function that writes a record of 2 s, the rows of measurements and a TOML file, and returns the problem."""
    record = Record("base", 0.01, np.sin(0.1 * np.arange(201)))
    base = [f"{t:.2f},{a!r}" for t, a in zip(record.time, record.acceleration.tolist(), strict=True)]
    (tmp_path / "base.csv").write_text("\n".join(["time_s,acc", *base]))

    def problem(rows: list[str], text: str = COLUMN, unit: str = "mm"):
        (tmp_path / "top.csv").write_text("\n".join([f"time_s,top [{unit}]", *rows]))
        (tmp_path / "own.toml").write_text(text)
        return make_problem(read_job(tmp_path / "own.toml"))

    return problem


def test_a_column_of_ones_own(column):
    found = column([f"{0.01 * k:.2f},{k % 89}" for k in range(201)])
    model = found.posterior.likelihood.model
    assert model.height == 5.0 and model.analysis.mesh == 10 and model.cover == pytest.approx(0.0508)
    assert found.record.acceleration[10] == pytest.approx(1.1 * np.sin(1.0))
    assert found.posterior.parameter_names == ["Ec", "Es", "a0", "a1", "ft", "sigma_displacement"]
    assert list(found.assumed) == ["sigma_displacement"]
    rms = np.sqrt(np.mean((1e-3 * (np.arange(201) % 89)) ** 2))
    assert found.assumed["sigma_displacement"].sd == pytest.approx(0.3 * rms, rel=1e-2)


def test_measurements_before_and_after_the_record_are_left_out(column):
    rows = [f"{0.01 * k:.2f},{k % 89}" for k in range(901)]
    text = COLUMN.replace("[priors]", 'zero = "3 s"\n[priors]')
    measured = column(rows, text).posterior.likelihood.measurements
    assert measured.values[0] == pytest.approx(1e-3 * (np.arange(300, 501) % 89)) and measured.start == 0.0
    assert "without 700 samples of displacement before or after the record" in measured.description
    with pytest.raises(ValueError, match="0 of 901 samples of displacement lie within the record, 0 to 2 s"):
        column(rows, text.replace("3 s", "9.5 s"))


def test_measurements_shorter_than_the_record(column):
    rows = [f"{0.02 * k:.2f},{k % 89}" for k in range(40)]
    likelihood = column(rows).posterior.likelihood
    assert "displacement ends 1.22 s before the record" in likelihood.measurements.description
    np.testing.assert_array_equal(likelihood.measurements.values[0], [*(1e-3 * np.arange(40)), *[np.nan] * 61])
    assert np.isfinite(likelihood.log_likelihood([1.0, 1.0, 1.0, 1.0, 1.0, 0.002]))


def test_a_new_diameter_of_bars_has_its_own_area(column):
    rows = [f"{0.01 * k:.2f},{k % 89}" for k in range(201)]
    model = column(rows, COLUMN + '[model.bars]\ndiameter = "32 mm"\n').posterior.likelihood.model
    assert model.bars.number == 18 and model.bars.area_each == pytest.approx(np.pi * 0.016**2)
    with pytest.raises(ValueError, match=r"own.toml: \[model.hoops\] .*spacing"):
        column(rows, COLUMN + '[model.hoops]\nspacing = "5 mm"\n')
    with pytest.raises(ValueError, match=r"\[priors\] fy: this prior is missing"):
        column(rows, COLUMN.replace("mesh", 'parameters = ["Ec", "Es", "a0", "a1", "ft", "fy"]\nmesh'))


def test_the_template_is_the_ready_made_posterior():
    found = make_problem(read_job(ROOT / "data" / "templates" / "column.toml"))
    usual = problems.bridge_column(data="short")
    assert found.posterior.parameter_names == usual.parameter_names
    point = usual.prior.mean()
    assert found.posterior.log_prob(point) == pytest.approx(usual.log_prob(point), rel=1e-12)
    file = ROOT / "data" / "templates" / "column.toml"
    text = file.read_text().replace("# zero", "zero")
    with pytest.raises(ValueError, match="zero: a data set states this itself"):
        make_problem(parse_job(text, file, file.parent))


def test_sensors_below_the_top_and_drifts_of_floors_are_channels(column):
    """The names of the columns are the outputs of the built-in structure."""
    rows = [f"{0.01 * k:.2f},{k % 89}" for k in range(201)]
    text = COLUMN.replace("mesh = 10", "mesh = 10\ncolumn_mass = 2e4")
    for name, unit in (("displacement@1.2", "mm"), ("velocity@2.5", "cm/s"), ("acceleration@2.5", "g")):
        found = column(rows, text.replace("displacement =", f'"{name}" =').replace("[mm]", f"[{unit}]"), unit)
        (channel,) = found.posterior.likelihood.model.channels
        assert channel.name == name and found.posterior.parameter_names[-1] == f"sigma_{name}"
    with pytest.raises(ValueError, match=r"a height of a node, 2.5, 5 m; got 'velocity@1.2'"):
        column(rows, text.replace("displacement =", '"velocity@1.2" ='))
    frame = "[model]\nkind = 'frame'\nmasses = [1.0, 1.0]\nstiffnesses = [62.0, 62.0]\nfloors = {low = 1, top = 2}\n"
    priors = "".join(f'{what}_{i} = "normal(1, 0.2)"\n' for what in ("stiffness", "damping") for i in (1, 2))
    text = frame + COLUMN[COLUMN.index("[record]") : COLUMN.index("Ec =")] + priors
    model = column(rows, text.replace("displacement =", '"displacement@top:low" =')).posterior.likelihood.model
    assert [channel.name for channel in model.channels] == ["displacement@top:low"]
