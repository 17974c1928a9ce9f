"""Time integration against reference runs, closed forms of free vibration, and its order."""

import numpy as np
import pytest

from fe_likelihoods import rrmse
from fe_likelihoods.kernels.frame import recorder
from fe_likelihoods.kernels.newmark import HISTORY_ROWS, Dynamics, newmark
from fe_likelihoods.kernels.static import Iteration

from . import golden

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
        results[case] = rrmse(history[:3], expected).max()
    assert results
    smooth = {"nominal", *(f"prior{k}" for k in range(3, 10))}
    assert not {case: r for case, r in results.items() if not r < (1e-8 if case in smooth else 1e-3)}


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
    assert rrmse(history[:1], expected[:1, ::8])[0] < 0.05


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
