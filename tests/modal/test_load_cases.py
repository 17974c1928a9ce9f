"""Static load tests: known errors, missing values, and the conjugate posterior of a linear flexibility."""

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, Posterior, Uniform, propagate, to_si
from fe_likelihoods.modal.load_cases import LoadTest, read_load_test

CHANNELS = Channel("midspan", "displacement", "mm"), Channel("bottom", "strain", "microstrain")
CASES = ("one truck", "two trucks", "four trucks")
UNIT = np.array([[0.001, 0.002, 0.004], [2e-5, 4e-5, 8e-5]])  # for a flexibility of one
VALUES = 1.1 * UNIT + np.array([[1e-5, -1e-5, 0.0], [0.0, 1e-6, np.nan]])


def test_the_posterior_of_a_flexibility_is_normal():
    test = LoadTest(CHANNELS, CASES, VALUES, errors={"midspan": 2e-5, "bottom": 1e-6})
    model = test.model(lambda theta: theta[0] * UNIT, ("flexibility",))
    posterior = Posterior(FELikelihood(model, test.measurements), {"flexibility": Uniform(0.5, 2.0)} | test.known)
    assert posterior.parameter_names == ["flexibility"] and test.measurements.points == CASES
    assert not posterior.likelihood.first_parts([0.1])  # load cases have no order
    weights = UNIT / np.array([[2e-5], [1e-6]])
    weights[1, 2] = 0.0
    precision = np.square(weights).sum()
    mean = (weights * np.nan_to_num(VALUES) / np.array([[2e-5], [1e-6]])).sum() / precision
    x = mean + np.array([0.0, 1.0, -2.0]) / np.sqrt(precision)
    logs = posterior(x[:, None])
    np.testing.assert_allclose(logs - logs[0], [0.0, -0.5, -2.0], atol=1e-9)
    printed = str(propagate(posterior, x[:, None], progress=False))
    assert "Prediction along 'load case'" in printed and "four trucks" in printed and "[s]" not in printed


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((CHANNELS, CASES[:2], VALUES), "each of 3 samples"),
        ((CHANNELS, ("a", "a", "b"), VALUES), "different names of load cases"),
        ((CHANNELS, CASES, to_si(1.0, "mm")), "one row per channel"),
        ((CHANNELS, CASES, VALUES, {"top": 1.0}), "standard deviations .* of midspan, bottom; got .*top"),
        ((CHANNELS, CASES, VALUES, {"midspan": 0.0}), "'midspan': 0.0"),
    ],
)
def test_bad_tests_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        LoadTest(*arguments[:3], errors=arguments[3] if len(arguments) > 3 else None)


def test_a_file_has_a_line_for_each_load_case(tmp_path):
    path = tmp_path / "trucks.csv"
    path.write_text("load case,midspan [mm],gauge\none truck,1.1,22\ntwo trucks,2.2,44\n")
    options = {"columns": {"bottom": "gauge"}, "units": {"bottom": "microstrain"}, "errors": {"midspan": 1e-4}}
    test = read_load_test(path, CHANNELS, **options)
    assert test.cases == ("one truck", "two trucks") and test.axis == "load case" and test.errors == {"midspan": 1e-4}
    np.testing.assert_allclose(test.values, [[1.1e-3, 2.2e-3], [22e-6, 44e-6]], rtol=1e-12)
    path.write_text("truck at [m];midspan [mm]\n7,5;1,1\n15;2,2\n")
    test = read_load_test(path, CHANNELS[:1])
    assert test.cases == (7.5, 15.0) and test.measurements.axis == "truck at [m]"
    for names in (("1 truck", "2 trucks"), ("100 kN", "200 kN"), ("LC 1", "2"), ("1a", "1")):
        path.write_text("case,midspan [mm]\n" + "".join(f"{name},1.1\n" for name in names))
        assert (
            read_load_test(path, CHANNELS[:1]).cases == names == read_load_test(path, CHANNELS[:1], cases="case").cases
        )
    path.write_text("case,midspan_mm\nA,1.1\nB,\nC,3.3\nD,\n")
    test = read_load_test(path, CHANNELS[:1])
    assert test.cases == ("A", "B", "C", "D")
    np.testing.assert_allclose(test.values, [[1.1e-3, np.nan, 3.3e-3, np.nan]], rtol=1e-12)
    path.write_text("midspan [mm]\n1.1\n1 mm\n")
    with pytest.raises(ValueError, match="expected one column of values named 'midspan .mm.'"):
        read_load_test(path, CHANNELS[:1])
    path.write_text("midspan [mm]\n1.1\n2.2\n")
    assert read_load_test(path, CHANNELS[:1]).cases == ("1", "2")
    for options, text in (
        ({"columns": {"midspan": "top"}}, "one column of values named 'top', the columns are midspan"),
        ({"units": {"midspan": "m"}}, "states the unit .mm. but units = .m. was given"),
        ({"cases": "truck"}, "no column 'truck' of load cases"),
    ):
        with pytest.raises(ValueError, match=text):
            read_load_test(path, CHANNELS[:1], **options)
