"""No way of changing a model lets the cache use simulations of another model in silence."""

import copy
import os
import pickle
import sys
import time
from collections import Counter

import numpy as np
import pytest

from fe_likelihoods import ExecutableModel, FELikelihood, FunctionModel, LocalPool, SimulationCache
from fe_likelihoods.simulation import changed_model
from fe_likelihoods.simulation.by_value import Pickled
from fe_likelihoods.simulation.changed_model import current_fingerprint
from fe_likelihoods.simulation.code_digest import code_digest
from fe_likelihoods.simulation.faults import ChangedModel

from . import model_changes as changes
from . import value_models
from .model_changes import CHANNELS, N_STEPS, NAMES, NOTICED, THETAS


@pytest.mark.parametrize("way", [*changes.CODE, *changes.OUTSIDE], ids=lambda way: way.name)
def test_a_change_between_two_runs(way):
    assert changes.between(way) == way.expected


@pytest.mark.parametrize("way", changes.DURING, ids=lambda way: way.name)
def test_a_change_during_a_run(way):
    """Its simulations are not stored under the key of the earlier model."""
    assert changes.during(way) == NOTICED


def test_only_what_is_documented_is_used_unseen():
    expected = Counter(way.expected for way in [*changes.CODE, *changes.OUTSIDE])
    assert len(changes.CODE) + len(changes.OUTSIDE) + len(changes.DURING) > 80
    assert expected[changes.DOCUMENTED] == 3


# functions that change what they use ----------------------------------------------------------------------------------

COUNTS = "calls = 0\ndef f(t):\n    global calls\n    calls += 1\n    return line(t)"
RARELY = "failed = []\ndef f(t):\n    if t[0] > 0.6: failed.append(t)\n    return line(t)"
KEEPS = "known = {}\ndef f(t):\n    known[tuple(t)] = 1.0\n    return line(t)"


@pytest.mark.parametrize("body", [COUNTS, KEEPS, RARELY], ids=["a counter", "earlier results", "a list of some runs"])
def test_a_function_that_changes_its_own_state_is_not_refused(body, tmp_path):
    with changes.workshop(changes.user(body)) as folder:
        first = changes.likelihood_of(folder, {}, SimulationCache(tmp_path / "cache.sqlite"))
        for row in THETAS:
            first.misfit(row)
        assert first.cache.info().simulations == len(THETAS)
        Pickled.of(first.model)
        again = changes.likelihood_of(folder, {}, SimulationCache(tmp_path / "cache.sqlite"))
        again.misfit(THETAS)
        assert (again.simulations, again.verifications) == (0, 2)


def test_rows_since_the_last_comparison_are_deleted_after_a_change(tmp_path, monkeypatch):
    """The fingerprint is computed again in 1 % of the time, so a few rows are stored before a change is noticed."""
    with changes.workshop(changes.user("E = 2.5\ndef f(t): return E * line(t)")) as folder:
        likelihood = changes.likelihood_of(folder, {}, SimulationCache(tmp_path / "cache.sqlite", responses=True))
        likelihood.misfit(THETAS[:2])
        likelihood._guard._not_before = time.monotonic() + 1e6
        sys.modules["user"].E = 2.6
        likelihood.misfit(THETAS[2:4])
        assert likelihood.cache.info().simulations == 4
        likelihood._guard._not_before = 0.0
        with pytest.raises(ChangedModel, match="FunctionModel has changed since the likelihood was made"):
            likelihood.misfit(THETAS[4:5])
        info = likelihood.cache.info()
        assert (info.simulations, info.responses, len(likelihood.memory_cache)) == (2, 2, 0)
    monkeypatch.setattr(changed_model, "_SHARE_OF_TIME", 0.01)
    guard = changed_model.ModelGuard(likelihood.model)
    computed = []
    monkeypatch.setattr(
        changed_model, "current_fingerprint", lambda model: computed.append(time.sleep(0.001)) or model.fingerprint
    )
    start = time.monotonic()
    while time.monotonic() < start + 0.25:
        guard.before(likelihood.model, lambda: True)
        guard.after(likelihood.model, lambda: True, THETAS, True, 0.0)
    assert 2 <= len(computed) <= 6


def test_a_change_in_memory_is_noticed_without_a_file():
    with changes.workshop(changes.user("E = [2.5]\ndef f(t): return E[0] * line(t)")) as folder:
        likelihood = changes.likelihood_of(folder, {}, None)
        likelihood.misfit(THETAS[:2])
        sys.modules["user"].E[0] = 2.6
        with pytest.raises(ChangedModel):
            likelihood.misfit(THETAS[2:])


EDITED = changes.user("import helper\ndef f(t): return helper.g(line(t)) * helper.E", helper=changes.HELPER)
STARTED = "import time\nstarted = time.time()\ndef f(t):\n    return line(t) if started else None"
OBJECT = (
    "class Counting:\n    calls = 0\n    def __call__(self, t):\n"
    "        self.calls += 1\n        return line(t)\nf = Counting()"
)
LAZY = "def f(t):\n    global steps\n    steps = 1.0\n    return steps * line(t)"
ATTRIBUTE = "def f(t):\n    f.calls = getattr(f, 'calls', 0) + 1\n    return line(t)"
HONEST = {
    "a counter": COUNTS,
    "earlier results": KEEPS,
    "the time of the start": STARTED,
    "an object": OBJECT,
    "a lazy global": LAZY,
    "an attribute": ATTRIBUTE,
}


@pytest.mark.parametrize("name", ["Data", "Frozen", "Slotted", "Named", "Concrete"])
def test_a_pickle_or_copy_of_an_instance_changes_no_digest(name):
    """Python writes attributes of its own into the class, such as `__slotnames__`."""
    function = getattr(value_models, name)()
    before = code_digest(function)
    same = [pickle.loads(pickle.dumps(function, protocol)) for protocol in (2, 4, 5)]
    same += [copy.copy(function), copy.deepcopy(function)]
    isinstance(function, value_models.Abstract)
    assert {code_digest(each) for each in (function, *same)} == {before}


# real processes -------------------------------------------------------------------------------------------------------


def test_a_dataclass_runs_in_a_pool():
    likelihood = FELikelihood(FunctionModel(value_models.Pooled(), NAMES, CHANNELS, 0.1, N_STEPS), changes.DATA)
    with LocalPool(2) as likelihood.pool:
        misfits = likelihood.misfit(THETAS)
    direct = FELikelihood(likelihood.model, changes.DATA)
    np.testing.assert_array_equal(misfits, direct.misfit(THETAS))
    assert likelihood.failure_count == 0


@pytest.mark.parametrize("isolated", [False, True], ids=["pool", "isolated"])
def test_processes_run_the_code_of_this_process_after_a_file_was_edited(isolated):
    with changes.workshop(EDITED) as folder, LocalPool(1) as pool:
        expected = changes.likelihood_of(folder, {}, None).misfit(THETAS)
        likelihood = changes.likelihood_of(folder, {"isolated": isolated}, None)
        if not isolated:
            likelihood.pool = pool
        (folder / "helper.py").write_text(changes.HELPER.replace("3.0", "4.0"))
        np.testing.assert_array_equal(likelihood.misfit(THETAS), expected)


# arguments ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("depends_on", "message"),
    [
        ("table.txt", "must be a list of Paths and values"),
        ({"a": 1}, "must be a list"),
        ([__file__], "is the name of a file; write Path"),
        ([changes.Path("/no/such/file")], "no such file or folder"),
        ([sys.stdout], "no digest of .* in depends_on can be computed"),
    ],
    ids=["a name", "a dict", "a text", "a missing file", "an open file"],
)
def test_wrong_dependencies_are_rejected(depends_on, message):
    with pytest.raises(ValueError, match=message):
        FunctionModel(np.sum, NAMES, CHANNELS, 0.1, N_STEPS, depends_on=depends_on)


def test_a_file_that_the_program_writes_is_named(tmp_path):
    log = tmp_path / "solver.log"
    log.write_text("")
    command = ["sh", "-c", "echo $0 >> $1; for k in 1 2 3; do cat in.txt; done > out.txt", "${offset}", str(log)]
    command[2] = command[2].replace("$", "$$")
    options = {"time_limit": 30.0, "columns": [0]}

    def model(**more):
        return ExecutableModel(
            command, {"in.txt": "$offset $slope\n"}, "out.txt", NAMES, CHANNELS, 0.1, 3, **options | more
        )

    plain, named = model(), model(written=[log])
    for one in (plain, named):
        assert current_fingerprint(one) == one.fingerprint
    np.testing.assert_array_equal(named.simulate([0.5, 0.1]), np.full((1, 3), 0.5))
    assert log.read_text() == "0.5\n"
    assert current_fingerprint(named) == named.fingerprint == model(written=[log]).fingerprint
    assert current_fingerprint(plain) != plain.fingerprint != model().fingerprint
    with pytest.raises(ChangedModel, match="the program itself writes belongs in written="):
        changed_model.ModelGuard(plain).before(plain, lambda: True)


def test_the_digest_of_a_function_takes_milliseconds():
    with changes.workshop(EDITED) as folder:
        function = changes.likelihood_of(folder, {}, None).model.function
        seconds = []
        for _ in range(20):
            start = time.perf_counter()
            code_digest(function)
            seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.01


# calls of the user between two batches with a pool -------------------------------------------------------------------

FORKS = pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
BETWEEN_BATCHES = HONEST | {
    "a list of some runs": RARELY,
    "an argument": "known = []\ndef keep(table, t): table.append(t)\ndef f(t):\n    keep(known, t)\n    return line(t)",
    "a local name": "known = {}\ndef f(t):\n    table = known\n    table[t[0]] = t\n    return line(t)",
    "a closure": (
        "def make():\n    calls = 0\n    def f(t):\n        nonlocal calls\n        calls += 1\n"
        "        return line(t)\n    return f\nf = make()"
    ),
    "another module": "import helper\ndef f(t):\n    helper.calls += 1\n    return line(t)",
    "a class attribute": (
        "class A:\n    calls = 0\n    def __call__(self, t):\n        type(self).calls += 1\n"
        "        return line(t)\nf = A()"
    ),
    "a private attribute": OBJECT.replace("calls", "__calls"),
    "a counter of numpy": "calls = np.zeros(2)\ndef f(t):\n    calls[0] += 1\n    return line(t)",
    "a workspace": "work = np.zeros((1, 20))\ndef f(t):\n    np.copyto(work, line(t))\n    return work.copy()",
    "an output argument": "work = np.zeros((1, 20))\ndef f(t): return np.add(line(t), 0.0, out=work).copy()",
    "an open file": (
        "import os\nclass A:\n    log = None\n    def __call__(self, t):\n        if self.log is None:\n"
        "            self.log = open(os.devnull, 'w')\n        return line(t)\nf = A()"
    ),
    "a lambda": "known = []\nf = lambda t: known.append(t) or line(t)",
    "an iterator": "import itertools\ncount = itertools.count()\ndef f(t): return line(t) + 0 * next(count)",
    "random numbers": "rng = np.random.default_rng(1)\ndef f(t): return line(t) + 0 * rng.normal()",
}


class Processes:
    """A pool whose workers are processes that begin with the values of this one, and leave these as they are."""

    n_workers = 2

    def map(self, function, items):
        reader, writer = os.pipe()
        child = os.fork()
        if not child:
            os.write(writer, pickle.dumps([function(item) for item in items]))
            os._exit(0)
        os.waitpid(child, 0)
        os.close(writer)
        with open(reader, "rb") as file:
            return pickle.load(file)


def pooled(folder):
    """Likelihood with a pool, and the module of the user."""
    likelihood = changes.likelihood_of(folder, {}, SimulationCache(folder / "cache.sqlite"))
    likelihood.pool = Processes()
    return likelihood, sys.modules["user"]


@pytest.mark.parametrize("body", BETWEEN_BATCHES.values(), ids=BETWEEN_BATCHES)
@FORKS
def test_a_user_may_call_the_function_between_two_batches_of_a_pool(body, monkeypatch):
    monkeypatch.setattr(changed_model, "_NO_TIME", np.inf)  # compare before every batch, however quick the machine
    with changes.workshop(changes.user(body, helper="calls = 0\n")) as folder:
        likelihood, module = pooled(folder)
        for start in range(0, 6, 2):
            module.f(THETAS[start] + 0.5)
            values = likelihood.misfit(THETAS[start : start + 2])
        assert np.isfinite(values).all()
        assert likelihood.cache.info().simulations == likelihood.simulations == 6
        # two points are simulated again before the second batch, and none before the third
        assert likelihood.verifications == (0 if body == STARTED else 2)


OTHERS = {
    "a global number": (f"E = 2.5\n{COUNTS.replace('line', 'E * line')}", "module.E = 2.6"),
    "an attribute that __init__ sets": (
        "class A:\n    def __init__(self): self.k, self.calls = 2.5, 0\n"
        "    def __call__(self, t):\n        self.calls += 1\n        return self.k * line(t)\nf = A()",
        "module.f.k = 2.6",
    ),
    "an array in a function with a work array": (
        "E = np.array([2.5])\ndef f(t):\n    x = np.zeros((1, 20))\n    x[:] = E * line(t)\n    return x",
        "module.E[0] = 2.6",
    ),
    "an item of the table with the counter": (
        "D = {'E': 2.5, 'calls': 0}\ndef f(t):\n    D['calls'] += 1\n    return D['E'] * line(t)",
        "module.D['E'] = 2.6",
    ),
    "a variable that the function assigns": (
        "E, last = 2.5, 0\ndef f(t):\n    global last, E\n    last, E = t, E\n    return E * line(t)",
        "module.E = 2.6",
    ),
}


@pytest.mark.parametrize(("body", "change"), OTHERS.values(), ids=OTHERS)
@FORKS
def test_a_function_that_counts_is_still_compared(body, change, monkeypatch):
    """With calls between the batches; what the function cannot change itself is noticed without a simulation."""
    with changes.workshop(changes.user(body)) as folder:
        likelihood, module = pooled(folder)
        likelihood.misfit(THETAS[:2])
        module.f(THETAS[0])
        likelihood.misfit(THETAS[2:4])
        repeated = likelihood.verifications
        exec(change, {"module": module})
        monkeypatch.setattr(changed_model, "_ROWS_PER_REPETITION", 2)
        with pytest.raises(ChangedModel) as caught:
            likelihood.misfit(THETAS[4:])
        by_repetition = "an earlier simulation gives another result" in str(caught.value)
        assert by_repetition == (likelihood.verifications > repeated) == ("D[" in body or "global last, E" in body)
        # simulations since the last time that nothing differed, or that earlier points were repeated, are deleted
        assert likelihood.cache.info().simulations == (2 if "calls" in body else 4)


@pytest.mark.parametrize(("seconds", "noticed"), [(10.0, True), (1e-6, False)], ids=["long", "short"])
def test_a_long_batch_is_compared_before_it_is_stored(seconds, noticed, monkeypatch):
    """However short ago the last comparison was: it takes less than 1 % of the time of the simulations."""
    with changes.workshop(changes.user("E = 2.5\ndef f(t): return E * line(t)")) as folder:
        model = changes.likelihood_of(folder, {}, None).model
        monkeypatch.setattr(changed_model, "_SHARE_OF_TIME", 0.01)
        guard = changed_model.ModelGuard(model)
        guard.before(model, lambda: True)
        guard._not_before = np.inf
        guard.before(model, lambda: True)
        sys.modules["user"].E = 2.6
        if noticed:
            with pytest.raises(ChangedModel):
                guard.after(model, lambda: True, THETAS, False, seconds)
        else:
            guard.after(model, lambda: True, THETAS, False, seconds)
        assert len(guard.unchecked) == 1
