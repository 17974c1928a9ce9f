"""Models defined by a Python function: same bits in every process, failures with reasons, fingerprint of the code."""

import functools
import math
import multiprocessing
import pickle
import threading
from dataclasses import dataclass
from multiprocessing.pool import ThreadPool
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import Channel, FunctionModel, Record, SimulationFailed
from fe_likelihoods.simulation.label import ModelLabel, value_digest
from fe_likelihoods.simulation.model import simulate_batch
from tests.faults import treacherous as bad
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, line, treacherous

NAMES = ("offset", "slope")
THETA = np.array([0.3, 0.1])


def model_of(function=treacherous, **options):
    return FunctionModel(function, NAMES, CHANNELS, DT, N_STEPS, **options)


def failure(model, what):
    """Reason of a failed simulation."""
    with pytest.raises(SimulationFailed) as caught:
        model.simulate([what + 0.5, 0.1])
    return caught.value.reason


@pytest.fixture(scope="module")
def guarded():
    return model_of(time_limit=4.0)


# responses ---------------------------------------------------------------------------------------------------


def test_same_bits_in_process_and_isolated(guarded):
    assert guarded.isolated
    assert not model_of().isolated
    for theta in np.random.default_rng(0).uniform(0.0, 1.0, size=(5, 2)):
        np.testing.assert_array_equal(guarded.simulate(theta), line(theta))
        np.testing.assert_array_equal(model_of().simulate(theta), line(theta))


def test_a_forgotten_return_is_named():
    with pytest.raises(SimulationFailed, match=r"shape \(\), expected .* = \(1, 20\): is it None"):
        model_of(lambda theta: None).simulate(THETA)


def test_an_array_that_the_function_uses_again_is_copied():
    array = np.zeros((len(CHANNELS), N_STEPS))

    def reuses(theta):
        array[:] = line(theta)
        return array

    thetas = np.array([THETA, 2.0 * THETA])
    np.testing.assert_array_equal(simulate_batch(model_of(reuses), thetas).response, [line(THETA), line(2.0 * THETA)])


def test_theta_of_the_caller_is_not_changed():
    def scribbles(theta):
        theta[:] = 0.0
        return line(theta)

    theta = THETA.copy()
    model_of(scribbles).simulate(theta)
    np.testing.assert_array_equal(theta, THETA)


def _attempt(model, theta):
    try:
        return model.simulate(theta).tolist()
    except SimulationFailed as error:
        return error.reason


@pytest.mark.parametrize("kind", ["threads", "forks"])
def test_threads_and_forks_have_separate_processes(kind):
    """A fork starts a new process even if the model had one before, which belongs to the parent."""
    guarded = model_of(time_limit=60.0)  # nothing waits here, and another machine may be slow
    guarded.simulate(THETA)
    thetas = [np.array([0.1 * k, 0.2]) for k in range(6)]
    thetas[2][0] = bad.CRASHES + 0.5
    pool = ThreadPool(3) if kind == "threads" else multiprocessing.get_context("fork").Pool(2)
    with pool:
        results = pool.map(functools.partial(_attempt, guarded), thetas, chunksize=1)
    expected = [line(theta).tolist() for theta in thetas]
    expected[2] = "the worker process died (signal 11)"
    assert results == expected
    np.testing.assert_array_equal(guarded.simulate(THETA), line(THETA))


def test_a_process_is_replaced_after_a_number_of_runs():
    model = pickle.loads(pickle.dumps(model_of(bad.process_id, runs_per_process=2)))
    pids = [model.simulate(THETA)[0, 0] for _ in range(4)]
    assert model.isolated
    assert pids[0] == pids[1] != pids[2] == pids[3]


# failures ----------------------------------------------------------------------------------------------------

REASONS = {
    "RAISES": "ZeroDivisionError: float division by zero",
    "REFUSES": "no convergence at step 3",
    "NOT_FINITE": "the response of channel 'a' is not finite",
    "SHAPE": "the response has shape (1, 19), expected (n_channels, n_steps) = (1, 20)",
}
DEADLY = {
    "CRASHES": "the worker process died (signal 11)",
    "KILLED": "the worker process died (signal 9)",
    "LEAVES": "the worker process ended with exit code 3",
    "HANGS": "stopped at the time limit of 4 s",
    "HANGS_HARD": "stopped at the time limit of 4 s",
    "FLOODS": "stopped at the time limit of 4 s",
}


@pytest.mark.parametrize("name", REASONS)
def test_reasons_in_process_and_isolated(name, guarded):
    for model in (model_of(), guarded):
        assert failure(model, getattr(bad, name)) == REASONS[name]


@pytest.mark.parametrize("name", DEADLY)
def test_a_killed_process_is_a_failure_and_the_next_run_succeeds(name, guarded):
    assert failure(guarded, getattr(bad, name)).startswith(DEADLY[name])
    np.testing.assert_array_equal(guarded.simulate(THETA), line(THETA))


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"time_limit": 0.0}, "time_limit must be a positive number of seconds"),
        ({"time_limit": "long"}, "time_limit"),
        ({"runs_per_process": 0}, "runs_per_process must be None or a positive integer"),
        ({"function": 3}, "expected a function"),
        (
            {"function": lambda theta, file=(i for i in ()): line(theta), "isolated": True},
            "cannot be sent to another",
        ),
        ({"parameter_names": ()}, "parameter_names must be a tuple of one or more str"),
        ({"parameter_names": "ab"}, "parameter_names"),
        ({"parameter_names": ("a", "a")}, "must differ"),
        ({"channels": ("a",)}, "channels must be a tuple of one or more Channel"),
        ({"channels": CHANNELS * 2}, "must differ"),
        ({"dt": 0.0}, "dt must be a positive number of seconds"),
        ({"n_steps": 0}, "n_steps must be a positive integer"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # the address of a lambda differs between processes
)
def test_wrong_arguments_are_rejected(options, advice):
    settings = {"function": line, "parameter_names": NAMES, "channels": CHANNELS, "dt": DT, "n_steps": N_STEPS}
    with pytest.raises(ValueError, match=advice):
        FunctionModel(**settings | options)


# fingerprints -------------------------------------------------------------------------------------------------------


def scaled(by):
    return lambda theta: by * line(theta)


def defined(source):
    """Function f defined by `source`, as in a module."""
    space = {"__name__": "someones_model", "np": np, "math": math}
    exec(source, space)
    return space["f"]


CODE = "G = 9.8\ndef g(x):\n    return x * G\ndef f(theta, n=3):\n    '''Doc.'''\n    return g(theta) + 1.5 * n\n"
TUPLE = """
from typing import NamedTuple
class Storey(NamedTuple):
    mass: float = 3.0
    def half(self):
        return self.mass / 2
    @property
    def double(self):
        return self.mass * 2
def f(theta):
    return theta[0] * Storey().half() * Storey().double
"""


CHANGES = {
    CODE: [
        ("G = 9.8", "G = 9.81"),
        ("x * G", "x / G"),
        ("1.5", "1.25"),
        ("n=3", "n=4"),
        ("+ 1.5", "- 1.5"),
        ("1.5", "15"),
    ],
    TUPLE: [("3.0", "4.0"), ("/ 2", "/ 3"), ("* 2", "* 4"), ("mass", "load")],
}


@pytest.mark.parametrize("code", CHANGES, ids=["function", "tuple"])
def test_equal_code_has_equal_digests_and_every_change_another(code):
    assert value_digest(defined(code)) == value_digest(defined(code))
    assert value_digest(defined(code)) == value_digest(defined("# a comment\n" + code.replace(" * ", "*")))
    for old, new in CHANGES[code]:
        assert value_digest(defined(code)) != value_digest(defined(code.replace(old, new))), new


def test_values_in_a_closure_enter_the_digest():
    record = Record("r", 0.1, np.arange(5.0))
    table = np.arange(6.0)
    values = [2.0, 3.0, "2.0", (1, 2), [1, 2], {"a": 1}, {"a": 2}, table, table[::2], record, record.scale(2.0), None]
    values += [functools.partial(scaled, 2.0), functools.partial(scaled, 3.0), Path("a"), np.float64(2.0), {3, 4}]
    digests = {value_digest(scaled(value)) for value in values}
    assert len(digests) == len(values)
    assert value_digest(scaled(table.copy())) == value_digest(scaled(table))
    assert value_digest(scaled(Record("r", 0.1, np.arange(5.0)))) == value_digest(scaled(record))


@dataclass
class Spring:
    stiffness: float

    def respond(self, theta):
        return self.stiffness * line(theta)

    def __call__(self, theta):
        return self.respond(theta)


def test_methods_and_callable_objects():
    assert value_digest(Spring(1.0).respond) == value_digest(Spring(1.0).respond)
    assert value_digest(Spring(1.0).respond) != value_digest(Spring(2.0).respond)
    assert value_digest(Spring(1.0)) != value_digest(Spring(2.0))
    assert value_digest(Spring(1.0)) != value_digest(Spring(1.0).respond)


def test_fingerprint_depends_on_names_channels_and_steps():
    models = [
        model_of(),
        FunctionModel(treacherous, ("a", "b"), CHANNELS, DT, N_STEPS),
        FunctionModel(treacherous, NAMES, (Channel("b", "acceleration", "g"),), DT, N_STEPS),
        FunctionModel(treacherous, NAMES, CHANNELS, 0.2, N_STEPS),
        FunctionModel(treacherous, NAMES, CHANNELS, DT, 21),
    ]
    assert len({model.fingerprint for model in models}) == len(models)
    assert model_of(time_limit=1.0).fingerprint == models[0].fingerprint  # the process does not change a response


def test_attributes_of_a_subclass_are_part_of_the_label():
    class Own(FunctionModel):
        def __init__(self, factor):
            self.factor = factor
            super().__init__(np.sin, ("a",), CHANNELS, DT, N_STEPS, version="1")
            self.lock = threading.Lock()

    labels = [ModelLabel(Own(factor)).code for factor in (2.5, 2.5, 3.0)]
    assert labels[0] == labels[1] != labels[2]
