"""Ready-made posteriors with bundled data: a bridge column, a seismically isolated bridge, and a free vibration.

`bridge_column` is the full-scale bridge column of the LHPOST tests, updated as in Ramancha et al. (2022): five
multiples of nominal values with normal priors truncated at zero, and two noise levels with half-normal priors. The
measured record and responses are not public. The bundled data are **synthetic** (``data/README.md``): EQ1, and a set
of EQ1 and a stronger EQ2 (``data="eq1-eq2"``) that informs every parameter, and a short test for first examples
(``data="short"``).

`isolated_bridge` is a bridge on sliding bearings with fluid dampers, after the shake-table tests of Tsopelas et al.
(1994): ten multiples of nominal values of friction and dampers. Its data are **synthetic** and most nominal values are
**assumed** (``docs/theory/isolated_bridge.rst``).

References
----------
M. K. Ramancha, R. Astroza, J. P. Conte, J. I. Restrepo, M. D. Todd (2022), Bayesian nonlinear finite element model
updating of a full-scale bridge-column using sequential Monte Carlo.
P. Tsopelas, S. Okamoto, M. C. Constantinou, D. Ozaki, S. Fujii (1994), NCEER-TAISEI Corporation Research Program on
Sliding Seismic Isolation Systems for Bridges, Report NCEER 94-0002, State University of New York, Buffalo.

Examples
--------
>>> posterior = problems.bridge_column(data="short")
>>> posterior.parameter_names
['Ec', 'Es', 'a0', 'a1', 'ft', 'sigma_acceleration', 'sigma_displacement']
"""

# The models are imported inside the functions that make them, because numba takes longer to import than all the rest.

from __future__ import annotations

import os
from importlib import resources
from types import MappingProxyType
from typing import Any

import numpy as np

from .cache.simulation_cache import SimulationCache
from .likelihood.likelihood import FELikelihood
from .likelihood.posterior import Posterior
from .noise.gaussian import GaussianNoise
from .priors.distributions import HalfNormal, TruncatedNormal
from .priors.problem_priors import bridge_column_prior, correlation_priors, isolated_bridge_prior
from .signals.channels import Channel, Measurements
from .signals.datasets import Dataset, read_dataset
from .signals.records import Record
from .units import to_si

BRIDGE_COLUMN_MEANS = MappingProxyType({"Ec": 0.59, "Es": 0.96, "a0": 0.27, "a1": 4.78, "ft": 2.43})
"""Posterior means of Ramancha et al. (2022), Table 2, as multiples of the nominal values: the synthetic truth."""

BRIDGE_COLUMN_NOISE = MappingProxyType(
    {"acceleration": to_si(7.7, "in/s2").item(), "displacement": to_si(0.09, "in").item()}
)
"""Noise levels of Ramancha et al. (2022), Table 2 [SI]: standard deviations of the white noise in the data."""

SHORT_SUBSTEPS = 2
"""Integration steps per sample of the short record."""

_COLUMN_FILES = {
    "eq1": "bridge_column_eq1.h5",
    "eq1-eq2": "bridge_column_events.h5",
    "short": "templates/bridge_column_short.h5",
}
_BRIDGE_CHANNELS = ("Ub_1", "Fb_1", "drift_1", "shear_1", "acc_p1", "Ub_2")  # of "twin", by default
_BRIDGE_FILES = {"twin": "templates/isolated_bridge.h5", "means": "isolated_bridge_means.h5"}


def _bundled(name: str) -> Dataset:
    with resources.as_file(resources.files("fe_likelihoods.data") / name) as path:
        return read_dataset(path)


def bridge_column_data(data: str = "eq1") -> Dataset:
    """Read the bundled synthetic data of the bridge column: base motion, channels and truth (``data/README.md``).

    Parameters
    ----------
    data : {"eq1", "eq1-eq2", "short"}
        "eq1" is earthquake EQ1. "eq1-eq2" is EQ1, a pause of 10 s and a stronger EQ2: the record is an `Events`, and
        the measurements are NaN in the pause. Both have the truth of the paper, but other noise levels. "short" is ten
        seconds of another motion, with a truth within the priors.

    Returns
    -------
    Dataset
        Base motion, measured channels and truth.

    Raises
    ------
    ValueError
        If there is no such set.

    Examples
    --------
    >>> data = problems.bridge_column_data("short")
    >>> data.record.duration
    9.984375
    """
    if data not in _COLUMN_FILES:
        raise ValueError(f"expected data={', '.join(map(repr, _COLUMN_FILES))}; got {data!r}")
    return _bundled(_COLUMN_FILES[data])


def bridge_column(
    *,
    data: str | Dataset = "eq1",
    every: int = 1,
    duration: float | None = None,
    noise: Any = None,
    cache: SimulationCache | str | os.PathLike | None = None,
    **changes,
) -> Posterior:
    """Make the posterior of the bridge column: seven parameters, two measured channels.

    The likelihood is equation (3) of Ramancha et al. (2022).

    Parameters
    ----------
    data : {"eq1", "eq1-eq2", "short"} or Dataset
        Bundled data (`bridge_column_data`), or your own. "eq1" is EQ1, during which the bars stay elastic and the data
        say nothing about a1. "eq1-eq2" is EQ1 and a stronger EQ2, which inform every parameter. "short" is a test of
        ten seconds for first examples.
    every : int
        Use every n-th sample only: the record is resampled with a filter, the measurements are decimated. 2 halves the
        cost of a simulation.
    duration : float, optional
        Use the first `duration` seconds only.
    noise : Noise, optional
        Default: white noise with one sigma per channel, as in the paper. The priors of others are in
        `bridge_column_prior`; those of other sensors (`outputs`) have 0.3 times the measured root mean square as their
        scale.
    cache : SimulationCache or path, optional
        Cache of simulations on disk.
    **changes
        Other arguments of `RCColumn.lhpost`.

    Returns
    -------
    Posterior
        Parameters Ec, Es, a0, a1, ft (multiples of nominal values), sigma_acceleration [m/s²] and sigma_displacement
        [m], or parameters of another noise.

    Raises
    ------
    ValueError
        If there is no such bundled set, or the measurements do not match the record.

    Examples
    --------
    >>> posterior = problems.bridge_column(data="short")
    >>> posterior.parameter_names
    ['Ec', 'Es', 'a0', 'a1', 'ft', 'sigma_acceleration', 'sigma_displacement']
    """
    from .models.rc_column import RCColumn
    from .models.rc_column_materials import ColumnAnalysis

    if data == "short":
        changes = {"analysis": ColumnAnalysis(substeps=SHORT_SUBSTEPS)} | changes
    record, measurements, _ = bridge_column_data(data) if isinstance(data, str) else data
    if duration is not None:
        record, measurements = record.trim(0.0, duration), measurements.trim(0.0, duration)
    if every != 1:
        measurements = measurements.decimate(every)
        record = record.resample(record.dt * every)
    model = RCColumn.lhpost(record, **changes)
    noise = GaussianNoise(model.channels) if noise is None else noise
    likelihood = FELikelihood(model, measurements, noise, cache=cache)
    sensors = [channel.name for channel in model.channels if channel.name not in BRIDGE_COLUMN_NOISE]
    rms = measurements.select(sensors).root_mean_squares if sensors else ()
    prior = bridge_column_prior(noise.parameter_names, dict(zip(sensors, rms, strict=True)))
    return Posterior(likelihood, prior)


def _vibrate(theta: np.ndarray, n_steps: int = 200) -> np.ndarray:
    """Displacement [m] of a free vibration, (1, n_steps) at 0.01 s: multiples of 2 Hz squared and of 2 % damping."""
    time = 0.01 * np.arange(n_steps)
    omega = 2.0 * np.pi * 2.0 * np.sqrt(theta[0])
    return 0.05 * np.exp(-0.02 * theta[1] * omega * time)[None] * np.cos(omega * time)


def free_vibration() -> Posterior:
    """Posterior of a free vibration, a first example whose simulation takes microseconds.

    Its parameters are multiples of the nominal stiffness (2 Hz) and of the nominal damping (2 % of critical), and the
    noise level of one measured displacement. The measurements are **synthetic**: stiffness 1.1, damping 0.8, and white
    noise of 2 mm.

    Returns
    -------
    Posterior
        Parameters stiffness, damping and sigma_top [m].

    Examples
    --------
    >>> from fe_likelihoods import problems
    >>> problems.free_vibration().parameter_names
    ['stiffness', 'damping', 'sigma_top']
    """
    from .models.function import FunctionModel

    channels = [Channel("top", "displacement", "mm")]
    model = FunctionModel(_vibrate, ["stiffness", "damping"], channels, dt=0.01, n_steps=200)
    noise = 0.002 * np.random.default_rng(1).standard_normal((1, 200))
    description = "SYNTHETIC: free vibration with stiffness 1.1 and damping 0.8, plus white noise of 2 mm (seed 1)"
    measurements = Measurements(model.channels, model.dt, model.simulate([1.1, 0.8]) + noise, description)
    multiple = TruncatedNormal(1.0, 0.3)
    prior = {"stiffness": multiple, "damping": multiple, "sigma_top": HalfNormal(0.01)}
    return Posterior(FELikelihood(model, measurements), prior)


def table_motion(seed: int = 1994) -> Record:
    """Synthetic acceleration of the table: 15 s at 200 Hz, 0.8 g, at the time scale of a quarter-scale model.

    The motion is stochastic (Rezaeian & Der Kiureghian 2008, 2010). Its parameters are **assumed** and give bearing
    displacements of about 35 mm.
    """
    from .data.ground_motion import stochastic_motion

    motion = stochastic_motion(
        seed,
        dt=0.005,
        duration=15.005,
        peak=8.0,
        peak_time=4.0,
        shape=3.0,
        frequencies=(6.0, 3.0),
        drift_time=12.0,
        filter_damping=0.30,
        high_pass=0.30,
    )
    source = "SYNTHETIC: Rezaeian & Der Kiureghian (2008, 2010), assumed parameters, quarter-scale time"
    return Record("synthetic table motion", 0.005, motion, source)


def isolated_bridge_data(data: str = "twin") -> Dataset:
    """Read a bundled synthetic test of the isolated bridge, with assumed nominal values (``data/README.md``).

    Parameters
    ----------
    data : {"twin", "means"}
        "twin" has ten channels of both piers. "means" has five means over the two piers, whose posterior has two modes.

    Returns
    -------
    Dataset
        Table motion, measured channels and truth.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    if data not in _BRIDGE_FILES:
        raise ValueError(f'expected data="twin" or "means"; got {data!r}; for your own data give a Dataset')
    return _bundled(_BRIDGE_FILES[data])


def isolated_bridge(
    *,
    data: str | Dataset = "twin",
    channels: tuple[str, ...] | None = None,
    noise: Any = None,
    cache: str | os.PathLike | SimulationCache | None = None,
    **changes,
) -> Posterior:
    """Make the posterior of the isolated bridge: ten parameters of friction and dampers, and the noise.

    Parameters
    ----------
    data : {"twin", "means"} or Dataset
        Bundled synthetic test, or your own, whose step may be a multiple of its record's. "twin" has a known
        truth and one mode. "means" has only means over the two piers, so that the devices of the piers can be
        exchanged: its posterior has exactly two modes, whose masses are proportional to the prior densities.
    channels : tuple of str, optional
        Measured channels to use. Default: pier 1 and ``Ub_2`` of "twin", all of any other data.
    noise : Noise, optional
        Default: white noise with one sigma for all channels, in root mean squares of the measured channels.
        Correlations ``rho_...`` of another noise are uniform between -1 and 1.
    cache : SimulationCache or path, optional
        Cache of simulations on disk.
    **changes
        Other arguments of `IsolatedBridge`: step, bearings, parameters ...

    Returns
    -------
    Posterior
        Ten multiples of nominal values, and the parameters of the noise.

    Raises
    ------
    ValueError
        If a name is unknown, or the measurements do not match the record.

    Examples
    --------
    >>> problems.isolated_bridge().ndim
    11
    """
    from .models.isolated_bridge import IsolatedBridge

    channels = _BRIDGE_CHANNELS if channels is None and data == "twin" else channels
    record, measurements, _ = isolated_bridge_data(data) if isinstance(data, str) else data
    if channels is not None:
        measurements = measurements.select(channels)
    every = max(1, round(measurements.dt / record.dt))
    outputs = tuple(channel.name for channel in measurements.channels)
    model = IsolatedBridge(record, outputs=outputs, **({"every": every} | changes))
    noise = GaussianNoise(model.channels, groups="all") if noise is None else noise
    rms = measurements.root_mean_squares
    scales = {"sigma": 1.0} | {f"sigma_{name}": scale for name, scale in zip(outputs, rms, strict=True)}
    sigmas = {name: scales[name] for name in noise.parameter_names if name in scales}
    prior = isolated_bridge_prior(model.parameter_names, sigmas).distributions
    prior |= correlation_priors(noise.parameter_names, scales)
    return Posterior(FELikelihood(model, measurements, noise, cache=cache), prior)
