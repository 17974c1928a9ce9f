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
        The statistic of the residuals that is stored, where it is not the sum of squares.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If no digest of the code of the user's class can be computed.
    """
    modules = [f"{LIBRARY}.simulation.model"]
    if statistic is not None and statistic.__module__.split(".")[0] == LIBRARY:
        modules.append(statistic.__module__)
    parts = [model.fingerprint, object_digest(model, *modules)]
    cls = type(model)
    if inherits_fingerprint(cls):
        try:
            parts.append(code_digest(cls))
        except ValueError as error:
            raise ValueError(
                f"{cls.__name__}: no digest of the code of the class can be computed; define a property `fingerprint` "
                f"in it, a text to be changed whenever the code changes: {error}"
            ) from error
    return " ".join(parts)
