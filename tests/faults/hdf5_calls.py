"""Kills by signal 9 after each call of h5py that changes a file: ``python -m tests.faults.hdf5_calls``.

What was changed before the call is on disk. HDF5 itself writes in another order and later, which `tests.faults.kills`
covers: it kills at the writes of the file.
"""

import os
import pickle
import shutil
import signal
import tempfile
from pathlib import Path

import h5py

from tests.faults.kills import end, evaluated_again, fork, script, whole_outcomes

CHANGES = [
    (h5py.Group, "create_dataset"),
    (h5py.Group, "create_group"),
    (h5py.Group, "__delitem__"),
    (h5py.Dataset, "__setitem__"),
    (h5py.Dataset, "resize"),
    (h5py.AttributeManager, "__setitem__"),
]


def count_changes(at=None):
    """Count the calls of this process that change an HDF5 file, and kill it after the call number `at`.

    Returns the calls so far, by method and name of what is changed.
    """
    calls = []

    def counted(method, what):
        def call(self, *args, **kwargs):
            result = method(self, *args, **kwargs)
            calls.append(f"{what} {args[0] if args and isinstance(args[0], str) else getattr(self, 'name', '')}")
            if len(calls) == at:
                h5py.h5f.flush(self._id if isinstance(self, h5py.AttributeManager) else self.id)
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return call

    for owner, name in CHANGES:
        setattr(owner, name, counted(getattr(owner, name), f"{owner.__name__}.{name}"))
    return calls


def changes_of(kind, folder):
    """The calls of a whole run that change its HDF5 file."""

    def counted():
        calls = count_changes()
        script(kind, folder / "counted.h5")
        return pickle.dumps(calls)

    return pickle.loads(end(*fork(counted))[1])


def kill_after(kind, at, folder, whole):
    """Kill a run of a kind after the call number `at`, and run it again; what went wrong, as text."""
    folder.mkdir()
    path = folder / "run.h5"

    def killed():
        count_changes(at)
        return script(kind, path)

    status, said = end(*fork(killed))
    if not os.WIFSIGNALED(status):
        return f"not killed: {said.decode()}"
    status, said = end(*fork(lambda: script(kind, path)))
    if status != 0:
        return f"stuck: {said.decode()}"
    if pickle.loads(said)[0] not in whole:
        return "wrong: another outcome"
    return "lost: evaluations were made again" if evaluated_again(folder / "log", kind) else ""


def kill_everywhere(kind, places=None):
    """Kill a run of a kind after each of its calls, or after those whose text contains one of `places`.

    Returns the number of kills, and messages of what went wrong.
    """
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    try:
        whole = whole_outcomes(kind, folder / "whole")[0]
        calls = changes_of(kind, folder)
        chosen = [n for n, call in enumerate(calls, 1) if places is None or any(place in call for place in places)]
        found = {n: kill_after(kind, n, folder / str(n), whole) for n in chosen}
    finally:
        shutil.rmtree(folder)
    return len(chosen), [f"{kind}, call {n} ({calls[n - 1]}): {wrong}" for n, wrong in found.items() if wrong]


if __name__ == "__main__":
    for each in ("smc", "without blobs", "guided", "tmcmc", "moves", "limit", "reset", "thin"):
        print(each, *kill_everywhere(each), sep="\n", flush=True)
