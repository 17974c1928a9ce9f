"""Shared fixtures: the folder of reference material beside the project, and the seed of the statistical tests."""

import os
from pathlib import Path

import numpy as np
import pytest

SHARED = Path(os.environ.get("FE_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the reference results, real records and measurements (``FE_SHARED``, by default ``../shared``)."""
    if not SHARED.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"the reference material must be there in CI: no folder {SHARED}")
        pytest.skip(f"NO REFERENCE MATERIAL at {SHARED}: set FE_SHARED to its folder to run this test")
    return SHARED


@pytest.fixture
def seed() -> int:
    """Seed of the statistical tests (environment variable ``SEED``, by default 20240)."""
    return int(os.environ.get("SEED", "20240"))


@pytest.fixture
def rng(seed) -> np.random.Generator:
    """Generator seeded with `seed`."""
    return np.random.default_rng(seed)
