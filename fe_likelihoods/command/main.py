"""Commands of the console script ``fe-likelihoods``.

The modules that do the work are imported inside the commands, so that ``--help`` answers at once.

Exit codes: 0 when a command has done its work, 1 for an error in the file, the data or the options, 3 when a run has
ended and its judgement is "do not use", 130 after Ctrl-C.
"""

import shlex
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import click

ERROR, NOT_USABLE, INTERRUPTED = 1, 3, 130
_FILE = click.Path(path_type=Path)
_DATA = ("synthetic_record.csv", "synthetic_measured.csv")
TEMPLATES = {
    "column": ("column.toml", "bridge_column_short.h5"),
    "function": ("function.toml", "my_function.py", *_DATA),
    "opensees": ("opensees.toml", "my_opensees.py", *_DATA),
    "modal": ("modal.toml", "synthetic_modes.csv"),
    "load-test": ("load-test.toml", "my_girder.py", "synthetic_load_test.csv"),
    "executable": ("executable.toml", "my_program.py", "my_input.txt", "synthetic_logger.csv"),
}
"""Files of each kind, in the folder ``templates`` of the bundled data."""


class _Commands(click.Group):
    """A group whose errors are one message without a traceback, unless ``--debug`` is given, and warnings sentences."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        click.UsageError.exit_code = ERROR
        return super().main(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        usual, warnings.formatwarning = warnings.formatwarning, lambda message, *place: f"Warning: {message}\n"
        try:
            return super().invoke(ctx)
        except (KeyboardInterrupt, SystemExit) as error:  # exit code 0 of the user's code would say that all is done
            stopped = isinstance(error, KeyboardInterrupt)
            message = ctx.obj.get("interrupted", "Interrupted: nothing was changed.")
            code = "" if stopped else f"Error: sys.exit({error.code!r}) in the user's code has ended the command. "
            click.echo(f"\n{message}" if stopped else code + message, err=True)
            ctx.exit(INTERRUPTED if stopped else ERROR)
        except (ValueError, OSError, RuntimeError, ImportError) as error:
            if ctx.params["debug"] or isinstance(error, RuntimeError) and type(error).__module__.startswith("click"):
                raise
            click.echo(f"Error: {error}", err=True)
            ctx.exit(ERROR)
        finally:
            warnings.formatwarning = usual


@click.group(cls=_Commands, context_settings={"show_default": True, "help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.version_option(package_name="fe-likelihoods")
@click.pass_context
def main(ctx: click.Context, debug: bool) -> None:
    """Update a structural model with measurements: one TOML file, one command, one report.

    \b
    fe-likelihoods new column my-column       a commented TOML file to start from
    fe-likelihoods check my-column/column.toml
    fe-likelihoods run my-column/column.toml

    Exit codes: 0 done; 1 error in file, data or options; 3 the run has ended and its result is not usable; 130 Ctrl-C.
    """
    ctx.obj = {}


@main.command()
@click.argument("file", type=_FILE)
@click.option("--out", type=_FILE, help="Folder of the run.", show_default="results-NAME for NAME.toml")
@click.option("--quiet", is_flag=True, help="Show no progress bars.")
@click.pass_context
def run(ctx: click.Context, file: Path, out: Path | None, quiet: bool) -> None:
    """Sample the posterior that FILE (TOML) describes; write report, tables and samples to a folder.

    The same command continues a run that was killed. A folder with a run of other settings is refused; [budget] and
    [prediction] may change.
    """
    from .runs import default_folder, run_job

    folder = out or default_folder(file)
    again = shlex.join(["fe-likelihoods", "run", str(file), *([] if out is None else ["--out", str(out)])])
    ctx.obj["interrupted"] = f"Interrupted. What was computed is kept in {folder}/; go on with: {again}"
    outcome = run_job(file, out, progress=not quiet)
    _show(outcome)
    ctx.exit(0 if outcome.usable else NOT_USABLE)


def _show(outcome: Any) -> None:
    click.echo((outcome.folder / "summary.txt").read_text(encoding="utf-8").rstrip())
    click.echo(f"Written to {outcome.folder}/: report.html, summary.txt, summary.csv, stages.csv, posterior.nc")


@main.command()
@click.argument("file", type=_FILE)
def check(file: Path) -> None:
    """Read FILE and its data, test with about 100 simulations, and say what was found.

    It tries whether the model is repeatable and follows its motion, and whether units, signs, clocks and channels are
    right. The picture check-NAME.png compares the measurements with simulations at draws of the prior: the
    measurements should lie within their band.
    """
    from .checking import check_job

    check_job(file, Path(f"check-{file.stem}.png"), click.echo)


@main.command()
@click.argument("run", type=_FILE, metavar="RUN")
@click.option("--run-code", is_flag=True, help="Run the Python file or program that the settings name as model.")
def report(run: Path, run_code: bool) -> None:
    """Make report and tables of RUN again, a folder that `run` made or a file in it, without new samples.

    Nothing that the settings in RUN name is run unless --run-code is given, so that the folder may come from anybody.
    """
    from .runs import report_run

    _show(report_run(run, run_code))


def write_templates(kind: str, folder: Path) -> tuple[str, ...]:
    """Copy the templates of a kind, a key of `TEMPLATES`, to a folder, which is created; names of the files."""
    names, source = TEMPLATES[kind], resources.files("fe_likelihoods.data") / "templates"
    if there := [name for name in names if (folder / name).exists()]:
        raise ValueError(f"{folder} already contains {', '.join(there)}; give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes((source / name).read_bytes())
    return names


@main.command()
@click.argument("kind", type=click.Choice(list(TEMPLATES)))
@click.argument("folder", type=_FILE)
def new(kind: str, folder: Path) -> None:
    """Write a commented TOML file of KIND to FOLDER to start from; it runs as it is, with synthetic data."""
    click.echo(f"Written to {folder}/: {', '.join(write_templates(kind, folder))}. The data are SYNTHETIC.")
    click.echo(f"Next: fe-likelihoods check {shlex.quote(f'{folder / kind}.toml')}")


@main.command()
@click.argument("files", type=_FILE, nargs=-1, required=True)
def data(files: tuple[Path, ...]) -> None:
    """List what data FILES hold (columns, channels, units, steps, gaps), and the lines of a TOML file that read them.

    A file is a table of a logger, a ground motion, a zip archive of V2 files, a data set, or a MATLAB file.
    """
    from .describe_files import describe_data

    for file in files:
        click.echo(f"{describe_data(file)}\n")
