"""
Your own model: a program, or a Python function
===============================================

A mass on a bilinear spring is simulated by a program that reads and writes text files (``own_program.py``), as any
finite-element program can be. The program becomes a posterior in a few lines, with a cache file and on two processes.
The same structure as a Python function gives the same posterior. **The data are synthetic.** ::

    python tutorials/03_your_own_program.py

:doc:`/own_model` has OpenSees, UM-Bridge and models in classes, :doc:`/clusters` has several machines, and
:doc:`/logger_and_program` does without Python.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import own_program

from fe_likelihoods import (
    Channel,
    ExecutableModel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
    problems,
)
from samplers import SMCSampler, plot_corner, summary

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# The structure
# -------------
#
# Parameters are multiples of a nominal stiffness (a period of 0.8 s) and of a nominal yield strength (20 mm). Channels
# say what the model returns, and the unit in which figures show it; the values are in SI units.

STIFFNESS = (2.0 * np.pi / 0.8) ** 2  # per unit mass [1/s²]
STRENGTH, HARDENING, DAMPING = 0.02 * STIFFNESS, 0.05, 0.06 * np.sqrt(STIFFNESS)
record = problems.table_motion().trim(0.0, 8.0).resample(0.01)
common = dict(
    parameter_names=("stiffness", "strength"),
    channels=(
        Channel("acceleration", "absolute acceleration", "g"),
        Channel("displacement", "relative displacement", "mm"),
    ),
    dt=record.dt,
    n_steps=record.n_steps,
)

# %%
# The program
# -----------
#
# The template is the input file with placeholders, ``$stiffness`` and ``$strength``. Every simulation has a folder of
# its own with the input file and ``motion.txt``; columns 1 and 2 of ``response.txt`` are the channels. A run that fails
# (by an exit code, NaN, a time limit, a missing file) has a log-probability of -inf. It is counted in
# ``posterior.report()`` with its parameters and its reason.

folder = Path(tempfile.mkdtemp())
motion = folder / "motion.txt"
motion.write_text("\n".join(map(repr, record.acceleration.tolist())) + "\n")
template = f"# multiples, then nominal values\n$stiffness $strength {STIFFNESS} {STRENGTH} {HARDENING} {DAMPING} 0.01\n"
program = ExecutableModel(
    [sys.executable, "-I", "-S", str(Path(own_program.__file__).resolve()), "oscillator.txt"],
    templates={"oscillator.txt": template},
    files={"motion.txt": motion},
    output="response.txt",
    columns=(1, 2),
    time_limit=20.0,
    **common,
)

# %%
# The posterior
# -------------
#
# ``pool=2`` starts two processes on this machine. ``cache=`` names a file of all simulations: a second run of this
# script with the same file simulates nothing, and an interrupted run loses nothing. With a guide, a model that takes a
# minute needs hundreds of runs instead of thousands.

TRUTH = [1.15, 0.85]
rng = np.random.default_rng(1)
clean = program.simulate(TRUTH)
noise = np.array([[0.3], [2e-3]]) * rng.standard_normal(clean.shape)  # standard deviations [m/s², m]
measured = Measurements(common["channels"], record.dt, clean + noise, "SYNTHETIC: bilinear oscillator")
prior = {"stiffness": TruncatedNormal(1.0, 0.3), "strength": TruncatedNormal(1.0, 0.3)}
prior |= {"sigma_acceleration": HalfNormal(2.0), "sigma_displacement": HalfNormal(0.02)}


def update(model, **options) -> tuple[SMCSampler, Posterior]:
    """A guided run with 100 walkers."""
    posterior = Posterior(FELikelihood(model, measured, **options), prior)
    sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide())
    sampler.run_mcmc(None, 1)
    return sampler, posterior


sampler, posterior = update(program, pool=2, cache=folder / "simulations.db")
print(sampler.verdict)
report = posterior.report()
print(f"{report['simulations']} simulations, {report['failure_count']} failed")
errors = sampler.mean_error(), sampler.sd_error()
print(summary(sampler.get_chain(flat=True), posterior.parameters, *errors))

# %%
# The same as a Python function
# -----------------------------
#
# `FunctionModel` takes a function of the parameters that returns the channels, shape (n_channels, n_steps).


def bilinear(theta: np.ndarray) -> np.ndarray:
    """Acceleration [m/s²] and displacement [m]."""
    motion = record.acceleration.tolist()
    rows = own_program.solve(STIFFNESS * theta[0], STRENGTH * theta[1], HARDENING, DAMPING, 0.01, motion)
    return np.array(rows).T


function = FunctionModel(bilinear, **common)
same, of_function = update(function)
difference = same.get_chain(flat=True).mean(axis=0) / sampler.get_chain(flat=True).mean(axis=0) - 1.0
print(f"log evidence {sampler.log_evidence:.3f} of the program, {same.log_evidence:.3f} of the function")
print(f"largest relative difference of a mean: {np.abs(difference).max():.1e}")

# %%
# Figures
# -------

draws = sampler.signed_sample.draw(4000, seed=1)
plot_corner(draws, posterior, truths=[*TRUTH, 0.3, 2e-3]).savefig("corner.png")
acceleration, displacement = function.simulate(draws.mean(axis=0)[:2])
figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
axes.plot(1e3 * displacement, -acceleration, linewidth=0.8)
axes.set(xlabel="displacement [mm]", ylabel="force per mass [m/s²]", title="Hysteresis at the posterior mean")
figure.savefig("loops.png")
