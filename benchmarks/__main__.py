"""Run benchmarks, print a table of each and store all rows.

``python -m benchmarks [NAME ...] [OPTION=VALUE ...]``; the options of a benchmark are the keyword arguments of its
function, several values are separated by commas. README.md lists what each measures, how long it takes and what it
needs.
"""

import argparse
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from . import (
    badge,
    bridge,
    column,
    cost,
    executors,
    few_simulations,
    new_events,
    report,
    samplers,
    screening,
    startup,
    truth,
)
from .rows import as_table, machine, write_json

BENCHMARKS: dict[str, Callable[..., Iterable[tuple]]] = {
    "badge": badge.badge,
    "new_events": new_events.new_events,
    "simulation": column.simulation,
    "batch": column.batch,
    "bridge": bridge.simulation,
    "imports": startup.imports,
    "compilation": startup.compilation,
    "report": report.report,
    "executors": executors.executors,
    "cost": cost.cost,
    "truth": truth.truth,
    "samplers": samplers.rows,
    "screening": screening.screening,
    "few_simulations": few_simulations.few_simulations,
}
QUICK: dict[str, dict[str, Any]] = {
    "badge": {"structures": ("Meloland",)},
    "new_events": {"structures": ("frame two floors",), "sizes": (1,), "subsets": 1},
    "truth": {"families": ("sharp", "two"), "ratios": (1.0,), "walkers": (200,)},
    "samplers": {"targets": ("T3",)},
    "screening": {"every": 40},
    "few_simulations": {"problems": ("few_samples", "oscillator"), "budgets": (200,)},
}
"""Options of the shortest run of each benchmark, which only shows that it runs."""


def converted(text: str, default: Any) -> Any:
    """A value of the type of a default; the values of a tuple are separated by commas."""
    if isinstance(default, tuple):
        return tuple(converted(part, default[0]) for part in text.split(","))
    return type(default)(text)


def options_of(function: Callable) -> dict[str, Any]:
    """The options of a benchmark and their defaults."""
    parameters = inspect.signature(function).parameters
    return {name: each.default for name, each in parameters.items() if name != "repeats"}


def parsed(words: list[str]) -> tuple[list[str], dict[str, dict[str, Any]]]:
    """Names of the benchmarks (all of them if none is given), and the given options of each.

    Raises
    ------
    ValueError
        If a benchmark or an option does not exist, or a value has another type.
    """
    names = [word for word in words if "=" not in word] or list(BENCHMARKS)
    if unknown := set(names) - set(BENCHMARKS):
        raise ValueError(f"expected names among {', '.join(BENCHMARKS)}; got {', '.join(sorted(unknown))}")
    given = dict(word.split("=", 1) for word in words if "=" in word)
    found = {}
    for name in names:
        known = options_of(BENCHMARKS[name])
        found[name] = {key: converted(text, known[key]) for key, text in given.items() if key in known}
    if unknown := set(given) - {key for options in found.values() for key in options}:
        some = "; ".join(f"{name}: {', '.join(options_of(BENCHMARKS[name])) or 'none'}" for name in names)
        raise ValueError(f"no such option: {', '.join(sorted(unknown))}. Options of {some}")
    return names, found


def main(arguments: list[str] | None = None) -> None:
    """Run the selected benchmarks, print their tables and store the rows."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, formatter_class=form)
    parser.add_argument("words", nargs="*", metavar="NAME or OPTION=VALUE", help=f"some of {', '.join(BENCHMARKS)}")
    parser.add_argument("--repeats", type=int, default=3, help="repeats or seeds (default 3)")
    parser.add_argument("--quick", action="store_true", help="one repeat of the shortest setting: does it run?")
    parser.add_argument("--out", type=Path, default=Path("results") / "benchmarks.json", help="file for the rows")
    given = parser.parse_intermixed_args(arguments)
    try:
        names, options = parsed(given.words)
    except ValueError as error:
        parser.error(str(error))
    if given.repeats < 1:
        parser.error(f"expected at least one repeat; got {given.repeats}")
    before, stored = machine(), []
    print(f"{before['cpu']}, {before['cores']} cores, load average {before['load_average'][:1]}")
    for name in names:
        print(f"\n{name}", flush=True)
        chosen = QUICK.get(name, {}) | options[name] if given.quick else options[name]
        rows = []
        for row in BENCHMARKS[name](1 if given.quick else given.repeats, **chosen):
            rows.append(row)
            write_json(given.out, [*stored, *rows], [before, machine()])  # hours are not lost with the last one
        stored += rows
        if rows:
            print(as_table(rows), flush=True)
    print(f"\nstored in {given.out}")


if __name__ == "__main__":
    main()
