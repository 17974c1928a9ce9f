"""Quality of a run's result: findings during and after the run, and the verdict."""

from .failures import NearFailures, failures_near

__all__ = ["NearFailures", "failures_near"]
