"""
One bridge, many earthquakes: a prediction that holds
=====================================================

A model that is calibrated with one earthquake predicts the next one too confidently: the stiffness and the damping of a
structure change with the amplitude of its motion and with time, and the error of the model comes on top. Several events
show how much. The tutorial goes from the calibration with one event to the fragility of the bridge:

* each event is calibrated alone, and one sentence says how much the events differ;
* new events are predicted from one event as usual, and from the population of all events; proper scores compare both;
* stiffness and damping that depend on the amplitude are compared with constant ones by the evidence;
* the fragility of the deck, with and without the spread between events, is compared with what happens.

**The data are synthetic**, so that the truth is known: a bridge deck on its column and its two ends, with stiffness and
damping that follow the amplitude, vary between events, and with a second mode that the model does not have. With the
records of a real bridge, eleven earthquakes of the Painter Street Overpass, the last section predicts each event from
the others::

    python tutorials/11_many_events.py                   # synthetic, a few minutes
    python tutorials/11_many_events.py --fast            # seconds, few samples; its numbers are not results
    python tutorials/11_many_events.py --data FOLDER     # and the real bridge

FOLDER has the processed records of station 89324 as downloaded, ``*ce89324p.zip``, from the Center for Engineering
Strong Motion Data, https://www.strongmotioncenter.org. Acknowledge the source: recorded by the California Strong Motion
Instrumentation Program of the California Geological Survey.
"""

import argparse
import json
import os
import time
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import bilinear, lfilter

from fe_likelihoods import (
    BridgeDeck,
    EquivalentLinear,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    JointLikelihood,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    StoredPosterior,
    Uniform,
    Varying,
    event_ratios,
    fragility,
    from_si,
    leave_one_out,
    peak,
    plot_scores,
    predict_new_event,
    propagate,
    read_record,
    share_within,
)
from samplers import SMCSampler, compare_models

parser = argparse.ArgumentParser(description="Predict earthquakes of one bridge from other earthquakes.")
parser.add_argument("--data", type=Path, help="folder of the records of the real bridge, searched at any depth")
parser.add_argument("--fast", action="store_true", default=bool(os.environ.get("FAST")), help="few events, few samples")
parser.add_argument("--seed", type=int, default=1, help="seed of the synthetic data and of the samplers")
parser.add_argument("--out", type=Path, default=Path("results-events"), help="folder of the results")
args = parser.parse_args()
fast = args.fast or bool(os.environ.get("FAST"))
args.out.mkdir(parents=True, exist_ok=True)
CALIBRATED, NEW, WALKERS, DRAWS, STEPS = (4, 4, 120, 60, 450) if fast else (8, 20, 300, 300, 900)
begin = time.perf_counter()
if fast:
    print("REDUCED SETTING (fast): few events and few samples; these numbers are not results")

# %%
# The bridge and its earthquakes
# ------------------------------
#
# The motions are filtered white noise (Kanai 1957, Tajimi 1960) with an envelope, with peaks from 0.03 to 0.6 g. The
# ends of the deck move a little differently from the base of its column. At the level of 5 mm the deck has 4.6 Hz and a
# damping ratio of 0.10; its stiffness decreases and its damping grows with the level. Between events of the same level,
# the logarithms of frequency and damping have standard deviations of 0.03 and 0.15 (season, age, bearings).

DT, SENSOR, REFERENCE = 0.02, 0.002, 0.005  # s, m/s², m
TRUTH = {"frequency": 4.6, "damping": 0.10, "share": 0.8, "softening": 0.2, "damping_growth": 0.35}
SPREAD = {"frequency": 0.03, "damping": 0.15}
LEVELS = (0.03, 0.6)  # peaks of the base [g]
G = 9.80665


def filtered_noise(rng: np.random.Generator, n: int) -> np.ndarray:
    """Ground acceleration with a peak of 1 m/s²: white noise through a soil layer of 2.5 Hz, with an envelope."""
    omega, zeta = 2.0 * np.pi * 2.5, 0.6
    soil = lfilter(
        *bilinear([2.0 * zeta * omega, omega**2], [1.0, 2.0 * zeta * omega, omega**2], 1.0 / DT), rng.normal(size=n)
    )
    drift_free = lfilter(*bilinear([1.0, 0.0, 0.0], [1.0, 3.0, 4.0], 1.0 / DT), soil)
    t = np.arange(n) * DT
    motion = drift_free * (t / 3.0) ** 2 * np.exp(2.0 - 2.0 * t / 3.0)
    return motion / np.abs(motion).max()


def ground_motion(seed: int, level: float) -> tuple[Record, ...]:
    """Accelerations of the base of the column and of the two ends, with a peak of `level` [g] at the base."""
    rng = np.random.default_rng([args.seed, 1, seed])
    base, *others = (filtered_noise(rng, STEPS) for _ in range(3))
    return tuple(
        Record(f"synthetic {seed}, {place}", DT, G * level * motion)
        for place, motion in zip(
            ("base", "first end", "second end"), (base, *(base + 0.3 * other for other in others)), strict=True
        )
    )


def true_response(seed: int, supports: tuple[Record, ...]) -> np.ndarray:
    """Acceleration of the deck in one event, with the parameters of this event and a second mode."""
    rng = np.random.default_rng([args.seed, 2, seed])
    own = {name: value * np.exp(SPREAD.get(name, 0.0) * rng.normal()) for name, value in TRUTH.items()}
    deck = LinearStructure(EquivalentLinear(BridgeDeck("deck"), REFERENCE), supports)
    second = LinearStructure(BridgeDeck("deck", share=0.0), supports)
    (first,), (higher,) = deck.simulate(list(own.values())), second.simulate([7.5, 0.05])
    return first + 0.4 * (higher - supports[0].acceleration)


def measure(seed: int, supports: tuple[Record, ...]) -> Measurements:
    """Measured acceleration of the deck: the true one and the noise of a sensor."""
    rng = np.random.default_rng([args.seed, 3, seed])
    response = true_response(seed, supports)
    channels = LinearStructure(BridgeDeck("deck"), supports).channels
    return Measurements(channels, DT, [response + SENSOR * rng.normal(size=response.size)])


rng = np.random.default_rng(args.seed)
low, high = np.log(LEVELS)
levels = np.exp(np.linspace(low, high, CALIBRATED))
events = {f"E{k + 1} ({level:.2f} g)": ground_motion(k, level) for k, level in enumerate(levels)}
measured = {name: measure(k, supports) for k, (name, supports) in enumerate(events.items())}
strongest = list(events)[-1]
new_events = {
    f"new {k + 1} ({level:.2f} g)": ground_motion(100 + k, level)
    for k, level in enumerate(np.exp(rng.uniform(low, high, NEW)))
}
new_measured = {name: measure(100 + k, supports) for k, (name, supports) in enumerate(new_events.items())}

# %%
# Each event alone
# ----------------
#
# The model is linear: frequency and damping; the share of the ends in the stiffness is taken as known. The noise is a
# share of the response, because the error of a model grows with the response (``level="measured"``).

MODEL_PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
PEAK = peak("deck")


def calibrate(supports: tuple[Record, ...], data: Measurements, share: float | None) -> tuple[Posterior, SMCSampler]:
    """Posterior of the linear deck for one event, and the sampler that has run; the share of the ends may be known."""
    model = LinearStructure(BridgeDeck("deck", share=share), supports)
    noise = GaussianNoise(data.channels, level="measured", window=1.0, sensor=(SENSOR,))
    prior = {name: MODEL_PRIOR[name] for name in model.parameter_names}
    posterior = Posterior(FELikelihood(model, data, noise), prior | {"share_deck": HalfNormal(1.0)})
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=args.seed)
    sampler.run_mcmc(None, 2, progress=False)
    return posterior, sampler


def store(sampler: SMCSampler, posterior: Posterior) -> StoredPosterior:
    """The samples of one event for comparisons and populations."""
    return StoredPosterior(sampler.get_chain(flat=True), posterior.prior, effective_sample_size=sampler.nwalkers)


posteriors, samplers = {}, {}
for name, supports in events.items():
    posteriors[name], samplers[name] = calibrate(supports, measured[name], TRUTH["share"])
stored = {name: store(samplers[name], posteriors[name]) for name in events}

responses = {name: np.abs(measured[name].values).max() / G for name in events}
fig, axes = plt.subplots(2, 1, figsize=(7, 6), sharex=True, layout="constrained")
for ax, k, label in zip(axes, (0, 1), ("frequency [Hz]", "damping ratio [-]"), strict=True):
    for name, sampler in samplers.items():
        q05, median, q95 = np.quantile(sampler.get_chain(flat=True)[:, k], [0.05, 0.5, 0.95])
        ax.errorbar(responses[name], median, [[median - q05], [q95 - median]], fmt="o", color="C0", capsize=3)
    ax.set_ylabel(label)
    ax.set_xscale("log")
axes[0].set_title("Each event calibrated alone: median and 90 % interval (synthetic data)")
axes[1].set_xlabel("measured peak of the deck [g]")
fig.savefig(args.out / "events.png", dpi=150)

# %%
# New events from one event, as usual
# -----------------------------------
#
# The posterior of the strongest event predicts the new events. Its intervals contain the errors of its parameters, and
# nothing of what differs between events. `Prediction.score` compares the peaks with the measured ones. CRPS and
# interval score are proper: narrow intervals at the wrong place lose as much as wide ones. `propagate` warns where the
# predicted peaks are outside of the calibrated range, or where the residuals contradict the noise.

chain = samplers[strongest].get_chain(flat=True)
as_usual, warned = {}, {}
for name, supports in new_events.items():
    rows = chain[:: max(1, len(chain) // DRAWS)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        prediction = propagate(
            posteriors[strongest], rows, record=supports, quantity=PEAK, seed=args.seed, progress=False
        )
    warned |= {name: str(caught[0].message)} if caught else {}
    as_usual[name] = prediction.score(new_measured[name])
print(f"\npropagate warned about {len(warned)} of {NEW} new events, such as:\n{next(iter(warned.values()), 'nothing')}")

# %%
# New events from the population of the events
# --------------------------------------------
#
# `Hierarchy` is the population of the parameters: medians and standard deviations between events. `predict_new_event`
# has one ratio for each event, of the measured peak to the peak at the median parameters of the population. This ratio
# contains the error of the model, the spread of the parameters and their correlation. Eight events do not know how much
# events scatter, so a scatter is expected from the model, and the prediction says how much of its width is due to it.
# Each event is simulated five times for this.

POPULATION = {  # priors of medians and of standard deviations of logarithms: assumed, wide
    "frequency": Varying(LogNormal(5.0, 0.5), HalfNormal(0.3)),
    "damping": Varying(LogNormal(0.1, 1.0), HalfNormal(0.7)),
    "share": Varying(LogNormal(0.8, 0.3), HalfNormal(0.3)),
}


def population(tests: dict[str, StoredPosterior]) -> Hierarchy:
    """The population of some events."""
    names = next(iter(tests.values())).prior.names
    varying = {name: each for name, each in POPULATION.items() if name in names}
    hierarchical = HierarchicalPosterior(tests, varying)
    moves = {} if fast else {"min_moves": 10, "max_moves": 30}  # they cost no simulation
    sampler = SMCSampler(
        max(WALKERS // 2, 60), hierarchical.ndim, hierarchical, vectorize=True, seed=args.seed, **moves
    )
    sampler.run_mcmc(None, 1, progress=False)
    return Hierarchy(hierarchical, sampler.get_chain(flat=True))


hierarchy = population(stored)
print(f"\n{hierarchy.spread}")
ratios = event_ratios(hierarchy, posteriors, PEAK)
print(ratios)
from_events = {}
for name, supports in new_events.items():
    prediction = predict_new_event(hierarchy, posteriors, supports, quantity=PEAK, seed=args.seed)
    from_events[name] = prediction.score(new_measured[name])


def show_scores(title: str, scores: dict) -> dict[str, float]:
    """Print one line of scores of predicted peaks; return the numbers."""
    pit = [each.pit[0] for each in scores.values()]
    shares = {f"within {100 * level:.0f} %": share_within(pit, level) for level in (0.9, 0.5)}
    numbers = {
        "CRPS / measured": float(np.mean([each.crps[0] / each.measured[0] for each in scores.values()])),
        "interval score / measured": float(
            np.mean([each.interval_score[0] / each.measured[0] for each in scores.values()])
        ),
        "upper / lower end": float(np.median([each.upper[0] / each.lower[0] for each in scores.values()])),
    }
    said = [f"{name} {share}" for name, share in shares.items()]
    print(f"{title:36s}" + "; ".join([*said, *(f"{name} {value:.2f}" for name, value in numbers.items())]))
    return numbers | {name: share.value for name, share in shares.items()}


print(f"\nPeaks of {NEW} new events (synthetic)")
summary = {
    "one event, as usual": show_scores("one event, as usual", as_usual),
    "population of events": show_scores(f"population of {CALIBRATED} events", from_events),
}
for file, scores in (("scores_as_usual", as_usual), ("scores_events", from_events)):
    plot_scores(scores).savefig(args.out / f"{file}.png", dpi=150)

# %%
# Does the amplitude explain the spread?
# --------------------------------------
#
# All events together, with common parameters (and one share of noise): once with constant stiffness and damping, once
# with stiffness and damping that follow the level of the response (`EquivalentLinear`, two parameters more). Their
# evidences are compared. The parameters still vary between events, so that their stated errors are too small.


def joint(amplitude: bool) -> tuple[Posterior, SMCSampler]:
    """The joint posterior of all events, and the sampler that has run."""
    likelihoods = {}
    chosen = list(events)[:: 3 if fast else 1]
    for number, (name, supports) in enumerate([(name, events[name]) for name in chosen], start=1):
        parts = BridgeDeck("deck", share=TRUTH["share"])
        model = LinearStructure(EquivalentLinear(parts, REFERENCE) if amplitude else parts, supports)
        noise = GaussianNoise(measured[name].channels, level="measured", window=1.0, sensor=(SENSOR,))
        likelihoods[f"E{number}"] = FELikelihood(model, measured[name], noise)
    own = {"softening": Uniform(0.0, 0.6), "damping_growth": Uniform(0.0, 1.0)} if amplitude else {}
    prior = {name: MODEL_PRIOR[name] for name in ("frequency", "damping")} | {"share_deck": HalfNormal(1.0)}
    posterior = Posterior(JointLikelihood(likelihoods), prior | own)
    guide = posterior.guide()  # hundreds of simulations instead of thousands
    sampler = SMCSampler(60 if fast else 120, posterior.ndim, posterior, vectorize=True, seed=args.seed, guide=guide)
    sampler.run_mcmc(None, 2, progress=False)
    return posterior, sampler


joints = {"constant": joint(False), "by amplitude": joint(True)}
comparison = compare_models({name: sampler for name, (_, sampler) in joints.items()})
print(f"\n{comparison.table()}")
for name, (_, sampler) in joints.items():
    print(f"{name}: {sampler.simulations:.0f} simulations")
posterior, sampler = joints["by amplitude"]
for name, column in zip(posterior.parameter_names, sampler.get_chain(flat=True).T, strict=True):
    if name in TRUTH:
        print(f"{name:15s} {column.mean():.3f} +- {column.std():.3f}, true median {TRUTH[name]:g}")

# %%
# Fragility
# ---------
#
# The probability that the peak of the deck exceeds a limit, under several motions at each of some intensities: once
# from the strongest event as usual, once with the spread between events and the ratio of peaks. The synthetic bridge
# has one event under each motion, with parameters of its own: its peak exceeds the limit or not. The Brier score, the
# mean square of (probability - outcome), judges the probabilities; 0 is best, a coin has 0.25. In the full setting it
# is 0.13 as usual, where 10 of 84 outcomes are given a probability below 1 %, and 0.06 with the population, where none
# is. The mean over the motions is the fragility of the bridge. As usual it is too small at low intensities, because the
# deck is stiffer and less damped there than in the strongest event.

LIMIT = 0.5 * G
GRID = np.exp(np.linspace(np.log(0.12), np.log(0.5), 4 if fast else 7))
PER_LEVEL = 3 if fast else 12
numbers = [1000 + k for k in range(len(GRID) * PER_LEVEL)]
records = [ground_motion(k, level) for k, level in zip(numbers, np.repeat(GRID, PER_LEVEL), strict=True)]
exceeded = np.array(
    [np.abs(true_response(k, supports)).max() > LIMIT for k, supports in zip(numbers, records, strict=True)]
)
options = {"quantity": PEAK, "threshold": LIMIT, "level": 0.9, "seed": args.seed, "progress": False}
curves = {
    "one event, as usual": fragility(
        posteriors[strongest], chain[:: max(1, len(chain) // DRAWS)], records, noise=False, **options
    ),
    "population of events": fragility(posteriors[strongest], hierarchy, records, ratios=ratios, **options),
}
fig, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
summary["fragility"] = {}
for ax, (label, curve) in zip(axes, curves.items(), strict=True):
    brier = float(np.mean((curve.probability - exceeded) ** 2))
    denied = int(np.sum(exceeded & (curve.probability < 0.01)) + np.sum(~exceeded & (curve.probability > 0.99)))
    summary["fragility"][label] = {"Brier score": brier, "wrong and certain": denied}
    print(f"{label}: Brier score {brier:.3f}; {denied} of {len(exceeded)} outcomes were given less than 1 %")
    intensity = np.repeat(GRID, PER_LEVEL)
    for outcome, marker, name in ((True, "^", "exceeded"), (False, "v", "not exceeded")):
        chosen = exceeded == outcome
        ax.plot(intensity[chosen], curve.probability[chosen], marker, color="C0" if outcome else "C1", label=name)
    ax.plot(GRID, curve.probability.reshape(-1, PER_LEVEL).mean(axis=1), color="0.4", label="mean of the motions")
    ax.plot(GRID, exceeded.reshape(-1, PER_LEVEL).mean(axis=1), "k--", label="share exceeded (synthetic truth)")
    ax.set_title(f"{label}: Brier score {brier:.3f}")
    ax.set_xlabel("peak acceleration of the base [g]")
axes[0].set_ylabel(f"P(peak of the deck > {from_si(LIMIT, 'g'):.2g} g)")
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
fig.savefig(args.out / "fragility.png", dpi=150)

# %%
# The real bridge
# ---------------
#
# The same with earthquakes of the Painter Street Overpass: channel 7 at the middle of the deck, channels 3, 4 and 9 at
# the base of the column and at the ends. Each event is predicted from the others: `leave_one_out` takes an event out of
# the population by weights, without a new calibration.


def read_real(folder: Path) -> dict[str, tuple[tuple[Record, ...], Measurements]]:
    """Supports and measured deck of every downloaded event."""
    found = {}
    for path in sorted(folder.rglob("*ce89324p.zip")):
        channels = {}
        for number in (3, 4, 9, 7):
            for member in ("CHAN{:d}.V2", "CHAN{:02d}.V2", "CHAN{:03d}.V2", "chan{:03d}.v2"):
                try:
                    channels[number] = read_record(path, number, member=member.format(number))
                    break
                except ValueError as error:
                    reason = error
            else:
                raise ValueError(f"{path.name}: no channel {number}: {reason}")
        end = min((each.n_steps - 1) * each.dt for each in channels.values())
        base, first, second, deck = (each.trim(0.0, end) for each in channels.values())
        model = LinearStructure(BridgeDeck("deck"), (base, first, second))
        data = Measurements(model.channels, model.dt, [deck.acceleration])
        found[path.name.removesuffix("_ce89324p.zip")] = (base, first, second), data
    return found


if args.data is None:
    print("\nThe real bridge: not run; give --data FOLDER with the files *ce89324p.zip of www.strongmotioncenter.org")
else:
    real = read_real(args.data)
    if len(real) < 3:
        raise SystemExit(f"expected three files *ce89324p.zip or more in {args.data}; found {len(real)}")
    if fast:
        real = dict(list(real.items())[:4])
    fitted = {name: calibrate(*each, None) for name, each in real.items()}
    real_posteriors = {name: posterior for name, (posterior, _) in fitted.items()}
    real_stored = {name: store(sampler, posterior) for name, (posterior, sampler) in fitted.items()}
    real_population = population(real_stored)
    print(f"\nPainter Street, real measurements\n{real_population.spread}")
    left_out = leave_one_out(real_population, seed=args.seed)
    held_out = left_out.scores(real_posteriors, quantity=PEAK, seed=args.seed)
    real_scores = {name: each.scores for name, each in held_out.items()}
    summary["Painter Street, each from the others"] = show_scores("Painter Street, each from the others", real_scores)
    plot_scores(real_scores).savefig(args.out / "scores_painter_street.png", dpi=150)

summary |= {"evidence": {name: sampler.log_evidence for name, (_, sampler) in joints.items()}}
(args.out / "summary.json").write_text(json.dumps(summary, indent=2))
print(f"{time.perf_counter() - begin:.0f} s; figures and summary.json in {args.out}/")
