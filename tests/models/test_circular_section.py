"""Circular section: exact areas, reference meshes, Gauss-Lobatto rules, and the confinement of published columns."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import RCColumn, Record, to_si
from fe_likelihoods.models.rc_column_section import bar_circle, circular_strips, gauss_lobatto

INCH, KSI = to_si(1.0, "in").item(), to_si(1.0, "ksi").item()
RADIUS, CORE_RADIUS = 24.0, 43.375 / 2  # of the tested column [in]


def second_moment(fibers):
    return fibers[:, 1] @ fibers[:, 0] ** 2


@pytest.fixture(scope="module")
def lhpost():
    return RCColumn.lhpost(Record("rest", 0.01, np.zeros(3)))


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


def test_strength_gain_by_confinement(lhpost):
    """Zero without hoops, concave in their area, and equal to a hand calculation at a pressure of fc/10."""

    def confined(area, **changes):
        hoops = replace(lhpost.hoops, area=area, **changes)
        return replace(lhpost, hoops=hoops).section.confinement(30e6)

    assert confined(1e-12) == pytest.approx((1.0, 1.0, 0.004), rel=1e-6)
    ratios = [confined(area).strength_ratio for area in np.linspace(1e-12, 1e-3, 9)]
    assert (np.diff(ratios) > 0).all() and (np.diff(ratios, 2) < 0).all()
    section, arch = lhpost.section, 1 - (6.0 - 0.625) / (2 * 43.375)
    for spiral, effective in ((False, arch**2), (True, arch)):
        pressure = 0.5 * effective / (1 - section.steel_ratio) * 4 / (section.core_diameter * 6.0 * INCH) * 54.8 * KSI
        tenth = confined(3e6 / pressure, spiral=spiral)
        assert tenth.strength_ratio == pytest.approx(-1.254 + 2.254 * 1.339403 - 0.2, abs=1e-5)  # sqrt(1.794)
        assert tenth.strain_ratio == pytest.approx(1 + 5 * 0.565014, abs=1e-5)
