"""Arrays of a record in memory are in a temporary file, which is opened late and closed early, and never shared."""

import os
import tempfile

import numpy as np
import pytest

from samplers.record import Record
from tests.faults.resumable_run import go_on, make


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_processes_have_a_temporary_file_each():
    record = Record()
    record.remembering()("first", lambda: [np.zeros(3)])
    (waits, tells), child = os.pipe(), os.fork()
    if child == 0:
        os.read(waits, 1)
        remember = record.remembering()
        right = [remember(key, lambda: [np.ones(3)])[0].all() for key in ("first", "second")]
        os._exit(0 if all(right) else 1)
    remember = record.remembering()
    for key, value in (("first", 0.0), ("second", 2.0)):
        remember(key, lambda value=value: [np.full(3, value)])
    os.write(tells, b"1")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    os.close(waits), os.close(tells)
    remember = record.remembering()
    assert [remember(key, pytest.fail)[0][0] for key in ("first", "second")] == [0.0, 2.0]


def test_a_run_without_arrays_needs_no_temporary_folder(monkeypatch, tmp_path):
    sampler = go_on(make(None, "moves"), steps=1)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert go_on(sampler, steps=2).iteration == 2


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="NO /proc ON THIS SYSTEM")
def test_a_finished_run_leaves_no_file_open():
    before = os.listdir("/proc/self/fd")
    kept = [go_on(make(None, kind), steps=1) for kind in ("guided", "smc", "moves")]
    assert len(os.listdir("/proc/self/fd")) == len(before) and kept[0].iteration == 1
