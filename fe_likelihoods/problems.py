"""Ready-made posteriors, with bundled data: the two systems of the papers.

`bridge_column` is the full-scale bridge column of the LHPOST tests, updated as in the paper: five multiples of nominal
values with normal priors truncated at zero, two noise levels with half-normal priors. The measured record and
responses of the paper could not be had; the bundled data are **synthetic** (see ``data/README.md``), and
`bridge_column_measurements` makes such data for any other base motion.
"""

from __future__ import annotations

from importlib import resources
from types import MappingProxyType

import numpy as np

from .channels import Dataset, Measurements, read_dataset
from .likelihood import FELikelihood
from .models.rc_column import RCColumn
from .posterior import Posterior
from .priors import HalfNormal, Prior, TruncatedNormal
from .records import Record
from .units import to_si

__all__ = [
    "BRIDGE_COLUMN_MEANS",
    "BRIDGE_COLUMN_NOISE",
    "bridge_column",
    "bridge_column_data",
    "bridge_column_measurements",
    "bridge_column_prior",
]

BRIDGE_COLUMN_MEANS = MappingProxyType({"Ec": 0.59, "Es": 0.96, "a0": 0.27, "a1": 4.78, "ft": 2.43})
"""Posterior means of the paper (Table 2), multiples of the nominal values: the truth of the synthetic data."""

BRIDGE_COLUMN_NOISE = MappingProxyType(
    {"acceleration": to_si(7.7, "in/s2").item(), "displacement": to_si(0.09, "in").item()}
)
"""Noise levels of the paper (Table 2) [SI]: standard deviations of the white noise of the synthetic data."""


def bridge_column_data() -> Dataset:
    """The bundled synthetic EQ1: base record, measured channels and how they were made (``data/README.md``)."""
    with resources.as_file(resources.files("fe_likelihoods.data") / "bridge_column_eq1.h5") as path:
        return read_dataset(path)


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


def bridge_column_prior() -> Prior:
    """The paper's prior: normal, truncated at zero, CV .30 .20 .60 .60 .40; half-normal of .1 g and 1.2 in."""
    structural = {"Ec": 0.30, "Es": 0.20, "a0": 0.60, "a1": 0.60, "ft": 0.40}
    return Prior(
        {name: TruncatedNormal(1.0, cv) for name, cv in structural.items()}
        | {
            "sigma_acceleration": HalfNormal(to_si(0.1, "g").item()),
            "sigma_displacement": HalfNormal(to_si(1.2, "in").item()),
        }
    )


def bridge_column(
    *,
    record: Record | None = None,
    measurements: Measurements | None = None,
    every: int = 1,
    duration: float | None = None,
    seed: int = 1,
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
    seed : int
        Of the noise, where measurements are made.
    **changes
        Other arguments of `RCColumn.lhpost`.

    Returns
    -------
    Posterior
        Parameters Ec, Es, a0, a1, ft (multiples of nominal), sigma_acceleration [m/s2], sigma_displacement [m].

    Raises
    ------
    ValueError
        For measurements without a record, or that do not fit it.
    """
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
    return Posterior(FELikelihood(model, measurements), bridge_column_prior())
