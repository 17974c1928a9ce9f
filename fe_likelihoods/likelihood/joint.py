"""Log-likelihood of several data sets: one `FELikelihood` for each, with parameters in common.

The data sets are independent given the parameters, so their log-likelihoods are added. A component test and a system
test, or tests of several specimens, then inform the parameters that they have in common. Each likelihood keeps its
model, noise, pool and caches.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..noise.marginal import sampled_noise
from ..priors.points import as_points
from .likelihood import FELikelihood
from .parameters import channels_of_deviations
from .sum_of_data_sets import SumOfDataSets

__all__ = ["JointLikelihood"]


class JointLikelihood(SumOfDataSets):
    """Sum of log-likelihoods of several data sets over the union of their parameters.

    Parameters with the same name are one parameter. `Posterior` accepts the object like an `FELikelihood`. Calling it
    is `log_likelihood`.

    Parameters
    ----------
    likelihoods : mapping of str to FELikelihood
        The likelihoods by name. They are evaluated in this order, and a point at which one is -inf is not simulated for
        the later ones: give cheap models, or those that fail often, first.
    separate : sequence of str, optional
        Names of parameters that each likelihood has for itself, such as the standard deviations of channels with the
        same name: the parameter ``name`` of the likelihood ``key`` is then ``name_key``.

    Attributes
    ----------
    likelihoods : dict of str to FELikelihood
        As given; ``joint[name]`` returns one of them.
    parameter_names : tuple of str
        Structural parameters of all likelihoods in the order of their first appearance, then noise parameters.
    fast_parameters : tuple of int
        Indices of the parameters whose change needs no simulation of any likelihood.

    Raises
    ------
    ValueError
        If there are no likelihoods, one is not an `FELikelihood`, a name stands for different units or different
        nominal values, or for a structural parameter in one likelihood and a noise parameter in another, a name in
        `separate` is unknown, or `separate` gives two parameters one name.

    Notes
    -----
    Units are compared where they are known: units of ``sigma_<channel>`` and ``sigma_<channel>_<event>`` from the
    channels' quantities, nominal values from the models' attribute ``nominal``, and other units from the mapping
    ``parameter_units`` (name to text) that your own model may have.

    Examples
    --------
    >>> second = FELikelihood(LinearOscillator(record, period=0.5), measurements)
    >>> joint = JointLikelihood({"first": likelihood, "second": second}, separate=["damping"])
    >>> joint.parameter_names
    ('stiffness', 'damping_first', 'damping_second', 'sigma_acceleration', 'sigma_displacement')
    """

    def __init__(self, likelihoods: Mapping[str, FELikelihood], *, separate: Sequence[str] = ()) -> None:
        if not isinstance(likelihoods, Mapping) or not likelihoods:
            raise ValueError(
                "JointLikelihood expects a non-empty mapping of names to likelihoods, such as "
                f'{{"component": likelihood_1, "system": likelihood_2}}; got {likelihoods!r}'
            )
        for key, likelihood in likelihoods.items():
            if not isinstance(key, str) or not key or not isinstance(likelihood, FELikelihood):
                raise ValueError(
                    f"JointLikelihood expects an FELikelihood under each name; got {likelihood!r} under {key!r}"
                )
        self.likelihoods = dict(likelihoods)
        self.separate = (separate,) if isinstance(separate, str) else tuple(separate)
        known = {name for likelihood in self.likelihoods.values() for name in likelihood.parameter_names}
        if unknown := [name for name in self.separate if name not in known]:
            raise ValueError(
                f"separate has the unknown parameters {', '.join(unknown)}; the parameters are "
                f"{', '.join(sorted(known))}"
            )
        first: dict[str, tuple[str, str, str]] = {}  # likelihood, name there and kind of each parameter
        units: dict[str, tuple[str, str]] = {}  # likelihood and unit, where it is known
        for kind in ("structural", "noise"):
            for key, likelihood in self.likelihoods.items():
                n_structural = len(likelihood.model.parameter_names)
                names = likelihood.parameter_names
                for name in names[:n_structural] if kind == "structural" else names[n_structural:]:
                    joint, unit = self.name_of(key, name), _unit(likelihood, name)
                    other, source, other_kind = first.setdefault(joint, (key, name, kind))
                    if source != name:
                        raise ValueError(
                            f"separate makes the name {joint!r} of two parameters, {source!r} and {name!r}; rename "
                            "likelihoods"
                        )
                    if kind != other_kind:
                        raise ValueError(
                            f"{joint!r} is a structural parameter in {other!r} and a noise parameter in {key!r}; "
                            "rename one of them, or put the name into separate="
                        )
                    other, expected = units.setdefault(joint, (key, unit)) if unit else (key, unit)
                    if unit != expected:
                        raise ValueError(
                            f"the parameter {joint!r} must have one unit; it is in {expected} in {other!r} and in "
                            f"{unit} in {key!r}: rename it in one of them, give both models one unit or nominal value, "
                            "or put the name into separate="
                        )
        self.parameter_names = tuple(first)
        self._columns = {
            key: [self.parameter_names.index(self.name_of(key, name)) for name in likelihood.parameter_names]
            for key, likelihood in self.likelihoods.items()
        }
        kinds = [kind for *_, kind in first.values()]
        self.fast_parameters = tuple(range(kinds.count("structural"), len(kinds)))

    def __getitem__(self, name: str) -> FELikelihood:
        """One of the likelihoods; ValueError for an unknown name."""
        if name not in self.likelihoods:
            raise ValueError(f"no likelihood {name!r}; the likelihoods are {', '.join(map(repr, self.likelihoods))}")
        return self.likelihoods[name]

    def name_of(self, key: str, name: str) -> str:
        """Name that a parameter of one likelihood has in the joint likelihood."""
        return f"{name}_{key}" if name in self.separate else name

    def with_likelihoods(self, likelihoods: Mapping[str, FELikelihood]) -> "JointLikelihood":
        """The same sum of other likelihoods, some of whose parameters may be missing."""
        left = {name for likelihood in likelihoods.values() for name in likelihood.parameter_names}
        result = JointLikelihood(likelihoods, separate=[name for name in self.separate if name in left])
        result.separate = self.separate  # also names of noise that `draw_noise` draws
        return result

    def samples_of(self, name: str, samples: Any, noise: bool = False) -> dict[str, np.ndarray]:
        """Samples (n,) of the parameters of one likelihood under its own names, with `noise` also of its noise.

        `samples` are (n, ndim) or named values (n,) of all parameters, or without `noise` of the structural ones.
        ValueError if the name is unknown, a parameter is missing, or an array has another shape.
        """
        likelihood = self[name]
        if not isinstance(samples, Mapping):
            structural = self.parameter_names[: self.ndim - len(self.fast_parameters)]
            names = structural if not noise and np.shape(samples)[-1:] == (len(structural),) else self.parameter_names
            samples = dict(zip(names, as_points(samples, names).T, strict=True))
        wanted = list(likelihood.model.parameter_names)
        wanted += sampled_noise(likelihood.noise).parameter_names if noise else ()
        missing = [joint for each in wanted if (joint := self.name_of(name, each)) not in samples]
        if missing:
            raise ValueError(f"the samples have no {', '.join(missing)}, which the likelihood {name!r} needs")
        return {each: np.asarray(samples[self.name_of(name, each)]) for each in wanted}


def _unit(likelihood: FELikelihood, name: str) -> str | None:
    """Unit of a parameter in words, None where it is not known."""
    model = likelihood.model
    if name in model.parameter_names:  # these are optional members of models of the user
        units, nominal = getattr(model, "parameter_units", {}), getattr(model, "nominal", {})
        if name in units:
            return str(units[name])
        return f"multiples of {nominal[name]:.12g}" if isinstance(nominal, Mapping) and name in nominal else None
    channels = channels_of_deviations(likelihood.noise, model.channels)
    return channels[name].si_unit if name in channels else None
