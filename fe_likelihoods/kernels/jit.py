"""The decorator that compiles kernels, and a disk cache that is never stale.

numba identifies cached machine code by the file that defines a function. It does not notice an edit of a kernel that
this function calls in another file, and would keep using the old machine code. Here the cache folder is named after a
hash of the sources of all kernels: any edit opens a new folder, and an unchanged library starts without compiling. The
same hash is part of the fingerprint of every model, so that results of other kernels are never mistaken for current
ones.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba

__all__ = ["kernel", "CACHE_FOLDER", "KERNEL_HASH", "SUM_REORDERING"]

SUM_REORDERING = {"reassoc", "contract", "nsz"}
"""LLVM flags that allow sums to be reordered, which SIMD reductions need. NaN and infinity keep their meaning, which
full `fastmath` does not guarantee."""


def _hash_sources() -> str:
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


KERNEL_HASH: str = _hash_sources()
"""Hash of the sources of all kernels."""


def _find_cache_folder() -> str:
    """Return the first writable folder below $FE_LIKELIHOODS_CACHE, $XDG_CACHE_HOME, ~/.cache, the temporary folder."""
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
        f"expected a writable folder for compiled kernels; none of {[r for r in roots if r]} can be written: set the "
        "environment variable FE_LIKELIHOODS_CACHE to a writable folder"
    )


CACHE_FOLDER: str = _find_cache_folder()
"""Folder of the machine code."""


def kernel(
    function: Callable | None = None, *, inline: bool = False, fastmath: set[str] | bool = False, cache: bool = True
) -> Callable:
    """Compile a kernel: no Python objects, no GIL, IEEE division, no allocation, cached on disk.

    Kernels are compiled without numba's reference counting: the caller provides every array, and an allocation is a
    compile error. Reference counting took 110 of the 180 ns of one evaluation of a section.

    Parameters
    ----------
    function : callable
        The kernel in plain Python; it stays available as ``.py_func``.
    inline : bool
        Merge the body into every caller. This is for functions of the inner loop that take arrays, because a call
        passes about eight scalars per array.
    fastmath : set of str
        LLVM flags; this library uses `SUM_REORDERING` only.
    cache : bool
        Keep the machine code on disk. Inlined functions are never cached on their own.

    Returns
    -------
    callable
        The compiled function, or a decorator where `function` is omitted.
    """
    if function is None:
        return lambda f: kernel(f, inline=inline, fastmath=fastmath, cache=cache)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = CACHE_FOLDER  # numba reads it at decoration; it is restored below
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
