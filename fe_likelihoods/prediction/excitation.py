"""The excitation of a prediction, and the state of the structure at its beginning.

A model with memory, such as reinforced concrete after cracking, responds to an earthquake according to what happened
before. A prediction under another record therefore starts from one of two states: "virgin", the state of the model at
the beginning of its own excitation, or "end", the state at the end of that excitation. For the second, the model runs
its own excitation, a pause, and the new record, and only the response to the new record is used.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np

from ..cache.stored_responses import StoredResponses
from ..signals.records import Record
from ..simulation.model import Model, SimulationBatch, simulate_batch

__all__ = ["STATES", "Excitation", "chosen_state", "excite", "under_record"]

STATES = ("virgin", "end")


class Excitation(NamedTuple):
    """A model under the excitation of a prediction.

    Attributes
    ----------
    model : Model
        The model under the whole excitation.
    first : int
        Index of the response sample at which the prediction begins.
    n_steps : int
        Number of samples in the prediction.
    from_state : str
        State at the beginning of the prediction, "virgin" or "end".
    """

    model: Model
    first: int
    n_steps: int
    from_state: str

    def simulate(self, thetas: np.ndarray, pool: Any = None, stored: StoredResponses | None = None) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) of the prediction at parameter sets (n, n_parameters).

        With `stored`, responses to the whole excitation are looked up and stored there.
        """
        batch = simulate_batch(self.model, thetas, pool) if stored is None else stored.simulate(thetas)
        return SimulationBatch(np.ascontiguousarray(batch.response[:, :, self.first :]), batch.reasons)


def chosen_state(model: Model, record: Any, from_state: str | None, stacklevel: int = 3) -> str:
    """Return the state from which a prediction starts.

    Parameters
    ----------
    model : Model
        The model. Without an attribute ``path_dependent`` it counts as path dependent.
    record : Record or None
        The new excitation, None for the model's own.
    from_state : {"virgin", "end"} or None
        The state, None for the default.
    stacklevel : int
        Place of the line to which a warning refers, as in `warnings.warn`.

    Returns
    -------
    str
        "virgin" or "end". The default is "virgin"; a warning names it if the model is path dependent.

    Raises
    ------
    ValueError
        If the state is another one, or is "end" without a record.
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
    """Return the model under the excitation of a prediction.

    Parameters
    ----------
    model : Model
        The model.
    record : Record or None
        The new excitation, None for the model's own.
    from_state : {"virgin", "end"}
        State at the beginning of the prediction.
    rest : float
        Pause before the new record if the state is "end" [s].

    Returns
    -------
    Excitation
        The model and the samples of the prediction.

    Raises
    ------
    ValueError
        If the model has one excitation only, or cannot continue from the end of its own.
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
