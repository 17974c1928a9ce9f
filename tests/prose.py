"""Two phrases that make docstrings hard to read, counted and listed: ``python -m tests.prose [FOLDER ...]``.

Both are mended by repeating the noun, or by putting nouns together: "sensor noise" for "the noise of the sensor" and
for "that of the sensor". The command fails where a package has more of one phrase than the limit, so `make lint` runs
it; with folders as arguments it lists the phrases in them.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path.cwd()
PACKAGES = ("fe_likelihoods", "samplers")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
PRONOUNS = re.compile(r"\b(?:that|those|the ones?) of\b", re.IGNORECASE)
CHAINS = re.compile(r"\bof (?:the |a |an |each |all |its |their )?[\w-]+ of\b")
MOST_PRONOUNS, MOST_CHAINS = 0.6, 1.6  # per 1000 words; seven projects that read well have .07 to .56, and .3 to 1.6


class Prose(NamedTuple):
    """Words of docstrings, and both phrases per 1000 of them."""

    words: int
    pronouns: float
    chains: float


def docstrings(tree: ast.Module) -> list[ast.Expr]:
    """The docstrings of a module, its classes and its functions."""
    bodies = [node.body for node in ast.walk(tree) if isinstance(node, DOCUMENTED)]
    return [body[0] for body in bodies if body and isinstance(body[0], ast.Expr) and text_of(body[0]) is not None]


def text_of(node: ast.Expr) -> str | None:
    """Text of a docstring on one line; None for any other expression."""
    value = getattr(node.value, "value", None)
    return " ".join(value.split()) if isinstance(value, str) else None


def count(folder: Path) -> Prose:
    """Both counts in the Python files of a folder."""
    texts = [text_of(node) for path in sorted(folder.rglob("*.py")) for node in docstrings(ast.parse(path.read_text()))]
    words = sum(len(text.split()) for text in texts)
    found = (1000 * sum(len(phrase.findall(text)) for text in texts) / max(words, 1) for phrase in (PRONOUNS, CHAINS))
    return Prose(words, *found)


def phrases(folder: Path) -> Iterator[str]:
    """File, first line of the docstring and words around each phrase."""
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder]:
        for node in docstrings(ast.parse(path.read_text())):
            text = text_of(node)
            for found in sorted([*PRONOUNS.finditer(text), *CHAINS.finditer(text)], key=lambda match: match.start()):
                around = text[max(0, found.start() - 50) : found.end() + 30]
                yield f"{path}:{node.lineno}: ... {around} ..."


def main(folders: list[str]) -> int:
    """Print the phrases of folders, or the counts of both packages; 1 if a count is above its limit."""
    if folders:
        print(*(line for folder in folders for line in phrases(Path(folder))), sep="\n")
        return 0
    above = False
    for package in PACKAGES:
        found = count(ROOT / package)
        above |= found.pronouns > MOST_PRONOUNS or found.chains > MOST_CHAINS
        print(
            f'{package}: {found.words} words of docstrings; "that of" {found.pronouns:.2f} (at most {MOST_PRONOUNS}), '
            f'"of ... of" {found.chains:.2f} (at most {MOST_CHAINS}) per 1000'
        )
    if above:
        print("repeat the noun, or put nouns together; `python -m tests.prose FOLDER` lists the places")
    return int(above)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
