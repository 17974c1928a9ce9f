"""The excitation of a prediction, and the state of the structure at its beginning.

A structure with memory, such as cracked concrete, responds to an earthquake according to what happened before. A
prediction under another record starts "virgin", as the model's own excitation does, or from the "end" of that
excitation: the model then runs its own excitation, a pause, and the new record, whose response alone is used.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.simulator import Simulator
from ..signals.records import Record
from ..simulation.model import Model, SimulationBatch, simulate_batch

__all__ = ["STATES", "Excitation", "chosen_state", "excite", "under_record"]

STATES = ("virgin", "end")


class Excitation(NamedTuple):
    """A model under the whole excitation of a prediction."""

    model: Model
    first: int  # response sample at which the prediction begins
    n_steps: int  # samples in the prediction
    from_state: str  # at the beginning of the prediction, "virgin" or "end"

    def simulate(self, thetas: np.ndarray, pool: Any = None, stored: Simulator | None = None) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) of the prediction at parameter sets (n, n_parameters).

        With `stored`, responses to the whole excitation are looked up in its cache and stored there.
        """
        batch = simulate_batch(self.model, thetas, pool) if stored is None else stored.run(thetas, full=True)[1]
        return SimulationBatch(np.ascontiguousarray(batch.response[:, :, self.first :]), batch.reasons)


def chosen_state(model: Model, record: Any, from_state: str | None, stacklevel: int = 3) -> str:
    """State from which a prediction starts, "virgin" by default, which a warning names if the model is path dependent.

    A model without the attribute ``path_dependent`` counts as such. ValueError for any other state, or "end" without a
    record.
    """
    if from_state is None:
        if record is not None and hasattr(model, "with_record") and getattr(model, "path_dependent", True):
            warnings.warn(
                f"the response of {type(model).__name__} may depend on earlier excitations; this prediction starts "
                'from the virgin structure, before any excitation. Give from_state="virgin" for this, or '
                'from_state="end" for the structure after the excitation of the model',
                UserWarning,
                stacklevel=stacklevel,
            )
        return "virgin"
    if from_state not in STATES:
        raise ValueError(f'from_state must be "virgin" or "end"; got {from_state!r}')
    if from_state == "end" and record is None:
        raise ValueError(
            'from_state="end" starts a new record from the end of the excitation of the model; give record=, or leave '
            "from_state out"
        )
    return from_state


def excite(model: Model, record: Any, from_state: str, rest: float) -> Excitation:
    """The model under a record (None: its own excitation), after a pause `rest` [s] if it starts from its "end".

    ValueError if the model has one excitation only, or cannot continue from the end of its own.
    """
    if record is None:
        return Excitation(model, 0, model.n_steps, from_state)
    alone = under_record(model, record)
    if from_state == "virgin":
        return Excitation(alone, 0, alone.n_steps, from_state)
    joined = _followed_by(model, record, rest)
    first = joined.n_steps - alone.n_steps
    if first < 1:
        raise ValueError(
            f"expected a response of {type(model).__name__} that ends with the {alone.n_steps} samples of the new "
            f"record, got {joined.n_steps} samples in all; correct its method followed_by or with_record"
        )
    return Excitation(joined, first, alone.n_steps, from_state)


def under_record(model: Model, record: Any) -> Model:
    """Return the model under another excitation; raise ValueError if it has no method ``with_record``."""
    if not hasattr(model, "with_record"):
        raise ValueError(
            f"{type(model).__name__} has one excitation only: give FunctionModel, OpenSeesModel or ExecutableModel "
            "record=, or write a model class with a method with_record(record) that returns the same model under "
            "another excitation (docs/own_model.rst)"
        )
    return model.with_record(record)


def _followed_by(model: Model, record: Any, rest: float) -> Model:
    """Return the model under its own excitation, a pause [s] and a further record."""
    if hasattr(model, "followed_by"):
        return model.followed_by(record, rest)
    own = getattr(model, "record", None)
    if isinstance(own, Record) and isinstance(record, Record):
        return model.with_record(own.followed_by(record, rest))
    raise ValueError(
        f'{type(model).__name__} cannot start from_state="end": it needs its Record in the attribute record, or a '
        "method followed_by(record, rest) that returns the same model under its own excitation, a pause of rest "
        "seconds and a further record"
    )
