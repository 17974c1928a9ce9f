"""A run with a progress bar in a process of its own: ``python -m tests.reporting.progress_run [log]``.

Prints the numbers that the bar must have shown at the end. With ``log``, the log shows INFO.
"""

import json
import logging
import sys

from samplers import SMCSampler
from tests.contract.targets import Gaussian


def main() -> None:
    """Run."""
    if "log" in sys.argv:
        logging.basicConfig(level=logging.INFO, format="%(name)s|%(message)s")
    posterior = Gaussian(3, 0.02)
    sampler = SMCSampler(250, 3, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 0, progress=True)
    annealed = sampler.evaluations
    sampler.run_mcmc(None, 2, progress=True)
    ladder = sum(stage.log_evidence_increment for stage in sampler.ladder)
    print(json.dumps({"annealed": annealed, "evaluations": sampler.evaluations, "log Z": f"{ladder:.2f}"}))


if __name__ == "__main__":
    main()
