"""Every Python block of the README and of the documentation runs as printed, and every link leads to a file.

The blocks of a page run one after another as one script, as in a notebook, in an empty working folder. A block with
the comment ``slow`` on the line before it runs only with the slow tests, and a page of which that is the first line
runs only there.
"""

import re
import textwrap
from pathlib import Path

import pytest

from fe_likelihoods import problems
from tests.opensees_column import require_opensees
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[1]
GENERATED = {"api", "tutorials", "_build"}
PAGES = [
    ROOT / "README.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.rst") if p.relative_to(ROOT / "docs").parts[0] not in GENERATED),
]
MARKDOWN = re.compile(r"(?P<slow><!-- slow -->\n)?```(?P<language>\w+)\n(?P<code>.*?)```", re.DOTALL)
RESTRUCTURED = re.compile(
    r"(?P<slow>^\.\. slow\n\n)?^\.\. code-block:: (?P<language>\w+)\n(?:   :.*\n)*\n(?P<code>(?:   .*\n|\n)+)",
    re.MULTILINE,
)


def blocks(page: Path, language: str, slow: bool = True) -> list[str]:
    """Blocks of code in a language on a page; without the slow ones unless `slow`."""
    pattern = MARKDOWN if page.suffix == ".md" else RESTRUCTURED
    text = page.read_text()
    found = [match for match in pattern.finditer(text) if match["language"] == language]
    whole = text.startswith(".. slow\n")
    return [textwrap.dedent(match["code"]) for match in found if slow or not (whole or match["slow"])]


def name_of(page: Path) -> str:
    """Path of a page from the root of the repository."""
    return page.relative_to(ROOT).as_posix()


def run(page: Path, folder: Path, slow: bool) -> None:
    """Run the Python blocks of a page as one script in `folder`."""
    script = folder / "page.py"
    script.write_text("\n\n".join(blocks(page, "python", slow)))
    run_script(script)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python", slow=False)], ids=name_of)
def test_python_blocks_run_as_printed(page, tmp_path):
    if any("OpenSeesModel(" in block for block in blocks(page, "python", slow=False)):
        require_opensees()
    run(page, tmp_path, slow=False)


@pytest.mark.slow
@pytest.mark.timeout(2000)
@pytest.mark.parametrize(
    "page",
    [
        page
        for page in PAGES
        if blocks(page, "python") != blocks(page, "python", slow=False)
        and page.name != "decisions.rst"  # tests/prediction/test_page_of_decisions.py runs its blocks
    ],
    ids=name_of,
)
def test_slow_python_blocks_run_as_printed(page, tmp_path):
    run(page, tmp_path, slow=True)


def test_first_lines_of_the_readme_run_with_another_posterior(tmp_path, monkeypatch, capsys):
    """With the bridge column, which takes half a minute, they run among the slow tests."""
    first, own_model, *_ = blocks(ROOT / "README.md", "python")
    assert 'problems.bridge_column(data="short")' in first
    script = tmp_path / "own_model.py"
    script.write_text(own_model.split("sampler =")[0])
    posterior = run_script(script)["posterior"]
    monkeypatch.setattr(problems, "bridge_column", lambda data: posterior)
    (tmp_path / "first.py").write_text(first)
    variables = run_script(tmp_path / "first.py")
    assert abs(variables["sampler"].get_chain(flat=True).mean(axis=0)[0] - 1.1) < 0.01  # the true stiffness
    assert f"log-evidence {variables['sampler'].log_evidence:.1f}" in capsys.readouterr().out
    assert (tmp_path / "report.html").is_file()


def test_every_python_block_is_found():
    """A block in another form of markup would not be run."""
    for page in PAGES:
        marks = re.findall(
            r"^\s*(?:```python|\.\. code(?:-block)?:: python|\.\. code::)", page.read_text(), re.MULTILINE
        )
        assert len(marks) == len(blocks(page, "python")), name_of(page)
        assert "::python" not in page.read_text(), name_of(page)


def test_shell_blocks_name_targets_and_files_that_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        for code in blocks(page, "sh"):
            for target in re.findall(r"^make ([a-z-]+)", code, re.MULTILINE):
                assert target in targets, f"{name_of(page)}: make {target}"
            for path in re.findall(r"\b(?:tutorials|tests|docs|data)/[\w/.]+", code):
                assert (ROOT / path).exists(), f"{name_of(page)}: {path}"


def test_make_targets_in_the_text_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        for target in re.findall(r"`make ([a-z-]+)`", page.read_text()):
            assert target in targets, f"{name_of(page)}: make {target}"


def test_links_to_files_lead_somewhere():
    for page in [*PAGES, *ROOT.glob("*.md"), ROOT / "data" / "README.md"]:
        text = page.read_text()
        links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
        links += re.findall(r"^\.\. (?:figure|image|literalinclude):: (\S+)", text, re.MULTILINE)
        for link in links:
            assert (page.parent / link).exists(), f"{name_of(page)} links {link}"


def test_files_named_in_the_text_exist():
    """Paths such as ``benchmarks`` or ``fe_likelihoods/models/steel_coupon.py`` in running text."""
    pattern = re.compile(r"(?<!:doc:)`((?:fe_likelihoods|samplers|tutorials|tests|data|docs)/[\w./]*\w/?)`")
    for page in PAGES:
        for path in pattern.findall(page.read_text()):
            assert (ROOT / path).exists() or path.startswith("docs/_build"), f"{name_of(page)}: {path}"


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100
