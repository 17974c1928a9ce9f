"""What the tutorials on tests of materials and members share: one posterior for each idea of the error, tables.

What separates a measurement from a simulation is two things. **Measurement error**: what the sensor adds; it is known
from the sensor or from the scatter of neighbouring samples, and new at each of them. **Model error**: what the model
cannot do at any parameters; larger by far here, the same in every repetition of the test, and lasting from sample to
sample. White noise takes both for one and counts each sample as a witness of its own. Three ideas are compared:

* ``white``: independent errors, n witnesses;
* ``effective``: the same, but n_eff witnesses, as many as the residuals of the white posterior are worth;
* ``AR(1)``: errors that last, their lag-one correlation unknown, above a sensor's noise that is known.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import corner
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from real_data import find

from fe_likelihoods.prediction.prediction import Prediction
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.probability.likelihood import FELikelihood
from fe_likelihoods.probability.noise import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.probability.posterior import Posterior
from fe_likelihoods.probability.priors import HalfNormal, Prior, Uniform
from fe_likelihoods.probability.residuals import (
    ResidualChecks,
    effective_samples,
    innovations,
    plot_residuals,
    residual_checks,
)
from fe_likelihoods.signals.channels import Measurements
from samplers import SMCSampler
from samplers.reporting.summary import summary

__all__ = [
    "Fit",
    "bands",
    "data_folder",
    "fit_noises",
    "keep_posterior",
    "keep_residuals",
    "keep_summary",
    "predict",
    "prediction_row",
    "report",
    "rrmse",
    "scatter",
    "table",
]

COLOURS = {"white": "#d9822b", "effective": "#5b8c5a", "AR(1)": "#1f5a8c"}


def data_folder(given: Path | None, files: tuple[str, ...], source: str) -> Path:
    """Folder of the measured data, or the end of the script with the words that say where to get them."""
    return {find(given, file, source).parent for file in files}.pop()


class Fit(NamedTuple):
    """Posterior under one idea of the error, its samples (n, ndim), and what it cost."""

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
    """Posteriors under the three ideas of the error, of a model with one channel.

    sigma : scale of the half-normal prior of the error. sensor : known noise of the sensor [both SI].
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
    worth = {channel.name: float(effective_samples(residuals)[0])}
    fits["effective"] = fit(GaussianNoise(model.channels, sensor=known, effective_samples=worth), {})
    fits["AR(1)"] = fit(AutoregressiveNoise(model.channels, sensor=known), {f"rho_{channel.name}": Uniform(0.0, 1.0)})
    return fits


def _posterior_rows(fits: Mapping[str, Fit], prior: Mapping[str, Any], scale: float, unit: str) -> list[dict[str, str]]:
    """Mean and standard deviation of every parameter under every idea of the error; sigma in `unit` of `scale` [SI]."""
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


def _corners(fits: Mapping[str, Fit], prior: Mapping[str, Any], title: str) -> Figure:
    """Structural parameters under the three ideas of the error: regions of 50 and 90 %."""
    n = len(prior)
    ranges = []
    for i in range(n):
        seen = np.concatenate([np.quantile(fit.samples[:, i], (0.001, 0.999)) for fit in fits.values()])
        margin = 0.05 * np.ptp(seen)
        ranges.append((seen.min() - margin, seen.max() + margin))
    figure = None
    for name, fit in fits.items():
        figure = corner.corner(
            fit.samples[:, :n],
            fig=figure,
            labels=list(prior),
            color=COLOURS[name],
            plot_datapoints=False,
            plot_density=False,
            levels=(0.5, 0.9),
            smooth=0.8,
            hist_kwargs={"density": True},
            range=ranges,
        )
    tallest = [
        max(axis.patches[k].get_xy()[:, 1].max() for k in range(len(axis.patches))) for axis in figure.axes[:: n + 1]
    ]
    for axis, height in zip(figure.axes[:: n + 1], tallest, strict=True):
        axis.set_ylim(0.0, 1.1 * height)
    handles = [plt.Line2D([], [], color=COLOURS[name]) for name in fits]
    figure.legend(handles, list(fits), loc="upper right", bbox_to_anchor=(0.95, 0.9), frameon=False, fontsize=18)
    figure.suptitle(title)
    return figure


def report(
    fits: Mapping[str, Fit], prior: Mapping[str, Any], checks: Mapping[str, ResidualChecks], scale: float
) -> dict[str, Any]:
    """What the fits say, in numbers: sigma in units of `scale` [SI]."""
    names, moments = (
        list(prior),
        {name: (fit.samples.mean(axis=0), fit.samples.std(axis=0)) for name, fit in fits.items()},
    )
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


def _residual_figure(fit: Fit, name: str, scale: float, unit: str) -> tuple[Figure, ResidualChecks, str]:
    """Checks of the residuals at the posterior mean; of AR(1), what is new in each of them. And the checks in words."""
    mean, likelihood = fit.samples.mean(axis=0), fit.posterior.likelihood
    shown, what = likelihood.residuals(mean), f"residuals, errors taken as {name}"
    if name == "AR(1)":
        shown, what = (
            innovations(shown, mean[-1:]),
            f"innovations of residuals, errors taken as AR(1) with rho {mean[-1]:.2f}",
        )
    checks = residual_checks(shown)
    figure = plot_residuals(shown, likelihood.model.channels, 1.0)
    figure.suptitle(what, fontsize="small")
    for axis, label in zip(figure.axes, ("sample", "lag [samples]", "quantile of a normal [-]"), strict=True):
        axis.set_xlabel(label)
    words = (
        f"{what}: lag one {checks.lag_one[0]:.2f}, worth {checks.n_effective[0]:.0f} of {shown.size} samples, "
        f"mean {checks.mean[0] / scale:.2f}, sd {checks.standard_deviation[0] / scale:.2f} {unit}"
    )
    return figure, checks, words


def keep_posterior(
    fits: Mapping[str, Fit], prior: Mapping[str, Any], scale: float, unit: str, title: str, out: Path
) -> str:
    """Table of the posteriors, printed, and their corner plot in ``corner.png``."""
    text = table(_posterior_rows(fits, prior, scale, unit))
    print(text)
    figure = _corners(fits, prior, title)
    figure.savefig(out / "corner.png", dpi=90)
    plt.close(figure)
    return text


def keep_residuals(fits: Mapping[str, Fit], scale: float, unit: str, out: Path) -> dict[str, ResidualChecks]:
    """Checks of the residuals under white noise and of the innovations under AR(1): in words, and as figures."""
    checks = {}
    for name, file in (("white", "residuals_white.png"), ("AR(1)", "residuals_ar1.png")):
        figure, checks[name], words = _residual_figure(fits[name], name, scale, unit)
        figure.savefig(out / file, dpi=130)
        plt.close(figure)
        print(words)
    return checks


def keep_summary(result: dict, out: Path) -> None:
    """Numbers of the run, with its seconds, into ``summary.json``; what it cost is printed."""
    (out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
    print(
        f"{sum(result['simulations'].values())} simulations ({sum(result['failures'].values())} failed) in "
        f"{result['seconds_sampling']:.0f} s, the whole in {result['seconds']:.0f} s; tables and figures are in {out}/"
    )


def predict(fit: Fit, n: int, seed: int, model: Any) -> tuple[Prediction, Prediction]:
    """Response of `model` alone, and what a sensor would read, over `n` samples of a posterior."""
    chosen = np.random.default_rng(seed).choice(len(fit.samples), min(n, len(fit.samples)), replace=False)
    # any measurements will do: what is predicted depends on parameters and noise alone
    none = Measurements(model.channels, model.dt, np.zeros((1, model.n_steps)))
    likelihood = FELikelihood(_Remembering(model), none, fit.posterior.likelihood.noise)
    posterior = Posterior(likelihood, fit.posterior.prior)
    return tuple(
        propagate(posterior, fit.samples[chosen], noise=noise, seed=seed, progress=False) for noise in (False, True)
    )


class _Remembering:
    """A model whose responses are kept, so that a prediction with noise does not simulate again."""

    def __init__(self, model: Any) -> None:
        self.parameter_names, self.channels = model.parameter_names, model.channels
        self.dt, self.n_steps, self.fingerprint = model.dt, model.n_steps, model.fingerprint
        self._model, self._kept = model, {}

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        key = np.asarray(theta).tobytes()
        if key not in self._kept:
            self._kept[key] = self._model.simulate(theta)
        return self._kept[key]


def prediction_row(
    predictions: Mapping[str, tuple[Prediction, Prediction]], nominal: np.ndarray, measured: np.ndarray, part: slice
) -> tuple[dict[str, str], dict]:
    """Errors and coverages of a part of the history, as a row of a table and as numbers."""
    row = {"RRMSE nominal": f"{100 * rrmse(nominal, measured, part):.1f} %"}
    numbers = {"nominal": rrmse(nominal, measured, part)}
    for name, (alone, noisy) in predictions.items():
        data = Measurements(alone.channels, alone.dt, measured[None])
        error = float(alone.rrmse(data, part)[0])
        inside = [float(prediction.coverage(data, part=part)[0]) for prediction in (alone, noisy)]
        row[f"{name}: RRMSE, in bands"] = f"{100 * error:.1f} %, {100 * inside[0]:.0f} and {100 * inside[1]:.0f} %"
        numbers[name] = {"rrmse": error, "coverage_response": inside[0], "coverage": inside[1]}
    return row, numbers


def rrmse(predicted: np.ndarray, measured: np.ndarray, part: slice = slice(None)) -> float:
    """Relative root-mean-square error of a part of the one channel."""
    return float(np.sqrt(np.sum((predicted[part] - measured[part]) ** 2) / np.sum(measured[part] ** 2)))


def scatter(x: np.ndarray, y: np.ndarray, width: int = 7) -> float:
    """Noise of the sensor of y, from the samples: median scatter about a parabola in x through `width` neighbours.

    Only where x goes one way. It is an upper bound, as the true curve is no parabola.
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


def bands(axes: Any, x: np.ndarray, low: np.ndarray, high: np.ndarray, **style: Any) -> None:
    """A band along a path that goes to and fro in x: one polygon for each way."""
    ways = np.sign(np.diff(x))
    turns = np.flatnonzero(ways[1:] * ways[:-1] < 0) + 1
    for start, stop in zip([0, *turns], [*turns, len(x) - 1], strict=True):
        way = slice(start, stop + 1)
        axes.fill_between(x[way], low[way], high[way], linewidth=0.0, **style)
        style.pop("label", None)


def table(rows: list[dict[str, str]]) -> str:
    """Rows with the same keys as aligned text."""
    widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    lines = ["  ".join(f"{key:<{width}}" for key, width in widths.items())]
    lines += ["  ".join(f"{row[key]:<{width}}" for key, width in widths.items()) for row in rows]
    return "\n".join(line.rstrip() for line in lines)
