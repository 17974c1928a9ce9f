"""What is distributed: the packages with their data and templates, and one version everywhere."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from setuptools import find_packages

from tests.test_readme import blocks

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = [*find_packages(str(ROOT), include=["fe_likelihoods*", "samplers*"]), "fe_likelihoods.data"]
VERSION = PROJECT["project"]["version"]


def folder_of(package: str) -> Path:
    renamed = PROJECT["tool"]["setuptools"]["package-dir"]
    return ROOT / renamed.get(package, package.replace(".", "/"))


def distributed() -> set[str]:
    """Files of the wheel: the modules of all packages, and what their patterns of data match."""
    data = PROJECT["tool"]["setuptools"]["package-data"]
    files = set()
    for package in PACKAGES:
        folder = folder_of(package)
        for pattern in ("*.py", *data.get(package, ())):
            found = [path for path in folder.glob(pattern) if path.is_file()]
            assert found, f"{pattern} of {package} matches nothing"
            files |= {f"{package.replace('.', '/')}/{path.relative_to(folder).as_posix()}" for path in found}
    return files


def sources() -> set[str]:
    """All files in the folders of the packages, without what running Python leaves there."""
    files = set()
    for top, package in (("fe_likelihoods",) * 2, ("samplers",) * 2, ("data", "fe_likelihoods/data")):
        for path in (ROOT / top).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                files.add(f"{package}/{path.relative_to(ROOT / top).as_posix()}")
    return files


def test_the_wheel_has_every_file_of_the_packages_and_no_test():
    files = distributed()
    assert not files ^ sources()
    assert {"fe_likelihoods/data/bridge_column_eq1.h5", "fe_likelihoods/reporting/templates/report.html"} <= files
    assert not [name for name in files if "test" in re.sub("load.test", "", name)]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_new_environment_runs_the_readme(tmp_path):
    """Source distribution, the wheel made from it, its installation, the first example and the command."""
    source, ignored = tmp_path / "source", shutil.ignore_patterns("__pycache__")
    for name in ("fe_likelihoods", "samplers", "data"):
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    given = {path.name for path in source.iterdir()}
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}

    def run(*command):
        done = subprocess.run(
            [*map(str, command)], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=1500
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
        return done.stdout

    run(sys.executable, "-m", "venv", "new")
    python = tmp_path / "new" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "build")
    run(python, "-m", "build", "--outdir", tmp_path / "dist", source)  # the wheel is made from the source distribution
    run(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path / "again", source)
    assert {path.name for path in source.iterdir()} == given  # nothing is left behind
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert (tmp_path / "dist" / f"fe_likelihoods-{VERSION}.tar.gz").is_file()
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert not names ^ distributed()
    run(python, "-m", "pip", "install", "--quiet", wheel)
    (tmp_path / "first.py").write_text(blocks(ROOT / "README.md", "python")[0])
    assert "log-evidence" in run(python, "first.py")
    assert "Usage" in run(tmp_path / "new" / "bin" / "fe-likelihoods", "--help")
