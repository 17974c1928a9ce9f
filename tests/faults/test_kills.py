"""Kills of every kind of run; ``python -m tests.faults.kills`` makes a thousand and more."""

import pytest

from tests.faults.kills import kill

pytestmark = pytest.mark.skipif("not hasattr(__import__('os'), 'fork')", reason="needs os.fork")

QUICK, SLOW = ("smc", "asynchronous, guided"), ("guided", "limit", "reset")


@pytest.mark.parametrize("kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)])
def test_the_same_script_goes_on_after_every_kill(kind):
    counts, messages = kill(4, [kind], seed=3, show=lambda *_: None)
    assert counts[kind, "kills"] >= 4
    assert not messages
