"""Numbers where priors are expected: parameters of the noise that are known."""

from collections.abc import Mapping
from numbers import Real
from typing import Any

from ..noise.known import KnownNoise
from .joint import JointLikelihood
from .likelihood import FELikelihood

__all__ = ["without_known"]


def without_known(likelihood: Any, prior: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The likelihood in which the parameters whose prior is a number have this value, and the other priors.

    ValueError if such a parameter is not a parameter of the noise.
    """
    known = {name: float(value) for name, value in prior.items() if isinstance(value, Real)}
    if not known:
        return likelihood, dict(prior)
    noise = [likelihood.parameter_names[place] for place in likelihood.fast_parameters]
    if others := [name for name in known if name not in noise]:
        raise ValueError(
            f"a number in the prior is a known parameter of the noise; the noise has no {', '.join(others)}, its "
            f"parameters are {', '.join(noise) or 'none'}: fix other parameters in the model, or give a distribution"
        )
    return _with_known(likelihood, known), {name: each for name, each in prior.items() if name not in known}


def _with_known(likelihood: Any, known: Mapping[str, float]) -> Any:
    if isinstance(likelihood, FELikelihood):
        return likelihood.with_noise(KnownNoise(likelihood.noise, known)) if known else likelihood
    parts = {}
    for (part, columns), key in zip(likelihood.parts(), likelihood.likelihoods, strict=True):
        names = dict(zip(part.parameter_names, (likelihood.parameter_names[c] for c in columns), strict=True))
        parts[key] = _with_known(part, {own: known[joint] for own, joint in names.items() if joint in known})
    left = {name for part in parts.values() for name in part.parameter_names}
    return JointLikelihood(parts, separate=[name for name in likelihood.separate if name in left])
