"""A run with a progress bar in a process of its own: ``python -m tests.reporting.progress_run [log|talking]``.

Prints the numbers that the bar must have shown at the end. With ``log``, the log shows INFO. With ``talking``, the
posterior writes messages to the terminal.
"""

import json
import logging
import sys
import warnings

from samplers import SMCSampler
from tests.contract.targets import Gaussian


class Talking(Gaussian):
    """A posterior that warns, logs and prints between its values."""

    batches = 0

    def __call__(self, x):
        """The log-density."""
        self.batches += 1
        if self.batches == 2:
            warnings.warn("warned", stacklevel=1)
        elif self.batches == 3:
            logging.getLogger("some.model").warning("logged without one")  # by the handler of last resort
            logging.getLogger("fe_likelihoods").warning("logged by a handler")
        elif self.batches == 4:
            print("printed", file=sys.stderr)
        return super().__call__(x)


def main() -> None:
    """Run."""
    if "log" in sys.argv:
        logging.basicConfig(level=logging.INFO, format="%(name)s|%(message)s")
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
