"""Kills at random writes; ``python -m tests.faults.kills`` makes a thousand and more."""

import pytest

from tests.faults.kills import kill

pytestmark = pytest.mark.skipif("not hasattr(__import__('os'), 'fork')", reason="needs os.fork")


@pytest.mark.parametrize("number", [4, pytest.param(300, marks=pytest.mark.slow)])
def test_the_same_script_goes_on_after_every_kill(number):
    kills, bad, messages = kill(number, seed=3)
    assert sum(kills.values()) >= number
    assert not bad, messages
