"""Several responses of one run: a program that writes modes, deflections and histories runs once for all data sets.

A `JointLikelihood` asks the models of its data sets one after the other for the same parameters. Here these models are
parts of one model, whose response has the samples of all of them, one after the other. What a run has returned for one
part is kept until each other part has taken it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.model import Model, SimulationBatch, SimulationFailed, simulate_batch
from .base import digest
from .executable import read_table

_MOST_BYTES = 2**28  # of responses that are kept for other parts


def one_run(
    parts: Mapping[str, tuple[Sequence[Channel], float, int]],
    output: Callable[..., Mapping[str, Any]] | Mapping[str, str],
    make: Callable[..., Model],
) -> dict[str, "PartOfRun"]:
    """Models of several data sets that one run answers.

    Parameters
    ----------
    parts : mapping of str to (channels, dt, n_steps)
        Channels, time step [s] (1 without a time) and number of samples of each response, by its name.
    output : callable, or mapping of str to str
        Function that returns each response (n_channels, n_steps) [SI] by its name. For a program also the name of each
        output file, which has a line for each sample and a column for each channel.
    make : callable
        ``make(output, channels=, dt=, n_steps=)`` returns the model of a run: a `FunctionModel`, an `OpenSeesModel`
        with this function, or an `ExecutableModel` with this output.

    Returns
    -------
    dict of str to PartOfRun
        A model for each likelihood, by name.

    Examples
    --------
    >>> from fe_likelihoods.models.one_run import one_run
    >>> midspan, pier = Channel("midspan", "displacement", "mm"), Channel("pier", "displacement", "mm")
    >>> parts = {"trucks": ([midspan], 1.0, 2), "wind": ([pier], 1.0, 3)}  # channels, step and number of samples
    >>> def all_at_once(theta):
    ...     return {"trucks": [[0.1, 0.2]] / theta[0], "wind": [[0.3, 0.2, 0.1]] / theta[0]}
    >>> models = one_run(parts, all_at_once, lambda output, **options: FunctionModel(output, ["EI"], **options))
    >>> sorted(models)
    ['trucks', 'wind']
    """
    if not parts or (isinstance(output, Mapping) and set(output) != set(parts)):
        raise ValueError(f"one_run: expected an output for each of the parts {', '.join(parts)}; got {output!r}")
    shapes = {name: (len(channels), n_steps) for name, (channels, _, n_steps) in parts.items()}
    size = sum(rows * columns for rows, columns in shapes.values())
    joined = _Joined(dict(output) if isinstance(output, Mapping) else output, shapes)
    everything = (Channel("all responses", "dimensionless", "1"),)
    run, first, models = _Run(make(joined, channels=everything, dt=1.0, n_steps=size), len(parts)), 0, {}
    for name, (channels, dt, n_steps) in parts.items():
        last = first + len(channels) * n_steps
        models[name] = PartOfRun(name, run, tuple(channels), dt, n_steps, slice(first, last), output)
        first = last
    return models


class _Joined:
    """Function that returns the samples of all responses of a user's function, or of all output files, as one row."""

    def __init__(
        self, output: Callable[..., Mapping[str, Any]] | Mapping[str, str], shapes: Mapping[str, tuple[int, int]]
    ) -> None:
        self.output, self.shapes = output, shapes

    def __call__(self, *arguments: Any) -> np.ndarray:
        if callable(self.output):
            return _in_a_row(self.output(*arguments), self.shapes)
        return _in_a_row({name: read_table(*arguments, file).T for name, file in self.output.items()}, self.shapes)


def _in_a_row(responses: Any, shapes: Mapping[str, tuple[int, int]]) -> np.ndarray:
    """Samples (1, n) of responses by name, in the order of `shapes`; `SimulationFailed` if they do not fit."""
    if not isinstance(responses, Mapping) or set(responses) != set(shapes):
        got = ", ".join(map(str, responses)) if isinstance(responses, Mapping) else type(responses).__name__
        raise SimulationFailed(f"expected a response for each of {', '.join(shapes)}; got {got}")
    for name, shape in shapes.items():
        if np.shape(responses[name]) != shape:
            raise SimulationFailed(f"the response {name} has shape {np.shape(responses[name])}, expected {shape}")
    return np.concatenate([np.ravel(responses[name]) for name in shapes])[None]


class _Run:
    """A model, and what its runs have returned for parts that have not asked for it yet."""

    def __init__(self, model: Model, n_parts: int) -> None:
        self.model, self.n_parts = model, n_parts
        self._kept: dict[bytes, tuple[np.ndarray, str, set[str]]] = {}  # by parameters, with the parts that took it

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_kept": {}}

    def responses(self, part: str, thetas: np.ndarray, pool: Any) -> SimulationBatch:
        """Responses (n, 1, n_samples) at parameters (n, n_parameters) that this part asks for."""
        thetas = np.ascontiguousarray(thetas, dtype=float)
        found = np.full((len(thetas), 1, self.model.n_steps), np.nan)
        reasons, left = [""] * len(thetas), []
        for row, theta in enumerate(thetas):
            known = self._kept.get(theta.tobytes())
            if known is None or part in known[2]:  # a part that asks again wants another run
                left.append(row)
                continue
            found[row], reasons[row] = known[0], known[1]
            known[2].add(part)
            if len(known[2]) == self.n_parts:
                del self._kept[theta.tobytes()]
        if left:
            batch = simulate_batch(self.model, thetas[left], pool)
            for row, response, reason in zip(left, batch.response, batch.reasons, strict=True):
                found[row], reasons[row] = response, reason
                self._kept.pop(thetas[row].tobytes(), None)
                self._kept[thetas[row].tobytes()] = response, reason, {part}
        while len(self._kept) > max(1, _MOST_BYTES // (8 * self.model.n_steps)):
            del self._kept[next(iter(self._kept))]
        return SimulationBatch(found, reasons)


class PartOfRun:
    """One of several responses of a model, see `one_run`."""

    path_dependent = False

    def __init__(
        self, name: str, run: _Run, channels: tuple[Channel, ...], dt: float, n_steps: int, place: slice, output: Any
    ) -> None:
        self.name, self.run, self.channels, self.dt, self.n_steps = name, run, channels, dt, n_steps
        self._place, self._output = place, output
        self.parameter_names = tuple(run.model.parameter_names)
        self.time_limit = getattr(run.model, "time_limit", None)
        quantities = [(channel.name, channel.quantity) for channel in channels]
        self.fingerprint = digest(run.model.fingerprint, name, repr((quantities, dt, n_steps)))

    def code_parts(self) -> dict[str, Any]:
        """User code of the run, for the label of stored simulations."""
        own = {"output": self._output} if callable(self._output) else {"files": repr(sorted(self._output.items()))}
        return (self.run.model.code_parts() if hasattr(self.run.model, "code_parts") else {}) | own

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] at the parameters (n_parameters,)."""
        return self._part(self.run.model.simulate(theta)[None])[0]

    def simulate_together(self, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
        """Responses at parameters (n, n_parameters), with the runs that another part has made there."""
        batch = self.run.responses(self.name, thetas, pool)
        return SimulationBatch(self._part(batch.response), batch.reasons)

    def _part(self, responses: np.ndarray) -> np.ndarray:
        return responses[:, 0, self._place].reshape(len(responses), len(self.channels), self.n_steps)
