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


LEAST_ERRORS = 1e-4, 1e-3  # of frequencies and shapes, known where no error is stated


@dataclass(frozen=True)
class ModeSums:
    """Statistic of residuals (m, n_sets (1 + n_sensors)): sums of squares of modes, of frequencies and of shapes."""

    n_sets: int

    def __call__(self, residuals: np.ndarray) -> np.ndarray:
        """Sums (m + 2 m n_sets,): of each mode, then of each frequency and of each shape."""
        squares = np.square(residuals).reshape(len(residuals), self.n_sets, -1)
        frequencies, shapes = squares[:, :, 0], squares[:, :, 1:].sum(axis=2)
        return np.concatenate([(frequencies + shapes).sum(axis=1), frequencies.ravel(), shapes.ravel()])


@dataclass(frozen=True)
class ModalNoise:
    """Errors of m modes, with a `Noise`'s members: known errors, unknown ones, or both.

    All pairs are of frequencies and of shapes: `known` errors (m,), zero if none is known; what is `unknown`, an error
    ``"common"`` to all modes, one for each (``"mode"``), or an empty text for none; and `counts` (m n_sets,) of degrees
    of freedom, of the sets of the first mode, of the second one, and so on. `student` are the degrees of freedom of
    Student-t errors, 0 for Gaussian ones.
    """

    channels: tuple[Channel, ...]
    n_sets: int
    n_sensors: int
    known: tuple[tuple[float, ...], tuple[float, ...]]
    unknown: tuple[str, str]
    counts: tuple[tuple[int, ...], tuple[int, ...]]
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
    def _ends(self) -> dict[str, list[str]]:
        """Ends of the names of unknown errors."""
        return {"": [], "common": [""], "mode": [f"_{channel.name.split()[-1]}" for channel in self.channels]}

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency_error`` and ``shape_error``, or one of each per mode, ``frequency_error_2``."""
        kinds = zip(("frequency_error", "shape_error"), self.unknown, strict=True)
        return tuple(f"{what}{end}" for what, kind in kinds for end in self._ends[kind])

    def deviations(self, parameters: np.ndarray) -> list[np.ndarray]:
        """Standard deviations of frequencies and of components of shapes, (n, m) each, at parameters (n, n_noise)."""
        parameters = np.asarray(parameters, dtype=float)
        # an unknown error that is not positive is impossible, also beside a known one
        variances = np.square(np.where(parameters > 0.0, parameters, np.nan))
        split = len(self._ends[self.unknown[0]])
        found = []
        for known, more, least in zip(self.known, np.split(variances, [split], axis=1), LEAST_ERRORS, strict=True):
            own = np.square(known) + np.square(np.where(np.array(known) > 0.0, 0.0, least))
            found.append(np.sqrt(own + (more if more.shape[1] else np.zeros((len(parameters), 1)))))
        return found

    def log_likelihood(self, statistics: np.ndarray, n_samples: Any, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood (n,) for the statistics (n, m + 2 m n_sets); -inf for impossible errors."""
        total, sums = np.zeros(len(statistics)), np.split(statistics[:, len(self.channels) :], 2, axis=1)
        for deviations, squares, counts in zip(self.deviations(parameters), sums, self.counts, strict=True):
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


def modal_noise(paired: Any, unknown: tuple[Any, Any], student_t: float | None) -> ModalNoise:
    """The errors of `PairedModes`, from what their data and the arguments of a `ModalLikelihood` say."""
    data, stated = paired.data, (paired.frequency_cv, paired.data.shape_error)
    if data.covariance is not None and (unknown[0] is not None or student_t is not None):
        raise ValueError(
            "ModalLikelihood: beside a covariance of the frequencies, neither an unknown frequency_error nor student_t "
            "is possible: leave it out, or give the data frequency_cv and no covariance"
        )
    if wrong := [each for each in unknown if each not in (None, "common", "mode")]:
        raise ValueError(
            f'ModalLikelihood: frequency_error and shape_error must be "common" or "mode"; got {wrong[0]!r}: known '
            "errors belong to the data (frequency_cv, shape_error), or are numbers in the mapping of priors"
        )
    known = [(0.0,) * data.n_modes if each is None else tuple(each.tolist()) for each in stated]
    of_frequency, of_shape = (each or ("common" if x is None else "") for each, x in zip(unknown, stated, strict=True))
    sizes = {mode: len(group) for group in paired.groups for mode in group}
    fitted = np.array([sizes[mode] for mode in range(data.n_modes)])
    freedoms = (data.has_shape * np.maximum(data.n_sensors - fitted, 0)).T
    counts = [tuple(each.ravel().tolist()) for each in ((~np.isnan(data.frequencies)).T.astype(int), freedoms)]
    student = 0.0 if student_t is None else check_degrees("ModalLikelihood: student_t", student_t)
    unknown = of_frequency, of_shape if freedoms.any() else ""
    return ModalNoise(paired.channels, data.n_sets, data.n_sensors, tuple(known), unknown, tuple(counts), student)
