"""Messages of the library in the words of the TOML file, for users who call no Python function."""

import contextlib
import re
import warnings
from collections.abc import Iterator
from typing import Any

import click

__all__ = ["in_toml_terms", "plain_warnings"]

_TERMS = (
    (r"with Measurements\.select\b", "of `channels` in [measurements]"),
    (r"\bmissing=\(([^()]*?),?\)", r"missing = [\1]"),
    (
        r"set the attribute max_simulations of the sampler to a larger number, or make a new sampler with the same "
        r"file, and call run_mcmc again",
        "set max_simulations in [budget] to a larger number and give the same command again",
    ),
    (r"Record\.trim\(start, stop\) and Measurements\.trim\(start, stop\)", "`duration` in [record]"),
    (r"\(fe_likelihoods\.units\.to_si converts\)", 'or a text with a unit, such as "1.2 m"'),
    (
        r"see the failures that log_prob_fn reports \(posterior\.report\(\) for a posterior of fe_likelihoods\)",
        "see the first failure in the messages above",
    ),
    (r"Calibrate with AutoregressiveNoise or effective_samples=", 'Set kind = "autoregressive" in [noise]'),
    (
        r'Predict peaks of the structure with noise="model"',
        'Compare the peaks with noise = false in [prediction], or in Python noise="model"',
    ),
)


def in_toml_terms(message: str, record: str = "[record]") -> str:
    """A message with the keys of the TOML file instead of functions and attributes of the library.

    Parameters
    ----------
    message : str
        The message of the library.
    record : str
        The section of the base motion that it is about.
    """
    for pattern, words in _TERMS:
        message = re.sub(pattern, words.replace("[record]", record), message)
    return message


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Print warnings for users as sentences, without the file and the line of the library that issued them."""
    usual = warnings.showwarning

    def show(message: Any, category: type[Warning], *place: Any, **options: Any) -> None:
        if issubclass(category, UserWarning):
            click.echo(f"Warning: {in_toml_terms(str(message))}", err=True)
        else:
            usual(message, category, *place, **options)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
