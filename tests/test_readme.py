"""Every Python block of the README and of the documentation runs as printed, and every link leads to a file.

The blocks of a page run one after another as one script, as in a notebook, in an empty working folder. A block with
the comment ``slow`` on the line before it runs only with the slow tests, and a page of which that is the first line
runs only there. Pages that sample run only there as well; names that their blocks import are looked up quickly.
"""

import ast
import importlib
import re
import textwrap
from pathlib import Path
from typing import Any

import pytest

from tests.opensees_column import require_opensees
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[1]
GENERATED = {"api", "tutorials", "_build"}
PAGES = [
    ROOT / "README.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.rst") if p.relative_to(ROOT / "docs").parts[0] not in GENERATED),
]
SHOWN = [ROOT / "README.md", ROOT / "docs" / "five_minutes.rst"]  # pages with everything that their blocks print
# two CPU seconds or more
SAMPLING = {
    f"docs/{page}.rst" for page in ("arviz", "events", "faq", "few_simulations", "information", "modes", "parallel")
} | {"docs/model_errors.rst", "docs/predictions.rst"}
MARKDOWN = re.compile(r"(?P<slow><!-- slow -->\n)?```(?P<language>\w+)\n(?P<code>.*?)```", re.DOTALL)
RESTRUCTURED = re.compile(
    r"(?P<slow>^\.\. slow\n\n)?^\.\. code-block:: (?P<language>\w+)\n(?:   :.*\n)*\n(?P<code>(?:   .*\n|\n)+)",
    re.MULTILINE,
)
SHOWN_FILE = re.compile(r"^\.\. code-block:: text\n   :caption: (\S+)\n\n((?:   .*\n|\n)+)", re.MULTILINE)


def blocks(page: Path, language: str, slow: bool = True) -> list[str]:
    """Blocks of code in a language on a page; without the slow ones unless `slow`."""
    pattern = MARKDOWN if page.suffix == ".md" else RESTRUCTURED
    text = page.read_text()
    found = [match for match in pattern.finditer(text) if match["language"] == language]
    whole = text.startswith(".. slow\n") or name_of(page) in SAMPLING
    return [textwrap.dedent(match["code"]) for match in found if slow or not (whole or match["slow"])]


def name_of(page: Path) -> str:
    """Path of a page from the root of the repository."""
    return page.relative_to(ROOT).as_posix()


def run(page: Path, folder: Path, slow: bool) -> dict[str, Any]:
    """Run the Python blocks of a page as one script in `folder`, which has the files that are shown with their name."""
    for name, content in SHOWN_FILE.findall(page.read_text()):
        (folder / name).write_text(textwrap.dedent(content).strip() + "\n")
    script = folder / "page.py"
    script.write_text("\n\n".join(blocks(page, "python", slow)))
    return run_script(script)


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
        and page not in SHOWN  # test_first_examples_print_what_is_shown
    ],
    ids=name_of,
)
def test_slow_python_blocks_run_as_printed(page, tmp_path):
    run(page, tmp_path, slow=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWN, ids=name_of)
def test_first_examples_print_what_is_shown(page, tmp_path, capsys):
    """The words, the means to 1 %, and other numbers within a factor: another machine has other draws of the guide."""
    found = run(page, tmp_path, slow=True)
    printed, shown = capsys.readouterr().out, "".join(blocks(page, "text"))
    number = re.compile(r"\d+\.?\d*(?:e-?\d+)?")
    assert number.sub("", printed).split() == number.sub("", shown).split()
    numbers = zip(number.findall(printed), number.findall(shown), strict=True)
    assert all(0.3 < float(one) / float(other) < 3.0 for one, other in numbers)
    for parameter, mean in zip(
        found["posterior"].parameters, found["sampler"].get_chain(flat=True).mean(0), strict=True
    ):
        (value,) = re.findall(rf"^{re.escape(parameter.label)} +(\S+)", shown, re.MULTILINE)
        assert float(value) == pytest.approx(parameter.shown(mean), rel=0.01)
    (stated,) = re.findall(r"After (\d+) simulations", page.read_text())
    assert 0.7 < found["sampler"].verdict.simulations / int(stated) < 1.4


def test_blocks_import_names_that_exist():
    for page in PAGES:
        for code in blocks(page, "python"):
            for node in ast.walk(ast.parse(code)):
                if (getattr(node, "module", None) or "").partition(".")[0] in ("fe_likelihoods", "samplers"):
                    module = importlib.import_module(node.module)
                    assert all(hasattr(module, alias.name) for alias in node.names), name_of(page)


def test_every_python_block_is_found():
    """A block in another form of markup would not be run."""
    for page in PAGES:
        marks = re.findall(
            r"^\s*(?:```python|\.\. code(?:-block)?:: python|\.\. code::)", page.read_text(), re.MULTILINE
        )
        assert len(marks) == len(blocks(page, "python")), name_of(page)
        assert "::python" not in page.read_text(), name_of(page)


def test_targets_and_files_that_pages_name_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        for target in re.findall(r"`make ([a-z-]+)`", page.read_text()):
            assert target in targets, f"{name_of(page)}: make {target}"
        for code in blocks(page, "sh"):
            for target in re.findall(r"^make ([a-z-]+)", code, re.MULTILINE):
                assert target in targets, f"{name_of(page)}: make {target}"
            for path in re.findall(r"\b(?:tutorials|tests|docs|data)/[\w/.]+", code):
                assert (ROOT / path).exists(), f"{name_of(page)}: {path}"


def test_links_to_files_lead_somewhere():
    for page in [*PAGES, *ROOT.glob("*.md"), ROOT / "data" / "README.md"]:
        text = page.read_text()
        links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
        links += re.findall(r"^\.\. (?:figure|image|literalinclude):: (\S+)", text, re.MULTILINE)
        for link in links:
            assert (page.parent / link).exists(), f"{name_of(page)} links {link}"


def test_files_named_in_the_text_exist():
    """Paths such as ``benchmarks`` or ``fe_likelihoods/models/rc_column.py`` in running text."""
    pattern = re.compile(r"(?<!:doc:)`((?:fe_likelihoods|samplers|tutorials|tests|data|docs)/[\w./]*\w/?)`")
    for page in PAGES:
        for path in pattern.findall(page.read_text()):
            assert (ROOT / path).exists() or path.startswith("docs/_build"), f"{name_of(page)}: {path}"


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 80
