"""The objects that the plotting functions accept, as protocols.

The plotting functions import nothing of the library but `fe_likelihoods.units`. They read the attributes listed here,
so any object with these attributes can be plotted. All values are in SI units; `unit` is the display unit of a channel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

__all__ = [
    "BarsLike",
    "ChannelHistories",
    "ChannelLike",
    "ColumnLike",
    "CurveLike",
    "DamageLike",
    "ExceedanceLike",
    "FragilityLike",
    "HistoryLike",
    "HistoryScoresLike",
    "HoopsLike",
    "MaterialCurveLike",
    "MomentCurvatureLike",
    "NamedLike",
    "PatchesLike",
    "PredictionLike",
    "QuantityScoresLike",
    "RecordLike",
    "ResidualChecksLike",
    "SpectrumLike",
]


class ChannelLike(Protocol):
    """A measured quantity, such as `fe_likelihoods.Channel`."""

    name: str
    quantity: str
    unit: str

    @property
    def dimension(self) -> str:
        """Dimension of the values, a key of `fe_likelihoods.units.DIMENSIONS`."""


class NamedLike(Protocol):
    """An excitation or another object with a name."""

    name: str


class RecordLike(NamedLike, Protocol):
    """A ground motion, such as `fe_likelihoods.Record`."""

    acceleration: np.ndarray

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, shape (n_steps,) [s]."""

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""


class ChannelHistories(Protocol):
    """Histories of channels, such as `fe_likelihoods.Measurements`."""

    channels: Sequence[ChannelLike]
    description: str

    def times(self, name: str) -> np.ndarray:
        """Sample times of one channel, shape (n_steps,) [s]."""

    def channel(self, name: str) -> np.ndarray:
        """History of one channel, shape (n_steps,) [SI]; NaN where a sample is missing."""


class SpectrumLike(Protocol):
    """A response spectrum, such as `fe_likelihoods.signals.response_spectrum.ResponseSpectrum`."""

    periods: np.ndarray
    damping_ratio: float
    displacement: np.ndarray
    pseudo_velocity: np.ndarray
    pseudo_acceleration: np.ndarray


class PredictionLike(Protocol):
    """A prediction of histories, such as `fe_likelihoods.prediction.prediction.Prediction`."""

    channels: Sequence[ChannelLike]
    mean: np.ndarray
    probabilities: Sequence[float]
    noise: bool

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, shape (n_steps,) [s]."""

    def quantile(self, probability: float) -> np.ndarray:
        """Quantile of all channels, shape (n_channels, n_steps) [SI]."""


class HistoryScoresLike(Protocol):
    """Scores of predicted histories, such as `fe_likelihoods.prediction.score_tables.HistoryScores`."""

    channels: Sequence[ChannelLike]
    level: float
    rms: np.ndarray
    interval_score: np.ndarray
    width: np.ndarray
    coverage: np.ndarray
    coverage_by_level: np.ndarray
    coverage_error: np.ndarray
    pit: np.ndarray
    effective_samples: np.ndarray


class QuantityScoresLike(Protocol):
    """Scores of predicted numbers, such as `fe_likelihoods.prediction.score_tables.QuantityScores`."""

    names: Sequence[str]
    units: Sequence[str]
    level: float
    measured: np.ndarray
    median: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    lower_quartile: np.ndarray
    upper_quartile: np.ndarray
    interval_score: np.ndarray
    pit: np.ndarray


class CurveLike(Protocol):
    """A lognormal fragility curve, such as `fe_likelihoods.prediction.fragility_curve.FragilityCurve`."""

    median: float
    dispersion: float

    def probability(self, intensity: np.ndarray) -> np.ndarray:
        """Probability of exceedance at positive intensities."""


class FragilityLike(Protocol):
    """Probabilities of exceedance per record, such as `fe_likelihoods.prediction.fragility.Fragility`."""

    intensity: np.ndarray
    probability: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    curve: CurveLike | None


class ExceedanceLike(Protocol):
    """Probabilities of exceedance, such as `fe_likelihoods.prediction.reliability.Exceedance`."""

    probability: np.ndarray
    standard_error: np.ndarray


class DamageLike(Protocol):
    """Damage of a column after events, such as `fe_likelihoods.column_damage.damage.Damage`; lengths in metres."""

    events: Sequence[str]
    presence: Mapping[str, ExceedanceLike]
    location: Mapping[str, ExceedanceLike]
    extent: Mapping[str, np.ndarray]
    probabilities: Sequence[float]
    heights: np.ndarray
    height: float
    effective_sample_size: float
    failures: str
    uncertainty: str


class ResidualChecksLike(Protocol):
    """Checks of residuals, such as `fe_likelihoods.noise.residuals.ResidualChecks`."""

    lag_one: np.ndarray
    n_effective: np.ndarray

    @property
    def sentences(self) -> Sequence[str]:
        """Verdict on each channel, in words."""


class HistoryLike(Protocol):
    """Named histories of one simulation [SI], such as the result of ``RCColumn.history``."""

    names: Sequence[str]

    def __getitem__(self, name: str) -> np.ndarray:
        """History of one quantity, shape (n_steps,)."""


class MaterialCurveLike(NamedLike, Protocol):
    """Stress of a material under a history of strain, such as `MaterialCurve`."""

    strain: np.ndarray
    stress: np.ndarray


class MomentCurvatureLike(Protocol):
    """Moment of a section under a history of curvature, such as `MomentCurvature`."""

    curvature: np.ndarray
    moment: np.ndarray
    axial_force: float


class BarsLike(Protocol):
    """Longitudinal bars on a circle."""

    number: int
    diameter: float
    first_angle: float


class HoopsLike(Protocol):
    """Circular hoops."""

    diameter: float
    spacing: float


class PatchesLike(Protocol):
    """A mesh of rings and wedges."""

    wedges: int
    core_rings: int
    cover_rings: int


class ColumnLike(Protocol):
    """A circular reinforced-concrete column, such as `fe_likelihoods.RCColumn`; lengths in metres."""

    diameter: float
    height: float
    cover: float
    bars: BarsLike
    hoops: HoopsLike
    mesh: int | PatchesLike
    units: Mapping[str, str] | Sequence[tuple[str, str]]
    loading: NamedLike

    @property
    def channels(self) -> Sequence[ChannelLike]:
        """Channels of the response."""

    @property
    def section_heights(self) -> np.ndarray:
        """Heights of the sections above the base [m]."""

    @property
    def core_diameter(self) -> float:
        """Diameter of the confined core [m]."""

    @property
    def bar_circle_radius(self) -> float:
        """Radius of the circle through the centres of the longitudinal bars [m]."""
