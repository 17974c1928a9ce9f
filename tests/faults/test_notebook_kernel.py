"""A real kernel of notebooks: a run is interrupted as by its stop button, and the cell is run again."""

import queue

import pytest

from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import Gaussian

N, STEPS = 40, 4
SAMPLERS = {"SMCSampler": SMCSampler, "TMCMCSampler": TMCMCSampler}
CELL = """
import time, emcee, samplers
from tests.contract.targets import Gaussian

class Slow(Gaussian):
    has_slept = False
    def __call__(self, x):
        if self.calls == {at} and not self.has_slept:
            self.has_slept = True
            print("under way", flush=True)
            time.sleep(20.0)
        return super().__call__(x)

backend = {backend}
sampler = samplers.{name}({walkers}, 3, Slow(), seed=3, backend=backend)
"""
RUN = f"sampler.run_mcmc(None, {STEPS} - sampler.iteration); None"
SHOW = "print(repr((sampler.get_chain().tolist(), sampler.log_evidence, sampler.evaluations)))"


class Kernel:
    """A kernel in a process of its own."""

    def __init__(self, folder):
        from jupyter_client.manager import KernelManager

        self.manager = KernelManager(kernel_name="python3")
        self.manager.start_kernel(cwd=str(folder))
        self.client = self.manager.client()
        self.client.start_channels()
        self.client.wait_for_ready(timeout=60)

    def start(self, code):
        # by default, a cell that ends with an error aborts those that follow within a moment
        return self.client.execute(code, allow_stdin=False, stop_on_error=False)

    def wait_for(self, text):
        """Read what the kernel prints until it contains a text."""
        said = ""
        while text not in said:
            message = self.client.get_iopub_msg(timeout=60)
            said += message["content"].get("text", "")

    def reply(self, number):
        while True:
            message = self.client.get_shell_msg(timeout=60)
            if message["parent_header"].get("msg_id") == number:
                return message["content"]

    def printed(self, code):
        """What a cell prints."""
        self.drain()
        assert self.reply(self.start(code))["status"] == "ok"
        said = ""
        while not said.endswith("\n"):
            said += self.client.get_iopub_msg(timeout=60)["content"].get("text", "")
        return said

    def drain(self):
        try:
            while True:
                self.client.get_iopub_msg(timeout=0.5)
        except queue.Empty:
            pass

    def close(self):
        self.client.stop_channels()
        self.manager.shutdown_kernel(now=True)


@pytest.fixture
def kernel(pytestconfig):
    pytest.importorskip("ipykernel", reason="NO IPYKERNEL: install it to interrupt a run in a notebook")
    kernel = Kernel(pytestconfig.rootpath)
    yield kernel
    kernel.close()


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize(
    ("name", "place", "in_file"),
    [
        ("SMCSampler", "at beta = 1", True),
        pytest.param("SMCSampler", "annealing", False, marks=pytest.mark.slow),
        pytest.param("TMCMCSampler", "annealing", True, marks=pytest.mark.slow),
        pytest.param("TMCMCSampler", "at beta = 1", False, marks=pytest.mark.slow),
    ],
)
def test_a_cell_that_was_interrupted_is_run_again(name, place, in_file, kernel, tmp_path):
    whole = SAMPLERS[name](N, 3, Gaussian(), seed=3)
    whole.run_mcmc(None, 0)
    annealing = whole.evaluations
    whole.run_mcmc(None, STEPS)
    at = annealing // 2 if place == "annealing" else annealing + N + N // 2
    backend = f"emcee.backends.HDFBackend({str(tmp_path / 'run.h5')!r})" if in_file else None
    setup = CELL.format(at=at, backend=backend, name=name, walkers=N)
    assert kernel.reply(kernel.start(setup))["status"] == "ok"
    number = kernel.start(RUN)
    kernel.wait_for("under way")
    kernel.manager.interrupt_kernel()
    reply = kernel.reply(number)
    assert (reply["status"], reply.get("ename")) == ("error", "KeyboardInterrupt")
    assert kernel.reply(kernel.start(RUN))["status"] == "ok"
    chain, log_evidence, evaluations = eval(kernel.printed(SHOW))
    assert chain == whole.get_chain().tolist()
    assert (log_evidence, evaluations) == (whole.log_evidence, whole.evaluations)


MODEL = """
import numpy as np
from fe_likelihoods import Channel, FELikelihood, FunctionModel, Measurements
TIME, K = np.linspace(0.0, 1.0, 20), 2.0
CHANNELS = (Channel("u", "displacement", "m"),)

def helper(x):
    return K * x

class Spring:
    def force(self, x):
        return helper(x)

def simulate(theta):
    return Spring().force(theta[0]) * TIME[None]

data = Measurements(CHANNELS, 0.01, TIME[None])
unused = (number for number in range(3))  # cannot be sent, and need not be
x = np.array([[1.3, 0.1], [1.1, 0.1], [0.7, 0.1]])

def values(function, **where):
    model = FunctionModel(function, ("a",), CHANNELS, 0.01, 20, version=str(K))
    return FELikelihood(model, data, **where).log_likelihood(x)
"""
COMPARE = """
here = values(simulate)
found = [values(simulate, pool=2), values(lambda theta: simulate(theta), pool=2)]
alone = FELikelihood(FunctionModel(simulate, ("a",), CHANNELS, 0.01, 20, isolated=True), data).log_likelihood(x)
print([np.array_equal(here, other) for other in (*found, alone)], here.sum())
"""


@pytest.mark.slow
def test_functions_of_cells_run_in_workers_with_the_values_of_the_notebook(kernel):
    """Also after a cell has changed a value; the workers are other processes."""
    assert kernel.reply(kernel.start(MODEL))["status"] == "ok"
    sums = []
    for cell in ("", "K = 3.0"):
        assert kernel.reply(kernel.start(cell))["status"] == "ok"
        said = kernel.printed(COMPARE)
        assert said.startswith("[True, True, True]"), said
        sums.append(said)
    assert sums[0] != sums[1]
