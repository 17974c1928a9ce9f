"""Size of the project in one table: ``python -m tests.size``, or ``make size``.

It measures the checkout in the current folder; another one by ``cd checkout && python /path/to/size.py``. Frames are
those on the stack from `run_mcmc` (included) to the user's function (excluded), counted while the function runs.
"""

import ast
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path

import emcee
import numpy as np

from tests.prose import count, docstrings

ROOT = Path.cwd()
PACKAGES = ("samplers", "fe_likelihoods")
WALKERS = 300  # enough that SMCSampler recycles


# ---------------------------------------------------------------- text


def lines_of(folder: str) -> tuple[int, int, int]:
    """Files, lines, and lines of code (no blank lines, comments and docstrings) of the Python files of a folder."""
    files = sorted((ROOT / folder).rglob("*.py"))
    lines = code = 0
    for path in files:
        text = path.read_text()
        documented = docstrings(ast.parse(text))
        prose = {number for node in documented for number in range(node.lineno, node.end_lineno + 1)}
        numbered = list(enumerate(text.splitlines(), 1))
        lines += len(numbered)
        code += sum(bool(s := line.strip()) and s[0] != "#" and number not in prose for number, line in numbered)
    return len(files), lines, code


# ---------------------------------------------------------------- names and settings


def count_fields(settings: type) -> int:
    """Fields of a dataclass; a field that is a dataclass itself counts as its fields."""
    values = vars(settings())
    nested = [type(values[field.name]) for field in fields(settings)]
    return sum(count_fields(kind) if is_dataclass(kind) else 1 for kind in nested)


def arguments_of(sampler: type) -> tuple[int, int]:
    """Numbers of arguments in emcee's order and of keyword arguments, without the settings."""
    settings = {field.name for field in fields(import_module("samplers.settings").Settings)}
    given = [p for p in signature(sampler).parameters.values() if p.kind is not Parameter.VAR_KEYWORD]
    keywords = [p.name for p in given if p.kind is Parameter.KEYWORD_ONLY]
    return len(given) - len(keywords), len(set(keywords) - settings)


# ---------------------------------------------------------------- frames


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


def describe(stacks: list[list[str]], package: str) -> str:
    """Frames and distinct files of the deepest stack."""
    stack = max(stacks, key=len)
    files = set(stack)
    own = sum(is_in(package, file) for file in files)
    return f"{len(stack)} frames in {len(files)} files, {own} of {package}"


def is_in(package: str, file: str) -> bool:
    return f"/{package}/" in file


def files_entered(package: str, run: Callable[[], object]) -> int:
    """Files of a package whose functions a run calls, in any thread."""
    entered = set()

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_name != "<module>":
            entered.add(frame.f_code.co_filename)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return sum(is_in(package, file) for file in entered)


def frames_of(sampler: type, package: str) -> Iterator[tuple[str, str]]:
    """Deepest stacks of the two parts of a run, and the files of a package that a whole run enters."""
    start = np.random.default_rng(1).standard_normal((WALKERS, 3))
    posterior = Normal()
    run = sampler(WALKERS, 3, posterior)
    if package == "samplers":
        run.run_mcmc(start, 0)
        yield "run_mcmc to the function, annealing, deepest", describe(posterior.stacks, package)
        posterior.stacks.clear()
    run.run_mcmc(None if package == "samplers" else start, 3)
    yield "run_mcmc to the function at beta = 1, deepest", describe(posterior.stacks, package)
    with tempfile.TemporaryDirectory() as folder:
        for label, file in (("in memory", None), ("with an HDF5 file", f"{folder}/chain.h5")):
            backend = file and emcee.backends.HDFBackend(file)
            count = files_entered(package, lambda: sampler(WALKERS, 3, Normal(), backend=backend).run_mcmc(start, 3))  # noqa: B023
            yield f"files of {package} entered, {label}", str(count)


def frames_to_kernels() -> str:
    """Deepest stack from ``posterior(theta)`` to a compiled function that Python calls, of the bridge column."""
    from numba.core.dispatcher import Dispatcher

    posterior = import_module("fe_likelihoods").problems.bridge_column()
    thetas = posterior.sample_prior(2, np.random.default_rng(1))
    posterior(thetas[0])  # compiles: numba reads the names that are replaced below
    stacks = []

    def watched(kernel):
        def call(*args):
            stacks.append(stack_to("__call__"))
            return kernel(*args)

        return call

    replaced = []
    for name, module in list(sys.modules.items()):
        if name.startswith("fe_likelihoods.") and not name.startswith("fe_likelihoods.kernels"):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    replaced.append((module, key, value))
                    setattr(module, key, watched(value))
    try:
        posterior(thetas[1])
    finally:
        for module, key, value in replaced:
            setattr(module, key, value)
    return (
        describe(stacks, "fe_likelihoods") if any(stacks) else "not seen: the kernel runs in a thread or is no global"
    )


# ---------------------------------------------------------------- the table


def rows():
    """Pairs of label and value, in the order of the table."""
    for folder in (*PACKAGES, "tests", "benchmarks", "tutorials"):
        if (ROOT / folder).is_dir():
            files, lines, code = lines_of(folder)
            yield f"{folder}: files, lines, lines of code", f"{files}, {lines}, {code}"
    guides = {"docs": sorted((ROOT / "docs").rglob("*.rst")), "README": [ROOT / "README.md"]}
    for label, paths in guides.items():
        paths = [path for path in paths if not {"api", "tutorials", "_build"} & set(path.parts[len(ROOT.parts) :])]
        yield f"{label}: files, words", f"{len(paths)}, {sum(len(path.read_text().split()) for path in paths)}"
    for package in PACKAGES:
        found = count(ROOT / package)
        yield f"{package}: words of docstrings", str(found.words)
        yield '    "that of", "those of", "the one of" per 1000', f"{found.pronouns:.2f}"
        yield '    "of (the) noun of" per 1000', f"{found.chains:.2f}"
        yield f"{package}: public names", str(len(import_module(package).__all__))
    samplers = import_module("samplers")
    yield "settings that a user may change", str(count_fields(import_module("samplers.settings").Settings))
    theirs = emcee.EnsembleSampler(WALKERS, 3, Normal())
    for label, value in frames_of(emcee.EnsembleSampler, "emcee"):
        yield f"EnsembleSampler: {label}", value
    for sampler in (samplers.SMCSampler, samplers.TMCMCSampler):
        name = sampler.__name__
        positional, keywords = arguments_of(sampler)
        yield f"{name}: emcee's arguments, further arguments, without settings", f"{positional}, {keywords}"
        public = {member for member in dir(sampler(WALKERS, 3, Normal())) if member[0] != "_"}
        yield f"{name}: public members, of these beyond emcee's", f"{len(public)}, {len(public - set(dir(theirs)))}"
        yield f"{name}: classes between it and emcee's", str(len(sampler.__mro__) - len(type(theirs).__mro__) - 1)
        for label, value in frames_of(sampler, "samplers"):
            yield f"{name}: {label}", value
    yield "posterior(theta) to a kernel of the bridge column", frames_to_kernels()


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    warnings.simplefilter("ignore")
    for label, value in rows():
        print(f"{label:<74} {value}", flush=True)
