"""Scripts of the documentation on clusters, run by SLURM on this machine and by MPI."""
