"""Circular section: exact areas, reference meshes, Gauss-Lobatto rules, and the confinement of published columns."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import RCColumn, Record, to_si
from fe_likelihoods.models.circular_section import (
    bar_circle,
    circular_patches,
    circular_strips,
    gauss_lobatto,
    mander_confinement,
)
from fe_likelihoods.models.rc_column_parts import Patches

INCH, KSI = to_si(1.0, "in").item(), to_si(1.0, "ksi").item()
RADIUS, CORE_RADIUS = 24.0, 43.375 / 2  # of the tested column [in]
CORE, COVER, STEEL = 1, 2, 3  # materials of the reference fibers


def second_moment(fibers):
    return fibers[:, 1] @ fibers[:, 0] ** 2


@pytest.fixture(scope="module")
def lhpost():
    return RCColumn.lhpost(Record("rest", 0.01, np.zeros(3)))


@pytest.fixture(scope="module")
def golden(shared):
    return np.load(shared / "golden" / "column" / "golden_A_section.npz")


@pytest.mark.parametrize("n", [4, 6, 20, 40, 200, 2000])
@pytest.mark.parametrize("core", [CORE_RADIUS, 0.3 * RADIUS, 0.999 * RADIUS])
def test_strips_have_the_area_and_inertia_of_the_circle(n, core):
    inner, outer = circular_strips(RADIUS, core, n)
    assert inner[:, 1].sum() == pytest.approx(math.pi * core**2, rel=1e-11)
    assert second_moment(inner) == pytest.approx(math.pi * core**4 / 4, rel=1e-11)
    whole = np.concatenate([inner, outer])
    assert whole[:, 1].sum() == pytest.approx(math.pi * RADIUS**2, rel=1e-11)
    assert second_moment(whole) == pytest.approx(math.pi * RADIUS**4 / 4, rel=1e-11)
    for fibers in (inner, outer):
        assert (fibers[:, 1] > 0).all()
        np.testing.assert_allclose(fibers[:, 0], -fibers[::-1, 0], rtol=1e-9)  # no coupling of force and moment
        assert (np.diff(fibers[:, 0]) > 0).all()
        assert np.abs(fibers[:, 0]).max() < RADIUS


def test_every_fiber_is_inside_its_strip():
    _, cover = circular_strips(RADIUS, CORE_RADIUS, 40)
    edges = np.linspace(-RADIUS, RADIUS, 41)
    assert len(cover) == 40
    assert ((cover[:, 0] > edges[:-1]) & (cover[:, 0] < edges[1:])).all()


def test_fibers_at_centroids_lose_inertia():
    """Control: fibers at the centroids of the strips, as usual, have too small a second moment of area."""
    edges = np.linspace(-RADIUS, RADIUS, 21)
    y = np.linspace(-RADIUS, RADIUS, 200_001)
    chord = 2 * np.sqrt(RADIUS**2 - y**2)
    strip = np.minimum(np.searchsorted(edges, y, side="right") - 1, 19)
    area = np.bincount(strip, weights=chord)
    centroid = np.bincount(strip, weights=chord * y) / area
    loss = 1 - (area @ centroid**2 * (y[1] - y[0])) / (math.pi * RADIUS**4 / 4)
    assert loss > 2e-3


@pytest.mark.parametrize(("wedges", "rings"), [(20, (10, 2)), (7, (3, 1)), (40, (20, 4))])
def test_patches_have_the_area_of_the_circle(wedges, rings):
    core, cover = circular_patches(RADIUS, CORE_RADIUS, wedges, *rings)
    assert core[:, 1].sum() == pytest.approx(math.pi * CORE_RADIUS**2, rel=1e-12)
    assert cover[:, 1].sum() == pytest.approx(math.pi * (RADIUS**2 - CORE_RADIUS**2), rel=1e-12)
    assert (core[:, 1] @ core[:, 0], cover[:, 1] @ cover[:, 0]) == pytest.approx((0, 0), abs=1e-9)


def test_patches_converge_to_the_inertia_of_the_circle_from_below():
    lost = [
        1 - second_moment(np.concatenate(circular_patches(1.0, 0.9, n, n // 2, 2))) / (math.pi / 4) for n in (10, 20)
    ]
    assert lost[0] > lost[1] > 0
    assert lost[0] / lost[1] == pytest.approx(4, abs=0.8)  # second order


@pytest.mark.parametrize(("n", "positions"), [(18, 10), (3, 2), (4, 3), (7, 4)])
def test_bars_with_the_same_position_are_merged(n, positions):
    bars = bar_circle(20.0, n, 1.56)
    assert len(bars) == positions
    assert bars[:, 1].sum() == pytest.approx(n * 1.56, rel=1e-14)
    assert second_moment(bars) == pytest.approx(n * 1.56 * 20.0**2 / 2, rel=1e-12)
    assert bars[:, 1] @ bars[:, 0] == pytest.approx(0.0, abs=1e-10)


def test_first_angle_rotates_the_bars():
    straight, turned = bar_circle(20.0, 18, 1.56), bar_circle(20.0, 18, 1.56, math.pi / 18)
    assert (len(straight), len(turned)) == (10, 9)
    assert np.abs(turned[:, 0]).max() == pytest.approx(20.0 * math.cos(math.pi / 18))
    oblique = bar_circle(20.0, 18, 1.56, 0.1)
    assert len(oblique) == 18
    assert second_moment(oblique) == pytest.approx(second_moment(straight), rel=1e-12)


def as_sorted(y, area):
    order = np.argsort(y)
    return np.array([y[order], area[order]])


@pytest.mark.parametrize(("name", "mesh"), [("rms40", 40), ("circ20_10_2_merged", Patches(20, 10, 2))])
def test_reference_fibers(golden, lhpost, name, mesh):
    """The dimensions of the column give the fibers of the reference results."""
    model = RCColumn.lhpost(lhpost.loading, mesh=mesh)
    y, area, material = golden[f"fibers/{name}"]
    for fibers, tag in zip(model.section.fibers(), (CORE, COVER, STEEL), strict=True):
        expected = as_sorted(y[material == tag], area[material == tag])
        got = as_sorted(fibers[:, 0] / INCH, fibers[:, 1] / INCH**2)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("n", range(2, 8))
def test_gauss_lobatto_is_exact_to_its_degree(n):
    points, weights = gauss_lobatto(n)
    assert (points[0], points[-1]) == (0.0, 1.0)
    np.testing.assert_array_equal(points + points[::-1], np.ones(n))
    for degree in range(2 * n - 2):
        assert weights @ points**degree == pytest.approx(1 / (degree + 1), rel=1e-13)
    assert abs(weights @ points ** (2 * n - 2) - 1 / (2 * n - 1)) > 1e-7  # not exact for the next degree


@pytest.mark.parametrize(
    ("n", "points", "weights"),
    [
        (2, [-1, 1], [1, 1]),
        (3, [-1, 0, 1], [1 / 3, 4 / 3, 1 / 3]),
        (4, [-1, -math.sqrt(1 / 5), math.sqrt(1 / 5), 1], [1 / 6, 5 / 6, 5 / 6, 1 / 6]),
        (5, [-1, -math.sqrt(3 / 7), 0, math.sqrt(3 / 7), 1], [1 / 10, 49 / 90, 32 / 45, 49 / 90, 1 / 10]),
    ],
)
def test_gauss_lobatto_equals_published_tables(n, points, weights):
    """Abramowitz & Stegun (1964), table 25.6, on [-1, 1]."""
    got_points, got_weights = gauss_lobatto(n)
    np.testing.assert_allclose(2 * got_points - 1, points, atol=1e-14)
    np.testing.assert_allclose(2 * got_weights, weights, rtol=1e-13)


def test_confinement_of_the_tested_column(lhpost):
    confinement = lhpost.confinement
    assert confinement.effectiveness == pytest.approx(0.897, abs=5e-4)
    assert confinement.lateral_pressure / KSI == pytest.approx(0.234, abs=5e-4)
    assert confinement.strength_ratio * 6.1 == pytest.approx(7.59, abs=5e-3)
    peak = 2 * 6.1 / 3320
    assert confinement.strain_ratio * peak == pytest.approx(0.00816, abs=5e-6)
    assert confinement.ultimate_strain > confinement.strain_ratio * peak


def test_confinement_of_the_reference_results(golden):
    """The reference results assume fyh = 60 ksi, fc = 6 ksi and a clear spacing of 4.75 in."""
    fc, fyh, core = 6.0, 60.0, 43.375
    confinement = mander_confinement(
        fc,
        core_diameter=core,
        steel_ratio=18 * 1.56 / (0.25 * math.pi * core**2),
        hoop_area=0.62,
        spacing=6.0,
        clear_spacing=4.75,
        fyh=fyh,
        ultimate_hoop_strain=0.12,
        spiral=False,
    )
    strength, peak, ultimate = -golden["section/nominal/core_args"][:3]
    assert confinement.effectiveness == pytest.approx(0.911, abs=5e-4)
    assert confinement.lateral_pressure == pytest.approx(0.260, abs=5e-4)
    assert confinement.strength_ratio * fc == pytest.approx(strength, rel=1e-8)
    assert confinement.strain_ratio * 2 * fc / 3320 == pytest.approx(peak, rel=1e-8)
    assert confinement.ultimate_strain == pytest.approx(ultimate, rel=1e-8)


def test_strength_gain_by_confinement():
    """Zero without hoops, concave in the hoop area, and equal to a hand calculation at a pressure of fc/10."""
    common = dict(core_diameter=1.0, steel_ratio=0.02, spacing=0.1, clear_spacing=0.08, fyh=400e6)
    common |= dict(ultimate_hoop_strain=0.12, spiral=False)
    none = mander_confinement(30e6, hoop_area=0.0, **common)
    assert (none.strength_ratio, none.strain_ratio, none.ultimate_strain) == pytest.approx((1, 1, 0.004))
    ratios = [mander_confinement(30e6, hoop_area=a, **common).strength_ratio for a in np.linspace(0, 1e-3, 9)]
    assert (np.diff(ratios) > 0).all() and (np.diff(ratios, 2) < 0).all()
    area = 0.1 * 30e6 / (0.5 * (1 - 0.04) ** 2 / 0.98 * 4 / (1.0 * 0.1) * 400e6)
    tenth = mander_confinement(30e6, hoop_area=area, **common)
    assert tenth.strength_ratio == pytest.approx(-1.254 + 2.254 * 1.339403 - 0.2, abs=1e-5)  # sqrt(1.794)
    assert tenth.strain_ratio == pytest.approx(1 + 5 * 0.565014, abs=1e-5)


def test_a_spiral_confines_better_than_hoops(lhpost):
    spiral = replace(lhpost, hoops=replace(lhpost.hoops, spiral=True)).confinement
    arch = 1 - (6.0 - 0.625) / (2 * 43.375)
    assert spiral.effectiveness / lhpost.confinement.effectiveness == pytest.approx(1 / arch, rel=1e-12)
    assert spiral.strength_ratio > lhpost.confinement.strength_ratio
