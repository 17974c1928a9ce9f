"""A log-likelihood as a sum over its parts, each of which has one model and one data set."""

from abc import abstractmethod
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ..priors.points import as_points
from ..simulation.faults import TransientReason
from ..simulation.model import split_seconds
from .data_identity import combined_digest

__all__ = ["COUNTS", "SumOfParts"]

COUNTS = (  # numbers of the report, which are added for several parts
    "simulations",
    "verifications",
    "unverified",
    "cache_hits",
    "disk_hits",
    "failure_count",
    "transient_failures",
    "seconds",
)


class SumOfParts:
    """Base class of `FELikelihood`, which is its only part, and `JointLikelihood`. The parts are independent."""

    parameter_names: tuple[str, ...]
    is_modal: ClassVar[bool] = False  # whether the data are natural frequencies and mode shapes

    @abstractmethod
    def parts(self) -> list[tuple[Any, list[int]]]:
        """The likelihoods in the order of their evaluation, with the indices of their parameters."""

    @abstractmethod
    def report(self) -> dict:
        """Summary of the simulations, see `Posterior.report`."""

    def __call__(self, x: Any) -> np.ndarray | float:
        """Same as `log_likelihood`."""
        return self.log_likelihood(x)

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    def log_likelihood(self, x: Any, inside: Any = True) -> np.ndarray | float:
        """Log-likelihood of structural parameters followed by noise parameters.

        Parameters
        ----------
        x : array_like (ndim,) or (n, ndim), or mapping
            A mapping has a value, or n values, for every parameter name.
        inside : bool, or (n,) bool
            Where the prior density is positive; nothing is simulated elsewhere, and the log-likelihood is -inf.

        Returns
        -------
        float or (n,) float
            -inf where a simulation fails, where the noise parameters are impossible for one part (nothing is simulated
            there) and where x is not finite; never NaN. Where one part is -inf, later parts are not simulated.
        """
        points = as_points(x, self.parameter_names)
        rows = points if points.ndim == 2 else points[None]
        total = np.where(inside, np.zeros(len(rows)), -np.inf)
        for part, columns in self.parts():
            left = (total > -np.inf).nonzero()[0]
            if len(left):
                wanted = rows if len(left) == len(rows) else rows[left]
                own = wanted.take(columns, axis=1)
                simulator = part.simulator
                statistics = simulator.run(own[:, : simulator.n_structural], partial(self.possible, wanted))
                total[left] += part.of_statistics(own, statistics)
        return total if points.ndim == 2 else float(total[0])

    def possible(self, rows: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) is finite and has possible noise parameters; nothing is simulated."""
        return np.all([part.possible(rows[:, columns]) for part, columns in self.parts()], axis=0)

    def fault(self, x: Any) -> str:
        """Reason of a failed simulation whose cause is not the model, such as a worker that was killed.

        Parameters
        ----------
        x : array_like (ndim,), or mapping
            A point whose log-likelihood was computed in this process.

        Returns
        -------
        str
            Empty where the simulations succeeded, or a failure is an answer of the model.
        """
        point = as_points(x, self.parameter_names)
        for part, columns in self.parts():
            simulator = part.simulator
            reason = simulator.memory_cache.reason((point[columns][: simulator.n_structural] + 0.0).tobytes())
            if isinstance(reason, TransientReason):
                return split_seconds(reason)[0]
        return ""

    @property
    def data_fingerprint(self) -> str:
        """Hex digest of the samples that are compared: equal for likelihoods of the same data.

        The order of the channels and of data sets has no effect. Times count from the start of each event and missing
        samples do not count, so that it is the same for EQ2 alone and for EQ2 after an EQ1 that is not compared.
        """
        return combined_digest([digest for part, _ in self.parts() for digest in part.data_digests()])

    def __getattr__(self, name: str) -> Any:
        """An entry of the report, such as ``simulations`` or ``failures``."""
        if name not in (*COUNTS, "failures", "failure_reasons"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return self.report()[name]
