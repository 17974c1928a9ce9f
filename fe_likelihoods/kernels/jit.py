"""The decorator that compiles kernels, and a disk cache that is never stale.

numba identifies cached machine code by the path of the file that defines a function. It does not notice an edit of a
kernel that this function calls in another file, and would keep using the old machine code; and it compiles an equal
copy of the library again. Here the cache folder is named after numba's version and a hash over all kernel sources, and
a kernel is found there by its module and the content of its file: any edit opens a new folder, and all equal copies of
the library, in any checkout or environment of a user, start without compiling. Caches of simulations use the hash as
the code of built-in models (`fe_likelihoods.simulation.label`).
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import stat
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import numba
from numba.core import caching
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.types import unliteral

try:
    from fcntl import LOCK_EX, LOCK_NB, LOCK_UN, flock
except ImportError:  # Windows: processes that start together may each compile
    flock = None

__all__ = ["kernel", "CACHE_FOLDER", "KERNEL_HASH", "SUM_REORDERING"]

logger = logging.getLogger(__name__)

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
"""Hash over all kernel sources."""


def _private_folder(path: str) -> str:
    """Create a folder into which only this user can write; OSError if that is impossible.

    numba's index is a pickle, and loading it runs the code in it: nobody else may have written it. A folder of somebody
    else, one that others could write to, and a link are not used.
    """
    with suppress(FileExistsError):
        os.mkdir(path, 0o700)
    status = os.lstat(path)
    ours = not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o022)
    if not (stat.S_ISDIR(status.st_mode) and ours):
        raise PermissionError(f"{path} is not a folder into which only this user can write")
    return path


def _find_cache_folder() -> str | None:
    """Create a private folder for compiled kernels below $FE_LIKELIHOODS_CACHE, $XDG_CACHE_HOME, ~/.cache or the
    temporary folder, the first in which that is possible; else None, with a warning: kernels are then compiled in every
    process.
    """
    user = f"fe_likelihoods-{os.getuid()}" if hasattr(os, "getuid") else "fe_likelihoods"
    shared = os.path.join(tempfile.gettempdir(), user)
    roots = [
        os.environ.get("FE_LIKELIHOODS_CACHE"),
        os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "fe_likelihoods"),
        shared,
    ]
    for root in filter(None, roots):
        try:
            if root == shared:  # its name is known to others, who can create it first
                _private_folder(root)
            os.makedirs(root, exist_ok=True)
            folder = _private_folder(os.path.join(root, f"kernels-{KERNEL_HASH}-numba{numba.__version__}"))
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    logger.warning(
        "Kernels are compiled in every process, which takes about a minute: none of %s can hold a private folder for "
        "them. Set the environment variable FE_LIKELIHOODS_CACHE to a folder of your own",
        ", ".join(root for root in roots if root),
    )
    return None


CACHE_FOLDER: str | None = _find_cache_folder()
"""Folder of the machine code; None if there is none."""


def _package(function: Callable) -> str:
    return (function.__module__ or "").rpartition(".")[0]


@cache
def _announce(package: str) -> None:
    """Log once per process that kernels of this library are compiled, because users wait meanwhile; not in workers.

    Workers are those of a pool of this library, and those that `multiprocessing` started, as dask does.
    """
    marked = any(name.startswith("FE_LIKELIHOODS_RUN_") for name in os.environ)
    if package == __package__ and not marked and multiprocessing.parent_process() is None:
        text = "Compiling the kernels, once: this takes a quarter of a minute or more. The machine code is kept in %s"
        logger.warning(text, CACHE_FOLDER)


_patience = [120.0]
"""Seconds that this process still waits for kernels of others; all of them take 12 s on a free core."""


def _lock(file: IO, function: Callable) -> None:
    """Lock a file; OSError where that is impossible, or where a process that has perhaps been stopped keeps it."""
    while True:
        try:
            return flock(file, LOCK_EX | LOCK_NB)
        except BlockingIOError:
            _announce(_package(function))
        if _patience[0] <= 0.0:
            raise TimeoutError(f"another process compiles {function.__name__}")
        time.sleep(0.05)
        _patience[0] -= 0.05


def _compile_in_one_process(kernel: numba.core.dispatcher.Dispatcher) -> None:
    """Let one process at a time look for the machine code of a kernel and compile it; others wait and load the result.

    Workers that start together would each compile everything. And numba numbers the files of the variants of a kernel
    without a lock: two processes that compile different variants at the same time would write both to the same file.
    """
    compile_or_load = kernel.compile
    name = f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}.lock"

    def compile_alone(signature):
        with global_compiler_lock, ExitStack() as held:  # the order is the same in every thread: none waits for itself
            with suppress(OSError):  # compiled without a lock
                file = held.enter_context(open(os.path.join(CACHE_FOLDER, name), "w"))
                _lock(file, kernel.py_func)
                held.callback(flock, file, LOCK_UN)  # explicitly: a process forked meanwhile shares the open file
            return compile_or_load(signature)

    kernel.compile = compile_alone


class _Locator(caching.UserProvidedCacheLocator):
    """Finds the machine code of a kernel by its package and the content of its file, whatever the path."""

    def __init__(self, function: Callable, file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        self._cache_path = os.path.join(CACHE_FOLDER, _package(function) or "kernels")

    def get_source_stamp(self) -> str:
        """Hash of the file: kernels outside this folder are not in the name of the cache folder."""
        return hashlib.blake2b(Path(self._py_file).read_bytes(), digest_size=8).hexdigest()

    @classmethod
    def from_function(cls, function: Callable, file: str) -> _Locator | None:
        """A locator; None, and numba's own error, for a function without a file."""
        return cls(function, file) if os.path.exists(file) else None


class _CacheImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]


class _Cache(caching.FunctionCache):
    _impl_class = _CacheImpl

    def load_overload(self, signature, context):
        """The machine code from the disk; None, with an announcement, if it must be compiled."""
        found = super().load_overload(signature, context)
        if found is None:
            _announce(_package(self._py_func))
        return found


class _InnerCode(JITCodeLibrary):
    """Code of a kernel for its callers: optimised and translated as a part of each, never alone."""

    codegen = SimpleNamespace(set_env=lambda name, environment: None)

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0  # nothing in it can be called from Python


class _InnerCompiler(Compiler):
    def __init__(self, types, target, library, *rest) -> None:
        super().__init__(types, target, _InnerCode(target.codegen(), "inner"), *rest)


def kernel(function: Callable | None = None, *, inline: bool = False, fastmath: set[str] | bool = False) -> Callable:
    """Compile a kernel: no Python objects, no GIL, IEEE division, no allocation; ``.py_func`` stays plain Python.

    Kernels are compiled without numba's reference counting: the caller provides every array, and an allocation is a
    compile error. Reference counting took 110 of the 180 ns of one evaluation of a section. Other kernels take a second
    version of it, without what a call from Python needs, the same for constants and variables: the column compiles in
    11 instead of 22 CPU s.

    `inline` merges the body into every caller: for functions in the inner loop that take arrays, because a call passes
    about eight scalars per array. Of `fastmath`, LLVM flags, this library uses `SUM_REORDERING` only. The machine code
    is kept on disk, compiled by one process at a time; that of inlined functions is not.
    """
    if function is None:
        return lambda f: kernel(f, inline=inline, fastmath=fastmath)
    options = {"nogil": True, "error_model": "numpy", "forceinline": inline, "fastmath": fastmath, "_nrt": False}
    options["no_cfunc_wrapper"] = True
    compiled = numba.njit(**options)(function)
    if compiled is function:  # numba is switched off
        return function
    inner = numba.njit(**options, no_cpython_wrapper=True, pipeline_class=_InnerCompiler)(function)
    compiled.get_overload = inner.get_overload
    compiled.get_call_template = lambda arguments, kws: inner.get_call_template([unliteral(a) for a in arguments], kws)
    if not inline and CACHE_FOLDER is not None:
        compiled._cache = _Cache(function)
        if flock is not None:
            _compile_in_one_process(compiled)
    return compiled
