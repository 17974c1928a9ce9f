from . import presets
from .rare_events import subset_simulation
from .reporting.arviz_data import to_arviz
from .reporting.figures import plot_corner, plot_marginals, plot_run
from .reporting.model_comparison import compare_models
from .reporting.summary import summary
from .reports import SamplingWarning
from .smc import SMCSampler, TMCMCSampler
from .tempering.guide import Guide

__all__ = [
    "Guide",
    "SMCSampler",
    "SamplingWarning",
    "TMCMCSampler",
    "compare_models",
    "plot_corner",
    "plot_marginals",
    "plot_run",
    "presets",
    "subset_simulation",
    "summary",
    "to_arviz",
]
