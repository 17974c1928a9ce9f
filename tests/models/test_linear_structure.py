"""Linear structures on several supports against closed forms, scipy's state-space solver, and the oscillator."""

import math
import pickle

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import eigh

from fe_likelihoods import BridgeDeck, LinearStructure, Record, ShearFrame, SimulationFailed
from fe_likelihoods.models.frames_and_decks import LinearSystem
from fe_likelihoods.signals.response_spectrum import respond
from fe_likelihoods.simulation.model import simulate_batch

DT = 0.02


class Matrices:
    """Parts with given matrices, which depend on no parameter."""

    parameter_names = ("none",)

    def __init__(self, mass, damping, stiffness, influence):
        n, self.n_supports = np.shape(influence)
        arrays = (np.array(each, dtype=float) for each in (mass, damping, stiffness, influence))
        self.channel_names = tuple(map(str, range(n)))
        self.system = LinearSystem(*arrays, np.eye(n), np.zeros((n, self.n_supports)))

    def assemble(self, theta):
        return self.system

    def respond(self, supports):
        """Relative displacements and velocities, and absolute accelerations, (n, n_steps) each."""
        outputs = [f"{kind}{name}" for kind in ("displacement@", "velocity@", "") for name in self.channel_names]
        response = LinearStructure(self, supports, outputs=outputs).simulate([0.0])
        return response.reshape(3, len(self.channel_names), -1)


@pytest.fixture
def three(rng) -> list[Record]:
    """Records of the base of a column and of two ends."""
    return [Record(name, DT, rng.normal(size=400)) for name in ("base", "first", "second")]


@pytest.mark.parametrize("strength", [0.2, 5.0], ids=["damped", "overdamped"])
def test_equals_state_space_solution_if_damping_couples_the_modes(three, strength):
    """With one damper between a floor and the ground, the damping matrix does not follow from modal ratios."""
    a = np.stack([record.acceleration for record in three])
    mass, stiffness = np.diag([2.0, 1.0]), np.array([[900.0, -400.0], [-400.0, 400.0]])
    damping = np.array([[0.4 + 40.0 * strength, -0.4], [-0.4, 0.4]])
    influence = np.array([[0.2, 0.3, 0.5], [0.6, 0.4, 0.0]])
    inverse = np.linalg.inv(mass)
    matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    _, modes = eigh(stiffness, mass)
    coupled = modes.T @ damping @ modes
    assert abs(coupled[0, 1]) > 0.1 * coupled[0, 0], "control: the modes are coupled"
    assert (np.abs(np.linalg.eigvals(matrix).imag).min() == 0.0) == (strength > 1.0), "control"
    forced = np.vstack([np.zeros((2, 3)), -influence])
    _, state, _ = signal.lsim((matrix, forced, np.eye(4), np.zeros((4, 3))), a.T, DT * np.arange(400))
    response = Matrices(mass, damping, stiffness, influence).respond(three)
    for ours, theirs in zip(response, (state[:, :2], state[:, 2:], state @ matrix[2:].T), strict=True):
        np.testing.assert_allclose(ours, theirs.T, rtol=0, atol=1e-10 * np.abs(theirs).max())


def test_floors_move_in_equilibrium(three):
    """M x'' + C u' + K u = 0 holds between the channels of all floors; drifts are differences."""
    floors, theta = {"f1": 1, "f2": 2, "f3": 3}, np.array([900.0, 800.0, 700.0, 0.05, 0.04, 0.03])
    parts = ShearFrame(floors, [1.0, 1.2, 0.8], [1.0, 1.0, 1.0])
    kinds = ("displacement", "velocity", "relative_acceleration")
    names = (*(f"{kind}@{floor}" for kind in kinds for floor in floors), *floors)
    model = LinearStructure(parts, three[0], outputs=names)
    u, v, a, absolute = model.simulate(theta).reshape(4, 3, -1)
    found = parts.assemble(theta)
    forces = found.mass @ absolute, found.damping @ v + found.stiffness @ u
    np.testing.assert_allclose(forces[0], -forces[1], rtol=0, atol=1e-11 * np.abs(forces[0]).max())
    np.testing.assert_allclose(absolute - three[0].acceleration, a, rtol=0, atol=1e-12 * np.abs(absolute).max())
    np.testing.assert_array_equal(absolute, LinearStructure(parts, three[0]).simulate(theta))
    drifts = LinearStructure(parts, three[0], outputs=("displacement@f3:f1", "velocity@f2:f1", "f2"))
    rows = drifts.simulate(theta)
    np.testing.assert_allclose(
        rows, [u[2] - u[0], v[1] - v[0], absolute[1]], rtol=0, atol=1e-12 * np.abs(absolute).max()
    )
    assert [(each.quantity, each.unit) for each in drifts.channels] == [
        ("relative displacement", "mm"),
        ("relative velocity", "mm/s"),
        ("absolute acceleration", "g"),
    ]
    np.testing.assert_array_equal(drifts.first(2.0).simulate(theta), rows[:, :101])
    np.testing.assert_array_equal(drifts.with_record(three[1]).with_record(three[0]).simulate(theta), rows)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(drifts)).simulate(theta), rows)


def test_relative_motion_on_several_supports_is_dynamic(three):
    """Relative to the motion that follows the supports slowly: the weighted oscillator."""
    base, first, second = (record.acceleration for record in three)
    outputs = ("displacement@m", "velocity@s", "relative_acceleration@s")
    weighted = 0.3 * base + 0.35 * (first + second)
    rows = LinearStructure(BridgeDeck("m", "s"), three, outputs=outputs).simulate([3.0, 0.08, 0.7, 0.6])
    alone = respond(weighted, DT, 2 * math.pi * 3.0, 0.08)
    expected = [alone.displacement, 0.6 * alone.velocity, 0.6 * (alone.acceleration - weighted)]
    for row, values in zip(rows, expected, strict=True):
        np.testing.assert_allclose(row, values, rtol=0, atol=1e-11 * np.abs(values).max())


def test_deck_equals_the_weighted_oscillator(three):
    base, first, second = (record.acceleration for record in three)
    model = LinearStructure(BridgeDeck("m", "s1", "s2"), three)
    assert model.parameter_names == ("frequency", "damping", "share", "shape")
    middle = respond(0.3 * base + 0.35 * (first + second), DT, 2 * math.pi * 3.0, 0.08).acceleration
    expected = [0.4 * first + 0.6 * middle, middle, 0.4 * second + 0.6 * middle]
    response = model.simulate([3.0, 0.08, 0.7, 0.6])
    np.testing.assert_allclose(response, expected, rtol=0, atol=1e-11)
    assert [channel.name for channel in model.channels] == ["s1", "m", "s2"]


def test_a_lead_starts_the_channels_from_a_moving_state(three):
    theta = [3.0, 0.02, 0.7, 0.6]
    whole = LinearStructure(BridgeDeck("m", "s"), three).simulate(theta)
    late = LinearStructure(BridgeDeck("m", "s"), three, lead=1.0)
    assert late.n_steps == 350
    np.testing.assert_array_equal(late.simulate(theta), whole[:, 50:])
    assert late.with_record(three[::-1]).lead == 1.0
    from_rest = LinearStructure(BridgeDeck("m", "s"), [record.trim(1.0) for record in three]).simulate(theta)
    assert np.abs(from_rest - whole[:, 50:]).max() > 0.1 * np.abs(whole).max(), "control: the state matters"


def test_impossible_parameters_fail_with_reasons_in_their_rows_only(three):
    model = LinearStructure(BridgeDeck("m"), three)
    thetas = np.array([[3, 0.1, 0.5], [-3, 0.1, 0.5], [3, 0.1, 1.5], [3, 0.0, 0.5], [3, 1.0, 0.5], [3, 1.1, 0.5]])
    response, reasons = simulate_batch(model, thetas)
    assert [bool(reason) for reason in reasons] == [False, True, True, True, True, False]
    for reason, word in zip(reasons[1:5], ("frequency", "share", "damping", "coincide"), strict=True):
        assert word in reason
    np.testing.assert_array_equal(response[0], model.simulate(thetas[0]))
    frame = LinearStructure(ShearFrame({"top": 2}, [1, 1], [1, 1]), three[0])
    with pytest.raises(SimulationFailed, match="not positive: damping_2"):
        frame.simulate([1.0, 1.0, 0.1, -0.1])


def test_fingerprint_depends_on_parts_and_supports(three):
    model = LinearStructure(BridgeDeck("m"), three)
    assert model.fingerprint == LinearStructure(BridgeDeck("m"), three, unit="m/s2").fingerprint
    others = [
        LinearStructure(BridgeDeck("n"), three),
        LinearStructure(BridgeDeck("m", share=0.5), three),
        LinearStructure(BridgeDeck("m"), three[::-1]),
        LinearStructure(BridgeDeck("m"), three, lead=1.0),
        model.with_record([three[0].scale(2.0), *three[1:]]),
        LinearStructure(BridgeDeck("m"), three, outputs=("displacement@m",)),
        LinearStructure(ShearFrame({"m": 1}, [1], [1]), three[0]),
        LinearStructure(ShearFrame({"m": 1}, [1], [2]), three[0]),
    ]
    assert len({model.fingerprint, *(other.fingerprint for other in others)}) == 9
    assert LinearStructure(BridgeDeck("m"), three, outputs=("m",)).fingerprint == model.fingerprint


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda r: LinearStructure(BridgeDeck("m"), r[:2]), "each of the 3 supports of BridgeDeck; got 2"),
        (lambda r: LinearStructure(BridgeDeck("m"), [r[0], r[1], r[2].trim(0, 1)]), "the same step and length"),
        (lambda r: LinearStructure(BridgeDeck("m"), [r[0], r[1], r[2].resample(0.01)]), "the same step and length"),
        (lambda r: LinearStructure(BridgeDeck("m"), []), "expected Records"),
        (lambda r: LinearStructure(BridgeDeck("m"), [r[0].acceleration] * 3), "expected Records"),
        (lambda r: LinearStructure(BridgeDeck("m"), r, lead=8.0), "stop"),
        (lambda r: LinearStructure(BridgeDeck("m"), r, lead=-1.0), "start = -1"),
        (lambda r: BridgeDeck(""), "name of a channel"),
        (lambda r: BridgeDeck("m", share=1.1), "share must be a number from 0 to 1"),
        (lambda r: BridgeDeck("m", "s", shape=math.nan), "shape must be a number from 0 to 1"),
        (lambda r: ShearFrame({"top": 3}, [1, 1], [1, 1]), "floors from 1 to 2; got 3"),
        (lambda r: ShearFrame({"top": 2}, [1, 1], [1]), "a stiffness for each of 2"),
        (lambda r: ShearFrame({"top": 2}, [1, -1], [1, 1]), "positive mass or stiffness"),
        (lambda r: LinearStructure(BridgeDeck("m"), r, outputs=("n",)), "expected outputs out of m, one of.*; got 'n'"),
        (lambda r: LinearStructure(BridgeDeck("m", "s"), r, outputs=("displacement@m:s",)), "on one support"),
        (lambda r: LinearStructure(BridgeDeck("m"), r, outputs=("strain@m",)), "one of displacement, velocity"),
        (lambda r: LinearStructure(BridgeDeck("m"), r, outputs=("m", "m")), "each once"),
        (lambda r: LinearStructure(ShearFrame((), [1, 1], [1, 1]), r[0]), "channels must be a tuple of one or more"),
    ],
)
def test_wrong_arguments_are_rejected(three, make, words):
    with pytest.raises(ValueError, match=words):
        make(three)
