"""Messages above a progress bar of a terminal: warnings, log messages and prints of a model do not break the bar.

A bar stays at the end of the line, so anything else that is written there is appended to it. While a bar is shown,
complete lines for the terminal are written above it instead.
"""

import contextlib
import logging
import sys
from collections.abc import Iterator
from typing import Any, TextIO

__all__ = ["messages_above"]

_LOGGERS = ("", "fe_likelihoods", "samplers")  # whose handlers are looked at; "" is the root logger


class _AboveBar:
    """A file that writes complete lines to a terminal above the bars that are shown there.

    Parameters
    ----------
    file : text file
        The terminal.
    bar_file : text file
        The file of the bars, which can be another one of the same terminal.
    """

    def __init__(self, file: TextIO, bar_file: TextIO):
        self._file, self._bar_file, self._begun = file, bar_file, ""

    def write(self, text: str) -> int:
        """Write the complete lines; the rest waits for its end."""
        from tqdm import tqdm

        lines, newline, self._begun = (self._begun + text).rpartition("\n")
        if newline:
            with tqdm.external_write_mode(file=self._bar_file):
                self._file.write(lines + newline)
                self._file.flush()
        return len(text)

    def finish(self) -> None:
        """Write a line that has no end."""
        if self._begun:
            self.write("\n")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _is_terminal(file: Any) -> bool:
    return hasattr(file, "isatty") and file.isatty()


@contextlib.contextmanager
def messages_above(bar: Any) -> Iterator[None]:
    """Write what is printed, warned and logged above a bar, if that is a bar in a terminal; else change nothing.

    Replaces ``sys.stdout`` and ``sys.stderr`` where they are terminals, and the streams of handlers of the root logger
    and of the loggers of the two packages that write there.

    Parameters
    ----------
    bar : tqdm bar, or emcee's silent one
        The bar, made before.
    """
    terminal = getattr(bar, "fp", None)
    if not _is_terminal(terminal) or hasattr(bar, "container"):  # a notebook has no terminal
        yield
        return
    files = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    above = {name: _AboveBar(file, terminal) for name, file in files.items() if _is_terminal(file)}
    handlers = [
        (handler, name)
        for logger in _LOGGERS
        for handler in logging.getLogger(logger).handlers
        for name in above
        if isinstance(handler, logging.StreamHandler) and handler.stream is files[name]
    ]
    for name, file in above.items():
        setattr(sys, name, file)
    for handler, name in handlers:
        handler.setStream(above[name])
    try:
        yield
    finally:
        # somebody else may have replaced them since
        for handler, name in handlers:
            if handler.stream is above[name]:
                handler.setStream(files[name])
        for name, file in above.items():
            file.finish()
            if getattr(sys, name) is file:
                setattr(sys, name, files[name])
