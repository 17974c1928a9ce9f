"""Figures of materials and sections: values, units and labels."""

import numpy as np
import pytest

from fe_likelihoods import plot_material, plot_moment_curvature
from fe_likelihoods.models.rc_column_curves import MaterialCurve, MomentCurvature
from tests.plots.reading import shows, texts


def test_stress_against_strain():
    strain = np.linspace(0.0, 0.01, 5)
    curves = [MaterialCurve(name, strain, 2e9 * k * strain) for k, name in ((1, "cover concrete"), (3, "steel"))]
    axes = plot_material(*curves, stress_unit="ksi")
    assert axes.get_xlabel() == "strain [%]" and axes.get_ylabel() == "stress [ksi]"
    assert texts(axes) == ["cover concrete", "steel"]
    first, second = axes.lines[2:]
    np.testing.assert_allclose(first.get_xdata(), 1e2 * strain)
    np.testing.assert_allclose(second.get_ydata(), 6e9 * strain / 6.894757293168361e6)
    assert shows(axes, [first, second]) and first.get_color() != second.get_color()
    with pytest.raises(ValueError, match="one or more curves; got none"):
        plot_material()
    with pytest.raises(ValueError, match="unit of stress"):
        plot_material(curves[0], stress_unit="kN")


def test_moment_against_curvature():
    curvature = np.linspace(0.0, 0.02, 5)
    curve = MomentCurvature(curvature, 1e8 * curvature, -2.5e6)
    axes = plot_moment_curvature({"nominal": curve, "updated": curve._replace(moment=2e8 * curvature)})
    assert axes.get_xlabel() == "curvature [1/m]" and axes.get_ylabel() == "moment [kN m]"
    assert texts(axes) == ["nominal, axial force -2500 kN", "updated, axial force -2500 kN"]
    np.testing.assert_allclose(axes.lines[3].get_ydata(), 2e5 * curvature)
    assert texts(plot_moment_curvature(curve)) == ["axial force -2500 kN"] and shows(axes, axes.lines[2:])
