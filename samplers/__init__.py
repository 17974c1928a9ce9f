"""Tempered ensemble samplers behind emcee's interface.

All public names can be imported from here, ``from samplers import SMCSampler, compare_models``, and are loaded on first
use: importing the package takes about 0.01 s, importing emcee with `scipy.stats` takes longer.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers; at run time `_EXPORTS` says the same
    from . import presets
    from .cost import (
        CostEstimate,
        estimate_cost,
    )
    from .moves.guided import (
        GuideMove,
    )
    from .moves.kernels import (
        MixtureMove,
        RandomWalkMove,
        StudentTMove,
    )
    from .presets import (
        CHING_CHEN_2007,
        RAMANCHA_2022_CONSTANT,
        RAMANCHA_2022_LITERAL,
    )
    from .reporting.arviz_data import (
        to_arviz,
    )
    from .reporting.corner_figures import (
        plot_corner,
        plot_marginals,
    )
    from .reporting.diagnosis import (
        Diagnostics,
    )
    from .reporting.model_comparison import (
        ModelComparison,
        compare_models,
    )
    from .reporting.pair_figures import (
        plot_pairs,
    )
    from .reporting.run_figures import (
        plot_ladder,
        plot_run,
    )
    from .reporting.summary import (
        Summary,
        comparison_table,
        ladder_table,
        summary,
    )
    from .smc import (
        SMCSampler,
    )
    from .storage.ladder_file import (
        read_ladder,
    )
    from .tempered import (
        TemperedSampler,
    )
    from .tempering.diagnostics import (
        SamplingWarning,
    )
    from .tempering.evidence_check import (
        EvidenceCheck,
    )
    from .tempering.failed_region import (
        NearFailures,
        failures_near,
    )
    from .tempering.guide import (
        Guide,
        GuideSession,
    )
    from .tempering.modes import (
        Mode,
    )
    from .tempering.population import (
        GuidedRound,
        Stage,
    )
    from .tempering.settings import (
        GuidedSettings,
        RecyclingSettings,
        Settings,
    )
    from .tempering.verdict import (
        Verdict,
    )
    from .tmcmc import (
        TMCMCSampler,
    )

__all__ = [
    "CHING_CHEN_2007",
    "CostEstimate",
    "Diagnostics",
    "EvidenceCheck",
    "Guide",
    "GuideMove",
    "GuideSession",
    "GuidedRound",
    "GuidedSettings",
    "MixtureMove",
    "Mode",
    "ModelComparison",
    "NearFailures",
    "RAMANCHA_2022_CONSTANT",
    "RAMANCHA_2022_LITERAL",
    "RandomWalkMove",
    "RecyclingSettings",
    "SMCSampler",
    "SamplingWarning",
    "Settings",
    "Stage",
    "StudentTMove",
    "Summary",
    "TMCMCSampler",
    "TemperedSampler",
    "Verdict",
    "compare_models",
    "comparison_table",
    "estimate_cost",
    "failures_near",
    "ladder_table",
    "plot_corner",
    "plot_ladder",
    "plot_marginals",
    "plot_pairs",
    "plot_run",
    "presets",
    "read_ladder",
    "summary",
    "to_arviz",
]

_EXPORTS = {
    "cost": (
        "CostEstimate",
        "estimate_cost",
    ),
    "moves.guided": ("GuideMove",),
    "moves.kernels": (
        "MixtureMove",
        "RandomWalkMove",
        "StudentTMove",
    ),
    "presets": (
        "CHING_CHEN_2007",
        "RAMANCHA_2022_CONSTANT",
        "RAMANCHA_2022_LITERAL",
    ),
    "reporting.arviz_data": ("to_arviz",),
    "reporting.corner_figures": (
        "plot_corner",
        "plot_marginals",
    ),
    "reporting.diagnosis": ("Diagnostics",),
    "reporting.model_comparison": (
        "ModelComparison",
        "compare_models",
    ),
    "reporting.pair_figures": ("plot_pairs",),
    "reporting.run_figures": (
        "plot_ladder",
        "plot_run",
    ),
    "reporting.summary": (
        "Summary",
        "comparison_table",
        "ladder_table",
        "summary",
    ),
    "smc": ("SMCSampler",),
    "storage.ladder_file": ("read_ladder",),
    "tempered": ("TemperedSampler",),
    "tempering.diagnostics": ("SamplingWarning",),
    "tempering.evidence_check": ("EvidenceCheck",),
    "tempering.failed_region": (
        "NearFailures",
        "failures_near",
    ),
    "tempering.guide": (
        "Guide",
        "GuideSession",
    ),
    "tempering.modes": ("Mode",),
    "tempering.population": (
        "GuidedRound",
        "Stage",
    ),
    "tempering.settings": (
        "GuidedSettings",
        "RecyclingSettings",
        "Settings",
    ),
    "tempering.verdict": ("Verdict",),
    "tmcmc": ("TMCMCSampler",),
}
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names}


def __getattr__(name: str) -> Any:
    """A public name, or a module or folder of the package, imported on first use (PEP 562)."""
    if name in _MODULE_OF:
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value
    full = f"{__name__}.{name}"
    try:
        return import_module(full)
    except ModuleNotFoundError as error:
        if error.name != full:  # the module exists and lacks one of its own imports
            raise
        raise AttributeError(f"module {__name__!r} has no attribute and no module {name!r}") from None


def __dir__() -> list[str]:
    from pkgutil import iter_modules

    return sorted({*globals(), *__all__, *(module.name for module in iter_modules(__path__))})
