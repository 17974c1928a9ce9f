"""Reference results and the columns that they belong to, in kip, inch and second, the units of their computation.

Two folders have them: `BUNDLED`, a small extract, and ``golden/column`` of the reference material outside the project.
Drivers take one material or one section through a history.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods.kernels import bar_fatigue, concrete04, fiber_section, frame, reinforcing_steel
from fe_likelihoods.kernels.jit import kernel
from fe_likelihoods.models.rc_column_section import gauss_lobatto

BUNDLED = Path(__file__).parent / "data"


# Nominal column [kip, in]: constants of concrete04 (fc, e0, ecu, Ec, ft, etu, beta) and of reinforcing_steel.
CORE = (-7.637057375550651, -0.00854535354081521, -0.01657753172309746, 3320.0, 0.306, 0.0010921686746987952, 0.1)
COVER = (-6.0, -0.0036144578313253013, -0.006, 3320.0, 0.306, 0.0010921686746987952, 0.1)
STEEL = (75.2, 102.0, 28400.0, 1000.0, 0.011, 0.12)
HEIGHT = 288.0
WEIGHT = 522.0
MASS = WEIGHT / 386.4
A0, A1 = 0.737, 0.0002016
DT = 1.0 / 256.0

STRICT = 1e-9
ILL_CONDITIONED = 5e-4  # where round-off decides whether the slope of a curve of the steel is clipped


class Fibers(NamedTuple):
    """Position y and area of the fibers of a section, (n, 2) each."""

    core: np.ndarray
    cover: np.ndarray
    bars: np.ndarray


def load(folder: Path, part: str) -> dict[str, np.ndarray]:
    """Return the arrays of one file of reference results, with `_meta` decoded."""
    with np.load(folder / f"golden_A_{part}.npz") as file:
        arrays = {key: file[key] for key in file.files}
    if "_meta" in arrays:
        arrays["_meta"] = json.loads(str(arrays["_meta"]))
    return arrays


def histories(arrays: dict[str, np.ndarray], material: str) -> Iterator[tuple]:
    """Yield name, arguments of the material, and the strains, stresses and tangents (3, n) of each history."""
    for key, values in arrays.items():
        if key.startswith(f"{material}/") and not key.endswith("/args"):
            yield key, arrays[key.rsplit("/", 1)[0] + "/args"], values


def fibers_of(arrays: dict[str, np.ndarray], name: str = "rms40") -> Fibers:
    """Return the fibers of a section, by material."""
    table = arrays[f"fibers/{name}"]
    return Fibers(*(np.ascontiguousarray(table[:2, table[2] == material].T) for material in (1, 2, 3)))


def circle(n_strips: int = 12, n_levels: int = 5) -> Fibers:
    """Return a coarse circular section: strips with exact area and second moment, bars on a circle."""

    def strips(radius, edges):
        edges = np.clip(edges, -radius, radius)
        angle = np.arcsin(edges / radius)
        area = radius**2 * np.diff(angle + 0.5 * np.sin(2 * angle))
        second = radius**4 * np.diff(0.25 * angle - 0.0625 * np.sin(4 * angle))
        return area, second

    edges = np.linspace(-24.0, 24.0, n_strips + 1)
    core_area, core_second = strips(21.6875, edges)
    area, second = strips(24.0, edges)
    middle = np.sign(edges[:-1] + edges[1:])
    core = np.column_stack([middle * np.sqrt(core_second / core_area), core_area])
    cover = np.column_stack([middle * np.sqrt((second - core_second) / (area - core_area)), area - core_area])
    bars = np.column_stack([20.67 * np.cos(np.linspace(0, np.pi, n_levels)), np.full(n_levels, 28.08 / n_levels)])
    return Fibers(core, cover, bars)


def column(
    fibers: Fibers,
    core: tuple = CORE,
    cover: tuple = COVER,
    steel: tuple = STEEL,
    *,
    n_elements: int = 2,
    n_points: int = 3,
    height: float = HEIGHT,
    corotational: bool = True,
    element_tolerance: float = 1e-12,
    bars_fail: bool = False,
) -> frame.Column:
    """Return a virgin column with its materials set; by default two elements of three points each.

    Bars that fail have a fatigue that does not matter: they fail where a test says so.
    """
    points, weights = gauss_lobatto(n_points)
    out = frame.allocate(
        n_elements=n_elements,
        height=height,
        corotational=corotational,
        element_tolerance=element_tolerance,
        points=points,
        weights=weights,
        core=fibers.core,
        cover=fibers.cover,
        bars=fibers.bars,
        bars_fail=bars_fail,
    )
    concrete04.constants(*map(float, core), out.sections.concrete[0])
    concrete04.constants(*map(float, cover), out.sections.concrete[1])
    reinforcing_steel.constants(*map(float, steel), out.sections.steel)
    if bars_fail:
        bar_fatigue.constants(1e9, 0.5, 1e18, out.sections.failure)
    frame.initialise_column(out)
    return out


def reference_column(arrays: dict[str, np.ndarray], prefix: str, fibers: str = "rms40", **options) -> frame.Column:
    """Return the column whose materials are stored under `prefix`."""
    args = (arrays[f"{prefix}/{material}_args"] for material in ("core", "cover", "steel"))
    return column(fibers_of(arrays, fibers), *args, **options)


def gravity(n_elements: int = 2, weight: float = WEIGHT) -> np.ndarray:
    """Static load: the weight at the top [kip]."""
    load = np.zeros(3 * n_elements)
    load[-2] = -weight
    return load


def mass(n_elements: int = 2) -> np.ndarray:
    """Diagonal mass: translations of the top [kip s²/in]."""
    out = np.zeros(3 * n_elements)
    out[-3:-1] = MASS
    return out


def concrete_constants(args) -> np.ndarray:
    """Return the constants of a concrete; four arguments mean a concrete without tension."""
    args = list(args) + [0.0, 1.0, 0.1] * (len(args) == 4)
    out = np.zeros(concrete04.N_CONSTANTS)
    concrete04.constants(*map(float, args), out)
    return out


def steel_constants(args) -> np.ndarray:
    """Constants of a steel."""
    out = np.zeros(reinforcing_steel.N_CONSTANTS)
    reinforcing_steel.constants(*map(float, args), out)
    return out


@kernel
def concrete_history(strain, c, out):
    """Write stress, tangent and the memory before each commit (eps_min, eps_max, eps_end) to `out` (5, n)."""
    eps_min, eps_max = 0.0, 0.0
    for i in range(strain.shape[0]):
        eps_end, slope, tension_slope = concrete04.unloading(eps_min, eps_max, c)
        out[2, i], out[3, i], out[4, i] = eps_min, eps_max, eps_end
        out[0, i], out[1, i] = concrete04.stress_tangent(strain[i], eps_min, eps_max, eps_end, slope, tension_slope, c)
        eps_min, eps_max = concrete04.commit(strain[i], eps_min, eps_max)


def steel_history(strain, c, out):
    """Write stress, tangent and branch number to `out` (3, n), from the virgin state."""
    _steel_history(strain, c, np.zeros(reinforcing_steel.N_STATE), out)


@kernel
def _steel_history(strain, c, state, out):
    for i in range(strain.shape[0]):
        out[0, i], out[1, i] = reinforcing_steel.update(strain[i], state, c)
        out[2, i] = state[0]


@kernel
def section_forces(e0, kappa, column, section=0):
    """Return N, M and the three tangents of one section of a column, at its committed memory."""
    return fiber_section.forces(e0, kappa, section, column.sections)


@kernel
def section_commit(e0, kappa, column):
    """Commit the first section of a column."""
    fiber_section.commit(e0, kappa, 0, column.sections)


@kernel
def section_history(e0, kappa, column, out):
    """Write N, M and the three tangents along a history of committed strains to `out` (5, n)."""
    for i in range(e0.shape[0]):
        out[0, i], out[1, i], out[2, i], out[3, i], out[4, i] = section_forces(e0[i], kappa[i], column)
        section_commit(e0[i], kappa[i], column)


def random_walks(rng, n_walks: int, n_steps: int, amplitude: float):
    """Yield strain histories from zero: random walks, independent jumps, and straight lines between reversals."""
    for number in range(n_walks):
        if number % 3 == 0:
            strain = np.cumsum(rng.normal(size=n_steps)) * amplitude / 10.0
        elif number % 3 == 1:
            strain = rng.uniform(-amplitude, amplitude, n_steps)
        else:
            turns = np.concatenate([[0.0], rng.uniform(-amplitude, amplitude, n_steps // 10 + 1)])
            strain = np.interp(0.1 * np.arange(n_steps), np.arange(len(turns)), turns)
        strain[0] = 0.0
        yield np.clip(strain, -5.0 * amplitude, 5.0 * amplitude)
