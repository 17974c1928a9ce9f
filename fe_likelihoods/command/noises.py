"""The noise that a TOML file describes."""

from typing import Any

from ..noise.autoregressive import AutoregressiveNoise
from ..noise.bands import BandNoise
from ..noise.gaussian import GaussianNoise, SharedGaussianNoise
from ..noise.modulated import ModulatedNoise
from ..noise.relative import RelativeNoise
from ..signals.channels import Channel, Measurements
from ..simulation.model import Model
from .job import Job
from .schema import did_you_mean, read_quantity

__all__ = ["make_noise"]


def make_noise(job: Job, model: Model, measured: Measurements) -> Any:
    """The noise of a file, for `FELikelihood`.

    Parameters
    ----------
    job : Job
    model : Model
    measured : Measurements

    Raises
    ------
    ValueError
        If a value is wrong for the noise; the message names the key where one is to blame.
    """
    given = dict(job.noise_options)
    if "sensor" in given:
        given["sensor"] = _sensor(job, given["sensor"], model.channels)
    measured = measured.select([channel.name for channel in model.channels])
    if job.noise == "per event":
        return "per event"
    if job.noise == "shared":
        return SharedGaussianNoise.of(measured, **given)
    if job.noise == "relative":
        return RelativeNoise.of(measured, **given)
    if job.noise == "modulated":
        return ModulatedNoise(model.channels, **given)
    if job.noise == "bands":
        return BandNoise(model.channels, given.pop("edges"), relative=given.pop("shares", True), **given)
    return (AutoregressiveNoise if job.noise == "autoregressive" else GaussianNoise)(model.channels, **given)


def _sensor(job: Job, given: dict[str, Any], channels: tuple[Channel, ...]) -> dict[str, float]:
    """Standard deviation of the noise of each sensor [SI]."""
    known, values = {channel.name: channel for channel in channels}, {}
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"{job.where('noise')} sensor: unknown channel {name!r}; {did_you_mean(name, [*known])}")
        try:
            values[name] = read_quantity(value, known[name].dimension)
        except ValueError as error:
            raise ValueError(f"{job.where('noise')} sensor: {name}: {error}") from None
        if not values[name] >= 0.0:
            raise ValueError(f"{job.where('noise')} sensor: {name}: expected a standard deviation; got {value!r}")
    return values
