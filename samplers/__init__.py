"""Tempered ensemble samplers behind the interface of emcee."""

from .alarms import SamplingWarning
from .backends import read_ladder
from .ladder import Stage
from .presets import RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
from .smc import SMCSampler
from .tempered import TemperedSampler

__all__ = [
    "RAMANCHA_2022_CONSTANT",
    "RAMANCHA_2022_LITERAL",
    "SMCSampler",
    "SamplingWarning",
    "Stage",
    "TemperedSampler",
    "read_ladder",
]
