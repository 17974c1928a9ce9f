"""The rules of who may import whom, read from the source."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("fe_likelihoods", "samplers")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
PLOTTING = {"arviz", "corner", "matplotlib"}
CLIENTS = {"bilby", "pymc", "pytensor", "pints", "nautilus", "dask", "mpi4py", "openseespy"}
ADAPTED = {"bilby": {"bilby"}, "pymc": {"pymc", "pytensor"}, "pints": {"pints"}, "nautilus": {"nautilus"}}
PRIVATE_EMCEE = {"_random", "_moves", "_weights", "_previous_state", "_FunctionWrapper"}
PURE = {"ladder", "families", "resampling", "edges", "shears", "mixtures", "importance", "recycling", "coarse"}
# in samplers, from the bottom up: a module imports only what its line names
SAMPLERS = {
    "ladder": set(),
    "families": set(),
    "resampling": set(),
    "shears": set(),
    "edges": set(),
    "mixtures": {"edges", "shears"},
    "importance": {"ladder", "mixtures"},
    "recycling": {"edges", "importance", "ladder", "mixtures"},
    "coarse": {"importance", "mixtures", "recycling"},
    "journal": set(),
    "evaluation": {"journal"},
    "moves": {"edges", "mixtures"},
    "fast_sweeps": {"moves"},
    "backends": {"importance", "journal", "ladder"},
    "alarms": {"importance", "ladder"},
    "settings": {"resampling"},
    "mutation": {"settings"},
    "comparison": set(),
    "smc": {"moves", "settings", "tempered"},
    "tmcmc": {"moves", "settings", "tempered"},
    "climb": {
        "alarms",
        "coarse",
        "edges",
        "families",
        "importance",
        "ladder",
        "mixtures",
        "mutation",
        "recycling",
        "settings",
    },
    "resume": {"journal", "moves", "settings"},
    "tempered": {
        "alarms",
        "backends",
        "climb",
        "evaluation",
        "families",
        "fast_sweeps",
        "importance",
        "journal",
        "ladder",
        "moves",
        "resume",
        "settings",
    },
}


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imports(path: Path) -> list[tuple[str, bool]]:
    """Every imported module by its full name, and whether the import stands at the top of the module."""
    tree = ast.parse(path.read_text())
    inner = {
        node
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    guarded = {
        node
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING"
        for node in ast.walk(branch)
    }
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found = []
    for node in ast.walk(tree):
        if node in guarded:
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        found += [(module, node not in inner) for module in names]
    return found


@pytest.fixture(params=MODULES, ids=name)
def module(request) -> Path:
    return request.param


def test_the_reader_of_imports_reads(tmp_path, monkeypatch):
    """Control: a module that breaks the rules is seen to break them."""
    path = tmp_path / "samplers" / "bad.py"
    path.parent.mkdir()
    path.write_text("from ..fe_likelihoods import units\nfrom .ladder import Stage\ndef f():\n    import arviz\n")
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    assert imports(path) == [
        ("fe_likelihoods.units", True),
        ("samplers.tempering.weights.Stage", True),
        ("arviz", False),
    ]


def test_the_two_packages_do_not_know_each_other(module):
    own, other = (PACKAGES if name(module).startswith("fe_") else PACKAGES[::-1])[:2]
    assert name(module).startswith(own)
    assert not [m for m, _ in imports(module) if m.split(".")[0] == other]


def test_plots_and_clients_are_imported_where_used(module):
    at_top = {m.split(".")[0] for m, top in imports(module) if top}
    assert not at_top & (PLOTTING | CLIENTS)
    everywhere = {m.split(".")[0] for m, _ in imports(module)}
    if everywhere & PLOTTING:
        assert module.stem in ("report", "figures", "predictive"), "what is shown belongs into these"


def test_every_adapter_knows_its_client_and_the_posterior_alone(module):
    adapts = module.parent == ROOT / "fe_likelihoods" / "adapters"
    own = ADAPTED.get(module.stem, set()) if adapts else set()
    everywhere = {m for m, _ in imports(module)}
    adapted = {m.split(".")[0] for m in everywhere} & set().union(*ADAPTED.values())
    assert adapted == own
    if adapts and own:
        below = {m.split(".")[1] for m in everywhere if m.startswith("fe_likelihoods.")}
        assert below <= {"posterior", "priors"}, below


def test_storage_has_its_places(module):
    everywhere = {m.split(".")[0] for m, _ in imports(module)}
    assert "h5py" not in everywhere or module.stem in ("backends", "channels", "problems", "cache_exchange")
    assert "sqlite3" not in everywhere or module.stem in ("cache", "cache_file")


def test_kernels_stand_on_numba_alone():
    kernels = sorted((ROOT / "fe_likelihoods" / "kernels").glob("*.py"))
    for path in kernels:
        allowed = {"numpy", "numba", "math", "__future__", "typing", "collections"}
        if path.stem == "jit":  # the disk cache of compiled kernels needs files and hashes
            allowed |= sys.stdlib_module_names
        for imported, _ in imports(path):
            sibling = imported.startswith("fe_likelihoods.kernels")
            assert sibling or imported.split(".")[0] in allowed, f"{name(path)} imports {imported}"


def test_models_know_no_likelihood():
    allowed = {"kernels", "records", "channels", "units", "models", "isolated", "processes"}
    for path in sorted((ROOT / "fe_likelihoods" / "models").glob("*.py")):
        for imported, _ in imports(path):
            parts = imported.split(".")
            if parts[0] == "fe_likelihoods" and len(parts) > 1:
                drawn = path.stem == parts[1] == "figures"  # stand on units alone, see below
                assert drawn or parts[1] in allowed, f"{name(path)} imports {imported}"


def test_figures_know_units_and_residuals_alone():
    """So that records, measurements and models can draw themselves; whoever draws imports its figures where used."""
    path = ROOT / "fe_likelihoods" / "figures.py"
    assert {m.split(".")[1] for m, _ in imports(path) if m.startswith("fe_likelihoods")} == {"units", "residuals"}
    for path in MODULES:
        at_top = [m for m, top in imports(path) if top and "figures" in m.split(".")]
        assert not at_top or path.stem == "figures", f"{name(path)} imports {at_top} at its top"


def test_noise_knows_neither_model_nor_likelihood():
    below = {
        "residuals": set(),
        "noise": {"channels", "residuals"},
        "noise_marginal": {"noise", "priors"},
    }
    for stem, allowed in below.items():
        path = ROOT / "fe_likelihoods" / f"{stem}.py"
        own = {m.split(".")[1] for m, _ in imports(path) if m.split(".")[0] == "fe_likelihoods"}
        assert own <= allowed, f"{name(path)} imports {own - allowed}"


def test_processes_stand_on_the_standard_library_alone():
    """So that a worker starts at once, and waits for what its function imports only."""
    below = {"minder": set(), "processes": {"minder"}, "isolated": {"processes"}, "local_pool": {"processes"}}
    for stem, allowed in below.items():
        path = ROOT / "fe_likelihoods" / f"{stem}.py"
        for imported, _ in imports(path):
            top, *rest = imported.split(".")
            assert (rest[0] in allowed) if top == "fe_likelihoods" else top in sys.stdlib_module_names, imported


def test_samplers_stand_in_storeys():
    for path in sorted((ROOT / "samplers").glob("*.py")):
        if path.stem not in SAMPLERS:
            continue
        below = {m.split(".")[1] for m, _ in imports(path) if m.split(".")[0] == "samplers"}
        assert below <= SAMPLERS[path.stem], f"{name(path)} imports {below - SAMPLERS[path.stem]}"
        if path.stem in PURE:
            outside = {m.split(".")[0] for m, _ in imports(path)} - {"samplers"}
            assert outside <= {"numpy", "scipy", *sys.stdlib_module_names}, name(path)


def test_emcees_private_names_stay_in_tempered(module):
    if name(module) == "samplers/tempered.py":
        return
    used = {n.attr for n in ast.walk(ast.parse(module.read_text())) if isinstance(n, ast.Attribute)}
    used |= {m.split(".")[-1] for m, _ in imports(module) if m.startswith("emcee")}
    assert not used & PRIVATE_EMCEE


def test_public_names_are_declared(module):
    """Every module says what it exports, and exports only what it has."""
    tree = ast.parse(module.read_text())
    declared = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and [ast.unparse(t) for t in node.targets] == ["__all__"]
    ]
    if module.stem == "__init__" and not declared:
        return
    assert len(declared) == 1, f"{name(module)} needs one __all__"
    bound = set()
    guarded = [node for branch in tree.body if isinstance(branch, ast.If) for node in branch.body]  # imported when used
    for node in [*tree.body, *guarded]:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            bound |= {ast.unparse(t) for t in targets}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            bound |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
    assert set(declared[0]) <= bound


def test_no_prints(module):
    calls = [n for n in ast.walk(ast.parse(module.read_text())) if isinstance(n, ast.Call)]
    assert not [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]
