"""One row of the table of clients, made in a process of its own (see `__main__`)."""

import importlib.metadata
import importlib.util
import logging
import time

import numpy as np

from .problem import exact, make_posterior
from .runs import CLIENTS
from .scoring import score


def row(name: str, seed: int) -> str:
    """Run one client, compare it with quadrature, and return a row in Markdown."""
    logging.getLogger("fe_likelihoods").setLevel(logging.ERROR)
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
