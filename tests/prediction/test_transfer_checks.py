"""Warnings of predictions beyond their calibration: on runs that are wrong, and how often on runs that are right."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    JointLikelihood,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    StoredPosterior,
    Uniform,
    Varying,
    peak,
    predict_new_event,
    propagate,
)

TOP = Channel("top", "displacement", "mm")
N, DT, SIGMA = 600, 0.02, 0.004


class Filter:
    """Response of a damped oscillation to an excitation (n_steps,), times a gain."""

    parameter_names, channels, dt, n_steps, path_dependent = ("gain",), (TOP,), DT, N, False

    def __init__(self, excitation):
        self.unit = lfilter([0.01], [1.0, -1.9, 0.98], excitation)
        self.fingerprint = f"filter {excitation.tobytes().hex()}"

    def simulate(self, theta):
        return theta[0] * self.unit[None]

    def with_record(self, excitation):
        return Filter(excitation)


def excitation(rng, strength=1.0):
    return strength * rng.standard_normal(N)


def calibrated(rng, *, noise=None, rho=0.0, strength=1.0, n=200):
    """A posterior of measured data with AR(1) errors, and samples of it (the gain is known up to its error)."""
    model = Filter(excitation(rng, strength))
    white = rng.standard_normal(N + 200)
    errors = SIGMA * strength * lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], white)[200:]
    values = model.unit + errors
    measured = Measurements([TOP], DT, values[None])
    noise = GaussianNoise([TOP]) if noise is None else noise
    prior = {"gain": LogNormal(1.0, 0.5)} | {"sigma_top": HalfNormal(0.02)}
    prior |= {"rho_top": Uniform(-0.999, 0.999)} if isinstance(noise, AutoregressiveNoise) else {}
    posterior = Posterior(FELikelihood(model, measured, noise), prior)
    gain, power = values @ model.unit / (model.unit @ model.unit), model.unit @ model.unit
    sd = np.std(values - gain * model.unit)
    columns = [
        gain + sd / np.sqrt(power) * rng.standard_normal(n),
        sd * (1.0 + rng.standard_normal(n) / np.sqrt(2 * N)),
    ]
    columns += [rho + 0.01 * rng.standard_normal(n)] if isinstance(noise, AutoregressiveNoise) else []
    return posterior, np.stack(columns, axis=1)


def said(function, *arguments, **options) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        function(*arguments, **options, progress=False)
    return [str(each.message) for each in caught]


def test_peaks_beyond_the_calibration_are_said_whatever_is_predicted(rng):
    posterior, samples = calibrated(rng)
    options = {"record": excitation(rng, 5.0), "noise": True, "seed": 1}
    for quantity in (None, "top", peak("top"), lambda response: response[0, 3]):
        found = said(propagate, posterior, samples, quantity=quantity, **options)
        assert sum("predicted peaks are outside" in text for text in found) == 1
        (text,) = (text for text in found if "predicted peaks" in text)
        assert "top (" in text and "times the largest calibrated one" in text and "factor of 2" in text
    (text,) = said(propagate, posterior, samples, record=excitation(rng, 0.1), quantity=peak("top"))
    assert "times the smallest calibrated one" in text
    # the ratio that is stated is that of the peaks
    ratio = float(text.split("top (")[1].split(" times")[0])
    weaker = propagate(
        posterior, samples, record=excitation(np.random.default_rng(2), 0.1), check=False, progress=False
    )
    measured = np.abs(posterior.likelihood.measurements.values).max()
    assert ratio == pytest.approx(np.abs(weaker.mean).max() / measured, rel=0.5) and ratio < 0.5


def test_the_range_is_that_of_all_calibrated_events(rng):
    weak, samples = calibrated(rng)
    strong, _ = calibrated(rng, strength=5.0)
    record = excitation(rng, 5.0)
    joint = JointLikelihood({"weak": weak.likelihood, "strong": strong.likelihood})
    assert said(propagate, weak, samples, record=record)
    assert not said(propagate, joint, samples, data_set="weak", record=record)
    events = [weak.likelihood.measurements, strong.likelihood.measurements]
    assert not said(propagate, weak, samples, record=record, calibrated=events)
    assert not said(propagate, weak.likelihood.model, samples[:, :1], record=record)  # nothing is known of a bare model
    assert said(propagate, weak.likelihood.model, samples[:, :1], record=record, calibrated=events[:1])
    assert not said(propagate, weak, samples, record=record, calibrated=())


def test_a_new_event_is_compared_with_the_events_of_the_hierarchy(rng):
    events = {name: calibrated(rng, strength=each) for name, each in (("weak", 1.0), ("strong", 4.0))}
    posteriors = {name: each for name, (each, _) in events.items()}

    def population(names):
        tests = {name: StoredPosterior(events[name][1], posteriors[name].prior) for name in names}
        varying = {"gain": Varying(LogNormal(1.0, 0.5), HalfNormal(0.1))}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            known = [1.0, 0.05] * np.exp(0.01 * rng.standard_normal((50, 2)))
            return Hierarchy(HierarchicalPosterior(tests, varying), known)

    both, single = population(events), population(["weak"])
    for quantity in (peak("top"), None):
        for strength, number in ((4.0, 0), (1.0, 0), (12.0, 1), (0.2, 1)):
            record = excitation(rng, strength)
            found = said(predict_new_event, both, posteriors, record, quantity=quantity, n=20)
            assert len(found) == number
            assert not any("Hierarchy" in text for text in found), "which is the population in use"
    # a population of one event: the spread between events is stated
    (text,) = said(predict_new_event, single, posteriors, excitation(rng, 12.0), quantity=peak("top"), n=50)
    assert "Calibrate with events of this amplitude" in text and "Hierarchy" not in text
    # control: samples of one posterior
    (text,) = said(propagate, *events["weak"], record=excitation(rng, 12.0), check=False)
    assert "or let parameters vary between events (in Python, Hierarchy)" in text


def test_a_motion_that_changes_nothing_is_said(rng):
    """As of a program that reads one file, whatever motion it is given."""
    motion = Record("calibration", DT, excitation(rng))
    noise = SIGMA * rng.standard_normal((1, N))

    def predicted(unread, record):
        def respond(theta, given):
            read = motion if unread else given
            return theta[0] * lfilter([0.01], [1.0, -1.9, 0.98], read.acceleration)[None, : given.n_steps]

        model = FunctionModel(respond, ("gain",), (TOP,), record=motion)
        likelihood = FELikelihood(model, Measurements([TOP], DT, respond([1.0], motion) + noise))
        samples = np.column_stack([rng.normal(1.0, 0.01, 20), np.full(20, SIGMA)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return propagate(likelihood, samples, record=record, from_state="virgin", progress=False).findings

    said = [
        any("changes nothing" in each.kind for each in predicted(unread, motion.scale(1.2))) for unread in (True, False)
    ]
    assert said == [True, False]
    for same in (motion, motion.trim(0.0, 6.0)):  # the calibration again, and a part of it
        assert not any("changes nothing" in each.kind for each in predicted(False, same))


def test_a_harmonic_is_said_and_another_broad_motion_is_not(rng):
    record = Record("noise", 0.02, rng.standard_normal(1000))
    model = LinearOscillator(record)
    posterior = FELikelihood(model, Measurements(model.channels, model.dt, model.simulate([1.0, 1.0])))
    sine = Record("sine", 0.02, np.sin(2.0 * np.pi * 0.02 * np.arange(1000)))
    options = {"samples": np.ones((20, 2)), "calibrated": (), "check": False, "progress": False}

    def about_harmonics(motion):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = propagate(posterior, record=motion, **options).findings
        return [each.text for each in found if "as a harmonic has" in each.text]

    (text,) = about_harmonics(sine)
    assert "in a band of 0.05 Hz" in text  # one line of the Fourier transform of 20 s
    for other in (
        record.scale(3.0),
        Record("other", 0.02, rng.standard_normal(400)),
        Record("still", 0.02, np.zeros(400)),
    ):
        assert about_harmonics(other) == []


def test_a_motion_that_is_read_is_compared_by_one_simulation_that_is_counted(rng):
    for check, expected in ((True, 1), (False, 0)):
        posterior, samples = calibrated(np.random.default_rng(3))
        propagate(posterior, samples, record=excitation(rng), check=check, progress=False)
        assert posterior.report()["simulations"] == expected
