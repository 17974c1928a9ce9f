"""Where the reference results are taken from, and what pure Python is allowed."""

from pathlib import Path

import numba
import pytest

from .golden import BUNDLED


@pytest.fixture(params=["bundled", "shared"])
def reference(request) -> Path:
    """Folder of reference results: the extract that travels with the tests, then the full set."""
    if request.param == "bundled":
        return BUNDLED
    return request.getfixturevalue("shared") / "golden" / "column"


def pytest_collection_modifyitems(items):
    """Without compilation numpy warns where the kernels count on IEEE infinities: no fault there."""
    if numba.config.DISABLE_JIT:
        for item in items:
            if Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.filterwarnings("ignore::RuntimeWarning"))
