"""A run with a progress bar in a process of its own; prints the numbers that the bar must have shown at the end."""

import json

from samplers import SMCSampler
from tests.contract.targets import Gaussian


def main() -> None:
    """Run."""
    sampler = SMCSampler(250, 3, Gaussian(3, 0.02), vectorize=True, seed=1)
    sampler.run_mcmc(None, 0, progress=True)
    annealed = sampler.evaluations
    sampler.run_mcmc(None, 2, progress=True)
    ladder = sum(stage.log_evidence_increment for stage in sampler.ladder)
    print(json.dumps({"annealed": annealed, "stages": len(sampler.ladder), "log Z": f"{ladder:.2f}"}))


if __name__ == "__main__":
    main()
