"""OpenSees models: accurate, repeatable, in a separate process; codes of ``analyze`` that are not handled."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from fe_likelihoods import LinearOscillator, OpenSeesModel, Record, SimulationFailed
from fe_likelihoods.models.opensees import _Codes
from tests.opensees_column import require_opensees
from tests.opensees_oscillator import CHANNELS, DAMPING, PERIOD, Oscillator

NAMES = ("stiffness", "damping")
DT, N_STEPS = 0.02, 200


@pytest.fixture(scope="module")
def record():
    require_opensees()
    acceleration = np.random.default_rng(4).normal(size=N_STEPS)
    acceleration[0] = 0.0
    return Record("noise", DT, acceleration)


def model_of(record, substeps, **options):
    function = Oscillator(record.acceleration, DT, substeps)
    return OpenSeesModel(function, NAMES, CHANNELS, DT, N_STEPS, **options)


@pytest.fixture(scope="module")
def model(record):
    return model_of(record, 5, time_limit=4.0)


def test_converges_to_the_exact_response_with_second_order(record):
    theta = np.array([1.2, 0.8])
    exact = LinearOscillator(record, PERIOD, DAMPING).simulate(theta)
    scale = np.abs(exact).max(axis=1)
    errors = []
    for substeps in (5, 10, 20):
        response = model_of(record, substeps).simulate(theta)
        errors.append(np.abs(response - exact).max(axis=1) / scale)
    # average acceleration elongates the period by the fraction (omega h)^2 / 12: 2e-5 with the smallest step
    assert (errors[-1] < 1e-3).all()
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.1)


def test_runs_are_independent(model, record):
    loaded_before = "openseespy.opensees" in sys.modules
    theta, other = np.array([1.2, 0.8]), np.array([0.4, 2.0])
    first = model.simulate(theta)
    model.simulate(other)
    np.testing.assert_array_equal(model.simulate(theta), first)
    np.testing.assert_array_equal(model_of(record, 5).simulate(theta), first)  # in a new process
    assert ("openseespy.opensees" in sys.modules) == loaded_before


def test_the_run_after_a_failure_is_not_affected(model):
    expected = model.simulate([1.0, 1.0])
    reasons = {
        9.0: "the worker process died (signal 6)",
        10.0: "stopped at the time limit of 4 s",
        11.0: "RuntimeError: OpenSees did not converge at step 1",
        np.nan: "",
    }
    for stiffness, reason in reasons.items():
        with pytest.raises(SimulationFailed) as caught:
            model.simulate([stiffness, 1.0])
        assert caught.value.reason.startswith(reason)
        np.testing.assert_array_equal(model.simulate([1.0, 1.0]), expected)


def test_an_analysis_that_stops_after_a_number_of_samples(record):
    def shaken(ops, theta, n_steps=N_STEPS):
        return Oscillator(record.acceleration[:n_steps], DT, 5)(ops, theta)

    model = OpenSeesModel(shaken, NAMES, CHANNELS, DT, N_STEPS)
    part = model.first(1.0)
    assert part.n_steps == 51 and part.fingerprint != model.fingerprint
    # the path of this excitation ends with the part: round-off of the clock interpolates between other values
    np.testing.assert_allclose(part.simulate([1.2, 0.8]), model.simulate([1.2, 0.8])[:, :51], rtol=0, atol=1e-9)
    assert not hasattr(model_of(record, 5), "first")


def test_wrong_arguments_are_rejected(record, monkeypatch):
    with pytest.raises(ValueError, match="expected a function of OpenSees"):
        OpenSeesModel(3, NAMES, CHANNELS, DT, N_STEPS)
    with pytest.raises(ValueError, match="time_limit must be a positive number"):
        model_of(record, 5, time_limit=-1.0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="pip install openseespy"):
        model_of(record, 5)


# codes of ops.analyze ------------------------------------------------------------------------------------------------

HARD_DT, HARD_N = 0.02, 100


def prepare(ops, iterations):
    """A yielding mass under a pulse: each step converges with 50 iterations, no step with one."""
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(1, 0.0)
    ops.node(2, 0.0)
    ops.fix(1, 1)
    ops.mass(2, 1.0)
    ops.uniaxialMaterial("Steel01", 1, 2.0, 70.0, 0.01)
    ops.element("zeroLength", 1, 1, 2, "-mat", 1, "-dir", 1)
    ops.timeSeries("Trig", 1, 0.0, 10.0, 1.0, "-factor", 3.0)
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-8, iterations)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")


def step_by_step(step):
    """Function of iterations that makes a step at each sample, until a step returns False."""

    def run(ops, theta):
        prepare(ops, int(theta[0]))
        response = np.zeros((1, HARD_N))
        for sample in range(HARD_N):
            if step(ops, sample) is False:
                break
            response[0, sample] = ops.nodeDisp(2, 1)
        return response

    return run


def ignores(ops, sample):
    ops.analyze(1, HARD_DT)


def imports(ops, sample):
    import openseespy.opensees

    openseespy.opensees.analyze(1, HARD_DT)


def by_name():
    from openseespy.opensees import analyze as advance

    def step(ops, sample):
        advance(1, HARD_DT)

    return step


def says_so_and_goes_on(ops, sample):
    if ops.analyze(1, HARD_DT) != 0:
        print("step", sample, "failed")


def breaks(ops, sample):
    return ops.analyze(1, HARD_DT) >= 0


def repeats(ops, sample):
    if ops.analyze(1, HARD_DT) != 0:
        ops.test("NormDispIncr", 1e-8, 50)
        ops.algorithm("ModifiedNewton", "-initial")
        ops.analyze(1, HARD_DT)
        ops.test("NormDispIncr", 1e-8, 1)
        ops.algorithm("Newton")


def in_one_call(ops, theta):
    prepare(ops, int(theta[0]))
    ops.analyze(HARD_N, HARD_DT)
    return np.full((1, HARD_N), ops.nodeDisp(2, 1))


def collects(ops, theta):
    """Tests all codes at the end, and begins anew if any is not 0."""
    for iterations in (int(theta[0]), 50):
        ops.wipe()
        prepare(ops, iterations)
        response, codes = np.zeros((1, HARD_N)), []
        for sample in range(HARD_N):
            codes.append(ops.analyze(1, HARD_DT))
            response[0, sample] = ops.nodeDisp(2, 1)
        if not any(codes):
            break
    return response


def pushed_after_gravity(ops, theta):
    """A static stage that is tested, and does not converge with one iteration, before one that converges."""
    prepare(ops, int(theta[0]))
    ops.remove("loadPattern", 1)
    ops.timeSeries("Linear", 2)
    ops.pattern("Plain", 2, 2)
    ops.load(2, 0.5)
    ops.wipeAnalysis()
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-8, int(theta[0]))
    ops.algorithm("Newton")
    ops.integrator("LoadControl", 0.25)
    ops.analysis("Static")
    if ops.analyze(4) != 0:
        print("gravity failed")
    ops.loadConst("-time", 0.0)
    ops.test("NormDispIncr", 1e-8, 50)
    ops.timeSeries("Linear", 3)
    ops.pattern("Plain", 3, 3)
    ops.load(2, 1.0)
    ops.integrator("DisplacementControl", 2, 1, 0.001)
    response = np.zeros((1, HARD_N))
    for sample in range(HARD_N):
        if ops.analyze(1) != 0:
            raise RuntimeError("no convergence")
        response[0, sample] = ops.nodeDisp(2, 1)
    return response


UNHANDLED = {
    "ignores": (step_by_step(ignores), "returned -3 at call 1 of 100 and the script did not look at it"),
    "imports": (step_by_step(imports), "returned -3 at call 1 of 100 and the script did not look at it"),
    "in one call": (in_one_call, "returned -3 at call 1 of 1 and the script did not look at it"),
    "says so and goes on": (
        step_by_step(says_so_and_goes_on),
        "returned -3 at call 100 of 100 and the script ended there",
    ),
    "breaks": (step_by_step(breaks), "returned -3 at call 1 of 1 and the script ended there"),
    "gravity": (pushed_after_gravity, "returned -3 at call 1 of 101 and the script went on with ops.loadConst"),
}
HANDLED = {"repeats": step_by_step(repeats), "collects": collects}


def hard(function):
    require_opensees()
    return OpenSeesModel(function, ("iterations",), CHANNELS[1:], HARD_DT, HARD_N)


@pytest.mark.parametrize("script", UNHANDLED)
def test_a_code_that_the_script_does_not_handle_is_a_failed_simulation(script):
    function, reason = UNHANDLED[script]
    model = hard(function)
    assert np.isfinite(model.simulate([50])).all()
    with pytest.raises(SimulationFailed, match=reason):
        model.simulate([1])
    assert np.isfinite(model.simulate([50])).all()  # codes of the run before do not count


@pytest.mark.parametrize("script", HANDLED)
def test_a_script_may_repeat_what_has_failed(script):
    model = hard(HANDLED[script])
    np.testing.assert_allclose(model.simulate([1]), model.simulate([50]), atol=1e-6)


@pytest.mark.slow
def test_functions_that_the_script_has_imported_by_name_are_watched():
    """In a process of its own, since this script imports OpenSees."""
    require_opensees()
    code = (
        "import tests.models.test_opensees as t, pytest\n"
        "model = t.hard(t.step_by_step(t.by_name()))\n"
        "assert model.simulate([50]).any()\n"
        "with pytest.raises(t.SimulationFailed, match='did not look at it'): model.simulate([1])\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


LOOKS = {
    "if": lambda code: not code,
    "comparison": lambda code: code < 0,
    "in a tuple": lambda code: code in (0, 1),
    "any": lambda code: any([0, code]),
    "int": int,
    "float": float,
    "abs": abs,
    "in an array": lambda code: np.array([0, code]),
    "numpy": lambda code: np.any([0, code]),
}
NO_LOOKS = {"printed": "{}".format, "repr": repr, "kept": lambda code: [code]}


@pytest.mark.parametrize("look", [*LOOKS, *NO_LOOKS])
def test_what_is_a_look_at_a_code(look):
    codes = _Codes()
    code = codes.analyze(lambda *arguments: -3, 1, 0.01)
    assert type(code) is not int and codes.analyze(lambda: 0) == 0
    assert (LOOKS | NO_LOOKS)[look](code) is not None
    assert ("did not look" in codes.reason) == (look in NO_LOOKS) and (codes.reason == "") == (look in LOOKS)
    assert code == -3 and hash(code) == hash(-3)
    assert codes.reason == ""
