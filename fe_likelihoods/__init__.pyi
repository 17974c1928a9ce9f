from . import problems
from .adapters import nautilus_prior, serve, to_bilby, to_pints, to_pymc
from .cache.simulation_cache import SimulationCache
from .cache.verification import StaleCache
from .column_damage.damage import Damage, LimitState, damage, limit_states
from .column_damage.measures import DamageMeasures, damage_measures, damage_outputs
from .column_damage.park_ang import ParkAng, park_ang_constants
from .data.make_isolated_bridge import table_motion
from .emulation.emulator import ResponseEmulator
from .emulation.guide import ResponseGuide
from .emulation.modes import Mode, ModeSearch, find_modes
from .events.agreement import Agreement, compare_tests
from .events.hierarchical_posterior import HierarchicalPosterior, Varying
from .events.hierarchy import Hierarchy
from .events.leave_one_out import leave_one_out
from .events.ratios import EventRatios, LevelRatios
from .events.stored_posterior import StoredPosterior
from .likelihood.block_likelihood import BlockLogLikelihood
from .likelihood.failures import TooManyFailures
from .likelihood.joint import JointLikelihood
from .likelihood.likelihood import FELikelihood
from .likelihood.parameters import Parameter
from .likelihood.posterior import Posterior
from .likelihood.predictive_draws import MeasuredData, MeasuredHistory, PredictiveDraws
from .models.equivalent_linear import EquivalentLinear
from .models.executable import ExecutableModel
from .models.function import FunctionModel
from .models.isolated_bridge import IsolatedBridge
from .models.isolated_bridge_parts import Bearing, Damper, Pier, Rubber
from .models.linear_oscillator import LinearOscillator
from .models.linear_structure import LinearStructure
from .models.linear_structure_parts import BridgeDeck, ShearFrame
from .models.opensees import OpenSeesModel
from .models.rc_column import RCColumn
from .models.rc_column_curves import MaterialCurve, MomentCurvature, material_curves, moment_curvature
from .models.rc_column_parts import BarBuckling, Bars, Concrete, Hoops, LowCycleFatigue, Patches, Steel
from .models.steel_coupon import SteelCoupon
from .models.tall_buildings import GroupedFrame, ModalModel, ShearFlexuralBeam
from .models.umbridge import UMBridgeModel
from .noise.autoregressive import AutoregressiveNoise
from .noise.gaussian import GaussianNoise
from .noise.protocol import Noise
from .noise.residuals import ResidualChecks, effective_samples, innovations, plot_residuals, residual_checks
from .plots.damage import plot_damage
from .plots.histories import plot_histories, plot_loop
from .plots.materials import plot_material, plot_moment_curvature
from .plots.predictions import plot_bands, plot_fragility
from .plots.scores import plot_scores
from .plots.structures import plot_sensors
from .prediction.averaging import AveragedPrediction, average_predictions
from .prediction.fragility import Fragility, fragility, peak_ground_acceleration
from .prediction.fragility_curve import fit_fragility
from .prediction.held_out import score_left_out
from .prediction.new_event import event_level, event_ratio, predict_from_median, predict_new_event
from .prediction.prediction import Prediction
from .prediction.propagation import fit_measures, propagate
from .prediction.quantities import arias_intensity, dissipated_energy, final_value, peak, rms
from .prediction.reliability import Exceedance, exceedance
from .prediction.score_tables import HistoryScores, QuantityScores
from .prediction.scores import crps_normal, crps_samples, interval_score, log_score_normal, share_within
from .priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from .priors.mixture_prior import MixtureDistribution, fit_mixture
from .priors.multivariate import MultivariateDistribution, MultivariateNormal, TruncatedMultivariateNormal
from .priors.priors import Prior
from .reporting.report import report
from .signals.alignment import Alignment, align
from .signals.channels import Channel, Measurements
from .signals.datasets import Dataset, read_dataset, write_dataset
from .signals.durations import growing_durations
from .signals.error_measures import rrmse
from .signals.events import Events, EventWindow
from .signals.fits import plot_fit
from .signals.measurement_readers import ImposedTest, read_columns, read_imposed_test
from .signals.readers import (
    read_at2,
    read_csv,
    read_esm,
    read_geonet,
    read_knet,
    read_record,
    read_smc,
    read_v2,
)
from .signals.records import DisplacementHistory, Record
from .signals.response_spectrum import ResponseSpectrum, response_spectrum
from .simulation.dask_executor import DaskExecutor
from .simulation.faults import TransientReason
from .simulation.local_pool import LocalPool
from .simulation.model import ContinuedResponse, Model, SimulationFailed
from .units import from_si, to_si

__all__ = [
    "Agreement",
    "Alignment",
    "AutoregressiveNoise",
    "AveragedPrediction",
    "BarBuckling",
    "Bars",
    "Bearing",
    "BlockLogLikelihood",
    "BridgeDeck",
    "Channel",
    "Concrete",
    "ContinuedResponse",
    "Damage",
    "DamageMeasures",
    "Damper",
    "DaskExecutor",
    "Dataset",
    "DisplacementHistory",
    "Distribution",
    "EquivalentLinear",
    "EventRatios",
    "EventWindow",
    "Events",
    "Exceedance",
    "ExecutableModel",
    "FELikelihood",
    "Fragility",
    "FunctionModel",
    "GaussianNoise",
    "GroupedFrame",
    "HalfNormal",
    "HierarchicalPosterior",
    "Hierarchy",
    "HistoryScores",
    "Hoops",
    "ImposedTest",
    "IsolatedBridge",
    "JointLikelihood",
    "LevelRatios",
    "LimitState",
    "LinearOscillator",
    "LinearStructure",
    "LocalPool",
    "LogNormal",
    "LowCycleFatigue",
    "MaterialCurve",
    "MeasuredData",
    "MeasuredHistory",
    "Measurements",
    "MixtureDistribution",
    "ModalModel",
    "Mode",
    "ModeSearch",
    "Model",
    "MomentCurvature",
    "MultivariateDistribution",
    "MultivariateNormal",
    "Noise",
    "OpenSeesModel",
    "Parameter",
    "ParkAng",
    "Patches",
    "Pier",
    "Posterior",
    "Prediction",
    "PredictiveDraws",
    "Prior",
    "QuantityScores",
    "RCColumn",
    "Record",
    "ResidualChecks",
    "ResponseEmulator",
    "ResponseGuide",
    "ResponseSpectrum",
    "Rubber",
    "ShearFlexuralBeam",
    "ShearFrame",
    "SimulationCache",
    "SimulationFailed",
    "StaleCache",
    "Steel",
    "SteelCoupon",
    "StoredPosterior",
    "TooManyFailures",
    "TransientReason",
    "TruncatedMultivariateNormal",
    "TruncatedNormal",
    "UMBridgeModel",
    "Uniform",
    "Varying",
    "align",
    "arias_intensity",
    "average_predictions",
    "compare_tests",
    "crps_normal",
    "crps_samples",
    "damage",
    "damage_measures",
    "damage_outputs",
    "dissipated_energy",
    "effective_samples",
    "event_level",
    "event_ratio",
    "exceedance",
    "final_value",
    "find_modes",
    "fit_fragility",
    "fit_measures",
    "fit_mixture",
    "fragility",
    "from_si",
    "growing_durations",
    "innovations",
    "interval_score",
    "leave_one_out",
    "limit_states",
    "log_score_normal",
    "material_curves",
    "moment_curvature",
    "nautilus_prior",
    "park_ang_constants",
    "peak",
    "peak_ground_acceleration",
    "plot_bands",
    "plot_damage",
    "plot_fit",
    "plot_fragility",
    "plot_histories",
    "plot_loop",
    "plot_material",
    "plot_moment_curvature",
    "plot_residuals",
    "plot_scores",
    "plot_sensors",
    "predict_from_median",
    "predict_new_event",
    "problems",
    "propagate",
    "read_at2",
    "read_columns",
    "read_csv",
    "read_dataset",
    "read_esm",
    "read_geonet",
    "read_imposed_test",
    "read_knet",
    "read_record",
    "read_smc",
    "read_v2",
    "report",
    "residual_checks",
    "response_spectrum",
    "rms",
    "rrmse",
    "score_left_out",
    "serve",
    "share_within",
    "table_motion",
    "to_bilby",
    "to_pints",
    "to_pymc",
    "to_si",
    "write_dataset",
]
