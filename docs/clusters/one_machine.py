"""Update a model with the cores of one machine: ``python one_machine.py --threads 4``."""

import argparse
import os
import signal

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    cores = len(os.sched_getaffinity(0))  # the cores of this job, not of the machine
    parser.add_argument("--cores", type=int, default=cores)
    parser.add_argument("--threads", type=int, default=1, help="cores that one simulation uses")
    args = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = str(args.threads)  # before numpy is imported; the processes of the pool inherit them

    import problem

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the end of a job acts as Ctrl-C
    problem.update(pool=args.cores // args.threads)
