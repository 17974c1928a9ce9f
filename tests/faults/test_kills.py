"""Kills of every kind of run; ``python -m tests.faults.kills`` makes a thousand and more."""

import pytest

from tests.faults.hdf5_calls import kill_everywhere
from tests.faults.kills import kill

pytestmark = pytest.mark.skipif("not hasattr(__import__('os'), 'fork')", reason="needs os.fork")

QUICK, SLOW = ("smc", "asynchronous, guided"), ("guided", "limit", "reset")


@pytest.mark.parametrize("kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)])
def test_the_same_script_goes_on_after_every_kill(kind):
    counts, messages = kill(4, [kind], seed=3, show=lambda *_: None)
    assert counts[kind, "kills"] >= 4
    assert not messages


@pytest.mark.parametrize(
    ("kind", "places"),
    [("smc", ["create_dataset blobs", "has_blobs"]), pytest.param("reset", ["has_blobs"], marks=pytest.mark.slow)],
)
def test_a_half_made_dataset_of_blobs_is_made_again(kind, places):
    kills, messages = kill_everywhere(kind, places)
    assert kills >= len(places) and not messages


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smc", "without blobs", "guided", "tmcmc", "limit", "reset", "thin"])
def test_a_kill_after_each_change_of_the_file_of_a_chain(kind):
    kills, messages = kill_everywhere(kind)
    assert kills > 20 and not messages
