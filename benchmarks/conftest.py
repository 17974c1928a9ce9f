"""Fixtures of the tests."""

from tests.conftest import figures_are_closed, rng, seed, shared

__all__ = ["figures_are_closed", "rng", "seed", "shared"]
