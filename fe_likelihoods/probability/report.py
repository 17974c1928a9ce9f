"""Summary of the simulations of a likelihood."""

from typing import Any

__all__ = ["simulation_report"]


def simulation_report(likelihood: Any) -> dict:
    """Summary of the simulations that a likelihood has requested in this process, see `Posterior.report`."""
    return {
        "simulations": likelihood.simulations,
        "verifications": likelihood.verifications,
        "unverified": likelihood.unverified,
        "cache_hits": likelihood.cache_hits,
        "disk_hits": likelihood.disk_hits,
        "failures": list(likelihood.failures),
        "failure_count": likelihood.failure_count,
        "transient_failures": likelihood.transient_failure_count,
        "failure_reasons": dict(likelihood.failure_reasons),
        "seconds": likelihood.seconds,
    }
