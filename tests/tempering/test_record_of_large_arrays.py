"""Arrays under a key of a record are returned as they were."""

import pickle
import tracemalloc

import numpy as np
import pytest

from samplers.record import Record


@pytest.mark.parametrize("in_file", [False, True])
def test_large_arrays_are_returned_as_they_were(tmp_path, in_file):
    record = Record(tmp_path / "run.record" if in_file else None)
    record.open()
    random = np.random.default_rng(1)
    given = [[random.standard_normal((n, 3)).astype(np.float32), np.arange(2)] for n in (200_000, 5, 150_000)]

    def asked_from(some, compute):
        remember = some.remembering()
        return [remember("key", (lambda arrays=arrays: arrays) if compute else pytest.fail) for arrays in given]

    asked_from(record, True)
    others = [record, pickle.loads(pickle.dumps(record))]
    if in_file:
        record.close()
        others.append(Record(tmp_path / "run.record"))
    for other in others:
        for arrays, expected in zip(asked_from(other, False), given, strict=True):
            assert len(arrays) == 2 and all(map(np.array_equal, arrays, expected))


def test_large_arrays_of_a_record_in_memory_are_on_disk():
    record, size = Record(), 2_000_000  # 50 stiffnesses: derivatives took 200 of 460 MB
    tracemalloc.start()
    remember = record.remembering()
    for number in range(5):
        remember("key", lambda number=number: [np.full(size, number)])
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 8 * size
    remember = record.remembering()
    assert all(np.array_equal(remember("key", pytest.fail)[0], np.full(size, number)) for number in range(5))
