"""The noise that a TOML file describes."""

from typing import Any

from ..noise.autoregressive import AutoregressiveNoise
from ..noise.gaussian import GaussianNoise
from ..signals.channels import Channel
from ..simulation.model import Model
from .job import Job
from .schema import did_you_mean, read_quantity

__all__ = ["make_noise"]


def make_noise(job: Job, model: Model) -> Any:
    """The noise of a file, for `FELikelihood`; ValueError, which names the key to blame, if a value is wrong for it."""
    given = {name: value for name, value in job.noise.items() if name not in ("kind", "marginal")}
    kind = job.noise.get("kind", "gaussian")
    if kind not in ("gaussian", "autoregressive"):
        raise ValueError(f"kind: unknown noise {kind!r}; {did_you_mean(kind, ('gaussian', 'autoregressive'))}")
    if "sensor" in given:
        given["sensor"] = _sensor(job, given["sensor"], model.channels)
    if kind == "gaussian":
        return GaussianNoise(model.channels, **given)
    if more := [name for name in given if name != "sensor"]:
        raise ValueError(f'{more[0]}: the kind "autoregressive" has no such key: leave it out, or leave kind out')
    return AutoregressiveNoise(model.channels, **given)


def _sensor(job: Job, given: dict[str, Any], channels: tuple[Channel, ...]) -> dict[str, float]:
    """Standard deviation of each sensor's noise [SI]."""
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
