"""The rules of who may import whom, and what no module may contain; one case per rule, violations are listed."""

import ast
import re
import sys
from pathlib import Path

from tests.architecture import (
    ORDER,
    PACKAGES,
    ROOT,
    Import,
    imports,
    module_cycles,
    modules,
    package_graph,
    second_defaults,
    tree_of,
)

PLOTTING = {"arviz", "corner", "matplotlib"}
CLIENTS = {"bilby", "pymc", "pytensor", "pints", "nautilus", "dask", "distributed", "mpi4py", "openseespy", "umbridge"}
ADAPTED = {"bilby": {"bilby"}, "pymc": {"pymc", "pytensor"}}
PRIVATE_EMCEE = {"_random", "_moves", "_weights", "_previous_state", "_FunctionWrapper"}
WORKERS = {"faults", "interrupts", "files", "folder", "by_value", "user_code", "worker", "local_pool", "programs"}
# a thing and its figure, section of the command, report or other package
SAME_NAME = {"comparison", "damage", "events", "finding", "guide", "inputs", "isolated_bridge", "priors", "results"} | {
    "interrupts",
    "sampling",
    "scores",
    "sensors",
    "starting",
}


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def folder(path: Path) -> str:
    """Entry at the top of the package: its folder, or the module itself."""
    return path.relative_to(ROOT).with_suffix("").parts[1]


def top(imported: Import) -> str:
    return imported.name.split(".")[0]


def own(path: Path) -> set[str]:
    """The folders and top modules of its own package that a module imports from."""
    package = path.relative_to(ROOT).parts[0]
    return {i.name.split(".")[1] for i in imports(path) if top(i) == package and "." in i.name}


def trees():
    for path in modules():
        yield path, tree_of(path)


def test_control_the_reader_of_imports_finds_what_breaks_the_rules(tmp_path):
    bad = tmp_path / "samplers" / "tempering" / "bad.py"
    bad.parent.mkdir(parents=True)
    bad.write_text(
        "from typing import TYPE_CHECKING\nfrom ..moves.population_moves import RandomWalkMove\nfrom . import weights\n"
        "if TYPE_CHECKING:\n    from ..smc import SMCSampler\ndef f():\n    import arviz\n"
    )
    (bad.parent / "weights.py").write_text("from . import bad\n")
    (tmp_path / "samplers" / "smc.py").write_text("from .tempering.bad import f\n")
    (tmp_path / "samplers" / "moves.py").write_text("")
    assert imports(bad, tmp_path)[1:] == [
        ("samplers.moves.population_moves.RandomWalkMove", True),
        ("samplers.tempering.weights", True),
        ("samplers.smc.SMCSampler", False),
        ("arviz", False),
    ]
    graph = package_graph("samplers", tmp_path)
    assert graph.cycles == [("smc", "tempering")] and graph.edges >= {("tempering", "moves"), ("tempering", "smc")}
    assert module_cycles(tmp_path) == [
        ("samplers.smc", "samplers.tempering.bad", "samplers.tempering.weights"),
    ]


def test_samplers_import_nothing_of_fe_likelihoods():
    """The other direction is free: likelihoods may use samplers."""
    from_samplers = [(path, i) for path in modules(package="samplers") for i in imports(path)]
    assert not [name(path) for path, i in from_samplers if top(i) == "fe_likelihoods"]
    assert [p for p in modules(package="fe_likelihoods") for i in imports(p) if top(i) == "samplers"]  # control


def test_tests_import_no_benchmark():
    """Benchmarks import helpers of the tests; what a test needs is in `tests`."""
    used = re.compile(r"^\s*(from|import) benchmarks\b", re.MULTILINE)
    assert not [name(path) for path in (ROOT / "tests").rglob("*.py") if used.search(path.read_text())]
    assert any(used.search(path.read_text()) for path in (ROOT / "benchmarks").glob("test_*.py"))  # control


def test_folders_import_only_from_folders_below_them():
    for package, order in ORDER.items():
        graph = package_graph(package)
        height = {entry: -line for line, entries in enumerate(order) for entry in entries}
        assert set(height) == set(graph.nodes), "tests.architecture.ORDER lists every folder"
        assert not [(a, b) for a, b in sorted(graph.edges) if height[a] <= height[b]]
        assert not graph.cycles


def test_no_modules_import_each_other_in_a_circle():
    assert not module_cycles()


def test_contributing_maps_every_folder():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    for package in PACKAGES:
        missing = [entry for entry in package_graph(package).nodes if f"{entry}" not in text]
        assert not missing, f"not in CONTRIBUTING.md: {missing} of {package}"


def test_plots_are_made_in_plots_and_reporting_with_libraries_imported_where_used():
    for path in modules():
        used = {top(i): i.at_top for i in imports(path) if top(i) in PLOTTING | CLIENTS}
        assert not any(used.values()), f"{name(path)} imports {used} at its top"
        for library in set(used) & PLOTTING:
            # annotations of what a method returns
            typed = library == "matplotlib" and all(
                "Figure" in i.name or "Axes" in i.name for i in imports(path) if top(i) == library
            )
            assert folder(path) in ("plots", "reporting") or typed, f"{name(path)} imports {library}"


def test_nothing_below_imports_plots():
    """Drawing knows the types, and the types do not know drawing; reports and the command are above."""
    for path in modules(package="fe_likelihoods"):
        if folder(path) not in ("plots", "reporting", "command", "__init__"):
            assert "plots" not in own(path), name(path)


def test_files_of_the_same_name_hold_the_same_thing():
    stems = [path.stem for path in modules() if path.stem not in ("__init__", "__main__")]
    assert {stem for stem in stems if stems.count(stem) > 1} <= SAME_NAME


def test_every_adapter_imports_its_client_and_the_posterior_alone():
    for path in modules():
        adapts = name(path).startswith("fe_likelihoods/adapters/")
        expected = ADAPTED.get(path.stem, set()) if adapts else set()
        assert {top(i) for i in imports(path)} & set().union(*ADAPTED.values()) == expected, name(path)
        more = {"models"} if path.stem == "__init__" else set()  # the server is in the module of its client
        assert not adapts or own(path) <= {"adapters", "likelihood", "priors"} | more, name(path)


def test_file_formats_have_their_places():
    for path in modules():
        used = {top(i) for i in imports(path)}
        if "h5py" in used:
            places = (
                "fe_likelihoods/signals/",
                "samplers/output",
                "samplers/record",
                "fe_likelihoods/simulation/cache_",
            )
            assert name(path).startswith(places), name(path)
        assert "sqlite3" not in used or folder(path) == "cache", name(path)


def test_kernels_import_numba_numpy_and_each_other_alone():
    allowed = {"numpy", "numba", "math", "__future__", "typing", "collections"}
    for path in sorted((ROOT / "fe_likelihoods" / "kernels").glob("*.py")):
        more = sys.stdlib_module_names if path.stem == "jit" else set()  # its disk cache needs files and hashes
        bad = [i.name for i in imports(path) if top(i) not in allowed | more | {"fe_likelihoods"}]
        assert not bad and own(path) <= {"kernels"}, f"{name(path)}: {bad}"


def test_worker_processes_import_the_standard_library_and_cloudpickle_alone():
    """A worker starts at once, and waits only for what its function imports."""
    for stem in WORKERS:
        path = ROOT / "fe_likelihoods" / "simulation" / f"{stem}.py"
        for i in imports(path):
            sibling = i.name.startswith("fe_likelihoods.simulation.") and i.name.split(".")[2] in WORKERS
            light = i.name.startswith("samplers.interrupts") or top(i) in {*sys.stdlib_module_names, "cloudpickle"}
            assert sibling or light, f"{name(path)} imports {i.name}"
    for package in ("fe_likelihoods/__init__.py", "fe_likelihoods/simulation/__init__.py", "samplers/__init__.py"):
        light = {*sys.stdlib_module_names, "lazy_loader"}
        heavy = [i.name for i in imports(ROOT / package) if i.at_top and top(i) not in light]
        assert not heavy, package


def test_mathematics_of_the_samplers_needs_numpy_and_scipy_alone():
    for path in modules(package="samplers"):
        pure = folder(path) in ("proposals", "estimates", "resampling")
        if pure:
            outside = {top(i) for i in imports(path)} - {"samplers", "numpy", "scipy", *sys.stdlib_module_names}
            assert not outside, f"{name(path)} imports {outside}"


def test_private_names_of_emcee_are_used_in_one_module():
    users = set()
    for path, tree in trees():
        if not name(path).startswith("samplers/"):
            continue
        used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        used |= {i.name.split(".")[-1] for i in imports(path) if i.name.startswith("emcee")}
        if used & PRIVATE_EMCEE:
            users.add(name(path))
    assert len(users) == 1, users


def test_public_names_are_declared():
    """Every module has one `__all__`, which lists only what the module defines."""
    for path, tree in trees():
        declared = [
            node.value
            for node in tree.body
            if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]
        ]
        if path.name == "__init__.py" and not declared:
            continue
        assert len(declared) == 1, f"{name(path)} needs one __all__"
        bound = set()
        guarded = [node for branch in tree.body if isinstance(branch, ast.If) for node in branch.body]
        for node in [*tree.body, *guarded]:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                bound.add(node.name)
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                bound |= {ast.unparse(target) for target in targets}
            elif isinstance(node, ast.ImportFrom | ast.Import):
                bound |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        assert set(ast.literal_eval(declared[0])) <= bound, name(path)


def test_no_module_prints():
    for path, tree in trees():
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        assert not [call for call in calls if isinstance(call, ast.Name) and call.id == "print"], name(path)


def test_public_names_are_imported_from_the_packages():
    """Tutorials, README and pages of the documentation import what the façade has from the façade."""
    exported = {package: set(__import__(package).__all__) for package in PACKAGES}
    texts = [*ROOT.glob("tutorials/*.py"), ROOT / "README.md", *ROOT.glob("docs/*.rst"), *ROOT.glob("docs/*.py")]
    for path in texts:
        for package, inner, names in re.findall(
            r"from (fe_likelihoods|samplers)\.([\w.]+) import ([^\n(]+)", path.read_text()
        ):
            found = {part.split(" as ")[0].strip() for part in names.split(",")} & exported[package]
            assert not found, f"{name(path)}: import {', '.join(found)} from {package}, not from {package}.{inner}"


def test_sources_cite_only_what_a_reader_has():
    """No file outside the repository; pages of docs/theory that exist."""
    files = [
        *modules(),
        *ROOT.glob("tutorials/*.py"),
        *ROOT.glob("docs/**/*.rst"),
        *ROOT.glob("data/*.*"),
        ROOT / "README.md",
    ]
    for path in files:
        if path.suffix not in (".py", ".rst", ".md"):
            continue
        text = path.read_text()
        assert not re.search(r"specs/|papers/\w+\.(txt|md)|FE_SHARED", text), name(path)
        for page in re.findall(r"docs/theory/(\w+)", text):
            assert (ROOT / "docs" / "theory" / f"{page}.rst").is_file(), f"{name(path)} cites docs/theory/{page}"


def test_defaults_of_settings_are_written_once():
    assert not second_defaults()


CHECKS = ("samplers/judgement/", "fe_likelihoods/checks/")
# limits of effort, settings of a search, of an estimate, and of what is printed: they judge nothing
EFFORT = {"EQUALLY_NEAR", "FEWEST", "FEWEST_DRAWS", "FINE", "FLOOR", "KEPT_APART", "LARGEST_TEST", "LATE_SHARE"} | {
    *("LONGEST_LAG", "LONGEST_SHARE", "MOST_DRAWS", "MOST_FAULTS", "MOST_SEARCHED"),
    *("MOST_PLACES", "MOST_SPIKES", "MOST_STORED", "MOST_VALUES"),
    *("NEAR_ENOUGH", "SAME_UNITS", "SECONDS", "SMOOTH", "TAPER", "TEST_SECONDS"),
}
MAKERS = {"Finding", "warnings.warn", "logger.warning"}


def called(node: ast.AST) -> set[str]:
    """Functions and classes that are called in a part of a module, as they are written."""
    return {ast.unparse(each.func) for each in ast.walk(node) if isinstance(each, ast.Call)}


def limits_of(tree: ast.Module) -> set[str]:
    """Module-level names of numbers."""
    found = set()
    for node in tree.body:
        numbers = isinstance(node, ast.Assign) and [
            each
            for each in ast.walk(node.value)
            if isinstance(each, ast.Constant) and isinstance(each.value, int | float)
        ]
        if numbers and any(numbers):
            found |= {each.id for target in node.targets for each in ast.walk(target) if isinstance(each, ast.Name)}
    return found


def judged_by_limits(tree: ast.Module) -> list[str]:
    """Conditions on a number of the module under which the module warns or makes a finding."""
    limits = limits_of(tree)
    return [
        ast.unparse(node.test)
        for node in ast.walk(tree)
        if isinstance(node, ast.If)
        and {each.id for each in ast.walk(node.test) if isinstance(each, ast.Name)} & limits
        and any(called(statement) & MAKERS for statement in node.body)
    ]


def test_findings_are_made_in_checks_and_judgement_alone():
    """Other modules return numbers; they may ask the checks, keep findings, show them and warn of them."""
    makers = {name(path) for path, tree in trees() if "Finding" in called(tree)}
    makers.remove("samplers/output.py")  # reads stored findings
    assert not [path for path in makers if not path.startswith(CHECKS)]
    assert len(makers) > 8  # control


def test_limits_that_judge_are_in_checks_and_judgement_alone():
    """No other module of a result warns where a number of its own is exceeded; caches and processes may."""
    control = ast.parse("LIMIT = 0.5\ndef f(x):\n    if x > LIMIT:\n        warnings.warn('large')\n")
    assert judged_by_limits(control) == ["x > LIMIT"]
    for path, tree in trees():
        if not name(path).startswith(CHECKS) and folder(path) not in ("cache", "simulation"):
            assert not judged_by_limits(tree), name(path)


def test_the_limits_of_the_checks_are_few_and_have_a_source():
    """At most 60, each with a comment beside it or above; 15 of them recognise sensors by their samples, four modes."""
    count = 0
    for path in sorted((ROOT / "fe_likelihoods" / "checks").glob("*.py")):
        lines = path.read_text().splitlines()
        for node in tree_of(path).body:
            found = limits_of(ast.Module([node], []))
            above = lines[max(node.lineno - 4, 0) : node.lineno - 1]
            said = "#" in lines[node.lineno - 1] or any(line.startswith("#") for line in above)
            assert said or not found, f"{name(path)}: {found} without a source"
            count += len(found - EFFORT)
    assert 10 < count <= 60
