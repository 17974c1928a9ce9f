"""Models of the user's own code that receive the record: predictions under other records."""

import pickle
import sys

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    ExecutableModel,
    FELikelihood,
    FunctionModel,
    LinearOscillator,
    Measurements,
    Record,
    propagate,
)
from tests.opensees_oscillator import CHANNELS, DAMPING, PERIOD

NAMES = ("stiffness", "damping")
ROOF = (Channel("roof", "displacement", "mm"),)
PROGRAM = """
import sys
name, dt, n_steps, factor = sys.argv[1:]
samples = [float(line) for line in open(name)]
assert len(samples) == int(n_steps)
with open("out.txt", "w") as file:
    for sample in samples:
        print(repr(float(factor) * float(dt) * sample), file=file)
"""


def oscillator(theta, record):
    return LinearOscillator(record, PERIOD, DAMPING).simulate(theta)


def roof(theta, record):
    return oscillator(theta, record)[1:, ::4]


@pytest.fixture
def record(rng):
    return Record("noise", 0.02, np.append(0.0, rng.normal(size=79)))


def test_function_with_a_record_is_the_built_in_model_under_any_record(record):
    model = FunctionModel(oscillator, NAMES, CHANNELS, record=record, path_dependent=False)
    builtin = LinearOscillator(record, PERIOD, DAMPING)
    posterior = FELikelihood(model, Measurements(CHANNELS, 0.02, builtin.simulate([1.0, 1.0])))
    samples, longer = np.array([[1.0, 1.0], [1.2, 0.8]]), record.resample(0.01).scale(2.0)
    for settings in ({"record": longer}, {"record": record.scale(0.5), "from_state": "end", "rest": 1.0}, {}):
        ours = propagate(posterior, samples, progress=False, **settings)
        theirs = propagate(builtin, samples, progress=False, **settings)
        np.testing.assert_array_equal(ours.mean, theirs.mean)
        assert ours.dt == theirs.dt


def test_response_with_a_longer_step(record):
    model = FunctionModel(roof, NAMES, ROOF, dt=0.08, record=record)
    assert model.n_steps == 20
    moved = model.with_record(record.resample(0.01))
    assert moved.dt == pytest.approx(0.04) and moved.n_steps == 40
    joined = model.followed_by(record.trim(0.0, 0.6), rest=0.1)  # 5 zeros and 3 more, so that a sample is at its start
    expected = oscillator([1.0, 1.0], record.followed_by(record.trim(0.0, 0.6), rest=0.16))[1:, ::4]
    np.testing.assert_array_equal(joined.simulate([1.0, 1.0]), expected)
    end = propagate(model, np.ones((1, 2)), record=record.trim(0.0, 0.6), from_state="end", rest=0.1, progress=False)
    np.testing.assert_array_equal(end.mean, expected[:, 22:])


def test_the_record_is_part_of_the_fingerprint(record):
    model = FunctionModel(oscillator, NAMES, CHANNELS, record=record)
    assert model.fingerprint != model.with_record(record.scale(1.1)).fingerprint
    assert model.fingerprint == model.with_record(record).fingerprint
    assert model.record is record  # with_record changes no model
    copy = pickle.loads(pickle.dumps(model.with_record(record.scale(2.0))))
    np.testing.assert_array_equal(copy.simulate([1.0, 1.0]), 2.0 * model.simulate([1.0, 1.0]))


def test_a_program_reads_the_record(record, tmp_path):
    script = tmp_path / "solver.py"
    script.write_text(PROGRAM)
    settings = {
        "command": [sys.executable, script, "motion/x.txt", "$record_dt", "${record_n_steps}", "$factor"],
        "templates": {},
        "output": "out.txt",
        "parameter_names": ["factor"],
        "channels": ROOF,
        "time_limit": 20.0,
    }
    model = ExecutableModel(**settings, record=record, record_file="motion/x.txt", path_dependent=False)
    np.testing.assert_array_equal(model.simulate([3.0]), 3.0 * 0.02 * record.acceleration[None])
    other = Record("other", 0.01, [1.0, 0.1, 1.0 / 3.0])
    prediction = propagate(model, np.array([[2.0]]), record=other, progress=False)
    np.testing.assert_allclose(prediction.mean, 0.02 * other.acceleration[None], rtol=1e-15)
    assert model.fingerprint != model.with_record(other).fingerprint
    with pytest.raises(ValueError, match="placeholders for record_dt"):
        ExecutableModel(**settings, dt=0.02, n_steps=80)
    with pytest.raises(ValueError, match="in.txt is more than one of a template, a file and the record file"):
        ExecutableModel(**settings | {"templates": {"in.txt": "$factor"}}, record=record, record_file="in.txt")


def test_bad_input_is_refused_before_any_simulation(record):
    def build(**options):
        return FunctionModel(oscillator, NAMES, CHANNELS, **options)

    cases = {
        "give dt and n_steps of the response, or record=": {"dt": 0.02},
        "expected a Record as record; got ndarray": {"record": np.ones(5)},
        "whole multiple of the step of the record, 0.02 s; got 0.03 s": {"record": record, "dt": 0.03},
        "has 80 samples at 0.02 s; got n_steps=79": {"record": record, "n_steps": 79},
    }
    for message, options in cases.items():
        with pytest.raises(ValueError, match=message):
            build(**options)
    with pytest.raises(ValueError, match="FunctionModel has one excitation, which its code contains: make it with rec"):
        propagate(build(dt=0.02, n_steps=80), np.ones((1, 2)), record=record, from_state="virgin", progress=False)
    with pytest.raises(ValueError, match="expected a Record as excitation; got list"):
        propagate(build(record=record), np.ones((1, 2)), record=[record], from_state="end", progress=False)
