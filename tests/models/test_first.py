"""Models under the first part of their excitation: the response is the first part of the whole response."""

import numpy as np
import pytest

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.models.frames_and_decks import BridgeDeck, ShearFrame
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.models.linear_structure import LinearStructure
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.models.rc_column_materials import ColumnAnalysis
from fe_likelihoods.noise.autoregressive import AutoregressiveNoise
from fe_likelihoods.problems import bridge_column, isolated_bridge
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import DisplacementHistory, Record
from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.model import first_part

RECORD = bridge_column(every=2, duration=8.0).likelihood.model.loading
TABLE = Record("table", 0.005, 3.0 * np.sin(np.arange(400) / 20.0))
THETA = {"frequency": 3.7, "damping": 0.05, "share": 0.8, "shape": 0.3}


def cases():
    column = RCColumn.lhpost(RECORD, analysis=ColumnAnalysis(mesh=10))
    imposed = DisplacementHistory("cycles", np.array([0.0, 0.05, -0.05, 0.1, -0.1]))
    bridge = isolated_bridge(data="means").likelihood.model
    vertical = bridge.with_record(TABLE)
    supports = [RECORD, RECORD.scale(0.9), RECORD.scale(1.1)]
    return {
        "oscillator": (LinearOscillator(RECORD), 5.003),
        "column": (column, 5.003),
        "column, imposed": (RCColumn.lhpost(imposed, analysis=ColumnAnalysis(mesh=10), parameters=("Ec", "ft")), 3.2),
        "bridge": (vertical, 1.2321),
        "bridge, vertical, every third": (
            type(bridge)(TABLE, vertical=TABLE.scale(0.5), every=3, outputs=bridge.outputs),
            1.2321,
        ),
        "frame": (LinearStructure(ShearFrame({"top": 2}, (1.0, 1.0), (900.0, 900.0)), RECORD), 5.003),
        "deck": (LinearStructure(BridgeDeck("m", "a", "b"), supports), 5.003),
        "deck, lead": (LinearStructure(BridgeDeck("m"), supports, lead=2.0), 5.003),
    }


@pytest.mark.parametrize(("model", "seconds"), cases().values(), ids=cases().keys())
def test_the_response_is_the_first_part_bit_for_bit(model, seconds, rng):
    part = first_part(model, seconds)
    measured = Measurements(model.channels, model.dt, np.zeros((len(model.channels), model.n_steps)))
    n_steps = measured.trim(0.0, seconds).n_steps  # the same rule for models and measurements
    assert 2 < n_steps < model.n_steps
    assert (part.n_steps, part.dt, part.parameter_names) == (n_steps, model.dt, model.parameter_names)
    assert [channel.name for channel in part.channels] == [channel.name for channel in model.channels]
    nominal = [THETA.get(name, 0.05 if name.startswith("damping_") else 1.0) for name in model.parameter_names]
    for _ in range(3):
        theta = np.array(nominal) * rng.uniform(0.9, 1.1, size=len(nominal))
        np.testing.assert_array_equal(part.simulate(theta), model.simulate(theta)[:, :n_steps])


@pytest.mark.parametrize(("model", "seconds"), cases().values(), ids=cases().keys())
def test_fingerprints_of_parts(model, seconds):
    part, end = first_part(model, seconds), (model.n_steps - 1) * model.dt
    assert part.fingerprint != model.fingerprint
    assert part.fingerprint == first_part(model, seconds).fingerprint
    assert part.fingerprint == first_part(first_part(model, end), seconds).fingerprint
    assert first_part(model, end).n_steps == model.n_steps
    for wrong in (0.0, -1.0, 1e6, 0.5 * model.dt, np.nan):
        with pytest.raises(ValueError, match=r"expected 0 <= start|fewer than 2 samples"):
            first_part(model, wrong)


@pytest.mark.parametrize("pool", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_the_likelihood_of_the_first_part(pool, rng, tmp_path):
    model = LinearOscillator(RECORD)
    values = model.simulate([1.0, 1.0]) + 0.01 * rng.normal(size=(2, model.n_steps))
    measurements = Measurements(model.channels, model.dt, values)
    whole = FELikelihood(
        model, measurements, AutoregressiveNoise(model.channels), pool=pool, cache=tmp_path / "cache.sqlite"
    )
    part = whole.first(5.003)
    expected = FELikelihood(first_part(model, 5.003), measurements.trim(0.0, 5.003), whole.noise)
    x = np.array([[1.02, 0.9, 0.01, 0.02, 0.1, 0.2], [0.98, 1.1, 0.01, 0.02, 0.1, 0.2]])
    np.testing.assert_array_equal(part.log_likelihood(x), expected.log_likelihood(x))
    assert (part.log_likelihood(x) != whole.log_likelihood(x)).all()
    assert (part.simulations, whole.simulations) == (2, 2)
    assert part.simulator.fingerprint == expected.simulator.fingerprint != whole.simulator.fingerprint
    assert whole.simulator.cache.info().simulations == 4
    if pool is not None:
        whole.simulator.pool.close()


class Building:
    """A user's model with a record, but without `first`."""

    parameter_names = ("stiffness", "damping")
    channels = (Channel("roof", "displacement", "mm"),)

    def __init__(self, record):
        self.record = record
        self.dt, self.n_steps = record.dt, record.n_steps
        self.fingerprint = f"building {record.fingerprint}"

    def with_record(self, record):
        return Building(record)

    def simulate(self, theta):
        return LinearOscillator(self.record).simulate(theta)[1:]


def test_a_model_with_a_record_can_be_shortened():
    whole = FELikelihood(Building(RECORD), Measurements(Building.channels, RECORD.dt, np.ones((1, RECORD.n_steps))))
    part = whole.first(5.003)
    assert part.simulator.fingerprint != whole.simulator.fingerprint
    response = whole.model.simulate([1.0, 1.0])[:, : part.measurements.n_steps]
    np.testing.assert_array_equal(part.model.simulate([1.0, 1.0]), response)


def straight(theta):
    return theta * np.arange(10.0)[None]


def test_a_model_that_cannot_be_shortened():
    model = FunctionModel(straight, ("a",), [Channel("y", "displacement", "m")], 0.1, 10)
    likelihood = FELikelihood(model, Measurements(model.channels, 0.1, np.ones((1, 10))))
    with pytest.raises(ValueError, match=r"FunctionModel cannot be shortened: it needs a method first\(seconds\)"):
        likelihood.first(0.5)


# functions that take the number of samples --------------------------------------------------------------------

CHANNEL = [Channel("y", "displacement", "m")]


def vibrates(theta, n_steps=300):
    time = 0.02 * np.arange(n_steps)
    return (np.exp(-0.1 * time) * np.cos(9.0 * np.sqrt(theta[0]) * time))[None]


def slopes(theta, n_steps=300):
    time, omega = 0.02 * np.arange(n_steps), 9.0 * np.sqrt(theta[0])
    return (-np.exp(-0.1 * time) * np.sin(omega * time) * time * omega / (2.0 * theta[0]))[None, None]


def required(theta, n_steps):
    return vibrates(theta, n_steps)


def ignores(theta, n_steps=7):
    return vibrates(theta)


def shaken(theta, record, n_steps):
    return LinearOscillator(record).simulate([*theta, 1.0])[1:, :n_steps]


@pytest.mark.parametrize("isolated", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("function", [vibrates, required])
def test_a_function_of_the_number_of_samples(function, isolated):
    model = FunctionModel(function, ("a",), CHANNEL, 0.02, 300, jacobian=slopes, isolated=isolated)
    part = model.first(1.999)
    assert part.n_steps == 100 and model.n_steps == 300
    np.testing.assert_array_equal(part.simulate([1.1]), model.simulate([1.1])[:, :100])
    np.testing.assert_array_equal(part.jacobian([1.1]), model.jacobian([1.1])[:, :, :100])
    assert part.fingerprint == model.first(1.98).fingerprint == model.first(4.0).first(1.98).fingerprint
    assert len({part.fingerprint, model.fingerprint, model.first(2.0).fingerprint}) == 3
    for wrong in (0.0, 7.0, np.nan):
        with pytest.raises(ValueError, match=r"expected 0 <= start|fewer than 2 samples"):
            model.first(wrong)


def test_a_function_that_does_not_return_the_first_samples_ends_the_run():
    model = FunctionModel(ignores, ("a",), CHANNEL, 0.02, 300)
    likelihood = FELikelihood(model, Measurements(CHANNEL, 0.02, vibrates([1.2])))
    message = r"expected the function to return the first 101 samples of 1 channels with n_steps=101; got the shape"
    assert model.simulate([1.0]).shape == (1, 300)  # whose n_steps is another thing
    with pytest.raises(ValueError, match=message):
        model.first(2.0).simulate([1.0])
    with pytest.raises(ValueError, match=message):
        likelihood.first(2.0).log_likelihood(np.array([[1.0, 0.1]]))
    with LocalPool(1) as pool, pytest.raises(ValueError, match=message):
        FELikelihood(model, likelihood.measurements, pool=pool).first(2.0).log_likelihood(np.array([[1.0, 0.1]]))


def test_a_part_under_a_record():
    model = FunctionModel(shaken, ("a",), CHANNEL, record=TABLE)
    part = model.first(1.0)
    assert part.n_steps == 201
    np.testing.assert_array_equal(part.simulate([1.1]), model.simulate([1.1])[:, :201])
    other = part.with_record(TABLE.scale(2.0))  # the whole response to another record
    np.testing.assert_allclose(other.simulate([1.1]), 2.0 * model.simulate([1.1]), rtol=1e-12)


def test_a_jacobian_needs_the_number_of_samples_as_well():
    with pytest.raises(ValueError, match="expected jacobian with the argument n_steps, as function has it; got"):
        FunctionModel(vibrates, ("a",), CHANNEL, 0.02, 300, jacobian=lambda theta: slopes(theta))
