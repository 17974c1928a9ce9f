"""Modal data from tables, MATLAB files and results of pyOMA2."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import savemat

from fe_likelihoods import read_modal_data
from fe_likelihoods.signals.sdof import respond

SHAPES = np.array([[1.0, 2.0, 3.0], [-2.0, -1.0, 2.0]])
UNIT = SHAPES / np.linalg.norm(SHAPES, axis=1, keepdims=True)


def written(folder, *lines):
    path = folder / "modes.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_has_a_line_for_each_mode(tmp_path):
    path = written(
        tmp_path, "mode,frequency_Hz,damping_%,floor 1,floor 2,floor 3", "2,3.0,1.5,-2,-1,2", "1,1.0,1.0,1,2,3"
    )
    data = read_modal_data(path, frequency_cv=0.01)
    assert data.mode_numbers == (1, 2) and data.frequencies.tolist() == [[1.0, 3.0]] and data.frequency_cv[1] == 0.01
    np.testing.assert_allclose(data.damping, [[0.010, 0.015]], rtol=1e-12)
    np.testing.assert_allclose(data.shapes[0], UNIT, rtol=1e-12)
    assert read_modal_data(path, ["floor 3", "floor 1"]).sensors == ("floor 3", "floor 1")


def test_other_layouts_of_a_table(tmp_path):
    """Semicolons with decimal commas, long names, periods, deviations, and modes in columns."""
    for lines in (
        ("Mode No.;Natural frequency [Hz];a;b;c", "1;1,0;1;2;3", "2;3,0;-2;-1;2"),
        ("mode,period [s],a,b,c", "1,1.0,1,2,3", f"2,{1 / 3!r},-2,-1,2"),
        ("T [s],a,b,c,MAC [%],MPC", "1.0,1,2,3,99.5,0.98", f"{1 / 3!r},-2,-1,2,97.1,0.99"),
        ("order;T_s;a;b;c", "10;1,0;1;2;3", f"12;{str(1 / 3).replace('.', ',')};-2;-1;2"),
        ("f [Hz],T (°C),a,b,c,mac", "1,20,1,2,3,1", "3,20,-2,-1,2,1"),
        ("f [Hz],T [K],a,b,c", "1,293.15,1,2,3", "3,293.15,-2,-1,2"),
        ("f [Hz],a,b,c,remark", "1,1,2,3,good", "3,-2,-1,2,poor"),
        ("omega_rad/s,a,b,c", "6.283185307179586,1,2,3", "18.84955592153876,-2,-1,2"),
        (",mode 1,mode 2", "frequency [Hz],1.0,3.0", "a,1,-2", "b,2,-1", "c,3,2"),
        ("name;first;second", "frequency_rad/s;6.283185307179586;18.84955592153876", "a;1;-2", "b;2;-1", "c;3;2"),
    ):
        data = read_modal_data(written(tmp_path, *lines))
        assert data.mode_numbers == (1, 2) and data.sensors == ("a", "b", "c")
        np.testing.assert_allclose(data.frequencies, [[1.0, 3.0]], rtol=1e-12)
        np.testing.assert_allclose(data.shapes[0], UNIT, rtol=1e-12)
    data = read_modal_data(written(tmp_path, "frequency_Hz,frequency_std_Hz,a", "1.0,0.01,1", "3.0,0.06,1"))
    np.testing.assert_allclose(data.frequency_cv, [0.01, 0.02], rtol=1e-12)
    data = read_modal_data(written(tmp_path, "frequency_Hz,cv [%],a", "1.0,1,1", "3.0,2,1"))
    np.testing.assert_allclose(data.frequency_cv, [0.01, 0.02], rtol=1e-12)
    data = read_modal_data(written(tmp_path, "T [s],a,MAC,order", "1.0,1,0.98,8", "0.5,1,0.99,8"))
    assert data.description == "modes.csv, without MAC, order, frequencies from periods"
    data = read_modal_data(written(tmp_path, "f_Hz,T_C,a,MAC", "1.0,12,1,2", "2.0,12,1,3"), ["a", "MAC"])  # a sensor
    assert data.sensors == ("a", "MAC") and data.temperatures == [12.0] and data.description == "modes.csv"
    for head in ("period,a", "T,a"):
        with pytest.raises(ValueError, match="unit of the periods|expected a column of frequencies"):
            read_modal_data(written(tmp_path, head, "1.0,1"))


def test_frequencies_alone_and_parts_of_complex_shapes(tmp_path):
    data = read_modal_data(written(tmp_path, "mode,frequency_Hz,damping_%", "1,2.0,1.5", "2,5.0,2"))
    assert data.sensors == () and data.damping.tolist() == [[0.015, 0.02]]
    for head in ("f_Hz,a_re,a_im", "f_Hz,a mag,a phase", "f_Hz,a real,a imag"):
        with pytest.raises(ValueError, match="parts of complex shapes; make real ones"):
            read_modal_data(written(tmp_path, head, "2.0,1.0,0.1"))
    assert read_modal_data(written(tmp_path, "f_Hz,roof_re,base_re", "2.0,1.0,0.1")).sensors == ("roof_re", "base_re")


def test_units_are_stated_or_given(tmp_path):
    lines = ("6.283185307179586,1,2", "12.566370614359172,1,-1")
    for head, options in (("frequency [rad/s],a,b", {}), ("frequency,a,b", {"unit": "rad/s"})):
        data = read_modal_data(written(tmp_path, head, *lines), **options)
        np.testing.assert_allclose(data.frequencies, [[1.0, 2.0]], rtol=1e-15)
    for head, options, text in (
        ("frequency,a,b", {}, "unit='Hz' or unit='rad/s'"),
        ("frequency_Hz,a,b", {"unit": "rad/s"}, "states Hz"),
        ("omega,a,b", {}, "unit='Hz' or unit='rad/s'"),
        ("lambda,a,b", {}, "expected a column of frequencies"),
        ("frequency_Hz,a,b", {"sensors": ["c"]}, "the sensors are a, b"),
    ):
        with pytest.raises(ValueError, match=text):
            read_modal_data(written(tmp_path, head, *lines), **options)


def test_a_table_of_several_identifications(tmp_path):
    head = "set,mode,frequency_Hz,a,b"
    data = read_modal_data(written(tmp_path, head, "1,1,1.0,1,2", "1,2,3.0,1,-1", "2,2,3.1,1,-1", "2,1,1.1,-1,-2"))
    assert data.n_sets == 2 and data.frequencies.tolist() == [[1.0, 3.0], [1.1, 3.1]]
    missed = read_modal_data(written(tmp_path, head, "1,1,1.0,1,2", "1,2,3.0,1,-1", "2,2,3.1,1,-1"))
    assert np.isnan(missed.frequencies[1, 0]) and missed.has_shape.tolist() == [[True, True], [False, True]]
    with pytest.raises(ValueError, match="a column 'set'"):
        read_modal_data(written(tmp_path, "mode,frequency_Hz,a,b", "1,1.0,1,2", "1,1.1,1,2"))


def test_a_matlab_file(tmp_path):
    path = tmp_path / "modes.mat"
    savemat(path, {"f": [1.0, 3.0], "Phi": SHAPES.T, "xi": [0.01, 0.02]})
    names = {"frequencies": "f", "shapes": "Phi", "damping": "xi"}
    data = read_modal_data(path, ["a", "b", "c"], unit="Hz", variables=names)
    np.testing.assert_allclose(data.shapes[0], UNIT, rtol=1e-12)
    assert data.damping.tolist() == [[0.01, 0.02]] and data.frequencies.tolist() == [[1.0, 3.0]]
    for variables in ({}, {"frequencies": "fn"}, {"frequencies": "f", "modes": "Phi"}):
        with pytest.raises(ValueError, match="the file has f, Phi, xi"):
            read_modal_data(path, unit="Hz", variables=variables)
    savemat(path, {"f": [1.0, 3.0], "Phi": SHAPES})
    with pytest.raises(ValueError, match="2 modes in the columns of Phi; got the shape .2, 3.: transpose it"):
        read_modal_data(path, ["a", "b", "c"], unit="Hz", variables={"frequencies": "f", "shapes": "Phi"})


def test_a_result_of_an_identification():
    turned = SHAPES.T * np.exp([0.4j, -1.0j])
    result = SimpleNamespace(Fn=np.array([1.0, 3.0]), Phi=turned, Xi=[0.01, 0.02], Fn_std=np.array([0.01, 0.06]))
    result.Phi_std = 0.02 * np.linalg.norm(SHAPES, axis=1) * np.ones((3, 2))
    data = read_modal_data(result, ["a", "b", "c"])
    np.testing.assert_allclose(data.shape_error, 0.02, rtol=1e-12)
    np.testing.assert_allclose(np.abs((data.shapes[0] * UNIT).sum(axis=1)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(data.frequency_cv, [0.01, 0.02], rtol=1e-12)
    with pytest.warns(UserWarning, match=r"phases of complex mode shapes scatter by 29 degrees \(shape 1\)"):
        read_modal_data(SimpleNamespace(Fn=[1.0], Phi=np.exp(1j * np.array([[0.0], [1.0]]))), ["a", "b"])
    with pytest.raises(ValueError, match="choose them first"):
        read_modal_data(SimpleNamespace(Fn=None, Phi=None))
    with pytest.raises(ValueError, match="expected a path"):
        read_modal_data(7)


@pytest.mark.slow
def test_modes_that_pyoma2_identifies():
    """Ambient vibration of a chain of four masses: frequencies and shapes within the errors that pyOMA2 states."""
    pytest.importorskip("pyoma2")
    from pyoma2.algorithms import SSI
    from pyoma2.setup import SingleSetup

    rng, dt = np.random.default_rng(1), 0.02
    stiffness = 900.0 * (2.0 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1))
    stiffness[-1, -1] = 900.0
    squares, shapes = np.linalg.eigh(stiffness)
    omegas = np.sqrt(squares)
    modal = shapes.T @ rng.normal(size=(4, 30_000))
    motion = shapes @ [respond(force, dt, w, 0.01).displacement for force, w in zip(modal, omegas, strict=True)]
    setup, algorithm = SingleSetup(motion.T, fs=1.0 / dt), SSI(name="ssi", br=20, ordmax=20, calc_unc=True, nb=20)
    setup.add_algorithms(algorithm)
    setup.run_by_name("ssi")
    setup.mpe("ssi", sel_freq=(omegas / (2.0 * np.pi)).tolist(), order_in="find_min")
    data = read_modal_data(algorithm.result, ["a", "b", "c", "d"])
    errors = data.frequencies[0] / (omegas / (2.0 * np.pi)) - 1.0
    assert (np.abs(errors) < 5.0 * data.frequency_cv).all() and (data.frequency_cv < 0.01).all()
    assert (np.abs((data.shapes[0] * shapes.T).sum(axis=1)) > 1.0 - 50.0 * data.shape_error**2 - 1e-4).all()
    assert data.damping[0] == pytest.approx(0.01, rel=0.3)
