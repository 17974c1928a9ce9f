"""Appended to the documentation's ``problem.py``: its model takes a while, and notes when simulations begin and end."""

import os
import time

WALKERS = 250
SECONDS = float(os.environ.get("SECONDS_PER_SIMULATION", "0.1"))
PLACE = os.getcwd()  # of the script: a simulation in a worker has a folder of its own
at_once = free_vibration  # noqa: F821


def free_vibration(theta):
    """The model of the documentation after some time."""
    _note("starts.txt", theta)
    time.sleep(SECONDS)
    response = at_once(theta)
    _note("ends.txt", theta)
    return response


def _note(name, theta):
    with open(os.path.join(PLACE, name), "a") as file:
        file.write(f"{theta[0]!r} {theta[1]!r}\n")
