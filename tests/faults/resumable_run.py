"""Runs that a test can kill: their posterior writes down every point, counts failures, and returns blobs."""

import os
from concurrent.futures import Executor, Future
from pathlib import Path

import emcee
import numpy as np

from samplers import SMCSampler
from tests.contract.targets import WithBlobs
from tests.tempering.guides import SearchingGuide

N, NDIM, STEPS, BURN_IN = 40, 3, 4, 2


class InOrder(Executor):
    """An executor that evaluates a point when it is submitted, so that the order of arrival is no matter of chance."""

    def submit(self, function, *args):
        future = Future()
        future.set_result(function(*args))
        return future


KINDS = {
    "smc": (SMCSampler, {"recycle": True}),
    "moves": (SMCSampler, {"recycle": False}),
    "guided": (SMCSampler, {"guide": SearchingGuide}),
    "map": (SMCSampler, {"recycle": True}),
    "asynchronous": (SMCSampler, {"recycle": True, "asynchronous": True, "pool": InOrder}),
    "limit": (SMCSampler, {"recycle": True}),
    "reset": (SMCSampler, {"recycle": False}),
    "thin": (SMCSampler, {"recycle": False}),
}


class Watched(WithBlobs):
    """Writes the points of every call to a file, and fails for a few of them.

    `event` is called before the values are computed.
    """

    def __init__(self, log=None, event=None, **kwargs):
        super().__init__(**kwargs)
        self.log, self.event = log, event

    def __call__(self, x):
        if self.log is not None:
            points = np.atleast_2d(np.asarray(x, dtype=float))
            note = np.array([os.getpid(), *[0] * (NDIM - 2), len(points)], dtype=float)
            with open(self.log, "ab", buffering=0) as file:  # one write for every call
                file.write(np.vstack([note, points]).tobytes())
        if self.event is not None:
            self.event()
        values = super().__call__(x)
        values[..., 0] = np.where(np.asarray(x)[..., 0] < -1.7, np.nan, values[..., 0])
        return values


def calls(log) -> list[tuple[int, list[bytes]]]:
    """Calls in a log: process and points of each."""
    rows = np.frombuffer(Path(log).read_bytes()).reshape(-1, NDIM) if Path(log).exists() else np.empty((0, NDIM))
    found, place = [], 0
    while place < len(rows):
        n = int(rows[place, -1])
        found.append((int(rows[place, 0]), [row.tobytes() for row in rows[place + 1 : place + 1 + n]]))
        place += 1 + n
    return found


def points_of(log) -> list[bytes]:
    """All points in a log."""
    return [point for _, points in calls(log) for point in points]


def make(path, kind, sd=0.01, log=None, event=None, **changes):
    """The sampler with a file, or in memory without a path."""
    Sampler, settings = KINDS[kind]
    posterior = Watched(log, event, ndim=NDIM, sd=sd)
    backend = None if path is None else emcee.backends.HDFBackend(str(path))
    settings = {"seed": 5, **settings, **changes}
    if "guide" in settings:
        settings["guide"] = settings["guide"](posterior)
    if "pool" in settings:
        settings["pool"] = settings["pool"]()
    return Sampler(N, NDIM, posterior, vectorize=kind not in ("map", "asynchronous"), backend=backend, **settings)


def go_on(sampler, kind="smc", steps=STEPS):
    """What a user's script does with a new sampler or with one whose run was interrupted."""
    thinning = {"thin_by": 2} if kind == "thin" else {}
    if kind == "reset" and sampler.iteration == 0:
        sampler.run_mcmc(None, BURN_IN)
        sampler.reset()
    sampler.run_mcmc(None, steps - sampler.iteration, **thinning)
    return sampler


def outcome(sampler) -> tuple:
    """What must be equal to the last bit: chain, counts of proposals, ladder, verdict, counts and failures."""
    backend = sampler.backend
    arrays = [sampler.get_chain(), sampler.get_log_prob(), sampler.get_blobs(), backend.accepted]
    numbers = sampler.log_evidence, sampler.log_evidence_error, sampler.log_evidence_check, sampler.verdict
    stages = [stage._replace(seconds=0) for stage in sampler.ladder]
    counts = sampler.evaluations, sampler.simulations, sampler.failure_count, int(sampler.iteration)
    failures = [(failure["parameters"].tobytes(), failure["reason"]) for failure in sampler.failures]
    return (
        *(np.asarray(values, dtype=float).tobytes() for values in arrays),
        sampler.random_state[1].tobytes(),
        *(
            repr(value)
            for value in (stages, *numbers, counts, failures, int(sampler.get_last_sample().random_state[2]))
        ),
    )
