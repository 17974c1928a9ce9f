"""Model defined by an external program: it reads input files that contain the parameters, and writes an output file.

Each run has a temporary folder. A program that hangs, crashes, writes too much or returns an unusable response is a
failed simulation, with a reason and the last lines of its standard error.
"""

from __future__ import annotations

import os
import re
import shutil
import string
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from ..simulation.failure_reasons import SimulationFailed, TransientReason, describe_exit, reason_of
from ..simulation.files import Group
from ..units import find_unit
from .user_model import UserModel, content_digest
from .validation import positive_float

_WATCH_INTERVAL = 0.1  # [s] between checks of the output size
_FREE_BYTES = 2**16  # less free space than this may be the reason of a failure
_EXIT_CODES_OF_SHELLS = {126, 127, *range(129, 160)}  # no program, or a program killed by signal 1 to 31


class ExecutableModel(UserModel):
    """External program as a model.

    ``$name`` or ``${name}`` in the templates and in the arguments of the command is replaced by the value of a
    parameter, with all its digits; ``$$`` is a dollar sign (`string.Template`). The program is started in the folder of
    the run, without a shell and standard input, with the environment variables of this process: name those that matter
    in `depends_on`. Afterwards all processes in its process group are killed (not daemons, containers and queued jobs).
    A run that writes more than 256 MiB is stopped. The label contains the program, and files that an argument names by
    an absolute path.

    Parameters
    ----------
    command : sequence of str
        Program and its arguments.
    templates : mapping of str to str or Path
        Input files: name in the run folder, and a text with placeholders, or the Path of a file that contains the text.
    output : str or callable
        Name of the file in the run folder that contains the response [SI]: one column per channel, separated by blanks
        or commas; text after # is ignored. Or a function that takes the folder (a Path) and returns the response
        (n_channels, n_steps).
    parameter_names, channels, dt, n_steps, path_dependent, depends_on
        As for `FunctionModel`.
    time_limit : float
        Longest duration of a run [s]; a longer run is stopped and counts as failed.
    columns : sequence of int, optional
        Columns of the output file that are the channels, counted from 0. By default the file has one column per channel
        and no others.
    output_units : mapping of str to str, optional
        Units of channels in the output file, by name of the channel. Default: SI units.
    record : Record, optional
        Excitation. Its samples [m/s²] are written into the file `record_file` in the run folder, one per line, and
        ``$record_dt`` [s] and ``$record_n_steps`` may stand in templates and arguments.
    record_file : str
        Name of the file with the base motion in the run folder.
    files : mapping of str to Path, optional
        Further files, copied into the run folder under the given names.
    version : str, optional
        Text in the fingerprint, for changes that the files do not show; it replaces the code of an `output` function.

    Raises
    ------
    ValueError
        If the program or a file does not exist, a placeholder is not a parameter, a parameter has no placeholder, a
        limit is not positive, or another argument is wrong.

    Examples
    --------
    A program that reads ``case.txt`` and writes one line per sample into ``top.txt``:

    >>> import sys
    >>> code = "k = float(open('case.txt').read()); print(0.1 / k, file=open('top.txt', 'w'))"
    >>> program = ExecutableModel(
    ...     [sys.executable, "-c", code], {"case.txt": "$stiffness"}, "top.txt", ["stiffness"],
    ...     [Channel("top", "displacement", "mm")], dt=0.01, n_steps=1, time_limit=60.0,
    ... )
    >>> program.simulate([2.0])
    array([[0.05]])
    """

    max_output = 2**28  # [bytes] that a run may write

    def __init__(
        self,
        command: Sequence[str | Path],
        templates: Mapping[str, str | Path],
        output: str | Callable[[Path], Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float | None = None,
        n_steps: int | None = None,
        *,
        time_limit: float,
        record: Record | None = None,
        record_file: str = "record.txt",
        path_dependent: bool = True,
        columns: Sequence[int] | None = None,
        output_units: Mapping[str, str] | None = None,
        files: Mapping[str, Path] | None = None,
        version: str | None = None,
        depends_on: Sequence[Any] = (),
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps, depends_on, record, path_dependent)
        self.time_limit = positive_float(time_limit, "ExecutableModel: time_limit", "seconds")
        if isinstance(command, str | Path) or not command:
            raise ValueError(
                f"ExecutableModel: command must be a list with the program and its arguments; got {command!r}"
            )
        self.command = (_executable(str(command[0])), *map(str, command[1:]))
        self.templates = {_inside(name): _text(name, source) for name, source in templates.items()}
        self.files = {_inside(name): _file(source).resolve() for name, source in (files or {}).items()}
        self.record_file = _inside(record_file)
        names = [*self.templates, *self.files, *([] if record is None else [self.record_file])]
        if repeated := {name for name in names if names.count(name) > 1}:
            raise ValueError(
                f"ExecutableModel: {', '.join(repeated)} is more than one of a template, a file and the record file; "
                "rename one of them"
            )
        self._check_placeholders()
        if not callable(output) and not isinstance(output, str):
            raise ValueError(f"ExecutableModel: output must be a file name or a function of a folder; got {output!r}")
        self.output = output if callable(output) else _inside(output)
        self.columns = tuple(range(len(self.channels))) if columns is None else tuple(int(c) for c in columns)
        self._no_other_columns = columns is None
        if len(self.columns) != len(self.channels) or min(self.columns) < 0:
            raise ValueError(
                f"ExecutableModel: expected one column, 0 or more, for each of the {len(self.channels)} channels; "
                f"got {columns}"
            )
        self.output_units = dict(output_units or {})
        self._factors = self._check_units()
        self.version = version
        given = {*self.templates, *self.files, self.record_file}
        self._elsewhere = [part for part in self.command[1:] if os.path.isfile(part) and part not in given]
        self._named = tuple(_named_files(self.command))
        self._prepare()

    def _files(self) -> tuple[Path, ...]:
        return *self._named, *map(Path, self.files.values()), *self._dependencies.paths

    def _prepare(self) -> None:
        output = "function" if callable(self.output) else self.output
        stated = [] if self.record is None else [["record", self.record_file, self.record.fingerprint]]
        if self.output_units:
            stated.append(["output units", sorted(self.output_units.items())])
        self.fingerprint = self._digest(output, self.columns, self.version, *stated)

    def _check_units(self) -> np.ndarray:
        """SI values of the units in the output file, shape (n_channels, 1)."""
        if callable(self.output) and self.output_units:
            raise ValueError("ExecutableModel: output_units belong to a file; let the function return SI units")
        names = [channel.name for channel in self.channels]
        if unknown := [name for name in self.output_units if name not in names]:
            raise ValueError(
                f"ExecutableModel: output_units names {', '.join(unknown)}; the channels are {', '.join(names)}"
            )
        units = [self.output_units.get(channel.name, channel.si_unit) for channel in self.channels]
        return np.array([[find_unit(u, c.dimension).factor] for u, c in zip(units, self.channels, strict=True)])

    def code_parts(self) -> dict[str, Any]:
        """Program, input files and user code as they are now, for the label of stored simulations."""
        contents = {f"file {path.name}": content_digest(path) for path in self._named}
        copied = {f"copied {name}": content_digest(path) for name, path in self.files.items()}
        templates = {f"template {name}": text for name, text in self.templates.items()}
        return {"command": " ".join(self.command), "output": self.output, **templates, **contents, **copied}

    def _check_placeholders(self) -> None:
        """Raise ValueError unless every placeholder is a parameter and every parameter has a placeholder."""
        sources = {f"template {name}": text for name, text in self.templates.items()}
        sources |= {f"argument {part!r} of the command": part for part in self.command[1:]}
        used: set[str] = set()
        for where, text in sources.items():
            template = string.Template(text)
            if not template.is_valid():
                raise ValueError(
                    f"ExecutableModel: a dollar sign in {where} starts no placeholder; write $$ for a dollar sign"
                )
            names = set(template.get_identifiers())
            names -= set(self._record_values)
            if unknown := sorted(names - set(self.parameter_names)):
                raise ValueError(
                    f"ExecutableModel: {where} has placeholders for {', '.join(unknown)}; the parameters are "
                    f"{', '.join(self.parameter_names)}"
                )
            used |= names
        if unused := [name for name in self.parameter_names if name not in used]:
            raise ValueError(
                f"ExecutableModel: no template and no argument has a placeholder for {', '.join(unused)}, so it would "
                f"have no effect; write ${{{unused[0]}}} where its value belongs"
            )

    @property
    def _record_values(self) -> dict[str, str]:
        """Placeholders of the record; a parameter of the same name takes precedence."""
        if self.record is None:
            return {}
        values = {"record_dt": repr(self.record.dt), "record_n_steps": str(self.record.n_steps)}
        return {name: value for name, value in values.items() if name not in self.parameter_names}

    def _respond(self, theta: np.ndarray) -> Any:
        values = {name: repr(float(value)) for name, value in zip(self.parameter_names, theta, strict=True)}
        values |= self._record_values
        group = Group()
        place = Path(group.place)
        folder = place / "run"
        try:
            folder.mkdir()
            self._write(folder, values)
            self._execute(group, [string.Template(part).substitute(values) for part in self.command[1:]])
            return self._check_response(self._read(folder))
        except Exception as error:
            reason = reason_of(error)
            if not isinstance(reason, TransientReason) and shutil.disk_usage(place).free < _FREE_BYTES:
                text = f"{reason} (the disk of the temporary folder {place.parent} is full)"
                raise SimulationFailed(TransientReason(text)) from error
            raise
        finally:
            group.end()

    def _write(self, folder: Path, values: dict[str, str]) -> None:
        """Write the input files into the folder of the run."""
        texts = {name: string.Template(text).substitute(values) for name, text in self.templates.items()}
        if self.record is not None:
            texts[self.record_file] = "".join(f"{value!r}\n" for value in self.record.acceleration.tolist())
        for name in (*texts, *self.files):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text)
        for name, source in self.files.items():
            shutil.copyfile(source, folder / name)

    def _execute(self, group: Group, arguments: list[str]) -> None:
        """Run the program in the folder ``run`` of the group's; raise SimulationFailed unless it succeeds."""
        place = Path(group.place)

        def watch(seconds: float) -> float:
            text = f"stopped at the time limit of {self.time_limit:g} s" if seconds > self.time_limit else ""
            if not text and _size(place) > self.max_output:
                text = f"stopped because it wrote more than {self.max_output} bytes"
            if text:
                raise SimulationFailed(TransientReason(text))
            return min(_WATCH_INTERVAL, self.time_limit - seconds + 1e-3)

        outputs = place / "stdout.txt", place / "stderr.txt"
        with open(outputs[0], "wb") as stdout, open(outputs[1], "wb") as stderr:
            command = [self.command[0], *arguments]
            exit_code = group.run(command, watch, cwd=place / "run", stdout=stdout, stderr=stderr)
        if exit_code:
            with open(outputs[1], "rb") as stderr:
                reason = ": ".join(filter(None, [describe_exit(exit_code, "the program"), _last_lines(stderr, 3)]))
            reason += self._missing(place / "run")
            killed = exit_code < 0 or exit_code in _EXIT_CODES_OF_SHELLS
            raise SimulationFailed(TransientReason(reason) if killed else reason)
        if _size(place) > self.max_output:
            raise SimulationFailed(TransientReason(f"the program wrote more than {self.max_output} bytes"))

    def _missing(self, folder: Path) -> str:
        """What a failed program may have looked for in the folder of the run, where it is not."""
        lost = [part for part in self._elsewhere if not (folder / part).exists()]
        if not lost:
            return ""
        return (
            f"; the program ran in {folder}, where there is no {', '.join(lost)}: give the absolute path in the "
            'command, or copy the file into this folder with files={"name": Path(...)}'
        )

    def _read(self, folder: Path) -> Any:
        """Read the response from the folder of the run."""
        if callable(self.output):
            return self.output(folder)
        table = read_table(folder, self.output)
        if table.shape[1] <= max(self.columns) or (self._no_other_columns and table.shape[1] != len(self.columns)):
            listed = f"columns {', '.join(map(str, self.columns))}, counted from 0"
            wanted = f"{len(self.columns)} columns" if self._no_other_columns else listed
            raise SimulationFailed(f"{self.output} has {table.shape[1]} columns, expected {wanted}")
        return self._factors * table[:, self.columns].T


def _last_lines(file: Any, most: int) -> str:
    """The last non-empty lines of an open file, at most `most` lines and 300 characters."""
    size = os.fstat(file.fileno()).st_size
    data = os.pread(file.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")
    lines = [line.strip() for line in data.splitlines() if line.strip()]
    return " / ".join(lines[-most:])[-300:]


def read_table(folder: Path, name: str) -> np.ndarray:
    """Numbers (n_lines, n_columns) in a file that a program has written; `SimulationFailed` if there are none."""
    if not (folder / name).is_file():
        raise SimulationFailed(f"the program succeeded but wrote no file {name}")
    text = (folder / name).read_text().replace(",", " ").splitlines()
    if not any(line.partition("#")[0].strip() for line in text):
        raise SimulationFailed(f"{name} is empty")
    try:
        return np.loadtxt(text, ndmin=2)
    except ValueError as error:
        raise SimulationFailed(f"{name} is not a table of numbers: {error}") from error


def _executable(name: str) -> str:
    """Absolute path of a program, so that it can be started in another folder."""
    found = shutil.which(name)
    if found is None:
        raise ValueError(
            f"ExecutableModel: expected an executable program, as a path or in the folders of PATH; got {name!r}"
        )
    return os.path.abspath(found)


def _inside(name: str) -> str:
    """Normalised name of a file; raise ValueError if it is not inside the folder of the run."""
    path = Path(name)
    if not name or path.is_absolute() or ".." in path.parts:
        raise ValueError(f"ExecutableModel: expected the name of a file inside the folder of the run; got {name!r}")
    return path.as_posix()


def _file(path: Path) -> Path:
    if not isinstance(path, Path) or not path.is_file():
        raise ValueError(f"ExecutableModel: expected the Path of an existing file; got {path!r}")
    return path


def _text(name: str, source: str | Path) -> str:
    if isinstance(source, str):
        return source
    try:
        return _file(source).read_text()
    except UnicodeDecodeError as error:
        raise ValueError(f"ExecutableModel: the template of {name} is not a text file: {error}") from error


def _named_files(command: Sequence[str]) -> list[Path]:
    """Files that the parts of a command name by an absolute path, also after an option as in ``--script=/path``."""
    found = []
    for part in command:
        for start in [match.start() for match in re.finditer("/", part)]:
            # a path starts the part, or follows an option or a separator
            if start == 0 or part[start - 1] in "=,:;@" or re.fullmatch("-[A-Za-z]", part[:start]):
                places = [part[start:], *re.split("[,:;]", part[start:])[:1]]
                found += [Path(place) for place in places if os.path.isfile(place)][:1]
    return found


def _size(folder: Path) -> int:
    """Size of the files in a folder [bytes]; files that are removed in the meantime do not count."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            total += path.lstat().st_size
    return total
