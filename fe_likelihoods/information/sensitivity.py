r"""Which parameters a quantity of the response depends on over the prior: Sobol indices.

For independent parameters the variance of a quantity q is a sum of parts. The first-order index of a parameter is the
part of it alone, and the total index also contains its interactions with the other parameters:

.. math::

   S_i = \frac{\mathrm{Var}[E[q \mid \theta_i]]}{\mathrm{Var}[q]}, \qquad
   T_i = 1 - \frac{\mathrm{Var}[E[q \mid \theta_{\sim i}]]}{\mathrm{Var}[q]}.

A Gaussian process (`fe_likelihoods.emulation.gaussian_process`) is fitted to the quantity at simulations over the
prior, and `scipy.stats.sobol_indices` evaluates it. The error of the process is known from the runs that are left out.
Reference: A. Saltelli et al. (2010), Variance based sensitivity analysis of model output, Computer Physics
Communications 181, 259-270, doi:10.1016/j.cpc.2009.09.018.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..emulation.gaussian_process import fit_process, predict
from ..likelihood.posterior import Posterior
from ..prediction.quantities import Quantity, evaluator
from ..priors.distributions import Distribution
from ..priors.priors import Prior
from ..simulation.model import Model, most_responses, simulate_batch
from ..text_tables import number, text_table

if TYPE_CHECKING:
    import pandas

FOLDS = 8  # of the jackknife
DESIGN, DESIGNS = 2**10, 8  # points of the emulator per scrambled Sobol design, and designs


class Sensitivity(NamedTuple):
    """Sobol indices of k numbers for d parameters; ``str`` is a table.

    Attributes
    ----------
    parameter_names : tuple of str
        Names of the parameters.
    first, first_error, total, total_error : (k, d) float
        First-order and total indices [-], and their standard errors, which include the error of the emulator.
    mean, sd : (k,) float
        Mean and standard deviation of the simulated numbers over the prior [SI].
    unexplained : (k,) float
        Share of the variance that the emulator does not explain at simulations that were left out [-].
    simulations, failed : int
        Simulations, and how many of them failed.
    """

    parameter_names: tuple[str, ...]
    first: np.ndarray
    first_error: np.ndarray
    total: np.ndarray
    total_error: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    unexplained: np.ndarray
    simulations: int
    failed: int

    def __str__(self) -> str:
        rows = [["parameter"]]
        rows += [[name] for name in self.parameter_names]
        for k in range(len(self.mean)):
            text = f" {k + 1}" if len(self.mean) > 1 else ""
            rows[0] += [f"first{text}", f"total{text}"]
            for i, row in enumerate(rows[1:]):
                row += [f"{max(self.first[k, i], 0.0):.2f} ± {self.first_error[k, i]:.2f}"]
                row += [f"{max(self.total[k, i], 0.0):.2f} ± {self.total_error[k, i]:.2f}"]
        shares = ", ".join(f"{number(100.0 * share, 2)} %" for share in self.unexplained)
        lines = [text_table(rows), f"From {self.simulations} simulations; the emulator leaves {shares} unexplained."]
        return "\n".join(lines)

    __repr__ = __str__

    def to_dataframe(self) -> "pandas.DataFrame":
        """The indices as a `pandas.DataFrame`, with a row for each quantity and parameter."""
        import pandas

        index = pandas.MultiIndex.from_product(
            [range(len(self.mean)), self.parameter_names], names=["quantity", "parameter"]
        )
        names = ("first", "first_error", "total", "total_error")
        return pandas.DataFrame({name: np.ravel(getattr(self, name)) for name in names}, index=index)


def sensitivity(
    model: Model,
    prior: Posterior | Prior | Mapping[str, Distribution],
    quantity: Quantity,
    *,
    simulations: int = 128,
    seed: int = 1,
    pool: Any = None,
) -> Sensitivity:
    """Sobol indices of quantities of the response, over the prior.

    Parameters
    ----------
    model : Model
    prior : Posterior, Prior, or mapping of parameter names to distributions
        With at least the parameters of the model, which must be independent; others are left out.
    quantity : ChannelQuantity, several of them, or callable
        ``peak("top")``, or a function of the response (n_channels, n_steps) [SI] that returns a number or an array
        (k,).
    simulations : int
        Number of simulations, a Latin hypercube of the prior. At least ten for each parameter.
    seed : int
        Seed of the draws.
    pool : object with ``map(function, items)``, optional
        Runs the simulations.

    Returns
    -------
    Sensitivity

    Raises
    ------
    ValueError
        If there are too few simulations that succeed, parameters have a joint prior, the quantity is a history, or it
        does not vary.

    Notes
    -----
    The standard errors combine the spread between eight scrambled designs of the emulator, the jackknife over eighths
    of the simulations, and the share of the variance that the emulator does not explain, which may belong to any
    parameter.

    Examples
    --------
    >>> print(sensitivity(model, prior, peak("displacement"), simulations=60))  # doctest: +SAMPLED
    parameter        first        total
    stiffness  0.21 ± 0.03  0.29 ± 0.02
    damping    0.71 ± 0.02  0.79 ± 0.03
    From 60 simulations; the emulator leaves 0.43 % unexplained.
    """
    given = getattr(prior, "prior", prior)
    known = (given if isinstance(given, Prior) else Prior(given)).subset(model.parameter_names)
    if joint := [key for key in known.distributions if isinstance(key, tuple)]:
        raise ValueError(
            f"Sobol indices are defined for independent parameters; {', '.join(joint[0])} have a joint prior: give "
            "independent distributions"
        )
    function = evaluator(quantity, model.channels, model.dt, model.n_steps).function
    if function is None:
        raise ValueError(
            f'quantity must be numbers of the response, such as peak("top"), not histories; got {quantity!r}'
        )
    d = known.dim
    if simulations < 10 * d:
        raise ValueError(f"expected at least {10 * d} simulations for {d} parameters; got {simulations}")
    from scipy.stats import qmc

    thetas = known.transform(qmc.LatinHypercube(d, seed=seed).random(simulations))
    values = _values(model, thetas, function, pool)
    good = np.isfinite(values).all(axis=1)
    if good.sum() < 5 * d:
        raise ValueError(
            f"expected at least {5 * d} simulations that succeed; got {good.sum()} of {simulations}: narrow the prior, "
            "or see why simulations fail (check_model)"
        )
    values, inputs = values[good], _inputs(known, thetas[good])
    mean, sd = values.mean(axis=0), values.std(axis=0)
    if not (sd > 1e-12 * np.abs(mean)).all():
        raise ValueError("expected quantities that vary over the prior; at least one is the same at all simulations")
    outputs = (values - mean) / sd
    process = fit_process(inputs, outputs, np.ones(len(sd)))
    designs = [qmc.Sobol(2 * d, seed=seed + k).random(DESIGN) for k in range(DESIGNS)]
    found = np.array([_indices(known, design, process) for design in designs])
    numbers = np.arange(len(inputs)) % FOLDS
    without = []
    for fold in range(FOLDS):
        kept = numbers != fold
        part = fit_process(inputs[kept], outputs[kept], np.ones(len(sd)), process.log_scales)
        without.append(_indices(known, designs[0], part))
    errors = np.hypot(np.sqrt(FOLDS - 1) * np.std(without, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(DESIGNS))
    unexplained = np.square(process.left_out).mean(axis=0)
    errors = np.hypot(errors, unexplained[:, None])  # this part of the variance may belong to any parameter
    first, total = found.mean(axis=0)
    return Sensitivity(
        known.names,
        first,
        errors[0],
        total,
        errors[1],
        mean,
        sd,
        unexplained,
        simulations,
        int((~good).sum()),
    )


def _values(model: Model, thetas: np.ndarray, function: Callable, pool: Any) -> np.ndarray:
    """Quantities (n, k) at parameters (n, d), NaN where the simulation failed."""
    rows, size = [], most_responses(model)
    for start in range(0, len(thetas), size):
        batch = simulate_batch(model, thetas[start : start + size], pool)
        failed = [bool(reason) for reason in batch.reasons]
        rows += [None if f else np.ravel(function(r)) for r, f in zip(batch.response, failed, strict=True)]
    width = next((len(row) for row in rows if row is not None), 1)
    return np.array([np.full(width, np.nan) if row is None else row for row in rows], dtype=float)


def _inputs(prior: Prior, thetas: np.ndarray) -> np.ndarray:
    """Parameters (n, d) in units of their prior standard deviation; logarithms where the prior is lognormal."""
    low, middle, high = prior.from_normal(np.array([[-1.0], [0.0], [1.0]]) * np.ones(prior.dim))
    scaled = (thetas - middle) / (0.5 * (high - low))
    for i in np.flatnonzero(prior.logarithmic):
        scaled[:, i] = np.log(thetas[:, i] / middle[i]) / np.log(high[i] / middle[i])
    return scaled


def _indices(prior: Prior, draws: np.ndarray, process: Any) -> np.ndarray:
    """First-order and total indices (2, k, d) of an emulator, from uniform numbers (n, 2 d) of two designs."""
    from scipy.stats import sobol_indices

    d = prior.dim
    first, second = draws[:, :d], draws[:, d:]

    def emulated(u: np.ndarray) -> np.ndarray:
        return predict(process, _inputs(prior, prior.transform(u))).T

    mixed = []
    for i in range(d):
        u = first.copy()
        u[:, i] = second[:, i]
        mixed.append(emulated(u))
    values = {"f_A": emulated(first), "f_B": emulated(second), "f_AB": np.array(mixed)}
    found = sobol_indices(func=values, n=len(draws))
    return np.stack([np.atleast_2d(found.first_order), np.atleast_2d(found.total_order)])
