"""Fixture of the reference results, and warnings that are expected in pure Python."""

from pathlib import Path

import numba
import pytest

from .golden import BUNDLED


@pytest.fixture(params=["bundled", "shared"])
def reference(request) -> Path:
    """Folder of reference results: the extract that is part of the tests, then the full set."""
    if request.param == "bundled":
        return BUNDLED
    return request.getfixturevalue("shared") / "golden" / "column"


def pytest_collection_modifyitems(items):
    """Ignore numpy's warnings in pure Python, because the kernels rely on IEEE infinities."""
    if numba.config.DISABLE_JIT:
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.filterwarnings("ignore::RuntimeWarning"))
