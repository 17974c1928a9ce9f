"""Records and imposed displacements: validation, resampling, trimming, fingerprints."""

import numpy as np
import pytest

from fe_likelihoods.signals.records import DisplacementHistory, Record


def sine(frequency, dt, n_steps, phase=0.3):
    return Record("sine", dt, np.sin(2 * np.pi * frequency * np.arange(n_steps) * dt + phase))


class TestRecord:
    def test_samples_are_a_read_only_copy(self):
        samples = np.arange(4)
        record = Record("ramp", 0.5, samples)
        samples[0] = 99
        assert record.acceleration.dtype == np.float64 and record.acceleration[0] == 0
        with pytest.raises(ValueError, match="read-only"):
            record.acceleration[0] = 1.0
        assert (record.n_steps, record.duration) == (4, 1.5)
        np.testing.assert_array_equal(record.time, [0, 0.5, 1.0, 1.5])
        assert str(record) == "ramp, 4 samples at 0.5 s, peak 0.306 g"

    @pytest.mark.parametrize(
        ("dt", "samples", "message"),
        [
            *((dt, [0.0, 1.0], "'r' must be a positive number of seconds") for dt in (0, -0.01, np.nan, "fast", None)),
            *((0.01, bad, "with 2 samples or more, got shape") for bad in ([], [1.0], [[1.0, 2.0]], 3.0)),
            (0.01, [0, 1, 2, np.inf, np.nan], "2 of 5 that are not, the first is sample 3"),
            (0.01, [0.0, 1j], "acceleration of 'r': expected real numbers, got complex ones"),
            (0.01, ["zero", "one"], "'r': expected an array of numbers"),
        ],
    )
    def test_what_is_no_record_is_refused(self, dt, samples, message):
        with pytest.raises(ValueError, match=message):
            Record("r", dt, samples)

    def test_fingerprint_follows_step_and_samples_only(self):
        record = Record("a", 0.01, [0.0, 1.0])
        assert record.fingerprint == Record("b", 0.01, [0.0, 1.0], source="elsewhere").fingerprint
        # BLAKE2b of 128 bits over little-endian doubles. The value must never change.
        assert record.fingerprint == "a2970c360e4e7a2eb2cd610f3efbd3f2"
        others = [Record("a", 0.02, [0.0, 1.0]), Record("a", 0.01, [0.0, np.nextafter(1.0, 2.0)])]
        assert all(other.fingerprint != record.fingerprint for other in others)

    def test_trim_keeps_both_ends(self):
        record = Record("r", 0.02, np.arange(3000))
        for first, last in [(0, 2999), (50, 100), (7, 8), (1234, 2998)]:
            part = record.trim(first * 0.02, last * 0.02)
            np.testing.assert_array_equal(part.acceleration, np.arange(first, last + 1))
        np.testing.assert_array_equal(record.trim(0.03, 0.07).acceleration, [2, 3])
        np.testing.assert_array_equal(record.trim(start=59.9).acceleration, np.arange(2995, 3000))
        assert "trimmed" in record.trim(0, 1).source

    @pytest.mark.parametrize("window", [(-1, 5), (5, 5), (5, 4), (0, 60), (np.nan, 5), (0.021, 0.059)])
    def test_trim_refuses_windows_outside(self, window):
        with pytest.raises(ValueError, match=r"expected 0 <= start < stop <= 59.98 s|fewer than 2 samples"):
            Record("r", 0.02, np.arange(3000)).trim(*window)

    def test_scale(self):
        np.testing.assert_array_equal(Record("r", 0.02, [1, 2]).scale(-2).acceleration, [-2, -4])
        with pytest.raises(ValueError, match="expected a finite number, got nan"):
            Record("r", 0.02, [1, 2]).scale(np.nan)


class TestResample:
    @pytest.mark.parametrize(("dt", "new_dt"), [(0.02, 0.005), (0.02, 0.02 / 3), (0.01, 0.0025)])
    def test_refining_keeps_old_samples_and_interpolates_linearly(self, dt, new_dt, rng):
        record = Record("r", dt, rng.normal(size=101))
        fine = record.resample(new_dt)
        parts = round(dt / new_dt)
        np.testing.assert_array_equal(fine.acceleration[::parts], record.acceleration)
        assert fine.duration == pytest.approx(record.duration, rel=1e-12)
        np.testing.assert_allclose(
            fine.acceleration, np.interp(fine.time, record.time, record.acceleration), atol=1e-12
        )

    def test_refining_by_a_fraction_stays_on_the_lines(self):
        ramp = Record("ramp", 0.02, np.arange(11.0))
        np.testing.assert_allclose(ramp.resample(0.015).acceleration, np.arange(14) * 0.75, atol=1e-14)

    @pytest.mark.parametrize("new_dt", [0.01, 0.02, 0.0125])
    def test_coarsening_keeps_slow_motion(self, new_dt):
        slow = sine(0.5 * 0.5 / new_dt, 0.005, 8001)
        coarse = slow.resample(new_dt)
        expected = np.sin(2 * np.pi * 0.25 / new_dt * coarse.time + 0.3)
        # The docstring states a ripple of 0.3 %. The mirrored ends add a little.
        np.testing.assert_allclose(coarse.acceleration[30:-30], expected[30:-30], atol=3e-3)
        np.testing.assert_allclose(coarse.acceleration, expected, atol=2e-2)
        assert coarse.time[-1] <= slow.duration + 1e-9 < coarse.time[-1] + new_dt

    def test_coarsening_does_not_shift_in_time(self):
        pulse = Record("pulse", 0.005, np.exp(-0.5 * ((np.arange(4001) - 2000) / 40) ** 2))
        coarse = pulse.resample(0.02)
        assert np.argmax(coarse.acceleration) == 500
        np.testing.assert_allclose(coarse.acceleration, coarse.acceleration[::-1], atol=1e-12)

    @pytest.mark.parametrize("ratio", [1.2, 1.5, 1.9])
    def test_coarsening_removes_motion_that_would_alias(self, ratio):
        fast = sine(ratio * 25.0, 0.005, 8001)  # 25 Hz is the Nyquist frequency of 0.02 s
        assert np.abs(fast.resample(0.02).acceleration[30:-30]).max() < 3e-3
        # Control: every fourth sample without a filter has the aliased motion at full amplitude.
        assert np.abs(fast.acceleration[::4]).max() > 0.9

    def test_constant_and_drift_are_kept_at_the_ends(self):
        time = np.arange(2001) * 0.005
        drift = Record("drift", 0.005, 3.0 + 0.1 * time).resample(0.02)
        np.testing.assert_allclose(drift.acceleration, 3.0 + 0.1 * drift.time, atol=1e-12)

    def test_short_record_and_same_step(self):
        record = Record("r", 0.01, np.ones(5))
        np.testing.assert_allclose(record.resample(0.02).acceleration, np.ones(3), atol=1e-12)
        assert record.resample(0.01) is record

    def test_refusals(self):
        for dt, message in (
            (0.02 * np.sqrt(2), "ratio of integers up to 1000, got .*; the nearest such step is"),
            (1.5, "must fit twice"),
            (1e-7, "ratio of integers"),
            (0, "positive number of seconds"),
        ):
            with pytest.raises(ValueError, match=message):
                Record("r", 0.02, np.arange(100)).resample(dt)


class TestDisplacementHistory:
    def test_subdivide_bounds_increments_and_keeps_the_points(self, rng):
        history = DisplacementHistory("test", rng.normal(scale=0.05, size=50))
        fine, indices = history.subdivide(0.003)
        assert np.abs(np.diff(fine.displacement)).max() <= 0.003 * (1 + 1e-9)
        np.testing.assert_array_equal(fine.displacement[indices], history.displacement)
        wanted = np.ceil(np.abs(np.diff(history.displacement)) / 0.003).sum() + 1
        assert fine.n_steps == wanted, "no more points than needed"

    def test_refusals_and_fingerprint(self):
        history = DisplacementHistory("test", [0.0, 1.0])
        assert history.fingerprint == DisplacementHistory("other", [0.0, 1.0]).fingerprint
        assert history.fingerprint != DisplacementHistory("test", [0.0, 1.1]).fingerprint
        for bad in (0, -1, np.nan):
            with pytest.raises(ValueError, match="expected a positive length"):
                history.subdivide(bad)
        with pytest.raises(ValueError, match="the first is sample 1"):
            DisplacementHistory("test", [0.0, np.nan])
