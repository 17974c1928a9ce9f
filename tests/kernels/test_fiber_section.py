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
