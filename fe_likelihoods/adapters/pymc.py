"""Adapter for PyMC: a `pymc.Model` with PyMC's distributions as priors and the log-likelihood as a black box.

Models that know the derivatives of their response (``jacobian``) have a gradient, so that `pymc.sample` uses NUTS.
Without one, only samplers that need no gradient can be used: `pymc.sample_smc`, which gives the evidence, and
`pymc.sample` with the step method `pymc.DEMetropolisZ`, `pymc.Metropolis` or `pymc.Slice`.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numpy as np

from ..likelihood.posterior import Posterior
from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform

if TYPE_CHECKING:
    import pymc


def to_pymc(posterior: Posterior) -> pymc.Model:
    """Convert a posterior to a PyMC model, with one free variable per parameter, of the same name.

    The log-likelihood is a Potential named ``log_likelihood``. PyMC evaluates one point at a time, so models that
    simulate batches of points in parallel gain nothing from it.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    pymc.Model

    Raises
    ------
    ValueError
        If a prior is not one of `fe_likelihoods.priors.distributions`, or a parameter is named ``log_likelihood``.

    Examples
    --------
    >>> with to_pymc(posterior):  # doctest: +SKIP
    ...     trace = pymc.sample_smc(2000)

    >>> with to_pymc(posterior):  # the oscillator knows its derivatives  # doctest: +SKIP
    ...     trace = pymc.sample(1000, chains=4)  # NUTS

    Pass starting points where the posterior is not zero; the default starting point of PyMC may be elsewhere:

    >>> starts = [dict(zip(posterior.parameter_names, x)) for x in posterior.sample_prior(4)]
    >>> with to_pymc(posterior):  # doctest: +SKIP
    ...     trace = pymc.sample(3000, tune=3000, step=pymc.DEMetropolisZ(), initvals=starts, chains=4)
    """
    import pymc
    import pytensor.tensor

    if "log_likelihood" in posterior.parameter_names:
        raise ValueError(
            "a parameter is named 'log_likelihood', which to_pymc uses for the likelihood: rename the parameter"
        )
    with pymc.Model() as model:
        parameters = [_translated(name, d) for name, d in posterior.prior.distributions.items()]
        pymc.Potential("log_likelihood", _make_op(posterior)(pytensor.tensor.stack(parameters)))
    return model


def _make_op(posterior: Posterior) -> object:
    """Construct the operator; pickles refer to this function because the class is created at run time."""
    return _op_classes()[0](posterior)


def _make_gradient(posterior: Posterior) -> object:
    """Construct the operator of the gradient, for pickles."""
    return _op_classes()[1](posterior)


@functools.cache
def _op_classes() -> tuple[type, type]:
    import pytensor.tensor
    from pytensor.graph.op import Op

    class LogLikelihood(Op):
        itypes = (pytensor.tensor.dvector,)
        otypes = (pytensor.tensor.dscalar,)

        def __init__(self, posterior: Posterior) -> None:
            self.posterior = posterior

        def __reduce__(self) -> tuple:
            return _make_op, (self.posterior,)

        def perform(self, node, inputs, outputs) -> None:
            outputs[0][0] = np.array(self.posterior.log_likelihood(inputs[0]))

        def grad(self, inputs, output_gradients) -> list:
            if not self.posterior.is_differentiable:  # pymc.sample then takes a step without gradient
                raise NotImplementedError("the model has no method jacobian")
            return [output_gradients[0] * Gradient(self.posterior)(inputs[0])]

    class Gradient(LogLikelihood):
        otypes = (pytensor.tensor.dvector,)

        def perform(self, node, inputs, outputs) -> None:
            outputs[0][0] = self.posterior.grad_log_likelihood(inputs[0])

        def __reduce__(self) -> tuple:
            return _make_gradient, (self.posterior,)

        grad = Op.grad  # a second derivative is not known

    return LogLikelihood, Gradient


def _translated(name: str, distribution: Distribution) -> object:
    """Create the variable with this prior in the current PyMC model, or raise ValueError."""
    import pymc

    # the exact type: a derived class is a different distribution
    kind = type(distribution)
    if kind is TruncatedNormal:
        low, high = (bound if math.isfinite(bound) else None for bound in distribution.bounds)
        return pymc.TruncatedNormal(name, distribution.mean, distribution.sd, lower=low, upper=high)
    if kind is HalfNormal:
        return pymc.HalfNormal(name, distribution.sd)
    if kind is Uniform:
        return pymc.Uniform(name, *distribution.bounds)
    if kind is LogNormal:
        return pymc.LogNormal(name, math.log(distribution.median), distribution.log_sd)
    raise ValueError(
        f"to_pymc supports TruncatedNormal, HalfNormal, Uniform and LogNormal; {name!r} is a {kind.__name__}: "
        "replace it by one of them"
    )
