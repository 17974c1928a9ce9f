"""``python -m tests.clients [client ...]``: run the clients that are installed and print one Markdown row per client.

The errors are those of the worst of the four parameters. The wall time includes imports.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context

from . import table
from .runs import CLIENTS


def main() -> None:
    seed = int(os.environ.get("SEED", "20240"))
    sys.stdout.write(
        "| client | error of mean, in sd (its standard error) | ratio of sd | error of log-evidence (its error) | "
        "evaluations | wall s | CPU s |\n|---|---|---|---|---|---|---|\n"
    )
    names = sys.argv[1:] or list(CLIENTS)
    # one process per client: modules that one client imports can prevent another from starting
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for row in pool.map(table.row, names, repeat(seed)):
            sys.stdout.write(row + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
