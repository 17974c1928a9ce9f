"""
Your own model: a Python function, OpenSees, any program
========================================================

One structure is modelled three times: a mass on a bilinear spring as a Python function, as OpenSees commands, and as
a program that reads and writes text files (``own_models.py``, ``own_program.py``). Each model becomes a posterior in
a few lines, with a cache and on several processes, and all three posteriors agree. A run that fails (by an exception,
NaN, a time limit, a crash of the process, or too much output) gives a log-probability of -inf. It is counted in
``posterior.report()`` with its parameters, its reason and its duration::

    python tutorials/05_your_own_model.py                     # two processes on this machine
    python tutorials/05_your_own_model.py --pool dask         # two workers of dask.distributed

The data are **synthetic**: the response of the function at known parameters plus white noise.
"""

import argparse
import importlib.util
import json
import os
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import own_models

from fe_likelihoods import (
    ExecutableModel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    OpenSeesModel,
    Posterior,
    Prior,
    TruncatedNormal,
)
from samplers import SMCSampler, plot_corner, summary

TRUTH = np.array([1.15, 0.85])
NOISE = np.array([0.3, 2e-3])  # standard deviations [m/s², m]


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description="Update your own model; write figures to a folder.")
    parser.add_argument("--pool", choices=("local", "dask", "none"), default="local")
    parser.add_argument("--workers", type=int, default=2, help="number of worker processes")
    parser.add_argument("--walkers", type=int, default=24 if os.environ.get("FAST") else 200)
    parser.add_argument("--cache", type=Path, help="file of the simulation cache (default: in OUT)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the noise and of the sampler")
    parser.add_argument("--out", type=Path, default=Path("results-own-model"), help="folder of the results")
    return parser.parse_args()


# %%
# Three models of one structure
# -----------------------------
#
# ``FunctionModel`` takes a function of the parameters, ``ExecutableModel`` a command with templates of its input files,
# and ``OpenSeesModel`` a function that builds and runs an OpenSees model. OpenSees is left out if ``openseespy`` is not
# installed.


def models(out: Path) -> dict:
    """The structure as a function, as a program, and in OpenSees if it is installed."""
    common = dict(
        parameter_names=own_models.NAMES,
        channels=own_models.CHANNELS,
        dt=own_models.RECORD.dt,
        n_steps=own_models.RECORD.n_steps,
    )
    found = {
        "function": FunctionModel(own_models.bilinear, **common),
        "program": ExecutableModel(
            [sys.executable, "-I", "-S", str(own_models.PROGRAM.resolve()), "oscillator.txt"],
            templates={"oscillator.txt": own_models.input_template()},
            files={"motion.txt": own_models.write_motion(out / "motion.txt")},
            output="response.txt",
            columns=(1, 2),
            time_limit=20.0,
            **common,
        ),
    }
    if importlib.util.find_spec("openseespy"):
        found["OpenSees"] = OpenSeesModel(own_models.bilinear_in_opensees, time_limit=20.0, **common)
    return found


def measurements(seed: int) -> Measurements:
    """Synthetic measurements: the response of the function at the true parameters plus white noise."""
    clean = own_models.bilinear(TRUTH)
    noise = NOISE[:, None] * np.random.default_rng(seed).standard_normal(clean.shape)
    return Measurements(own_models.CHANNELS, own_models.RECORD.dt, clean + noise, "SYNTHETIC: bilinear oscillator")


def make_posterior(model, data: Measurements, pool, cache: Path | None) -> Posterior:
    """Posterior with the same prior, noise, pool and cache for every model."""
    prior = Prior(
        {name: TruncatedNormal(1.0, 0.3) for name in model.parameter_names}
        | {"sigma_acceleration": HalfNormal(2.0), "sigma_displacement": HalfNormal(0.02)}
    )
    return Posterior(FELikelihood(model, data, pool=pool, cache=cache, max_failure_share=0.5), prior)


# %%
# Pools
# -----
#
# ``pool=2`` starts two processes on this machine. No simulation is lost when a worker dies, and the workers end with
# the script, even after ``kill -9``. For several machines use dask.distributed:
#
# .. code-block:: python
#
#     from dask.distributed import Client, LocalCluster
#     client = Client(LocalCluster(n_workers=2, threads_per_worker=1))        # this machine
#
#     from dask_jobqueue import SLURMCluster                                  # pip install dask-jobqueue
#     cluster = SLURMCluster(queue="compute", cores=32, processes=32, memory="64GB", walltime="08:00:00")
#     cluster.scale(jobs=8)                                                   # 256 workers
#     client = Client(cluster)
#
#     likelihood = FELikelihood(model, measurements, pool=client, cache="simulations.db")
#
# Model and data are sent to each worker once, afterwards only parameters. The cache stays with the process of the
# sampler. The second choice is ``mpi4py.futures.MPIPoolExecutor`` with ``mpiexec -n 65 python -m mpi4py.futures
# script.py``. The results are the same to the last bit on all of them. :doc:`/clusters` has complete scripts.


def make_pool(kind: str, workers: int):
    """Value of ``pool=``, and the objects to close at the end."""
    if kind == "none":
        return None, []
    if kind == "local":
        return workers, []
    from dask.distributed import Client, LocalCluster

    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    client = Client(cluster)
    return client, [client, cluster]


# %%
# Sampling all three
# ------------------
#
# The processes of a dask cluster import the script, so it needs the guard ``if __name__ == "__main__"``.


# %%
# A slow model
# ------------
#
# With a model that takes a minute, thousands of simulations take days. A guide finds the posterior from the responses,
# and hundreds of simulations are enough. Nothing about the model changes. The verdict says what the result is worth.
# With a larger ``max_simulations`` the run goes on where it stopped.


def with_few_simulations(posterior: Posterior, walkers: int, seed: int) -> SMCSampler:
    """The same posterior by a guide. The cache file keeps the responses that the guide requests."""
    sampler = SMCSampler(
        walkers, posterior.ndim, posterior, vectorize=True, seed=seed, guide=posterior.guide(), max_simulations=1000
    )
    sampler.run_mcmc(None, 1)
    return sampler


def plot_loop(theta: np.ndarray, path: Path) -> None:
    """Hysteresis of the function at the given parameters (2,)."""
    acceleration, displacement = own_models.bilinear(theta)
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    axes.plot(1e3 * displacement, -acceleration, color="#1f5a8c", linewidth=0.8)
    axes.set(
        xlabel="displacement [mm]",
        ylabel="force of spring and damper per mass [m/s²]",
        title="Hysteresis at the posterior mean",
    )
    axes.grid(alpha=0.25)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Sample the posterior of each model, compare and plot."""
    args, fast = parse_arguments(), bool(os.environ.get("FAST"))
    args.out.mkdir(parents=True, exist_ok=True)
    cache = args.cache or args.out / "simulations.db"
    data = measurements(args.seed)
    pool, to_close = make_pool(args.pool, args.workers)
    results, draws = {}, {}
    for name, model in models(args.out).items():
        posterior = make_posterior(model, data, pool, cache)
        start = time.perf_counter()
        few = {"max_moves": 2 if fast else 3} if args.walkers < 250 else {}  # with more, recycling replaces the moves
        sampler = SMCSampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=args.seed, **few)
        sampler.run_mcmc(None, 1 if fast else 4, progress=not fast)
        draws[name] = sampler.get_chain(flat=True)
        report = posterior.report()
        moments = summary(draws[name], posterior.parameter_names)
        results[name] = {
            "mean": moments.mean.tolist(),
            "sd": moments.sd.tolist(),
            "log_evidence": float(sampler.log_evidence),
            "simulations": report["simulations"],
            "from_disk": report["disk_hits"],
            "failures": report["failure_reasons"],
            "seconds": time.perf_counter() - start,
        }
        print(
            f"{name:<9} stiffness {moments.mean[0]:.4f} +- {moments.sd[0]:.4f}, strength {moments.mean[1]:.4f} +- "
            f"{moments.sd[1]:.4f} (truth {TRUTH[0]}, {TRUTH[1]}); log evidence {sampler.log_evidence:.2f}; "
            f"{report['simulations']} simulations, {report['disk_hits']} read from the cache file, "
            f"{report['failure_count']} failed, "
            f"{results[name]['seconds']:.1f} s"
        )
    guided_walkers = 24 if fast else 100
    function = make_posterior(models(args.out)["function"], data, None, cache)
    few = with_few_simulations(function, guided_walkers, args.seed)
    print(f"with a guide: log evidence {few.log_evidence:.2f} +- {few.log_evidence_error:.2f}\n{few.verdict}")
    for thing in to_close:
        thing.close()

    labels = [f"{name} [x nominal]" for name in own_models.NAMES]
    structural = {name: x[:, :2] for name, x in draws.items()}
    # the three posteriors are equal, so that the last one covers the others
    plot_corner(structural, labels=labels, truths=TRUTH).savefig(args.out / "corner.png", dpi=130)
    plot_loop(draws["function"].mean(axis=0)[:2], args.out / "loops.png")
    (args.out / "summary.json").write_text(json.dumps(results, indent=2) + "\n")
    print(f"figures and summary.json are in {args.out}/")


if __name__ == "__main__":
    main()
