"""The bridge column built in OpenSees, a peer for tests and benchmarks.

It uses the fibers and the confinement of the model, none of its kernels. OpenSees has one model per process and may end
that process; all runs are made in a second one.
"""

from __future__ import annotations

import functools
import importlib.util
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from fe_likelihoods.units import G0, to_si

if TYPE_CHECKING:  # the process that runs OpenSees does not have to import the compiled model
    from fe_likelihoods.models.rc_column import RCColumn

KIP, INCH, KSI = (to_si(1.0, unit).item() for unit in ("kip", "in", "ksi"))
TO_MASS, GRAVITY = KIP / INCH, G0 / INCH
CORE, COVER, STEEL = 1, 2, 3  # material tags
MAX_ITERATIONS = 50


class Response(NamedTuple):
    """Response of the column; shorter than its loading if OpenSees did not converge."""

    response: np.ndarray  # of the top [in, s, kip]; (3, n) under base acceleration, (5, n) under imposed displacement
    seconds: float  # CPU time of the analysis alone
    recorded: np.ndarray  # (n, n_recorded), empty without recorders


def require_opensees() -> None:
    """Skip the test with a message where OpenSees cannot be imported."""
    if reason := why_no_opensees():
        pytest.skip(f"NO OPENSEES: {reason}")


@functools.cache
def why_no_opensees() -> str:
    """Why OpenSees cannot be imported; empty if it can."""
    if importlib.util.find_spec("openseespy") is None:
        return "openseespy is not installed (extra 'test')"
    probe = subprocess.run([sys.executable, "-c", "import openseespy.opensees"], capture_output=True, text=True)
    last = (probe.stderr.strip() or "no message").splitlines()[-1]
    return f"openseespy does not start (it needs libblas3 and liblapack3): {last}" if probe.returncode else ""


def peer_of(model: RCColumn, theta: np.ndarray) -> SimpleNamespace:
    """Input of OpenSees in kip, inch and second: the column at multiples `theta` of its nominal parameters."""
    values = dict(model.nominal)
    for name, factor in zip(model.parameters, theta, strict=True):
        values[name] *= float(factor)
    if values["fc"] != model.concrete.fc:
        raise ValueError("the confinement of the peer is that of the nominal fc: leave fc out of the parameters")
    concrete, steel, confinement = model.concrete, model.steel, model.confinement
    fc, ec, ft = (values[name] / KSI for name in ("fc", "Ec", "ft"))
    peak = 2.0 * fc / ec if concrete.peak_strain is None else concrete.peak_strain
    core_peak = peak * confinement.strain_ratio
    tension = (ec, ft, ft / ec + concrete.softening_strain, concrete.softening_ratio)
    core, cover, bars = model.section.fibers()
    fibers = [
        np.column_stack([part[:, 0] / INCH, part[:, 1] / INCH**2, np.full(len(part), tag)])
        for part, tag in ((core, CORE), (cover, COVER), (bars, STEEL))
    ]
    mass = values["mass"] / TO_MASS
    return SimpleNamespace(
        # Concrete04: fc, eps_c, eps_cu (negative), Ec, ft, eps_tu, beta
        core=(-fc * confinement.strength_ratio, -core_peak, -max(confinement.ultimate_strain, 1.05 * core_peak))
        + tension,
        cover=(-fc, -peak, -max(concrete.ultimate_strain, 1.5 * peak)) + tension,
        # ReinforcingSteel: fy, fu, Es, Esh, eps_sh, eps_u
        steel=tuple(values[name] / KSI for name in ("fy", "fu", "Es", "Esh"))
        + (steel.hardening_strain, steel.ultimate_strain),
        fibers=np.concatenate(fibers).T,  # (3, n): y, area, material
        mass=(mass, mass, model.rotational_inertia / (KIP * INCH)),
        node_masses=tuple(
            np.append(np.ones(model.analysis.n_elements - 1), 0.5)
            * model.column_mass
            / model.analysis.n_elements
            / TO_MASS
        ),
        axial_load=(values["mass"] * G0 if model.axial_load is None else model.axial_load) / KIP,
        a0=values["a0"],
        a1=values["a1"],
        height=model.height / INCH,
        n_elements=model.analysis.n_elements,
        n_points=model.analysis.n_points,
        geometry=model.analysis.geometry.capitalize(),
    )


Recorders = Sequence[tuple]  # arguments of eleResponse, with the index of the value last; ("nodeDisp", node, dof)


def shake(
    column: SimpleNamespace, acceleration: np.ndarray, dt: float, tolerance: float = 1e-10, recorders: Recorders = ()
) -> Response:
    """Apply gravity, then a base acceleration (n,) [in/s²] with step `dt` [s], in a separate process.

    `tolerance` is the norm of the last displacement increment [in and rad]; `recorders` are responses of elements that
    are recorded after every step.
    """
    return _in_process("_shake", column, np.asarray(acceleration, dtype=float), dt, tolerance, tuple(recorders))


def push(column: SimpleNamespace, targets: np.ndarray, tolerance: float = 1e-10, recorders: Recorders = ()) -> Response:
    """Apply gravity, then move the top through `targets` (n,) [in], one step each, in a separate process."""
    return _in_process("_push", column, np.asarray(targets, dtype=float), tolerance, tuple(recorders))


def _record(ops, recorders: Recorders) -> list[float]:
    """Current values of all recorders."""
    return [
        getattr(ops, arguments[0])(*arguments[1:])
        if str(arguments[0]).startswith("node")
        else ops.eleResponse(*arguments[:-1])[arguments[-1]]
        for arguments in recorders
    ]


def _in_process(function: str, *arguments) -> Response:
    try:
        return _process().submit(_run, function, arguments).result()
    except BrokenProcessPool as error:
        _process.cache_clear()
        raise RuntimeError("OpenSees ended its process") from error


@functools.cache
def _process() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_print_nothing)


def _print_nothing() -> None:
    for descriptor in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def _run(function: str, arguments: tuple) -> Response:
    import openseespy.opensees as ops

    return {"_shake": _shake, "_push": _push}[function](ops, *arguments)


def _analyse(ops, tolerance: float) -> None:
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", tolerance, MAX_ITERATIONS)
    ops.algorithm("Newton")


def _build(ops, column: SimpleNamespace, tolerance: float) -> None:
    """Build the column and apply its gravity load; the clock is reset to zero."""
    n = column.n_elements
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    for i in range(n + 1):
        ops.node(i + 1, 0.0, column.height * i / n)
    ops.fix(1, 1, 1, 1)
    x, y, rotational = column.mass
    for i, own in enumerate(column.node_masses):
        top = i + 1 == n
        ops.mass(i + 2, own + x * top, own + y * top, rotational * top)
    ops.uniaxialMaterial("Concrete04", CORE, *column.core)
    ops.uniaxialMaterial("Concrete04", COVER, *column.cover)
    ops.uniaxialMaterial("ReinforcingSteel", STEEL, *column.steel)
    ops.section("Fiber", 1)
    for y, area, material in column.fibers.T:
        ops.fiber(y, 0.0, area, int(material))
    ops.geomTransf(column.geometry, 1)
    ops.beamIntegration("Lobatto", 1, 1, column.n_points)
    for i in range(n):
        ops.element("forceBeamColumn", i + 1, i + 1, i + 2, 1, 1)
    ops.timeSeries("Linear", 1)
    ops.pattern("Plain", 1, 1)
    for i, own in enumerate(column.node_masses):
        ops.load(i + 2, 0.0, -own * GRAVITY - (column.axial_load if i + 1 == n else 0.0), 0.0)
    _analyse(ops, tolerance)
    ops.integrator("LoadControl", 0.1)
    ops.analysis("Static")
    if ops.analyze(10):
        raise RuntimeError("OpenSees did not converge under gravity")
    ops.loadConst("-time", 0.0)


def _shake(ops, column: SimpleNamespace, acceleration: np.ndarray, dt: float, tolerance: float, recorders) -> Response:
    _build(ops, column, tolerance)
    top = column.n_elements + 1
    ops.rayleigh(column.a0, 0.0, 0.0, column.a1)
    # a path ends at its last point; one more value keeps round-off of the clock from passing the end
    values = np.append(acceleration, acceleration[-1]).tolist()
    ops.timeSeries("Path", 2, "-dt", dt, "-values", *values)
    ops.pattern("UniformExcitation", 2, 1, "-accel", 2)
    ops.wipeAnalysis()
    _analyse(ops, tolerance)
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    response = np.empty((3, len(acceleration)))
    recorded = np.empty((len(acceleration), len(recorders)))
    recorded[0] = _record(ops, recorders)
    response[:, 0] = ops.nodeDisp(top, 1), acceleration[0], ops.nodeDisp(top, 2)
    done = 1
    start = time.process_time()
    while done < len(acceleration) and ops.analyze(1, dt) == 0:
        response[0, done] = ops.nodeDisp(top, 1)
        response[1, done] = ops.nodeAccel(top, 1)
        response[2, done] = ops.nodeDisp(top, 2)
        recorded[done] = _record(ops, recorders)
        done += 1
    seconds = time.process_time() - start
    response[1, 1:] += acceleration[1:]
    return Response(response[:, :done], seconds, recorded[:done])


def _push(ops, column: SimpleNamespace, targets: np.ndarray, tolerance: float, recorders) -> Response:
    _build(ops, column, tolerance)
    top = column.n_elements + 1
    ops.timeSeries("Linear", 2)
    ops.pattern("Plain", 2, 2)
    ops.load(top, 1.0, 0.0, 0.0)
    response = np.empty((5, len(targets)))
    recorded = np.empty((len(targets), len(recorders)))
    done = 0
    start = time.process_time()
    for target in targets:
        increment = target - ops.nodeDisp(top, 1)
        if increment != 0.0:
            ops.integrator("DisplacementControl", top, 1, increment)
            if ops.analyze(1):
                break
        response[:, done] = (
            ops.nodeDisp(top, 1),
            ops.getTime(),
            ops.nodeDisp(top, 2),
            ops.nodeDisp(top, 3),
            ops.eleResponse(1, "section", 1, "force")[1],
        )
        recorded[done] = _record(ops, recorders)
        done += 1
    return Response(response[:, :done], time.process_time() - start, recorded[:done])
