"""Client for UM-Bridge servers: requests, network faults, and the choice of a server.

UM-Bridge (L. Seelinger, V. Cheng-Seelinger, A. Davis, M. Parno and A. Reinarz, 2023, Journal of Open Source Software
8(83), 4748, doi:10.21105/joss.04748) sends JSON over HTTP. The standard library suffices; UM-Bridge's Python client has
no time limit, and cannot distinguish a lost connection from a model error. Requests are sent directly, ignoring
``http_proxy``, so that servers on this machine are found.
"""

import json
import logging
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import Any
from urllib.parse import urlsplit

__all__ = ["SIMULATION_FAILED", "TRANSIENT_FAILURE", "ServerError", "ServerTimeout", "UMBridgeServers", "Unavailable"]

logger = logging.getLogger(__name__)

TRANSIENT_FAILURE = "TransientFailure"
"""Error type with which `fe_likelihoods.adapters.serve` reports a failure whose cause is not the model."""

SIMULATION_FAILED = "SimulationFailed"
"""Error type with which `fe_likelihoods.adapters.serve` reports other failures."""

_CONNECT_SECONDS = 10.0  # longest time until a server accepts a connection
_LONGEST_WAIT = 60.0  # [s] between two attempts
_RECENT = 30.0  # [s] after a fault during which other servers are preferred
# the system closes a connection within minutes after the other machine has failed silently
_KEEP_ALIVE = [(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)] + [
    (socket.IPPROTO_TCP, getattr(socket, option), value)
    for option, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4))
    if hasattr(socket, option)  # not on every system
]
_BUSY = {429, 502, 503, 504}  # HTTP status of a load balancer without a free server


class Unavailable(RuntimeError):
    """No server could be reached, or each connection was lost; the message says what happened."""


class ServerTimeout(RuntimeError):
    """A server accepted a request and did not answer within the time limit."""


class ServerError(RuntimeError):
    """A server answered with an error of a `kind`, such as "InvalidInput", or "HTTP 500" without UM-Bridge's format."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(f"{kind}: {message}" if message else kind)
        self.kind, self.message = kind, message


class _Fault(Exception):
    """The server did not accept the request, or the connection was lost afterwards."""


class UMBridgeServers:
    """Servers of the same models, at different http or https addresses; each request goes to the least busy server.

    Threads can share the object. Servers that had a fault in the last 30 s are asked last. After a fault, a request is
    repeated `retries` times; the time between the first two attempts, `retry_wait` [s], is doubled each time, up to
    60 s. ValueError for wrong arguments.
    """

    def __init__(self, urls: Sequence[str], retries: int, retry_wait: float) -> None:
        self.urls = tuple(_address(url) for url in urls)
        if not self.urls or len(set(self.urls)) != len(self.urls):
            raise ValueError(f"UM-Bridge: expected one or more different addresses; got {', '.join(self.urls) or urls}")
        if isinstance(retries, bool) or not isinstance(retries, int) or retries < 0:
            raise ValueError(f"UM-Bridge: retries must be a whole number, 0 or more; got {retries!r}")
        if isinstance(retry_wait, bool) or not isinstance(retry_wait, int | float) or not 0.0 <= retry_wait < 1e6:
            raise ValueError(f"UM-Bridge: retry_wait must be a number of seconds, 0 or more; got {retry_wait!r}")
        self.retries, self.retry_wait = retries, float(retry_wait)
        self._running: Counter[str] = Counter()
        self._fault_times: dict[str, float] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple:
        return type(self), (self.urls, self.retries, self.retry_wait)

    def evaluate(self, request: dict[str, Any], time_limit: float | None = None) -> Any:
        """Output vectors of an evaluation, as read from JSON and not checked; `time_limit` [s] is for one attempt.

        `ServerError` if the server answers with an error, `ServerTimeout` if not in time, `Unavailable` if all attempts
        failed.
        """
        for attempt in range(self.retries + 1):
            if attempt:
                time.sleep(min(self.retry_wait * 2.0 ** (attempt - 1), _LONGEST_WAIT))
            try:
                with self._least_busy() as url:
                    return _ask(url, "/Evaluate", request, time_limit, "output")
            except _Fault as fault:
                text = f"{url}: {fault}"
        raise Unavailable(f"{text} ({attempt + 1} attempt{'s' if attempt else ''})")

    @contextmanager
    def _least_busy(self) -> Iterator[str]:
        """The address of the least busy server, on which a request runs; its faults are noted."""
        with self._lock:
            now = time.monotonic()
            url = min(self.urls, key=lambda u: (now - self._fault_times.get(u, -_RECENT) < _RECENT, self._running[u]))
            self._running[url] += 1
        fault = None
        try:
            yield url
        except _Fault as error:
            fault = error
            raise
        finally:
            with self._lock:
                self._running[url] -= 1
                had_fault = self._fault_times.pop(url, None) is not None
                if fault is not None:
                    self._fault_times[url] = time.monotonic()
            if fault is not None and not had_fault:
                logger.warning("UM-Bridge server %s: %s. The request is repeated", url, fault)
            elif fault is None and had_fault:
                logger.warning("UM-Bridge server %s answers again", url)

    def sizes(self, url: str, name: str, config: dict[str, Any]) -> tuple[list[int], list[int]]:
        """Input and output sizes of a model with a configuration on one of the servers.

        ServerError if the server has no such model, the model cannot be evaluated, or the sizes are no lists of vector
        lengths; Unavailable if the server cannot be reached.
        """
        try:
            info = _ask(url, "/Info")
            version, models = info.get("protocolVersion"), info.get("models", [])
            if version != 1:
                raise ServerError("protocol", f"expected version 1.0 of the protocol of UM-Bridge; got {version!r}")
            if name not in models:
                raise ServerError("ModelNotFound", f"expected one of its models {', '.join(map(repr, models))}")
            if not _ask(url, "/ModelInfo", {"name": name}).get("support", {}).get("Evaluate"):
                raise ServerError("UnsupportedFeature", "the model cannot be evaluated")
            request = {"name": name, "config": config}
            sizes = [_ask(url, f"/{end}Sizes", request).get(f"{end.lower()}Sizes") for end in ("Input", "Output")]
        except (_Fault, ServerTimeout) as error:
            raise Unavailable(f"{url}: {error}") from error
        for given in sizes:
            if not isinstance(given, list) or not all(isinstance(size, int) and size >= 0 for size in given):
                raise ServerError("sizes", f"expected lists of the lengths of vectors; got {sizes[0]!r}, {sizes[1]!r}")
        return sizes[0], sizes[1]


def _address(url: str) -> str:
    """Address without a slash at the end; ValueError if it is not a http or https address."""
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and not parts.query and parts.port != 0
    except (AttributeError, TypeError, ValueError):
        usable = False
    if not usable:
        raise ValueError(f"UM-Bridge: expected the address of a server, such as 'http://localhost:4242'; got {url!r}")
    return url.rstrip("/")


def _ask(
    url: str, path: str, content: Any = None, time_limit: float | None = _CONNECT_SECONDS, key: str | None = None
) -> Any:
    """A server's answer, a JSON object, or the object's value for a key; a GET request without `content`."""
    status, body = _exchange(url, path, content, time_limit)
    if status in _BUSY:
        raise _Fault(f"HTTP {status}, no server is free")
    text = body.decode(errors="replace")
    answer = None
    with suppress(ValueError):
        answer = json.loads(text)
    error = answer.get("error") if isinstance(answer, dict) else None
    if isinstance(error, dict):
        raise ServerError(str(error.get("type", "error")), str(error.get("message", "")))
    if status == 200 and isinstance(answer, dict):
        if key is not None and key not in answer:
            raise _Fault(f"the answer has no {key}")
        return answer if key is None else answer[key]
    beginning = " ".join(text[:200].split())
    if status == 500:  # the answer of Python servers if the model raises an exception
        raise ServerError("HTTP 500", beginning)
    if status == 200 and answer is None and re.search(r"\b(nan|inf)\b", text):  # Python's text of such numbers
        raise ServerError("not finite", "the output contains nan or inf")
    raise _Fault(f"HTTP {status}, not an answer of UM-Bridge: {beginning}")


def _exchange(url: str, path: str, content: Any, time_limit: float | None) -> tuple[int, bytes]:
    """Status and body of the answer to one request, on a new connection."""
    parts = urlsplit(url)
    kind = HTTPSConnection if parts.scheme == "https" else HTTPConnection
    body = None if content is None else json.dumps(content, allow_nan=False)
    with closing(kind(parts.hostname, parts.port, timeout=_CONNECT_SECONDS)) as connection:
        try:
            connection.connect()
            for level, option, value in _KEEP_ALIVE:
                connection.sock.setsockopt(level, option, value)
            connection.sock.settimeout(time_limit)
        except OSError as error:
            raise _Fault(f"no connection ({error})") from error
        try:
            headers = {} if body is None else {"Content-Type": "application/json"}
            connection.request("POST" if body else "GET", parts.path + path, body, headers)
            response = connection.getresponse()
            return response.status, response.read()
        except TimeoutError as error:
            if time_limit is None or error.errno is not None:  # the other machine has vanished
                raise _Fault(f"the connection was lost ({error})") from error
            raise ServerTimeout(f"stopped at the time limit of {time_limit:g} s") from error
        except (OSError, HTTPException) as error:
            raise _Fault(f"the connection was lost ({type(error).__name__}: {error})") from error
