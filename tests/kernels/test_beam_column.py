"""The force-based element against closed forms, differences, equilibrium, and a second implementation in numpy.

One element with linear geometry on a fixed base has the basic deformations v = (elongation, theta_i, theta_j) at the
displacements (v2 L, v1, v3 - v2) of its free end. The tests use only the public assembly of the column.
"""

import numpy as np
import pytest

from fe_likelihoods.kernels import concrete04, frame, reinforcing_steel
from fe_likelihoods.kernels.static import Position, equilibrate

from . import golden


def single(element_tolerance=1e-12, **options):
    """One element of 144 in with linear geometry."""
    return golden.column(
        golden.circle(),
        n_elements=1,
        height=144.0,
        corotational=False,
        element_tolerance=element_tolerance,
        **options,
    )


def advance(column, v):
    """Bring the element to the basic deformations `v`; return whether it converged, Q, and K as a matrix."""
    u = np.array([v[1] * column.length, v[0], v[2] - v[1]])
    converged = frame.assemble(u, column, np.zeros(3), np.zeros((3, 3)), False)
    row = column.elements.state[0]
    return converged, row[:3].copy(), symmetric(row[3:9])


def symmetric(upper):
    out = np.zeros((3, 3))
    out[np.triu_indices(3)] = upper
    return out + np.triu(out, 1).T


def stiffness_of_section(column):
    """Return EA and EI of the virgin section."""
    s = column.sections
    modulus = np.where(np.arange(s.y.size) < s.core_count, *s.concrete[:, concrete04.EC])
    steel = s.steel[reinforcing_steel.E0]
    ea = modulus @ s.area + steel * s.bar_area.sum()
    return ea, (modulus * s.area) @ s.y**2 + steel * s.bar_area @ s.bar_y**2


@pytest.mark.parametrize("n_points", range(2, 8))
@pytest.mark.parametrize("n_elements", [1, 2, 3])
def test_elastic_cantilever_is_closed_form(n_elements, n_points):
    """Tip deflection P h^3 / 3 EI, rotation P h^2 / 2 EI, shortening N h / EA.

    Gauss-Lobatto with n points is exact up to degree 2n - 3, so M^2 needs three points. Two points (the trapezoidal
    rule) give a deflection that is too large by the factor 1 + 1/(2 n_elements^2).
    """
    column = golden.column(
        golden.circle(), n_elements=n_elements, n_points=n_points, corotational=False, element_tolerance=1e-30
    )
    ea, ei = stiffness_of_section(column)
    h = golden.HEIGHT
    n = 3 * n_elements
    # at strains of 1e-11, steel (1.5 eps) and concrete are linear to 1e-9, and round-off is much smaller
    p, axial = 1e-11 * ei / (24.0 * h), -1e-12 * ea
    load = np.zeros(n)
    load[-3:-1] = p, axial
    position = Position(np.zeros(n), np.zeros(n), np.zeros((n, n)))
    u = position.u
    assert frame.assemble(u, column, position.force, position.stiffness, False)
    assert equilibrate(column, position, load, -1, 0.0, -1, 1e-18, 20) < 1e-18
    trapezoidal = 1.0 + 1.0 / (2.0 * n_elements**2) if n_points == 2 else 1.0
    assert u[-3] == pytest.approx(p * h**3 / (3 * ei) * trapezoidal, rel=1e-8)
    assert u[-1] == pytest.approx(-p * h**2 / (2 * ei), rel=1e-8)
    assert u[-2] == pytest.approx(axial * h / ea, rel=1e-8)


def states(rng, column, n, size):
    """Take the element through `n` random committed deformations and yield each."""
    for _ in range(n):
        v = rng.normal(size=3) * size
        if advance(column, v)[0]:
            frame.commit_sections(column)
            yield v


MILD = np.array([0.02, 2e-3, 2e-3])


def test_tangent_is_the_derivative(rng):
    """The tangent is consistent where no fiber changes its branch between the two neighbouring states."""
    column = single(element_tolerance=1e-22)
    scale = np.diag(1.0 / np.sqrt(np.diag(symmetric(column.elements.state[0, 3:9]))))
    errors = []
    for _ in states(rng, column, 40, MILD):
        v = column.elements.state[0, 9:12] + rng.normal(size=3) * 0.1 * MILD
        converged, _, tangent = advance(column, v)
        if not converged:
            continue
        estimates = []
        for step in (2e-8, 1e-7):
            columns = []
            for i in range(3):
                h = np.zeros(3)
                h[i] = step * (MILD / MILD[1])[i]
                sides = [advance(column, v + side * h) for side in (1, -1)]
                if not (sides[0][0] and sides[1][0]):
                    break
                columns.append((sides[0][1] - sides[1][1]) / (2 * h[i]))
            estimates.append(columns)
        if len(estimates[0]) < 3 or len(estimates[1]) < 3:
            continue
        one, two = (scale @ np.column_stack(columns) @ scale for columns in estimates)
        if np.abs(one - two).max() < 1e-4:
            errors.append(np.abs(scale @ tangent @ scale - two).max())
        advance(column, v)
    assert len(errors) > 20
    assert np.median(errors) < 1e-5
    assert np.mean(np.array(errors) < 1e-3) > 0.9


def test_large_steps_reach_the_state_of_small_ones(rng):
    """At steps at which plain iterations often fail: initial flexibilities, then tenths of the step, succeed."""
    gaps = []
    for _ in range(60):
        column = single()
        list(states(rng, column, 2, MILD))
        before, v = column.elements.state.copy(), rng.normal(size=3) * 8.0 * MILD
        converged, q, _ = advance(column, v)
        column.elements.state[:] = before
        start = before[0, 9:12]
        if converged and all(advance(column, start + part * (v - start))[0] for part in np.linspace(0.002, 1.0, 500)):
            gaps.append(np.abs(q - column.elements.state[0, :3]).max() / np.abs(q).max())
    assert len(gaps) > 45  # of 60
    assert np.mean(np.array(gaps) < 1e-6) > 0.7  # softening sections may have more than one state


@pytest.mark.parametrize("v", [(-290.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (0.0, np.inf, 0.0)])
def test_impossible_deformation_is_reported_and_changes_nothing(v, rng):
    column = single()
    list(states(rng, column, 3, MILD))
    before = column.elements.state.copy()
    converged, _, _ = advance(column, np.array(v))
    assert not converged
    np.testing.assert_array_equal(column.elements.state, before)
