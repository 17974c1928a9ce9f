#!/bin/bash
# sbatch slurm.sh python dask_jobs.py --jobs 8
# sbatch --cpus-per-task=64 --mem=128G slurm.sh python one_machine.py
#SBATCH --job-name=update
#SBATCH --partition=compute
#SBATCH --time=08:00:00
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@120

# Two minutes before the walltime ends: stop the command as by Ctrl-C, and submit this job again.
again() {
    kill -TERM "$command"
    wait "$command"
    scontrol requeue "$SLURM_JOB_ID"
    exit
}
trap again USR1

"$@" &
command=$!
wait "$command"
