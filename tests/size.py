"""Size of the project in one table: ``python -m tests.size``, or ``make size``.

Of the checkout in the current folder. Frames are from `run_mcmc` (included) to the user's function (excluded).
"""

import sys
import traceback
import warnings
from pathlib import Path

import samplers
from tests.contract.targets import Gaussian

ROOT = Path.cwd()
ROOMS = {
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
    "population": 1700,
    "information": 1000,
    "column_damage": 600,
    "checks": 1600,
    "reporting": 1000,
    "plots": 1400,
    "command": 1900,
    "adapters": 500,
    "modal": 1200,
}
BUDGETS = {  # lines of Python files, docstrings included
    "samplers": 8000,
    **{f"fe_likelihoods/{room}": budget for room, budget in ROOMS.items()},
    "fe_likelihoods": 38_000,
    "tests": 38_000,
    "benchmarks": 2500,
    "tutorials": 2000,
}


def lines_of(folder: str) -> int:
    """Lines of the Python files of a folder."""
    return sum(len(path.read_text().splitlines()) for path in (ROOT / folder).rglob("*.py"))


class Watched(Gaussian):
    """Notes the deepest stack from `run_mcmc` to its calls, as files of frames."""

    deepest = ()

    def __call__(self, x):
        codes = [frame.f_code for frame, _ in traceback.walk_stack(sys._getframe(1))]
        first = max(k for k, code in enumerate(codes) if code.co_name == "run_mcmc")
        self.deepest = max(self.deepest, [code.co_filename for code in codes[: first + 1]], key=len)
        return super().__call__(x)


def rows():
    """Pairs of label and value, in the order of the table."""
    for folder, budget in BUDGETS.items():
        yield f"{folder}: lines, budget", f"{lines_of(folder):6d} {budget:6d}"
    pages = [path for path in (ROOT / "docs").rglob("*.rst") if not {"api", "tutorials", "_build"} & set(path.parts)]
    words = sum(len(path.read_text().split()) for path in pages)
    yield "docs: pages, words, budget", f"{len(pages)} {words} 45000"
    yield "README: words", str(len((ROOT / "README.md").read_text().split()))
    for Sampler in (samplers.SMCSampler, samplers.TMCMCSampler):
        run = Sampler(300, 3, posterior := Watched())  # enough walkers that SMCSampler recycles
        for part, steps in (("annealing", 0), ("at beta = 1", 3)):
            posterior.deepest = ()
            run.run_mcmc(None, steps)
            frames = f"{len(posterior.deepest)} frames in {len(set(posterior.deepest))} files"
            yield f"{Sampler.__name__}: run_mcmc to the function, {part}", frames


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for label, value in rows():
        print(f"{label:<70} {value}", flush=True)
