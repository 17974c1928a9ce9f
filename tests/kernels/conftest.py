"""Fixture of the reference results."""

from pathlib import Path

import pytest

from .golden import BUNDLED


@pytest.fixture(params=["bundled", "shared"])
def reference(request) -> Path:
    """Folder of reference results: the extract that is part of the tests, then the full set."""
    if request.param == "bundled":
        return BUNDLED
    return request.getfixturevalue("shared") / "golden" / "column"
