"""Servers of UM-Bridge in processes of their own: ``python -m tests.clients.served KIND PORT``; KIND is of `KINDS`."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np

TIME = 0.1 * np.arange(20)
WRONG = ["nan", "-inf", "NaN", '"1.0"', "null", "[1.0]", "true", "1.0, 1.0"]  # at slopes of 90, 91, ...


class Verbatim(float):
    """A number that JSON gets as another text."""

    def __repr__(self):
        return WRONG[int(self) - 90]


def line(theta):
    """Two straight lines (2, 20); they fail at offsets above 3."""
    if theta[0] > 3.0:
        raise RuntimeError("the offset is too large")
    return np.array([theta[0] + theta[1] * TIME, theta[0] / 3.0 - theta[1] * TIME])


def package():
    """The package's own server: `line` from two input vectors, a text of `WRONG` in it, or the end of the server."""
    import umbridge

    class Line(umbridge.Model):
        def get_input_sizes(self, config):
            return [1, 1]

        def get_output_sizes(self, config):
            return [20, 20]

        def supports_evaluate(self):
            return True

        def __call__(self, parameters, config):
            (offset,), (slope,) = parameters
            if slope == 99.0:
                os._exit(1)  # as if killed during a simulation
            top, base = (config.get("factor", 1.0) * line([offset, slope])).tolist()
            return [top[:-1] + [Verbatim(slope) if slope >= 90.0 else top[-1]], base]

    umbridge.serve_models([Line("forward")], int(sys.argv[2]))


def ours():
    """Our server of a posterior and of a model that fails for several reasons."""
    from fe_likelihoods import Channel, FunctionModel, SimulationFailed
    from fe_likelihoods.adapters import serve
    from fe_likelihoods.simulation.failure_reasons import TransientReason

    from .problem import make_posterior

    def fails(theta):
        if theta[0] > 2.0:
            raise SimulationFailed("collapse at the top" if theta[0] > 3.0 else TransientReason("no licence was free"))
        return line(theta)

    channels = Channel("top", "displacement", "mm"), Channel("base", "displacement", "mm")
    model = FunctionModel(fails, ("offset", "slope"), channels, 0.1, 20, version="line")
    serve({"line": model, "posterior": make_posterior()}, port=int(sys.argv[2]))
    print("done")


KINDS = {"package": package, "ours": ours}


def free_port():
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Process:
    """A server that accepts connections once this object is made; it is killed at the end of the with-block."""

    def __init__(self, kind, port=None):
        self.port = port or free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        command = [sys.executable, "-u", "-m", __name__, kind, str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])
        assert any("Running on http" in text for text in self.process.stdout), f"{kind} has not started"

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.process.kill()
        self.process.communicate()


if __name__ == "__main__":
    KINDS[sys.argv[1]]()
