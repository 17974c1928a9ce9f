# %% [markdown]
# # Your own model: a Python function, OpenSees, any program; with a cache and on many processes
#
# One structure three times: a mass on a bilinear spring as a Python function, as OpenSees commands, and as a program
# that reads and writes text (`own_models.py`, `own_program.py`). Each becomes a posterior in a few lines, and all three
# agree. What goes wrong in a run (an exception, NaN, a hang, a crash of the process, too much output) is a simulation
# that failed: -inf, counted, with its parameters, its reason and its duration in `posterior.report()`.
#
#     python tutorials/05_your_own_model.py                     # two processes of this machine
#     python tutorials/05_your_own_model.py --pool dask         # two workers of dask.distributed
#
# The data are **synthetic**: the response of the function at known parameters, plus white noise.

# %%
import argparse
import importlib.util
import json
import os
import sys
import time
from pathlib import Path

import corner
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import own_models

from fe_likelihoods.models.executable import ExecutableModel
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.opensees import OpenSeesModel
from fe_likelihoods.probability.likelihood import FELikelihood
from fe_likelihoods.probability.posterior import Posterior
from fe_likelihoods.probability.priors import HalfNormal, Prior, TruncatedNormal
from fe_likelihoods.signals.channels import Measurements
from samplers import SMCSampler
from samplers.reporting.summary import summary

TRUTH = np.array([1.15, 0.85])
NOISE = np.array([0.3, 2e-3])  # m/s2, m


def parsed() -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description="Update a model of your own; figures into a folder.")
    parser.add_argument("--pool", choices=("local", "dask", "none"), default="local")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--walkers", type=int, default=24 if os.environ.get("FAST") else 200)
    parser.add_argument("--cache", type=Path, help="file of simulations (default: in OUT)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results-own-model"))
    return parser.parse_args()


# %% [markdown]
# ## Three models of one structure


# %%
def models(out: Path) -> dict:
    """The structure as a function, as a program, and in OpenSees where that is installed."""
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
            keep_failures=out / "failures",
            **common,
        ),
    }
    if importlib.util.find_spec("openseespy"):
        found["OpenSees"] = OpenSeesModel(own_models.bilinear_in_opensees, time_limit=20.0, **common)
    return found


def measurements(seed: int) -> Measurements:
    """Synthetic: the function's response at the truth plus white noise."""
    clean = own_models.bilinear(TRUTH)
    noise = NOISE[:, None] * np.random.default_rng(seed).standard_normal(clean.shape)
    return Measurements(own_models.CHANNELS, own_models.RECORD.dt, clean + noise, "SYNTHETIC: bilinear oscillator")


def posterior_of(model, data: Measurements, pool, cache: Path) -> Posterior:
    """Prior, noise per channel, pool and cache: the same for every model."""
    prior = Prior(
        {name: TruncatedNormal(1.0, 0.3) for name in model.parameter_names}
        | {"sigma_acceleration": HalfNormal(2.0), "sigma_displacement": HalfNormal(0.02)}
    )
    return Posterior(FELikelihood(model, data, pool=pool, cache=cache, max_failure_share=0.5), prior)


# %% [markdown]
# ## Pools
#
# `pool=2` is a pool of two processes of this machine: it loses no work when a worker dies, and its workers end with
# the script, even after `kill -9`. Beyond one machine the supported engine is dask.distributed:
#
# ```python
# from dask.distributed import Client, LocalCluster
# client = Client(LocalCluster(n_workers=2, threads_per_worker=1))        # this machine
#
# from dask_jobqueue import SLURMCluster                                  # pip install dask-jobqueue
# cluster = SLURMCluster(queue="compute", cores=32, processes=32, memory="64GB", walltime="08:00:00")
# cluster.scale(jobs=8)                                                   # 256 workers
# client = Client(cluster)
#
# likelihood = FELikelihood(model, measurements, pool=client, cache="simulations.db")
# ```
# Model and data go to a worker once, afterwards only parameters; the cache stays with this process. Point TMPDIR to a
# folder that all machines see. Second choice: `mpi4py.futures.MPIPoolExecutor`, `mpiexec -n 65 python -m mpi4py.futures
# script.py`. What comes back is the same to the last bit on all of them.


# %%
def engine(kind: str, workers: int):
    """What goes into ``pool=``, and what to close in the end."""
    if kind == "none":
        return None, []
    if kind == "local":
        return workers, []
    from dask.distributed import Client, LocalCluster

    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    client = Client(cluster)
    return client, [client, cluster]


# %% [markdown]
# ## Sampling all three
#
# Starting processes inside a script asks for the guard `if __name__ == "__main__"`: workers read the script too.


# %%
def main() -> None:
    """Sample, compare, plot."""
    args = parsed()
    args.out.mkdir(parents=True, exist_ok=True)
    cache = args.cache or args.out / "simulations.db"
    data = measurements(args.seed)
    pool, to_close = engine(args.pool, args.workers)
    results, draws = {}, {}
    for name, model in models(args.out).items():
        posterior = posterior_of(model, data, pool, cache)
        start = time.perf_counter()
        sampler = SMCSampler(args.walkers, posterior.ndim, posterior, vectorize=True, seed=args.seed, max_moves=3)
        sampler.run_mcmc(None, 4, progress=not os.environ.get("FAST"))
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
            f"{report['simulations']} simulations, {report['disk_hits']} from disk, {report['failure_count']} failed, "
            f"{results[name]['seconds']:.1f} s"
        )
    for thing in to_close:
        thing.close()

    figure = None
    colours = dict(zip(draws, ("#1f5a8c", "#d9822b", "#5b8c5a"), strict=False))
    for name, x in draws.items():
        figure = corner.corner(
            x[:, :2], fig=figure, labels=own_models.NAMES, color=colours[name], plot_datapoints=False, truths=TRUTH
        )
    figure.suptitle("function, program and OpenSees: one posterior (synthetic data)", fontsize="small")
    figure.savefig(args.out / "corner.png", dpi=130)
    plt.close(figure)
    response = own_models.bilinear(draws["function"].mean(axis=0)[:2])
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    axes.plot(1e3 * response[1], -response[0], color="#1f5a8c", linewidth=0.8)
    axes.set(
        xlabel="displacement [mm]", ylabel="spring and damper force per mass [m/s²]", title="At the posterior mean"
    )
    figure.savefig(args.out / "loops.png", dpi=130)
    plt.close(figure)
    (args.out / "summary.json").write_text(json.dumps(results, indent=2) + "\n")
    print(f"figures and summary.json are in {args.out}/")


if __name__ == "__main__":
    main()
