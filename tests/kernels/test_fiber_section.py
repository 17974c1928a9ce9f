"""The section against reference histories, closed forms in the elastic range, and differences."""

import numpy as np
import pytest

from fe_likelihoods.kernels import concrete04, reinforcing_steel

from . import golden

# Round-off decides here whether a slope of the steel is clipped (see test_reinforcing_steel).
ROUGH = "section/nominal/rms40/large/P-522"


def histories(arrays):
    for key in arrays:
        if key.startswith("section/") and not key.endswith("_args"):
            theta, fibers = key.split("/")[1:3]
            yield key, golden.reference_column(arrays, f"section/{theta}", fibers), arrays[key]


def deviation(column, history):
    """Return the largest deviations of N and M over the largest of their reference (N: at least the weight)."""
    out = np.zeros((5, history.shape[1]))
    golden.section_history(history[0].copy(), history[1].copy(), column, out)
    n_scale = max(np.abs(history[2]).max(), golden.WEIGHT)
    return np.abs(out[0] - history[2]).max() / n_scale, np.abs(out[1] - history[3]).max() / np.abs(history[3]).max()


def test_reference_histories(reference):
    results = {k: deviation(column, history) for k, column, history in histories(golden.load(reference, "section"))}
    assert results
    limits = {key: golden.ILL_CONDITIONED if key == ROUGH else golden.STRICT for key in results}
    assert not {key: r for key, r in results.items() if not max(r) < limits[key]}


@pytest.fixture
def column():
    return golden.column(golden.circle())


def properties(column):
    """Return EA, the coupling term and EI of the virgin section."""
    s = column.sections
    modulus = np.where(np.arange(s.y.size) < s.core_count, *s.concrete[:, concrete04.EC])
    ea, y = modulus * s.area, s.y
    bars, z = s.steel[reinforcing_steel.E0] * s.bar_area, s.bar_y
    return ea.sum() + bars.sum(), -(ea @ y + bars @ z), ea @ y**2 + bars @ z**2


def test_linear_range_is_closed_form(column):
    """N = EA e0 and M = EI kappa, at strains so small that the laws are linear to 1e-9."""
    ea, _, ei = properties(column)
    for e0, kappa in ((1e-11, 0.0), (-1e-11, 0.0), (0.0, 1e-12), (3e-12, -1e-13)):
        n, moment, *tangent = golden.section_forces(e0, kappa, column)
        assert n == pytest.approx(ea * e0, rel=1e-8, abs=1e-8 * ea * 1e-12)
        assert moment == pytest.approx(ei * kappa, rel=1e-8, abs=1e-8 * ei * 1e-13)
        assert tangent[0] == pytest.approx(ea, rel=1e-7)
        assert tangent[2] == pytest.approx(ei, rel=1e-7)


def test_symmetric_section_does_not_couple(column):
    ea, _, ei = properties(column)
    for e0 in (-1e-3, -1e-4, 0.0, 5e-5, 5e-4, 5e-3):
        n, moment, _, coupling, _ = golden.section_forces(e0, 0.0, column)
        assert abs(moment) < 1e-13 * (abs(n) + 1.0) * 24.0
        assert abs(coupling) < 1e-13 * ea * 24.0
    # control: one bar is moved
    column.sections.bar_y[0] += 1.0
    assert abs(golden.section_forces(-1e-3, 0.0, column)[1]) > 1.0


@pytest.mark.parametrize("yielded", [False, True])
def test_tangent_is_the_derivative(column, rng, yielded):
    """At random memories, where no fiber changes its branch between the two neighbouring states.

    Beyond yield a bar is rarely on a curve with R > 100, whose tangent is by definition the slope at its start.
    """
    ea, _, ei = properties(column)
    scale = np.array([[ea, ea * 24.0], [ea * 24.0, ea * 24.0**2]])
    size = (2e-3, 2e-4) if yielded else (3e-4, 1e-5)
    errors = []
    for _ in range(40):
        for e0, kappa in rng.normal(size=(3, 2)) * size:
            golden.section_commit(e0, kappa, column)
        for e0, kappa in rng.normal(size=(10, 2)) * size:
            tangent = golden.section_forces(e0, kappa, column)[2:]
            tangent = np.array([[tangent[0], tangent[1]], [tangent[1], tangent[2]]])
            sides = []
            for step in (1e-9, 1e-8):
                h, k = step, step / 24.0
                d_e0 = np.subtract(
                    golden.section_forces(e0 + h, kappa, column)[:2], golden.section_forces(e0 - h, kappa, column)[:2]
                ) / (2 * h)
                d_kappa = np.subtract(
                    golden.section_forces(e0, kappa + k, column)[:2], golden.section_forces(e0, kappa - k, column)[:2]
                ) / (2 * k)
                sides.append(np.column_stack([d_e0, d_kappa]))
            if np.abs((sides[0] - sides[1]) / scale).max() > 1e-5:
                continue  # a fiber at a corner of its law
            errors.append(np.abs((tangent - sides[1]) / scale).max())
    assert len(errors) > 300
    assert np.mean(np.array(errors) < 1e-5) > (0.95 if yielded else 0.999)
    assert column.sections.virgin[0] == (0.0 if yielded else 1.0)


def test_a_trial_changes_nothing(column, rng):
    sections = column.sections
    memory = (sections.concrete_memory, sections.steel_memory, sections.virgin)
    for e0, kappa in rng.normal(size=(20, 2)) * (1e-3, 1e-4):
        golden.section_commit(e0, kappa, column)
        before = [array.copy() for array in memory]
        for trial in rng.normal(size=(20, 2)) * (2e-3, 2e-4):
            golden.section_forces(*trial, column)
        for array, kept in zip(memory, before, strict=True):
            np.testing.assert_array_equal(array, kept)


def test_virgin_bars_equal_bars_with_memory(column, rng):
    """The series below yield and the full law agree, so the flag affects the speed only."""
    limit = column.sections.steel[reinforcing_steel.YIELD_STRAIN]
    other = golden.column(golden.circle())
    other.sections.virgin[0] = 0.0
    e0, kappa = rng.uniform(-1, 1, size=(2, 200)) * [[0.5 * limit], [0.45 * limit / 21.0]]
    out = np.zeros((2, 5, 200))
    golden.section_history(e0, kappa, column, out[0])
    golden.section_history(e0, kappa, other, out[1])
    assert column.sections.virgin[0] == 1.0
    scale = np.abs(out[0]).max(axis=1, keepdims=True)
    np.testing.assert_allclose(out[1] / scale, out[0] / scale, rtol=0, atol=1e-12)
