r"""Predictions from few simulations and a posterior whose expectations are known (control variates).

A guided run knows its posterior well: expectations of functions of the parameters cost no simulation (the signed sample
of `samplers`). A quantity q of another excitation must be simulated. From simulations at n draws, a Gaussian process
:math:`\hat q` with a linear mean is fitted to the quantity, and the differences of the simulated values are

.. math::

   q(\theta) = \hat q(\theta) + e, \qquad
   E[q] = E_\pi[\hat q] + E[e], \qquad \mathrm{Var}[q] = \mathrm{Var}_\pi[\hat q] + \mathrm{Var}[e],

where e has the distribution of the leave-one-out errors of the process, which scatter about zero. The Monte Carlo error
of a mean is thus the scatter of e over :math:`\sqrt n`, not the scatter of q. Where the quantity is close to linear
over the posterior, thirty simulations are worth hundreds of draws; where the emulator explains nothing, they are worth
thirty.

The regression estimator is in Owen, A. B. (2013), Monte Carlo theory, methods and examples, section 8.9.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..checks.transfer import check_emulated
from ..emulation.gaussian_process import GaussianProcess, fit_process, left_out_errors, predict_mean
from .prediction import Prediction
from .propagation import propagate

__all__ = ["propagate_few"]

FEWEST = 20  # simulations
FOLDS = 10  # of the jackknife


def propagate_few(
    posterior_or_model: Any,
    sample: Any,
    *,
    quantity: Any,
    simulations: int = 30,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    seed: int | None = 1,
    **options: Any,
) -> Prediction:
    """Predict numbers of the response from few simulations and the signed sample of a guided run.

    Parameters
    ----------
    posterior_or_model : Posterior, FELikelihood or Model
        The object to predict with, as in `propagate`.
    sample : SignedSample
        ``sampler.signed_sample``: points (m, ndim) ``coords`` with ``weights`` of both signs.
    quantity : ChannelQuantity, several of them, or callable
        ``peak("top")``, or a function of the response (n_channels, n_steps) [SI] that returns a number or an array
        (k,).
    simulations : int
        Number of simulations, at least 20 and three more than twice the parameters of the model.
    quantiles : sequence of float
        Probabilities of the quantiles.
    seed : int, optional
        Seed of the draws.
    **options
        ``record``, ``model``, ``from_state``, ``cache``, ``pool`` and other options of `propagate`. There is no noise:
        the quantity is that of the simulated response.

    Returns
    -------
    Prediction
        ``values`` are the simulated ones; mean, variance, quantiles and their errors are those of the emulated quantity
        and its differences. ``effective_sample_size`` is the number of independent draws that would give the mean with
        the same error (the smallest one of several numbers).

    Raises
    ------
    ValueError
        For a sample without weights, too few simulations, noise, or a quantity that is a history.

    Notes
    -----
    Thirty draws show nothing of a rare part of the posterior: where the quantity changes only there (a collapse or a
    threshold with a probability below about 3 / `simulations`), mean and errors are too small, without a sign.

    Examples
    --------
    >>> few = SMCSampler(40, posterior.ndim, posterior, vectorize=True, guide=posterior.guide(), seed=1)
    >>> state = few.run_mcmc(None, 1)
    >>> stronger = record.scale(1.2)
    >>> predicted = propagate_few(posterior, few.signed_sample, quantity=peak("displacement"), record=stronger)
    >>> len(predicted.values), predicted.mean.round(3)  # doctest: +SAMPLED
    (30, np.float64(0.099))
    """
    if not all(hasattr(sample, name) for name in ("coords", "weights", "rounds", "expectation")):
        raise ValueError(
            "expected sampler.signed_sample of a run with guide=posterior.guide(); it is None for a run without a "
            f"guide, and for a guide without emulator: use propagate with the chain; got {type(sample).__name__}"
        )
    if options.get("noise") or "effective_sample_size" in options or isinstance(quantity, Mapping):
        raise ValueError(
            "expected one quantity of the response, without noise= and effective_sample_size=: predict measured values "
            "with propagate and the chain"
        )
    model = getattr(posterior_or_model, "likelihood", posterior_or_model)
    d = len(getattr(model, "model", model).parameter_names)
    least = max(FEWEST, 2 * d + 3)
    if simulations < least:
        raise ValueError(f"expected at least {least} simulations for {d} parameters; got {simulations}")
    if (
        quantity is None
        or isinstance(quantity, str)
        or (isinstance(quantity, list | tuple) and isinstance(quantity[0], str))
    ):
        raise ValueError(
            f'quantity must be numbers of the response, such as peak("top"), not histories; got {quantity!r}'
        )
    known = np.flatnonzero(sample.rounds == 0)
    share = sample.weights[known] / sample.weights[known].sum()
    rng = np.random.default_rng(seed)
    chosen = rng.choice(known, simulations, p=share, replace=np.count_nonzero(share) < simulations)
    drawn = propagate(
        posterior_or_model, sample.coords[chosen], quantity=quantity, quantiles=quantiles, seed=seed, **options
    )
    succeeded = np.delete(np.arange(simulations), drawn.failed)
    if len(succeeded) < least:
        raise ValueError(f"expected at least {least} simulations that succeed; got {len(succeeded)} of {simulations}")
    inputs = _whitened(sample.coords[:, :d], known, share)
    rows, values = chosen[succeeded], drawn.values.reshape(len(succeeded), -1)
    scale = values.std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    process = fit_process(inputs[rows], values / scale, np.ones(len(scale)))
    unexplained = float(np.square(left_out_errors(process)[0]).mean(axis=0).max())
    which = rng.integers(len(rows), size=len(inputs))
    result, error = _estimates(sample, inputs, process, which, quantiles)
    folds, without = np.arange(len(rows)) % FOLDS, []
    for fold in range(FOLDS):
        kept = folds != fold
        part = fit_process(inputs[rows[kept]], values[kept] / scale, np.ones(len(scale)), process.log_scales, 0)
        without.append(_estimates(sample, inputs, part, which % kept.sum(), quantiles)[0])
    error = np.hypot(error, np.sqrt(FOLDS - 1) * np.std(without, axis=0))
    result, error = result * scale, error * scale
    shape = np.shape(drawn.mean)
    mean, variance, standard_error = (x.reshape(shape) for x in (result[0], np.square(result[1]), error[0]))
    equal = bool((values == values[0]).all(axis=0).any())
    unknown = int(np.isnan(variance).sum())
    return replace(
        drawn,
        mean=mean,
        variance=variance,
        standard_error=standard_error,
        quantiles=result[2:].reshape(-1, *shape),
        quantile_error=error[2:].reshape(-1, *shape),
        effective_sample_size=float(len(values) if equal else np.min(variance / np.square(standard_error))),
        findings=(*drawn.findings, *check_emulated(len(values), equal, unexplained, unknown)),
    )


def _whitened(thetas: np.ndarray, known: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Parameters (m, d) in coordinates whose covariance over the known density is the identity."""
    mean = share @ thetas[known]
    apart = thetas - mean
    scale = np.sqrt(share @ np.square(apart[known]))
    correlation = (apart[known] / scale).T @ (share[:, None] * (apart[known] / scale))
    return np.linalg.solve(np.linalg.cholesky(correlation), (apart / scale).T).T


def _estimates(
    sample: Any, inputs: np.ndarray, process: GaussianProcess, which: np.ndarray, quantiles: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean, standard deviation and quantiles, (2 + p, k), and their errors from the signed sample alone.

    `which` (m,) numbers the leave-one-out error that each point gets.
    """
    values = predict_mean(process, inputs) + left_out_errors(process)[0][which]
    of_quantity = sample._replace(coords=values)
    found = [of_quantity.expectation(), of_quantity.standard_deviation(), *map(of_quantity.quantile, quantiles)]
    return np.array([each.value for each in found]), np.array([each.error for each in found])
