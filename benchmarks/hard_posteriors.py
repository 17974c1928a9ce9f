"""``python -m benchmarks.hard_posteriors [names] [--seeds 5] [--budget 500] [--out FILE]``: right, or refused?

Runs a sampler with a guide and a budget on the small posteriors of `tests.statistics.hard_posteriors`, whose answers
are known by brute force, and prints one line per case and seed: verdict, simulations, effective sample size, errors,
and a judgement. "WRONG" is a result that does not lie within its own errors although its verdict is better than "not
usable". References are cached in ``results/hard_references.json``; they take about ten seconds each.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from tests.statistics.brute_force import Reference, reference
from tests.statistics.guided_runs import Errors, Outcome, compare, run
from tests.statistics.hard_posteriors import CASES

from .rows import aligned

__all__ = ["cached_reference"]

HEADER = (
    "case",
    "seed",
    "judgement",
    "verdict",
    "runs",
    "ESS",
    "log Z error",
    "+-",
    "in se",
    "mean [sd]",
    "in se",
    "sd [%]",
    "share",
    "s",
)


def cached_reference(name: str, seed: int, file: Path) -> Reference:
    """Reference of a case and seed from the cache, or computed and stored there."""
    cache = json.loads(file.read_text()) if file.exists() else {}
    key = f"{name} {seed}"
    if key not in cache:
        found = reference(CASES[name], seed)
        cache[key] = [np.asarray(value).tolist() for value in found]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(cache))
    return Reference(*[np.array(value) if isinstance(value, list) else value for value in cache[key]])


def line(name: str, seed: int, outcome: Outcome, errors: Errors) -> tuple[str, ...]:
    """Cells of one run."""
    numbers = (
        f"{outcome.simulations:.0f}",
        f"{outcome.effective_sample_size:.0f}",
        f"{errors.log_evidence:+.3f}",
        f"{outcome.log_evidence_error:.3f}",
        f"{errors.log_evidence_z:+.1f}",
        f"{errors.mean:.2f}",
        f"{errors.mean_z:.1f}",
        f"{100 * errors.sd:.0f}",
        f"{errors.share:.2f}",
        f"{outcome.seconds:.1f}",
    )
    return (name, str(seed), errors.judgement[:60], outcome.status, *numbers)


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hard_posteriors", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(CASES)}; all by default")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, of data and sampler (default 5)")
    parser.add_argument("--first", type=int, default=1, help="first seed (default 1)")
    parser.add_argument("--budget", type=int, default=500, help="largest number of simulations (default 500)")
    parser.add_argument("--default", action="store_true", help="the default SMC, 500 walkers, without guide or budget")
    parser.add_argument("--reasons", action="store_true", help="print the reasons of the verdicts too")
    parser.add_argument("--out", type=Path, help="file for the results (JSON)")
    parser.add_argument("--references", type=Path, default=Path("results") / "hard_references.json")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(CASES):
        parser.error(f"expected names among {', '.join(CASES)}; got {', '.join(unknown)}")
    lines, stored = [HEADER], []
    for name in arguments.names or CASES:
        case = CASES[name]
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            known = cached_reference(name, seed, arguments.references)
            posterior = case.posterior(seed, name)
            if arguments.default:
                outcome = run(posterior, seed, None, guided=False, nwalkers=500)
            else:
                outcome = run(posterior, seed, arguments.budget)
            errors = compare(outcome, known, case.labels if case.label else None)
            lines.append(line(name, seed, outcome, errors))
            print(*lines[-1], sep="  ", flush=True)
            if arguments.reasons:
                print("   ", outcome.reasons, *outcome.warnings, sep="\n    ", flush=True)
            stored.append({"case": name, "seed": seed, "budget": arguments.budget, "reasons": outcome.reasons})
            stored[-1] |= errors._asdict() | {
                key: getattr(outcome, key)
                for key in ("simulations", "effective_sample_size", "status", "log_evidence_error", "seconds")
            }
    print()
    print(aligned(lines, right=range(4, len(HEADER))))
    counts = Counter((one["judgement"], one["status"]) for one in stored)
    print(", ".join(f"{n} {judgement} ({status})" for (judgement, status), n in counts.most_common()))
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    main()
