"""Structural finite-element models as black-box log-likelihoods.

All public names can be imported from here, ``from fe_likelihoods import Record, FELikelihood, Posterior``, and are
loaded on first use: importing the package takes about 0.01 s. The names are listed in ``__init__.pyi``, which editors
and type checkers read as well. Other modules are imported by their names, as in ``import fe_likelihoods.units``.
"""

from importlib import import_module

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# names that were public: what takes their place, or their module
_REPLACED = {
    "BandNoise": 'GaussianNoise(channels, groups=edges, level="response", sensor=...), without level= for SI units',
    "EventNoise": 'GaussianNoise(channels, groups="event")',
    "LevelRatios": 'EventRatios(values, levels=..., form="linear")',
    "MarginalNoise": "posterior.marginal()",
    "ModulatedNoise": 'GaussianNoise(channels, level="response", window=..., sensor=...)',
    "RelativeNoise": 'GaussianNoise(channels, level="measured")',
    "SharedGaussianNoise": 'GaussianNoise(channels, groups="all")',
    "TimeShiftNoise": "FELikelihood(..., time_shifts={channel: largest shift [s]})",
    "compare_tests": "a sentence of the population: print(hierarchy), Hierarchy.spread",
    "event_level": "part of event_ratios(hierarchy, posteriors, quantity), as levels",
    "event_ratio": "event_ratios(hierarchy, posteriors, quantity), of all events together",
    "predict_from_median": "predict_new_event(hierarchy, posteriors, record, model=..., quantity=...)",
    "score_left_out": "leave_one_out(hierarchy).scores(posteriors, quantity=...)",
}
_IN_MODULES = {
    "adapters": "serve to_bilby to_pymc",
    "cache.verification": "StaleCache",
    "column_damage.damage": "Damage LimitState",
    "column_damage.measures": "DamageMeasures",
    "column_damage.park_ang": "ParkAng",
    "emulation.emulator": "ResponseEmulator",
    "emulation.guide": "ResponseGuide",
    "emulation.modes": "Mode ModeSearch find_modes",
    "events.stiffness_loss": "StiffnessLoss",
    "information.identifiability": "Combination Identifiability",
    "information.sensitivity": "Sensitivity",
    "information.sensors": "SensorRanking",
    "likelihood.block_likelihood": "BlockLogLikelihood",
    "likelihood.failures": "TooManyFailures",
    "likelihood.parameters": "Parameter",
    "likelihood.predictive_draws": "MeasuredData MeasuredHistory PredictiveDraws",
    "models.isolated_bridge_parts": "Bearing Damper Pier Rubber",
    "models.rc_column_curves": "MaterialCurve MomentCurvature",
    "models.rc_column_parts": "Patches",
    "noise.protocol": "Noise",
    "noise.residuals": "ResidualChecks innovations",
    "plots.histories": "plot_histories",
    "prediction.averaging": "AveragedPrediction",
    "prediction.fragility": "Fragility peak_ground_acceleration",
    "prediction.fragility_curve": "fit_fragility",
    "prediction.prediction": "Prediction",
    "prediction.quantities": "displacement_before_failure find_failure",
    "prediction.reliability": "Exceedance",
    "prediction.score_tables": "HistoryScores QuantityScores",
    "prediction.scores": "Share crps_normal crps_samples log_score_normal",
    "priors.distributions": "Distribution",
    "priors.mixture_prior": "MixtureDistribution",
    "priors.multivariate": "MultivariateDistribution",
    "problems": "table_motion",
    "signals.alignment": "Alignment",
    "signals.datasets": "Dataset read_dataset write_dataset",
    "signals.events": "EventWindow",
    "signals.measurement_readers": "ImposedTest",
    "signals.readers": "read_at2 read_csv read_esm read_geonet read_knet read_smc read_v2",
    "signals.response_spectrum": "ResponseSpectrum response_spectrum",
    "simulation.faults": "TransientReason",
    "simulation.local_pool": "LocalPool",
    "simulation.model": "Model",
}


def __getattr__(name: str) -> object:
    """A public name, loaded on first use; ImportError for one that is elsewhere, since it is the error of an import."""
    if name in _REPLACED:
        raise ImportError(f"fe_likelihoods.{name} is now {_REPLACED[name]}")
    for module, names in _IN_MODULES.items():
        if name in names.split():
            raise ImportError(f"{name} is imported from its module: from fe_likelihoods.{module} import {name}")
    try:
        return _load(name)
    except AttributeError:
        if not name.startswith("_") and name in import_module("samplers").__all__:
            raise ImportError(f"{name} is in the other package: from samplers import {name}") from None
        raise
