"""Workers compute with the code and the values of the process that sends them, whatever its files say."""

import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from fe_likelihoods import FunctionModel
from fe_likelihoods.simulation import by_value
from fe_likelihoods.simulation.by_value import Pickled, load
from fe_likelihoods.simulation.executors import LocalPool, Sandbox, as_executor
from fe_likelihoods.simulation.failure_reasons import ChangedModel
from fe_likelihoods.simulation.label import ModelLabel
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Treacherous, line

LAW = """
import functools
import threading
import numpy as np
from numpy import sqrt
K = 2.0
LOCK = threading.Lock()
def get():
    return K
class Spring:
    stiffness = property(lambda self: K)
    make = staticmethod(lambda: Spring())
    lock = threading.RLock()
    def force(self, x):
        return K * x
def direct(x):
    return K * x
def through_a_class(x):
    return Spring.make().force(x) / Spring().stiffness * K
def with_a_lock(x):
    with LOCK, Spring.lock:
        return K * x
def counts(x):
    global K
    K = K + 1.0
    import law
    return law.K * x
@functools.cache
def cached(x):
    return K * x
class Cached:
    @functools.lru_cache(maxsize=3)
    def force(self, x):
        return K * x
class Private:
    __slots__ = ("__k", "__dict__")
    def __init__(self):
        self.__k = K
    @functools.cached_property
    def stiffness(self):
        return self.__k
def through_private_slots(x):
    return Private().stiffness * x
class Named:  # is pickled by its name, as compiled functions are
    def __reduce__(self):
        return "bad"
def through_a_cache(x):
    return cached(x) + Cached().force(x) - K * x
def through_numpy(x):
    return float(sqrt(K * x))
"""
USER = """
import law, pack.deep
from law import direct
def by_module(x):
    return law.K * x
def by_name(x):
    return direct(x)
def late(x):
    from law import K
    return K * x
def late_module(x):
    import law as there
    return there.get() * x
def deep(x):
    return pack.deep.twice(x)
def late_relative(x):
    return pack.late(x)
"""
FUNCTIONS = ("by_module", "by_name", "late", "late_module", "deep", "late_relative")


@pytest.fixture
def user(tmp_path, monkeypatch):
    """Modules of a user, whose values have been changed after they were imported."""
    (tmp_path / "law.py").write_text(LAW)
    (tmp_path / "user.py").write_text(USER)
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("def late(x):\n    from .deep import twice\n    return twice(x)\n")
    (tmp_path / "pack" / "deep.py").write_text("import law\ndef twice(x):\n    return law.get() * x\n")
    monkeypatch.syspath_prepend(tmp_path)
    names = ("law", "user", "pack", "pack.deep")
    import user as module

    module.law.K = 3.0
    yield module
    for name in names:
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def pool():
    with LocalPool(1) as pool:
        yield pool


def results(user, pool):
    return {name: pool.map(getattr(user, name), [1.0, 2.0]) for name in FUNCTIONS}


def test_a_worker_has_the_values_of_the_parent_also_after_they_change(user, pool):
    """The functions are sent again when anything that they use has changed."""
    for k in (3.0, 4.0, 3.0):
        user.law.K = k
        assert results(user, pool) == dict.fromkeys(FUNCTIONS, [k, 2.0 * k])
        assert pool.map(user.law.through_a_class, [1.0]) == [k]
        assert [pool.submit(user.late, 1.0).result(), pool.submit(user.deep, 1.0).result()] == [k, k]
    user.law.get = lambda: 10.0  # another function of the same name
    assert pool.map(user.late_module, [1.0]) == [10.0]


def test_a_global_that_is_not_defined_yet_is_not_none(pool):
    """As in a notebook whose cells are run in another order."""
    script = sys.modules["__main__"]
    exec(
        "def defined(item):\n    try:\n        return [_late_value]\n    except NameError:\n        return []",
        vars(script),
    )
    try:
        for _ in range(3):
            assert pool.map(script.defined, [0]) == [[]]
        script._late_value = None
        assert pool.map(script.defined, [0]) == [[None]]
    finally:
        del script.defined
        vars(script).pop("_late_value", None)


def test_a_sent_model_has_the_same_label(pool):
    model = Treacherous()
    assert pool.map(lambda _: ModelLabel(model).items, [0]) == [ModelLabel(model).items]


@pytest.mark.parametrize("start", ["spawn", "fork"])
def test_the_same_in_processes_of_other_pools(start, user, pool):
    with ProcessPoolExecutor(1, mp_context=get_context(start)) as executor, get_context(start).Pool(1) as processes:
        for other in (as_executor(executor), as_executor(processes)):
            for k in (3.0, 4.0, 3.0):  # the workers keep several functions
                user.law.K = k
                assert results(user, other) == dict.fromkeys(FUNCTIONS, [k, 2.0 * k])
                assert other.map(user.law.through_a_class, [1.0]) == [k]


def test_the_same_in_an_isolated_process(user):
    sandbox = Sandbox(user.late_module)
    user.law.K = 5.0
    assert sandbox(1.0) == 5.0
    user.law.K = 6.0
    assert sandbox(1.0) == 6.0


def test_a_module_is_one_namespace_in_the_worker(user, pool):
    assert pool.map(user.law.counts, [1.0, 1.0]) == [4.0, 5.0]
    assert user.law.K == 3.0


class Unsendable:
    def __reduce__(self):
        raise TypeError(f"cannot pickle <Unsendable object at {id(self):#x}>")


def test_locks_are_new_and_values_that_cannot_be_sent_are_refused_with_their_type(user, pool):
    assert pool.map(user.law.with_a_lock, [1.0]) == [3.0]
    user.law.bad = (number for number in (1, 2))
    for function in (user.law.direct, user.by_name):
        with pytest.raises(ValueError, match=f"{function.__name__} cannot be sent .*cannot pickle 'generator'"):
            pool.map(function, [1.0])
    user.law.bad = Unsendable()
    with pytest.raises(ValueError, match="direct cannot be sent .*cannot pickle <Unsendable object>"):
        pool.map(user.law.direct, [1.0])
    user.law.bad = user.law.Named()
    with pytest.raises(ValueError, match="cannot be loaded in a worker process: AttributeError.*'bad'"):
        pool.map(user.law.direct, [1.0])


def test_lambdas_closures_and_arrays_are_sent(pool):
    table, factor = np.arange(5.0), 2.0
    assert pool.map(lambda i: factor * table[i], [1, 2]) == [2.0, 4.0]
    table[1] = 7.0
    assert pool.map(lambda i: factor * table[i], [1, 2]) == [14.0, 4.0]

    def recursive(n):
        return n * recursive(n - 1) if n else 1

    assert pool.map(recursive, [5]) == [120]


def test_cached_functions_and_numpy_are_sent(user, pool):
    assert pool.map(user.law.through_a_cache, [1.0]) == pool.map(user.law.cached, [1.0]) == [3.0]
    assert pool.map(user.law.through_numpy, [3.0]) == [3.0]
    assert pool.map(user.law.through_private_slots, [1.0]) == [3.0]


def test_another_version_of_the_library_is_refused(monkeypatch):
    pickled = Pickled.of(line)
    monkeypatch.setattr(by_value, "sources_digest", lambda: bytes(16))
    with pytest.raises(ChangedModel, match="another version of fe_likelihoods"):
        load(pickled.payload)


def test_a_file_that_differs_in_the_worker_is_refused(tmp_path, pool):
    table = tmp_path / "table.txt"
    table.write_text("1")
    pickled = Pickled.of(FunctionModel(line, ("a", "b"), CHANNELS, DT, N_STEPS, depends_on=[table]))
    table.write_text("22")
    with pytest.raises(ChangedModel, match=r"table\.txt in the worker process differs"):
        pool.map(_load, [pickled])


def _load(pickled):
    return load(pickled.payload) is not None


def test_modules_of_this_process_stay_when_a_function_is_loaded_in_it(user):
    law = user.law
    assert load(Pickled.of(user.by_module).payload)(1.0) == 3.0
    assert sys.modules["law"] is law and law.K == 3.0


def test_what_belongs_to_the_user():
    for name in (__name__, "__main__", "made_by_hand"):
        assert by_value.is_of_user(name)
    for module in (np, pytest, threading, by_value, sys, np.random.mtrand):
        assert not by_value.is_of_user(module.__name__)
