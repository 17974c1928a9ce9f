"""The two façades and code of a user, read by pyright in basic mode as an editor reads them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PYRIGHT = shutil.which("pyright", path=str(Path(sys.executable).parent)) or shutil.which("pyright")
needs_pyright = pytest.mark.skipif(PYRIGHT is None, reason="types are not checked: pip install 'pyright[nodejs]'")


def errors(*files: Path, folder: Path) -> list[str]:
    """Errors of pyright in some files, without settings of the project."""
    command = [PYRIGHT, "--outputjson", "--pythonpath", sys.executable, *map(str, files)]
    found = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=300)
    report = json.loads(found.stdout)
    assert report["summary"]["filesAnalyzed"] == len(files), found.stdout
    return [f"{Path(each['file']).name}: {each['message']}" for each in report["generalDiagnostics"]]


@needs_pyright
def test_facades_and_code_of_a_user_have_no_errors_of_types():
    files = [ROOT / "fe_likelihoods" / "__init__.pyi", ROOT / "samplers" / "__init__.pyi", ROOT / "tests/user_code.py"]
    assert all((file.parent / "py.typed").is_file() for file in files[:2])
    assert errors(*files, folder=ROOT) == []


@needs_pyright
def test_wrong_code_of_a_user_is_found(tmp_path):
    """Names, arguments and results are known to the checker; none of them is Any."""
    code = (ROOT / "tests" / "user_code.py").read_text()
    code += "\nfe.Rekord\nPosterior(3.0, prior).ndim\nfuture.skore(measured)\nfe.propagate(posterior, samples, sed=1)\n"
    (tmp_path / "wrong.py").write_text(code)
    found = errors(tmp_path / "wrong.py", folder=ROOT)
    for words in ("Rekord", "float", "skore", 'No overloads for "propagate"'):
        assert any(words in error for error in found), (words, found)
