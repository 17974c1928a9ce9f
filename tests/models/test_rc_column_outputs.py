"""Outputs of the column below its top: names, closed forms, likelihood, wrong names.

`tests/kernels/test_against_opensees.py` compares them with the recorders of OpenSees.
"""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import ColumnAnalysis, DisplacementHistory, RCColumn, material_curves
from fe_likelihoods.models.rc_column_outputs import Sections, parse_outputs
from fe_likelihoods.models.rc_column_section import gauss_lobatto
from fe_likelihoods.problems import bridge_column, bridge_column_data
from fe_likelihoods.units import G0

SENSORS = ("base_moment", "base_shear", "axial_force", "curvature@0.3", "strain@0.3:-0.55", "rotation@0:0.6")


@pytest.fixture(scope="module")
def shaken():
    """Two seconds of the bundled record, with sensors below the top."""
    part = bridge_column_data().record.trim(6.0, 8.0)
    return RCColumn.lhpost(part, outputs=("acceleration", "displacement", *SENSORS))


def pushed(*targets, **changes):
    arguments = dict(parameters=("Ec",), axial_load=0.0) | changes
    return RCColumn.lhpost(DisplacementHistory("push", np.array(targets, dtype=float)), **arguments)


def test_sensors_change_nothing_at_the_top(shaken):
    plain = replace(shaken, outputs=None)
    np.testing.assert_array_equal(shaken.simulate(np.ones(5))[:2], plain.simulate(np.ones(5)))
    assert plain.fingerprint != shaken.fingerprint
    assert replace(shaken, outputs=(*shaken.outputs[:-1], "rotation@0:0.7")).fingerprint != shaken.fingerprint


def test_channels_have_quantities_and_display_units(shaken):
    channels = {channel.name: channel for channel in replace(shaken, units={"strain": "microstrain"}).channels}
    assert channels["strain@0.3:-0.55"].quantity == "strain" and channels["strain@0.3:-0.55"].unit == "microstrain"
    assert [channels[name].si_unit for name in SENSORS] == ["N m", "N", "N", "1/m", "1", "rad"]
    both = replace(shaken, units={"strain": "%", "strain@0.3:-0.55": "microstrain"})
    assert both.channels[6].unit == "microstrain"
    with pytest.raises(ValueError, match="display unit of rotation"):
        replace(shaken, units={"rotation": "m"})
    with pytest.raises(ValueError, match="display units of channels"):
        replace(shaken, units={"tilt": "rad"})


def test_history_contains_the_sensors(shaken):
    history, response = shaken.history(np.ones(5)), shaken.simulate(np.ones(5))
    for name, row in zip(shaken.outputs, response, strict=True):
        np.testing.assert_array_equal(history[name], row)
    np.testing.assert_array_equal(history["base_moment"], -history["base moment"])
    np.testing.assert_array_equal(history["axial_force"], history["base axial force"])
    with pytest.raises(ValueError, match="out of .*'base moment'.*'base_moment'.*; got 'moment'"):
        history["moment"]


def test_a_place_at_the_surface_is_not_refused_for_its_rounding(shaken):
    """The radius of a section of 48 in is one rounding below 0.6096 m."""
    radius, height = 0.5 * shaken.diameter, shaken.height
    assert radius < 0.6096
    outside = np.nextafter(height, 2.0 * height)
    for name in (
        "strain@0:0.6096",
        "strain@0:-0.6096",
        f"curvature@{float(outside)!r}",
        f"rotation@-1e-16:{float(outside)!r}",
    ):
        replace(shaken, outputs=(name,))
    top = [replace(shaken, outputs=(f"rotation@{lower}:1",))._prepared.outputs[0] for lower in ("0", "-1e-16")]
    assert top[0].slip and top[1].slip
    for name in ("strain@0:0.60961", f"curvature@{1.0001 * height}", "curvature@-0.001"):
        with pytest.raises(ValueError, match="in the section|heights between"):
            replace(shaken, outputs=(name,))


@pytest.mark.parametrize(("n_elements", "n_points"), [(1, 3), (2, 3), (3, 5)])
def test_elastic_cantilever(n_elements, n_points):
    """Curvatures are linear over the height, also between the sections; rotations are their integrals."""
    height = 7.3152
    heights = (0.0, 0.4, 2.0, 3.0, 3.6576, 5.5, height)
    outputs = ("force", "base_moment", "base_shear", *(f"curvature@{z}" for z in heights))
    outputs += ("rotation@0:0.5", "rotation@1:5", f"rotation@0:{height}", "strain@2:0.3", "strain@2:0")
    analysis = ColumnAnalysis(n_elements=n_elements, n_points=n_points, geometry="linear")
    column = pushed(0.0, 1e-6, analysis=analysis, outputs=outputs)
    values = dict(zip(outputs, column.simulate([1.0])[:, 1], strict=True))
    base, force = values["curvature@0.0"], values["force"]
    assert base > 0.0 and values["base_shear"] == pytest.approx(force, rel=1e-6)
    assert values["base_moment"] == pytest.approx(force * height, rel=1e-6)
    for z in heights:
        assert values[f"curvature@{z}"] == pytest.approx(base * (1 - z / height), rel=1e-4, abs=1e-4 * base)
    for low, high in ((0.0, 0.5), (1.0, 5.0), (0.0, height)):
        angle = base * (high - low) * (1.0 - 0.5 * (low + high) / height)
        assert values[f"rotation@{low:g}:{high:g}"] == pytest.approx(angle, rel=1e-4)
    assert values[f"rotation@0:{height}"] == pytest.approx(1.5 * 1e-6 / height, rel=1e-4)  # 3/2 of the chord's
    compressed = -0.3 * base * (1 - 2.0 / height)  # on the side towards which the column bends
    assert values["strain@2:0.3"] - values["strain@2:0"] == pytest.approx(compressed, rel=1e-4)


@pytest.mark.parametrize(("geometry", "tolerance"), [("linear", 1e-6), ("corotational", 2e-3)])
@pytest.mark.parametrize("penetration", [0.0, 0.2])
def test_the_slope_of_the_deflected_shape_is_the_rotation(geometry, tolerance, penetration):
    """Of a yielding column, also above strain penetration; there is no kink at the node between two elements.

    The corotational element bends about its chord with small rotations, which differ by their squares.
    """
    heights, step = (1e-3, 0.5, 3.0, 3.6576 - 0.001, 3.6576 + 0.001, 7.0), 1e-4
    pairs = [(f"displacement@{z - step}", f"displacement@{z + step}") for z in heights]
    outputs = (*(name for pair in pairs for name in pair), *(f"rotation@0:{z}" for z in heights))
    analysis = ColumnAnalysis(geometry=geometry)
    column = pushed(0.0, 0.05, 0.15, outputs=outputs, analysis=analysis, penetration=penetration)
    values = column.simulate([1.0])[:, -1]
    slopes, rotations = (values[1:12:2] - values[0:12:2]) / (2.0 * step), values[12:]
    expected = np.sin(rotations) if geometry == "corotational" else rotations
    np.testing.assert_allclose(slopes, expected, rtol=0.0, atol=tolerance * rotations[-1])
    assert rotations[0] > 0.1 * rotations[-1] if penetration else rotations[0] < 0.01 * rotations[-1]


def test_motions_below_the_top():
    """Newmark's identities between displacement, velocity and acceleration of every node, the top among them."""
    names = ("displacement", "velocity", "relative_acceleration", "acceleration")
    record = bridge_column_data().record.trim(6.0, 8.0)
    height = RCColumn.lhpost(record).height
    outputs = (*names, *(f"{name}@{z}" for z in (height / 2.0, height) for name in names))
    column = RCColumn.lhpost(record, outputs=outputs, column_mass=2e4)
    u, v, a, absolute = np.moveaxis(column.simulate(np.ones(5)).reshape(3, 4, -1), 1, 0)
    for shift, rate in ((u, v), (v, a)):
        mean = 0.5 * record.dt * (rate[:, 1:] + rate[:, :-1])
        np.testing.assert_allclose(np.diff(shift), mean, rtol=0.0, atol=1e-12 * np.abs(shift).max())
    np.testing.assert_array_equal(absolute, a + record.acceleration)
    for each in (u, v, a, absolute):
        np.testing.assert_array_equal(each[0], each[2])
        assert np.abs(each[1] - each[2]).max() > 0.1 * np.abs(each[2]).max()


def test_the_weight_of_the_column_acts():
    analysis = ColumnAnalysis(n_elements=3)
    column = pushed(0.0, 0.0, outputs=("axial_force",), axial_load=1e6, column_mass=3e4, analysis=analysis)
    assert column.simulate([1.0])[0, 0] == pytest.approx(-1e6 - 2.5e4 * G0, rel=1e-9)  # half an element is at the base


def test_stresses_are_of_the_nearest_fiber():
    """The stress of the material's law at the strain of the bar or fiber, and of a bar that yields."""
    bar = RCColumn.lhpost(bridge_column_data().record).bar_circle_radius
    column = pushed(0.0, 1e-5, 0.15, axial_load=1e5)
    core, cover, bars = column.section.fibers()
    cases = [(f"bar_stress@0:{bar:.3f}", 2, bars, 0.0), (f"bar_stress@0.001:{-bar}", 2, bars, 0.0)]
    cases += [("concrete_stress@3.66:0.3", 0, core, column.height / 2.0), ("concrete_stress@0:0.6", 1, cover, 0.0)]
    for name, material, fibers, height in cases:
        position = float(name.partition(":")[2])
        y = fibers[np.abs(fibers[:, 0] + position).argmin(), 0]
        stress, strain = replace(column, outputs=(name, f"strain@{height}:{-y}")).simulate([1.0])
        law = material_curves(column, [1.0], [strain[1]])[material]
        assert stress[1] == pytest.approx(law.stress[-1], rel=1e-9) and strain[1] != 0.0, name
        if name.endswith(str(-bar)):
            assert strain[2] > 2.0 * column.steel.fy / column.steel.es
            assert stress[2] == pytest.approx(column.steel.fy, rel=0.05)


def test_rotation_from_the_foundation_includes_strain_penetration():
    outputs = ("curvature@0", "rotation@0:0.6", "rotation@0.1:0.6", "rotation@0:0.1")
    column = pushed(0.0, 0.08, outputs=outputs, penetration=0.2, parameters=("Ec", "penetration"))
    for factor in (1.0, 2.0):
        base, whole, upper, lower = column.simulate([1.0, factor])[:, 1]
        above = lower - 0.2 * factor * base  # rotation of the column alone
        assert whole == pytest.approx(lower + upper, rel=1e-12)
        assert 0.05 * base < above < 0.1 * base


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("moment", "outputs out of"),
        ("curvature", "outputs out of"),
        ("rotation@0.3", "outputs out of"),
        ("force", "outputs out of"),
        ("curvature@nan", "outputs out of"),
        ("displacement@7.4", "heights between 0 and 7.3152 m"),
        ("displacement@1:0.3", "outputs out of"),
        ("velocity@3.6", "a height of a node, 3.658, 7.315 m; got 'velocity@3.6'"),
        ("acceleration@0", "a height of a node"),
        ("acceleration@3.6576", "a column whose nodes have a mass.*give the mass of the column itself, column_mass"),
        ("bar_stress@0.5:0.5", "a height of a section, 0, 1.829, 3.658, 5.486, 7.315 m"),
        ("bar_stress@0:0.45", "a position on a bar, -0.5"),
        ("concrete_stress@0:0.7", "between -0.6096 and 0.6096 m"),
        ("rotation@0.6:0.6", "a lower and a higher section"),
        ("strain@0.3:0.62", "between -0.6096 and 0.6096 m"),
        (3.0, "outputs out of"),
    ],
)
def test_wrong_names_are_rejected(shaken, name, words):
    with pytest.raises(ValueError, match=words):
        replace(shaken, outputs=("displacement", name))


def test_the_loading_decides_which_outputs_of_the_top_there_are():
    with pytest.raises(ValueError, match="outputs out of .'force'"):
        pushed(0.0, 0.01, outputs=("acceleration",))
    for name in ("velocity", "acceleration@7.3152"):
        with pytest.raises(ValueError, match="outputs out of .'force'.*'displacement@...', 'curvature@...'"):
            pushed(0.0, 0.01, outputs=(name,))
    sections = Sections(7.0, 0.5, 1, gauss_lobatto(3)[0])
    with pytest.raises(ValueError, match="once"):
        parse_outputs(("base_moment", "base_moment"), sections, ("force",))


def test_measurements_of_some_channels_name_the_outputs_to_choose():
    data = bridge_column_data()
    data = data._replace(measurements=data.measurements.select(["acceleration"]))
    with pytest.raises(ValueError, match=r"make the model with outputs=\('acceleration',\)"):
        bridge_column(data=data)
    posterior = bridge_column(data=data, outputs=("acceleration",))
    assert posterior.parameter_names[-1] == "sigma_acceleration"
