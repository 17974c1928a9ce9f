"""Server of UM-Bridge for posteriors and models, so that clients in other languages and processes can evaluate them.

Requests that wait are evaluated together, as one batch, so posteriors and models are never called by two threads at
once. Numbers are sent with all their digits. The server of the package umbridge accepts connections from all networks,
and its answers are not JSON where an output is infinite or the model raises an exception. This one is based on the
standard library.
"""

from __future__ import annotations

import json
import logging
import math
import queue
import socketserver
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import AF_INET6
from typing import Any, NamedTuple

import numpy as np

from ..simulation.executors import as_executor
from ..simulation.faults import TransientReason
from ..simulation.model import Model, simulate_batch, split_seconds
from ..simulation.umbridge_servers import SIMULATION_FAILED, TRANSIENT_FAILURE

__all__ = ["UMBridgeServer", "serve"]

logger = logging.getLogger(__name__)

_ALMOST_INFINITE = 1e100
_DENSITIES = ("log_prob", "log_likelihood", "log_prior")
_UNSUPPORTED = ("Gradient", "ApplyJacobian", "ApplyHessian")
_LARGEST_REQUEST = 2**24  # [bytes]
_IDLE_SECONDS = 600.0  # after which a connection without a request is closed


def serve(
    served: Any,
    *,
    host: str = "127.0.0.1",
    port: int = 4242,
    pool: Any = None,
    block: bool = True,
) -> UMBridgeServer | None:
    """Make posteriors and models available to clients of UM-Bridge: MUQ, QUESO, tinyDA, QMCPy and others.

    A posterior takes one vector, its parameters in the order of `parameter_names`, and returns one number, its
    log-density. With the configuration ``{"density": "log_likelihood"}`` or ``{"density": "log_prior"}`` the number is
    that part of it. JSON has no infinite numbers, so -1e100 stands for a density of zero: outside the support of the
    prior, and where a simulation fails. A chain should start where the density is not zero (`Posterior.sample_start`).

    A model takes one vector, its parameters, and returns one vector per channel [SI]. A failed simulation is an error
    of the type SimulationFailed, with its reason.

    Gradients, Jacobians and Hessians are not supported: clients are told so, and a request for one is an error.

    Points that wait are evaluated together: give the likelihood of a posterior, or here a model, a pool to evaluate
    several points at once. Whoever can connect to the server can start simulations; there are no passwords.

    Parameters
    ----------
    served : Posterior, Model, or mapping of str to these
        What is served. A mapping gives the names under which clients find them; a single posterior is named
        ``"posterior"``, a single model ``"forward"``.
    host : str
        Address on which connections are accepted, by default from this machine alone. Name another one to let other
        machines connect: ``"0.0.0.0"`` accepts them from all networks.
    port : int
        Port; 0 for a free one.
    pool : int or pool, optional
        Runs the simulations of models, as in `FELikelihood`. A posterior uses the pool of its likelihood.
    block : bool
        Whether to return only after Ctrl-C.

    Returns
    -------
    UMBridgeServer or None
        Without `block`, the server, which runs in threads of this process until `UMBridgeServer.close`. Until then
        do not evaluate `served` elsewhere in this process: posteriors are not made for several threads.

    Raises
    ------
    ValueError
        If something is neither a posterior nor a model, or `pool` is given without a model.
    OSError
        If the port is taken, or the address is not one of this machine.

    Examples
    --------
    >>> serve(posterior)
    >>> with serve({"column": model, "posterior": posterior}, port=0, block=False) as server:
    ...     print(umbridge.HTTPModel(server.url, "posterior")([[1.0, 1.0, 0.1]]))
    """
    if not isinstance(served, Mapping):
        served = {"posterior" if hasattr(served, "log_prob") else "forward": served}
    server = UMBridgeServer(served, host, port, pool)
    logger.info("Serving %s at %s", ", ".join(served), server.url)
    if not block:
        return server
    with server, suppress(KeyboardInterrupt):
        threading.Event().wait()
    return None


class UMBridgeServer:
    """A running server; see `serve` for the parameters. `url` is its address, as in ``"http://127.0.0.1:4242"``."""

    def __init__(self, served: Mapping[str, Any], host: str, port: int, pool: Any) -> None:
        if not served:
            raise ValueError(
                "serve: expected a posterior, a model, or a mapping of names to them; got an empty mapping"
            )
        models = [thing for thing in served.values() if not hasattr(thing, "log_prob")]
        if pool is not None and not models:
            raise ValueError("serve: pool= runs the simulations of models; give it to the likelihood of a posterior")
        evaluators = {name: _evaluator(name, thing, pool) for name, thing in served.items()}
        self._http = _HTTPServer((host, port), evaluators)
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._http.server_address[1]}"
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def __enter__(self) -> UMBridgeServer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Accept no further connections and end after the points that are being evaluated."""
        if self._thread.is_alive():
            self._http.shutdown()
            self._http.server_close()
            self._http.batches.close()
            self._thread.join()


class _Error(Exception):
    """An error that is sent to the client."""

    def __init__(self, kind: str, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.kind, self.message, self.status = kind, message, status


class _Evaluator(NamedTuple):
    """How a posterior or model is evaluated."""

    input_size: int  # number of parameters
    output_sizes: list[int]  # lengths of the output vectors
    densities: tuple[str, ...]  # of the configuration, the default first; empty for a model
    evaluate: Callable[[np.ndarray, str], list]  # (n, input_size) and a density -> output or `_Error` per point

    def density_of(self, config: Any) -> str:
        """The density that a configuration names, empty for a model; `_Error` for another configuration."""
        config = {} if config is None else config
        known = {"density"} if self.densities else set()
        if not isinstance(config, dict) or set(config) - known:
            keys = f"the key 'density' ({', '.join(self.densities)})" if known else "no keys"
            raise _Error("InvalidInput", f"expected a config with {keys}; got {json.dumps(config)[:200]}")
        density = config.get("density", self.densities[0] if self.densities else "")
        if config and density not in self.densities:
            raise _Error("InvalidInput", f"density must be one of {', '.join(self.densities)}; got {density!r}")
        return density

    def point_of(self, blocks: Any) -> list[float]:
        """The numbers of an input; `_Error` unless it is one vector of the right length with finite numbers."""
        if not isinstance(blocks, list) or [len(b) if isinstance(b, list) else -1 for b in blocks] != [self.input_size]:
            raise _Error(
                "InvalidInput",
                f"expected a list with one vector of {self.input_size} numbers; got {json.dumps(blocks)[:200]}",
            )
        if not all(type(value) in (int, float) and math.isfinite(value) for value in blocks[0]):
            raise _Error("InvalidInput", f"expected finite numbers; got {json.dumps(blocks[0])[:200]}")
        return blocks[0]


class _Request(NamedTuple):
    """A point that waits for its evaluation."""

    evaluator: _Evaluator
    density: str
    point: list[float]
    outcome: Future


class _Batches:
    """Evaluates all points that wait, batch after batch, in one thread: models need not be safe for several threads."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._closed, self._lock = False, threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def output(self, evaluator: _Evaluator, blocks: Any, config: Any) -> list[list[float]]:
        """Output at a point, once its batch is evaluated."""
        request = _Request(evaluator, evaluator.density_of(config), evaluator.point_of(blocks), Future())
        with self._lock:  # nothing is put after the None of `close`
            if self._closed:
                raise _Error("Closed", "the server is being closed", 503)
            self._waiting.put(request)
        return request.outcome.result()

    def close(self) -> None:
        """End after the requests that wait."""
        with self._lock:
            self._closed = True
            self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        closing = False
        while not closing:
            waiting = [self._waiting.get()]
            with suppress(queue.Empty):
                while True:
                    waiting.append(self._waiting.get_nowait())
            closing = None in waiting
            batches: dict[tuple[int, str], list[_Request]] = {}
            for request in filter(None, waiting):
                batches.setdefault((id(request.evaluator), request.density), []).append(request)
            for batch in batches.values():
                self._evaluate(batch)

    @staticmethod
    def _evaluate(batch: list[_Request]) -> None:
        points = np.array([request.point for request in batch], dtype=float)
        try:
            outputs = batch[0].evaluator.evaluate(points, batch[0].density)
        except BaseException as error:  # TooManyFailures, SystemExit: sent to the clients that wait; the server goes on
            logger.exception("A batch of %d points could not be evaluated", len(batch))
            outputs = [_Error(type(error).__name__, str(error), 500) for _ in batch]
        for request, output in zip(batch, outputs, strict=True):
            if isinstance(output, _Error):
                request.outcome.set_exception(output)
            else:
                request.outcome.set_result(output)


def _evaluator(name: str, thing: Any, pool: Any) -> _Evaluator:
    """Evaluator of a posterior or model; ValueError for something else."""
    if hasattr(thing, "log_prob") and hasattr(thing, "ndim"):
        densities = tuple(density for density in _DENSITIES if hasattr(thing, density))

        def log_density(points: np.ndarray, density: str) -> list:
            values = np.maximum(getattr(thing, density)(points), -_ALMOST_INFINITE)
            return [[[value]] for value in values.tolist()]

        return _Evaluator(thing.ndim, [1], densities, log_density)
    if not all(hasattr(thing, member) for member in ("simulate", "parameter_names", "channels", "n_steps")):
        raise ValueError(f"serve: expected a posterior or a model as {name!r}; got {type(thing).__name__}")
    executor = as_executor(pool, thing)

    def respond(points: np.ndarray, density: str) -> list:
        return _responses(thing, points, executor)

    return _Evaluator(len(thing.parameter_names), [thing.n_steps] * len(thing.channels), (), respond)


def _responses(model: Model, points: np.ndarray, executor: Any) -> list:
    """Response, or error, of a model at each point."""
    batch = simulate_batch(model, points, executor)
    outputs = []
    for response, reason in zip(batch.response, batch.reasons, strict=True):
        if not reason and not np.isfinite(response).all():
            reason = "the response is not finite"
        if reason:
            kind = TRANSIENT_FAILURE if isinstance(reason, TransientReason) else SIMULATION_FAILED
            outputs.append(_Error(kind, split_seconds(reason)[0], 500))
        else:
            outputs.append(response.tolist())
    return outputs


class _HTTPServer(ThreadingHTTPServer):
    """HTTP server with one thread per connection."""

    daemon_threads = True
    request_queue_size = 1024  # connections of a client with many threads arrive at once

    def __init__(self, address: tuple[str, int], evaluators: Mapping[str, _Evaluator]) -> None:
        if ":" in address[0]:
            self.address_family = AF_INET6
        super().__init__(address, _Handler)
        self.evaluators, self.batches = evaluators, _Batches()

    def server_bind(self) -> None:
        """Bind without the search for the name of the host, which can take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log the error of a connection, for example after a client was killed."""
        logger.debug("The connection of %s has ended", client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    server: _HTTPServer
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = -1
    timeout = _IDLE_SECONDS

    def do_GET(self) -> None:
        """Answer ``/Info``."""
        if self.path.rstrip("/") == "/Info":
            self._send(200, {"protocolVersion": 1.0, "models": list(self.server.evaluators)})
        else:
            self._send_error(_Error("NotFound", f"GET {self.path}: expected /Info", 404))

    def do_POST(self) -> None:
        """Answer the requests about a model."""
        try:
            self._send(200, self._answer(self._content()))
        except _Error as error:
            self._send_error(error)

    def _content(self) -> dict[str, Any]:
        """The JSON object that was sent."""
        try:
            length = int(self.headers.get("Content-Length", ""))
            if not 0 <= length <= _LARGEST_REQUEST:
                raise ValueError
        except ValueError:
            self.close_connection = True  # the content cannot be read, so the next request cannot be found
            text = f"expected a Content-Length of at most {_LARGEST_REQUEST} bytes"
            raise _Error("InvalidInput", text) from None
        try:
            content = json.loads(self.rfile.read(length))
        except ValueError as error:
            raise _Error("InvalidInput", f"expected JSON: {error}") from None
        if not isinstance(content, dict):
            raise _Error("InvalidInput", "expected a JSON object")
        return content

    def _answer(self, content: dict[str, Any]) -> dict[str, Any]:
        action = self.path.strip("/")
        if action.removesuffix("ShMem") in _UNSUPPORTED:
            raise _Error("UnsupportedFeature", f"{action} is not supported: there are evaluations only")
        name, config = content.get("name"), content.get("config")
        evaluator = self.server.evaluators.get(name) if isinstance(name, str) else None
        if evaluator is None:
            known = ", ".join(self.server.evaluators)
            raise _Error("ModelNotFound", f"expected the name of one of {known}; got {json.dumps(name)[:200]}")
        if action == "Evaluate":
            return {"output": self.server.batches.output(evaluator, content.get("input"), config)}
        if action == "ModelInfo":
            return {"support": {"Evaluate": True} | dict.fromkeys(_UNSUPPORTED, False)}
        if action in ("InputSizes", "OutputSizes"):
            evaluator.density_of(config)
            inputs = action == "InputSizes"
            return {f"{action[0].lower()}{action[1:]}": [evaluator.input_size] if inputs else evaluator.output_sizes}
        raise _Error("NotFound", f"POST {self.path}: expected Evaluate, ModelInfo, InputSizes or OutputSizes", 404)

    def _send_error(self, error: _Error) -> None:
        self._send(error.status, {"error": {"type": error.kind, "message": error.message}})

    def _send(self, status: int, content: dict[str, Any]) -> None:
        body = json.dumps(content, allow_nan=False).encode()
        with suppress(ConnectionError):  # a client that does not wait any more
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            self.wfile.flush()

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are logged for debugging only."""
        logger.debug("%s: %s", self.address_string(), format % args)
