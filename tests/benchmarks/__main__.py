"""``python -m tests.benchmarks [names] [--repeats 3] [--out results/benchmarks.json]``."""

import argparse
from pathlib import Path

from . import bridge, cache, column, cost, engines, peers, samplers, startup
from .rows import as_table, machine, write_json

BENCHMARKS = {
    "simulation": column.simulation,
    "batch": column.batch,
    "bridge": bridge.simulation,
    "imports": startup.imports,
    "compilation": startup.compilation,
    "cost": cost.cost,
    "cache": cache.cache,
    "engines": engines.engines,
    "samplers": samplers.rows,
    "peers": peers.rows,
}


def main() -> None:
    """Run the benchmarks that were asked for, print their table and keep it."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(BENCHMARKS)}; all by default")
    parser.add_argument("--repeats", type=int, default=3, help="of which the median is taken (default 3)")
    parser.add_argument("--out", type=Path, default=Path("results") / "benchmarks.json")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(BENCHMARKS):
        parser.error(f"expected names out of {', '.join(BENCHMARKS)}; got {', '.join(unknown)}")
    if arguments.repeats < 1:
        parser.error(f"expected one repeat or more; got {arguments.repeats}")
    machines = [machine()]
    rows = [row for name in arguments.names or BENCHMARKS for row in BENCHMARKS[name](arguments.repeats)]
    machines.append(machine())
    print(f"{machines[0]['cpu']}, {machines[0]['cores']} cores; load average of the last minute", end=" ")
    print(" before and ".join(str(m["load_average"][:1]) for m in machines), "after")
    print(as_table(rows))
    write_json(arguments.out, rows, machines)
    print(f"kept in {arguments.out}")


if __name__ == "__main__":
    main()
