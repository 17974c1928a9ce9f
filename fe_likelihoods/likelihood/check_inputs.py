"""Checks of what a likelihood is made of and called with."""

from ..noise.protocol import Noise, noise_channels
from ..signals.channels import Measurements
from ..simulation.model import Model

__all__ = ["check_model", "check_noise", "match_measurements"]

_MODEL_MEMBERS = ("parameter_names", "channels", "dt", "n_steps", "fingerprint", "simulate")


def check_model(model: Model) -> None:
    """Raise ValueError, with the names of the missing members, if an object is not a model."""
    # the class first, so that no property is computed
    missing = [name for name in _MODEL_MEMBERS if not (hasattr(type(model), name) or hasattr(model, name))]
    if missing:
        raise ValueError(
            f"{type(model).__name__} is not a model, because it has no {', '.join(missing)}; a model needs "
            f"{', '.join(_MODEL_MEMBERS)} (see fe_likelihoods.simulation.model.Model)"
        )


def check_noise(model: Model, noise: Noise) -> None:
    """Raise ValueError if an object is no noise, or has other channels than the model."""
    if isinstance(noise, type) or not hasattr(noise, "log_likelihood"):
        raise ValueError(
            "noise must be a noise, such as GaussianNoise(model.channels) or GaussianNoise(model.channels, "
            f'groups="event"); got {noise!r}'
        )
    expected = [channel.name for channel in model.channels]
    got = [channel.name for channel in noise_channels(noise, model.channels)]
    if expected != got:
        raise ValueError(
            f"the noise's channels are {', '.join(got)}, the model's are {', '.join(expected)}; make the noise with "
            "model.channels"
        )


def match_measurements(model: Model, measurements: Measurements) -> Measurements:
    """Measurements in the order of the model's channels; ValueError if channels or quantities differ."""
    expected = [channel.name for channel in model.channels]
    got = [channel.name for channel in measurements.channels]
    if sorted(expected) != sorted(got):
        advice = "select the common ones in the measurements (Measurements.select) and in the model"
        common = tuple(name for name in got if name in expected)
        if common and hasattr(model, "outputs"):  # of the library's models, whose channels have the names of outputs
            advice = f"make the model with outputs={common!r}"
            advice += "" if len(common) == len(got) else f", and take measurements.select({list(common)!r})"
        raise ValueError(
            f"the model's channels are {', '.join(expected)}, the measurements' are {', '.join(got)}; {advice}"
        )
    matched = measurements if expected == got else measurements.select(expected)
    for ours, theirs in zip(model.channels, matched.channels, strict=True):
        words = [channel.quantity.split()[:-1] for channel in (ours, theirs)]
        if ours.dimension != theirs.dimension or (all(words) and words[0] != words[1]):
            raise ValueError(
                f"channel {ours.name!r} is {ours.quantity!r} in the model and {theirs.quantity!r} in the measurements"
            )
    return matched
