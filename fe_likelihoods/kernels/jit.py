"""How the kernels are compiled: one decorator, and a disk cache that is never stale.

numba keys its disk cache by the file that holds a function, so an edit in a *called* kernel of another file
would leave an old machine code in use. Here the cache lies in a folder named by a hash of the sources of all
kernels: any edit opens a new folder, an unchanged library starts without compiling. The same hash enters the
fingerprint of every model, so that a result computed by other kernels is never taken for a current one.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba

__all__ = ["kernel", "KERNEL_HASH", "SUM_REORDERING"]

SUM_REORDERING = {"reassoc", "contract", "nsz"}
"""LLVM licence to reorder sums (SIMD reductions). Not `fastmath`: NaN and infinity keep their meaning."""


def _hash_sources() -> str:
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


KERNEL_HASH: str = _hash_sources()
"""Hash of the sources of all kernels."""


def _cache_folder() -> str:
    """First writable of $FE_LIKELIHOODS_CACHE, $XDG_CACHE_HOME, ~/.cache and the temporary folder."""
    user = f"fe_likelihoods-{os.getuid()}" if hasattr(os, "getuid") else "fe_likelihoods"
    roots = [
        os.environ.get("FE_LIKELIHOODS_CACHE"),
        os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "fe_likelihoods"),
        os.path.join(tempfile.gettempdir(), user),
    ]
    for root in filter(None, roots):
        folder = os.path.join(root, f"kernels-{KERNEL_HASH}")
        try:
            os.makedirs(folder, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    raise OSError(
        f"no writable folder for compiled kernels among {roots}: set FE_LIKELIHOODS_CACHE to one that can be written"
    )


_CACHE_FOLDER = _cache_folder()


def kernel(
    function: Callable | None = None, *, inline: bool = False, fastmath: set[str] | bool = False, cache: bool = True
) -> Callable:
    """Compile a kernel: no Python objects, no GIL, IEEE division, no allocation, cached on disk.

    Kernels are compiled without numba's reference counting: every array comes from the caller, and an allocation is a
    compile error. Counting the references of the arrays of a section cost more than its fibers (110 of 180 ns).

    Parameters
    ----------
    function : callable
        The kernel in plain Python; it stays reachable as ``.py_func``.
    inline : bool
        Merge the body into every caller: for functions of the hot loop that take arrays, because a call passes
        about eight scalars for each array.
    fastmath : set of str
        LLVM flags; only `SUM_REORDERING` is used in this library.
    cache : bool
        Keep the machine code on disk. Functions that are only ever merged into others need none.
    """
    if function is None:
        return lambda f: kernel(f, inline=inline, fastmath=fastmath, cache=cache)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _CACHE_FOLDER  # read by numba at decoration; other users' setting is put back
    try:
        return numba.njit(
            nogil=True,
            error_model="numpy",
            cache=cache and not inline,
            forceinline=inline,
            fastmath=fastmath,
            _nrt=False,
        )(function)
    finally:
        numba.config.CACHE_DIR = before
