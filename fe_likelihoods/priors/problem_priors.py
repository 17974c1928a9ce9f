"""Priors of the ready-made problems in `fe_likelihoods.problems`."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from ..units import to_si
from .distributions import HalfNormal, TruncatedNormal, Uniform
from .priors import Prior

NOISE_SCALE = 0.3  # half-normal prior of a sigma in root mean squares of the measured channels (assumed)


def bridge_column_prior(
    noise_parameters: Sequence[str] = ("sigma_acceleration", "sigma_displacement"),
    measured: Mapping[str, float] = MappingProxyType({}),
) -> Prior:
    """Make the prior of Ramancha et al. (2022), whose title is in docs/theory/concrete.rst.

    The structural parameters are normal with mean 1, truncated at zero, with the coefficients of variation 0.30 (Ec),
    0.20 (Es), 0.60 (a0), 0.60 (a1) and 0.40 (ft). The noise levels are half-normal. Their 0.1 g and 1.2 in are taken as
    scales: standard deviations of the normal before taking the absolute value (`HalfNormal`). The paper does not say
    whether they are scales or standard deviations of the half-normal distributions; the latter would give scales that
    are 1.66 times as large.

    Assumed: a shared ``sigma`` in root mean squares of the channels, and the levels of further channels in their root
    mean squares `measured` [SI], are half-normal with scale 0.3; correlations ``rho_...`` are uniform between -1 and 1.
    Raises ValueError if there is no default prior for a noise parameter.
    """
    structural = {"Ec": 0.30, "Es": 0.20, "a0": 0.60, "a1": 0.60, "ft": 0.40}
    scales = {f"sigma_{name}": NOISE_SCALE * value for name, value in measured.items()} | {
        "sigma_acceleration": to_si(0.1, "g").item(),
        "sigma_displacement": to_si(1.2, "in").item(),
        "sigma": NOISE_SCALE,
    }
    noise = {name: HalfNormal(scales[name]) for name in noise_parameters if name in scales}
    return Prior(
        {name: TruncatedNormal(1.0, cv) for name, cv in structural.items()}
        | noise
        | correlation_priors(noise_parameters, scales)
    )


def correlation_priors(noise_parameters: Sequence[str], scales: Mapping[str, float]) -> dict[str, Uniform]:
    """Return priors of the noise parameters that are correlations, not standard deviations with a scale."""
    others = [name for name in noise_parameters if name not in scales]
    unknown = [name for name in others if not name.startswith("rho_")]
    if unknown:
        raise ValueError(
            f"no default prior for {', '.join(unknown)} of this noise: make Posterior(FELikelihood(...), prior) with "
            "your own prior"
        )
    return {name: Uniform(-1.0, 1.0) for name in others}


def isolated_bridge_prior(parameter_names: Sequence[str], sigmas: Mapping[str, float]) -> Prior:
    """Make the prior of the isolated bridge (assumed).

    The multiples of nominal values are normal with mean 1 and standard deviation 0.5, truncated to [0.2, 2.5]. A noise
    level with scale s is half-normal with scale 0.3 s, truncated below at 0.001 s; s is 1 for a shared sigma, the
    measured root mean square of the channel [SI] for a sigma per channel.
    """
    structural = {name: TruncatedNormal(1.0, 0.5, 0.2, 2.5) for name in parameter_names}
    return Prior(structural | {name: TruncatedNormal(0.0, NOISE_SCALE * s, 1e-3 * s) for name, s in sigmas.items()})
