"""Models in worker processes whose code is not that of the process that sent them."""

import logging
import weakref
from functools import partial
from typing import Any

from .faults import ChangedModel
from .label import ModelLabel

__all__ = ["SentModel"]

logger = logging.getLogger(__name__)

_CODE = ("source of ", "function", "class", "output")  # items of a label that are the same in every worker
_sent: dict[int, tuple[weakref.ref, dict[str, str]]] = {}  # by the id of a model
_compared: set[str] = set()  # items with which those of this process were compared


class SentModel:
    """A model that is compared, in the process that receives it, with the one that was sent.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ChangedModel
        When it is unpickled, if its code or the files that it depends on are others in the other process.
    """

    def __init__(self, model: Any) -> None:
        self.model = model

    @property
    def _items(self) -> dict[str, str]:
        """Items of the label when the model was sent first, so that equal functions have equal bytes."""
        known = _sent.get(id(self.model))
        if known is None or known[0]() is not self.model:
            forget = partial(_forget, id(self.model))
            known = _sent[id(self.model)] = weakref.ref(self.model, forget), ModelLabel(self.model).items
        return known[1]

    def __reduce__(self) -> tuple:
        return _receive_model, (self.model, self.model.fingerprint, self._items)


def _forget(model_id: int, _: weakref.ref) -> None:
    _sent.pop(model_id, None)


def _receive_model(model: Any, fingerprint: str, items: dict[str, str]) -> SentModel:
    name, sent = type(model).__name__, repr(sorted(items.items()))
    if sent not in _compared:
        here = ModelLabel(model).items
        differing = sorted(item for item in items.keys() & here.keys() if items[item] != here[item])
        code = [item for item in differing if item.startswith(_CODE)]
        if code or model.fingerprint != fingerprint:
            raise ChangedModel(
                f"{name} is not the same in the worker process ({', '.join(code[:3]) or 'its fingerprint'} differs): "
                "its source file was edited, or the worker process has imported an earlier version. Start a new pool "
                "and make the model again"
            )
        if differing:
            logger.warning(
                "%s: values in this worker process are not those of the main process: %s. The worker uses its own. If "
                "the response depends on them, set them where the module defines them, or pass them in the object",
                name,
                ", ".join(differing[:5]),
            )
        _compared.add(sent)
    return SentModel(model)
