"""Measured channels: what was measured (`Channel`) and the samples of several channels (`Measurements`).

Values are always in SI units. The unit of a `Channel` is its display unit, used in labels and figures only.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit
from .error_measures import rrmse
from .sampling import check_step, same_sampling, sample_window

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Channel", "Measurements", "plot_response"]


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    Parameters
    ----------
    name : str
        Name, unique among the channels of a model or of measurements.
    quantity : str
        The measured quantity: a dimension of `fe_likelihoods.units.DIMENSIONS`, with or without words before it, such
        as ``"acceleration"`` or ``"relative displacement"``.
    unit : str
        Display unit for labels and figures ("g", "in", "kip"). Values are always in SI units.

    Raises
    ------
    ValueError
        If the name is empty, the quantity does not end with a dimension, or the unit has another dimension.
    """

    name: str
    quantity: str
    unit: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"a channel needs a name, got {self.name!r}")
        if not isinstance(self.quantity, str) or self.dimension not in DIMENSIONS:
            raise ValueError(
                f"quantity of channel {self.name!r} must be one of {', '.join(DIMENSIONS)}, with or without words "
                f"before it, got {self.quantity!r}"
            )
        try:
            find_unit(self.unit, self.dimension)
        except ValueError as error:
            raise ValueError(f"channel {self.name!r}: {error}") from None

    @property
    def dimension(self) -> str:
        """Dimension of the values, the last word of the quantity: a key of `fe_likelihoods.units.DIMENSIONS`."""
        return self.quantity.split()[-1] if self.quantity.split() else ""

    @property
    def si_unit(self) -> str:
        """SI unit of the values."""
        return DIMENSIONS[self.dimension]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Simultaneous samples of several channels at a constant step.

    Parameters
    ----------
    channels : tuple of Channel
        The channels, with unique names.
    dt : float
        Time step [s].
    values : (n_channels, n_steps) array_like
        Samples in SI units, one row per channel, stored as a read-only copy.
    description : str, optional
        What was measured, where and when.

    Raises
    ------
    ValueError
        If names repeat, the shape does not match the channels, the step is not positive, or a sample is not finite.
    """

    channels: tuple[Channel, ...]
    dt: float
    values: NDArray[np.float64]
    description: str = ""

    def __post_init__(self) -> None:
        channels = tuple(self.channels)
        names = [channel.name for channel in channels]
        if not channels or len(set(names)) != len(names):
            raise ValueError(f"measurements need channels with different names, got {names}")
        if np.iscomplexobj(self.values):
            raise ValueError("values must be real numbers, got complex ones; give the real part if it is the data")
        values = np.array(self.values, dtype=np.float64)
        if values.ndim != 2 or values.shape[0] != len(channels) or values.shape[1] < 1:
            raise ValueError(
                f"expected values of shape (n_channels, n_steps) = ({len(channels)}, n_steps), got {values.shape}"
            )
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            row, step = bad[0]
            raise ValueError(
                f"values must be finite: {len(bad)} are not, the first is sample {step} of channel {names[row]!r} "
                f"({values[row, step]}); repair or cut the data"
            )
        values.flags.writeable = False
        object.__setattr__(self, "channels", channels)
        object.__setattr__(self, "dt", check_step(self.dt, "the measurements"))
        object.__setattr__(self, "values", values)

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return len(self.channels)

    @property
    def n_steps(self) -> int:
        """Number of samples of each channel."""
        return self.values.shape[1]

    @property
    def time(self) -> NDArray[np.float64]:
        """Times of the samples, from zero, shape (n_steps,) [s]."""
        return np.arange(self.n_steps) * self.dt

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of names, quantities, step and values. Display units are not included."""
        state = hashlib.blake2b(digest_size=16)
        state.update(json.dumps([[channel.name, channel.quantity] for channel in self.channels]).encode())
        state.update(np.array([self.dt, self.n_steps], dtype="<f8").tobytes())
        state.update(np.ascontiguousarray(self.values, dtype="<f8").tobytes())
        return state.hexdigest()

    def channel(self, name: str) -> NDArray[np.float64]:
        """Return the samples of one channel, shape (n_steps,) [SI]; raise ValueError if it does not exist."""
        return self.values[self._row(name)]

    def select(self, names: Sequence[str]) -> "Measurements":
        """Return the measurements of the named channels, in this order; raise ValueError if one does not exist."""
        if isinstance(names, str):
            raise ValueError(f"select takes a sequence of names, for instance [{names!r}]")
        rows = [self._row(name) for name in names]
        return replace(self, channels=tuple(self.channels[row] for row in rows), values=self.values[rows])

    def trim(self, start: float = 0.0, stop: float | None = None) -> "Measurements":
        """Return the samples between two times [s], both included, as in `Record.trim`. Time starts at zero again."""
        window = sample_window("the measurements", self.n_steps, self.dt, start, stop)
        return replace(self, values=self.values[:, window])

    def decimate(self, factor: int) -> "Measurements":
        """Return every `factor`-th sample, starting with the first one, without a filter.

        Parameters
        ----------
        factor : int
            A whole number from 1 to the number of samples.

        Returns
        -------
        Measurements
            The remaining samples, with a step of `factor` times the old one.

        Raises
        ------
        ValueError
            If the factor is not such a number.

        Notes
        -----
        This is the right way to thin measurements for a likelihood with white noise: the remaining samples keep their
        noise, which is still independent from sample to sample, and they are compared with the response of the model
        at the same instants. A filter would correlate the noise.

        The remaining samples are not a band-limited signal, because motion above the new Nyquist frequency appears at
        lower frequencies (aliasing). Do not differentiate or integrate them or compute spectra of them, and resample
        an excitation with `Record.resample` instead.
        """
        if not isinstance(factor, (int, np.integer)) or not 1 <= factor <= self.n_steps:
            raise ValueError(f"factor must be a whole number from 1 to {self.n_steps}, got {factor!r}")
        return replace(self, dt=self.dt * factor, values=self.values[:, ::factor])

    def plot(
        self, response: "Measurements | None" = None, channels: Sequence[str] | None = None, **options
    ) -> "Figure":
        """Plot the histories of the channels and, if given, the response of a model with its errors.

        Parameters
        ----------
        response : Measurements, optional
            The response of a model.
        channels : sequence of str, optional
            Names of the channels to draw. Default: all.
        **options
            Further arguments of `fe_likelihoods.plots.histories.plot_histories`.

        Returns
        -------
        matplotlib Figure
            The figure, one axes per channel.

        Raises
        ------
        ValueError
            As `fe_likelihoods.plots.histories.plot_histories`.
        """
        from ..plots.histories import plot_histories

        errors = {} if response is None else self._errors(response)
        return plot_histories(self, response, channels, errors=errors, **options)

    def _errors(self, response: "Measurements") -> dict[str, float]:
        """Return the RRMSE of each channel that both have [-]; none if step or length differ or the channel is zero."""
        if not same_sampling(self.dt, self.n_steps, response.dt, response.n_steps):
            return {}
        simulated = {channel.name for channel in response.channels}
        common = [channel.name for channel in self.channels if channel.name in simulated]
        nonzero = [name for name in common if self.channel(name).any()]
        return {name: float(rrmse(response.channel(name), self.channel(name))) for name in nonzero}

    def _row(self, name: str) -> int:
        names = [channel.name for channel in self.channels]
        if name not in names:
            raise ValueError(f"no channel {name!r}; the channels are {', '.join(names)}")
        return names.index(name)


def plot_response(response: Measurements, measurements: Measurements | None = None, **options) -> "Figure":
    """Plot the response of a model, beside measurements if there are any.

    Parameters
    ----------
    response : Measurements
        The response, with the channels and the step of the model.
    measurements : Measurements, optional
        The measurements. Only their channels are drawn.
    **options
        Further arguments of `fe_likelihoods.plots.histories.plot_histories`.

    Returns
    -------
    matplotlib Figure
        The figure, one axes per channel.

    Raises
    ------
    ValueError
        As `fe_likelihoods.plots.histories.plot_histories`.
    """
    if measurements is not None:
        return measurements.plot(response, **options)
    from ..plots.histories import plot_histories

    return plot_histories(response=response, **options)
