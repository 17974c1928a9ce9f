"""An import brings no more along than it needs, and every name is there as if it did."""

import ast
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fe_likelihoods
import samplers

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {
    *("arviz", "corner", "distributed", "emcee", "h5py", "matplotlib", "numba", "pandas", "xarray"),
    *("scipy.signal", "scipy.special", "scipy.stats"),
}


def fresh(code: str) -> str:
    """What `code` prints in a new interpreter that finds the packages under test."""
    paths = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.parametrize(
    ("code", "allowed"),
    [
        ("import fe_likelihoods, samplers", set()),
        ("import fe_likelihoods.problems, fe_likelihoods.priors.priors, fe_likelihoods.simulation.model", set()),
        ("from fe_likelihoods import FELikelihood, Record, SimulationCache", set()),
        ("import fe_likelihoods.models.linear_oscillator, fe_likelihoods.models.function", set()),
        ("import fe_likelihoods.models.rc_column", {"numba"}),
        ("import fe_likelihoods; fe_likelihoods.problems.bridge_column()", {"h5py", "numba", "scipy.special"}),
        ("from samplers import SMCSampler", {"emcee", "h5py", "scipy.special"}),
        ("from fe_likelihoods import *; from samplers import *", {"emcee", "h5py", "numba", "scipy.special"}),
    ],
)
def test_import_brings_what_it_needs(code, allowed):
    brought = set(json.loads(fresh(f"import json, sys; {code}; print(json.dumps(sorted(sys.modules)))"))) & HEAVY
    assert brought <= allowed
    assert brought or not allowed  # where something is allowed it is there: what is looked for can be found


@pytest.mark.parametrize("package", ["fe_likelihoods", "samplers"])
def test_every_public_name_is_there(package):
    names = sorted(__import__(package).__all__)
    code = f"from {package} import *; print(sorted(n for n, value in globals().items() if n in {names} and value))"
    assert fresh(code).strip() == str(names)


@pytest.mark.parametrize(("package", "most"), [(samplers, 12), (fe_likelihoods, 91)])
def test_the_stub_lists_what_it_imports(package, most):
    """`__all__` of the stub, which type checkers read, has the names that exist at run time."""
    tree = ast.parse((ROOT / package.__name__ / "__init__.pyi").read_text())
    imported = {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    (declared,) = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)]
    assert imported == set(declared) == set(package.__all__) <= set(dir(package))
    assert len(declared) <= most


def test_no_folder_or_module_has_the_name_of_a_public_function():
    """Such a name would be the function or the module, whichever was imported last."""
    for package in (fe_likelihoods, samplers):
        folder = Path(package.__file__).parent
        names = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
        shared = names & set(package.__all__)
        assert all(inspect.ismodule(getattr(package, name)) for name in shared), shared
