"""Predictions of events that the calibration has not seen: one bridge in eleven earthquakes, real measurements.

Painter Street Overpass (CSMIP station 89324), transverse: a deck on its column and its two ends (`BridgeDeck`), whose
middle (channel 7) is predicted. Ways to predict an event:

* "one event, as usual": the posterior of the 1992 main shock, white noise or effective samples, propagated under the
  other ten events;
* "one event": `predict_new_event` from the main shock alone, with the priors below for the spread;
* "other events": each event from the ten others by `predict_new_event`;
* "other events, amplitude-dependent": the same with `EquivalentLinear`, whose softening and growth of damping are
  common to all events. One event does not tell them from its frequency and damping, so its posterior follows from that
  of the linear model without simulations of the other one (`_amplitude_dependent`).

The rows are medians over the events (RRMSE, CRPS, interval score and width as multiples of the root mean square of the
measured channel; coverage of the 90 % band, and of its strong part), the share of measured peaks within their 50 and
90 % intervals, the median ratios of the upper end of the 90 % interval of the peak to its middle and to its lower end,
and the root mean square error of the logarithm of the peak as a multiple of the stated one. The last rows are the
evidence of the amplitude-dependent model of all events relative to the linear one, and its common parameters.

The data are no part of this project: set FE_SHARED to a folder with the downloads from https://www.strongmotioncenter.org
(``*ce89324p.zip``) in ``measured/painter_street_bridge``. Without them one row says so. Files that cannot be used, such
as those without one of the channels, are left out, each with a row that says why.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from fe_likelihoods import (
    BridgeDeck,
    EquivalentLinear,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    Record,
    StoredPosterior,
    Uniform,
    Varying,
    peak,
    predict_new_event,
    propagate,
    read_record,
    residual_checks,
    share_within,
)
from fe_likelihoods.models.equivalent_linear import response_level
from fe_likelihoods.models.linear_system import respond_structure
from fe_likelihoods.prediction.prediction import Prediction
from fe_likelihoods.prediction.score_tables import HistoryScores, QuantityScores
from samplers import SMCSampler

from .rows import Row
from .targets import SHARED

__all__ = ["read_events", "transfer"]

_FOLDER = SHARED / "measured" / "painter_street_bridge"
_MAIN = "petrolia_25apr1992_ce89324p"
_INPUTS, _OUTPUT = (3, 4, 9), 7
_MEMBERS = ("CHAN{:d}.V2", "CHAN{:02d}.V2", "CHAN{:03d}.V2", "chan{:03d}.v2")
_PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
_SENSOR = 0.002  # of the accelerations [m/s²], the floor of the noise (assumed)
_WINDOW = 1.0  # [s]
_VARYING = {  # priors of the population: medians, and standard deviations of logarithms and logits (assumed)
    "frequency": Varying(LogNormal(5.0, 0.5), HalfNormal(0.3)),
    "damping": Varying(LogNormal(0.1, 1.0), HalfNormal(0.7)),
    "share": Varying(LogNormal(0.8, 0.3), HalfNormal(0.3)),
    "share_ch7": Varying(LogNormal(0.3, 0.7), HalfNormal(0.5)),
}
_BOUNDED = _VARYING | {"share": Varying(Uniform(0.0, 1.0), HalfNormal(1.5), "logit")}
_NOISE = "share_ch7"
_REFERENCE = 0.0005  # [m], near the geometric mean of the levels of the events
_POWERS = {"softening": norm(0.15, 0.2), "damping_growth": norm(0.2, 0.3)}  # priors of one event
_COMMON = {"softening": HalfNormal(0.3), "damping_growth": HalfNormal(0.5)}  # priors of all events (assumed)
_PEAK = peak("ch7")


class _Fit(NamedTuple):
    posterior: Posterior
    samples: np.ndarray
    log_evidence: float
    log_evidence_error: float
    log_weights: np.ndarray | None = None


class _Scored(NamedTuple):
    histories: HistoryScores
    peaks: QuantityScores


def transfer(repeats: int = 1) -> list[Row]:
    """Scores of predicted events, medians over the events, for each way to predict; one seed per repeat."""
    records, rows = read_events()
    if len(records) < 3:
        return [
            *rows,
            Row("transfer", "SKIPPED", None, "", f"no three files *ce89324p.zip in {_FOLDER}: set FE_SHARED"),
        ]
    for seed in range(1, repeats + 1):
        relative = {name: _calibrate(each, "relative", seed) for name, each in records.items()}
        rows += _from_one(records, relative, seed)
        rows += _held_out("other events", relative, seed)
        amplitude = {name: _amplitude_dependent(fit, seed) for name, fit in relative.items()}
        rows += _held_out("other events, amplitude-dependent", amplitude, seed, _COMMON)
        rows += _evidence(relative, amplitude, seed)
    return rows


def read_events() -> tuple[dict[str, dict[int, Record]], list[Row]]:
    """Channels of the events that can be used, by name, and a row for each file that cannot."""
    found, rows = {}, []
    for path in sorted(_FOLDER.rglob("*ce89324p.zip")) if _FOLDER.is_dir() else []:
        try:
            if path.stem in found:
                raise ValueError("another file has the same name")
            records = _records(path)
            FELikelihood(*_model_and_measurements(records))
        except (ValueError, OSError) as error:
            rows.append(Row("transfer", "LEFT OUT", None, "", f"{path.name}: {error}"))
        else:
            found[path.stem] = records
    return found, rows


def _from_one(records: dict[str, dict[int, Record]], relative: dict[str, _Fit], seed: int) -> list[Row]:
    """All other events from the main shock alone: as usual, and with the spread between events."""
    if _MAIN not in records:
        return [Row("transfer", "SKIPPED", None, "", f"predictions from one event need {_MAIN}.zip")]
    rows, unseen = [], [name for name in records if name != _MAIN]
    for noise in ("white", "effective samples"):
        fit = _calibrate(records[_MAIN], noise, seed)
        scored = [_as_usual(fit, relative[name].posterior, seed) for name in unseen]
        rows += _rows(f"one event, as usual, {noise}", seed, scored)
    single = _hierarchies({_MAIN: relative[_MAIN]}, seed)
    return rows + _rows("one event", seed, [_new_event(single, relative, name, seed) for name in unseen])


def _held_out(case: str, fits: dict[str, _Fit], seed: int, common: dict | None = None) -> list[Row]:
    """Each event from the other ones."""
    scored = []
    for name in fits:
        others = {other: fit for other, fit in fits.items() if other != name}
        scored.append(_new_event(_hierarchies(others, seed, common), fits, name, seed))
    return _rows(case, seed, scored)


def _records(path: Path) -> dict[int, Record]:
    """The transverse channels of one event by number, of one length."""
    found = {}
    for number in (*_INPUTS, _OUTPUT):
        for member in _MEMBERS:
            try:
                found[number] = read_record(path, number, member=member.format(number))
                break
            except ValueError as error:
                reason = error
        else:
            raise ValueError(f"no channel {number}: {reason}")
    end = min((each.n_steps - 1) * each.dt for each in found.values())
    return {number: each.trim(0.0, end) for number, each in found.items()}


def _model_and_measurements(records: dict[int, Record]) -> tuple[LinearStructure, Measurements]:
    model = LinearStructure(BridgeDeck("ch7"), [records[number] for number in _INPUTS])
    return model, Measurements(model.channels, records[_OUTPUT].dt, [records[_OUTPUT].acceleration])


def _calibrate(records: dict[int, Record], noise: str, seed: int) -> _Fit:
    """Posterior of one event, with noise in SI units ("white", "effective samples") or as a share of the response."""
    model, measured = _model_and_measurements(records)
    if noise == "relative":
        kind = GaussianNoise(measured.channels, level="measured", window=_WINDOW, sensor=(_SENSOR,))
        prior = _PRIOR | {"share_ch7": HalfNormal(1.0)}
    else:
        kind, prior = GaussianNoise(model.channels), _PRIOR | {"sigma_ch7": HalfNormal(1.0)}
    if noise == "effective samples":
        white = _calibrate(records, "white", seed)
        residuals = white.posterior.likelihood.residuals(white.samples.mean(axis=0))
        kind = GaussianNoise(model.channels, effective_samples=residual_checks(residuals).n_effective)
    posterior = Posterior(FELikelihood(model, measured, kind), prior)
    sampler = SMCSampler(300, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 2, progress=False)
    return _Fit(posterior, sampler.get_chain(flat=True), sampler.log_evidence, sampler.log_evidence_error)


def _amplitude_dependent(fit: _Fit, seed: int) -> _Fit:
    """Posterior of one event with `EquivalentLinear`, from that of the linear model.

    The responses are equal where frequency and damping at the level l of the response are those of the linear model,
    f_0 = f (l / l_0)^(p / 2) and zeta_0 = zeta (l / l_0)^-q, for any p and q. These are drawn from their priors, and
    the samples are weighted with the ratio of the priors and the determinant of (f_0, zeta_0) as functions of
    (f, zeta), in which the slopes of the level are differences.
    """
    likelihood, rng = fit.posterior.likelihood, np.random.default_rng(seed)
    model, parts = likelihood.model, EquivalentLinear(BridgeDeck("ch7"), _REFERENCE)
    acceleration = np.stack([support.acceleration for support in model.supports])
    frequency, damping, share, noise = fit.samples.T

    def log_levels(factors: list[float]) -> np.ndarray:
        systems = [model.parts.assemble(theta) for theta in fit.samples[:, :3] * factors]
        responses = [respond_structure(system, acceleration, model.dt).displacement[0] for system in systems]
        return np.log(np.array([response_level(response) for response in responses]) / _REFERENCE)

    log_level, h = log_levels([1.0, 1.0, 1.0]), 1e-4
    by_frequency = (log_levels([1.0 + h, 1.0, 1.0]) - log_levels([1.0 - h, 1.0, 1.0])) / (2.0 * h)
    by_damping = (log_levels([1.0, 1.0 + h, 1.0]) - log_levels([1.0, 1.0 - h, 1.0])) / (2.0 * h)
    p, q = (prior.rvs(len(share), random_state=rng) for prior in _POWERS.values())
    frequency_0, damping_0 = frequency * np.exp(0.5 * p * log_level), damping * np.exp(-q * log_level)
    determinant = (1.0 + 0.5 * p * by_frequency - q * by_damping) * frequency_0 * damping_0 / (frequency * damping)
    prior = Prior(
        {"frequency": _VARYING["frequency"].location, "damping": _VARYING["damping"].location}
        | {"share": _PRIOR["share"], **_POWERS, "share_ch7": HalfNormal(1.0)}
    )
    samples = np.stack([frequency_0, damping_0, share, p, q, noise], axis=1)
    old = fit.posterior.prior.logpdf(fit.samples) + _POWERS["softening"].logpdf(p) + _POWERS["damping_growth"].logpdf(q)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_weights = np.where(determinant > 0.0, prior.logpdf(samples) - old + np.log(determinant), -np.inf)
    gain = np.log(np.exp(log_weights).mean())
    amplitude = LinearStructure(parts, model.supports)
    posterior = Posterior(FELikelihood(amplitude, likelihood.measurements, likelihood.noise), prior)
    return _Fit(posterior, samples, fit.log_evidence + gain, fit.log_evidence_error, log_weights)


def _population(
    fits: dict[str, _Fit], seed: int, common: dict | None = None, noise: bool = True, varying: dict = _VARYING
) -> tuple[HierarchicalPosterior, SMCSampler]:
    """Samples of the population of some events, with parameters that they have in common, with or without the noise."""
    tests = {
        name: StoredPosterior(
            fit.samples,
            fit.posterior.prior,
            log_weights=fit.log_weights,
            log_evidence=fit.log_evidence,
            log_evidence_error=fit.log_evidence_error,
            effective_sample_size=300,
        )
        for name, fit in fits.items()
    }
    varying = {name: each for name, each in varying.items() if noise or name != _NOISE}
    correlation = 1.0 if len(fits) > 1 else None  # one event does not show correlations
    posterior = HierarchicalPosterior(tests, varying, common=common, correlation=correlation, max_samples=200)
    sampler = SMCSampler(300, posterior.ndim, posterior, vectorize=True, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few particles
        sampler.run_mcmc(None, 1, progress=False)
    return posterior, sampler


def _hierarchies(fits: dict[str, _Fit], seed: int, common: dict | None = None) -> tuple[Hierarchy, Hierarchy]:
    """The population of some events without and with the share of the noise.

    The peak has no noise but the ratio. Ten events tell the correlations of three parameters better than those of four,
    so that the population without the noise is narrower in the direction that changes the peak.
    """
    return _hierarchy(fits, seed, common, noise=False), _hierarchy(fits, seed, common, noise=True)


def _hierarchy(
    fits: dict[str, _Fit], seed: int, common: dict | None, noise: bool, varying: dict = _VARYING
) -> Hierarchy:
    posterior, sampler = _population(fits, seed, common, noise, varying)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the share of the ends is at its bound in one event
        return Hierarchy(posterior, sampler.get_chain(flat=True))


def _evidence(linear: dict[str, _Fit], amplitude: dict[str, _Fit], seed: int) -> list[Row]:
    """Evidence of the amplitude-dependent model of all events relative to the linear one; its common parameters."""
    case = f"{len(linear)} events, seed {seed}"
    (_, one), (posterior, other) = _population(linear, seed), _population(amplitude, seed, _COMMON)
    error = np.hypot(one.log_evidence_error, other.log_evidence_error)
    rows = [Row("log-evidence over linear", case, other.log_evidence - one.log_evidence, "", f"+- {error:.2f}")]
    samples, names = other.get_chain(flat=True), posterior.parameter_names
    for name in _COMMON:
        values = samples[:, names.index(name)]
        rows.append(Row(name, case, float(values.mean()), "", f"+- {values.std():.3f}"))
    return rows


def _as_usual(fit: _Fit, other: Posterior, seed: int) -> _Scored:
    """Another event from one posterior: its histories with noise, its peak without."""
    supports, samples = other.likelihood.model.supports, fit.samples[::2]
    histories = propagate(fit.posterior, samples, record=supports, noise=True, seed=seed, progress=False)
    peaks = propagate(fit.posterior, samples, record=supports, quantity=_PEAK, noise=True, seed=seed, progress=False)
    return _score(histories, peaks, other)


def _new_event(hierarchies: tuple[Hierarchy, Hierarchy], fits: dict[str, _Fit], name: str, seed: int) -> _Scored:
    """One event: its peak from the population without the noise, its histories from that with it."""
    posteriors = {other: fit.posterior for other, fit in fits.items()}
    options = {"model": posteriors[name], "seed": seed}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # draws with a share above 1 fail and are left out
        histories = predict_new_event(hierarchies[1], posteriors, None, noise=True, n=300, **options)
        peaks = predict_new_event(hierarchies[0], posteriors, None, quantity=_PEAK, n=2000, **options)
    return _score(histories, peaks, posteriors[name])


def _score(histories: Prediction, peaks: Prediction, other: Posterior) -> _Scored:
    measured = other.likelihood.measurements
    return _Scored(histories.score(measured), peaks.score(measured))


def _rows(case: str, seed: int, scored: list[_Scored]) -> list[Row]:
    histories, peaks = zip(*scored, strict=True)
    named = f"{case}, {len(scored)} events, seed {seed}"
    rows = [Row("RRMSE", named, _median([each.rrmse[0] for each in histories]), "")]
    for name in ("crps", "interval_score", "width"):
        scaled = [getattr(each, name)[0] / each.rms[0] for each in histories]
        rows.append(Row(f"{name} / RMS", named, _median(scaled), "", f"{min(scaled):.2g} to {max(scaled):.2g}"))
    for name in ("coverage", "coverage_strong"):
        shares = [getattr(each, name)[0] for each in histories]
        rows.append(Row(name, named, _median(shares), "", f"{min(shares):.2f} to {max(shares):.2f}"))
    return rows + _peak_rows(case, seed, peaks)


def _median(values: list[float]) -> float:
    return float(np.median(values))


def _peak_rows(case: str, seed: int, peaks: Sequence[QuantityScores]) -> list[Row]:
    pit, rows = [each.pit[0] for each in peaks], []
    case = f"{case}, {len(peaks)} events, seed {seed}"
    for level in (0.5, 0.9):
        share = share_within(pit, level)
        rows.append(Row(f"peaks within {level:.0%}", case, share.value, "", f"{share}"))
    ends = [each.upper[0] / each.median[0] for each in peaks]
    rows.append(Row("upper end / median of the peak", case, _median(ends), "", f"{min(ends):.2f} to {max(ends):.2f}"))
    apart = [each.upper[0] / each.lower[0] for each in peaks]
    rows.append(Row("upper / lower end of the peak", case, _median(apart), "", f"{min(apart):.2f} to {max(apart):.2f}"))
    errors = [np.log(each.measured[0] / each.median[0]) for each in peaks]
    stated = np.log(apart) / (2.0 * norm.ppf(0.95))  # standard deviation of a normal distribution with these ends
    ratio = float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stated))))
    rows.append(Row("error / stated error of the log peak", case, ratio, "", "root mean squares; 1 is right"))
    score = [each.interval_score[0] / each.measured[0] for each in peaks]
    rows.append(
        Row("interval score / measured peak", case, _median(score), "", f"{min(score):.2g} to {max(score):.2g}")
    )
    return rows
