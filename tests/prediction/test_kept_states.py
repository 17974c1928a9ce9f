"""States at the end of an excitation: the bits of one simulation of the whole, and no event is run twice."""

import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fe_likelihoods import Channel, DisplacementHistory, Events, IsolatedBridge, RCColumn, Record, propagate
from fe_likelihoods.prediction.kept_states import KEPT_STATES, StateMemory, simulate_last_part
from fe_likelihoods.problems import bridge_column_data
from fe_likelihoods.simulation.model import ContinuedResponse, SimulationFailed

SETTINGS = {"from_state": "end", "rest": 0.5, "progress": False}


class Slip:
    """Block whose foundation slips while the acceleration exceeds a limit: response = slip so far."""

    parameter_names = ("limit",)
    runs: list[tuple[float, int]] = []  # limit and number of samples of every run

    def __init__(self, record):
        self.channels = (Channel("slip", "displacement", "m"),)
        self.record, self.dt, self.n_steps = record, record.dt, record.n_steps
        self.fingerprint = "slip " + record.fingerprint

    def with_record(self, record):
        return type(self)(record)

    def simulate(self, theta):
        return self.simulate_from(theta).response

    def simulate_from(self, theta, state=None):
        first, slip = (0, 0.0) if state is None else (int(state[0]) + 1, state[1])
        acceleration = self.record.acceleration[first:]
        self.runs.append((theta[0], len(acceleration)))
        if theta[0] < 0.0:
            raise SimulationFailed("negative limit")
        steps = np.maximum(np.abs(acceleration) - theta[0], 0.0)
        steps[0] += slip
        slips = np.cumsum(steps)
        return ContinuedResponse(slips[None], np.array([self.n_steps - 1, slips[-1]]))


class InPlace(Slip):
    """A class that updates the state that it receives."""

    def simulate_from(self, theta, state=None):
        found = super().simulate_from(theta, state)
        if state is not None:
            state[:] = found.state
        return found


class Cut(Slip):
    """A class that returns a part of the response after a state."""

    part = np.s_[:, -1:]

    def simulate_from(self, theta, state=None):
        found = super().simulate_from(theta, state)
        return found if state is None else found._replace(response=found.response[self.part])


class OtherState(Slip):
    """A class that returns its state as something else than an array of numbers."""

    kind = list

    def simulate_from(self, theta, state=None):
        found = super().simulate_from(theta, state)
        return found._replace(state=self.kind(found.state))


class Doubled(Slip):
    """A class that changes the response, and inherits a method that does not know of it."""

    def simulate(self, theta):
        return 2.0 * super().simulate(theta)


@pytest.fixture(autouse=True)
def forget():
    KEPT_STATES.clear()
    Slip.runs.clear()
    yield
    KEPT_STATES.clear()
    KEPT_STATES.limit(256 * 2**20)


@pytest.fixture
def eq(rng):
    return [Record(f"EQ{i}", 0.02, rng.normal(size=40 + i)) for i in range(1, 5)]


def whole(model, events, theta):
    """Response to the last event, from one simulation of all."""
    return model.with_record(events).simulate(theta)[:, events.windows[-1].samples]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"substeps": 3, "n_elements": 1},
        {"outputs": ("base_moment", "strain@0.1:0.4", "rotation@0:0.5"), "geometry": "linear"},
        {
            "outputs": ("displacement@1.5", "acceleration@3.66", "velocity@3.66", "bar_stress@0:0.52"),
            "column_mass": 2e4,
            "substeps": 2,
        },
    ],
)
def test_column_goes_on_with_the_same_bits(changes):
    strong = bridge_column_data().record.trim(10.0, 10.5).scale(2.0)
    column = RCColumn.lhpost(strong, mesh=10, **changes)
    joined, theta = column.followed_by(strong, rest=0.1), np.array([0.9, 1.1, 1.2, 0.8, 1.3])
    response = joined.simulate(theta)
    first = joined.n_steps - strong.n_steps
    before = joined.first((first - 1) * joined.dt).simulate_from(theta)
    after = joined.simulate_from(theta, before.state)
    np.testing.assert_array_equal(np.hstack([before.response, after.response]), response)
    np.testing.assert_array_equal(after.state, joined.simulate_from(theta).state)
    virgin = column.simulate(theta)
    assert np.abs(after.response - virgin).max() > 1e-3 * np.abs(virgin).max()


@pytest.mark.parametrize(("friction", "every"), [("bouc-wen", 1), ("elastic-plastic", 1), ("coulomb", 4)])
def test_bridge_goes_on_with_the_same_bits(rng, friction, every):
    first, second = (Record("table", 0.01, 3.0 * rng.normal(size=n)) for n in (42, 31))
    bridge = IsolatedBridge(first, vertical=first.scale(0.5), friction=friction, every=every)
    joined, theta = bridge.followed_by(second, rest=0.1), np.linspace(0.8, 1.2, 10)
    response = joined.simulate(theta)
    n = joined.n_steps - bridge.with_record(second).n_steps
    before = joined.first((n - 1) * joined.dt).simulate_from(theta)
    after = joined.simulate_from(theta, before.state)
    np.testing.assert_array_equal(np.hstack([before.response, after.response]), response)
    np.testing.assert_array_equal(after.state, joined.simulate_from(theta).state)


def test_states_that_do_not_fit_are_refused(eq):
    column, bridge = RCColumn.lhpost(eq[0], mesh=10), IsolatedBridge(eq[0].resample(0.01))
    state = column.simulate_from(np.ones(5)).state
    with pytest.raises(ValueError, match="before the last one of this response of 41 samples; got .* sample 40"):
        column.simulate_from(np.ones(5), state)
    with pytest.raises(ValueError, match="a state of 21 numbers"):
        bridge.simulate_from(np.ones(10), state)
    with pytest.raises(ValueError, match="a column under a Record; got 'DisplacementHistory'"):
        RCColumn.lhpost(DisplacementHistory("push", [0.0, 0.01]), parameters=("Ec",)).simulate_from(np.ones(1))


def test_the_first_event_is_run_once_for_all_predictions(eq):
    model, samples = Slip(eq[0]), np.array([[0.1], [0.2], [0.2], [0.3]])
    for later, n in [(eq[1], 41 + 25 + 42), (eq[2], 43), (eq[2], 43), (eq[3], 44)]:
        Slip.runs.clear()
        prediction = propagate(model, samples, record=later, **SETTINGS)
        assert sum(length for _, length in Slip.runs) == 3 * n
        expected = np.mean([whole(model, Events([eq[0], later], 0.5), theta) for theta in samples], axis=0)
        np.testing.assert_allclose(prediction.mean, expected, rtol=1e-14)
    Slip.runs.clear()
    propagate(model, [[0.5]], record=eq[1], **SETTINGS)  # another theta
    propagate(model, [[0.5]], record=eq[1], **(SETTINGS | {"rest": 1.0}))  # a longer pause
    assert [n for _, n in Slip.runs] == [41 + 25, 42, 25, 42]


def test_each_event_is_run_once_where_one_follows_the_other(eq):
    theta = np.array([0.2])
    for known in (1, 2, 3):
        Slip.runs.clear()
        model = Slip(Events(eq[:known], 0.5))
        prediction = propagate(model, [theta], record=eq[known], **SETTINGS)
        assert [n for _, n in Slip.runs] == [25 + 41 * (known == 1), eq[known].n_steps]
        np.testing.assert_array_equal(prediction.mean, whole(model, Events(eq[: known + 1], 0.5), theta))


def test_models_without_states_run_everything(eq):
    theta = np.array([0.2])
    model = Doubled(eq[0])  # inherits simulate_from, which does not double
    for _ in range(2):
        prediction = propagate(model, [theta], record=eq[1], **SETTINGS)
        np.testing.assert_array_equal(prediction.mean, whole(model, Events(eq[:2], 0.5), theta))
    assert len(KEPT_STATES) == 0


def test_code_of_the_user_that_changes_gives_other_states(eq):
    source = "class Edited(Slip):\n    def simulate_from(self, theta, state=None):\n        return {}"
    found = []
    for factor in (1.0, 2.0):  # a cell that is edited and run again: the fingerprint is the same
        names = {"Slip": Slip, "__name__": "cell"}
        exec(source.format(f"Slip.simulate_from(self, {factor} * theta, state)"), names)
        found.append(propagate(names["Edited"](eq[0]), [[0.2]], record=eq[1], **SETTINGS).mean)
    np.testing.assert_array_equal(found[1], whole(Slip(eq[0]), Events(eq[:2], 0.5), np.array([0.4])))
    assert (found[0] != found[1]).any()


def test_failures_are_rows_and_are_not_kept(eq):
    model, samples = Slip(eq[0]), np.array([[-0.1], [0.2]])
    for _ in range(2):
        prediction = propagate(model, samples, record=eq[1], **SETTINGS)
        assert prediction.failure_reasons == {"negative limit": 1} and prediction.failed.tolist() == [0]
    assert len(KEPT_STATES) == 2


def test_pool_gives_the_same_bits(eq):
    model, samples = Slip(eq[0]), np.array([[-0.1], [0.2], [0.3]])
    alone = propagate(model, samples, record=eq[1], state_bytes=0, **SETTINGS)
    assert len(KEPT_STATES) == 0
    with ThreadPoolExecutor(2) as pool:
        pooled = [propagate(model, samples, record=later, pool=pool, **SETTINGS) for later in (eq[1], eq[1])]
    for each in pooled:
        np.testing.assert_array_equal(each.mean, alone.mean)
    assert len(KEPT_STATES) == 4


def test_memory_stays_within_its_limit(eq):
    memory, thetas = StateMemory(4 * 16), np.array([[0.1], [0.2], [0.3]])

    def predict(model, n):
        Slip.runs.clear()
        before = model.n_steps - n
        batch = simulate_last_part(model, before, thetas, memory=memory)
        for theta, response in zip(thetas, batch.response, strict=True):
            np.testing.assert_array_equal(response, Slip.simulate(model, theta)[:, before:])
        assert memory.n_bytes == 16 * len(memory) <= 4 * 16
        return sum(n for _, n in Slip.runs[:-3])

    one, other = Slip(Events(eq[:2], 0.5)), Slip(Events([eq[0], eq[2]], 0.5))
    assert [predict(one, 42), predict(one, 42), predict(other, 43)] == [3 * (66 + 42), 3 * 42, 3 * 43]
    predict(Slip(Events(eq[2:], 0.5)), 44)  # drops the states of EQ1, which were not used for longest
    assert predict(one, 42) == 3 * (66 + 42)
    memory.limit(0)
    assert (memory.n_bytes, len(memory)) == (0, 0)


@pytest.mark.parametrize("limit", [-1, np.nan, "1 GB"])
def test_limit_that_is_no_number_of_bytes_is_refused(eq, limit):
    with pytest.raises(ValueError, match=f"state_bytes must be a number of bytes, or None for no limit; got {limit!r}"):
        propagate(Slip(eq[0]), [[0.2]], record=eq[1], state_bytes=limit, **SETTINGS)


def test_a_model_may_write_into_the_state_that_it_receives(eq):
    model, expected = InPlace(eq[0]), whole(Slip(eq[0]), Events(eq[:2], 0.5), np.array([0.2]))
    for _ in range(3):
        np.testing.assert_array_equal(propagate(model, [[0.2]], record=eq[1], **SETTINGS).mean, expected)


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (list, "list"),
        (lambda state: {"slip": state}, "dict"),
        (lambda state: None, "NoneType"),
        (lambda state: np.array([{"slip": state}]), "array of Python objects"),
    ],
)
def test_a_state_that_is_no_array_of_numbers_is_a_failed_simulation(eq, monkeypatch, kind, name):
    monkeypatch.setattr(OtherState, "kind", staticmethod(kind))
    joined, memory = OtherState(Events(eq[:2], 0.5)), StateMemory()
    (reason,) = simulate_last_part(joined, joined.n_steps - 42, np.array([[0.2]]), memory=memory).reasons
    assert f"simulate_from of OtherState returned a state of type {name}: expected an array of numbers" in reason
    assert len(memory) == 0


@pytest.mark.parametrize(
    ("part", "shape"), [(np.s_[:, -1:], r"\(1, 1\)"), (np.s_[:, :-1], r"\(1, 41\)"), (0, r"\(42,\)")]
)
def test_a_response_of_another_length_is_a_failed_simulation(eq, monkeypatch, part, shape):
    monkeypatch.setattr(Cut, "part", part)
    joined = Cut(Events(eq[:2], 0.5))
    (reason,) = simulate_last_part(joined, joined.n_steps - 42, np.array([[0.2]])).reasons
    assert re.search(rf"simulate_from of Cut returned a response of shape {shape}, expected .* = \(1, 42\)", reason)
