"""Results of runs as arviz data: each run is one chain, whose draws are ordered by founder, walker and step.

arviz estimates effective sample sizes from the correlation between neighbours, which dependent draws are then.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .summary import is_tempered, log_posterior_of, names_of_parameters

if TYPE_CHECKING:
    import xarray

_CHAINS = (
    "Each chain is an independent run, so r_hat compares runs, and there is no r_hat of one run: pass a list of runs "
    "with different seeds."
)


def to_arviz(
    sampler: Any, prediction: Any = None, *, parameter_names: Sequence[str] | None = None, discard: int = 0
) -> Any:
    """Convert one run, or several independent runs, to arviz data.

    Parameters
    ----------
    sampler : sampler or sequence of samplers
        Samplers that have run, with chains of equal length; `emcee.EnsembleSampler` is accepted too.
    prediction : fe_likelihoods.prediction.prediction.Prediction, optional
        The result of `fe_likelihoods.propagate`; adds the group ``predictions``.
    parameter_names : sequence of str, optional
        By default the names of the posterior, or those given to the sampler (name_0, name_1, ... of a group), or else
        theta_0, theta_1, ...
    discard : int
        Burn-in of each run, in steps. Chains of SMC and TMCMC have none.

    Returns
    -------
    arviz.InferenceData
        A DataTree from arviz 1.0 on; ``to_netcdf(path)`` writes it to a file. It has the groups ``posterior``,
        ``sample_stats`` and, where they are known, ``prior`` and ``predictions``; ``docs/arviz`` describes them. A
        slash in the name of a parameter or channel becomes ``_``.

    Examples
    --------
    >>> data = to_arviz(sampler)
    >>> data.posterior["stiffness"].shape
    (1, 300)
    """
    import arviz
    import xarray

    runs = list(sampler) if isinstance(sampler, Sequence) else [sampler]
    known = log_posterior_of(runs[0])
    names = parameter_names or getattr(known, "parameter_names", None) or _names_in_emcee(runs[0])
    names = names_of_parameters(names, runs[0].ndim)
    if not all(hasattr(run, "get_chain") and run.ndim == len(names) for run in runs):
        raise ValueError(f"expected samplers of {len(names)} parameters; got {[type(run).__name__ for run in runs]}")
    chains, stats = _ordered(runs, discard)
    described = {each.name: each for each in getattr(known, "parameters", ())}
    groups = {
        "posterior": _parameter_group(chains, names, described, {"chains": _CHAINS}),
        "sample_stats": xarray.Dataset(
            {
                name: (("chain", "draw", *(f"{name}_dim_{i}" for i in range(values.ndim - 2))), values)
                for name, values in stats.items()
            },
            {"chain": np.arange(len(runs)), "draw": np.arange(chains.shape[1])},
            _statistics_of_runs(runs),
        ),
    }
    first = [getattr(run, "prior_draws", None) for run in runs]
    if all(draws is not None for draws in first):
        source = "draws of the prior from which the annealing began; the chains are the runs"
        groups["prior"] = _parameter_group(np.stack(first), names, described, {"source": source})
    if prediction is not None:
        groups["predictions"] = prediction.to_xarray()
    for group, data in groups.items():  # a slash would be a folder in netCDF
        names = {*data.variables, *data.dims}
        groups[group] = data.rename({name: name.replace("/", "_") for name in names if "/" in name})
    if arviz.__version__.startswith("0."):
        return arviz.InferenceData(**groups)
    return xarray.DataTree.from_dict(groups)


def _ordered(runs: Sequence[Any], discard: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Chains (n_runs, n_draws, ndim) in the order of founder, walker and step, and statistics of draws."""
    shapes = [run.get_chain(discard=discard).shape for run in runs]
    if len(set(shapes)) > 1 or 0 in shapes[0]:
        raise ValueError(f"all runs must have chains of the same shape, with one step or more; got {shapes}")
    n_steps, n_walkers, _ = shapes[0]
    chains, stats = [], {"lp": [], "step": [], "walker": [], "founder": []}
    blobs = [_blobs(run, discard) for run in runs]
    stats |= {name: [] for name in blobs[0] if all(name in each for each in blobs)}
    for run, own in zip(runs, blobs, strict=True):
        founders = run.founders if is_tempered(run) else np.arange(n_walkers)
        order = np.argsort(founders, kind="stable")
        chains.append(run.get_chain(discard=discard)[:, order].swapaxes(0, 1).reshape(-1, run.ndim))
        stats["lp"].append(run.get_log_prob(discard=discard)[:, order].T.ravel())
        stats["step"].append(np.tile(discard + np.arange(n_steps), n_walkers))
        stats["walker"].append(np.repeat(order, n_steps))
        stats["founder"].append(np.repeat(founders[order], n_steps))
        for name in stats.keys() & own.keys():
            values = own[name][:, order].swapaxes(0, 1)
            stats[name].append(values.reshape(-1, *values.shape[2:]))
    return np.stack(chains), {name: np.stack(values) for name, values in stats.items()}


def _names_in_emcee(run: Any) -> list[str] | None:
    """Names given to an emcee sampler, one per parameter; None without them."""
    if not getattr(run, "params_are_named", False):
        return None
    names = {}
    for name, places in run.parameter_names.items():
        places = np.atleast_1d(places)
        names |= {int(k): name if len(places) == 1 else f"{name}_{i}" for i, k in enumerate(places)}
    return [names.get(k, f"theta_{k}") for k in range(run.ndim)]


def _blobs(run: Any, discard: int) -> dict[str, np.ndarray]:
    """Blobs (n_steps, n_walkers, ...) by their names, or as ``blobs``; objects are left out."""
    found = run.get_blobs(discard=discard)
    if found is None:
        return {}
    named = {name: found[name] for name in found.dtype.names} if found.dtype.names else {"blobs": found}
    ours = ("lp", "step", "walker", "founder", "chain", "draw")
    return {f"blob_{k}" if k in ours else k: each for k, each in named.items() if each.dtype.kind in "fiubcUSmM"}


def _parameter_group(
    samples: np.ndarray, names: Sequence[str], described: Mapping[str, Any], attributes: Mapping[str, Any]
) -> "xarray.Dataset":
    """Samples (n_chains, n_draws, ndim) with units, labels and nominal values of the parameters."""
    import xarray

    variables = {}
    for column, name in enumerate(names):
        about, parameter = {}, described.get(name)
        if parameter is not None:
            about = {key: getattr(parameter, key) for key in ("factor", "nominal", "multiple_of")}
            about |= {"units": parameter.unit, "long_name": parameter.label}
        variables[name] = (("chain", "draw"), samples[:, :, column], about)
    coordinates = {"chain": np.arange(len(samples)), "draw": np.arange(samples.shape[1])}
    return xarray.Dataset(variables, coordinates, dict(attributes))


def _statistics_of_runs(runs: Sequence[Any]) -> dict[str, Any]:
    """Attributes of ``sample_stats``: arrays over the runs, and texts with one line per run."""
    attributes: dict[str, Any] = {"samplers": "\n".join(type(run).__name__ for run in runs)}
    if not all(is_tempered(run) and run.ladder for run in runs):
        return attributes
    numbers = ("log_evidence", "log_evidence_error", "evaluations", "simulations", "failure_count")
    attributes |= {name: np.array([float(getattr(run, name)) for run in runs]) for name in numbers}
    attributes["ladder"] = json.dumps([[stage._asdict() for stage in run.ladder] for run in runs])
    attributes["settings"] = "\n".join(repr(run.settings) for run in runs)
    attributes["verdict"] = "\n".join(str(run.verdict) for run in runs)
    failures = (Counter(failure["reason"] for failure in run.failures) for run in runs)
    return attributes | {"failures": "\n".join(map(json.dumps, failures))}
