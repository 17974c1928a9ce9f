"""Base classes that validate inputs and outputs of external models: user code, programs, assembled matrices.

`UserModel` adds an excitation, a `Record` that the external code receives. The reason of a failed simulation ends with
its duration, so that a report of failures shows whether runs fail in their first second or after an hour.
"""

from __future__ import annotations

import copy
import json
import os
import sys
from collections.abc import Iterable, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from samplers.interrupts import raise_if_it_ends_the_run

from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.sampling import rest_samples
from ..simulation.by_value import is_arriving
from ..simulation.failure_reasons import ChangedModel, reason_of
from ..simulation.files import file_digest
from ..simulation.label import value_digest
from ..simulation.model import SimulationFailed, real_response
from .base import StructuralModel, digest
from .validation import check_theta, positive_float


class ExternalModel(StructuralModel):
    """Model whose response comes from external code, and is therefore checked after each simulation.

    A subclass defines `_respond`, which may raise any exception and return anything. `depends_on` are files (a Path:
    the content of a file or of all files in a folder) and values that affect the response, as part of the fingerprint.
    Raises ValueError if names are missing, repeated or not text, if `dt` [s] or `n_steps` is not positive, or if
    `depends_on` cannot be used.
    """

    fingerprint = ""

    def __init__(
        self,
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int,
        depends_on: Iterable[Any] = (),
    ) -> None:
        kind = type(self).__name__
        for what, values, expected in (("parameter_names", parameter_names, str), ("channels", channels, Channel)):
            if isinstance(values, str) or not all(isinstance(value, expected) for value in values) or not len(values):
                raise ValueError(f"{kind}: {what} must be a tuple of one or more {expected.__name__}; got {values!r}")
        self.parameter_names, self.channels = tuple(parameter_names), tuple(channels)
        for what, names in (
            ("parameter_names", self.parameter_names),
            ("channels", [channel.name for channel in self.channels]),
        ):
            if len(set(names)) != len(names) or not all(names):
                raise ValueError(f"{kind}: the names of {what} must differ and not be empty; got {', '.join(names)}")
        self.dt = positive_float(dt, f"{kind}: dt", "seconds")
        if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or n_steps < 1:
            raise ValueError(f"{kind}: n_steps must be a positive integer number of samples; got {n_steps!r}")
        self.n_steps = int(n_steps)
        self._dependencies = Dependencies(depends_on, kind)

    def _files(self) -> Iterable[Path]:
        """Files whose content a response depends on."""
        return self._dependencies.paths

    def __getstate__(self) -> dict[str, Any]:
        contents = {str(path): content_digest(path) for path in self._files()}
        return vars(self) | {"_contents": contents} if contents else dict(vars(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        contents = state.pop("_contents", {})
        vars(self).update(state)
        for path, content in contents.items() if is_arriving() else ():
            if content_digest(Path(path)) != content:
                raise ChangedModel(
                    f"{type(self).__name__}: {path} in the worker process differs from the file in the process that "
                    "sends simulations: it was changed meanwhile, or is another one on that machine"
                )

    def simulate(self, theta: ArrayLike) -> np.ndarray:
        """Response [SI] (n_channels, n_steps) for one set of parameters (n_parameters,), of which the code gets a copy.

        Raises SimulationFailed if the external code raises an exception, or its response has a wrong shape, is complex
        or is not finite; the reason is a `TransientReason` if the cause is not the model (see
        `fe_likelihoods.simulation.failure_reasons`). Raises ValueError if `theta` has another shape. KeyboardInterrupt
        and SystemExit of the code in this process, even as the cause of another exception, are no failed simulation:
        they end the run.
        """
        theta = check_theta(theta, self.parameter_names).copy()
        before = sys.exception()
        try:
            return self._check_response(self._respond(theta))
        except BaseException as error:  # external code may raise anything
            raise_if_it_ends_the_run(error, before)
            raise SimulationFailed(reason_of(error)) from error

    def _digest(self, *parts: Any) -> str:
        """Fingerprint of the names, the channels, the step, the length and `parts`, which JSON can represent."""
        channels = [(channel.name, channel.quantity) for channel in self.channels]
        named = [type(self).__name__, self.parameter_names, channels, self.dt, self.n_steps]
        return digest(json.dumps([*named, *parts, *self._dependencies.texts()]))

    def _check_response(self, response: Any) -> np.ndarray:
        """Convert a response to floats (n_channels, n_steps); raise SimulationFailed if it cannot be used."""
        response = real_response(response, self.channels, self.n_steps)
        for channel, values in zip(self.channels, response, strict=True):
            if not np.isfinite(values).all():
                raise SimulationFailed(f"the response of channel {channel.name!r} is not finite")
        return response


class UserModel(ExternalModel):
    """Model made of user code, which receives a `Record` if one is given.

    A subclass defines `_respond`, and `_prepare`, which is called after each change of the record. With a record, `dt`
    [s] is a whole multiple of its step (None: that step) and `n_steps` follows: the response has a sample at the first
    sample of the record, and then every `dt` until its end. Without one, both are needed. `path_dependent` is False for
    a linear structure. Errors are as for `ExternalModel`.
    """

    def __init__(
        self,
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float | None,
        n_steps: int | None,
        depends_on: Iterable[Any] = (),
        record: Record | None = None,
        path_dependent: bool = True,
    ) -> None:
        dt, n_steps = _sampling(type(self).__name__, dt, n_steps, record)
        super().__init__(parameter_names, channels, dt, n_steps, depends_on)
        self.record = record
        self.path_dependent = bool(path_dependent)

    def with_record(self, record: Record) -> UserModel:
        """Return the same model under another record.

        If the response step is a multiple of the present record's step, it is the same multiple of the new record's
        step. ValueError if the model was made without a record, or `record` is not a `Record`.
        """
        kind = type(self).__name__
        if self.record is None:
            raise ValueError(
                f"{kind} has one excitation, which its code contains: make it with record=, so that the code receives "
                "the record, and other records can be simulated (docs/own_model.rst)"
            )
        if not isinstance(record, Record):
            raise ValueError(f"{kind}: expected a Record as excitation; got {type(record).__name__}")
        other = copy.copy(self)
        every = self._every
        other.record, other.dt, other.n_steps = record, every * record.dt, (record.n_steps - 1) // every + 1
        other._prepare()
        return other

    def followed_by(self, record: Record, rest: float = 10.0) -> UserModel:
        """Return the same model under its present record, a pause of `rest` [s] and a further record.

        The pause is lengthened to a whole number of response steps. ValueError as `with_record` and
        `Record.followed_by`.
        """
        self.with_record(record)
        n_zeros = rest_samples(rest, self.record.dt)
        n_zeros += -(self.record.n_steps + n_zeros) % self._every
        return self.with_record(self.record.followed_by(record, n_zeros * self.record.dt))

    @property
    def _every(self) -> int:
        """Samples of the record per sample of the response."""
        return round(self.dt / self.record.dt)

    def _prepare(self) -> None:
        """Compute what depends on the record, the fingerprint among it."""
        raise NotImplementedError


def _sampling(kind: str, dt: float | None, n_steps: int | None, record: Record | None) -> tuple[Any, Any]:
    """Step and length of a response; raise ValueError if they are missing or do not fit the record."""
    if record is None:
        if dt is None or n_steps is None:
            raise ValueError(f"{kind}: give dt and n_steps of the response, or record=, which determines them")
        return dt, n_steps
    if not isinstance(record, Record):
        raise ValueError(f"{kind}: expected a Record as record; got {type(record).__name__}")
    step = record.dt if dt is None else positive_float(dt, f"{kind}: dt", "seconds")
    every = round(step / record.dt)
    if every < 1 or abs(step - every * record.dt) > 1e-9 * step:
        raise ValueError(
            f"{kind}: dt must be a whole multiple of the step of the record, {record.dt!r} s; got {dt!r} s: leave it "
            "out, or use Record.resample"
        )
    expected = (record.n_steps - 1) // every + 1
    if n_steps is not None and n_steps != expected:
        raise ValueError(
            f"{kind}: the response to {record.n_steps} samples of the record has {expected} samples at {step:g} s; got "
            f"n_steps={n_steps!r}: leave it out"
        )
    return every * record.dt, expected


class Dependencies:
    """The argument ``depends_on`` of a model of class `kind`; `paths` are its files and folders.

    A Path stands for the content of a file, or of all files in a folder; any other object for its value. Raises
    ValueError if a file does not exist, a text is the name of a file, or a value has no digest.
    """

    def __init__(self, things: Iterable[Any], kind: str) -> None:
        if isinstance(things, str | os.PathLike | dict) or not isinstance(things, Iterable):
            raise ValueError(f"{kind}: depends_on must be a list of Paths and values; got {things!r}")
        self._things = tuple(things)
        self._kind = kind
        for thing in self._things:
            if isinstance(thing, str) and os.path.exists(thing):
                raise ValueError(
                    f"{kind}: depends_on has the text {thing!r}, which is the name of a file; write Path({thing!r}) "
                    "for its content"
                )
            if isinstance(thing, Path) and not thing.exists():
                raise ValueError(f"{kind}: depends_on has {thing!r}, but there is no such file or folder")
        self.paths = tuple(thing.resolve() for thing in self._things if isinstance(thing, Path))
        self.texts()

    def texts(self) -> list[str]:
        """Digests of all contents and values, in order, as they are now."""
        texts, paths = [], iter(self.paths)
        for thing in self._things:
            if isinstance(thing, Path):
                texts.append(content_digest(next(paths)))
                continue
            try:
                texts.append(value_digest(thing))
            except ValueError as error:
                raise ValueError(
                    f"{self._kind}: no digest of {thing!r} in depends_on can be computed; give numbers, texts, arrays "
                    f"or Paths: {error}"
                ) from error
        return texts


def content_digest(path: Path) -> str:
    """Digest of a file, of all files in a folder with their names, or a text that says that it is missing."""
    try:
        if not path.is_dir():
            return file_digest(path)
        files = sorted(file for file in path.rglob("*") if file.is_file())
        parts = [f"{file.relative_to(path).as_posix()}\0{file_digest(file)}" for file in files]
        return blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()
    except OSError as error:
        return f"missing: {type(error).__name__}"
