"""Stiffness losses from modes before and after an event, with another temperature."""

import numpy as np
import pytest

from fe_likelihoods import LogNormal, ModalData, ModalLikelihood, Posterior, ShearFrame, StoredPosterior, stiffness_loss
from fe_likelihoods.modal.mode_models import StructureModes
from tests.emulation.problems import guided

FLOORS = {"floor 1": 1, "floor 2": 2, "floor 4": 4, "roof": 6}
FRAME = ShearFrame(FLOORS, [300e3] * 6, [400e6] * 6)
NAMES = [f"stiffness_{i}" for i in range(1, 7)]


def calibrated(stiffnesses, temperature, rng, frame=FRAME, slope=-0.0015):
    """Posterior of the mean of five synthetic identifications of four modes of a true frame."""
    modes = StructureModes(frame).simulate(stiffnesses)[:, :4]
    shapes = modes[1:].T / np.linalg.norm(modes[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(5, 4, 4))
    frequencies = modes[0] * (1.0 + slope * (temperature - 20.0)) * (1.0 + 0.005 * rng.normal(size=(5, 4)))
    data = ModalData(frequencies, shapes, tuple(FLOORS)).mean()
    posterior = Posterior(ModalLikelihood(FRAME, data), dict.fromkeys(NAMES, LogNormal(1.0, 0.2)))
    sampler = guided(posterior, starts=2, walkers=200)
    return StoredPosterior.from_run(sampler, posterior)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_loss_is_found_and_a_warmer_day_is_none(seed):
    rng = np.random.default_rng(1000 + seed)
    healthy, storey = np.exp(0.1 * rng.normal(size=6)), int(rng.integers(6))
    after = healthy * np.exp(0.01 * rng.normal(size=6))
    after[storey] *= 0.75 if seed % 2 else 1.0
    loss = stiffness_loss(calibrated(healthy, 2.0, rng), calibrated(after, 28.0, rng), NAMES)
    if seed % 2:
        assert loss.presence() > 0.9 and loss.location().argmax() == storey
    else:
        assert loss.presence() < 0.1


@pytest.mark.slow
def test_losses_lie_in_their_intervals_though_the_masses_are_wrong():
    inside, alarms = [], []
    for seed in range(10):
        rng = np.random.default_rng(5000 + seed)
        healthy, n = np.exp(0.1 * rng.normal(size=6)), (0, 1, 2, 1, 0)[seed % 5]
        damaged = rng.choice(6, n, replace=False)
        after = healthy * np.exp(0.01 * rng.normal(size=6))
        after[damaged] *= rng.uniform(0.6, 0.95, n)
        temperatures, slope = rng.uniform(-5.0, 32.0, 2), rng.uniform(-0.002, 0.0)
        frame = ShearFrame(FLOORS, 300e3 * np.exp(0.03 * rng.normal(size=6)), [400e6] * 6)
        states = [
            calibrated(each, day, rng, frame, slope) for each, day in zip((healthy, after), temperatures, strict=True)
        ]
        found = stiffness_loss(*states, NAMES)
        low, lower, upper, high = np.quantile(found.loss, (0.05, 0.25, 0.75, 0.95), axis=0)
        loss = 1.0 - after / healthy
        inside.append([(low <= loss) & (loss <= high), (lower <= loss) & (loss <= upper)])
        alarms.append(found.presence() > 0.5)
        assert alarms[-1] <= (n > 0)
    shares = np.mean(inside, axis=(0, 2))  # of 50 frames: 97 and 55 %
    assert shares[0] > 0.85 and 0.35 < shares[1] < 0.75 and sum(alarms) >= 4
