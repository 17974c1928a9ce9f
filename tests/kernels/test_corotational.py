"""The transformation against rigid motions, differences at large rotations, and the P-Delta cantilever."""

import numpy as np
import pytest

from fe_likelihoods.kernels.corotational import add_to_stiffness, deformations
from fe_likelihoods.kernels.jit import kernel
from fe_likelihoods.kernels.static import Iteration, Position, apply_gravity, equilibrate

from . import golden
from .test_beam_column import stiffness_of_section

LENGTH = 1.3
# Basic stiffness K11 K12 K13 K22 K23 K33 of a fictitious linear element, without zero or equal entries.
STIFFNESS = np.array([7.0, 0.4, -0.3, 3.0, 1.1, 2.5])


@kernel
def end_forces(u, q0, k, length, corotational, basic, force, stiffness):
    """Write end forces and tangent of an element with basic forces q0 + k v at the displacements of both ends (6,)."""
    chord = deformations(u[3] - u[0], u[4] - u[1], u[2], u[5], length, corotational)
    v1, v2, v3 = chord.elongation, chord.theta_i, chord.theta_j
    force[:] = 0.0
    stiffness[:] = 0.0
    basic[0] = q0[0] + k[0] * v1 + k[1] * v2 + k[2] * v3
    basic[1] = q0[1] + k[1] * v1 + k[3] * v2 + k[4] * v3
    basic[2] = q0[2] + k[2] * v1 + k[4] * v2 + k[5] * v3
    for i in range(6):
        basic[3 + i] = k[i]
    add_to_stiffness(0, basic, chord, corotational, force, stiffness)


def element(u, q0=(0.0, 0.0, 0.0), k=STIFFNESS, corotational=True):
    force, stiffness = np.zeros(6), np.zeros((6, 6))
    end_forces(np.asarray(u, float), np.asarray(q0, float), k, LENGTH, corotational, np.empty(9), force, stiffness)
    return force, stiffness


def basic(u, corotational=True):
    return np.array(deformations(u[3] - u[0], u[4] - u[1], u[2], u[5], LENGTH, corotational)[:3])


def displaced(rng, size):
    """Return random displacements and rotations of both ends; the chord rotates by less than half a turn."""
    u = rng.normal(size=6) * size
    u[4] += 0.1
    return u


def central(function, u, step):
    return np.column_stack([(function(u + h) - function(u - h)) / (2 * step) for h in step * np.eye(6)])


@pytest.mark.parametrize("angle", [1e-9, 0.01, 0.5, 1.5, 3.0, -2.5])
def test_rigid_motion_deforms_nothing(angle):
    """A rotation by `angle` (counter-clockwise) about an arbitrary point, and a translation."""
    centre, shift = np.array([0.7, -0.4]), np.array([0.3, -1.1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    u = np.zeros(6)
    for end, position in enumerate(([0.0, 0.0], [0.0, LENGTH])):
        u[3 * end : 3 * end + 2] = turn @ (np.array(position) - centre) + centre + shift - position
        u[3 * end + 2] = angle
    np.testing.assert_allclose(basic(u), 0.0, atol=1e-15 * 10)
    force, _ = element(u)
    np.testing.assert_allclose(force, 0.0, atol=1e-13)
    # control: in the linear variant a large rotation is a deformation
    if abs(angle) > 0.1:
        assert np.abs(basic(u, corotational=False)).max() > 1e-3


def test_small_elongation_is_not_lost():
    """chord - length is computed without cancellation: an elongation of 1e-14 keeps its digits."""
    for elongation in (1e-14, 1e-10, -1e-12):
        v1, _, _, c, s, chord = deformations(0.0, elongation, 0.0, 0.0, LENGTH, True)
        assert v1 == pytest.approx(elongation, rel=1e-12)
        assert (c, s, chord) == (1.0, 0.0, LENGTH + elongation)


@pytest.mark.parametrize("corotational", [True, False])
@pytest.mark.parametrize("size", [0.01, 0.5])
def test_end_forces_are_work_conjugate(rng, corotational, size):
    """p = T' Q with T = dv/du: for each unit basic force the end forces are a row of the derivative."""
    for _ in range(20):
        u = displaced(rng, size)
        derivative = central(lambda w: basic(w, corotational), u, 1e-5)
        rows = [element(u, q0, np.zeros(6), corotational)[0] for q0 in np.eye(3)]
        np.testing.assert_allclose(rows, derivative, rtol=0, atol=1e-7)


@pytest.mark.parametrize("corotational", [True, False])
@pytest.mark.parametrize("size", [0.01, 0.5])
def test_tangent_is_the_derivative_of_the_forces(rng, corotational, size):
    """The sum of the material and the geometric part, at forces of the size of the stiffness."""
    for _ in range(20):
        u, q0 = displaced(rng, size), rng.normal(size=3) * 3.0
        _, stiffness = element(u, q0, corotational=corotational)
        derivative = central(lambda w, q0=q0: element(w, q0, corotational=corotational)[0], u, 1e-5)
        np.testing.assert_allclose(stiffness, derivative, rtol=0, atol=2e-6)
        np.testing.assert_allclose(stiffness, stiffness.T, rtol=0, atol=1e-12)


def amplified_deflection(n_elements, corotational=True):
    """Return the tip deflection over P h^3 / 3 EI of a very slender cantilever with k h = 1, and the closed form.

    The cantilever is so slender that its strains stay below 1e-6, where concrete and steel are linear to 1e-6.
    """
    column = golden.column(
        golden.circle(),
        n_elements=n_elements,
        height=100 * golden.HEIGHT,
        corotational=corotational,
        element_tolerance=1e-24,
    )
    _, ei = stiffness_of_section(column)
    h = 100 * golden.HEIGHT
    weight, lateral = ei / h**2, 1e-5 * ei / h**2
    load = golden.gravity(n_elements, weight)
    assert apply_gravity(column, load, Iteration(1e-9, 20, 0)) == 0
    position = Position(column.vectors[4], column.vectors[5], column.matrices[2])
    load[-3] = lateral
    assert equilibrate(column, position, load, -1, 0.0, -1, 1e-9, 20) < 1e-9
    return position.u[-3] / (lateral * h**3 / (3 * ei)), 3 * (np.tan(1.0) - 1.0)


def test_p_delta_amplification_converges_to_the_closed_form():
    """Each element has a straight chord, so the convergence is of second order in the number of elements."""
    n = np.array([2, 4, 8, 16])
    deflections = [amplified_deflection(k) for k in n]
    errors = np.array([abs(value - exact) for value, exact in deflections])
    rates = np.log2(errors[:-1] / errors[1:])
    assert np.all(np.abs(rates - 2.0) < 0.1)
    assert errors[-1] < 2e-3 * deflections[-1][1]
    # control: without geometric effects there is no amplification
    assert amplified_deflection(4, corotational=False)[0] == pytest.approx(1.0, abs=1e-4)
