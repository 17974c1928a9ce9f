"""Units: factors against their definitions, spellings in file headers, and errors."""

import numpy as np
import pytest

from fe_likelihoods import Channel
from fe_likelihoods.units import UNITS, find_unit, from_si, to_si


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (1, "g", 9.80665),
        (980.665, "gal", 9.80665),
        (980.665, "cm/s2", 9.80665),
        (1, "in/s2", 0.0254),
        (1, "ft/s2", 0.3048),
        (12, "in", 0.3048),
        (1, "kip", 4448.2216152605),  # NIST SP 811
        (1, "lbf", 4.4482216152605),
        (1, "ksi", 6.894757293168361e6),
        (1, "psi", 6894.757293168361),
        (1, "MN", 1e6),
        (1, "GPa", 1e9),
        (20, "ms", 0.02),
        (20, "milliseconds", 0.02),
        (1, "us", 1e-6),
        (1, "um", 1e-6),
        (1, "mg", 9.80665e-3),
        (180, "deg", np.pi),
        (1000, "mrad", 1.0),
        (1, "kip in", 112.9848290276167),  # NIST SP 811
        (1, "lbf ft", 1.3558179483314004),  # NIST SP 811
        (1, "1/in", 1 / 0.0254),
        (2, "1/km", 0.002),
        (1, "microstrain", 1e-6),
        (2 * np.pi, "rad/s", 1.0),
        (90, "rpm", 1.5),
        (10, "lbf/in", 1751.2683524647636),  # NIST SP 811
        (1, "kN/mm", 1e6),
        (386.08858267716535, "lb", 175.12683524647636),  # the mass of one lbf s2/in
        (1, "lbf s2/in", 175.12683524647636),
    ],
)
def test_factors_agree_with_their_definitions(value, unit, expected):
    assert to_si(value, unit) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("unit", UNITS)
def test_from_si_is_the_inverse_of_to_si(unit, rng):
    values = rng.normal(size=(3, 4))
    there_and_back = from_si(to_si(values, unit), unit, UNITS[unit].dimension)
    np.testing.assert_allclose(there_and_back, values, rtol=4e-16)


def test_a_share_is_a_strain_only_where_no_other_dimension_is_stated():
    assert find_unit("%").dimension == "strain" and find_unit("%", "dimensionless") == ("%", 0.01, "dimensionless")
    with pytest.raises(ValueError, match="expected a unit of dimensionless, got 'microstrain'"):
        find_unit("microstrain", "dimensionless")


def test_a_temperature_is_in_degrees_and_an_underscore_in_a_moment_is_no_quotient():
    assert find_unit("°C").dimension == "temperature" and find_unit("kN_m").name == "kN m"
    with pytest.raises(ValueError, match="subtract 273.15, and give degC"):
        find_unit("K", "temperature")
    assert to_si(2.0, "t", "mass") == 2000.0 and to_si(3.0, "kN m/rad") == 3000.0
    assert Channel("joint", "rotational stiffness", "kN m/rad").si_unit == "N m/rad"
    with pytest.raises(ValueError, match="unknown unit 't'"):
        find_unit("t")


SPELLINGS = {
    "acceleration": ["cm/s2", "CM/SEC/SEC", "cm/sec2", "cm/s/s", "cm/s^2", "cm/s**2", "cm_s2", "cm/s²"],
    "moment": ["kN m", "kN-m", "kNm", "kN·m", "kN*m", "KN M"],
    "strain": ["microstrain", "ue", "µε", "με", "Microstrain"],
    "time": ["us", "µs", "μs", "microseconds", "microsec"],
    "displacement": ["um", "µm", "μm", "UM"],
}


@pytest.mark.parametrize("dimension", SPELLINGS)
def test_spellings_of_file_headers(dimension):
    names = SPELLINGS[dimension]
    assert {find_unit(each, dimension).factor for each in names} == {UNITS[names[0]].factor}


@pytest.mark.parametrize("spelling", ["mN m", "mN", "mPa", "mpa", "mn"])
def test_milli_is_not_read_as_mega(spelling):
    with pytest.raises(ValueError, match="unknown unit"):
        find_unit(spelling)
    assert find_unit("MPA").factor == 1e6


def test_error_for_an_unknown_unit_lists_the_known_ones():
    with pytest.raises(ValueError, match="'furlong'.*in/s2.*kip.*ksi"):
        to_si(1.0, "furlong")
    with pytest.raises(ValueError, match="unknown unit None"):
        to_si(1.0, None)


def test_wrong_dimension_is_refused():
    with pytest.raises(ValueError, match="expected a unit of acceleration, got 'in', a unit of displacement.*gal"):
        to_si(1.0, "in", "acceleration")
    with pytest.raises(ValueError, match="unknown dimension 'length'; known dimensions: acceleration"):
        from_si(1.0, "in", "length")
