"""Size of the project in one table: ``python -m tests.size``, or ``make size``.

It measures the checkout in the current folder: lines by room beside their budgets, words, and frames on the stack from
`run_mcmc` (included) to the user's function (excluded), counted while the function runs.
"""

import ast
import sys
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np

from tests.prose import docstrings

ROOT = Path.cwd()
BUDGETS = {  # lines of Python files, docstrings included
    "samplers": 8000,
    **{
        f"fe_likelihoods/{room}": budget
        for room, budget in {
            "emulation": 1600,
            "likelihood": 2300,
            "simulation": 2200,
            "cache": 1300,
            "noise": 2100,
            "priors": 1400,
            "signals": 3800,
            "models": 5200,
            "kernels": 3400,
            "prediction": 3300,
            "events": 1700,
            "information": 1000,
            "column_damage": 600,
            "checks": 1600,
            "reporting": 1000,
            "plots": 1400,
            "command": 1900,
            "adapters": 500,
            "modal": 1200,
        }.items()
    },
    "fe_likelihoods": 38_000,
    "tests": 38_000,
    "benchmarks": 2500,
    "tutorials": 2000,
}
WALKERS = 300  # enough that SMCSampler recycles


def lines_of(folder: str) -> tuple[int, int]:
    """Lines, and lines of code (no blank lines, comments and docstrings), of the Python files of a folder."""
    lines = code = 0
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text()
        prose = {n for node in docstrings(ast.parse(text)) for n in range(node.lineno, node.end_lineno + 1)}
        numbered = list(enumerate(text.splitlines(), 1))
        lines += len(numbered)
        code += sum(bool(s := line.strip()) and s[0] != "#" and n not in prose for n, line in numbered)
    return lines, code


class Normal:
    """Standard normal prior and a Gaussian likelihood; notes the stack at each call."""

    def __init__(self):
        self.stacks: list[list[str]] = []

    def log_prior(self, x):
        return -0.5 * np.sum(x**2, axis=-1) - 1.5 * np.log(2 * np.pi)

    def sample_prior(self, n, random):
        return random.standard_normal((n, 3))

    def __call__(self, x):
        self.stacks.append(stack_to("run_mcmc"))
        return self.log_prior(x) - 0.5 * np.sum((x - 0.7) ** 2, axis=-1) / 0.1**2


def stack_to(name: str) -> list[str]:
    """Files of the frames between the caller and the outermost frame of this name, which is included."""
    files, found, frame = [], 0, sys._getframe(2)
    while frame is not None:
        files.append(frame.f_code.co_filename)
        found = len(files) if frame.f_code.co_name == name else found
        frame = frame.f_back
    return files[:found]


def describe(stacks: list[list[str]]) -> str:
    """Frames and distinct files of the deepest stack."""
    stack = max(stacks, key=len)
    return f"{len(stack)} frames in {len(set(stack))} files"


def frames_of(sampler: type) -> list[str]:
    """Deepest stacks of the two parts of a run: annealing, and steps at beta = 1."""
    posterior, found = Normal(), []
    run = sampler(WALKERS, 3, posterior)
    for start, steps in ((np.random.default_rng(1).standard_normal((WALKERS, 3)), 0), (None, 3)):
        posterior.stacks.clear()
        run.run_mcmc(start, steps)
        found.append(describe(posterior.stacks))
    return found


def rows():
    """Pairs of label and value, in the order of the table."""
    for folder, budget in BUDGETS.items():
        lines, code = lines_of(folder)
        yield f"{folder}: lines, budget, lines of code", f"{lines:6d} {budget:6d} {code:6d}"
    pages = [path for path in (ROOT / "docs").rglob("*.rst") if not {"api", "tutorials", "_build"} & set(path.parts)]
    words = sum(len(path.read_text().split()) for path in pages)
    yield "docs: pages, words, budget", f"{len(pages)} {words} 45000"
    yield "README: words", str(len((ROOT / "README.md").read_text().split()))
    for name in ("SMCSampler", "TMCMCSampler"):
        annealing, final = frames_of(getattr(import_module("samplers"), name))
        yield f"{name}: run_mcmc to the function, annealing, at beta = 1", f"{annealing}; {final}"


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    warnings.simplefilter("ignore")
    for label, value in rows():
        print(f"{label:<70} {value}", flush=True)
