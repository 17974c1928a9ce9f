"""A structure whose fragility is known."""

import numpy as np

from fe_likelihoods import peak, propagate
from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import SimulationFailed
from fe_likelihoods.units import G0

MEDIAN, DISPERSION = 0.4 * G0, 0.35


class Flexible:
    """Displacement = flexibility times base acceleration. With a lognormal flexibility the fragility is lognormal."""

    parameter_names = ("log_flexibility",)
    channels = (Channel("displacement", "relative displacement", "cm"),)
    fingerprint = "flexible"
    path_dependent = False

    def __init__(self, record, limit=np.inf, reason="did not converge"):
        self.record, self.limit, self.reason = record, limit, reason
        self.dt, self.n_steps = record.dt, record.n_steps

    def with_record(self, record):
        if not isinstance(record, Record):
            raise ValueError(f"expected a Record; got {type(record).__name__}")
        return type(self)(record, self.limit, self.reason)

    def simulate(self, theta):
        displacement = 0.1 / MEDIAN * np.exp(theta[0]) * self.record.acceleration
        if np.abs(displacement).max() > self.limit:
            raise SimulationFailed(self.reason)
        return displacement[None]


def under(records, model, samples, quantity=peak("displacement"), **settings):
    """Predictions of a number under each record."""
    settings = {"from_state": "virgin", "progress": False} | settings
    return [propagate(model, samples, record=each, quantity=quantity, **settings) for each in records]


def strongest(records):
    """Peak acceleration of each record [m/s²]."""
    return [np.abs(each.acceleration).max() for each in records]
