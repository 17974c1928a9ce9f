"""Tempered ensemble samplers behind emcee's interface.

All public names can be imported from here, ``from samplers import SMCSampler, compare_models``, and are loaded on first
use: importing the package takes about 0.01 s, importing emcee with `scipy.stats` takes longer. The names are listed in
``__init__.pyi``, which editors and type checkers read as well.
"""

from importlib import import_module

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# names that were public in 0.2: what takes their place, or their module
_REPLACED = {
    "CHING_CHEN_2007": "presets.CHING_CHEN_2007",
    "Diagnostics": "Verdict, which sampler.verdict returns",
    "GuidedSettings": "part of the sampler, without settings",
    "RAMANCHA_2022_CONSTANT": "presets.RAMANCHA_2022_CONSTANT",
    "RAMANCHA_2022_LITERAL": "presets.RAMANCHA_2022_LITERAL",
    "RecyclingSettings": "part of the sampler, without settings but recycle= and runs=",
    "plot_ladder": "part of plot_run",
    "plot_pairs": "a function of tutorials/02_bridge_column.py; plot_corner draws pairs of parameters",
    "read_ladder": "sampler.ladder, also of a sampler that is made for the file of a run",
}
_IN_MODULES = {
    "cost": "CostEstimate",
    "estimates.importance": "EvidenceCheck",
    "judgement.failures": "NearFailures failures_near",
    "judgement.modes": "Mode",
    "moves.population_moves": "ConditionalMove GuideMove",
    "rare_events": "RareEvent",
    "reporting.model_comparison": "ModelComparison",
    "reporting.summary": "Summary",
    "reports": "GuidedRound",
    "settings": "Settings",
    "tempering.guide": "GuideSession",
}


def __getattr__(name: str) -> object:
    """A public name, loaded on first use; ImportError for one that is elsewhere, since it is the error of an import."""
    if name in _REPLACED:
        raise ImportError(f"samplers.{name} is now {_REPLACED[name]}")
    for module, names in _IN_MODULES.items():
        if name in names.split():
            raise ImportError(f"{name} is imported from its module: from samplers.{module} import {name}")
    try:
        return _load(name)
    except AttributeError:
        if not name.startswith("_") and name in import_module("fe_likelihoods").__all__:
            raise ImportError(f"{name} is in the other package: from fe_likelihoods import {name}") from None
        raise
