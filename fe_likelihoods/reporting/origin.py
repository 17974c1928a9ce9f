"""Where a result comes from: settings, versions, digests of model, data and posterior, and how to repeat the run."""

import platform
import sys
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from samplers.smc import FEWEST_TO_RECYCLE

from ..checks.run import FinishedRun

__all__ = ["fingerprints", "how_to_repeat", "sampler_settings", "versions"]

_PACKAGES = ("fe-likelihoods", "numpy", "scipy", "numba", "emcee", "h5py", "corner", "arviz", "matplotlib")


def versions() -> list[tuple[str, str]]:
    """Names and versions of Python, the operating system and the packages that a result depends on."""
    found = [("Python", platform.python_version()), ("system", f"{platform.system()} {platform.machine()}")]
    for package in (*_PACKAGES, *(["openseespy"] if "openseespy" in sys.modules else [])):
        try:
            found.append((package, version(package)))
        except PackageNotFoundError:  # for instance a source folder that is not installed
            found.append((package, "not installed as a package"))
    return found


def fingerprints(run: FinishedRun) -> list[tuple[str, str]]:
    """Digests (hexadecimal) of models, data and posterior; equal digests stand for equal inputs."""
    found = []
    for name in ("fingerprint", "data_fingerprint"):
        try:
            digest = getattr(run.posterior, name, None)
        except ValueError as error:  # a prior or noise of the user's own that does not show its values
            digest = f"none: {error}"
        if digest:
            found.append(("posterior" if name == "fingerprint" else "data", str(digest)))
    for key, each in {} if run.likelihood is None else run.likelihood.likelihoods.items():
        found.append((f"model of {key}" if key else "model", each.model.fingerprint))
    return found


def sampler_settings(run: FinishedRun) -> list[tuple[str, str]]:
    """Size and settings of the sampler, in words."""
    sampler = run.sampler
    rows = [("sampler", type(sampler).__name__), ("walkers", str(sampler.nwalkers))]
    rows.append(("stored iterations", str(sampler.iteration)))
    if run.discard:
        rows.append(("iterations left out as burn-in", str(run.discard)))
    rows.append(("samples in this report", str(len(run.samples))))
    if not hasattr(sampler, "settings"):
        return rows
    seed = sampler.seed
    rows.append(("seed", "not given to this sampler" if seed is None else str(seed)))
    rows.append(("guide", "none" if sampler.guide is None and not sampler.rounds else "yes"))
    limit = sampler.max_simulations
    rows.append(("largest number of simulations", "none" if limit is None else f"{limit:g}"))
    return rows + changed_settings(sampler.settings)


def changed_settings(settings: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Names and values of dataclass fields that differ from their defaults, nested ones with a dot."""
    found, default = [], type(settings)()
    for field in fields(settings):
        value, usual = getattr(settings, field.name), getattr(default, field.name)
        if is_dataclass(value):
            found += changed_settings(value, f"{prefix}{field.name}.")
        elif value != usual:
            found.append((f"{prefix}{field.name}", getattr(value, "__name__", None) or repr(value)))
    return found


def how_to_repeat(run: FinishedRun) -> str:
    """Lines of Python that make the run again, from a posterior with the same fingerprint."""
    sampler = run.sampler
    name, package = type(sampler).__name__, "samplers" if hasattr(sampler, "settings") else "emcee"
    arguments = [str(sampler.nwalkers), "posterior.ndim", "posterior"]
    # of a function of the user's own, whose values only the user can write down
    arguments += [f"{key}={key}" for key in ("args", "kwargs") if getattr(sampler.log_prob_fn, key, None)]
    if getattr(sampler, "vectorize", False):
        arguments.append("vectorize=True")
    if package == "emcee":
        return (
            f"from emcee import {name}\n\nsampler = {name}({', '.join(arguments)})\n"
            f"sampler.run_mcmc(start, {sampler.iteration})    # start: the ({sampler.nwalkers}, {sampler.ndim}) points "
            "that the walkers began at"
        )
    if sampler.seed is not None:
        arguments.append(f"seed={sampler.seed}")
    if sampler.guide is not None or sampler.rounds:
        arguments.append("guide=posterior.guide()")
    if sampler.max_simulations is not None:
        arguments.append(f"max_simulations={sampler.max_simulations:g}")
    changed = changed_settings(sampler.settings)
    recycles = name == "SMCSampler" and sampler.nwalkers >= FEWEST_TO_RECYCLE
    usual = ("recycle", str(recycles))  # None, the default, was replaced by it
    arguments += [f"{key}={text}" for key, text in changed if "." not in key and (key, text) != usual]
    lines = "".join(f"    {each},\n" for each in arguments)
    return f"from {package} import {name}\n\nsampler = {name}(\n{lines})\nsampler.run_mcmc(None, {sampler.iteration})"
