"""What the commands ``cache info``, ``verify``, ``export`` and ``salvage`` do with a cache of simulations."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..cache.file import CacheFile
from ..cache.salvage import salvage
from ..cache.simulation_cache import SimulationCache
from ..likelihood.likelihood import FELikelihood

__all__ = ["Verified", "describe", "export_cache", "latest_stored", "salvage_cache", "verify_cache"]

TIMEOUT = 30.0  # of another writer [s]


class Verified(NamedTuple):
    """What `verify_cache` has found: whether nothing is wrong, and a sentence."""

    good: bool
    text: str


def _opened(file: Path) -> SimulationCache:
    """An existing cache; it is not created, and a damaged one raises ValueError and is left as it is."""
    if not file.is_file():
        raise ValueError(f"there is no file {file}; the cache of a run is simulations.sqlite in its folder")
    if damage := CacheFile(file, TIMEOUT).damage():
        raise ValueError(
            f"{file} is damaged ({damage}) and was not changed; copy what can be read to a new cache with: "
            f"fe-likelihoods cache salvage {file}"
        )
    return SimulationCache(file, verify=True)


def describe(file: Path) -> str:
    """What a cache contains, as lines of text."""
    cache = _opened(file)
    found = cache.info()
    cache.close()
    return "\n".join(
        (
            f"{found.path}: {found.file_bytes / 1e6:.1f} MB",
            f"simulations  {found.simulations}, of which {found.failures} failed",
            f"computing    {found.seconds:.0f} s",
            f"responses    {found.responses}, {found.response_bytes / 1e6:.1f} MB",
        )
    )


def verify_cache(file: Path, settings: Path | None = None) -> Verified:
    """Compare the rows of a cache with their checksums, and some of them with new simulations.

    Parameters
    ----------
    file : Path
    settings : Path, optional
        TOML file of a model whose simulations the cache contains.

    Returns
    -------
    Verified

    Raises
    ------
    ValueError
        If the file is not a cache or is damaged (it is not changed), or nothing of the model is stored in it.
    """
    cache = _opened(file)
    rows, damaged = cache.check_rows()
    text = f"{rows} simulations, {damaged} of which do not match their checksums"
    if damaged:
        text += "; they will be simulated again when they are needed"
    if settings is None:
        cache.close()
        return Verified(not damaged, text)
    agree = _agree_with(cache, settings)
    if agree:
        text += f"; {cache.verified} stored points were simulated again and agree"
    else:
        text += f"; new simulations of the model in {settings.name} differ from the stored ones, which are not used"
    cache.close()
    return Verified(agree and not damaged, text)


def _agree_with(cache: SimulationCache, settings: Path) -> bool:
    """Simulate stored points of the model in `settings` again; False if they differ and a new generation has begun."""
    from .job import read_job
    from .models import make_problem

    likelihood = make_problem(read_job(settings), cache).posterior.likelihood
    stored = latest_stored(likelihood)
    if stored is None:
        raise ValueError(
            f"{cache.path} has no simulations of the model in {settings.name}; give the TOML file of its run"
        )
    key = likelihood.simulator.simulation_key
    before = cache.generations_of(key)
    likelihood.misfit(stored[None, :])
    return cache.generations_of(key) == before


def export_cache(file: Path, out: Path) -> str:
    """Copy an undamaged cache to a new file, without its log; what was done as a sentence."""
    if out.exists():
        raise ValueError(f"{out} exists; give another file with --out")
    cache = _opened(file)
    n = cache.copy(out)
    cache.close()
    return f"{n} simulations copied to {out}"


def salvage_cache(file: Path, out: Path) -> str:
    """Copy the readable rows of a damaged cache to a new one; what was done as a sentence."""
    if not file.is_file():
        raise ValueError(
            f"there is no file {file}; a cache that was set aside is named like simulations.sqlite.damaged-1"
        )
    if out.exists():
        raise ValueError(f"{out} exists; give a new file with --out")
    cache = SimulationCache(out)
    found = salvage(file.resolve(), cache.file.connection())
    cache.close()
    return f"{found.simulations} simulations and {found.responses} responses copied to {out}; others could not be read"


def latest_stored(likelihood: FELikelihood) -> np.ndarray | None:
    """Structural parameters of the successful simulation that the cache of a likelihood stored last, if any."""
    cache, key = likelihood.simulator.cache, likelihood.simulator.simulation_key
    width = likelihood.simulator.n_numbers
    for generation in cache.generations_of(key):
        for row in cache.stored_rows(key, generation, width, likelihood.measurements.n_steps, most=100):
            if not row.reason:
                return row.theta
    return None
