"""Model that runs on UM-Bridge servers, in any language, in a container or on another machine."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.faults import ChangedModel, TransientReason
from ..simulation.model import SimulationFailed
from ..simulation.umbridge_servers import (
    SIMULATION_FAILED,
    TRANSIENT_FAILURE,
    ServerError,
    ServerTimeout,
    UMBridgeServers,
    Unavailable,
)
from .user_model import ExternalModel
from .validation import positive_float

__all__ = ["UMBridgeModel"]

_OTHER_MODEL = {"InvalidInput", "ModelNotFound", "UnsupportedFeature"}  # errors of a server with another model


class UMBridgeModel(ExternalModel):
    """Model of an UM-Bridge server.

    The parameters are sent in the order of `parameter_names`, divided into vectors of the sizes that the server asks
    for. The response has one vector per channel, or `output` computes it from the vectors that the server returns.

    If the server answers with an error, the simulation has failed, and the error text is the reason. A server that
    cannot be reached, or that dies during a simulation, is a fault of the infrastructure: the simulation is repeated
    `retries` times. If all attempts fail, no cache stores the failure (docs/own_model.rst).

    For several servers, use a pool with one thread per server, such as
    ``FELikelihood(..., pool=ThreadPoolExecutor(3))`` for three; each simulation goes to the least busy server. A load
    balancer has one address; use as many threads as it has servers.

    Parameters
    ----------
    urls : str or sequence of str
        Address of the server, as in ``"http://localhost:4242"``, or addresses of several servers of the same model.
    name : str
        Name of the model on the server, often ``"forward"``.
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float
        Time step of the response [s].
    n_steps : int, optional
        Number of response samples; by default the length of the server's vectors.
    config : mapping, optional
        Configuration that is sent with every request; its values must be representable in JSON.
    output : callable, optional
        Function that takes the server's list of vectors (one-dimensional arrays) and returns the response (n_channels,
        n_steps) [SI]. It is required if the server does not return one vector [SI] per channel.
    version : str
        Text that enters the fingerprint. The code on a server has no digest here: change the text whenever the served
        model changes, and give different models with the same name different texts.
    depends_on : sequence, optional
        Other files and values that the response depends on; see `FunctionModel`.
    time_limit : float, optional
        Longest time until the answer [s], which includes the time that a simulation waits at the server for others. A
        longer simulation counts as failed; the server is not told and continues to run it.
    retries : int
        Number of further attempts after a fault of the infrastructure.
    retry_wait : float
        Time between the first two attempts [s]; it is doubled each time, up to 60 s. The defaults leave half a minute
        in which a server can be restarted.

    Raises
    ------
    ConnectionError
        If a server does not answer.
    ValueError
        If a server has no such model, its sizes do not fit the parameters and channels, or another argument is wrong.

    Notes
    -----
    The addresses are not part of the fingerprint: a model is the same at another port. The name, the configuration, the
    sizes and `version` are.

    Examples
    --------
    >>> model = UMBridgeModel(
    ...     "http://localhost:4242", "forward", ("stiffness",), (Channel("tip", "displacement", "mm"),), 0.01
    ... )
    """

    def __init__(
        self,
        urls: str | Sequence[str],
        name: str,
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int | None = None,
        *,
        config: Mapping[str, Any] | None = None,
        output: Callable[[list[np.ndarray]], Any] | None = None,
        version: str = "",
        depends_on: Sequence[Any] = (),
        time_limit: float | None = None,
        retries: int = 5,
        retry_wait: float = 1.0,
    ) -> None:
        kind = type(self).__name__
        if output is not None and not callable(output):
            raise ValueError(f"{kind}: output must be a function of the server's vectors; got {output!r}")
        if output is not None and n_steps is None:
            raise ValueError(f"{kind}: give n_steps, the number of samples that output returns per channel")
        super().__init__(parameter_names, channels, dt, 1 if n_steps is None else n_steps, depends_on)
        self.time_limit = None if time_limit is None else positive_float(time_limit, f"{kind}: time_limit", "seconds")
        self.name, self.config, self.version, self.output = name, _copy_of(config, kind), str(version), output
        self.servers = UMBridgeServers([urls] if isinstance(urls, str) else list(urls), retries, retry_wait)
        self.input_sizes, self.output_sizes = self._common_sizes()
        if sum(self.input_sizes) != len(self.parameter_names):
            raise ValueError(
                f"{kind}: model {name!r} at {self.servers.urls[0]} takes {sum(self.input_sizes)} numbers, in vectors "
                f"of sizes {self.input_sizes}; got {len(self.parameter_names)} parameter_names: "
                f"{', '.join(self.parameter_names)}"
            )
        if output is None:
            expected = self.output_sizes[0] if n_steps is None and self.output_sizes else self.n_steps
            if self.output_sizes != [expected] * len(self.channels) or not expected:
                steps = "of the same length" if n_steps is None else f"of n_steps={n_steps} numbers"
                raise ValueError(
                    f"{kind}: expected one vector {steps} for each of the channels "
                    f"{', '.join(channel.name for channel in self.channels)}; model {name!r} at "
                    f"{self.servers.urls[0]} returns vectors of sizes {self.output_sizes}: give n_steps= and output=, "
                    "a function of these vectors that returns (n_channels, n_steps)"
                )
            self.n_steps = expected
        sizes = self.input_sizes, self.output_sizes
        self.fingerprint = self._digest(self.name, self.config, *sizes, self.version)

    def code_parts(self) -> dict[str, Any]:
        """User code, for the label of stored simulations."""
        return {"output": self.output}

    def _common_sizes(self) -> tuple[list[int], list[int]]:
        """Sizes of the inputs and of the outputs, which are the same on all servers."""
        kind, known = type(self).__name__, None
        for url in self.servers.urls:
            try:
                sizes = self.servers.sizes(url, self.name, self.config)
            except Unavailable as error:
                raise ConnectionError(
                    f"{kind}: expected a server of UM-Bridge; {error}. Start it, or correct the address"
                ) from error
            except ServerError as error:
                raise ValueError(
                    f"{kind}: expected a model named {self.name!r} that can be evaluated at {url}; {error}"
                ) from error
            if known is not None and sizes != known:
                raise ValueError(
                    f"{kind}: expected the same model {self.name!r} on all servers; its input and output sizes are "
                    f"{known} at {self.servers.urls[0]} and {sizes} at {url}"
                )
            known = sizes
        return known

    def _respond(self, theta: np.ndarray) -> Any:
        if not np.isfinite(theta).all():
            raise SimulationFailed("the parameters are not finite")
        blocks = np.split(theta, np.cumsum(self.input_sizes[:-1]))
        request = {"name": self.name, "input": [block.tolist() for block in blocks], "config": self.config}
        try:
            answer = self.servers.evaluate(request, self.time_limit)
        except ServerTimeout as error:
            raise SimulationFailed(TransientReason(str(error), time_limit=self.time_limit)) from error
        except Unavailable as error:
            raise SimulationFailed(TransientReason(str(error))) from error
        except ServerError as error:
            if error.kind in _OTHER_MODEL:
                self._require_same_model(error)
            own = {SIMULATION_FAILED: str, TRANSIENT_FAILURE: TransientReason}.get(error.kind)
            raise SimulationFailed(own(error.message) if own else str(error)) from error
        vectors = self._vectors(answer)
        return vectors if self.output is None else self.output(vectors)

    def _vectors(self, answer: Any) -> list[np.ndarray]:
        """Vectors of an answer; SimulationFailed if they are not vectors of numbers with the stated sizes."""
        try:
            vectors = [np.asarray(vector, dtype=float) for vector in answer]
        except (TypeError, ValueError) as error:
            raise SimulationFailed(f"the output of the server is not a list of numeric vectors: {error}") from error
        if [vector.shape for vector in vectors] != [(size,) for size in self.output_sizes]:
            shapes = [vector.shape for vector in vectors]
            raise SimulationFailed(f"the output has vectors of shapes {shapes}, expected sizes {self.output_sizes}")
        return vectors

    def _require_same_model(self, error: ServerError) -> None:
        """Raise ChangedModel if the error came from servers that were started again with another model."""
        try:
            same = self._common_sizes() == (self.input_sizes, self.output_sizes)
        except ConnectionError as fault:
            raise SimulationFailed(TransientReason(str(fault))) from error
        except ValueError:
            same = False
        if not same:
            raise ChangedModel(
                f"{type(self).__name__}: a server no longer has the model {self.name!r} with inputs of sizes "
                f"{self.input_sizes} and outputs of sizes {self.output_sizes} ({error}): start that model again, or "
                "make a new UMBridgeModel and a new likelihood"
            ) from error


def _copy_of(config: Mapping[str, Any] | None, kind: str) -> dict[str, Any]:
    """Copy of a configuration as JSON gives it; ValueError if JSON cannot represent it."""
    try:
        return json.loads(json.dumps(dict(config or {}), sort_keys=True, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{kind}: config must be a mapping of texts to values that JSON can represent; got {config!r} ({error})"
        ) from error
