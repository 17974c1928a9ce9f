"""Models that fail like real ones: the first parameter selects how they harm their process."""

import ctypes
import os
import signal
import sys
import time
import weakref
from pathlib import Path

import numpy as np

from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.simulation.model import SimulationFailed

CHANNELS = (Channel("a", "acceleration", "m/s2"),)
DT, N_STEPS = 0.1, 20
LOADED: list[int] = []
TIME = DT * np.arange(N_STEPS)
FINE, RAISES, REFUSES, NOT_FINITE, SHAPE, HANGS, HANGS_HARD, CRASHES, KILLED, LEAVES, FLOODS = range(11)


def line(theta: np.ndarray) -> np.ndarray:
    """The correct response, (1, 20)."""
    return (theta[0] + theta[1] * TIME)[None]


def treacherous(theta: np.ndarray) -> np.ndarray:
    """A line, unless the whole part of theta[0] is one of the names above."""
    what = int(theta[0])
    if what == RAISES:
        raise ZeroDivisionError("float division by zero")
    if what == REFUSES:
        raise SimulationFailed("no convergence at step 3")
    if what == SHAPE:
        return line(theta)[:, 1:]
    if what == HANGS:
        time.sleep(3600)
    if what == HANGS_HARD:
        ctypes.PyDLL(None).sleep(3600)  # in compiled code that holds the GIL
    if what == CRASHES:
        ctypes.string_at(0)
    if what == KILLED:
        os.kill(os.getpid(), signal.SIGKILL)
    if what == LEAVES:
        os._exit(3)
    if what == FLOODS:
        while True:
            os.write(1, b"all is well\n" * 1000)
    return line(theta) * (np.nan if what == NOT_FINITE else 1.0)


class Treacherous:
    """The same function as a model, without protection."""

    parameter_names = ("offset", "slope")
    channels = CHANNELS
    dt = DT
    n_steps = N_STEPS
    fingerprint = "treacherous"

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        return treacherous(theta)


class Hidden:
    """An attribute that no label contains: its values are where the code of a model does not name them."""

    def __set_name__(self, owner, name):
        self.name = name

    def __get__(self, model, owner):
        return vars(sys)["hidden of tests"][model][self.name]

    def __set__(self, model, value):
        vars(sys)["hidden of tests"].setdefault(model, {})[self.name] = value


vars(sys).setdefault("hidden of tests", weakref.WeakKeyDictionary())


class Announced(Treacherous):
    """A model that writes a file named by the process in which it runs."""

    def __init__(self, folder: Path, model) -> None:
        self.folder, self.model = folder, model

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        (self.folder / f"{os.getpid()}").touch()
        return self.model.simulate(theta)


class DiesOnce(Treacherous):
    """Kills its process at the first call for each parameter set, which it marks by a file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        mark = self.folder / f"{theta[0]!r}"
        if int(theta[0]) == KILLED and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return line(theta)


class Gated(Treacherous):
    """A run with an offset in (0.9, 1) takes until a folder has the file ``go``; every run leaves a file there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        (self.folder / f"started {theta[0]!r}").touch()
        while 0.9 < theta[0] < 1.0 and not (self.folder / "go").exists():
            time.sleep(0.005)
        return treacherous(theta)


class DiesLoading:
    """A function whose first process dies while it loads it, and the second at its first item."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._dies(0)

    def __call__(self, item: int) -> int:
        self._dies(1)
        return item

    def _dies(self, *numbers: int) -> None:
        number = len(list(self.folder.iterdir()))
        if number in numbers:
            (self.folder / str(number)).touch()
            os.kill(os.getpid(), signal.SIGKILL)


class Large(Treacherous):
    """A model of 1 MB that counts how often it was unpickled in this process."""

    def __init__(self):
        self.ballast = np.random.default_rng(1).bytes(2**20)

    def __setstate__(self, state):
        self.__dict__.update(state)
        LOADED.append(1)

    def simulate(self, theta):
        response = super().simulate(np.array([0.1, theta[1]]))
        response[0, 0] = len(LOADED)
        return response


class Unpicklable(Treacherous):
    def __init__(self):
        self.solver = type("Solver", (), {})()
        self.solver.output = open(os.devnull, "w")  # noqa: SIM115


class Absent(Treacherous):
    """Can be pickled here but not loaded in another process."""

    def __reduce__(self):
        return _absent, (os.getpid(),)


def _absent(home):
    if os.getpid() == home:
        return Absent()
    raise ModuleNotFoundError("No module named 'mine'")


class Unreachable(OSError):
    """Can be pickled, but not unpickled, because of its constructor."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(f"{host}:{port} is unreachable")


def unreachable(theta: np.ndarray) -> np.ndarray:
    """Needs a server that cannot be reached."""
    raise Unreachable("licences", 27000)


def process_id(theta: np.ndarray) -> np.ndarray:
    """The process in which it runs."""
    return np.full((1, N_STEPS), os.getpid())


def third(theta: np.ndarray) -> np.ndarray:
    """NaN in a third of the prior and an exception in a small part of it."""
    if theta[0] > 0.98:
        raise ValueError("too stiff")
    return line(theta) * (np.nan if theta[0] < 1.0 / 3.0 else 1.0)


def posterior_of(model, top: float = 1.0, **options):
    """Posterior of a model of two parameters, whose offset is between 0 and `top`."""
    # not needed by workers, which start faster without it
    from fe_likelihoods.likelihood.likelihood import FELikelihood
    from fe_likelihoods.likelihood.posterior import Posterior
    from fe_likelihoods.priors.distributions import HalfNormal, Uniform

    noise = np.random.default_rng(3).normal(size=(1, N_STEPS))
    measurements = Measurements(CHANNELS, DT, line(np.array([0.4, 0.7])) + 0.3 * noise)
    prior = {"offset": Uniform(0.0, top), "slope": Uniform(-2.0, 2.0), "sigma_a": HalfNormal(0.5)}
    return Posterior(FELikelihood(model, measurements, **options), prior)


def descendants(pid: int) -> list[int]:
    """Process ids of all descendants of a process, from /proc."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                status = (entry / "stat").read_text()
            except OSError:
                continue
            state, parent = status.rpartition(")")[2].split()[:2]
            if state != "Z":
                parents[int(entry.name)] = int(parent)
    found, new = [], [pid]
    while new:
        new = [child for child, parent in parents.items() if parent in new]
        found += new
    return found


def gone(pids, seconds: float = 20.0) -> bool:
    """Whether all of these processes end within a time."""
    stop = time.monotonic() + seconds
    while any(_runs(pid) for pid in pids):
        if time.monotonic() > stop:
            return False
        time.sleep(0.02)
    return True


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
