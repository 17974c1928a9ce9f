from . import problems
from .adapters.identification import read_modal_data
from .cache.simulation_cache import SimulationCache
from .checks.result import check_model, check_result
from .checks.screening import check_data
from .column_damage.damage import damage, limit_states
from .column_damage.measures import damage_measures, damage_outputs
from .column_damage.park_ang import park_ang_constants
from .information.identifiability import identifiability
from .information.sensitivity import sensitivity
from .information.sensors import rank_sensors
from .likelihood.function_likelihood import FunctionLikelihood
from .likelihood.joint import JointLikelihood
from .likelihood.likelihood import FELikelihood
from .likelihood.posterior import Posterior
from .modal.modal_data import ModalData
from .modal.modal_likelihood import ModalLikelihood
from .modal.mode_models import FunctionModes
from .models.executable import ExecutableModel
from .models.frames_and_decks import BridgeDeck, ModalModel, ShearFrame
from .models.function import FunctionModel
from .models.isolated_bridge import IsolatedBridge
from .models.linear_oscillator import LinearOscillator
from .models.linear_structure import LinearStructure
from .models.opensees import OpenSeesModel
from .models.rc_column import RCColumn
from .models.rc_column_curves import material_curves, moment_curvature
from .models.rc_column_materials import Bars, ColumnAnalysis, Concrete, Hoops, LowCycleFatigue, Steel
from .models.sensor_errors import SensedModel, Sensor
from .models.umbridge import UMBridgeModel
from .noise.autoregressive import AutoregressiveNoise
from .noise.gaussian import GaussianNoise
from .noise.residuals import residual_checks
from .plots.damage import plot_damage
from .plots.histories import (
    plot_bands,
    plot_fit,
    plot_histories,
    plot_record,
    plot_residuals,
    plot_spectrum,
)
from .plots.scores import plot_scores
from .plots.sensors import plot_ranking
from .plots.structures import plot_hysteresis, plot_section, plot_sensors
from .population.event_ratios import EventRatios
from .population.hierarchical_posterior import HierarchicalPosterior, Varying
from .population.hierarchy import Hierarchy
from .population.stiffness_loss import stiffness_loss
from .population.stored_posterior import StoredPosterior
from .prediction.exceedance import exceedance
from .prediction.fragility import fragility
from .prediction.held_out import leave_one_out
from .prediction.new_event import event_ratios, predict_new_event
from .prediction.propagation import propagate
from .prediction.quantities import final_value, peak, rms
from .prediction.scores import share_within
from .priors.distributions import HalfNormal, LogNormal, TruncatedNormal, Uniform
from .priors.mixture_prior import fit_mixture
from .priors.priors import Prior
from .reporting.report import report
from .signals.alignment import align
from .signals.channels import Channel, Measurements
from .signals.read import read_columns, read_record
from .signals.records import DisplacementHistory, Events, Record
from .simulation.model import SimulationFailed
from .units import from_si, to_si

__all__ = [
    "AutoregressiveNoise",
    "Bars",
    "BridgeDeck",
    "Channel",
    "ColumnAnalysis",
    "Concrete",
    "DisplacementHistory",
    "EventRatios",
    "Events",
    "ExecutableModel",
    "FELikelihood",
    "FunctionLikelihood",
    "FunctionModel",
    "FunctionModes",
    "GaussianNoise",
    "HalfNormal",
    "HierarchicalPosterior",
    "Hierarchy",
    "Hoops",
    "IsolatedBridge",
    "JointLikelihood",
    "LinearOscillator",
    "LinearStructure",
    "LogNormal",
    "LowCycleFatigue",
    "Measurements",
    "ModalData",
    "ModalLikelihood",
    "ModalModel",
    "OpenSeesModel",
    "Posterior",
    "Prior",
    "RCColumn",
    "Record",
    "SensedModel",
    "Sensor",
    "ShearFrame",
    "SimulationCache",
    "SimulationFailed",
    "Steel",
    "StoredPosterior",
    "TruncatedNormal",
    "UMBridgeModel",
    "Uniform",
    "Varying",
    "align",
    "check_data",
    "check_model",
    "check_result",
    "damage",
    "damage_measures",
    "damage_outputs",
    "event_ratios",
    "exceedance",
    "final_value",
    "fit_mixture",
    "fragility",
    "from_si",
    "identifiability",
    "leave_one_out",
    "limit_states",
    "material_curves",
    "moment_curvature",
    "park_ang_constants",
    "peak",
    "plot_bands",
    "plot_damage",
    "plot_fit",
    "plot_histories",
    "plot_hysteresis",
    "plot_ranking",
    "plot_record",
    "plot_residuals",
    "plot_scores",
    "plot_section",
    "plot_sensors",
    "plot_spectrum",
    "predict_new_event",
    "problems",
    "propagate",
    "rank_sensors",
    "read_columns",
    "read_modal_data",
    "read_record",
    "report",
    "residual_checks",
    "rms",
    "sensitivity",
    "share_within",
    "stiffness_loss",
    "to_si",
]
