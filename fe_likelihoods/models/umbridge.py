"""UM-Bridge both ways, on the package `umbridge`: a model on a server, and a server of posteriors and models."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.failure_reasons import ChangedModel, TransientReason, UnusableModel, reason_of
from ..simulation.model import SimulationFailed, simulate_batch
from .user_model import ExternalModel
from .validation import check_integer, check_number, positive_float


def _package() -> Any:
    """The package, whose module `um` imports aiohttp.web and requests; ValueError if it is not installed."""
    try:
        import umbridge
    except ImportError as error:
        raise ValueError("UM-Bridge needs the package umbridge: pip install 'fe-likelihoods[umbridge]'") from error
    return umbridge


class UMBridgeModel(ExternalModel):
    """Model of an UM-Bridge server (docs/own_model.rst); it needs the package umbridge.

    Parameters
    ----------
    url : str
        Address of the server or load balancer. A pool of threads in `FELikelihood` runs several simulations at once.
    name, version : str
        Name of the model on the server, often ``"forward"``, and a text to change whenever that model changes. Both are
        in the fingerprint, as are the configuration and the sizes; the address is not.
    parameter_names, channels, dt, n_steps, depends_on
        As for `FunctionModel`. The parameters fill the input vectors in their order; the server states `n_steps`.
    config : mapping, optional
        Configuration that is sent with every request, of values that JSON can represent.
    output : callable, optional
        Function of the list of output vectors that returns the response (n_channels, n_steps) [SI]. It is required if
        the server does not return one vector [SI] per channel.
    time_limit : float, optional
        Longest wait for an answer [s]. Without it, a machine that vanishes may be waited for without end.
    retries, retry_wait : int, float
        Further attempts if the server cannot be reached or dies; time until the first [s], doubled each time to 60 s.

    Examples
    --------
    A server at this address must run; ``docs/own_model.rst`` starts one.

    >>> remote = UMBridgeModel(
    ...     "http://localhost:4242", "forward", ["stiffness"], [Channel("top", "displacement", "mm")], dt=0.01
    ... )  # doctest: +SKIP
    """

    def __init__(
        self,
        url: str,
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
        if output is not None and (n_steps is None or not callable(output)):
            raise ValueError(f"UMBridgeModel: output must be a function, with n_steps; got {output!r}, {n_steps!r}")
        super().__init__(parameter_names, channels, dt, 1 if n_steps is None else n_steps, depends_on)
        self.time_limit = None if time_limit is None else positive_float(time_limit, "time_limit", "seconds")
        check_integer("number of retries", retries, 0, 1000)
        check_number("zero or positive", "retry_wait", retry_wait)
        self.url, self.name, self.output, self.retries, self.retry_wait = url, name, output, retries, retry_wait
        self.config = dict(sorted((config or {}).items()))
        self.input_sizes, self.output_sizes = sizes = self._sizes()
        self.n_steps = self.n_steps if n_steps is not None else max(self.output_sizes, default=1)
        expected = [self.n_steps] * len(self.channels) if output is None else self.output_sizes
        if sum(self.input_sizes) != len(self.parameter_names) or self.output_sizes != expected:
            raise ValueError(
                f"UMBridgeModel: {name!r} takes vectors of sizes {sizes[0]} and returns {sizes[1]}; got the parameters "
                f"{self.parameter_names} and channels of sizes {expected}: change the names, or give n_steps and output"
            )
        self.fingerprint = self._digest(self.name, self.config, *sizes, str(version))

    def code_parts(self) -> dict[str, Any]:
        """User code, for the label of stored simulations."""
        return {"output": self.output}

    def _sizes(self) -> tuple[list[int], list[int]]:
        """Sizes of the input and output vectors that the server states."""
        package = _package()
        try:
            model = package.HTTPModel(self.url, self.name)
            sizes = model.get_input_sizes(self.config), model.get_output_sizes(self.config)
            return [int(size) for size in sizes[0]], [int(size) for size in sizes[1]]
        except Exception as error:  # the package raises Exception, KeyError and others
            kind = ConnectionError if type(error).__name__ == "ConnectionError" else UnusableModel
            text = f"UMBridgeModel: expected an UM-Bridge server with a model {self.name!r} at {self.url}; got "
            raise kind(f"{text}{type(error).__name__}: {error}. Start it, or correct the address") from error

    def _respond(self, theta: np.ndarray) -> Any:
        if not np.isfinite(theta).all():
            raise SimulationFailed("the parameters are not finite")
        blocks = [block.tolist() for block in np.split(theta, np.cumsum(self.input_sizes[:-1]))]
        answer = self._ask({"name": self.name, "input": blocks, "config": self.config})
        content, place = {}, 0
        try:
            content = answer.json()
        except ValueError as error:
            place = error.pos
        if "error" in content:
            kind, text = content["error"]["type"], content["error"]["message"]
            other = kind in ("InvalidInput", "ModelNotFound", "UnsupportedFeature")
            if other and self._sizes() != (self.input_sizes, self.output_sizes):
                raise ChangedModel(
                    f"UMBridgeModel: the server has another model now, start the first one again: {text}"
                )
            text = text if kind in ("SimulationFailed", "TransientReason") else f"{kind}: {text}"
            raise SimulationFailed(TransientReason(text) if kind == "TransientReason" else text)
        if "output" not in content:
            # the package answers 500 where a model raises an exception, and an output with nan, which is not JSON
            kind = str if answer.status_code == 500 or answer.text.startswith("{") else TransientReason
            raise SimulationFailed(kind(f"not UM-Bridge, HTTP {answer.status_code}: {answer.text[place:][:200]}"))
        vectors = [[x for x in vector if type(x) in (int, float) and abs(x) < np.inf] for vector in content["output"]]
        if [len(vector) for vector in vectors] != self.output_sizes or vectors != content["output"]:
            raise SimulationFailed(f"expected numbers, {self.output_sizes} of them; got {str(content['output'])[:200]}")
        return vectors if self.output is None else self.output([np.array(vector, dtype=float) for vector in vectors])

    def _ask(self, request: dict[str, Any]) -> Any:
        """HTTP answer. The package's own request has no time limit, and hides the HTTP status."""
        requests = _package().um.requests
        for attempt in range(self.retries + 1):
            try:
                answer = requests.post(f"{self.url}/Evaluate", json=request, timeout=(10.0, self.time_limit))
                if answer.status_code not in (429, 502, 503, 504):  # a load balancer without a free server
                    return answer
                answer.raise_for_status()
            except requests.RequestException as error:
                if isinstance(error, requests.ReadTimeout) or attempt == self.retries:
                    raise SimulationFailed(TransientReason(f"{error} (attempt {attempt + 1})")) from error
                time.sleep(min(self.retry_wait * 2.0**attempt, 60.0))


def serve(served: Any, *, host: str = "127.0.0.1", port: int = 4242, block: bool = True) -> UMBridgeServer | None:
    """Make posteriors and models available to clients of UM-Bridge (docs/clients.rst); it needs the package umbridge.

    Parameters
    ----------
    served : Posterior, Model, or mapping of str to these
        A mapping gives the names; a single posterior is named ``"posterior"``, a single model ``"forward"``.
    host, port : str, int
        Where connections are accepted, without passwords; ``"0.0.0.0"`` is all networks, and port 0 a free port.
    block : bool
        Whether to return only after Ctrl-C; else a `UMBridgeServer` in threads of this process is returned: do not
        evaluate `served` elsewhere until its `close`.
    """
    if not isinstance(served, Mapping):
        served = {"posterior" if hasattr(served, "log_prob") else "forward": served}
    application = _application([_served(name, thing) for name, thing in served.items()])
    listening = socket.create_server((host, port))
    if not block:
        return UMBridgeServer(application, listening)
    _package().um.web.run_app(application, sock=listening, access_log=None)


class UMBridgeServer(ExitStack):
    """A running server; `url` is its address. `close` ends it after the points that are being evaluated."""

    def __init__(self, application: Any, listening: socket.socket) -> None:
        def end() -> None:
            raise web.GracefulExit

        super().__init__()
        web = _package().um.web
        self.url, loop = "http://{}:{}".format(*listening.getsockname()), asyncio.new_event_loop()
        options = {"sock": listening, "loop": loop, "handle_signals": False, "print": None, "access_log": None}
        thread = threading.Thread(target=web.run_app, args=(application,), kwargs=options, daemon=True)
        thread.start()
        self.callback(thread.join)
        self.callback(lambda: loop.is_closed() or loop.call_soon_threadsafe(end))  # the first to be called


def _application(models: list[Any]) -> Any:
    """The application that `umbridge.serve_models` would run on all networks; here exceptions have reasons."""
    web = _package().um.web

    @web.middleware
    async def with_reasons(request: Any, handler: Any) -> Any:
        try:
            return await handler(request)
        except Exception as error:
            kind = "TransientReason" if isinstance(reason_of(error), TransientReason) else type(error).__name__
            answer = {"error": {"type": kind, "message": str(error)}}
            return web.json_response(answer, status=getattr(error, "status", 500))

    taken, run = [], web.run_app
    web.run_app = lambda application, **_: taken.append(application)
    try:
        _package().serve_models(models)
    finally:
        web.run_app = run
    taken[0].middlewares.append(with_reasons)
    return taken[0]


def _served(name: str, thing: Any) -> Any:
    """Posterior or model as an object of the package, which asks for the sizes before each evaluation."""
    densities = [density for density in ("log_prob", "log_likelihood", "log_prior") if hasattr(thing, density)]
    if not densities and not all(hasattr(thing, name) for name in ("simulate", "parameter_names", "channels")):
        raise ValueError(f"serve: expected a posterior or a model as {name!r}; got {type(thing).__name__}")
    inputs = [thing.ndim if densities else len(thing.parameter_names)]
    outputs = [1] if densities else [thing.n_steps] * len(thing.channels)

    def input_sizes(config: dict[str, Any]) -> list[int]:
        if config and (list(config) != ["density"] or config["density"] not in densities):
            raise ValueError(f"expected a config with at most a density, one of {densities}; got {config}")
        return inputs

    def numbers(parameters: list[list[float]]) -> np.ndarray:
        point = np.asarray(parameters)
        if point.dtype.kind not in "fiu" or not np.isfinite(point).all():
            raise ValueError(f"expected finite numbers; got {str(parameters)[:200]}")
        return point.astype(float)

    def evaluate(parameters: list[list[float]], config: dict[str, Any]) -> list[list[float]]:
        point = numbers(parameters)
        if densities:
            (value,) = getattr(thing, config.get("density", densities[0]))(point)
            return [[max(float(value), -1e100)]]  # JSON has no infinite numbers
        (response,), (reason,) = simulate_batch(thing, point)
        if reason:
            raise SimulationFailed(reason)
        return response.tolist()

    def gradient(out: int, into: int, parameters: list, sens: list[float], config: dict[str, Any]) -> list[float]:
        density = config.get("density", densities[0])
        if density == "log_prior":
            raise ValueError("expected the density log_prob or log_likelihood for a gradient; got log_prior")
        (slopes,) = getattr(thing, f"grad_{density}")(numbers(parameters))
        return (sens[0] * slopes).tolist()

    model = _package().Model(name)
    model.supports_evaluate, model.__call__ = lambda: True, evaluate
    if getattr(thing, "is_differentiable", False):
        model.supports_gradient, model.gradient = lambda: True, gradient
    model.get_input_sizes, model.get_output_sizes = input_sizes, lambda config: outputs
    return model
