"""The disk cache of compiled kernels, which must never be stale, and the banded solver."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from fe_likelihoods import kernels
from fe_likelihoods.kernels import jit, linear_solve

SOURCES = Path(kernels.__file__).parent
ROOT = Path(__file__).resolve().parents[2]
FOLDER = f"kernels-{jit.KERNEL_HASH}-numba{numba.__version__}"


def python(code, *arguments, cwd=SOURCES.parents[1], **environment):
    """Run `code` in a new interpreter that finds the package and these tests; return its standard output."""
    paths = [str(cwd), str(ROOT), os.environ.get("PYTHONPATH", "")]
    result = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture
def copied(tmp_path):
    """Copy of the kernels as a separate package, with a caller of `concrete04.commit` in another file."""
    folder = tmp_path / "copied" / "kernels"
    shutil.copytree(SOURCES, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "caller.py").write_text(
        "from .concrete04 import commit\nfrom .jit import kernel\n\n\n"
        "@kernel\ndef call(eps):\n    return commit(eps, -1.0, 1.0)[1]\n"
    )
    return folder


def result_of(copied, cache):
    """Return the hash of the copied sources, the result of the compiled caller, and the number of its cache hits."""
    code = (
        "import json; from kernels import jit, caller; value = caller.call(2.0); "
        "print(json.dumps([jit.KERNEL_HASH, value, sum(caller.call.stats.cache_hits.values())]))"
    )
    return json.loads(python(code, cwd=copied.parent, FE_LIKELIHOODS_CACHE=str(cache), NUMBA_DISABLE_JIT="0"))


def test_machine_code_is_shared_by_equal_copies_and_never_stale(copied, tmp_path):
    """numba alone would compile the copy again, and would not notice an edit of a kernel in a file that is called."""
    cache = tmp_path / "cache"
    first = result_of(copied, cache)
    assert first[1:] == [2.0, 0]
    checkout = Path(shutil.copytree(copied, tmp_path / "another checkout" / "kernels"))
    os.utime(checkout / "caller.py", (1.0, 1.0))
    assert result_of(checkout, cache) == [first[0], 2.0, 1]  # from the disk
    source = copied / "concrete04.py"
    edited = source.read_text().replace("max(eps_max, eps)", "max(eps_max, eps) + 10.0")
    assert edited != source.read_text()
    source.write_text(edited)
    hash_, value, hits = result_of(copied, cache)
    assert hash_ != first[0]
    assert (value, hits) == (12.0, 0)
    assert len(list(cache.iterdir())) == 2


CALL_TWICE = "from kernels import caller; caller.call(2.0); caller.call(2)"  # two types: compiled twice
IN_A_WORKER = (
    "import multiprocessing\n"
    "def call():\n    from kernels import caller; caller.call(2.0)\n"
    "process = multiprocessing.get_context('fork').Process(target=call); process.start(); process.join()\n"
    "assert process.exitcode == 0"
)


def messages(copied, code, cache, **environment):
    """What a new process that compiles the copied kernels shows on stderr."""
    settings = {"FE_LIKELIHOODS_CACHE": str(cache), "NUMBA_DISABLE_JIT": "0", "PYTHONPATH": str(copied.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | settings | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stderr.splitlines()


@pytest.mark.slow
def test_a_compilation_announces_itself_once_and_only_if_it_is_made(copied, tmp_path):
    (line,) = messages(copied, CALL_TWICE, tmp_path / "cache")
    assert line.startswith("Compiling the kernels, once: ") and str(tmp_path / "cache") in line
    assert messages(copied, CALL_TWICE, tmp_path / "cache") == []


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork")
@pytest.mark.parametrize(("code", "mark"), [(IN_A_WORKER, {}), (CALL_TWICE, {"FE_LIKELIHOODS_RUN_1": "1"})])
def test_workers_announce_no_compilation(copied, tmp_path, code, mark):
    assert messages(copied, code, tmp_path / "cache", **mark) == []
    assert any((tmp_path / "cache").rglob("*.nbc"))  # it was compiled


CALL_AT_A_SIGN = (
    "from kernels import caller; print('ready', flush=True); input(); caller.call(2.0)\n"
    "print(sum(caller.call.stats.cache_misses.values()))"
)


def start(copied, code, cache):
    settings = {"FE_LIKELIHOODS_CACHE": str(cache), "NUMBA_DISABLE_JIT": "0", "PYTHONPATH": str(copied.parent)}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen([sys.executable, "-c", code], env=os.environ | settings, text=True, **pipes)


@pytest.mark.slow
@pytest.mark.skipif(jit.flock is None, reason="NO flock")
def test_processes_that_start_together_compile_once(copied, tmp_path):
    both = [start(copied, CALL_AT_A_SIGN, tmp_path / "cache") for _ in range(2)]
    for process in both:
        assert process.stdout.readline() == "ready\n"
    (folder,) = (tmp_path / "cache").iterdir()
    with open(folder / "kernels.caller.call.lock", "w") as held:
        jit.flock(held, jit.LOCK_EX)
        for process in both:
            process.stdin.write("\n")
            process.stdin.flush()
            assert process.stderr.readline().startswith("Compiling the kernels, once: ")  # also where it is awaited
        assert not list(folder.rglob("*.nbi"))
        # one that has waited long enough, for a process that may have been stopped, compiles by itself
        impatient = start(copied, "from kernels import jit\njit._patience[0] = 0.1\n" + CALL_AT_A_SIGN, folder.parent)
        assert impatient.communicate("\n", timeout=120)[0] == "ready\n1\n"
        shutil.rmtree(next(path for path in folder.iterdir() if path.is_dir()))
    results = [process.communicate(timeout=120) for process in both]
    assert sorted(results) == [("0\n", ""), ("1\n", "")]


def folder_of(**environment):
    code = "from fe_likelihoods.kernels import jit; print(jit.CACHE_FOLDER)"
    return python(code, **{name: str(value) for name, value in environment.items()}).strip()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="NO getuid: files have no modes")
def test_the_folder_is_private(tmp_path):
    """Others could put a pickle into another one, which numba would load."""
    folder = tmp_path / FOLDER
    assert folder_of(FE_LIKELIHOODS_CACHE=tmp_path) == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert folder_of(FE_LIKELIHOODS_CACHE=tmp_path, XDG_CACHE_HOME=tmp_path / "home") != str(folder)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="NO getuid: files have no modes")
def test_a_folder_of_somebody_else_is_not_used(tmp_path, monkeypatch, caplog):
    """A link counts as one; so does the folder that another user created. A file in its way is passed over."""
    monkeypatch.setattr(jit.tempfile, "gettempdir", lambda: str(tmp_path))
    for name in ("XDG_CACHE_HOME", "FE_LIKELIHOODS_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / "file" / "below"))
    (tmp_path / "file").touch()
    shared = tmp_path / f"fe_likelihoods-{os.getuid()}"
    assert jit._find_cache_folder() == str(shared / FOLDER)
    assert shared.stat().st_mode & 0o777 == 0o700
    shutil.rmtree(shared)
    (tmp_path / "elsewhere").mkdir()
    shared.symlink_to(tmp_path / "elsewhere")
    assert jit._find_cache_folder() is None
    assert "Set the environment variable FE_LIKELIHOODS_CACHE to a folder of your own" in caplog.text
    shared.unlink()
    shared.mkdir()
    monkeypatch.setattr(os, "getuid", lambda uid=os.getuid(): uid)
    owner = os.lstat
    monkeypatch.setattr(os, "lstat", lambda path: os.stat_result([*owner(path)[:4], os.getuid() + 1, *owner(path)[5:]]))
    assert jit._find_cache_folder() is None


FIRST_EVALUATIONS = """
import json
import numba
import numpy as np
from numba.core.event import install_recorder
from fe_likelihoods import problems
with install_recorder("numba:compile") as compiled:
    column = problems.bridge_column(duration=0.25)
    whole = problems.isolated_bridge_data()
    short = type(whole)(whole.record.trim(0.0, 0.25), whole.measurements.trim(0.0, 0.25), {})
    bridge = problems.isolated_bridge(data=short)
    values = [posterior(posterior.sample_prior(1, 1)[0]) for posterior in (column, bridge)]
    events = len(compiled.buffer)
    numba.njit(lambda x: x)(1.0)  # control: a compilation is recorded
    print(json.dumps([bool(np.isfinite(values).all()), events, len(compiled.buffer) - events]))
"""


def test_second_start_compiles_nothing():
    """First likelihoods of both posteriors in a new interpreter, when the machine code is on disk."""
    python(FIRST_EVALUATIONS)  # compiles everything that is not on disk yet
    finite, events, control = json.loads(python(FIRST_EVALUATIONS))
    assert finite
    assert events == 0
    assert control > 0


def banded(rng, n, definite):
    """Return a symmetric, diagonally dominant matrix of half bandwidth five, definite or not."""
    a = np.triu(np.tril(rng.normal(size=(n, n)), 5), -5)
    signs = np.ones(n) if definite else rng.choice([-1.0, 1.0], n)
    return a + a.T + 20.0 * np.diag(signs)


@pytest.mark.parametrize("definite", [True, False])
@pytest.mark.parametrize("n", [3, 6, 15, 30])
def test_banded_solution_is_that_of_numpy(rng, n, definite):
    a, b = banded(rng, n, definite), rng.normal(size=n)
    expected = np.linalg.solve(a, b)
    solved = b.copy()
    linear_solve.solve_banded(a.copy(), solved)
    np.testing.assert_allclose(solved, expected, rtol=0, atol=1e-12)


def test_singular_matrix_does_not_give_a_finite_answer():
    """The caller recognises it as a failed iteration."""
    b = np.ones(3)
    linear_solve.solve_banded(np.zeros((3, 3)), b)
    assert not np.isfinite(b).any()
