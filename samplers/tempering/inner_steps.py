"""Steps of an annealing that is part of another one, passed on to whoever consumes the latter."""

from collections.abc import Generator

from .adaptive_importance import Recycled
from .population import Population, Report, Sweep

__all__ = ["and_last_population", "only_sweeps"]


def and_last_population(
    steps: Generator[tuple[Population, Report], None, Recycled],
) -> Generator[tuple[Population, Report], None, tuple[Recycled, Population]]:
    """The same steps; returns what they return, and their last population."""
    while True:
        try:
            population, report = next(steps)
        except StopIteration as end:
            return end.value, population
        yield population, report


def only_sweeps(
    steps: Generator[tuple[Population, Report], None, Recycled],
) -> Generator[tuple[Population, Sweep], None, Recycled]:
    """The sweeps of a recycling on the coarse model; its stages are not stages of the run."""
    while True:
        try:
            population, report = next(steps)
        except StopIteration as end:
            return end.value
        if isinstance(report, Sweep):
            yield population, report
