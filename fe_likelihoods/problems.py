"""Ready-made posteriors, with bundled data: the two systems of the papers.

`bridge_column` is the full-scale bridge column of the LHPOST tests, updated as in the paper: five multiples of nominal
values with normal priors truncated at zero, two noise levels with half-normal priors. The measured record and
responses of the paper could not be had; the bundled data are **synthetic** (see ``data/README.md``), and
`bridge_column_measurements` makes such data for any other base motion.

`isolated_bridge` is the isolated bridge of the paper on TMCMC: ten multiples of nominal values of friction and dampers.
Its data are **synthetic** and most nominal values are **assumed**.

The models are imported by the functions that make them: numba takes longer to start than the rest together.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from types import MappingProxyType
from typing import Any

import numpy as np

from .models.isolated_bridge_channels import CHANNEL_SETS
from .probability.likelihood import FELikelihood
from .probability.noise import AutoregressiveNoise, GaussianNoise, SharedGaussianNoise
from .probability.posterior import Posterior
from .probability.priors import HalfNormal, Prior, TruncatedNormal, Uniform
from .signals.channels import Channel, Measurements
from .signals.datasets import Dataset, read_dataset
from .signals.records import Record
from .simulation.disk_cache import SimulationCache
from .units import to_si

__all__ = [
    "BRIDGE_COLUMN_MEANS",
    "BRIDGE_COLUMN_NOISE",
    "ISOLATED_BRIDGE_NOISE",
    "ISOLATED_BRIDGE_OUTPUTS",
    "ISOLATED_BRIDGE_TRUTH",
    "bridge_column",
    "bridge_column_data",
    "bridge_column_measurements",
    "bridge_column_prior",
    "isolated_bridge",
    "isolated_bridge_data",
    "isolated_bridge_measurements",
    "isolated_bridge_prior",
]

BRIDGE_COLUMN_MEANS = MappingProxyType({"Ec": 0.59, "Es": 0.96, "a0": 0.27, "a1": 4.78, "ft": 2.43})
"""Posterior means of the paper (Table 2), multiples of the nominal values: the truth of the synthetic data."""

BRIDGE_COLUMN_NOISE = MappingProxyType(
    {"acceleration": to_si(7.7, "in/s2").item(), "displacement": to_si(0.09, "in").item()}
)
"""Noise levels of the paper (Table 2) [SI]: standard deviations of the white noise of the synthetic data."""


_COARSE_SHARE = 0.75
_COARSE_TOLERANCES = {"tolerance": 1e-3, "element_tolerance": 1e-3}


def _bundled(name: str) -> Dataset:
    with resources.as_file(resources.files("fe_likelihoods.data") / name) as path:
        return read_dataset(path)


def bridge_column_data() -> Dataset:
    """The bundled synthetic EQ1: base record, measured channels and how they were made (``data/README.md``)."""
    return _bundled("bridge_column_eq1.h5")


def bridge_column_measurements(
    record: Record, *, seed: int = 1, n_strips: int = 200, substeps: int = 4, noise: bool = True, **changes
) -> Measurements:
    """Synthetic measurements of the column under `record`: a finer model than the one to be updated, plus white noise.

    Parameters
    ----------
    record : Record
        Base acceleration.
    seed : int
        Of the noise.
    n_strips, substeps : int
        Mesh and integration steps per record step of the finer model (the updated one has 40 and 1).
    noise : bool
        False: the response alone.
    **changes
        Other arguments of `RCColumn.lhpost`.
    """
    from .models.rc_column import RCColumn

    model = RCColumn.lhpost(record, mesh=n_strips, substeps=substeps, **changes)
    values = model.simulate([BRIDGE_COLUMN_MEANS[name] for name in model.parameter_names])
    if noise:
        rng = np.random.default_rng(seed)
        levels = np.array([BRIDGE_COLUMN_NOISE[c.name] for c in model.channels])
        values = values + levels[:, None] * rng.standard_normal(values.shape)
    description = (
        f"SYNTHETIC: response of RCColumn.lhpost ({n_strips} strips, {substeps} integration steps per sample) to "
        f"{record.name} at the paper's posterior means" + (f", plus white noise (seed {seed})" if noise else "")
    )
    return Measurements(model.channels, record.dt, values, description)


def bridge_column_prior(
    noise_parameters: Sequence[str] = ("sigma_acceleration", "sigma_displacement"),
) -> Prior:
    """The paper's prior: normal, truncated at zero, CV .30 .20 .60 .60 .40; half-normal of .1 g and 1.2 in.

    Parameters
    ----------
    noise_parameters : sequence of str
        Those of another noise: a shared ``sigma`` in root mean squares of the measured channels is half-normal of .3,
        correlations ``rho_...`` are uniform between -1 and 1; both assumed.

    Raises
    ------
    ValueError
        For a parameter that is none of these.
    """
    structural = {"Ec": 0.30, "Es": 0.20, "a0": 0.60, "a1": 0.60, "ft": 0.40}
    scales = {
        "sigma_acceleration": to_si(0.1, "g").item(),
        "sigma_displacement": to_si(1.2, "in").item(),
        "sigma": 0.3,
    }
    noise = {name: HalfNormal(scales[name]) for name in noise_parameters if name in scales}
    return Prior(
        {name: TruncatedNormal(1.0, cv) for name, cv in structural.items()} | noise | _rest(noise_parameters, scales)
    )


def _rest(noise_parameters: Sequence[str], scales: Mapping[str, float]) -> dict[str, Uniform]:
    """Priors of the parameters of a noise that are no standard deviations, hence not in `scales`."""
    rest = [name for name in noise_parameters if name not in scales]
    unknown = [name for name in rest if not name.startswith("rho_")]
    if unknown:
        raise ValueError(
            f"no default prior for {', '.join(unknown)} of this noise: make Posterior(FELikelihood(...), prior) with "
            "your own"
        )
    return {name: Uniform(-1.0, 1.0) for name in rest}


def _noise(noise: Any, channels: Sequence[Channel], measurements: Measurements) -> Any:
    """The noise of a name, or the one that was given; ValueError for another name."""
    if hasattr(noise, "log_likelihood"):
        return noise
    if noise == "per channel":
        return GaussianNoise(channels)
    if noise == "shared":
        return SharedGaussianNoise.of(measurements.select([channel.name for channel in channels]))
    if noise == "autoregressive":
        return AutoregressiveNoise(channels)
    raise ValueError(
        'expected noise="per channel", "shared", "autoregressive" or "marginal", or a noise of fe_likelihoods.probability.noise; '
        f"got {noise!r}"
    )


def bridge_column(
    *,
    record: Record | None = None,
    measurements: Measurements | None = None,
    every: int = 1,
    duration: float | None = None,
    noise: Any = "per channel",
    seed: int = 1,
    cache: SimulationCache | str | os.PathLike | None = None,
    **changes,
) -> Posterior:
    """Posterior of the bridge column: seven parameters, two measured channels, likelihood of the paper's equation (3).

    Parameters
    ----------
    record, measurements : optional
        Base motion and measured responses at its step. Default: the bundled synthetic EQ1. With a record alone,
        synthetic measurements are made for it (`bridge_column_measurements`).
    every : int
        Keep one sample in `every`: record resampled (anti-aliased), measurements decimated. 2 costs about half.
    duration : float
        Keep the first `duration` seconds.
    noise : {"per channel", "shared", "autoregressive", "marginal"}, or a noise of `fe_likelihoods.probability.noise`
        White, one sigma for each channel as in the paper, or one for both; or an error that lasts, with a correlation
        ``rho_...`` per channel too. Priors are in `bridge_column_prior`. "marginal" is "per channel" with the sigmas
        integrated out (`Posterior.marginal`): five parameters.
    seed : int
        Of the noise, where measurements are made.
    cache : SimulationCache or path, optional
        Where simulations are kept on disk, for later runs too.
    **changes
        Other arguments of `RCColumn.lhpost`.

    Returns
    -------
    Posterior
        Parameters Ec, Es, a0, a1, ft (multiples of nominal), sigma_acceleration [m/s2], sigma_displacement [m], or
        those of another noise.
        Its `coarse` sees the record up to three quarters of its Arias intensity only and solves the equations of motion
        less tightly: a quarter of the cost, for a wider posterior about the same place. (A larger step or fewer strips
        save less and move the posterior by many of its standard deviations.)

    Raises
    ------
    ValueError
        For measurements without a record, or that do not fit it; for an unknown noise.
    """
    from .models.rc_column import RCColumn

    if record is None:
        if measurements is not None:
            raise ValueError("measurements came without the record that caused them: give record= too")
        data = bridge_column_data()
        record, measurements = data.record, data.measurements
    elif measurements is None:
        measurements = bridge_column_measurements(record, seed=seed)
    if duration is not None:
        record, measurements = record.trim(0.0, duration), measurements.trim(0.0, duration)
    if every != 1:
        measurements = measurements.decimate(every)
        record = record.resample(record.dt * every)
    model = RCColumn.lhpost(record, **changes)
    law = _noise("per channel" if noise == "marginal" else noise, model.channels, measurements)
    likelihood, prior = FELikelihood(model, measurements, law, cache=cache), bridge_column_prior(law.parameter_names)
    coarse = None
    intensity = np.cumsum(record.acceleration**2)
    most = int(np.searchsorted(intensity, _COARSE_SHARE * intensity[-1])) * record.dt
    if most > record.dt:
        few = measurements.trim(0.0, most)
        cheap = replace(model, loading=record.trim(0.0, most), **_COARSE_TOLERANCES)
        coarse = Posterior(FELikelihood(cheap, few, law, cache=likelihood.cache), prior)
    posterior = Posterior(likelihood, prior, coarse)
    return posterior.marginal() if noise == "marginal" else posterior


# ------------------------------------------------------------------ isolated bridge

_DEVICES = ("fmin_1", "df_1", "a_1", "fmin_2", "df_2", "a_2", "Kd_1", "C0_1", "Kd_2", "C0_2")
ISOLATED_BRIDGE_TRUTH = MappingProxyType(
    {
        "twin": MappingProxyType(
            dict(zip(_DEVICES, (1.15, 0.85, 1.2, 0.9, 1.1, 0.8, 0.8, 1.25, 1.3, 0.9), strict=True))
        ),
        "means": MappingProxyType(dict.fromkeys(_DEVICES, 1.0) | {"df_1": 0.8, "df_2": 1.2}),
    }
)
"""Multiples of the nominal values from which the two synthetic data sets were made (assumed)."""

ISOLATED_BRIDGE_OUTPUTS = MappingProxyType(
    {"twin": CHANNEL_SETS[10], "means": ("mean_Ub", "mean_Fb", "mean_drift", "mean_shear", "mean_acc_p")}
)
"""Channels of the two synthetic data sets."""

ISOLATED_BRIDGE_NOISE = MappingProxyType({"twin": 0.05, "means": 0.10})
"""White noise of the two synthetic data sets, in root mean squares of each channel (assumed)."""


def isolated_bridge_data(data: str = "twin") -> Dataset:
    """A bundled synthetic test of the isolated bridge, nominal values assumed (``data/README.md``).

    Parameters
    ----------
    data : {"twin", "means"}
        Ten channels of both piers; or five means of the two piers, whose posterior has two modes.

    Raises
    ------
    ValueError
        For another name.
    """
    if data not in ISOLATED_BRIDGE_TRUTH:
        raise ValueError(f'expected data="twin" or "means"; got {data!r}; for your own give record= and measurements=')
    return _bundled("isolated_bridge.h5" if data == "twin" else "isolated_bridge_means.h5")


def isolated_bridge_measurements(
    record: Record,
    *,
    theta: Mapping[str, float] = ISOLATED_BRIDGE_TRUTH["twin"],
    outputs: tuple[str, ...] | int = 10,
    noise: float = 0.05,
    seed: int = 1,
    step: float = 0.05e-3,
    every: int = 2,
    **changes,
) -> Measurements:
    """Synthetic measurements of the isolated bridge under `record`: a finer step of integration, plus white noise.

    Parameters
    ----------
    record : Record
        Acceleration of the table.
    theta : mapping of str to float
        Multiples of the nominal values of all ten parameters.
    outputs : tuple of str, 5, 6 or 10
        Channels (see `IsolatedBridge`).
    noise : float
        Standard deviation of the noise, in root mean squares of each channel; 0 for the response alone.
    seed : int
        Of the noise.
    step : float
        Of integration [s]; the updated model has .25 ms.
    every : int
        One sample in so many of the record's.
    **changes
        Other arguments of `IsolatedBridge`.
    """
    from .models.isolated_bridge import IsolatedBridge

    model = IsolatedBridge(record, outputs=outputs, step=step, every=every, **changes)
    values = model.simulate([theta[name] for name in model.parameter_names])
    rms = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    values = values + noise * rms * np.random.default_rng(seed).standard_normal(values.shape)
    description = (
        f"SYNTHETIC, nominal values assumed: response of IsolatedBridge (step {1e3 * step:g} ms) to {record.name}"
        + (f", plus white noise of {100 * noise:g} % of each channel's root mean square (seed {seed})" if noise else "")
    )
    return Measurements(model.channels, model.dt, values, description)


def isolated_bridge_prior(parameter_names: Sequence[str], sigmas: Mapping[str, float]) -> Prior:
    """Multiples of nominal N(1, .5) within [.2, 2.5]; half-normal noise of .3 scales, above a thousandth: all assumed.

    The paper gives no prior (specs/isolated_bridge.md, section 5).

    Parameters
    ----------
    parameter_names : sequence of str
        Structural parameters.
    sigmas : mapping of str to float
        Noise parameters and the scale of each: 1 for a shared sigma, the measured root mean square of a channel [SI].
    """
    structural = {name: TruncatedNormal(1.0, 0.5, 0.2, 2.5) for name in parameter_names}
    return Prior(structural | {name: TruncatedNormal(0.0, 0.3 * s, 1e-3 * s) for name, s in sigmas.items()})


def isolated_bridge(
    *,
    data: str = "twin",
    channels: tuple[str, ...] | int | None = None,
    noise: Any = "shared",
    record: Record | None = None,
    measurements: Measurements | None = None,
    seed: int = 1,
    cache: str | os.PathLike | SimulationCache | None = None,
    **changes,
) -> Posterior:
    """Posterior of the isolated bridge: ten parameters of friction and dampers, and the noise.

    Parameters
    ----------
    data : {"twin", "means"}
        Bundled synthetic test: "twin" has a known truth and one mode; "means" holds only means of the two piers, so
        the devices of the piers can be exchanged: exactly two modes, whose masses are known
        (`IsolatedBridge.exchanged`).
    channels : tuple of str, 5, 6 or 10, optional
        Measured channels that are used. Default: six of "twin", as in the paper's figure of the fit; all of any other.
    noise : {"shared", "per channel", "autoregressive", "marginal"}, or a noise of `fe_likelihoods.probability.noise`
        White, one sigma for all channels, in root mean squares of the measured channel, as in the paper's results, or
        one for each channel [SI], its general formulation; or an error that lasts, with a correlation ``rho_...`` per
        channel too (uniform between -1 and 1). "marginal" is "shared" with sigma integrated out
        (`Posterior.marginal`): ten parameters.
    record, measurements : optional
        Table motion and responses of your own. With a record alone, synthetic measurements are made for it
        (`isolated_bridge_measurements`). Measurements may have a step that is a multiple of the record's.
    seed : int
        Of the noise, where measurements are made.
    cache : path or SimulationCache, optional
        Where simulations are kept from run to run (see `FELikelihood`).
    **changes
        Other arguments of `IsolatedBridge`: step, friction, bearings, parameters ...

    Returns
    -------
    Posterior

    Raises
    ------
    ValueError
        For unknown names, for measurements without a record, or that do not fit it.
    """
    from .models.isolated_bridge import IsolatedBridge

    if record is None:
        if measurements is not None:
            raise ValueError("measurements came without the record that caused them: give record= too")
        bundled = isolated_bridge_data(data)
        record, measurements = bundled.record, bundled.measurements
        channels = 6 if channels is None and data == "twin" else channels
    elif measurements is None:
        measurements = isolated_bridge_measurements(record, seed=seed)
    names = CHANNEL_SETS.get(channels) if isinstance(channels, int) else channels
    if isinstance(channels, int) and names is None:
        raise ValueError(f"expected channels by name, or one of the sets {tuple(CHANNEL_SETS)}; got {channels}")
    if names is not None:
        measurements = measurements.select(names)
    every = round(measurements.dt / record.dt)
    model = IsolatedBridge(
        record, outputs=tuple(c.name for c in measurements.channels), **({"every": max(1, every)} | changes)
    )
    law = _noise("shared" if noise == "marginal" else noise, model.channels, measurements)
    rms = SharedGaussianNoise.of(measurements).scales
    scales = {"sigma": 1.0} | {f"sigma_{c.name}": scale for c, scale in zip(measurements.channels, rms, strict=True)}
    sigmas = {name: scales[name] for name in law.parameter_names if name in scales}
    prior = isolated_bridge_prior(model.parameter_names, sigmas).distributions | _rest(law.parameter_names, scales)
    posterior = Posterior(FELikelihood(model, measurements, law, cache=cache), prior)
    return posterior.marginal() if noise == "marginal" else posterior
