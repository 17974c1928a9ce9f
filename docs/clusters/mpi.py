"""Update a model on MPI ranks: ``mpiexec -n 65 python -m mpi4py.futures mpi.py`` has 64 workers."""

import problem
from mpi4py.futures import MPIPoolExecutor

if __name__ == "__main__":
    with MPIPoolExecutor() as pool:
        problem.update(pool=pool)
