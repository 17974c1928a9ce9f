"""
Natural frequencies, mode shapes and a truck test as data
=========================================================

Nothing shakes this structure but wind and traffic, so there are no time histories to compare with: its natural
frequencies and mode shapes were identified from ambient vibration.

* Three modes at four of the six floors of a building, identified five times, calibrate six storey stiffnesses, and
  predict the modes that were left out.
* The same after an event: which storey has lost stiffness, if all modes are 1 % lower because the day was warmer?
* A truck test of a girder, with sensors of known noise, calibrates its bending stiffness.

**The data are synthetic**, so that the truth is known. ::

    python tutorials/10_modes_and_load_tests.py
"""

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    LogNormal,
    ModalData,
    ModalLikelihood,
    Posterior,
    ShearFrame,
    StoredPosterior,
    stiffness_loss,
    to_si,
)
from fe_likelihoods.modal.load_cases import LoadTest
from fe_likelihoods.modal.mode_models import StructureModes
from samplers import SMCSampler

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# Modes of a building
# -------------------
#
# A `ModalData` has a row for each mode. Scale and sign of the shapes are arbitrary. The five identifications are
# averaged, and their scatter is the error: it contains what differs from day to day.

FLOORS = {"floor 1": 1, "floor 2": 2, "floor 4": 4, "roof": 6}
frame = ShearFrame(FLOORS, masses=[300e3] * 6, stiffnesses=[400e6] * 6)  # kg, N/m
stiffnesses = [f"stiffness_{i}" for i in range(1, 7)]


def identify(truth: list[float], seed: int) -> ModalData:
    """Five synthetic identifications of five modes."""
    rng = np.random.default_rng(seed)
    modes = StructureModes(frame).simulate(truth)[:, :5]
    shapes = modes[1:].T / np.linalg.norm(modes[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(5, 5, 4))
    return ModalData(modes[0] * (1.0 + 0.005 * rng.normal(size=(5, 5))), shapes, tuple(FLOORS)).mean()


def calibrate(data: ModalData, seed: int) -> tuple[SMCSampler, Posterior]:
    """A guided run with log-normal priors."""
    posterior = Posterior(ModalLikelihood(frame, data), {name: LogNormal(1.0, 0.2) for name in stiffnesses})
    guide = posterior.guide()
    sampler = SMCSampler(200, posterior.ndim, posterior, guide=guide, seed=seed, vectorize=True)
    sampler.run_mcmc(None, 1)
    return sampler, posterior


healthy = [1.0, 1.1, 0.9, 1.0, 1.1, 0.95]
before = identify(healthy, seed=1)
print(before)
sampler, posterior = calibrate(before.select([1, 2, 3]), seed=1)
print(sampler.verdict)
modes = posterior.likelihood.predict_modes(sampler.get_chain(flat=True), before)
print(modes)  # modes 4 and 5 were not used

# %%
# After an event
# --------------
#
# Storey 3 has lost 25 %, and the stiffness of the building 2 % because the day is warmer: `stiffness_loss` allows for a
# common change.

after = identify((0.98 * np.array(healthy) * [1.0, 1.0, 0.75, 1.0, 1.0, 1.0]).tolist(), seed=2)
states = [StoredPosterior.from_run(*calibrate(data, seed)) for seed, data in ((3, before), (4, after))]
loss = stiffness_loss(*states, stiffnesses)
print(loss)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
low, high = modes.interval(0.9)
places = np.arange(1, 6)
ends = low / before.mean_frequencies[:5], high / before.mean_frequencies[:5]
left.vlines(places, *ends, linewidth=6, alpha=0.4, label="computed, 90 %")
left.axhline(1.0, color="C1", linewidth=1.5, label="measured")
left.set(xlabel="mode", xticks=places, ylabel="frequency / measured frequency [-]", title="Modes 1 to 3 were used")
left.legend(loc="lower left")
right.bar(range(1, 7), loss.probability(0.1))
right.set(xlabel="storey", ylabel="P(loss > 10 %)", title="After the event", ylim=(0, 1))
figure.savefig("modes.png")

# %%
# A truck test of a girder
# ------------------------
#
# A truck of 400 kN stands at three places of a simple span. A load case is a sample, instead of a time, and the noise
# of the sensors is a known number in the mapping of priors.

SPAN, TRUCK, EI = 30.0, 400e3, 12e9  # m, N, N m2
PLACES = np.array([7.5, 15.0, 22.5])
channels = Channel("quarter", "displacement", "mm"), Channel("midspan", "displacement", "mm")


def deflection(theta: np.ndarray) -> np.ndarray:
    """Deflections [m] at a quarter and at half of the span, for each place of the truck."""
    x, a = np.meshgrid([SPAN / 4, SPAN / 2], PLACES, indexing="ij")
    near, far = np.minimum(x, a), SPAN - np.maximum(x, a)
    return TRUCK * near * far * (SPAN**2 - near**2 - far**2) / (6.0 * theta[0] * EI * SPAN)


noise = to_si(0.1, "mm") * np.random.default_rng(3).normal(size=(2, 3))
test = LoadTest(
    channels, ["7.5 m", "15 m", "22.5 m"], deflection([0.9]) + noise, errors=dict(quarter=1e-4, midspan=1e-4)
)
girder = test.model(deflection, ("stiffness",))
static = Posterior(FELikelihood(girder, test.measurements), {"stiffness": LogNormal(1.0, 0.2)} | test.known)
run = SMCSampler(200, static.ndim, static, seed=5, vectorize=True)
run.run_mcmc(None, 4)
stiffness = run.get_chain(flat=True)[:, 0]
print(f"stiffness {stiffness.mean():.3f} +- {stiffness.std():.3f} (true: 0.9)")
print(np.stack([test.values, girder.simulate([stiffness.mean()])], axis=-1).round(4))  # measured and computed [m]
