"""A model that is a program: input files with the parameters in them, a run, an output file.

Each run has a temporary folder of its own. A program that hangs, crashes, floods its disk or answers nonsense is a
failed simulation with its reason and the last words of its standard error; the folder can be kept to look at.
"""

import os
import shutil
import string
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.code_digest import code_digest
from ..simulation.model import SimulationFailed
from ..simulation.processes import RunFailed, Started, TemporaryFolder, ending, last_lines
from .external import CheckedModel, positive

__all__ = ["ExecutableModel"]


class ExecutableModel(CheckedModel):
    """An external program as a model.

    ``$name`` or ``${name}`` in the templates and in the command's arguments is the value of a parameter, with all its
    digits; ``$$`` is a dollar sign (`string.Template`). The program is started in its folder, without a shell and
    without standard input. When it has ended, or is stopped, its process group is killed; when it is stopped, so is
    (on Linux) whatever else carries its environment, such as programs that went into the background.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments.
    templates : mapping of str to str or Path
        Name in the run's folder, and the text with placeholders, or the file (a Path) that holds it.
    output : str, or callable of a Path
        Name of the file in the run's folder that holds the response: a column for each channel, by blanks or commas,
        in SI, lines with # skipped. Or a function of the folder that returns the response (n_channels, n_steps).
    parameter_names, channels, dt, n_steps : as in `CheckedModel`
    time_limit : float
        A run that takes longer [s] is stopped and has failed.
    columns : sequence of int, optional
        The columns of the output file that are the channels, from 0; by default it has no others.
    files : mapping of str to Path, optional
        Further files for the run's folder, copied as they are.
    keep_failures : path, optional
        Folder into which the folders of failed runs are moved, each with a file ``reason.txt``.
    max_kept : int
        The most folders that are kept there.
    max_output : int
        The most that a run may write into its folder and to standard output and error [bytes].
    hash_executable : bool
        Whether the content of the program enters the fingerprint, and that of files named by an absolute path among
        the arguments. Large installations are told apart better by `version`.
    version : str, optional
        Enters the fingerprint; takes the place of the code where `output` is a function.

    Raises
    ------
    ValueError
        If the program or a file does not exist, a placeholder is no parameter, a parameter has no placeholder, a limit
        is not positive, or what `CheckedModel` refuses.

    Examples
    --------
    >>> model = ExecutableModel(
    ...     ["frame3d", "column.inp"], {"column.inp": Path("column.template")}, "top.out", ("stiffness",),
    ...     (Channel("top", "relative displacement", "mm"),), 0.01, 2000, time_limit=60.0,
    ... )
    """

    def __init__(
        self,
        command: Sequence[str | Path],
        templates: Mapping[str, str | Path],
        output: str | Callable[[Path], Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int,
        *,
        time_limit: float,
        columns: Sequence[int] | None = None,
        files: Mapping[str, Path] | None = None,
        keep_failures: str | Path | None = None,
        max_kept: int = 20,
        max_output: int = 2**28,
        hash_executable: bool = True,
        version: str | None = None,
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps)
        self.time_limit = positive(time_limit, "ExecutableModel: time_limit", "seconds")
        self.max_output = int(positive(max_output, "ExecutableModel: max_output", "bytes"))
        self.max_kept = int(positive(max_kept, "ExecutableModel: max_kept", "folders"))
        if isinstance(command, str | Path) or not command:
            raise ValueError(
                f"ExecutableModel: command must be a list of the program and its arguments; got {command!r}"
            )
        self.command = (_executable(str(command[0])), *map(str, command[1:]))
        self.templates = {_inside(name): _text(name, source) for name, source in templates.items()}
        self.files = {_inside(name): _file(source).resolve() for name, source in (files or {}).items()}
        if repeated := set(self.templates) & set(self.files):
            raise ValueError(f"ExecutableModel: {', '.join(repeated)} is both a template and a file")
        self._check_placeholders()
        if not callable(output) and not isinstance(output, str):
            raise ValueError(f"ExecutableModel: output must be a file name or a function of a folder; got {output!r}")
        self.output = output if callable(output) else _inside(output)
        self.columns = tuple(range(len(self.channels))) if columns is None else tuple(int(c) for c in columns)
        self._exactly = columns is None
        if len(self.columns) != len(self.channels) or min(self.columns) < 0:
            raise ValueError(
                f"ExecutableModel: expected a column, 0 or more, for each of the {len(self.channels)} channels; "
                f"got {columns}"
            )
        self.keep_failures = None if keep_failures is None else Path(keep_failures).resolve()
        self.fingerprint = self._fingerprint(hash_executable, version)

    def _fingerprint(self, hash_executable: bool, version: str | None) -> str:
        named = [Path(part) for part in self.command if Path(part).is_absolute() and Path(part).is_file()]
        contents = [_hash(path) for path in named] if hash_executable else []
        copied = {name: _hash(path) for name, path in sorted(self.files.items())}
        parse: Any = [self.output, self.columns]
        if callable(self.output):
            try:
                parse = version if version is not None else code_digest(self.output)
            except ValueError as error:
                raise ValueError(
                    f"ExecutableModel: the fingerprint needs version= here, a text to be changed with the function "
                    f"output: {error}"
                ) from error
        return self._digest(self.command, contents, sorted(self.templates.items()), copied, parse, version)

    def _check_placeholders(self) -> None:
        sources = {f"template {name}": text for name, text in self.templates.items()}
        sources |= {f"argument {part!r} of the command": part for part in self.command[1:]}
        used: set[str] = set()
        for where, text in sources.items():
            template = string.Template(text)
            if not template.is_valid():
                raise ValueError(
                    f"ExecutableModel: a dollar sign in {where} begins no placeholder; write $$ for a dollar sign"
                )
            names = set(template.get_identifiers())
            if unknown := sorted(names - set(self.parameter_names)):
                raise ValueError(
                    f"ExecutableModel: {where} asks for {', '.join(unknown)}; the parameters are "
                    f"{', '.join(self.parameter_names)}"
                )
            used |= names
        if unused := [name for name in self.parameter_names if name not in used]:
            raise ValueError(
                f"ExecutableModel: no template and no argument has a placeholder for {', '.join(unused)}, so it would "
                f"change nothing; write ${{{unused[0]}}} where its value belongs"
            )

    def _respond(self, theta: np.ndarray) -> Any:
        values = {name: repr(float(value)) for name, value in zip(self.parameter_names, theta, strict=True)}
        with TemporaryFolder() as place:
            folder = place / "run"
            folder.mkdir()
            start = time.monotonic()
            try:
                self._write(folder, values)
                self._execute(place, [string.Template(part).substitute(values) for part in self.command[1:]])
                return self._checked(self._read(folder))
            except Exception as error:
                self._keep(place, values, error, time.monotonic() - start)
                raise

    def _write(self, folder: Path, values: dict[str, str]) -> None:
        for name, text in self.templates.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(string.Template(text).substitute(values))
        for name, source in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, path)

    def _execute(self, place: Path, arguments: list[str]) -> None:
        """Run the program in the folder ``run`` of `place`; RunFailed unless it ends well."""
        start = time.monotonic()
        with open(place / "stdout.txt", "wb") as stdout, open(place / "stderr.txt", "w+b") as stderr:
            program = Started(
                [self.command[0], *arguments],
                cwd=place / "run",
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
            )
            try:
                looked = start
                while not program.ended():
                    now = time.monotonic()
                    if now - start > self.time_limit:
                        raise RunFailed(f"stopped at the time limit of {self.time_limit:g} s", now - start)
                    if now - looked > 0.1:
                        looked = now
                        if _size(place) > self.max_output:
                            raise RunFailed(f"stopped because it wrote more than {self.max_output} bytes", now - start)
                    time.sleep(min(0.02, 0.001 + 0.05 * (now - start)))
            except BaseException:
                program.kill()
                raise
            exit_code = program.kill(everywhere=False)
            if exit_code:
                words = filter(None, [ending(exit_code, "the program"), last_lines(stderr, 3)])
                raise RunFailed(": ".join(words), time.monotonic() - start)
            if _size(place) > self.max_output:
                raise RunFailed(f"the program wrote more than {self.max_output} bytes", time.monotonic() - start)

    def _read(self, folder: Path) -> Any:
        if callable(self.output):
            return self.output(folder)
        path = folder / self.output
        if not path.is_file():
            raise SimulationFailed(f"the program ended well and left no file {self.output}")
        text = path.read_text().replace(",", " ").splitlines()
        if not any(line.partition("#")[0].strip() for line in text):
            raise SimulationFailed(f"{self.output} is empty")
        try:
            table = np.loadtxt(text, ndmin=2)
        except ValueError as error:
            raise SimulationFailed(f"{self.output} is no table of numbers: {error}") from error
        if table.shape[1] <= max(self.columns) or (self._exactly and table.shape[1] != len(self.columns)):
            wanted = f"{len(self.columns)} columns" if self._exactly else f"columns {', '.join(map(str, self.columns))}"
            raise SimulationFailed(f"{self.output} has {table.shape[1]} columns, expected {wanted}")
        return table[:, self.columns].T

    def _keep(self, place: Path, values: dict[str, str], error: Exception, seconds: float) -> None:
        if self.keep_failures is None:
            return
        with suppress(OSError):  # a full disk must not hide the failure itself
            self.keep_failures.mkdir(parents=True, exist_ok=True)
            if len(list(self.keep_failures.glob("failure_*"))) >= self.max_kept:
                return
            told = f"{getattr(error, 'reason', None) or error}\nafter {seconds:.3g} s\n"
            (place / "reason.txt").write_text(told + "".join(f"{name} = {value}\n" for name, value in values.items()))
            kept = tempfile.mkdtemp(prefix="failure_", dir=self.keep_failures)
            for path in place.iterdir():
                shutil.move(path, kept)


def _executable(name: str) -> str:
    """Absolute path of a program: it must not depend on the folder in which it is started."""
    found = shutil.which(name)
    if found is None:
        raise ValueError(
            f"ExecutableModel: there is no program {name!r} that can be executed, neither as a path nor in the folders "
            "of PATH"
        )
    return os.path.abspath(found)


def _inside(name: str) -> str:
    path = Path(name)
    if not name or path.is_absolute() or ".." in path.parts:
        raise ValueError(f"ExecutableModel: expected the name of a file inside the run's folder; got {name!r}")
    return path.as_posix()


def _file(path: Path) -> Path:
    if not isinstance(path, Path) or not path.is_file():
        raise ValueError(f"ExecutableModel: expected the Path of a file that exists; got {path!r}")
    return path


def _text(name: str, source: str | Path) -> str:
    if isinstance(source, str):
        return source
    try:
        return _file(source).read_text()
    except UnicodeDecodeError as error:
        raise ValueError(f"ExecutableModel: the template of {name} is no text: {error}") from error


def _hash(path: Path) -> str:
    with open(path, "rb") as file:
        digest = blake2b(digest_size=16)
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def _size(folder: Path) -> int:
    """Bytes in a folder; what vanishes meanwhile does not count."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            total += path.lstat().st_size
    return total
