"""What the result of a run is worth: concerns found while it runs and after it, and the verdict."""

from .failures import NearFailures, failures_near

__all__ = ["NearFailures", "failures_near"]
