"""Time integration against reference runs, closed forms of free vibration, and its order."""

import math

import numpy as np
import pytest

from fe_likelihoods.kernels import concrete04
from fe_likelihoods.kernels.frame import recorder
from fe_likelihoods.kernels.newmark import HISTORY_ROWS, Dynamics, newmark
from fe_likelihoods.kernels.static import Iteration
from fe_likelihoods.signals.channels import relative_errors

from . import golden
from .test_beam_column import stiffness_of_section

TOLERANCE = 1e-10


def run(
    column,
    ground,
    *,
    a0=golden.A0,
    a1=golden.A1,
    dt=golden.DT,
    tolerance=TOLERANCE,
    max_iterations=50,
    halvings=6,
    every=1,
    weight=golden.WEIGHT,
):
    """Return (status, retries) and the history; samples that the run does not reach stay NaN."""
    ground = np.asarray(ground, dtype=float)
    n_elements = column.elements.state.shape[0]
    history = np.full((len(HISTORY_ROWS), (len(ground) - 1) // every + 1), np.nan)
    dynamics = Dynamics(golden.gravity(n_elements, weight), golden.mass(n_elements), a0, a1)
    iteration = Iteration(tolerance, max_iterations, halvings)
    result = newmark(column, dynamics, ground, dt, every, iteration, history, recorder(column))
    return result, history


@pytest.fixture
def column():
    return golden.column(golden.circle())


@pytest.fixture(scope="module")
def motion():
    """The first seconds of the synthetic ground motion of the reference runs [in/s²], step 1/256 s."""
    return golden.load(golden.BUNDLED, "dynamic")["record50"]


# --- reference runs ---


def cases(arrays):
    for case, info in arrays["_meta"]["cases"].items():
        column = golden.reference_column(arrays, f"dyn/{case}")
        theta = arrays[f"dyn/{case}/theta"]
        ground = arrays["record50"][: info["nsteps"] + 1] * info["scale"]
        yield case, column, {"a0": theta[2], "a1": theta[3]}, ground, arrays[f"dyn/{case}/resp"]


def test_reference_runs(reference):
    """Displacement, acceleration and vertical displacement; cracks amplify round-off in about half of the runs."""
    results = {}
    for case, column, damping, ground, expected in cases(golden.load(reference, "dynamic")):
        (status, _), history = run(column, ground, **damping)
        assert status == 0
        assert np.isfinite(history).all()
        results[case] = relative_errors(history[:3] - expected, expected).max()
    assert results
    smooth = {"nominal", *(f"prior{k}" for k in range(3, 10))}
    assert not {case: r for case, r in results.items() if not r < (1e-8 if case in smooth else 1e-3)}


def test_parameters_one_percent_off_are_detected():
    arrays = golden.load(golden.BUNDLED, "dynamic")
    for case, column, damping, ground, expected in cases(arrays):
        damping["a0"] *= 1.01
        assert relative_errors(run(column, ground, **damping)[1][:3] - expected, expected).max() > (
            1e-4 if case == "prior8" else 1e-3
        )
    for case, column, damping, ground, expected in cases(arrays):
        if case == "nominal_x4_sub1":  # this run cracks
            column.sections.concrete[:, concrete04.FT] *= 1.01
            assert relative_errors(run(column, ground, **damping)[1][:3] - expected, expected).max() > 1e-3


# --- free vibration of the elastic column, at strains of 1e-8, where the laws are linear to 1e-7 ---


def frequency(column):
    """Return the angular frequency of a cantilever with a mass at its top [1/s], in closed form."""
    return math.sqrt(3.0 * stiffness_of_section(column)[1] / (golden.MASS * golden.HEIGHT**3))


def identified(displacement, dt):
    """Return frequency and damping ratio of the continuous system from a free vibration by average acceleration.

    The samples satisfy u[n+2] - s u[n+1] + p u[n] = 0; the roots z give the eigenvalues (2/dt)(z - 1)/(z + 1).
    """
    left = np.column_stack([displacement[1:-1], -displacement[:-2]])
    s, p = np.linalg.lstsq(left, displacement[2:], rcond=None)[0]
    root = complex(s / 2.0, math.sqrt(p - s * s / 4.0))
    eigenvalue = 2.0 / dt * (root - 1.0) / (root + 1.0)
    return abs(eigenvalue), -eigenvalue.real / abs(eigenvalue)


def free_vibration(column, dt, a0, a1, n_steps=1200):
    result, history = run(column, push(n_steps), a0=a0, a1=a1, dt=dt, weight=0.0, tolerance=1e-13)
    assert result == (0, 0)
    return frequency(column), history


def push(n_steps, size=1e-3):
    """A motion that pushes the column once [in/s²]."""
    return np.where(np.arange(n_steps) == 1, size, 0.0)


@pytest.mark.parametrize("dt", [0.002, 0.02])
@pytest.mark.parametrize(("a0", "a1"), [(0.0, 0.0), (0.737, 0.0), (0.0, 2e-3), (0.4, 1e-3)])
def test_frequency_and_damping_of_free_vibration(a0, a1, dt):
    """2 pi sqrt(m h^3 / 3 EI), and zeta = a0 / 2 omega + a1 omega / 2."""
    column = golden.column(golden.circle(), corotational=False, element_tolerance=1e-20)
    omega, history = free_vibration(column, dt, a0, a1)
    # the start is left out, where the massless rotations are not yet in phase with the mass
    measured, damping = identified(history[0, 300:], dt)
    assert measured == pytest.approx(omega, rel=1e-6)
    assert damping == pytest.approx(a0 / (2 * omega) + a1 * omega / 2, abs=1e-6)


# --- order ---


def pulse(dt, duration=1.6, length=0.6):
    time = dt * np.arange(round(duration / dt) + 1)
    return np.where(time < length, np.sin(math.pi * time / length) ** 4, 0.0)


def observed_orders(response, coarsest=0.02, levels=4):
    """Return log2 of the ratios of successive errors, against a run with an eighth of the smallest step."""
    reference = response(coarsest / 2 ** (levels + 2))[:: 2 ** (levels + 2)]
    errors = []
    for level in range(levels):
        values = response(coarsest / 2**level)[:: 2**level]
        errors.append(np.sqrt(np.mean((values - reference) ** 2)))
    errors = np.array(errors)
    return np.log2(errors[:-1] / errors[1:])


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("scale", [1e-4, 10.0])
def test_second_order(row, scale):
    """Displacement and acceleration under a smooth pulse, in the linear and in the nonlinear uncracked range."""

    def response(dt):
        column = golden.column(golden.circle(), element_tolerance=1e-20)
        result, history = run(column, scale * pulse(dt), dt=dt, tolerance=1e-11)
        assert result[0] == 0
        return history[row]

    orders = observed_orders(response)
    assert np.all(np.abs(orders - 2.0) < 0.1)


# --- the run itself ---


@pytest.mark.parametrize("every", [2, 7])
def test_every_keeps_one_sample_in(column, motion, every):
    _, full = run(column, motion)
    _, kept = run(column, motion, every=every)
    np.testing.assert_array_equal(kept, full[:, ::every])


def test_retries_are_counted_and_agree_with_a_finer_run(motion):
    """Four iterations do not suffice for steps in which the section cracks; these steps are retried and halved."""
    ground = 6.0 * motion
    coarse = ground[::8].copy()  # a view has another type, for which the kernel would be compiled again
    fine = np.interp(np.arange(8 * (len(coarse) - 1) + 1) / 8.0, np.arange(len(coarse)), coarse)
    _, expected = run(golden.column(golden.circle()), fine, dt=golden.DT)
    (status, retries), history = run(
        golden.column(golden.circle()), coarse, dt=8 * golden.DT, max_iterations=4, halvings=12
    )
    assert status == 0
    assert retries > 0
    assert relative_errors(history[:1] - expected[:1, ::8], expected[:1, ::8])[0] < 0.05


def test_impossible_step_ends_the_run_with_its_number(column, motion):
    """With four iterations and no halving the run ends where it cracks, and keeps the samples before."""
    (status, retries), history = run(column, 6.0 * motion, max_iterations=4, halvings=0)
    assert 1 < status < len(motion)
    assert retries > 0
    assert np.isfinite(history[:, :status]).all()
    assert np.isnan(history[:, status:]).all()
    result, shorter = run(column, 6.0 * motion[:status], max_iterations=4, halvings=0)
    assert result[0] == 0
    np.testing.assert_array_equal(history[:, :status], shorter)


def test_a_larger_tolerance_is_tried_where_the_iteration_has_reached_it(motion):
    """The repetition converges, and the run is as one whose tolerance is larger from the beginning."""
    weak, tolerance, limited = motion[:600], 1e-13, dict(max_iterations=3, halvings=0)
    (status, _), expected = run(golden.column(golden.circle()), weak, tolerance=100.0 * tolerance, **limited)
    (again, retries), history = run(golden.column(golden.circle()), weak, tolerance=tolerance, **limited)
    assert (status, again) == (0, 0)
    assert retries > 0
    np.testing.assert_allclose(history[0], expected[0], rtol=0, atol=1e-12 * np.abs(expected[0]).max())
