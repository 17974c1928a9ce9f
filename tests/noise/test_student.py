"""Student-t errors: density, missing samples, an outlier, a guide, and what is refused."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import Channel, FELikelihood, Posterior, Uniform
from fe_likelihoods.modal.load_cases import LoadTest
from fe_likelihoods.noise.student import StudentNoise

CHANNELS = Channel("a", "displacement", "mm"), Channel("b", "strain", "1")
UNIT = np.outer([1.0, 2.0], np.arange(1.0, 9.0))


def likelihood(values, **options):
    test = LoadTest(CHANNELS, [f"case {k}" for k in range(8)], values)
    return FELikelihood(test.model(lambda theta: theta[0] * UNIT, ("x",)), test.measurements, StudentNoise(CHANNELS))


def test_the_density_is_that_of_scipy(rng):
    values = 1.1 * UNIT + rng.normal(size=UNIT.shape)
    values[1, 3] = np.nan
    found = likelihood(values)([1.0, 0.3, 0.7])
    logs = stats.t.logpdf(values - UNIT, 4.0, scale=[[0.3], [0.7]])
    assert found == pytest.approx(np.nansum(logs), rel=1e-12)
    assert likelihood(values)([1.0, 0.0, 0.7]) == likelihood(values)([1.0, 0.3, -0.7]) == -np.inf
    deviations = StudentNoise(CHANNELS, 6.0).standard_deviations(np.array([[0.3, 0.7]]))
    np.testing.assert_allclose(deviations[0], stats.t.std(6.0, scale=[0.3, 0.7]))


def test_one_simulation_serves_every_scale(rng):
    each = likelihood(1.1 * UNIT)
    values = each(np.column_stack([np.ones(20), rng.uniform(0.1, 1.0, (20, 2))]))
    assert each.simulations == 1 and len(set(values)) == 20


def test_an_outlier_moves_the_parameter_little(rng):
    """Means and standard deviations of Gaussian and Student-t errors by quadrature."""
    values = UNIT + 0.05 * rng.normal(size=UNIT.shape)
    values[0, 7] += 4.0  # half of the value
    known = {"sigma_a": 0.05, "sigma_b": 0.05}
    found = {}
    for name, noise in (("gaussian", None), ("student", StudentNoise(CHANNELS))):
        test = LoadTest(CHANNELS, [f"case {k}" for k in range(8)], values)
        model = test.model(lambda theta: theta[0] * UNIT, ("x",))
        posterior = Posterior(FELikelihood(model, test.measurements, noise), {"x": Uniform(0.5, 1.5)} | known)
        x = np.linspace(0.95, 1.2, 1001)
        density = np.exp(posterior(x[:, None]) - posterior(x[:, None]).max())
        mean = (x * density).sum() / density.sum()
        found[name] = mean, np.sqrt((np.square(x - mean) * density).sum() / density.sum())
    assert abs(found["gaussian"][0] - 1.0) > 5.0 * found["gaussian"][1]
    assert abs(found["student"][0] - 1.0) < 3.0 * found["student"][1]


@pytest.mark.parametrize("degrees", [2.0, -1.0, "four", True])
def test_degrees_are_checked(degrees):
    with pytest.raises(ValueError, match="degrees of freedom above 2"):
        StudentNoise(CHANNELS, degrees)
