"""A log-likelihood as a sum over its data sets, each of which has one model; most have one data set."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np

from ..noise.known import KnownNoise
from ..noise.marginal import MarginalNoise
from ..priors.distributions import Distribution, RandomState, as_generator
from ..priors.multivariate import as_distribution
from ..priors.points import as_points
from .histories import Histories
from .parameters import Parameter, describe_parameters

__all__ = ["COUNTS", "SumOfDataSets"]

COUNTS = (  # numbers of the report, which are added for several data sets
    "simulations",
    "verifications",
    "unverified",
    "cache_hits",
    "disk_hits",
    "failure_count",
    "transient_failures",
    "seconds",
)


class SumOfDataSets:
    """Base class of `FELikelihood`, which is its only data set, and `JointLikelihood`, whose data are independent."""

    parameter_names: tuple[str, ...]
    fast_parameters: tuple[int, ...]
    is_modal: ClassVar[bool] = False  # whether the data are natural frequencies and mode shapes

    likelihoods: Mapping[str, Any]  # an `FELikelihood` for each, in the order of their evaluation; "" for the only one
    _columns: dict[str, list[int]]  # indices of their parameters

    def data_sets(self) -> list[tuple[Any, list[int]]]:
        """The data sets in the order of their evaluation, with the indices of their parameters."""
        return [(likelihood, self._columns[key]) for key, likelihood in self.likelihoods.items()]

    def name_of(self, key: str, name: str) -> str:
        """Name that a parameter of a data set has here."""
        return name

    def with_likelihoods(self, likelihoods: Mapping[str, Any]) -> Self:
        """The same likelihood with other data sets under the same names."""
        return next(iter(likelihoods.values()), self)

    def with_known(self, known: Mapping[str, float]) -> Self:
        """The same likelihood with known values of parameters of the noise, which are parameters no more.

        ValueError if one is another parameter.
        """
        noise = [self.parameter_names[place] for place in self.fast_parameters]
        if others := [name for name in known if name not in noise]:
            raise ValueError(
                f"a number in the prior is a known parameter of the noise; the noise has no {', '.join(others)}, its "
                f"parameters are {', '.join(noise) or 'none'}: fix others in the model, or give a distribution"
            )
        return self._with_noises(lambda noise, own: KnownNoise(noise, own) if own else noise, known)

    def _with_noises(self, make: Callable[[Any, dict], Any], values: Mapping[str, Any]) -> Self:
        """The same likelihood with noises made of each noise, and of the values of its parameters by its own names."""
        found = {}
        for key, data_set in self.likelihoods.items():
            names = ((name, self.name_of(key, name)) for name in data_set.noise.parameter_names)
            noise = make(data_set.noise, {name: values[ours] for name, ours in names if ours in values})
            found[key] = data_set if noise is data_set.noise else data_set.with_noise(noise)
        return self.with_likelihoods(found)

    # densities ----------------------------------------------------------------------------------------------------

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
            -inf where a simulation fails, where the noise parameters are impossible for one data set (nothing is
            simulated there) and where x is not finite; never NaN. Where one is -inf, later ones are not simulated.
        """
        points = as_points(x, self.parameter_names)
        rows = points if points.ndim == 2 else points[None]
        total = np.where(inside, np.zeros(len(rows)), -np.inf)
        for data_set, columns in self.data_sets():
            left = (total > -np.inf).nonzero()[0]
            if len(left):
                wanted = rows if len(left) == len(rows) else rows[left]
                own = wanted.take(columns, axis=1)
                simulator = data_set.simulator
                statistics = simulator.run(own[:, : simulator.n_structural], partial(self.possible, wanted))
                total[left] += data_set.of_statistics(own, statistics)
        return total if points.ndim == 2 else float(total[0])

    def possible(self, rows: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) is finite and has possible noise parameters; nothing is simulated."""
        return np.all([data_set.possible(rows[:, columns]) for data_set, columns in self.data_sets()], axis=0)

    def failures_at(self, x: Any) -> list[str]:
        """Reasons of failed simulations at points, after the name of the data set, see `Posterior.failures_at`."""
        found, logs = [], {key: each.simulator.failures for key, each in self.likelihoods.items()}
        for point in np.atleast_2d(as_points(x, self.parameter_names)):
            reasons = {key: log.reason_at(point[self._columns[key]]) for key, log in logs.items()}
            key, reason = next(((key, reason) for key, reason in reasons.items() if reason), ("", ""))
            found.append(type(reason)(f"{key}: {reason}") if key else reason)
        return found

    def recall_failures(self, x: Any, reasons: Sequence[str]) -> None:
        """Count simulations of an earlier process, see `Posterior.recall_failures`."""
        points, reasons = np.atleast_2d(as_points(x, self.parameter_names)), np.array(reasons, dtype=object)
        for key, data_set in self.likelihoods.items():
            name = f"{key}: " if key else ""
            own = [each[len(name) :] if each.startswith(name) else "" for each in reasons]
            thetas = points[:, self._columns[key]][:, : data_set.simulator.n_structural]
            data_set.simulator.recall(thetas, None, own)
            left = [not each for each in own]  # later data sets were not simulated where this one failed
            points, reasons = points[left], reasons[left]

    def histories(self) -> Histories:
        """The residual histories of all data sets as those of one; ValueError if no emulator can predict them."""
        return Histories(self)

    def first_parts(self, shares: Sequence[float]) -> list[Any]:
        """None: several data sets have no common record."""
        return []

    # description --------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Units, nominal values and labels of the parameters."""
        described: dict[str, Parameter] = {}
        for key, data_set in self.likelihoods.items():
            for each in describe_parameters(data_set.model, data_set.noise):
                name = self.name_of(key, each.name)
                described.setdefault(name, each._replace(name=name))
        return tuple(described[name] for name in self.parameter_names)

    @property
    def data_fingerprint(self) -> str:
        """Hex digest of the samples that are compared: equal for likelihoods of the same data.

        Neither the order of channels, events and data sets nor missing samples have an effect, so that it is the same
        for EQ2 alone and for EQ2 after an EQ1 that is not compared.
        """
        samples: dict[str, list[np.ndarray]] = {}
        for data_set in self.likelihoods.values():
            data, compared = data_set.measurements, getattr(data_set.measured, "values", data_set.measured)
            for channel, dt, row in zip(data.channels, data.steps, compared, strict=True):
                name = f"{channel.name} {channel.quantity} {dt:.9g}"
                samples.setdefault(name, []).append(row[~np.isnan(row)] + 0.0)
        digest = hashlib.blake2b(digest_size=16)
        for name, rows in sorted(samples.items()):
            digest.update(f"{name} {sum(map(len, rows))} ".encode() + np.sort(np.concatenate(rows)).tobytes())
        return digest.hexdigest()

    def density_parts(self) -> list[str]:
        """Texts that identify the density; ValueError if the ``repr`` of a noise does not show its values."""
        found = list(self.parameter_names)
        for data_set, columns in self.data_sets():
            found += [json.dumps(columns), *data_set.density_parts()]
        return found

    def report(self) -> dict:
        """Summary of all simulations, and of several likelihoods one for each, see `Posterior.report`."""
        found = {key: data_set.simulator.report() for key, data_set in self.likelihoods.items()}
        if "" in found:
            return found[""]
        total = {name: sum(each[name] for each in found.values()) for name in COUNTS}
        total["failures"] = [
            {"likelihood": key, **failure} for key, own in found.items() for failure in own["failures"]
        ]
        total["failure_reasons"] = dict(sum((Counter(each["failure_reasons"]) for each in found.values()), Counter()))
        return total | {"likelihoods": found}

    def __getattr__(self, name: str) -> Any:
        """An entry of the report, such as ``simulations`` or ``failures``."""
        if name not in (*COUNTS, "failures", "failure_reasons"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return self.report()[name]

    # noise that is integrated out ---------------------------------------------------------------------------------

    def marginal(self, priors: Mapping[str, Distribution]) -> Self:
        """The same likelihood with the standard deviations of white noise integrated out, see `Posterior.marginal`.

        `priors` are those of the noise parameters; others may be among them. ValueError also if a noise parameter has a
        joint prior distribution with others, or belongs to several data sets: its integral is not a product.
        """
        noise = [self.parameter_names[place] for place in self.fast_parameters]
        if correlated := [name for name in noise if name not in priors]:
            raise ValueError(
                f"{', '.join(correlated)} have a joint prior distribution and cannot be integrated out; give them "
                "independent priors"
            )
        owners = Counter(column for _, columns in self.data_sets() for column in columns)
        if shared := [self.parameter_names[place] for place in self.fast_parameters if owners[place] > 1]:
            raise ValueError(
                f"{', '.join(shared)} belong to several likelihoods and cannot be integrated out; give each likelihood "
                f"its own with separate={shared!r}"
            )
        priors = {name: as_distribution(name, priors[name]) for name in noise}
        return self._with_noises(MarginalNoise, priors)

    def draw_noise(self, x: Any, rng: RandomState = None) -> dict[str, np.ndarray]:
        """Complete samples (n,) of all parameters from structural ones (n, ndim), see `Posterior.draw_noise`."""
        for data_set in self.likelihoods.values():
            if not isinstance(data_set.noise, MarginalNoise):
                raise ValueError(
                    f"the noise parameters {', '.join(data_set.noise.parameter_names)} are in the samples of this "
                    "posterior; draw_noise is for posteriors from which they are integrated out, see marginal()"
                )
        points = np.atleast_2d(as_points(x, self.parameter_names))
        rng = as_generator(rng)
        named = dict(zip(self.parameter_names, points.T, strict=True))
        for key, data_set in self.likelihoods.items():
            names, own = data_set.noise.noise.parameter_names, points[:, self._columns[key]]
            uniform = rng.random((len(own), len(names)))
            drawn = data_set.noise.draw(data_set.misfit(own), data_set.n_samples, uniform)
            named |= {self.name_of(key, name): sigmas for name, sigmas in zip(names, drawn.T, strict=True)}
        return named
