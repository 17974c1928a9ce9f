"""Records that follow each other: joined samples, windows of the events, and a state that is carried through."""

import numpy as np
import pytest

from fe_likelihoods import Channel, Events, LinearOscillator, Measurements, RCColumn, Record
from fe_likelihoods.problems import bridge_column_data


@pytest.fixture
def eq1(rng):
    return Record("EQ1", 0.02, rng.normal(size=40), "first test")


@pytest.fixture
def eq2(rng):
    return Record("EQ2", 0.02, rng.normal(size=30))


def by_hand(first, zeros, second):
    return np.concatenate([first.acceleration, np.zeros(zeros), second.acceleration])


class TestFollowedBy:
    def test_samples_are_those_of_both_with_zeros_between(self, eq1, eq2):
        joined = eq1.followed_by(eq2, rest=1.0)
        np.testing.assert_array_equal(joined.acceleration, by_hand(eq1, 50, eq2))
        assert joined.dt == eq1.dt and joined.name == "EQ1, EQ2"
        assert "first test; after a pause of 1 s followed by EQ2" in joined.source
        assert eq1.followed_by(eq2).n_steps == 40 + 500 + 30  # 10 s, as everywhere
        assert Events([eq1]).followed_by(eq2).rests == Events([eq1, eq2]).rests == (10.0,)

    def test_pause_is_rounded_to_steps(self, eq1, eq2):
        assert eq1.followed_by(eq2, rest=0.031).n_steps == 72
        assert eq1.followed_by(eq2, rest=0).n_steps == 70
        for rest in (-0.02, np.nan, np.inf, "long", None):
            with pytest.raises(ValueError, match="pause between two records must be zero or more seconds, got"):
                eq1.followed_by(eq2, rest=rest)
        with pytest.raises(ValueError, match=r"same time step, got 0.02 s \('EQ1'\) and 0.01 s.*use Record.resample"):
            eq1.followed_by(eq2.resample(0.01))
        with pytest.raises(ValueError, match="'EQ1' must be followed by a Record, got ndarray"):
            eq1.followed_by(np.ones(5))

    def test_response_has_the_bits_of_one_long_record(self):
        eq1 = bridge_column_data().record.trim(0.0, 1.0)
        eq2 = eq1.scale(2.0)
        joined, long = eq1.followed_by(eq2, rest=0.5), Record("long", eq1.dt, by_hand(eq1, round(0.5 / eq1.dt), eq2))
        assert joined.fingerprint == long.fingerprint == Events([eq1, eq2], rest=0.5).fingerprint
        for structure in (RCColumn.lhpost, LinearOscillator):
            ours, theirs = structure(joined), structure(long)
            theta = np.full(len(ours.parameter_names), 1.1)
            np.testing.assert_array_equal(ours.simulate(theta), theirs.simulate(theta))
            assert ours.fingerprint == theirs.fingerprint
            assert structure(Events([eq1, eq2])).with_record(long).fingerprint == theirs.fingerprint


class TestEvents:
    def test_windows_keep_the_times_of_the_events(self, eq1, eq2):
        events = Events([eq1, eq2, eq1], rest=1.0)
        assert events.names == ("EQ1", "EQ2", "EQ1_2") and events.records == (eq1, eq2, eq1)
        window = events.window("EQ2")
        assert (window.first, window.stop) == (90, 120)
        assert window.start == pytest.approx(1.8) and window.end == pytest.approx(1.8 + eq2.duration)
        for record, each in zip(events.records, events.windows, strict=True):
            np.testing.assert_array_equal(events.acceleration[each.samples], record.acceleration)
            assert events.time[each.first] == each.start
        assert np.count_nonzero(events.acceleration) == 40 + 30 + 40

    def test_pauses_may_differ(self, eq1, eq2):
        events = Events([eq1, eq2, eq1], rest=[0.1, 0.2], names=["a", "b", "c"])
        assert [window.first for window in events.windows] == [0, 45, 85] and events.names == ("a", "b", "c")

    def test_events_in_events_are_taken_apart(self, eq1, eq2):
        nested = Events([Events([eq1, eq2], rest=0.1), eq1], rest=1.0)
        assert nested.rests == pytest.approx((0.1, 1.0)) and nested.names == ("EQ1", "EQ2", "EQ1_2")
        assert Events([eq1, eq2], 0.1).followed_by(eq1, 1.0).fingerprint == nested.fingerprint

    def test_histories_are_split(self, eq1, eq2):
        events = Events([eq1, eq2], rest=1.0)
        parts = events.split(np.stack([events.acceleration, events.time]))
        np.testing.assert_array_equal(parts["EQ2"][0], eq2.acceleration)
        assert parts["EQ1"].shape == (2, 40)
        with pytest.raises(ValueError, match=r"expected histories of 120 samples, got \(2, 5\)"):
            events.split(np.ones((2, 5)))

    def test_scaled_and_resampled_events_keep_their_windows(self, eq1, eq2):
        events = Events([eq1, eq2], rest=1.0)
        assert events.scale(2.0).windows == events.windows
        np.testing.assert_array_equal(events.scale(2.0).acceleration, 2.0 * events.acceleration)
        fine = events.resample(0.01)
        assert fine.window("EQ2").start == pytest.approx(events.window("EQ2").start - 0.01, abs=0.011)
        np.testing.assert_array_equal(fine.split(fine.acceleration)["EQ2"][::2], eq2.acceleration)
        assert type(events.trim(0.0, 0.5)) is Record

    def test_bad_input_is_refused(self, eq1, eq2):
        cases = {
            "one Record or more, got none": ([],),
            "one Record or more, got ndarray": ([np.ones(5)],),
            "the events would overlap": ([eq1, eq2], -0.1),
            "one for each of the 1 pauses": ([eq1, eq2], [1.0, 2.0]),
            "expected records of the same time step": ([eq1, eq2.resample(0.01)],),
            "2 different texts": ([eq1, eq2], 1.0, ["a", "a"]),
        }
        for message, arguments in cases.items():
            with pytest.raises(ValueError, match=message):
                Events(*arguments)
        with pytest.raises(ValueError, match="no event 'EQ3'; the events are EQ1"):
            Events([eq1]).window("EQ3")


@pytest.mark.parametrize("step", [0.01 * (1.0 + 1e-9), 0.01 * (1.0 + 2e-10), 0.01 * (1.0 - 2e-10)])
def test_steps_that_differ_by_round_off_are_joined_or_refused(step):
    """The end of the second event had been beyond the joined samples: an error of numpy."""
    events = Events([Record("a", 0.01, np.ones(3001)), Record("b", 0.01, np.ones(3001))], rest=10.0)
    measured = Measurements([Channel("top", "displacement", "m")], step, [np.ones(round(30.0 / step) + 1)])
    try:
        assert np.nansum(events.join({"a": measured, "b": measured}).values) == 2 * measured.n_steps
    except ValueError as error:
        assert "samples in the event" in str(error) or "at a multiple of the step" in str(error)
