"""Shared parts of the tutorials on cyclic tests: one posterior per error model, predictions, tables and figures.

Two errors separate a measurement from a simulation. The **measurement error** is what the sensor adds. It is known
from the sensor or from the scatter of neighbouring samples, and it is independent at each sample. The **model error**
is what the model cannot reproduce with any parameters. It is much larger here, the same in every repetition of the
test, and correlated from sample to sample. White noise treats both as one independent error per sample. Three error
models are compared:

* ``white``: independent errors;
* ``effective``: the same, but the n samples count as n_eff independent samples, estimated from the residuals of the
  posterior with white noise;
* ``AR(1)``: errors with an unknown lag-one correlation, plus the known noise of the sensor.
"""

import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from real_data import find_file

from fe_likelihoods import (
    AutoregressiveNoise,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    SimulationCache,
    Uniform,
    effective_samples,
    plot_residuals,
    propagate,
    residual_checks,
    rrmse,
)
from fe_likelihoods.noise.residuals import ResidualChecks, innovations
from fe_likelihoods.prediction.prediction import Prediction
from samplers import SMCSampler, plot_corner, summary


def find_folder(given: Path | None, files: tuple[str, ...], source: str) -> Path:
    """Folder that contains the measured data; SystemExit with their source if it is not given or lacks a file."""
    return {find_file(given, file, source).parent for file in files}.pop()


class Fit(NamedTuple):
    """Posterior under one error model, and its samples.

    Attributes
    ----------
    posterior : Posterior
        The posterior.
    samples : (n, ndim) float
        Samples of the posterior.
    log_evidence : float
        Logarithm of the evidence.
    simulations, failures : int
        Number of simulations, and of failed ones.
    """

    posterior: Posterior
    samples: np.ndarray
    log_evidence: float
    simulations: int
    failures: int


def fit_noises(
    model: Any,
    measurements: Measurements,
    prior: Mapping[str, Any],
    sigma: float,
    sensor: float,
    *,
    walkers: int,
    seed: int,
    progress: bool,
    **settings: Any,
) -> dict[str, Fit]:
    """Sample the posteriors of a model with one channel under the three error models.

    Parameters
    ----------
    model : Model
        The model.
    measurements : Measurements
        The measured channel.
    prior : mapping of str to Distribution
        Priors of the structural parameters.
    sigma : float
        Scale of the half-normal prior of the error [SI].
    sensor : float
        Known standard deviation of the noise of the sensor [SI].
    walkers, seed, progress
        Of `SMCSampler` and its method `run_mcmc`.
    **settings
        More settings of `SMCSampler`.

    Returns
    -------
    dict of str to Fit
        By error model: "white", "effective", "AR(1)".
    """
    (channel,) = model.channels
    known = {channel.name: sensor}

    def fit(noise: Any, more: Mapping[str, Any]) -> Fit:
        whole = Prior(dict(prior) | {f"sigma_{channel.name}": HalfNormal(sigma)} | dict(more))
        posterior = Posterior(FELikelihood(model, measurements, noise), whole)
        sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
        sampler.run_mcmc(None, 4, progress=progress)
        report = posterior.report()
        return Fit(
            posterior,
            sampler.get_chain(flat=True),
            float(sampler.log_evidence),
            report["simulations"],
            report["failure_count"],
        )

    fits = {"white": fit(GaussianNoise(model.channels), {})}
    residuals = fits["white"].posterior.likelihood.residuals(fits["white"].samples.mean(axis=0))
    effective = {channel.name: float(effective_samples(residuals)[0])}
    fits["effective"] = fit(GaussianNoise(model.channels, sensor=known, effective_samples=effective), {})
    fits["AR(1)"] = fit(AutoregressiveNoise(model.channels, sensor=known), {f"rho_{channel.name}": Uniform(0.0, 1.0)})
    return fits


def _posterior_rows(fits: Mapping[str, Fit], prior: Mapping[str, Any], scale: float, unit: str) -> list[dict[str, str]]:
    """Mean and standard deviation of every parameter under every error model; sigma in `unit` of `scale` [SI]."""
    moments = {name: summary(fit.samples, fit.posterior.parameter_names) for name, fit in fits.items()}
    rows = []
    for i, parameter in enumerate(fits["AR(1)"].posterior.parameter_names):
        structural, factor = parameter in prior, 1.0 / scale if parameter.startswith("sigma") else 1.0
        row = {"parameter": f"{parameter} [{unit}]" if parameter.startswith("sigma") else parameter}
        row["prior"] = f"{prior[parameter].mean:g} +- {prior[parameter].sd:g}" if structural else ""
        for name, found in moments.items():
            known = i < len(found.mean)
            row[name] = f"{factor * found.mean[i]:.3f} +- {factor * found.sd[i]:.3f}" if known else ""
        for name in ("effective", "AR(1)"):
            row[f"sd, {name} / white"] = f"{moments[name].sd[i] / moments['white'].sd[i]:.1f}" if structural else ""
        rows.append(row)
    return rows


def _plot_corner(fits: Mapping[str, Fit], prior: Mapping[str, Any], title: str) -> Figure:
    """Structural parameters under the three error models."""
    labels = [f"{parameter} [x nominal]" for parameter in prior]
    return plot_corner({name: fit.samples[:, : len(labels)] for name, fit in fits.items()}, labels=labels, title=title)


def report(
    fits: Mapping[str, Fit], prior: Mapping[str, Any], checks: Mapping[str, ResidualChecks], scale: float
) -> dict[str, Any]:
    """Numbers of the fits, for ``summary.json``; sigma in units of `scale` [SI]."""
    names = list(prior)
    moments = {name: (fit.samples.mean(axis=0), fit.samples.std(axis=0)) for name, fit in fits.items()}
    return {
        "mean": {name: dict(zip(names, mean.tolist(), strict=False)) for name, (mean, _) in moments.items()},
        "sd": {name: dict(zip(names, sd.tolist(), strict=False)) for name, (_, sd) in moments.items()},
        "sigma": {name: float(mean[len(names)] / scale) for name, (mean, _) in moments.items()},
        "rho": float(moments["AR(1)"][0][-1]),
        "lag_one": {name: float(check.lag_one[0]) for name, check in checks.items()},
        "n_effective": float(checks["white"].n_effective[0]),
        "samples": fits["white"].posterior.likelihood.measurements.n_steps,
        "log_evidence": {name: fit.log_evidence for name, fit in fits.items()},
        "simulations": {name: fit.simulations for name, fit in fits.items()},
        "failures": {name: fit.failures for name, fit in fits.items()},
    }


def _plot_residuals(fit: Fit, name: str, scale: float, unit: str) -> tuple[Figure, ResidualChecks, str]:
    """Figure, checks and a sentence: residuals at the posterior mean, or under AR(1) their innovations."""
    mean, likelihood = fit.samples.mean(axis=0), fit.posterior.likelihood
    shown, title = likelihood.residuals(mean), f"residuals of the fit with {name} errors"
    if name == "AR(1)":
        shown = innovations(shown, mean[-1:])
        title = f"innovations of the residuals of the fit with AR(1) errors, rho {mean[-1]:.2f}"
    checks = residual_checks(shown)
    figure = plot_residuals(shown, likelihood.model.channels, 1.0)
    figure.suptitle(title, fontsize="small")
    for axes, label in zip(figure.axes, ("sample", "lag [samples]", "quantile of a normal [-]"), strict=True):
        axes.set_xlabel(label)
    sentence = (
        f"{title}: lag-one correlation {checks.lag_one[0]:.2f}, n_eff {checks.n_effective[0]:.0f} of {shown.size}, "
        f"mean {checks.mean[0] / scale:.2f}, sd {checks.standard_deviation[0] / scale:.2f} {unit}"
    )
    return figure, checks, sentence


def save_posterior(
    fits: Mapping[str, Fit], prior: Mapping[str, Any], scale: float, unit: str, title: str, out: Path
) -> str:
    """Print and return the table of the posteriors; save their corner plot as ``corner.png``."""
    text = table(_posterior_rows(fits, prior, scale, unit))
    print(text)
    _plot_corner(fits, prior, title).savefig(out / "corner.png", dpi=90)
    return text


def save_residuals(fits: Mapping[str, Fit], scale: float, unit: str, out: Path) -> dict[str, ResidualChecks]:
    """Print and return the checks of the residuals under white and AR(1) errors; save their figures."""
    checks = {}
    for name, file in (("white", "residuals_white.png"), ("AR(1)", "residuals_ar1.png")):
        figure, checks[name], sentence = _plot_residuals(fits[name], name, scale, unit)
        figure.savefig(out / file, dpi=130)
        print(sentence)
    return checks


def save_summary(result: dict, out: Path) -> None:
    """Write the numbers of a run to ``summary.json`` and print its cost."""
    (out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
    print(
        f"{sum(result['simulations'].values())} simulations ({sum(result['failures'].values())} failed) in "
        f"{result['seconds_sampling']:.0f} s, {result['seconds']:.0f} s in total; tables and figures are in {out}/"
    )


def predict(fit: Fit, n: int, seed: int, model: Any) -> tuple[Prediction, Prediction]:
    """Predict with `n` samples of a posterior: the response of `model` alone, and the response with noise."""
    chosen = np.random.default_rng(seed).choice(len(fit.samples), min(n, len(fit.samples)), replace=False)
    # the prediction depends only on parameters and noise: the measurements of the likelihood are not used
    unused = Measurements(model.channels, model.dt, np.zeros((1, model.n_steps)))
    posterior = Posterior(FELikelihood(model, unused, fit.posterior.likelihood.noise), fit.posterior.prior)
    # the prediction with noise finds the responses in the cache; verify=False, because the model cannot have changed
    with TemporaryDirectory() as folder, closing(SimulationCache(Path(folder) / "cache", verify=False)) as cache:
        settings = {"seed": seed, "cache": cache, "progress": False}
        return tuple(propagate(posterior, fit.samples[chosen], noise=noise, **settings) for noise in (False, True))


def prediction_row(
    predictions: Mapping[str, tuple[Prediction, Prediction]], nominal: np.ndarray, measured: np.ndarray, part: slice
) -> tuple[dict[str, str], dict]:
    """Errors, coverage and interval score in a part of the history, as a row of a table and as numbers.

    Interval score, CRPS and width are those of the 90 % band with noise, as multiples of the root mean square of the
    measured part.
    """
    before = float(rrmse(nominal[part], measured[part]))
    row, numbers = {"RRMSE nominal": f"{100 * before:.1f} %"}, {"nominal": before}
    for name, (alone, noisy) in predictions.items():
        data = Measurements(alone.channels, alone.dt, measured[None])
        of_response, scores = (each.score(data, part=part) for each in (alone, noisy))
        error, inside = float(of_response.rrmse[0]), [float(each.coverage[0]) for each in (of_response, scores)]
        relative = {
            what: float(getattr(scores, what)[0] / scores.rms[0]) for what in ("interval_score", "crps", "width")
        }
        row[f"{name}: RRMSE, in bands, score"] = (
            f"{100 * error:.1f} %, {100 * inside[0]:.0f} and {100 * inside[1]:.0f} %, {relative['interval_score']:.2f}"
        )
        numbers[name] = {"rrmse": error, "coverage_response": inside[0], "coverage": inside[1]} | relative
    return row, numbers


def scatter(x: np.ndarray, y: np.ndarray, width: int = 7) -> float:
    """Upper bound of the noise of y: median scatter about a parabola in x through `width` neighbouring samples.

    Only windows in which x is monotonic are used. The true curve is not a parabola, hence an upper bound.
    """
    found = []
    for start in range(len(x) - width + 1):
        near, values = x[start : start + width], y[start : start + width]
        steps = np.diff(near)
        if (steps > 0.0).all() or (steps < 0.0).all():
            z = (near - near[0]) / (near[-1] - near[0])
            rest = values - np.polyval(np.polyfit(z, values, 2), z)
            found.append(np.sqrt(np.sum(rest**2) / (width - 3)))
    return float(np.median(found))


def fill_bands(axes: Any, x: np.ndarray, low: np.ndarray, high: np.ndarray, **style: Any) -> None:
    """Fill a band along a path that reverses in x: one polygon per monotonic part."""
    ways = np.sign(np.diff(x))
    turns = np.flatnonzero(ways[1:] * ways[:-1] < 0) + 1
    for start, stop in zip([0, *turns], [*turns, len(x) - 1], strict=True):
        way = slice(start, stop + 1)
        axes.fill_between(x[way], low[way], high[way], linewidth=0.0, **style)
        style.pop("label", None)


def table(rows: list[dict[str, str]]) -> str:
    """Format rows with equal keys as an aligned table."""
    widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    lines = ["  ".join(f"{key:<{width}}" for key, width in widths.items())]
    lines += ["  ".join(f"{row[key]:<{width}}" for key, width in widths.items()) for row in rows]
    return "\n".join(line.rstrip() for line in lines)
