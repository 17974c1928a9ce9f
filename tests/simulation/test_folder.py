"""Each simulation in a worker has a working folder of its own; simulations that write elsewhere at once are refused."""

import errno
import importlib
import logging
import multiprocessing
import os
import py_compile
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.simulation.executors import LocalPool, as_executor
from fe_likelihoods.simulation.failure_reasons import UnusableModel
from fe_likelihoods.simulation.files import Observed, Observer, read_again
from fe_likelihoods.simulation.label import items_of
from fe_likelihoods.simulation.model import simulate_batch
from tests.opensees_column import require_opensees

CHANNELS = [Channel("top", "displacement", "mm")]
THETAS = np.random.default_rng(1).uniform(0.5, 1.5, (12, 2))


def model(function, **options):
    return FunctionModel(function, ["a", "b"], CHANNELS, 0.01, 2, **options)


def write_and_read(path, theta):
    """A wrapper of a program: its input file has the same name in every simulation."""
    with open(path, "w") as file:
        file.write(" ".join(repr(float(x)) for x in theta))
    time.sleep(0.002)
    return [[float(word) for word in Path(path).read_text().split()]]


def of_program(theta):
    command = [
        "/bin/sh",
        "-c",
        'echo "$0" "$1" > in.txt; sleep 0.002; cat in.txt > out.txt',
        *map(repr, theta.tolist()),
    ]
    subprocess.run(command, check=True)
    return [[float(word) for word in Path("out.txt").read_text().split()]]


def of_recorder(theta):
    """A bar in OpenSees, whose displacement and force are from a recorder with a fixed name."""
    import openseespy.opensees as ops

    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(1, 0.0)
    ops.node(2, 1.0)
    ops.fix(1, 1)
    ops.uniaxialMaterial("Elastic", 1, theta[1] / theta[0])
    ops.element("Truss", 1, 1, 2, 1.0, 1)
    ops.timeSeries("Constant", 1)
    ops.pattern("Plain", 1, 1)
    ops.load(2, theta[1])
    ops.recorder("Node", "-file", "out.txt", "-precision", 17, "-node", 2, "-dof", 1, "disp")
    ops.recorder("Element", "-file", "force.txt", "-precision", 17, "-ele", 1, "axialForce")
    for command, *arguments in (("system", "BandGeneral"), ("constraints", "Plain"), ("numberer", "Plain")):
        getattr(ops, command)(*arguments)
    ops.algorithm("Linear")
    ops.integrator("LoadControl", 1.0)
    ops.analysis("Static")
    assert ops.analyze(1) == 0
    time.sleep(0.002)
    ops.wipe()  # closes the files
    return [[float(Path(name).read_text()) for name in ("out.txt", "force.txt")]]


@pytest.fixture(scope="module")
def pool():
    with LocalPool(2) as pool:
        yield pool


@pytest.fixture
def start(tmp_path, monkeypatch):
    """The working folder of this process."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def old(path, text):
    """A file that was written long ago."""
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(text)
    os.utime(path, (1e9, 1e9))


def assert_right(function, pool, thetas=THETAS, **options):
    batch = simulate_batch(model(function, **options), thetas, as_executor(pool))
    assert batch.reasons == [""] * len(thetas)
    np.testing.assert_allclose(batch.response[:, 0], thetas, rtol=1e-12 if function is of_recorder else 0.0)


# names inside of the folder -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["in.txt", "results/in.txt"])
@pytest.mark.parametrize("is_there", [True, False])
def test_a_fixed_relative_name_is_private_to_a_simulation(name, is_there, start, pool):
    old(start / "results" / "notes.txt", "kept")
    if is_there:
        old(start / name, "1.0 1.0")
    before = sorted(start.rglob("*"))
    assert_right(lambda theta: write_and_read(name, theta), pool)
    assert sorted(start.rglob("*")) == before
    assert not is_there or (start / name).read_text() == "1.0 1.0"


@pytest.mark.parametrize("is_there", [True, False])
@pytest.mark.parametrize("program", [of_program, of_recorder])
def test_a_program_with_fixed_names_runs_in_the_folder(program, is_there, start, pool):
    if program is of_recorder:
        require_opensees()
    if is_there:
        old(start / "in.txt", "1.0 1.0")
        old(start / "out.txt", "1.0 1.0")
    assert_right(program, pool)
    assert is_there or list(start.iterdir()) == []


def test_programs_write_in_copies_of_files_and_large_ones_are_refused(start, pool):
    def append(theta):
        subprocess.run(["/bin/sh", "-c", f"sleep .02; echo 1 >> {name}"], check=True)
        return [[float(len(Path(name).read_text().split()))] * 2]

    name = "log.txt"
    old(start / name, "1\n")
    assert simulate_batch(model(append), THETAS, pool).response[:, 0, 0].tolist() == [2.0] * len(THETAS)
    assert (start / name).read_text() == "1\n"
    name = "large.txt"
    old(start / name, "1\n" * 2**20)
    with pytest.raises(UnusableModel, match=r"large\.txt"):
        simulate_batch(model(append), THETAS, pool)


def test_a_file_that_others_write_meanwhile_does_not_change_during_a_simulation(start, pool):
    def reads_twice(theta):
        first = Path("shared.txt").read_text()
        subprocess.run(["/bin/sh", "-c", f"echo 2 > '{seen}/shared.txt'"], check=True)
        return [[float(first), float(Path("shared.txt").read_text())]]

    seen = str(start)
    old(start / "shared.txt", "1")
    with LocalPool(1) as one:
        assert simulate_batch(model(reads_twice), THETAS[:2], one).response.tolist() == [[[1.0, 1.0]], [[2.0, 2.0]]]


def test_files_of_the_starting_folder_are_readable_as_they_are_now(start, pool):
    def read(theta):
        names = ["a.txt", "data/b.txt", ".hidden/c.txt", "1/2/3/4/5/d.txt", "late.txt"]
        return [[float(sum(int(Path(name).read_text()) for name in names if Path(name).exists())), 0.0]]

    for place, number in (("a.txt", 1), ("data/b.txt", 10), (".hidden/c.txt", 100), ("1/2/3/4/5/d.txt", 1000)):
        (start / place).parent.mkdir(parents=True, exist_ok=True)
        (start / place).write_text(str(number))
    assert simulate_batch(model(read), THETAS, pool).response[:, 0, 0].tolist() == [1111.0] * len(THETAS)
    (start / "late.txt").write_text("10000")
    (start / "data" / "b.txt").write_text("20")
    assert simulate_batch(model(read), THETAS, pool).response[:, 0, 0].tolist() == [11121.0] * len(THETAS)


def test_nothing_is_left_for_the_next_simulation(start, pool):
    def untidy(theta):
        found = sorted(str(path) for path in Path().rglob("*"))
        texts = [path.read_text() for path in sorted(Path().rglob("*.txt"))]
        os.remove("a.txt")
        Path("b.txt").write_text("changed")
        os.rename("sub/c.txt", "sub/d.txt")
        Path("new", "deep").mkdir(parents=True)
        Path("new", "deep", "file").write_text("left")
        if theta[0] > 1.0:
            os.chdir("sub")
            os.remove("d.txt")
            os.chdir("..")
            os.rmdir("sub")
        return [[float(found == expected), float(texts == ["a", "b", "c"])]]

    expected = ["a.txt", "b.txt", "sub", "sub/c.txt"]
    for name in ("a.txt", "b.txt", "sub/c.txt"):
        old(start / name, Path(name).stem)
    assert simulate_batch(model(untidy), THETAS, pool).response.tolist() == [[[1.0, 1.0]]] * len(THETAS)
    assert {str(path.relative_to(start)) for path in start.rglob("*")} == set(expected)


def test_nothing_is_left_by_a_simulation_that_exits(start):
    def exits(theta):
        assert os.listdir() == []
        Path("left.txt").write_text("left")
        sys.exit("no convergence")

    reasons = simulate_batch(model(exits, isolated=True), THETAS[:3]).reasons
    assert ["no convergence" in reason for reason in reasons] == [True] * 3


@pytest.mark.parametrize("isolated", [True, False])
def test_files_of_the_user_survive_a_simulation_that_empties_their_folder(isolated, start, pool):
    """Its folder shows them as links, and a folder that it makes again has none of them."""

    def empties(theta):
        shutil.rmtree("results")
        os.mkdir("results")
        return write_and_read("results/in.txt", theta)

    for k in range(3):
        old(start / "results" / f"thesis{k}.csv", "precious")
    assert_right(empties, None if isolated else pool, THETAS[:8], **({"isolated": True} if isolated else {}))
    assert {path.name for path in (start / "results").iterdir()} == {f"thesis{k}.csv" for k in range(3)}
    assert all(not path.is_symlink() and path.read_text() == "precious" for path in (start / "results").iterdir())


@pytest.mark.parametrize("kind", ["link", "large", "deep"])
def test_names_below_folders_are_private(kind, start, pool, tmp_path_factory):
    folder = start / {"link": "out", "large": "out", "deep": "a/b/c/d/e"}[kind]
    folder.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        folder.symlink_to(tmp_path_factory.mktemp("elsewhere"))
    for k in range(90 if kind == "large" else 1):
        old(folder / f"{k}.txt", "old")
    name = folder.relative_to(start).as_posix()

    def by_program(theta):
        code = f'echo "$0 $1" > {name}/in.txt; sleep .005; cat {name}/in.txt > {name}/out.txt'
        subprocess.run(["/bin/sh", "-c", code, *map(repr, theta.tolist())], check=True)
        return [[float(word) for word in Path(name, "out.txt").read_text().split()]]

    old(folder / "in.txt", "old")
    assert_right(by_program, pool)
    assert (folder / "0.txt").read_text() == "old"


def test_files_beside_the_starting_folder_are_readable(start, pool, monkeypatch):
    (start / "scripts").mkdir()
    monkeypatch.chdir(start / "scripts")
    old(start / "data" / "x.txt", "2.0")
    assert_right(lambda theta: [(theta * float(Path("../data/x.txt").read_text()) / 2.0).tolist()], pool, THETAS[:4])


def test_an_isolated_function_has_a_folder_and_pool_none_has_not(start):
    thetas = THETAS[:2]
    assert_right(lambda theta: write_and_read("in.txt", theta), None, thetas, isolated=True)
    assert list(start.iterdir()) == []
    assert_right(lambda theta: write_and_read("in.txt", theta), None, thetas)
    assert [path.name for path in start.iterdir()] == ["in.txt"]


def test_modules_beside_the_script_are_found(start, monkeypatch):
    def imports(theta):
        import beside_the_script

        return [[beside_the_script.VALUE, 0.0]]

    (start / "beside_the_script.py").write_text("VALUE = 5.0\n")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    with LocalPool(1) as one:
        assert simulate_batch(model(imports), THETAS[:1], one).response[0, 0, 0] == 5.0


def test_the_label_names_files_of_the_starting_folder(start):
    def read(theta):
        Path("made.txt").write_text("own")
        return Path("made.txt").read_text() + Path("input.txt").read_text() + Path("../beside/input.txt").read_text()

    inputs = start.parent / "beside" / "input.txt", start / "input.txt"
    for path in inputs:
        old(path, "1")
    with LocalPool(1) as one:
        [(text, opened)] = one.map(Observed(read), [THETAS[0]])
    assert text == "own11"
    assert sorted(path for path in opened if path.endswith(".txt")) == sorted(map(str, inputs))


def test_folders_are_removed_with_the_process(tmp_path):
    code = (
        "import numpy as np\n"
        "from tests.simulation.test_folder import *\n"
        "pool, isolated = as_executor(2), model(of_program, isolated=True)\n"
        "simulate_batch(model(of_program), THETAS[:2], pool)\n"
        "simulate_batch(isolated, THETAS[:1])\n"
        "print(len(list(Path(tempfile.gettempdir()).glob('fe_likelihoods_*'))))\n"
    )
    command, environment = [sys.executable, "-c", code], os.environ | {"TMPDIR": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3"]
    for _ in range(500):  # each process has a shell that removes its folder
        if not any(tmp_path.iterdir()):
            break
        time.sleep(0.02)
    assert list(tmp_path.iterdir()) == []


# files outside of the folder ----------------------------------------------------------------------------------------


def rewritten(path, theta):
    """Written under another name, and renamed."""
    result = write_and_read(f"{path}.{os.getpid()}.{threading.get_ident()}", theta)
    os.replace(f"{path}.{os.getpid()}.{threading.get_ident()}", path)
    time.sleep(0.002)
    return [[float(word) for word in Path(path).read_text().split()]] if result else []


def in_its_folder(path, theta):
    os.chdir(Path(path).parent)
    return write_and_read("in.txt", theta)


def remade(path, theta):
    """A scratch folder of a fixed name, emptied before each run."""
    folder = Path(path).parent / "scratch"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return write_and_read(folder / "in.txt", theta)


def made_once(path, theta):
    folder = Path(path).parent / "scratch"
    folder.mkdir(exist_ok=True)
    return write_and_read(folder / "in.txt", theta)


def by_a_program(path, theta):
    """Noticed when Python code reads it, the second time."""
    subprocess.run(["/bin/sh", "-c", f'sleep .01; echo "$0" "$1" > "{path}"', *map(repr, theta.tolist())], check=True)
    return [[float(word) for word in Path(path).read_text().split()]]


WRITES = [write_and_read, rewritten, in_its_folder, remade, made_once, by_a_program]


@pytest.mark.parametrize("write", WRITES)
def test_simulations_of_several_workers_that_write_an_absolute_path_are_refused(write, start, pool, tmp_path_factory):
    path = tmp_path_factory.mktemp("place") / "in.txt"
    with pytest.raises(UnusableModel, match="use one worker, pool=1") as refused:
        simulate_batch(model(lambda theta: write(str(path), theta)), THETAS, pool)
    assert str(path.parent) in str(refused.value)
    with LocalPool(1) as one:
        assert_right(lambda theta: write(str(path), theta), one, THETAS[:4])


@pytest.mark.parametrize("options", [{}, {"isolated": True}])
def test_threads_that_write_files_of_fixed_names_are_refused(options, start, tmp_path_factory):
    path = "in.txt" if not options else str(tmp_path_factory.mktemp("place") / "in.txt")
    for function in (lambda theta: write_and_read(path, theta), *([] if options else [of_program])):
        with ThreadPoolExecutor(2) as threads, pytest.raises(UnusableModel, match="Use a pool of processes"):
            simulate_batch(model(function, **options), THETAS, as_executor(threads))


def test_files_that_no_other_simulation_writes_are_no_reason_to_refuse(start, pool, tmp_path_factory):
    def harmless(theta):
        with tempfile.TemporaryDirectory() as place, tempfile.NamedTemporaryFile("w") as file, open(os.devnull, "w"):
            file.write("text")
            subprocess.run(["true"], cwd=place, check=True)
            os.replace(Path(place, "in.txt").absolute().as_posix(), f"{place}/b") if Path(
                place, "in.txt"
            ).exists() else 0
            Path(f"{log}.mark").touch()
            with open(log, "a") as text:
                text.write("x")
            return write_and_read(f"{place}/in.txt", theta)

    log = str(tmp_path_factory.mktemp("place") / "log.txt")
    with ThreadPoolExecutor(2) as threads:
        assert_right(harmless, pool)
        assert_right(harmless, threads)
    assert Path(log).read_text() == "x" * 2 * len(THETAS)


def test_a_simulation_may_read_in_another_folder_and_not_what_was_written_there_meanwhile(
    start, pool, tmp_path_factory
):
    def looks(theta):
        os.chdir(place)
        return [(theta * float(Path("x.txt").read_text())).tolist()]

    def written(theta):
        time.sleep(0.02)  # times of files have steps of some milliseconds
        Path(place, "x.txt").touch()  # as compiled code does
        return looks(theta)

    place = tmp_path_factory.mktemp("place")
    old(place / "x.txt", "1.0")
    assert_right(looks, pool)
    with pytest.raises(UnusableModel, match=r"x\.txt"):
        simulate_batch(model(written), THETAS, pool)


def test_an_input_file_that_is_written_before_each_batch_is_no_reason_to_refuse(start, pool, tmp_path_factory):
    def read(theta):
        return [[float(Path(path).read_text()), theta[1]]]

    path = str(tmp_path_factory.mktemp("place") / "in.txt")
    for k in range(6):
        Path(path).write_text(str(k))
        assert simulate_batch(model(read), THETAS[:4], pool).response[:, 0, 0].tolist() == [float(k)] * 4


# all pools ----------------------------------------------------------------------------------------------------------


def relative(theta):
    return write_and_read("in.txt", theta)


def client():
    distributed = pytest.importorskip("distributed")
    return distributed.Client(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL)


SPAWN = multiprocessing.get_context("spawn")
POOLS = {
    "local": lambda: LocalPool(8),
    "processes": lambda: ProcessPoolExecutor(2, mp_context=SPAWN),
    "multiprocessing": lambda: SPAWN.Pool(2),
    "dask": client,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", POOLS)
def test_no_simulation_reads_files_of_another(kind, start):
    thetas = np.random.default_rng(2).uniform(0.5, 1.5, (300, 2))
    old(start / "in.txt", "1.0 1.0\n")
    with POOLS[kind]() as pool:
        assert_right(relative, pool, thetas)


def simulated(theta):
    """As the pool of a sampler calls a model."""
    return simulate_batch(model(relative), theta[None]).response[0, 0].tolist()


def test_the_workers_of_a_sampler_have_folders_too(start):
    with multiprocessing.get_context("fork").Pool(2) as processes:
        assert processes.map(simulated, THETAS, chunksize=1) == THETAS.tolist()
    assert list(start.iterdir()) == []


# names of files that are links ---------------------------------------------------------------------------------------


def through_a_link(make):
    def read():
        make("data.txt", "in.txt")
        return Path("in.txt").read_text()

    return read


def test_a_folder_that_could_not_be_shown_is_shown_anew(tmp_path, monkeypatch):
    """Half of it would make results without the other files."""
    for name in ("a.txt", "b.txt", "c.txt"):
        old(tmp_path / name, name)
    copy, left = shutil.copy2, [None, OSError(errno.ENOSPC, "No space left on device"), None, None, None]

    def on_a_full_disk(source, target):
        copy(source, target)
        if error := left.pop(0):
            raise error

    monkeypatch.setattr(shutil, "copy2", on_a_full_disk)
    observed = Observed(lambda _: sorted(os.listdir()), True, (b"another process", str(tmp_path)))
    with pytest.raises(OSError, match="No space left"):
        observed(None)
    assert observed(None)[0] == ["a.txt", "b.txt", "c.txt"]


def made_again():
    text = Path("data/k.txt").read_text()
    os.remove("data/k.txt")
    Path("data/k.txt").write_text(text)


def moved_away_and_back():
    os.rename("data.txt", "work.txt")
    Path("work.txt").read_text()
    os.rename("work.txt", "data.txt")


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
@pytest.mark.parametrize(
    "use",
    [
        lambda: Path("data/k.txt").read_text(),
        lambda: open("data/k.txt", "r+").close(),
        lambda: subprocess.run(["sh", "data/k.txt"], check=False),
        lambda: subprocess.run(["sh", "k.txt"], cwd="data", check=False),
        through_a_link(os.symlink),
        through_a_link(os.link),
        moved_away_and_back,
        lambda: (Path("data/k.txt").read_text(), Path("data/k.txt").touch()),
        made_again,
    ],
)
def test_a_file_is_known_by_the_name_that_the_code_gives_to_it(use, tmp_path, monkeypatch):
    """The target of a link may change, and a file that is linked to or moved is an input."""
    monkeypatch.chdir(tmp_path)
    for name in ("v1", "v2"):
        Path(name).mkdir()
        Path(name, "k.txt").write_text(f"echo {name}")
    Path("data.txt").write_text("1")
    os.symlink("v1", "data")
    with Observer() as observer:
        use()
    opened = observer.result({})
    assert read_again(opened) == opened
    os.remove("data")
    os.symlink("v2", "data")
    Path("data.txt").write_text("2222")
    assert read_again(opened) != opened


def test_a_module_without_its_source_counts(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "law.txt").write_text("K = 2.5")
    py_compile.compile(tmp_path / "law.txt", tmp_path / "law_without_source.pyc")
    with Observer() as observer:
        importlib.import_module("law_without_source")
    assert str(tmp_path / "law_without_source.pyc") in observer.result({})


def test_modules_of_a_zip_file_have_its_content_in_the_label(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path / "laws.zip")
    labels = []
    for factor in ("2.5", "3.5"):
        with zipfile.ZipFile(tmp_path / "laws.zip", "w") as file:
            file.writestr("law_of_zip.py", f"def law(a):\n    return {factor} * a\n")
        importlib.invalidate_caches()
        sys.modules.pop("law_of_zip", None)
        labels.append(items_of({"function": importlib.import_module("law_of_zip")})["source of law_of_zip"])
    assert labels[0] != labels[1]


def test_an_output_that_takes_the_place_of_a_file_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("out.txt").write_text("old")
    with Observer() as observer:
        Path("new.txt").write_text("new")
        os.rename("new.txt", "out.txt")
        Path("out.txt").read_text()
    assert not observer.result({})
