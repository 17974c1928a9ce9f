"""Modal data from tables, MATLAB files and results of pyOMA2."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import savemat

from fe_likelihoods import read_modal_data
from fe_likelihoods.signals.response_spectrum import respond

SHAPES = np.array([[1.0, 2.0, 3.0], [-2.0, -1.0, 2.0]])
NO_SENSORS = "T,Periode,T_air,complexity,quality,sigma_f,cov,MPC,modal mass,Dekrement,zeta %".split(",")
TEMPERATURES = "Lufttemperatur,T_air,temperature_F,T (F),Temp C,Tmean_C,steel temperature,zeta1,remark".split(",")
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


@pytest.mark.parametrize(
    "lines",
    [
        ("Mode No.;Natural frequency [Hz];a;b;c", "1;1,0;1;2;3", "2;3,0;-2;-1;2"),
        ("f [Hz],T (°C),a,b,c", "1,20,1,2,3", "3,20,-2,-1,2"),
        ("Mode;Frequenz [Hz];Dämpfung [%];Temperatur [°C];a;b;c", "1;1,0;1;20;1;2;3", "2;3,0;1;20;-2;-1;2"),
        ("Eigenfrequenz_Hz,a,b,c", "1,1,2,3", "3,-2,-1,2"),
        ("Fréquence (Hz),a,b,c", "1,1,2,3", "3,-2,-1,2"),
        ("mode,f [Hz],a,b,c,remark", "1,1,1,2,3,good", "2,3,-2,-1,2,poor"),
        ("Mode,omega [rad/s],zeta [%],a,b,c", "1,6.283185307179586,1,1,2,3", "2,18.84955592153876,1,-2,-1,2"),
        ("time,f [Hz],a,b,c", "2021-01-01 08:00,1,1,2,3", "2021-01-01 08:00,3,-2,-1,2"),
        (",Mode number,f [Hz],a,b,c", "first,1,1,1,2,3", "second,2,3,-2,-1,2"),  # names of the rows
        ("Modennummer;f [Hz];a;b;c", "1;1,0;1;2;3", "2;3,0;-2;-1;2"),
    ],
)
def test_other_layouts_of_a_table(lines, tmp_path):
    """Semicolons with decimal commas, short names, temperatures, remarks, and angular frequencies."""
    data = read_modal_data(written(tmp_path, *lines))
    assert data.mode_numbers == (1, 2) and data.sensors == ("a", "b", "c")
    np.testing.assert_allclose(data.frequencies, [[1.0, 3.0]], rtol=1e-12)
    np.testing.assert_allclose(data.shapes[0], UNIT, rtol=1e-12)
    assert data.temperatures is None or data.temperatures == [20.0]


def test_errors_and_what_is_no_sensor(tmp_path):
    for head, rows in (
        ("frequency_Hz,frequency_std_Hz,a", ("1.0,0.01,1", "3.0,0.06,1")),
        ("f_Hz,f_std [rad/s],a", ("1.0,0.06283185307,1", "3.0,0.3769911184,1")),
    ):
        data = read_modal_data(written(tmp_path, head, *rows))
        np.testing.assert_allclose(data.frequency_cv, [0.01, 0.02], rtol=1e-9)
        assert data.sensors == ("a",)
    data = read_modal_data(written(tmp_path, "f_Hz,T_C,a,MAC", "1.0,12,1,2", "2.0,12,1,3"), ["a", "MAC"])  # a sensor
    assert data.sensors == ("a", "MAC") and data.temperatures == [12.0]
    data = read_modal_data(written(tmp_path, "f_Hz,T,B", "1.0,1,2"), ["T", "B"])  # top and bottom
    assert data.sensors == ("T", "B") and data.temperatures is None
    data = read_modal_data(written(tmp_path, "frequency_Hz,frequency_std,f1,f2", "1.0,0.01,1,2"))  # floors
    assert data.sensors == ("f1", "f2") and data.frequency_cv == pytest.approx([0.01])
    data = read_modal_data(written(tmp_path, "mode,frequency_Hz,damping_%", "1,2.0,1.5", "2,5.0,2"))
    assert data.sensors == () and data.damping.tolist() == [[0.015, 0.02]]


@pytest.mark.parametrize(
    ("head", "row", "text"),
    [
        ("period_s,a", "1.0,1", "expected one column of frequencies"),
        ("T [s],f_Hz,a", "1.0,1,1", "other units"),
        ("f_Hz,T [K],a", "1.0,293,1", "other units"),
        ("f_Hz,temperature [K],a", "1.0,293,1", "subtract 273.15"),
        ("f_Hz,a_re,a_im", "2.0,1.0,0.1", "may be no components of real shapes"),
        ("f_Hz,Re(a),Im(a)", "2.0,1.0,0.1", "may be no components of real shapes"),
        ("f_Hz,a,MAC [%]", "2.0,1.0,0.1", "give those that are sensors"),
        ("f_Hz,|a|,<a,|b|,<b", "2.0,1.0,3,0.1,181", "give those that are sensors"),
        ("f_Hz,a", "2.0,0.5+0.1i", "expected a number"),
        ("mode,f_Hz,a", "first bending,2.0,0.5", "whole numbers in the column of modes"),
        ("frequency_Hz,omega_rad/s,a", "1.0,6.3,1", "one column of frequencies"),
        ("f_Hz,error_Hz,a", "1.0,0.1,1", "other units"),
        ("Ordnung,f_Hz,a", "12,1.0,1", "give those that are sensors"),  # of the mode, or of the identified system
        *((f"f_Hz,a,{name}", "1.0,1,1", "give those that are sensors") for name in NO_SENSORS),
        ("f_Hz,fd_Hz", "1.0,0.99", "give those that are sensors"),
        ("mode,f_Hz,x,y,x,y", "1,1.0,1,2,3,4", "different names, got the columns mode, f_Hz, x, y, x, y"),
        *((f"{name},f_Hz", "1,1.0\n2,1.1", "several identifications need") for name in ("Tag", "day", "Versuch")),
        *((f"{name},f_Hz", "2021-01-01,1.0\n2021-01-02,1.1", "several identifications") for name in ("logged", "Zeit")),
        ("state,f_Hz", "sound,1.0\ndamaged,1.1", r"a column 'mode' beside text, got \['state'\]; write"),
        ("mode,f1_Hz,f2_Hz", "1,2.9,2.91\n2,7.8,7.81", "got mode; rename or delete"),
        ("mode,Frequenz 1 [Hz],a,b", "1,2.9,1,2", "got a, b, mode; rename or delete"),
        *((f"date,{name},f1_Hz", "2021-01-01,14,2.1", f"got {re.escape(name)}; rename") for name in TEMPERATURES),
        ("set,mode,f_Hz", "1,1,2.9\n,2,7.8", "in each line of 'set', got ''; write"),
        ("date,f1_Hz", "2021-01-01,2.9\nMean,2.9", "in each line of 'date', got 'Mean'; write"),
        ("date,f1_Hz,f2_Hz", "2021-01-01,2.1,9999\n2021-01-02,2.1,6.2", "9999 in 1 rows, which usually stands for a"),
        ("f_Hz,a,b", "2.1,1,-999\n6.2,1,-1", "-999 in 1 rows, which usually stands for a"),
        ("f_Hz,Dämpfung", "2.1,0.01", "expected a unit of damping, got 'Dämpfung'; state it"),
        ("omega [Hz]", "2.1", "omega in rad/s, got Hz; correct"),
        ("mode,f_Hz", "2,1.0\n1,2.0", r"of the modes \[1, 2\]"),
    ],
)
def test_columns_that_are_no_modes_are_refused(head, row, text, tmp_path):
    with pytest.raises(ValueError, match=text):
        read_modal_data(written(tmp_path, head, row))


def test_units_are_stated_or_given(tmp_path):
    lines = ("6.283185307179586,1,2", "12.566370614359172,1,-1")
    for head, options in (("frequency [rad/s],a,b", {}), ("frequency,a,b", {"unit": "rad/s"})):
        data = read_modal_data(written(tmp_path, head, *lines), **options)
        np.testing.assert_allclose(data.frequencies, [[1.0, 2.0]], rtol=1e-15)
    for head, options, text in (
        ("frequency,a,b", {}, "does not state the unit of its frequency: give unit="),
        ("frequency_Hz,a,b", {"unit": "rad/s"}, "states the unit 'Hz'"),
        ("omega,a,b", {}, "does not state the unit of its frequency: give unit="),
        ("omega,a,b", {"unit": "Hz"}, "omega in rad/s, got Hz; correct"),
        ("lambda,a,b", {}, "expected one column of frequencies"),
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
    for head, stamp in (
        ("timestamp", "2021-01-01 {:02}:00"),
        ("Zeit", "01.01.2021 {:02}:00"),
        ("date,time", "2021-01-01,{:02}:00:00"),
        ("Datensatz,time", "{},2021-01-01 08:00"),
    ):
        lines = f"{stamp},1,1.0,1,2", f"{stamp},2,3.0,1,-1"
        rows = [line.format(hour) for hour in (9, 10, 11) for line in lines]
        data = read_modal_data(written(tmp_path, f"{head},mode,frequency_Hz,a,b", *rows[:-1]))
        assert data.sensors == ("a", "b") and data.frequencies[:2].tolist() == [[1.0, 3.0], [1.0, 3.0]]
        assert np.isnan(data.frequencies[2, 1])  # missed at 11:00
    with pytest.raises(ValueError, match="a column 'set'"):
        read_modal_data(written(tmp_path, "mode,frequency_Hz,a,b", "1,1.0,1,2", "1,1.1,1,2"))
    lines = "1,1.0,1,2", "1,3.0,1,-1", "2,3.1,1,-1"  # the second identification has missed mode 1
    with pytest.raises(ValueError, match="a column 'mode', because one of them may miss a mode"):
        read_modal_data(written(tmp_path, "set,frequency_Hz,a,b", *lines))


def test_a_table_of_days(tmp_path):
    """A line for each day, with a date and the temperature, and a column or a line for each mode."""
    days = "date,temperature_C,f1_Hz,f3_Hz", "2021-01-02,5,1.0,3.0", "2021-02-01,12,0.99,"
    modes = "date,mode,f_Hz,T_C", "2021-01-02,1,1.0,5", "2021-01-02,3,3.0,5", "2021-02-01,1,0.99,12"
    german = "Datum;Temperatur [°C];f1 [Hz];f3 [Hz]", "02.01.2021;5;1,00;3,00", "01.02.2021;12;0,99;"
    minutes = "time,temperature_C,f1_Hz,f3_Hz", "2021-01-02 08:00,5,1.0,3.0", "2021-02-01 09:30,12,0.99,"
    for lines in (days, modes, german, minutes):
        data = read_modal_data(written(tmp_path, *lines))
        np.testing.assert_array_equal(data.frequencies, [[1.0, 3.0], [0.99, np.nan]])
        assert data.temperatures.tolist() == [5.0, 12.0] and data.mode_numbers == (1, 3)
    with pytest.raises(ValueError, match="one temperature for each identification"):
        read_modal_data(written(tmp_path, *modes, "2021-02-01,3,2.97,13"))


def test_a_matlab_file(tmp_path):
    path = tmp_path / "modes.mat"
    savemat(path, {"f": [1.0, 3.0], "Phi": SHAPES.T, "xi": [0.01, 0.02]})
    names = {"frequencies": "f", "shapes": "Phi"}
    data = read_modal_data(path, ["a", "b", "c"], unit="Hz", variables=names, damping=[0.01, 0.02])
    np.testing.assert_allclose(data.shapes[0], UNIT, rtol=1e-12)
    assert data.damping.tolist() == [[0.01, 0.02]] and data.frequencies.tolist() == [[1.0, 3.0]]
    for variables in (
        {},
        {"frequencies": "fn"},
        {"frequencies": "f", "modes": "Phi"},
        {"frequencies": "f", "damping": "xi"},
    ):
        with pytest.raises(ValueError, match="the file has f, Phi, xi"):
            read_modal_data(path, unit="Hz", variables=variables)
    for bad, text in (
        (
            [[1.0, 1.1, 1.2], [3.0, 3.1, 3.2]],
            r"expected frequencies of one identification.* got an array of shape \(2, 3",
        ),
        ([1.0 + 0.1j, 3.0], "the variable 'f' is complex numbers"),
        ({"f": 1.0}, "the variable 'f' is a struct"),
        ("1.0", "the variable 'f' is text"),
    ):
        savemat(path, {"f": bad})
        with pytest.raises(ValueError, match=text):
            read_modal_data(path, unit="Hz", variables={"frequencies": "f"})
    savemat(path, {"f": [1.0, 3.0], "Phi": SHAPES})
    with pytest.raises(ValueError, match="transpose them"):
        read_modal_data(path, ["a", "b", "c"], unit="Hz", variables={"frequencies": "f", "shapes": "Phi"})


def test_a_result_of_an_identification():
    turned = SHAPES.T * np.exp([0.4j, -1.0j])
    result = SimpleNamespace(Fn=np.array([1.0, 3.0]), Phi=turned, Xi=[0.01, 0.02], Fn_std=np.array([0.01, 0.06]))
    data = read_modal_data(SimpleNamespace(result=result), ["a", "b", "c"])  # an algorithm
    np.testing.assert_allclose(np.abs((data.shapes[0] * UNIT).sum(axis=1)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(data.frequency_cv, [0.01, 0.02], rtol=1e-12)
    for nothing in (None, np.array([])):
        with pytest.raises(ValueError, match="choose them first"):
            read_modal_data(SimpleNamespace(Fn=nothing, Phi=nothing))
    with pytest.raises(ValueError, match="states the unit 'Hz' but units = 'rad/s'"):
        read_modal_data(result, ["a", "b", "c"], unit="rad/s")
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
    data = read_modal_data(algorithm, ["a", "b", "c", "d"])
    errors = data.frequencies[0] / (omegas / (2.0 * np.pi)) - 1.0
    assert (np.abs(errors) < 5.0 * data.frequency_cv).all() and (data.frequency_cv < 0.01).all()
    assert (np.abs((data.shapes[0] * shapes.T).sum(axis=1)) > 1.0 - 1e-4).all()
    assert data.damping[0] == pytest.approx(0.01, rel=0.3)
