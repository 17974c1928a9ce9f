"""Servers of UM-Bridge in processes of their own: ``python -m tests.clients.served KIND PORT FOLDER``.

KIND is one of `KINDS`. The address is printed once connections are accepted. The runs of `held_line` leave
files in FOLDER.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from fe_likelihoods import Channel, FunctionModel, SimulationFailed
from fe_likelihoods.adapters import serve
from fe_likelihoods.simulation.faults import TransientReason

__all__ = ["CHANNELS", "DT", "KINDS", "NAMES", "TIME", "Process", "line", "line_model", "runs_of"]

DT, TIME = 0.1, 0.1 * np.arange(20)
NAMES, CHANNELS = ("offset", "slope"), (Channel("top", "displacement", "mm"), Channel("base", "displacement", "mm"))
FOLDER = Path(sys.argv[3]) if __name__ == "__main__" else Path()


def line(theta):
    """Two straight lines (2, 20); they fail at offsets above 3, and at 2.5 for a reason that is not the model."""
    if theta[0] > 3.0:
        raise SimulationFailed("the offset is too large")
    if theta[0] == 2.5:
        raise SimulationFailed(TransientReason("no licence was free"))
    return np.array([theta[0] + theta[1] * TIME, theta[0] / 3.0 - theta[1] * TIME])


def held_line(theta):
    """The same; each run leaves a file in FOLDER, but waits while there are as many as the file `limit` says."""
    limit = FOLDER / "limit"
    while limit.exists() and len(runs_of(FOLDER)) >= int(limit.read_text() or 0):
        time.sleep(0.005)
    FOLDER.joinpath(f"run-{os.getpid()}-{time.monotonic_ns()}").touch()
    return line(theta)


def runs_of(folder):
    """Files that runs have left in a folder."""
    return list(Path(folder).glob("run-*"))


def line_model(function=line):
    """Model of one of these functions."""
    return FunctionModel(function, NAMES, CHANNELS, DT, len(TIME), version="line")


def _reference(port):
    """The server of the package umbridge: two blocks of inputs and outputs, a configuration, errors and NaN."""
    import umbridge
    from aiohttp import web

    class Blocks(umbridge.Model):
        def get_input_sizes(self, config):
            return [1, 2]

        def get_output_sizes(self, config):
            return [2, 3]

        def supports_evaluate(self):
            return True

        def __call__(self, parameters, config):
            (a,), (b, c) = parameters
            if a > 1.0:
                raise RuntimeError("did not converge")
            if a == 1.0:
                return [[np.nan, a], [a, b, c]]
            return [[a, b], [config.get("factor", 1.0) * c, a, b]]

    run_app = web.run_app

    def on_loopback(app, port):
        run_app(app, host="127.0.0.1", port=port, print=lambda *_: print(f"http://127.0.0.1:{port}", flush=True))

    web.run_app = on_loopback
    umbridge.serve_models([Blocks("blocks")], port)


def _posterior():
    from .problem import make_posterior

    return make_posterior()


KINDS = {
    "line": lambda: {"forward": line_model()},
    "held line": lambda: {"forward": line_model(held_line)},
    "posterior": lambda: {"posterior": _posterior()},
}


class Process:
    """A server in another process, which accepts connections when this object is made.

    The kind is one of `KINDS`, or "reference"; port 0 is a free one; `folder` has the files of `held_line`.
    """

    def __init__(self, kind, port=0, folder="."):
        command = [sys.executable, "-m", __name__, kind, str(port), str(folder)]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=Path(__file__).parents[2]
        )
        self.url = self._process.stdout.readline().strip()
        assert self.url, f"the server {kind} has not started"
        self.port = int(self.url.rpartition(":")[2])

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.kill()

    def kill(self):
        """End the process by SIGKILL."""
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


def main():
    """Serve until the process is killed."""
    kind, port = sys.argv[1], int(sys.argv[2])
    if kind == "reference":
        _reference(port)
        return
    with serve(KINDS[kind](), port=port, block=False) as server:
        print(server.url, flush=True)
        while True:
            time.sleep(3600.0)


if __name__ == "__main__":
    main()
