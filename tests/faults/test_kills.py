"""Kills of every kind of run."""

import pytest

from tests.faults.kills import kill

pytestmark = pytest.mark.skipif("not hasattr(__import__('os'), 'fork')", reason="needs os.fork")

QUICK, SLOW = ("smc", "guided"), ("asynchronous", "limit", "reset")


@pytest.mark.parametrize("kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)])
def test_the_same_script_goes_on_after_every_kill(kind):
    kills, messages = kill(4, kind, seed=3)
    assert kills >= 4 and not messages
