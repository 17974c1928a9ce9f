"""Compiled kernels against pure Python, and the disk cache, which must never be stale."""

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
from fe_likelihoods.kernels import bar_fatigue, jit, linear_solve
from fe_likelihoods.kernels.frame import recorder
from fe_likelihoods.kernels.newmark import HISTORY_ROWS, Dynamics, newmark
from fe_likelihoods.kernels.static import Iteration, impose_displacement

from . import golden

SOURCES = Path(kernels.__file__).parent
ROOT = Path(__file__).resolve().parents[2]
ROUND_OFF = 1e-13
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


# --- the cache ---


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


@pytest.mark.slow
def test_a_cache_folder_that_cannot_be_written_is_skipped(tmp_path):
    """Where a file is in the place of a folder, the next candidate is used."""
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    home = tmp_path / "home"
    code = "from fe_likelihoods.kernels import jit; print(jit.CACHE_FOLDER)"
    folder = python(code, FE_LIKELIHOODS_CACHE=str(blocked), XDG_CACHE_HOME=str(home)).strip()
    assert Path(folder).is_relative_to(home)


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
    """A link counts as one; so does the folder that another user created under the known name."""
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


def test_kernels_work_without_a_folder(monkeypatch):
    monkeypatch.setattr(jit, "CACHE_FOLDER", None)
    assert jit.kernel(_double)(2.0) == 4.0


def _double(x):
    return 2.0 * x


def test_an_edited_kernel_outside_the_library_is_compiled_again(tmp_path):
    """Its file is not in the name of the folder."""
    for number in (1.0, 2.0):
        code = f"from fe_likelihoods.kernels.jit import kernel\n\n\n@kernel\ndef call(x):\n    return x + {number}\n"
        (tmp_path / "outside.py").write_text(code)
        (tmp_path / "__pycache__").exists() and shutil.rmtree(tmp_path / "__pycache__")
        program = "from outside import call; print(call(0.0), sum(call.stats.cache_hits.values()))"
        for hits in (0, 1):
            environment = {"PYTHONPATH": str(tmp_path), "FE_LIKELIHOODS_CACHE": str(tmp_path / "cache")}
            assert python(program, **environment).split() == [str(number), str(hits)]


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


@golden.compiled_only
def test_second_start_compiles_nothing():
    """First likelihoods of both posteriors in a new interpreter, when the machine code is on disk."""
    python(FIRST_EVALUATIONS)  # compiles everything that is not on disk yet
    finite, events, control = json.loads(python(FIRST_EVALUATIONS))
    assert finite
    assert events == 0
    assert control > 0


# --- compiled kernels against pure Python ---


def short_subset() -> dict[str, np.ndarray]:
    """Return results of materials, a section, a pushover and a run that are short enough for pure Python."""
    rng = np.random.default_rng(7)
    out = {}
    for name, args in (("core", golden.CORE), ("r400", (-6.0, -0.0026, -0.05, 1958.8, 0.744, 0.00138, 0.1))):
        for number, strain in enumerate(golden.random_walks(rng, 3, 150, 0.003)):
            out[f"{name} {number}"] = np.zeros((5, 150))
            golden.concrete_history(strain, golden.concrete_constants(args), out[f"{name} {number}"])
    # nested reversals decide clips by their last digit: straight runs only
    peaks = 0.02 * np.linspace(0.1, 1.0, 15) * (-1.0) ** np.arange(15)
    strain = np.interp(np.arange(150) / 10.0, np.arange(16), np.concatenate([[0.0], peaks]))
    out["steel"] = np.zeros((3, 150))
    golden.steel_history(strain, golden.steel_constants(golden.STEEL), out["steel"])
    failure = np.zeros(bar_fatigue.N_FAILURE)
    bar_fatigue.constants(0.1, 0.5, 0.4, failure)
    out["fatigue"], memory = np.zeros((1, 150)), np.zeros(bar_fatigue.N_STATE)
    c = golden.steel_constants(golden.STEEL)
    out["fatigue"][0] = [bar_fatigue.update(each, memory, c, failure)[0] for each in strain]

    def column():
        return golden.column(golden.circle(4, 3), n_points=3)

    out["section"] = np.zeros((5, 60))
    e0, kappa = rng.normal(size=(2, 60)) * [[5e-4], [1e-4]]
    golden.section_history(e0, kappa, column(), out["section"])
    out["pushover"] = np.zeros((9, 12))
    iteration, fibers = Iteration(1e-10, 50, 4), ((0, 0), (0, 5), (1, -1), (5, -2))
    pushed, shaken = column(), column()
    seen = recorder(pushed, 12, sections=True, motion=1, fibers=fibers)
    impose_displacement(pushed, golden.gravity(), np.linspace(0.0, 4.0, 12), iteration, out["pushover"], seen)
    out["run"] = np.zeros((len(HISTORY_ROWS), 40))
    ground = 300.0 * np.sin(np.linspace(0.0, 6.0, 40))
    dynamics = Dynamics(golden.gravity(), golden.mass(), golden.A0, golden.A1)
    felt = recorder(shaken, 40, sections=True, motion=3, fibers=fibers)
    status = newmark(shaken, dynamics, ground, 0.02, 1, iteration, out["run"], felt)
    out["status"] = np.array(status)
    for name in ("sections", "motion", "stresses"):
        out[name], out[f"shaken {name}"] = getattr(seen, name), getattr(felt, name)
    return out


@pytest.mark.slow
def test_pure_python_gives_the_same_results(tmp_path):
    code = (
        "import sys, numba, numpy; assert numba.config.DISABLE_JIT; "
        "from tests.kernels.test_jit import short_subset; numpy.savez(sys.argv[1], **short_subset())"
    )
    python(code, tmp_path / "pure.npz", NUMBA_DISABLE_JIT="1")
    compiled = short_subset()
    with np.load(tmp_path / "pure.npz") as pure:
        assert set(pure.files) == set(compiled)
        for name, values in compiled.items():
            scale = np.maximum(np.abs(values).max(axis=-1, keepdims=True), 1e-300)
            # the iterations of the column stop at 1e-10 in and amplify round-off to that size
            limit = 1e-9 if name in ("pushover", "run") or name.startswith("shaken") else ROUND_OFF
            np.testing.assert_allclose(pure[name] / scale, values / scale, rtol=0, atol=limit, err_msg=name)
    assert np.abs(compiled["run"][0]).max() > 1.0
    assert compiled["status"][0] == 0


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
