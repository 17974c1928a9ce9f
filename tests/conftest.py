"""Shared fixtures: the folder of reference material beside the project, and the seed of the statistical tests.

Linear algebra uses one thread per process, also in the scripts that tests start: threads of OpenBLAS that wait for each
other on small matrices take three times the processor time. The longest tests come first: `make test` distributes by
stealing, and no worker waits for another one at the end.
"""

import os
import signal
import sys
from contextlib import nullcontext
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # read when numpy is imported

import numpy as np  # noqa: E402
import pytest  # noqa: E402

LONG = ("test_tutorials.py", "test_readme.py")

SHARED = Path(os.environ.get("FE_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the reference results, real records and measurements (``FE_SHARED``, by default ``../shared``)."""
    if not SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"the reference material must be there in CI: no folder {SHARED}")
        pytest.skip(f"NO REFERENCE MATERIAL at {SHARED}: set FE_SHARED to its folder to run this test")
    return SHARED


@pytest.fixture
def seed() -> int:
    """Seed of the statistical tests (environment variable ``SEED``, by default 20240)."""
    return int(os.environ.get("SEED", "20240"))


@pytest.fixture
def rng(seed) -> np.random.Generator:
    """Generator seeded with `seed`."""
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def shared_pool():
    """A function: a context with a pool of some processes that the tests of a file use one after another.

    A process of a pool takes a CPU second to start. Tests that leave a process busy or look at the processes make
    pools of their own.
    """
    from fe_likelihoods.simulation.executors import LocalPool

    pools = {}
    yield lambda workers: nullcontext(pools.get(workers) or pools.setdefault(workers, LocalPool(workers)))
    for pool in pools.values():
        pool.close()


@pytest.fixture(autouse=True)
def random_numbers_of_numpy():
    """A test that seeds nothing, as examples of emcee, has the same random numbers in any order of the tests."""
    np.random.seed(1)  # noqa: NPY002  the generator that emcee uses


@pytest.fixture(autouse=True)
def figures_are_closed():
    """Close the figures of a test: matplotlib warns of more than 20, in whichever test comes next."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(autouse=True)
def handler_of_sigint_is_put_back():
    """A test, or a library that it imports, may set another handler of Ctrl-C: dask_jobqueue sets ``sys.exit``."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def path(tmp_path):
    """The file that most tests of readers write."""
    return tmp_path / "a.csv"


def pytest_configure():
    """Let Ctrl-C end runs also where the tests are in the background of a shell, which ignores it there."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_terminal_summary(terminalreporter):
    """One line about the tests that were skipped because OpenSees does not start."""
    skipped = terminalreporter.stats.get("skipped", ())
    if number := sum("NO OPENSEES" in str(report.longrepr) for report in skipped):
        terminalreporter.write_line(
            f"{number} tests compare with OpenSees and were skipped: install libblas3 and liblapack3, and openseespy"
        )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Begin with the files whose tests take up to a minute; the order within a file stays."""
    items.sort(key=lambda item: item.path.name not in LONG)
