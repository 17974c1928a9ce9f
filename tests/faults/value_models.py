"""Models written as classes of values: dataclasses, a named tuple and a subclass of an abstract class."""

import abc
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .treacherous import line


@dataclass
class Data:
    factor: float = 2.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return self.factor * line(theta)


@dataclass(frozen=True)
class Frozen:
    factor: float = 2.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return self.factor * line(theta)


@dataclass(slots=True)
class Slotted:
    factor: float = 2.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return self.factor * line(theta)


class Named(NamedTuple):
    factor: float = 2.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return self.factor * line(theta)


class Abstract(abc.ABC):
    @abc.abstractmethod
    def __call__(self, theta: np.ndarray) -> np.ndarray: ...


class Concrete(Abstract):
    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return 2.0 * line(theta)


@dataclass(frozen=True)
class Pooled:
    """Used by one test only, in which no instance was pickled before."""

    factor: float = 2.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        return self.factor * line(theta)
