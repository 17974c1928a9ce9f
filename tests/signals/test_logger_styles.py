"""Styles of logger files: each is read right, or refused with a sentence that says what to do."""

import numpy as np
import pytest

from fe_likelihoods import Channel, read_columns
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.units import G0
from tests.signals.logger_styles import ACCELERATION, COLUMNS, READ, REFUSED, STEP

TOP = Channel("top", "acceleration", "g")


@pytest.mark.parametrize("style", READ)
def test_styles_that_are_read(tmp_path, style):
    path = tmp_path / "a.txt"
    path.write_text(READ[style], encoding="utf-8")
    column = COLUMNS.get(style)
    record = read_record(path, column=column)
    assert record.dt == pytest.approx(STEP, rel=1e-12)
    np.testing.assert_allclose(record.acceleration / G0, ACCELERATION, atol=6e-6)


@pytest.mark.parametrize("style", REFUSED)
def test_styles_that_are_refused(tmp_path, style):
    text, message = REFUSED[style]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_record(tmp_path / "a.txt", column=COLUMNS.get(style))


def test_a_unix_time_beside_an_elapsed_one(path):
    path.write_text("timestamp_ms,time_s,acc_g\n1715682727000,0.00,1\n1715682727020,0.02,2\n1715682727040,0.04,3\n")
    assert read_columns(path, (TOP,), ("acc_g",)).start == 0.0
    path.write_text("timestamp_ms,time_s,acc_g\n1715682727000,0.00,1\n1715682727020,0.02,2\n1715682727080,0.04,3\n")
    with pytest.raises(ValueError, match="got the columns 'time_s' and 'timestamp_ms' with different times"):
        read_columns(path, (TOP,), ("acc_g",))


@pytest.mark.parametrize(
    ("cell", "value"),
    [("1,234.5", 1234.5), ("-12,345,678", -12345678.0), ("1'234.5", 1234.5), ("1 234.5", 1234.5), ("1.5D+03", 1500.0)],
)
def test_numbers_of_other_countries_and_programs(tmp_path, cell, value):
    (tmp_path / "a.csv").write_text(f"time_s;acc [mm/s2]\n0.0;1\n0.1;{cell}\n")
    assert read_record(tmp_path / "a.csv").acceleration[1] == pytest.approx(1e-3 * value, rel=1e-12)


@pytest.mark.parametrize("name", ["Top [µm]", "Top (μm)", "top_um"])
def test_micrometres_in_names_and_labels(tmp_path, name):
    (tmp_path / "a.csv").write_text(f"time_s,{name}\n0.00,1\n0.01,-2500\n0.02,3\n", encoding="utf-8")
    found = read_columns(tmp_path / "a.csv", [Channel("top", "displacement", "µm")], [name])
    np.testing.assert_allclose(found.values, [[1e-6, -2.5e-3, 3e-6]], rtol=1e-15)


@pytest.mark.parametrize(
    "first", ["TT.MM.JJJJ hh:mm:ss", "dd/mm/yyyy HH:mm:ss.fff", "yyyy-mm-ddTHH:MM:SS", "-", "hh:mm:ss"]
)
def test_a_dash_or_a_date_format_in_a_line_of_units_says_nothing(tmp_path, first):
    path, rows = tmp_path / "a.csv", ["14.05.2024 10:32:07,000;0,5;1,25", "14.05.2024 10:32:07,020;0,25;-3,5"]
    path.write_text("\n".join(["Logger;Nr. 12;", "Zeit;Basis;Weg", f"{first};g;mm", *rows, ""]))
    found = read_columns(path, [TOP, Channel("d", "displacement", "mm")], ["Basis", "Weg"])
    np.testing.assert_allclose(found.values, [[0.5 * G0, 0.25 * G0], [1.25e-3, -3.5e-3]], rtol=1e-15)
    path.write_text("\n".join(["Zeit;Basis;Weg", f"{first};g;mm", "0,00;0,5;1,25", "0,02;0,25;-3,5", ""]))
    with pytest.raises(ValueError, match="the column 'Zeit' has no unit"):
        read_columns(path, [TOP], ["Basis"])
    assert read_columns(path, [TOP], ["Basis"], time_unit="s").dt == 0.02
    # names that are no units remain the header line
    path.write_text("\n".join(["Logger;Nr.;12", f"{first};Basis;Weg", "0,00;0,5;1,25", "0,02;0,25;-3,5", ""]))
    assert read_columns(path, [TOP], ["Basis"], "g", 0.02).values[0, 0] == 0.5 * G0


@pytest.mark.parametrize("mark", ["OL", "***", "#DIV/0!", "Inf"])
@pytest.mark.parametrize("place", [0, 1, 3])
def test_texts_for_missing_samples(tmp_path, mark, place):
    path, cells = tmp_path / "a.csv", ["1", "2", "-9999", "4"]
    cells[place] = mark
    path.write_text("Flag,time_s,acc_g,OL\n" + "".join(f"OL,{0.01 * k:.2f},{c},1\n" for k, c in enumerate(cells)))
    with pytest.raises(ValueError, match=f"line {place + 2}: expected a .*number, got .*; .* give missing=") as caught:
        read_columns(path, [TOP], ["acc_g"])
    assert str([mark]) in str(caught.value)
    with pytest.raises(ValueError, match=r"got -9999 in 1 rows, .*give missing=\['.*', -9999\]"):
        read_columns(path, [TOP], ["acc_g"], missing=[mark])
    expected = [np.nan if cell in (mark, "-9999") else float(cell) * G0 for cell in cells]
    found = read_columns(path, [TOP], ["acc_g"], missing=[mark, -9999])
    np.testing.assert_array_equal(found.values, [expected])
    assert read_record(path, column="OL", units="g", missing=mark).n_steps == 4
    with pytest.raises(ValueError, match="an excitation needs all samples, 2 are missing"):
        read_record(path, column="acc_g", missing=[mark, -9999])


@pytest.mark.parametrize("missing", [["9999"], ["1,5"], [" "], [None], ["10:32:07"]])
def test_texts_that_stand_for_no_missing_sample_are_refused(tmp_path, missing):
    (tmp_path / "a.csv").write_text("time_s,acc_g\n0.00,1\n0.01,2\n")
    with pytest.raises(ValueError, match="missing: expected finite numbers and texts"):
        read_record(tmp_path / "a.csv", missing=missing)


@pytest.mark.parametrize("line", ["time_s,acc_g", "0.02,1x", "end,end"])
def test_a_second_header_line_and_a_damaged_number_are_no_missing_samples(tmp_path, line):
    (tmp_path / "a.csv").write_text(f"time_s,acc_g\n0.00,1\n0.01,2\n{line}\n0.03,2\n")
    with pytest.raises(ValueError, match="line 4: expected a number, got '[^']*'($|; cut off the line,)"):
        read_record(tmp_path / "a.csv")


def test_a_first_sample_that_is_a_mark_is_no_header_line(tmp_path):
    (tmp_path / "a.csv").write_text("acc_g\nOL\n1\n2\n")
    found = read_columns(tmp_path / "a.csv", [TOP], ["acc_g"], dt=0.01, missing=["OL"])
    np.testing.assert_array_equal(found.values, [[np.nan, G0, 2 * G0]])


@pytest.mark.parametrize("footer", ["Max;;17,2", "Max;17,2;;", "Exported 06.07.2019;;", ";;17,2", "Mittel"])
def test_a_line_below_the_samples_is_to_be_cut_and_no_missing_sample(path, footer):
    rows = [f"{0.01 * k:.2f};{0.5 * k:.1f};{17.2 - k:.1f}".replace(".", ",") for k in range(9)]
    path.write_text("\n".join(["Logger;Nr. 12;", "Zeit [s];Weg [mm];Kraft [kN]", *rows, footer, ""]))
    with pytest.raises(
        ValueError, match="line 12: expected .*; .*cut off the line, and all lines below it, if it is no row"
    ) as caught:
        read_columns(path, [Channel("F", "force", "kN")], ["Kraft [kN]"])
    assert "missing=" not in str(caught.value)
    path.write_text(path.read_text().replace(f"{footer}\n", ""))
    assert read_columns(path, [Channel("F", "force", "kN")], ["Kraft [kN]"]).values[0, 0] == 17200.0
