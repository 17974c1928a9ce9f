"""``python -m benchmarks [names] [--repeats 3] [--out FILE]``, or ``--compare BEFORE AFTER``: see --help.

``python -m benchmarks truth`` has options of its own (`benchmarks.truth`).
"""

import argparse
import sys
from functools import partial
from pathlib import Path

from . import (
    bridge,
    bridge_steps,
    busy_workers,
    cache,
    carried_state,
    column,
    cost,
    decisions,
    executors,
    expected,
    few_hundred_peers,
    growth,
    hierarchy,
    hierarchy_cases,
    hierarchy_warnings,
    job,
    measured_columns,
    measured_peaks,
    measured_tests,
    new_event,
    noises,
    opensees_memory,
    overhead,
    peers,
    samplers,
    sequential,
    starts,
    startup,
    storage,
    strain_penetration,
    transfer,
    transfer_twins,
    truth,
)
from .comparison import compare
from .rows import as_table, machine, write_json

BENCHMARKS = {
    "simulation": column.simulation,
    "batch": column.batch,
    "sensors": column.sensors,
    "bridge": bridge.simulation,
    "bridge_steps": bridge_steps.steps,
    "imports": startup.imports,
    "compilation": startup.compilation,
    "cost": cost.cost,
    "growth": growth.growth,
    "hierarchy": hierarchy.hierarchy,
    "hierarchy_ranks": hierarchy.ranks,
    "hierarchy_cases": hierarchy_cases.cases,
    "busy_workers": busy_workers.busy_workers,
    "hierarchy_warnings": hierarchy_warnings.alarms,
    "transfer": transfer.transfer,
    "transfer_median": transfer.transfer_median,
    "transfer_twins": transfer_twins.transfer_twins,
    "noises": noises.noises,
    "transfer_columns": measured_columns.columns,
    "strain_penetration": strain_penetration.evidence,
    "transfer_frame": measured_tests.frame,
    "transfer_meloland": measured_tests.meloland,
    "transfer_coupon": measured_tests.coupon,
    "new_event": new_event.new_event,
    "level_ratios": decisions.level_ratios,
    "fragility_bands": decisions.fragility_bands,
    "measured_peaks": measured_peaks.measured_peaks,
    "cache": cache.cache,
    "storage": storage.storage,
    "executors": executors.executors,
    "expected": expected.expected,
    "samplers": samplers.rows,
    "starts": starts.starts,
    "carried_state": carried_state.carried_state,
    "sequential": sequential.sequential,
    "peers": peers.rows,
    "overhead": overhead.overhead,
    "few_hundred_peers": few_hundred_peers.rows,
    "memory": job.memory,
    "opensees_memory": opensees_memory.memory,
    "job": job.job,
}


def main() -> None:
    """Run the selected benchmarks, print their table and store it."""
    if sys.argv[1:2] == ["truth"]:
        truth.main(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(BENCHMARKS)} (all by default); truth")
    parser.add_argument("--repeats", type=int, default=3, help="number of repeats; the median is reported (default 3)")
    parser.add_argument("--out", type=Path, default=Path("results") / "benchmarks.json")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="compare two stored files; runs no benchmark"
    )
    parser.add_argument("--every", type=int, default=job.EVERY, help="job: use one sample in EVERY; 1: full record")
    parser.add_argument("--limit", type=float, default=job.LIMIT, help="job: time limit of each run [s]; 0: none")
    arguments = parser.parse_args()
    if arguments.compare:
        try:
            print(compare(*arguments.compare))
        except ValueError as error:
            parser.error(str(error))
        return
    if unknown := set(arguments.names) - set(BENCHMARKS):
        parser.error(f"expected names among {', '.join(BENCHMARKS)}; got {', '.join(unknown)}")
    if arguments.repeats < 1:
        parser.error(f"expected at least one repeat; got {arguments.repeats}")
    if arguments.every < 1 or arguments.limit < 0:
        parser.error(f"expected --every of 1 or more, --limit not below 0; got {arguments.every}, {arguments.limit:g}")
    benchmarks = BENCHMARKS | {"job": partial(job.job, every=arguments.every, limit=arguments.limit)}
    machines = [machine()]
    groups = [benchmarks[name](arguments.repeats) for name in arguments.names or benchmarks]
    machines.append(machine())
    print(f"{machines[0]['cpu']}, {machines[0]['cores']} cores; load average of the last minute", end=" ")
    print(" before and ".join(str(m["load_average"][:1]) for m in machines), "after")
    print(as_table(*groups))
    write_json(arguments.out, [row for rows in groups for row in rows], machines)
    print(f"stored in {arguments.out}")


if __name__ == "__main__":
    main()
