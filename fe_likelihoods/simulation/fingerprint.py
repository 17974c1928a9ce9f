"""Fingerprint of a model together with the digests of the code that its results depend on."""

from typing import Any

from .code_digest import code_digest
from .source_digest import LIBRARY, inherits_fingerprint, object_digest

__all__ = ["simulation_fingerprint"]


def simulation_fingerprint(model: Any, statistic: Any = None) -> str:
    """Fingerprint of a model together with the digest of the source files that its results depend on.

    A class of the user that inherits its fingerprint from a model of the library is also represented by its code.

    Parameters
    ----------
    model : Model
        Its class may be defined outside the library.
    statistic : function, optional
        The statistic of the residuals that is stored, where it is not the sum of squares. One of the user is
        represented by its code.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If no digest of the code of the user's class or statistic can be computed.
    """
    modules, code = [f"{LIBRARY}.simulation.model"], []
    if statistic is not None:
        if statistic.__module__.split(".")[0] == LIBRARY:
            modules.append(statistic.__module__)
        else:
            code = [_code_of(statistic, "the statistic of the noise", "define it without such an object")]
    parts = [model.fingerprint, object_digest(model, *modules), *code]
    cls = type(model)
    if inherits_fingerprint(cls):
        advice = "define a property `fingerprint` in it, a text to be changed whenever the code changes"
        parts.append(_code_of(cls, "the code of the class", advice))
    return " ".join(parts)


def _code_of(thing: Any, what: str, advice: str) -> str:
    try:
        return code_digest(thing)
    except ValueError as error:
        raise ValueError(f"{thing.__qualname__}: no digest of {what} can be computed; {advice}: {error}") from error
