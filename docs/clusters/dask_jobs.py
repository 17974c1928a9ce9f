"""Update a model on workers that dask-jobqueue submits as jobs of their own: ``python dask_jobs.py --help``.

This process proposes the points and writes all files. The jobs of the workers come and go with the work: a worker
leaves before its walltime ends, and other jobs take its place. Interrupted in any way, the same command goes on.
"""

import argparse
import os
import signal

import dask_jobqueue
import problem
from dask.distributed import Client

CLUSTERS = {"slurm": dask_jobqueue.SLURMCluster, "pbs": dask_jobqueue.PBSCluster}


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", choices=CLUSTERS, default="slurm")
    parser.add_argument("--partition", default="compute", help="partition (SLURM) or queue (PBS)")
    parser.add_argument("--cores", type=int, default=32, help="cores of a job")
    parser.add_argument("--threads", type=int, default=1, help="cores that one simulation uses")
    parser.add_argument("--memory", default="64GB", help="memory of a job")
    parser.add_argument("--walltime", default="08:00:00", help="of a job")
    parser.add_argument("--lifetime", default="7h", help="of a worker: the walltime less more than one simulation")
    parser.add_argument("--stagger", default="20m", help="spread of the lifetimes, so that jobs do not end together")
    parser.add_argument("--jobs", type=int, default=8, help="most jobs at once")
    return parser.parse_args()


def make_cluster(args: argparse.Namespace) -> dask_jobqueue.JobQueueCluster:
    """A cluster without jobs; each job will run one worker process per simulation at a time."""
    return CLUSTERS[args.system](
        queue=args.partition,
        cores=args.cores,
        processes=args.cores // args.threads,
        memory=args.memory,
        walltime=args.walltime,
        worker_extra_args=["--nthreads", "1", "--lifetime", args.lifetime, "--lifetime-stagger", args.stagger],
        job_script_prologue=[f"cd '{os.getcwd()}'", f"export OMP_NUM_THREADS={args.threads}"],
    )


if __name__ == "__main__":
    args = parse_arguments()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # scancel and qdel act as Ctrl-C: the jobs are ended
    with make_cluster(args) as cluster, Client(cluster) as client:
        cluster.adapt(minimum_jobs=1, maximum_jobs=args.jobs)
        problem.update(pool=client)
