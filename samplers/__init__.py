"""Tempered ensemble samplers behind the interface of emcee."""

from .alarms import SamplingWarning
from .backends import read_ladder
from .importance import EvidenceCheck
from .ladder import Stage
from .presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
from .smc import SMCSampler
from .tempered import TemperedSampler
from .tmcmc import TMCMCSampler

__all__ = [
    "CHING_CHEN_2007",
    "EvidenceCheck",
    "RAMANCHA_2022_CONSTANT",
    "RAMANCHA_2022_LITERAL",
    "SMCSampler",
    "SamplingWarning",
    "Stage",
    "TMCMCSampler",
    "TemperedSampler",
    "read_ladder",
]
