"""Fixtures of the tests of clients: the exact answer, and a client, or a skip that says how to install it."""

import importlib.util
import logging
import os

import pytest

from .problem import Exact, exact
from .runs import CLIENTS, Client


@pytest.fixture(scope="session")
def answer() -> Exact:
    """Moments and evidence by quadrature."""
    return exact()


@pytest.fixture(autouse=True)
def quiet(caplog):
    """Hide the failed simulations of the oscillator, which are intended."""
    caplog.set_level(logging.ERROR, logger="fe_likelihoods")


@pytest.fixture
def client_named():
    """Function from a name of `runs.CLIENTS` to the client; it skips the test if the client is not installed.

    The environment variable ``REQUIRED_CLIENTS``, a list of modules separated by commas, turns such a skip into a
    failure.
    """

    def find(name: str) -> Client:
        client = CLIENTS[name]
        if importlib.util.find_spec(client.module) is None:
            reason = f"{client.module.upper()} IS NOT INSTALLED: {client.install}"
            if client.module in os.environ.get("REQUIRED_CLIENTS", "").split(","):
                pytest.fail(reason)
            pytest.skip(reason)
        return client

    return find
