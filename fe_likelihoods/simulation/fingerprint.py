"""Fingerprint of a model together with the digests of the code that its results depend on."""

import dis
import functools
import types
import weakref
from dataclasses import fields, is_dataclass
from typing import Any

from .code_digest import code_digest, describe_code
from .source_digest import LIBRARY, inherits_fingerprint, object_digest

__all__ = ["read_attributes_again", "simulation_fingerprint", "state_of", "state_of_user"]

_attributes: dict[int, tuple[weakref.ref, str]] = {}  # digests of the user's attributes, per id of a model


def simulation_fingerprint(model: Any, statistic: Any = None) -> str:
    """Fingerprint of a model together with the digest of the source files that its results depend on.

    A class of the user that inherits its fingerprint from a model of the library is also represented by its code
    and by the attributes that it adds, as they were when a likelihood was made: it may count its runs in them.

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
        parts.append(_attributes_of_user(model))
    return " ".join(parts)


def _code_of(thing: Any, what: str, advice: str) -> str:
    try:
        return code_digest(thing)
    except ValueError as error:
        raise ValueError(f"{thing.__qualname__}: no digest of {what} can be computed; {advice}: {error}") from error


def read_attributes_again(model: Any) -> None:
    """Forget the digest of the attributes that a class of the user has added to a model of the library."""
    _attributes.pop(id(model), None)


def _attributes_of_user(model: Any) -> str:
    """Digest of the attributes that are set by no class of the library; it is kept until `read_attributes_again`."""
    kept, digest = _attributes.get(id(model), (None, ""))
    if kept is None or kept() is not model:
        own = _own_attributes(model)
        digest = describe_code(own, strict=False).digest if own else ""
        _attributes[id(model)] = weakref.ref(model, lambda _, key=id(model): _attributes.pop(key, None)), digest
    return digest


def state_of_user(model: Any) -> str:
    """Digest of what a class of the user adds to a model of the library, as it is now; empty for other models.

    Values that the class may itself change when it runs are left out.
    """
    return state_of(model) if inherits_fingerprint(type(model)) else ""


def state_of(model: Any) -> str:
    """As `state_of_user`, also for a class of the user with a fingerprint of its own, which need not contain it."""
    cls = type(model)
    if cls.__module__.split(".")[0] == LIBRARY:
        return ""
    own = _Attributes()
    vars(own).update(_own_attributes(model))
    return describe_code([cls, own], strict=False, user=cls).steady


class _Attributes:
    """Object with the attributes of another one."""


def _own_attributes(model: Any) -> dict[str, Any]:
    """Attributes that are set by no class of the library."""
    library = set().union(*map(_names_set_by, type(model).__mro__))
    return {name: value for name, value in sorted(vars(model).items()) if name not in library}


@functools.cache
def _names_set_by(cls: type) -> frozenset[str]:
    """Names of the attributes that the methods of a class of the library set; none for other classes."""
    if cls.__module__.split(".")[0] != LIBRARY:
        return frozenset()
    names = {field.name for field in fields(cls)} if is_dataclass(cls) else set()
    for member in vars(cls).values():
        member = getattr(member, "fget", None) or getattr(member, "func", None) or member
        if isinstance(member, types.FunctionType):
            code = member.__code__
            names.update(step.argval for step in dis.get_instructions(code) if step.opname == "STORE_ATTR")
            if "__setattr__" in code.co_names:
                names.update(text for text in code.co_consts if isinstance(text, str))
    return frozenset(names) | {name for name, member in vars(cls).items() if hasattr(member, "attrname")}
