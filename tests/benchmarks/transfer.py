"""Predictions of events that the calibration has not seen: one bridge in eleven earthquakes, real measurements.

Painter Street Overpass (CSMIP station 89324), transverse: a deck on its column and its two ends (`BridgeDeck`), whose
middle (channel 7) is predicted. Three ways to predict an event:

* "one event, as usual": the posterior of the 1992 main shock, white noise or effective samples, propagated under the
  other ten events;
* "one event, spread stated": `predict_new_event` from the main shock alone, with the stated priors below for the spread
  between events and for the ratio of measured to fitted peaks;
* "other events": each event from the ten others by `predict_new_event`.

The rows are medians over the events (RRMSE, CRPS, interval score and width as multiples of the root mean square of the
measured channel; coverage of the 90 % band, and of its strong part), the share of measured peaks within their 50 and
90 % intervals, and the median ratio of the upper end of the 90 % interval of the peak to its middle.

The data are no part of this project: set FE_SHARED to a folder with the downloads from https://www.strongmotioncenter.org
(``*ce89324p.zip``) in ``measured/painter_street_bridge``. Without them one row says so.
"""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods import (
    BridgeDeck,
    EventRatios,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    HistoryScores,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Prediction,
    QuantityScores,
    Record,
    RelativeNoise,
    StoredPosterior,
    Uniform,
    Varying,
    event_ratio,
    peak,
    predict_new_event,
    propagate,
    read_v2,
    residual_checks,
    share_within,
)
from samplers import SMCSampler

from .rows import Row
from .targets import SHARED

__all__ = ["transfer"]

_FOLDER = SHARED / "measured" / "painter_street_bridge"
_MAIN = "petrolia_25apr1992_ce89324p"
_INPUTS, _OUTPUT = (3, 4, 9), 7
_MEMBERS = ("CHAN{:d}.V2", "CHAN{:02d}.V2", "CHAN{:03d}.V2", "chan{:03d}.v2")
_PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
_SENSOR = 0.002  # of the accelerations [m/s²], the floor of the noise (assumed)
_WINDOW = 1.0  # [s]
_VARYING = {  # priors of the population: medians, and standard deviations of the logarithms (assumed)
    "frequency": Varying(LogNormal(5.0, 0.5), HalfNormal(0.3)),
    "damping": Varying(LogNormal(0.1, 1.0), HalfNormal(0.7)),
    "share": Varying(LogNormal(0.8, 0.3), HalfNormal(0.3)),
    "share_ch7": Varying(LogNormal(0.3, 0.7), HalfNormal(0.5)),
}
_GUESS = {"prior_sd": 0.1, "prior_events": 3.0}  # of the ratio of peaks, for one event (assumed)
_PEAK = peak("ch7")


class _Fit(NamedTuple):
    posterior: Posterior
    samples: np.ndarray


class _Scored(NamedTuple):
    histories: HistoryScores
    peaks: QuantityScores


def transfer(repeats: int = 1) -> list[Row]:
    """Scores of predicted events, medians over the events, for each way to predict; one seed per repeat."""
    files = sorted(_FOLDER.rglob("*ce89324p.zip")) if _FOLDER.is_dir() else []
    if len(files) < 2:
        return [Row("transfer", "SKIPPED", None, "", f"no two files *ce89324p.zip in {_FOLDER}: set FE_SHARED")]
    records = {path.stem: _records(path) for path in files}
    rows = []
    for seed in range(1, repeats + 1):
        relative = {name: _calibrate(each, "relative", seed) for name, each in records.items()}
        ratios = {name: event_ratio(fit.posterior, fit.samples[::6], _PEAK) for name, fit in relative.items()}
        unseen = [name for name in records if name != _MAIN]
        for noise in ("white", "effective samples"):
            fit = _calibrate(records[_MAIN], noise, seed)
            scored = [_as_usual(fit, relative[name].posterior, seed) for name in unseen]
            rows += _rows(f"one event, as usual, {noise}", seed, scored)
        single = _hierarchy({_MAIN: relative[_MAIN]}, seed)
        guess = EventRatios([ratios[_MAIN]], **_GUESS)
        scored = [_new_event(single, guess, relative[name].posterior, seed) for name in unseen]
        rows += _rows("one event, spread stated", seed, scored)
        scored = []
        for name in records:
            others = {other: fit for other, fit in relative.items() if other != name}
            measured = EventRatios([ratios[other] for other in others])
            scored.append(_new_event(_hierarchy(others, seed), measured, relative[name].posterior, seed))
        rows += _rows("other events", seed, scored)
    return rows


def _records(path: Path) -> dict[int, Record]:
    """The transverse channels of one event by number, of one length."""
    found = {}
    for number in (*_INPUTS, _OUTPUT):
        for member in _MEMBERS:
            try:
                found[number] = read_v2(path, number, member=member.format(number))
                break
            except ValueError as error:
                reason = error
        else:
            raise ValueError(f"{path.name}: no channel {number}: {reason}")
    end = min((each.n_steps - 1) * each.dt for each in found.values())
    return {number: each.trim(0.0, end) for number, each in found.items()}


def _calibrate(records: dict[int, Record], noise: str, seed: int) -> _Fit:
    """Posterior of one event, with noise in SI units ("white", "effective samples") or as a share of the response."""
    model = LinearStructure(BridgeDeck("ch7"), [records[number] for number in _INPUTS])
    measured = Measurements(model.channels, model.dt, [records[_OUTPUT].acceleration])
    if noise == "relative":
        kind = RelativeNoise.of(measured, window=_WINDOW, sensor=(_SENSOR,))
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
    return _Fit(posterior, sampler.get_chain(flat=True))


def _hierarchy(fits: dict[str, _Fit], seed: int) -> Hierarchy:
    """The population of some events."""
    tests = {
        name: StoredPosterior(fit.samples, fit.posterior.prior, effective_sample_size=300) for name, fit in fits.items()
    }
    correlation = 1.0 if len(fits) > 1 else None  # one event does not show correlations
    posterior = HierarchicalPosterior(tests, _VARYING, correlation=correlation, max_samples=200)
    sampler = SMCSampler(120, posterior.ndim, posterior, vectorize=True, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the share of the ends is at its bound in one event
        sampler.run_mcmc(None, 1, progress=False)
        return Hierarchy(posterior, sampler.get_chain(flat=True))


def _as_usual(fit: _Fit, other: Posterior, seed: int) -> _Scored:
    """Another event from one posterior: its histories with noise, its peak without."""
    supports, samples = other.likelihood.model.supports, fit.samples[::2]
    histories = propagate(fit.posterior, samples, record=supports, noise=True, seed=seed, progress=False)
    peaks = propagate(fit.posterior, samples, record=supports, quantity=_PEAK, noise=True, seed=seed, progress=False)
    return _score(histories, peaks, other)


def _new_event(hierarchy: Hierarchy, ratios: EventRatios, other: Posterior, seed: int) -> _Scored:
    """Another event from the population."""
    supports = other.likelihood.model.supports
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # draws with a share above 1 fail and are left out
        histories = predict_new_event(hierarchy, other, supports, noise=True, n=300, seed=seed)
        peaks = predict_new_event(hierarchy, other, supports, quantity=_PEAK, ratios=ratios, n=500, seed=seed)
    return _score(histories, peaks, other)


def _score(histories: Prediction, peaks: Prediction, other: Posterior) -> _Scored:
    measured = other.likelihood.measurements
    return _Scored(histories.score(measured), peaks.score(measured))


def _rows(case: str, seed: int, scored: list[_Scored]) -> list[Row]:
    histories, peaks = zip(*scored, strict=True)
    pit = [each.pit[0] for each in peaks]
    case = f"{case}, {len(scored)} events, seed {seed}"

    def median(values: list[float]) -> float:
        return float(np.median(values))

    rows = [Row("RRMSE", case, median([each.rrmse[0] for each in histories]), "")]
    for name in ("crps", "interval_score", "width"):
        scaled = [getattr(each, name)[0] / each.rms[0] for each in histories]
        rows.append(Row(f"{name} / RMS", case, median(scaled), "", f"{min(scaled):.2g} to {max(scaled):.2g}"))
    for name in ("coverage", "coverage_strong"):
        shares = [getattr(each, name)[0] for each in histories]
        rows.append(Row(name, case, median(shares), "", f"{min(shares):.2f} to {max(shares):.2f}"))
    for level in (0.5, 0.9):
        rows.append(Row(f"peaks within {level:.0%}", case, share_within(pit, level), ""))
    ends = [each.upper[0] / each.median[0] for each in peaks]
    rows.append(Row("upper end / median of the peak", case, median(ends), "", f"{min(ends):.2f} to {max(ends):.2f}"))
    score = [each.interval_score[0] / each.measured[0] for each in peaks]
    rows.append(Row("interval score / measured peak", case, median(score), "", f"{min(score):.2g} to {max(score):.2g}"))
    return rows
