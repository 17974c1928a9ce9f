"""Quality of a run's result: concerns found during and after the run, and the verdict."""

from .failures import NearFailures, failures_near

__all__ = ["NearFailures", "failures_near"]
