"""A run that a test can kill: its posterior takes time in every call, and returns blobs."""

import time

import emcee

from samplers import RAMANCHA_2022_LITERAL, SMCSampler, TMCMCSampler
from tests.contract.targets import WithBlobs
from tests.tempering.guides import SearchingGuide

N, NDIM = 40, 3
SAMPLERS = {
    "smc": (SMCSampler, {"recycle": True}),
    "moves": (SMCSampler, {"recycle": False}),
    "tmcmc": (TMCMCSampler, {}),
    "leaders": (TMCMCSampler, {"chains": "leaders", "burn_in": 1}),
    "literal": (SMCSampler, {**RAMANCHA_2022_LITERAL, "ess_floor": 10.0}),  # the floor of the preset is above N
    "guided": (SMCSampler, {"guide": SearchingGuide}),
    "guided, TMCMC": (TMCMCSampler, {"guide": SearchingGuide}),
    "stretch": (SMCSampler, {"moves": emcee.moves.StretchMove(), "max_moves": 5}),
}


class Slow(WithBlobs):
    """Waits in every call."""

    def __init__(self, seconds, **kwargs):
        super().__init__(**kwargs)
        self.seconds = seconds

    def __call__(self, x):
        time.sleep(self.seconds)
        return super().__call__(x)


def make(path, name, seconds=0.0, sd=0.01, **changes):
    """The sampler with a file; the seed is that of the first run, later ones continue it whatever their own seed is."""
    Sampler, settings = SAMPLERS[name]
    posterior = Slow(seconds, ndim=NDIM, sd=sd)
    backend = emcee.backends.HDFBackend(str(path))
    settings = {"seed": 5, **settings, **changes}
    if "guide" in settings:
        settings["guide"] = settings["guide"](posterior)
    return Sampler(N, NDIM, posterior, vectorize=True, backend=backend, **settings)
