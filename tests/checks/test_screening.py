"""What measurements and motions show by themselves is named before any simulation, and good ones are left alone."""

import numpy as np

from fe_likelihoods import Channel, Events, Measurements, Record, check_data
from fe_likelihoods.checks.screening import screen

TOP, DECK = Channel("top", "displacement", "mm"), Channel("deck", "acceleration", "g")
TIMES = 0.02 * np.arange(500)
WAVES = np.sin(np.multiply.outer([9.0, 31.0], TIMES)) * TIMES * np.exp(-0.5 * TIMES)
VALUES = (WAVES + 0.01 * np.random.default_rng(1).standard_normal((2, 500))) * [[0.02], [3.0]]
MOTION = Record("EQ", 0.02, 2.0 * np.random.default_rng(2).standard_normal(500))


def kinds(values=VALUES, record=MOTION, description=""):
    return [each.kind for each in check_data(Measurements([TOP, DECK], 0.02, values, description), record)]


def test_plausible_data_are_left_alone():
    assert kinds() == [] and kinds(record=None) == [] and kinds(record=[MOTION, MOTION.scale(0.5)]) == []
    assert kinds(record=Events([MOTION, MOTION.scale(0.5)], rest=1.0)) == []


def test_straight_parts_are_gaps():
    straight = VALUES.copy()
    straight[1, 200:231] = np.linspace(straight[1, 200], straight[1, 230], 31)
    (found,) = check_data(Measurements([TOP, DECK], 0.02, straight))
    assert (found.kind, found.severity) == ("A channel has gaps", "care") and '"deck", 4.000, 4.600' in found.action


def test_data_without_time_are_not_screened_for_faults_of_sensors():
    values = np.full((2, 500), np.nan)
    values[0], values[1] = VALUES[0], VALUES[1] + 10.0
    assert len(screen(Measurements([TOP, DECK], 0.02, values))) == 1
    assert screen(Measurements([TOP, DECK], 0.02, values, axis="position")) == []


def test_a_channel_that_never_changes_is_named():
    silent = VALUES.copy()
    silent[0] = 0.01
    assert kinds(silent) == ["A sensor was silent"]
