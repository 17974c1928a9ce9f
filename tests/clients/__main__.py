"""``python -m tests.clients [client ...]``: runs the clients that are installed, one Markdown row for each.

The errors are the largest of the four parameters; wall time is that of the machine at hand, imports included.
"""

import importlib.metadata
import importlib.util
import logging
import os
import sys
import time

import numpy as np

from .problem import exact, make_posterior
from .runs import CLIENTS
from .scoring import score


def _row(name: str, seed: int) -> str:
    client = CLIENTS[name]
    if importlib.util.find_spec(client.module) is None:
        return f"| {name} | not installed: {client.install} |"
    posterior = make_posterior()
    evaluations = 0
    evaluate = posterior.likelihood.log_likelihood

    def counted(points):
        nonlocal evaluations
        evaluations += len(points)
        return evaluate(points)

    posterior.likelihood.log_likelihood = counted
    wall, cpu = time.perf_counter(), time.process_time()
    found = client.run(posterior, seed)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    result = score(found, exact())
    errors = found.mean_error / exact().sd
    evidence = "-" if found.log_evidence is None else f"{result.log_evidence:+.2f} ({found.log_evidence_error:.2f})"
    worst = np.argmax(np.abs(result.mean))
    ratio = result.sd_ratio[np.argmax(np.abs(np.log(result.sd_ratio)))]
    version = importlib.metadata.version(client.distribution)
    return (
        f"| {name} {version} | {result.mean[worst]:+.2f} ({errors[worst]:.2f}) | {ratio:.2f} | {evidence} | "
        f"{evaluations} | {wall:.1f} | {cpu:.1f} |"
    )


def main() -> None:
    logging.getLogger("fe_likelihoods").setLevel(logging.ERROR)
    seed = int(os.environ.get("SEED", "20240"))
    sys.stdout.write(
        "| client | error of mean, in sd (its standard error) | ratio of sd | error of log-evidence (its error) | "
        "evaluations | wall s | CPU s |\n|---|---|---|---|---|---|---|\n"
    )
    for name in sys.argv[1:] or CLIENTS:
        sys.stdout.write(_row(name, seed) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
