"""What a figure of posterior samples shows: the chosen parameters, their labels and units, and the marked values.

Units, nominal values and labels are those of ``posterior.parameters``, where the posterior has them. Without them the
labels are ``posterior.parameter_names``, or else x0, x1, ...
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .inspection import described_parameters_of, distributions_of, prior_of

__all__ = ["Drawn", "PriorMarginals", "Values", "choose_parameters", "panel_limits"]

Values = Sequence[float] | Mapping[str, float]
"""One number per parameter, NaN where there is none, or numbers by the names of some parameters."""

PRIOR_DRAWS = 20_000


class Drawn(NamedTuple):
    """Parameters of a figure; all values in the units of the labels.

    Attributes
    ----------
    names, labels : tuple of str
        One per drawn parameter.
    samples : dict of str to ndarray, shape (n, k)
        Samples of the drawn parameters, by the label of the sampler; the label is empty for samples without one.
    truths, nominal : ndarray, shape (k,)
        Values to mark; NaN where there is none.
    prior : PriorMarginals, optional
        Prior densities; None where the posterior has no prior.
    note : str
        What the figure leaves out; empty if it shows all parameters.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    samples: dict[str, np.ndarray]
    truths: np.ndarray
    nominal: np.ndarray
    prior: "PriorMarginals | None"
    note: str


class PriorMarginals:
    """Marginal prior densities of the drawn parameters, in the units of the labels.

    Parameters
    ----------
    prior : object
        With ``distributions`` (a mapping of names to objects with ``logpdf``), ``rvs(size, random_state)``, or both.
        The density of a parameter without a distribution of its own is estimated from draws.
    names : sequence of str
        Names of the drawn parameters.
    columns : sequence of int
        Their places among all parameters.
    factors : ndarray, shape (k,)
        Units of the labels, in the units of the samples.
    """

    def __init__(self, prior: Any, names: Sequence[str], columns: Sequence[int], factors: np.ndarray) -> None:
        self._distributions = distributions_of(prior)
        self._names, self._factors = tuple(names), np.asarray(factors, dtype=float)
        # a fixed seed: the same figure whenever it is drawn
        self.draws = np.asarray(prior.rvs(PRIOR_DRAWS, 0), dtype=float)[:, list(columns)] / self._factors

    def density(self, k: int, values: np.ndarray) -> np.ndarray:
        """Density of the k-th drawn parameter at values (n,), per unit of its label."""
        distribution = self._distributions.get(self._names[k])
        if distribution is not None:
            return np.exp(distribution.logpdf(values * self._factors[k])) * self._factors[k]
        kernel = _kernel_density(self.draws[:, k])
        return np.zeros(len(values)) if kernel is None else kernel(values)

    def bounds(self) -> np.ndarray:
        """Bounds (k, 2) of the drawn parameters; infinite where there is none or it is not known."""
        distributions = [self._distributions.get(name) for name in self._names]
        bounds = [getattr(each, "bounds", (-np.inf, np.inf)) for each in distributions]
        return np.array(bounds, dtype=float) / self._factors[:, None]

    def spread(self, k: int) -> float:
        """Standard deviation of the k-th drawn parameter."""
        return float(self.draws[:, k].std())


def _kernel_density(values: np.ndarray) -> Callable | None:
    from scipy.stats import gaussian_kde

    return gaussian_kde(values) if np.ptp(values) > 0.0 else None


def choose_parameters(
    samples: Any,
    posterior: Any = None,
    *,
    truths: Values | None = None,
    nominal: Values | None = None,
    prior: bool = True,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    max_parameters: int | None = None,
) -> Drawn:
    """Check the arguments of a figure, and convert what it shows to the units of its labels.

    Parameters
    ----------
    samples : array_like, shape (n, ndim), or mapping of str to array_like
        Samples of one sampler, or of several by their labels.
    posterior : Posterior, optional
        See the module.
    truths, nominal : sequence of float, shape (ndim,), or mapping of str to float, optional
        Values to mark, in the units of the samples. Default of `nominal`: those of ``posterior.parameters``.
    prior : bool
        Whether prior densities are wanted.
    names : sequence of str, optional
        Names of the parameters to draw. Default: all, or the first `max_parameters`.
    labels : sequence of str, shape (ndim,), optional
        Labels of all parameters, instead of those of the posterior.
    max_parameters : int, optional
        Largest number of parameters that are drawn without `names`.

    Returns
    -------
    Drawn

    Raises
    ------
    ValueError
        If the samples have different numbers of parameters or are not finite, if there are less than two of them, if
        the number of labels or values is wrong, or if a name is unknown.
    """
    arrays = {str(label): _checked(x, label) for label, x in _by_label(samples).items()}
    widths = {label: x.shape[1] for label, x in arrays.items()}
    if len(set(widths.values())) > 1:
        raise ValueError(f"all samples must have the same parameters; the numbers of columns are {widths}")
    ndim = next(iter(widths.values()))
    parameters = described_parameters_of(posterior, ndim)
    if labels is not None and len(labels) != ndim:
        raise ValueError(f"expected one label for each of {ndim} parameters; got {len(labels)}: {list(labels)}")
    known = [parameter.name for parameter in parameters]
    if labels is not None and posterior is None:
        known = list(labels)
    columns, note = _columns(known, names, max_parameters)
    chosen = [parameters[i] for i in columns]
    factors = np.array([parameter.factor for parameter in chosen])
    marked = [
        _values(given, known, what)[columns] / factors
        for given, what in (
            (truths, "truths"),
            (nominal if nominal is not None else [parameter.nominal for parameter in parameters], "nominal"),
        )
    ]
    source = prior_of(posterior) if prior else None
    chosen_names = tuple(known[i] for i in columns)
    return Drawn(
        chosen_names,
        tuple(parameter.label if labels is None else labels[i] for i, parameter in zip(columns, chosen, strict=True)),
        {label: x[:, columns] / factors for label, x in arrays.items()},
        *marked,
        None if source is None else PriorMarginals(source, chosen_names, columns, factors),
        note,
    )


def _by_label(samples: Any) -> Mapping[str, Any]:
    if not isinstance(samples, Mapping):
        return {"": samples}
    if not samples:
        raise ValueError("no samples to draw: pass an array (n, ndim), or a mapping of labels to such arrays")
    return samples


def _checked(samples: Any, label: str) -> np.ndarray:
    samples, where = np.asarray(samples, dtype=float), f" of {label!r}" if label else ""
    if samples.ndim != 2 or len(samples) < 2 or samples.shape[1] < 1:
        raise ValueError(
            f"samples{where} must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got "
            f"{samples.shape}"
        )
    if not np.isfinite(samples).all():
        raise ValueError(
            f"samples{where} must be finite; {np.count_nonzero(~np.isfinite(samples).all(axis=1))} of {len(samples)} "
            "rows are not: leave these rows out"
        )
    return samples


def _columns(known: list[str], names: Sequence[str] | None, most: int | None) -> tuple[list[int], str]:
    """Places of the parameters to draw, and what is left out in words."""
    if names is None:
        if most is None or len(known) <= most:
            return list(range(len(known))), ""
        return list(range(most)), f"the first {most} of {len(known)} parameters; names= chooses others"
    wanted = [names] if isinstance(names, str) else list(names)
    if not wanted or (unknown := [name for name in wanted if name not in known]):
        what = f"unknown: {', '.join(map(str, unknown))}" if wanted else "got none"
        raise ValueError(f"names must be some of the parameters {', '.join(known)}; {what}")
    return [known.index(name) for name in wanted], ""


def _values(given: Values | None, known: list[str], what: str) -> np.ndarray:
    """Values to mark, one per parameter."""
    if given is None:
        return np.full(len(known), np.nan)
    if isinstance(given, Mapping):
        if unknown := [name for name in given if name not in known]:
            raise ValueError(f"{what}: unknown parameters {', '.join(unknown)}; known are {', '.join(known)}")
        return np.array([given.get(name, np.nan) for name in known], dtype=float)
    values = np.asarray([np.nan if value is None else value for value in given], dtype=float)
    if values.shape != (len(known),):
        raise ValueError(
            f"{what} must have one value for each of {len(known)} parameters (NaN for no mark), or be a mapping of "
            f"names to values; got shape {values.shape}"
        )
    return values


def panel_limits(samples: Mapping[str, np.ndarray], truths: np.ndarray, margin: float = 0.12) -> np.ndarray:
    """Limits (k, 2) of the panels: those of the samples, widened by up to half of their size to show a true value.

    Parameters
    ----------
    samples : mapping of str to ndarray, shape (n, k)
    truths : ndarray, shape (k,)
    margin : float
        Empty space at both sides, as a share of the size.
    """
    quantiles = np.array([np.quantile(x, [0.002, 0.998], axis=0) for x in samples.values()])
    low, high = quantiles[:, 0].min(axis=0), quantiles[:, 1].max(axis=0)
    size = high - low
    near = (truths > low - 0.5 * size) & (truths < high + 0.5 * size)
    low, high = np.where(near, np.fmin(low, truths), low), np.where(near, np.fmax(high, truths), high)
    space = np.where(high > low, margin * (high - low), np.maximum(0.05 * np.abs(low), 1e-12))
    return np.column_stack([low - space, high + space])
