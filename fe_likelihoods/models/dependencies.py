"""Files and values that a model depends on and that no digest of its code can contain."""

from __future__ import annotations

import os
from collections.abc import Iterable
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ..simulation.files import file_digest
from ..simulation.label import value_digest

__all__ = ["Dependencies", "content_digest"]


class Dependencies:
    """The argument ``depends_on`` of a model of class `kind`; `paths` are its files and folders.

    A Path stands for the content of a file, or of all files in a folder; any other object for its value. Raises
    ValueError if a file does not exist, a text is the name of a file, or a value has no digest.
    """

    def __init__(self, things: Iterable[Any], kind: str) -> None:
        if isinstance(things, str | os.PathLike | dict) or not isinstance(things, Iterable):
            raise ValueError(f"{kind}: depends_on must be a list of Paths and values; got {things!r}")
        self._things = tuple(things)
        self._kind = kind
        for thing in self._things:
            if isinstance(thing, str) and os.path.exists(thing):
                raise ValueError(
                    f"{kind}: depends_on has the text {thing!r}, which is the name of a file; write Path({thing!r}) "
                    "for its content"
                )
            if isinstance(thing, Path) and not thing.exists():
                raise ValueError(f"{kind}: depends_on has {thing!r}, but there is no such file or folder")
        self.paths = tuple(thing.resolve() for thing in self._things if isinstance(thing, Path))
        self.texts()

    def texts(self) -> list[str]:
        """Digests of all contents and values, in order, as they are now."""
        texts, paths = [], iter(self.paths)
        for thing in self._things:
            if isinstance(thing, Path):
                texts.append(content_digest(next(paths)))
                continue
            try:
                texts.append(value_digest(thing))
            except ValueError as error:
                raise ValueError(
                    f"{self._kind}: no digest of {thing!r} in depends_on can be computed; give numbers, texts, arrays "
                    f"or Paths: {error}"
                ) from error
        return texts


def content_digest(path: Path) -> str:
    """Digest of a file, of all files in a folder with their names, or a text that says that it is missing."""
    try:
        if not path.is_dir():
            return file_digest(path)
        files = sorted(file for file in path.rglob("*") if file.is_file())
        parts = [f"{file.relative_to(path).as_posix()}\0{file_digest(file)}" for file in files]
        return blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()
    except OSError as error:
        return f"missing: {type(error).__name__}"
