r"""Errors of natural frequencies and mode shapes.

With the coefficient of variation c of a frequency and the standard deviation :math:`\sigma` of a component of a shape
with a norm of 1, the log-likelihood of one identified mode at n sensors is

.. math::

    \log L = -\log(c \sqrt{2 \pi}) - \frac{(f / \hat f - 1)^2}{2 c^2}
    - (n - k) \log(\sigma \sqrt{2 \pi}) - \frac{1 - \mathrm{MAC}}{2 \sigma^2} .

The shape has n - k degrees of freedom, because the scale (k = 1), or the place in a plane of k close modes, is fitted.
The variance of each error is the known variance plus the variance of the unknown error. Where none is known, it is
1e-4 squared for frequencies, and 1e-3 squared for shapes, because digits and temperature leave no identification more
exact: a few frequencies that the parameters can fit exactly would give a spike of any height to an error of zero.

With Student-t errors of :math:`\nu` degrees of freedom, c and :math:`\sigma` are scales, and the exponentials are
:math:`(1 + e^2 / \nu c^2)^{-(\nu + 1) / 2}`, and :math:`(1 + (1 - \mathrm{MAC}) / \nu \sigma^2)^{-(\nu + n - k) / 2}`
for all components of a shape together: one wrong identification moves the parameters little.

References
----------
M. W. Vanik, J. L. Beck, S. K. Au, Bayesian probabilistic approach to structural health monitoring, Journal of
Engineering Mechanics 126(7), 2000, 738-745, doi:10.1061/(ASCE)0733-9399(2000)126:7(738).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..noise.gaussian import HALF_LOG_TWO_PI
from ..noise.student import check_degrees, student_constant
from ..signals.channels import Channel

__all__ = ["ModalNoise", "ModeSums", "modal_noise"]


LEAST_FREQUENCY_ERROR, LEAST_SHAPE_ERROR = 1e-4, 1e-3  # of an identification, known where no error is stated


@dataclass(frozen=True)
class ModeSums:
    """Statistic of residuals: the sum of squares of each mode, then the squares of each frequency and of each shape."""

    n_sets: int

    def __call__(self, residuals: np.ndarray) -> np.ndarray:
        """Sums (m + 2 m n_sets,) for residuals (m, n_sets (1 + n_sensors))."""
        squares = np.square(residuals).reshape(len(residuals), self.n_sets, -1)
        frequencies, shapes = squares[:, :, 0], squares[:, :, 1:].sum(axis=2)
        return np.concatenate([(frequencies + shapes).sum(axis=1), frequencies.ravel(), shapes.ravel()])


@dataclass(frozen=True)
class ModalNoise:
    """Errors of m modes, with a `Noise`'s members: known errors, unknown ones, or both.

    Frequencies have the known errors `frequency_known` (m,), shapes `shape_known` (m,), zero if none is known.
    `frequency` and `shape` say what is unknown: ``"common"`` for one error of all modes, ``"mode"`` for one each, or an
    empty text for none. `counts` and `freedoms` (m n_sets,) are the numbers of frequencies, 0 or 1, and of degrees of
    freedom of the shapes, of the sets of the first mode, of the second one, and so on. `student` are the degrees of
    freedom of Student-t errors, 0 for Gaussian ones.
    """

    channels: tuple[Channel, ...]
    n_sets: int
    n_sensors: int
    counts: tuple[int, ...]
    freedoms: tuple[int, ...]
    frequency_known: tuple[float, ...]
    shape_known: tuple[float, ...]
    frequency: str
    shape: str
    student: float = 0.0
    level = "si"  # the errors do not depend on the response

    @property
    def title(self) -> str:
        """Name for reports."""
        text = "errors of natural frequencies and mode shapes"
        return f"{text}, Student-t with {self.student:g} degrees of freedom" if self.student else text

    @property
    def statistic(self) -> ModeSums:
        """What the likelihood needs of a simulation."""
        return ModeSums(self.n_sets)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency_error`` and ``shape_error``, or one of each per mode, ``frequency_error_2``."""
        numbers = [channel.name.split()[-1] for channel in self.channels]
        kinds = {"": [], "common": [""], "mode": [f"_{number}" for number in numbers]}
        return tuple(f"{what}_error{end}" for what in ("frequency", "shape") for end in kinds[getattr(self, what)])

    def deviations(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations of frequencies and of components of shapes, (n, m) each, at parameters (n, n_noise)."""
        m, parameters = len(self.channels), np.asarray(parameters, dtype=float)
        # an unknown error that is not positive is impossible, also beside a known one
        variances = np.square(np.where(parameters > 0.0, parameters, np.nan))
        split = {"": 0, "common": 1, "mode": m}[self.frequency]
        found = []
        for known, unknown, least in (
            (self.frequency_known, variances[:, :split], LEAST_FREQUENCY_ERROR),
            (self.shape_known, variances[:, split:], LEAST_SHAPE_ERROR),
        ):
            floor = np.where(np.array(known) > 0.0, 0.0, least)
            more = unknown if unknown.shape[1] else np.zeros((len(parameters), m))
            found.append(np.sqrt(np.square(known) + np.square(floor) + more))
        return found[0], found[1]

    def log_likelihood(self, statistics: np.ndarray, n_samples: Any, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) for the statistics (n, m + 2 m n_sets); -inf for impossible errors."""
        total, sums = np.zeros(len(statistics)), np.split(statistics[:, len(self.channels) :], 2, axis=1)
        kinds = zip(self.deviations(parameters), sums, (self.counts, self.freedoms), strict=True)
        for deviations, squares, counts in kinds:
            used = np.flatnonzero(counts)
            d, spread = np.array(counts)[used], np.repeat(deviations, self.n_sets, axis=1)[:, used]
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                ratios = squares[:, used] / np.square(spread)
                if self.student:
                    logs = 0.5 * (self.student + d) * np.log1p(ratios / self.student)
                    logs -= student_constant(self.student, d)
                else:
                    logs = 0.5 * ratios + d * HALF_LOG_TWO_PI
                total -= (d * np.log(spread) + logs).sum(axis=1)
        return np.where(np.isnan(total) | (total == math.inf), -np.inf, total)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, m) of the frequencies, as shares."""
        return self.deviations(parameters)[0]

    def response_deviations(self, parameters: np.ndarray, response: np.ndarray, dt: Any = None) -> np.ndarray:
        """Standard deviations of all samples (m, n_sets (1 + n_sensors)); zero where nothing was measured."""
        frequency, shape = (each[0][:, None] for each in self.deviations(np.atleast_2d(parameters)))
        one = np.hstack([frequency, np.repeat(shape, self.n_sensors, axis=1)])
        return np.tile(one, self.n_sets) * (np.asarray(response) != 0.0)


def modal_noise(
    paired: Any, frequency_error: str | None, shape_error: str | None, student_t: float | None
) -> ModalNoise:
    """The errors of `PairedModes`, from what their data and the arguments of a `ModalLikelihood` say."""
    data, m = paired.data, paired.data.n_modes
    if data.covariance is not None and (frequency_error is not None or student_t is not None):
        raise ValueError(
            "ModalLikelihood: beside a covariance of the frequencies, neither an unknown frequency_error nor student_t "
            "is possible: leave it out, or give the data frequency_cv and no covariance"
        )
    known, unknown = {}, {"frequency": frequency_error, "shape": shape_error}
    for what, stated in (("frequency", paired.frequency_cv), ("shape", data.shape_error)):
        known[what] = (0.0,) * m if stated is None else tuple(stated.tolist())
        if unknown[what] is None:
            unknown[what] = "common" if stated is None else ""
        if unknown[what] not in ("", "common", "mode"):
            raise ValueError(
                f'ModalLikelihood: {what}_error must be "common" or "mode"; got {unknown[what]!r}: known errors belong '
                "to the data (frequency_cv, shape_error), or are numbers in the mapping of priors"
            )
    sizes = {mode: len(group) for group in paired.groups for mode in group}
    fitted = np.array([sizes[mode] for mode in range(m)])
    freedoms = (data.has_shape * np.maximum(data.n_sensors - fitted, 0)).T
    return ModalNoise(
        paired.channels,
        data.n_sets,
        data.n_sensors,
        tuple((~np.isnan(data.frequencies)).T.astype(int).ravel().tolist()),
        tuple(freedoms.ravel().tolist()),
        *known.values(),
        unknown["frequency"],
        unknown["shape"] if freedoms.any() else "",
        0.0 if student_t is None else check_degrees("ModalLikelihood: student_t", student_t),
    )
