"""A run with a progress bar in a process of its own: ``python -m tests.reporting.progress_run [talking]``.

Prints the numbers that the bar must have shown at the end. With ``talking``, the posterior writes a message to the log,
which is shown in the terminal.
"""

import json
import logging
import sys

from samplers import SMCSampler
from tests.contract.targets import Gaussian


class Talking(Gaussian):
    """A posterior that logs between its values."""

    batches = 0

    def __call__(self, x):
        """The log-density."""
        self.batches += 1
        if self.batches == 3:
            logging.getLogger("fe_likelihoods").warning("logged by a handler")
        return super().__call__(x)


def main() -> None:
    """Run."""
    if "talking" in sys.argv:
        logging.getLogger("fe_likelihoods").addHandler(logging.StreamHandler())
    posterior = (Talking if "talking" in sys.argv else Gaussian)(3, 0.02)
    sampler = SMCSampler(250, 3, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 0, progress=True)
    annealed = sampler.evaluations
    sampler.run_mcmc(None, 2, progress=True)
    ladder = sum(stage.log_evidence_increment for stage in sampler.ladder)
    numbers = {"annealed": annealed, "stages": len(sampler.ladder)}
    numbers |= {"evaluations": sampler.evaluations, "log Z": f"{ladder:.2f}"}
    print(json.dumps(numbers))


if __name__ == "__main__":
    main()
