r"""Student-t errors, which outliers of a few values move little.

With the scale :math:`\sigma` of a channel and :math:`\nu` degrees of freedom, each error e is independent with

.. math:: \log p(e) = \log \frac{\Gamma((\nu + 1) / 2)}{\Gamma(\nu / 2) \sqrt{\nu \pi} \sigma}
   - \frac{\nu + 1}{2} \log \left(1 + \frac{e^2}{\nu \sigma^2}\right) .

References
----------
K. L. Lange, R. J. A. Little, J. M. G. Taylor, Robust statistical modeling using the t distribution, Journal of the
American Statistical Association 84(408), 1989, 881-896, doi:10.1080/01621459.1989.10478852.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from ..signals.channels import Channel
from .option_checks import checked_channels
from .sufficient_statistics import SampleCounts, samples_per_channel


def student_constant(degrees: float, dimensions: np.ndarray | float = 1.0) -> np.ndarray | float:
    """Logarithm of the density of a Student t distribution of a scale of 1 at its centre, in some dimensions."""
    half = 0.5 * (degrees + np.asarray(dimensions))
    return gammaln(half) - gammaln(0.5 * degrees) - 0.5 * np.asarray(dimensions) * np.log(degrees * np.pi)


def check_degrees(where: str, degrees: float) -> float:
    """The degrees of freedom; ValueError if they are not above 2, where the variance is finite."""
    if isinstance(degrees, bool) or not isinstance(degrees, int | float | np.number) or not degrees > 2.0:
        raise ValueError(f"{where}: expected degrees of freedom above 2, such as 4; got {degrees!r}")
    return float(degrees)


def each_square(residuals: np.ndarray) -> np.ndarray:
    """Statistic: sums of squares (n_channels,) of residuals (n_channels, n_samples), then each square, 0 if missing."""
    squares = np.square(np.nan_to_num(residuals))
    return np.concatenate([squares.sum(axis=1), squares.ravel()])


@dataclass(frozen=True)
class StudentNoise:
    """Independent Student-t errors with one scale ``sigma_<channel>`` per channel, for load tests with outliers.

    All squares are cached instead of their sum, so it is for data of few samples.

    Parameters
    ----------
    channels : sequence of Channel
        The channels.
    degrees : float
        Degrees of freedom, above 2. With 4, an error of five scales counts as one of about 2.5 in Gaussian noise.

    Raises
    ------
    ValueError
        If the degrees are not above 2.

    Examples
    --------
    >>> from fe_likelihoods.noise.student import StudentNoise
    >>> likelihood = FELikelihood(model, measurements, StudentNoise(model.channels))
    """

    channels: Sequence[Channel]
    degrees: float = 4.0
    statistic = staticmethod(each_square)
    shares_of = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", checked_channels(self, self.channels))
        object.__setattr__(self, "degrees", check_degrees("StudentNoise", self.degrees))

    @property
    def title(self) -> str:
        """Name for reports."""
        return f"Student-t noise with {self.degrees:g} degrees of freedom"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>``: scales of the errors [SI]."""
        return tuple(f"sigma_{channel.name}" for channel in self.channels)

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,) for statistics (n, n_channels + n_values) at scales (n, n_channels), or -inf."""
        n_channels, nu = len(self.channels), self.degrees
        counts = samples_per_channel(n_samples) * np.ones(n_channels)
        scales = np.where(parameters > 0.0, parameters, np.nan)
        squares = statistics[:, n_channels:].reshape(len(statistics), n_channels, -1)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            logs = np.log1p(squares / (nu * np.square(scales)[:, :, None])).sum(axis=2)
            total = (counts * (student_constant(nu) - np.log(scales)) - 0.5 * (nu + 1.0) * logs).sum(axis=1)
        return np.where(np.isnan(total) | (total == np.inf), -np.inf, total)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) of the errors [SI]."""
        return np.asarray(parameters, dtype=float) * np.sqrt(self.degrees / (self.degrees - 2.0))
