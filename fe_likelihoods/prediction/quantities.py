r"""Quantities of a response: histories of channels, numbers from the histories of channels, or any function of it.

A `ChannelQuantity` has a channel and therefore a dimension, so that a threshold in a unit of another dimension is
refused. Two are energy measures: the Arias intensity of an acceleration, and the work of a force through a
displacement.

.. math:: I_A = \frac{\pi}{2 g} \int a^2\, dt, \qquad W = \int F\, du.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..signals.channels import Channel, Measurements
from ..units import G0

_WORK = {"force": ("energy", "kJ"), "moment": ("energy", "kJ"), "stress": ("stress", "MPa")}  # dimension and unit

FAILED = 0.8  # of the largest force, below which a structure has failed (by convention a loss of 20 %)
_AS_FAR = 0.97  # of the largest displacement so far, as far as which an excursion goes: repeated cycles are equal


@dataclass(frozen=True, eq=False)
class ChannelQuantity:
    """A number from the history of one channel, or of several; ``str(quantity)`` is, for example, "peak of deck".

    `others` are further arguments of the function: histories of other channels, by name, or arrays of the same number
    of samples [SI], such as an imposed displacement; the part is taken of each. `describe` returns a `Channel` with the
    number's name, dimension and display unit for the `Channel` of the history, or raises ValueError for a channel that
    has no such number; by default it is the channel itself.
    """

    channel: str
    function: Callable[..., float]  # of the history (n_steps,) [SI], returns a number [SI]
    part: slice = field(default_factory=lambda: slice(None))  # samples of the history that the function receives
    others: tuple[str | np.ndarray, ...] = ()
    timed: bool = False  # whether the last argument is the time step [s]
    describe: Callable[[Channel], Channel] | None = None
    name: str = "quantity"  # what the number is, such as "peak"
    n_steps: int | None = None  # samples of the history that it is for; None: any number

    def __str__(self) -> str:
        return f"{self.name} of {self.channel}"

    @property
    def channel_names(self) -> list[str]:
        """Names of all channels that are needed."""
        return [self.channel, *(each for each in self.others if isinstance(each, str))]

    def evaluate(self, histories: Sequence[np.ndarray], dt: float) -> float:
        """Compute the number from the histories of `channel_names` [SI] and their time step [s]."""
        first, *named = histories
        further = iter(named)
        arguments = [first, *(next(further) if isinstance(each, str) else each for each in self.others)]
        return self.function(*(each[self.part] for each in arguments), *([dt] if self.timed else []))

    def described(self, channel: Channel) -> Channel:
        """Name, dimension and display unit of the number, as a channel."""
        return channel if self.describe is None else self.describe(channel)

    def check_length(self, n_steps: int) -> None:
        """Raise ValueError if the quantity is for another number of samples, or the part has none."""
        if self.n_steps not in (None, n_steps):
            raise ValueError(
                f"{self} is for responses of {self.n_steps} samples, got {n_steps}: make it with "
                "model.with_record(record) for a prediction under another record"
            )
        for each in self.others:
            if not isinstance(each, str) and len(each) != n_steps:
                raise ValueError(
                    f"the history of channel {self.channel!r} has {n_steps} samples, the array that belongs to it "
                    f"{len(each)}: give both for the same excitation"
                )
        if not len(range(n_steps)[self.part]):
            raise ValueError(f"no sample of the {n_steps} of channel {self.channel!r} is in the part {self.part}")


Quantity = None | str | ChannelQuantity | Sequence[str] | Sequence[ChannelQuantity] | Callable[[np.ndarray], Any]
"""Quantities that `fe_likelihoods.prediction.propagation.propagate` accepts."""


class Evaluator(NamedTuple):
    """How a quantity is computed from the response of a model."""

    rows: list[int] | None  # whose histories are the quantity, None for others
    function: Callable[[np.ndarray], Any] | None  # of the response (n_channels, n_steps) [SI]
    channels: tuple[Channel, ...]  # of the quantity; empty for a function of the whole response
    shape: tuple[int, ...] | None = None  # of a number or several; None if it is not known before a response


def peak(channel: str, part: slice = slice(None)) -> ChannelQuantity:
    """Return the quantity "largest absolute value of the channel", in a part of its samples (default: all).

    Examples
    --------
    >>> peaks = propagate(posterior, samples, quantity=[peak("acceleration"), peak("displacement")])
    >>> print(peaks)  # doctest: +SAMPLED
    Prediction: 300 samples, with the spread of the parameters only; effective sample size 300
    value         unit   mean  MC error       sd    5 %   50 %  95 %
    acceleration     g  0.364  0.000203  0.00352  0.359  0.364  0.37
    displacement    cm   8.25     0.005   0.0866   8.11   8.24  8.39
    """
    return ChannelQuantity(channel, _largest, part, name="peak")


def rms(channel: str, part: slice = slice(None)) -> ChannelQuantity:
    """Return the quantity "root mean square of the channel", in a part of its samples (default: all).

    Examples
    --------
    >>> print(propagate(posterior, samples, quantity=rms("acceleration")))  # doctest: +SAMPLED
    Prediction: 300 samples, with the spread of the parameters only; effective sample size 300
    value         unit   mean  MC error       sd    5 %   50 %   95 %
    acceleration     g  0.167  0.000136  0.00235  0.164  0.167  0.171
    """
    return ChannelQuantity(channel, _root_mean_square, part, name="RMS")


def arias_intensity(channel: str, part: slice = slice(None)) -> ChannelQuantity:
    r"""Return the quantity "Arias intensity of an acceleration", a measure of the motion's energy.

    Parameters
    ----------
    channel : str
        Name of an acceleration channel.
    part : slice
        Samples of the history. Default: all.

    Returns
    -------
    ChannelQuantity
        :math:`\frac{\pi}{2 g} \int a^2\, dt` [m/s] by the trapezoidal rule (A. Arias, 1970, A measure of earthquake
        intensity, in: Seismic Design for Nuclear Power Plants, MIT Press, 438-483). A channel of another dimension is
        a ValueError when the quantity is used.

    Examples
    --------
    >>> from fe_likelihoods.prediction.quantities import arias_intensity
    >>> print(propagate(posterior, samples, quantity=arias_intensity("acceleration")))  # doctest: +SAMPLED
    Prediction: 300 samples, with the spread of the parameters only; effective sample size 300
    value                            unit  mean  MC error     sd   5 %  50 %  95 %
    Arias intensity of acceleration   m/s  4.32   0.00701  0.121  4.13  4.31  4.52
    """
    describe = functools.partial(_describe, "Arias intensity", {"acceleration": ("velocity", "m/s")})
    return ChannelQuantity(channel, _arias_intensity, part, timed=True, describe=describe, name="Arias intensity")


def dissipated_energy(force: str, displacement: str | ArrayLike, part: slice = slice(None)) -> ChannelQuantity:
    r"""Return the quantity "work of a force", which over closed cycles is the energy that they dissipate.

    Parameters
    ----------
    force : str
        Name of a channel: force, moment (with a rotation) or stress (with a strain; energy per volume).
    displacement : str or (n_steps,) array_like
        Name of the displacement channel that belongs to it, or the imposed displacement of a test [SI], with one value
        per force sample.
    part : slice
        Samples of both histories. Default: all.

    Returns
    -------
    ChannelQuantity
        :math:`\int F\, du` [J, or J/m³ = Pa for a stress] by the trapezoidal rule. It contains the elastic energy
        that is stored at the end of the part.

    Raises
    ------
    ValueError
        If the displacement is neither a name nor finite values (n_steps,). When the quantity is used: if the channel
        has another dimension or another number of samples.

    Examples
    --------
    >>> from fe_likelihoods.prediction.quantities import dissipated_energy
    >>> loops = RCColumn.lhpost(record, outputs=("base_shear", "displacement"))
    >>> print(propagate(loops, np.ones((1, 5)), quantity=dissipated_energy("base_shear", "displacement")))
    Prediction: 1 samples, with the spread of the parameters only; effective sample size 1
    value                 unit  mean  MC error  sd   5 %  50 %  95 %
    energy of base_shear    kJ  7.81         0   0  7.81  7.81  7.81
    """
    displacement = _displacement(displacement, "dissipated_energy")
    describe = functools.partial(_describe, "energy", _WORK)
    return ChannelQuantity(force, _work, part, (displacement,), describe=describe, name="energy")


def displacement_before_failure(force: str, displacement: str | ArrayLike) -> ChannelQuantity:
    """Return the quantity "largest displacement before the force fails to reach 80 % of its peak".

    A structure has failed in the first excursion (between two changes of sign of the displacement) that goes as far as
    any before it, comes after the largest force, and reaches less than 80 % of this force. A structure that
    does not fail has the largest displacement of the whole history: continue the history to see more. Under a large
    axial load the force also falls by P-Delta, without any damage: use the base moment divided by the height
    (``geometry="linear"`` of `ColumnAnalysis`).

    Parameters
    ----------
    force : str
        Name of the channel of the lateral force.
    displacement : str or (n_steps,) array_like
        Name of the displacement channel that belongs to it, or the imposed displacement of a test [m], with one value
        per force sample.

    Raises
    ------
    ValueError
        If the displacement is neither a name nor finite values (n_steps,). When the quantity is used: if the channel is
        no force, or has another number of samples.

    Examples
    --------
    >>> from fe_likelihoods.prediction.quantities import displacement_before_failure
    >>> cycles = 0.3 * np.sin(np.linspace(0.0, 12.0 * np.pi, 400)) * np.linspace(0.0, 1.0, 400)  # m
    >>> tested = RCColumn.lhpost(DisplacementHistory("cycles", cycles), parameters=["Ec"], fatigue=LowCycleFatigue())
    >>> failure = displacement_before_failure("force", cycles)
    >>> print(propagate(tested, np.ones((1, 1)), quantity=failure))
    Prediction: 1 samples, with the spread of the parameters only; effective sample size 1
    value                                 unit  mean  MC error  sd  5 %  50 %  95 %
    displacement before failure of force    mm   287         0   0  287   287   287
    """
    displacement = _displacement(displacement, "displacement_before_failure")
    describe = functools.partial(_describe, "displacement before failure", {"force": ("displacement", "mm")})
    return ChannelQuantity(force, _before_failure, others=(displacement,), describe=describe, name="failure")


def final_value(channel: str, samples: int = 1) -> ChannelQuantity:
    """Return the quantity "mean of the last samples of the channel", such as the residual drift after a motion.

    Parameters
    ----------
    channel : str
        Name of the channel.
    samples : int
        Number of last samples. Where the structure still vibrates, choose a whole number of periods, or append rest to
        the record: ``record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0)``.

    Raises
    ------
    ValueError
        If the number is not a positive whole number.

    Examples
    --------
    >>> quiet = record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0)
    >>> print(propagate(LinearOscillator(quiet), samples[:, :2], quantity=final_value("displacement", samples=20)))
    Prediction: 300 samples, with the spread of the parameters only; effective sample size 300
    value         unit ...
    displacement    cm ...
    """
    if not isinstance(samples, int | np.integer) or samples < 1:
        raise ValueError(f"final_value: samples must be a whole number, 1 or more; got {samples!r}")
    return ChannelQuantity(channel, MeanOfLast(int(samples)), name="final value")


def measured_quantity(quantity: Any, measurements: Measurements) -> np.ndarray:
    """Measured values, () or (n_quantities,) [SI], of one `ChannelQuantity` or a sequence, as it was predicted.

    ValueError for any other quantity, or if the measurements lack a channel or samples of it.
    """
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    if not isinstance(several, Sequence) or not all(isinstance(each, ChannelQuantity) for each in several):
        raise ValueError(
            "a function of the whole response is not known for measurements: give the measured values [SI] instead"
        )
    values = [_measured(each, measurements.select(each.channel_names)) for each in several]
    return np.array(values[0] if isinstance(quantity, ChannelQuantity) else values)


def _measured(quantity: ChannelQuantity, measurements: Measurements) -> float:
    """The quantity, computed from measurements."""
    quantity.check_length(measurements.n_steps)
    quantity.described(measurements.channels[0])
    if len(measurements.channels) > 1 and not measurements.simultaneous:
        raise ValueError(
            f"the channels {', '.join(quantity.channel_names)} are measured at different times, so that the number of "
            "both is not known: give the measured value [SI]"
        )
    for channel, history in zip(measurements.channels, measurements.values, strict=True):
        if np.isnan(history[quantity.part]).any():
            raise ValueError(
                f"samples of channel {channel.name!r} are missing, so that its measured quantity is not known: give "
                "the measured values [SI], or measurements that are trimmed to a part without gaps"
            )
    return float(quantity.evaluate(measurements.values, measurements.steps[0]))


class MeanOfLast(NamedTuple):
    """Function of a history: the mean of its last samples."""

    samples: int

    def __call__(self, history: np.ndarray) -> float:
        return float(np.mean(history[-self.samples :]))


def _root_mean_square(history: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(history))))


def _largest(history: np.ndarray) -> float:
    return float(np.max(np.abs(history)))


def _arias_intensity(acceleration: np.ndarray, dt: float) -> float:
    squares = np.square(acceleration)
    return float(0.5 * np.pi / G0 * dt * (squares.sum() - 0.5 * (squares[0] + squares[-1])))


def _work(force: np.ndarray, displacement: np.ndarray) -> float:
    return float(0.5 * (force[1:] + force[:-1]) @ np.diff(displacement))


def find_failure(force: np.ndarray, displacement: np.ndarray) -> int:
    """First sample of the excursion in which a structure fails (`displacement_before_failure`); n_steps if none."""
    size, largest_force = np.abs(displacement), np.abs(force).max()
    ends = [0, *(np.flatnonzero(np.diff(np.sign(displacement)) != 0) + 1), len(displacement)]
    reached = 0.0
    for start, stop in itertools.pairwise(ends):
        largest = size[start:stop].max()
        if largest > _AS_FAR * reached and start > np.argmax(np.abs(force)):
            if np.abs(force[start:stop]).max() < FAILED * largest_force:
                return int(start)
        reached = max(reached, largest)
    return len(displacement)


def _before_failure(force: np.ndarray, displacement: np.ndarray) -> float:
    return float(np.abs(displacement[: find_failure(force, displacement)]).max())


def _displacement(displacement: str | ArrayLike, of: str) -> str | np.ndarray:
    """The name of a channel, or a copy of finite displacements (n_steps,) that does not change."""
    if isinstance(displacement, str):
        return displacement
    values = np.array(displacement, dtype=float)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise ValueError(
            f"{of}: expected the name of a channel, or finite displacements (n_steps,) [SI]; got an array of shape "
            f"{values.shape}"
        )
    values.flags.writeable = False
    return values


def _describe(name: str, known: Mapping[str, tuple[str, str]], channel: Channel) -> Channel:
    """The number of a channel, whose dimension and unit are `known` by the dimension of the channel."""
    if channel.dimension not in known:
        raise ValueError(
            f"{name} needs a channel of {', '.join(known)}; channel {channel.name!r} is {channel.quantity!r}"
        )
    return Channel(f"{name} of {channel.name}", *known[channel.dimension])


def evaluator(quantity: Quantity, channels: Sequence[Channel], dt: float, n_steps: int | None = None) -> Evaluator:
    """How a quantity of `propagate` is computed from responses of these channels, with the time step [s].

    With `n_steps`, the arrays of a quantity are checked before the simulations. ValueError if this is not a quantity,
    it names an unknown channel, or one that has no such number.
    """
    channels = tuple(channels)
    names = [channel.name for channel in channels]

    def row(name: str) -> int:
        if name not in names:
            raise ValueError(f"no channel {name!r}; the channels of the model are {', '.join(names)}")
        return names.index(name)

    if quantity is None:
        return Evaluator(list(range(len(channels))), None, channels)
    if isinstance(quantity, str):
        return Evaluator([row(quantity)], None, (channels[row(quantity)],))

    def number(each: ChannelQuantity) -> tuple[Callable[[np.ndarray], float], Channel]:
        rows = [row(name) for name in each.channel_names]
        if n_steps is not None:
            each.check_length(n_steps)
        return lambda response: each.evaluate([response[k] for k in rows], dt), each.described(channels[rows[0]])

    if isinstance(quantity, ChannelQuantity):
        function, channel = number(quantity)
        return Evaluator(None, function, (channel,), ())
    if callable(quantity):
        return Evaluator(None, quantity, ())
    if isinstance(quantity, Sequence) and quantity:
        if all(isinstance(each, str) for each in quantity) and len(set(quantity)) == len(quantity):
            rows = [row(name) for name in quantity]
            return Evaluator(rows, None, tuple(channels[k] for k in rows))
        if all(isinstance(each, ChannelQuantity) for each in quantity):
            functions, numbers = zip(*(number(each) for each in quantity), strict=True)
            return Evaluator(
                None, lambda response: np.array([f(response) for f in functions]), numbers, (len(numbers),)
            )
    raise ValueError(
        "quantity must be None, a channel's name, different names, peak(name), several of these, or a function of the "
        f"response (n_channels, n_steps); got {quantity!r}"
    )
