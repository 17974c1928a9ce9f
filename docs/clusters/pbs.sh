#!/bin/bash
# id=$(qsub pbs.sh); for n in 2 3 4; do id=$(qsub -W depend=afternotok:$id pbs.sh); done
#PBS -N update
#PBS -q compute
#PBS -l walltime=08:00:00
#PBS -l select=1:ncpus=1:mem=4gb
#PBS -j oe

cd "$PBS_O_WORKDIR" || exit 1
exec python dask_jobs.py --system pbs --jobs 8
