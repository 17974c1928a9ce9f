"""Damage: measures against closed forms and the histories of the column, limit states, and what is refused."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    ColumnAnalysis,
    DisplacementHistory,
    EventRatios,
    Events,
    FunctionModel,
    LinearOscillator,
    LogNormal,
    RCColumn,
    Record,
    SimulationFailed,
    damage,
    damage_measures,
    damage_outputs,
    park_ang_constants,
    plot_damage,
    problems,
    propagate,
)
from fe_likelihoods.column_damage.damage import LimitState
from fe_likelihoods.column_damage.park_ang import ParkAng
from fe_likelihoods.prediction.quantities import evaluator

TRUTH = np.array(list(problems.BRIDGE_COLUMN_MEANS.values()))
CONSTANTS = ParkAng(0.36, 5e5)


def bare(loading):
    """The column with the two outputs of the whole structure."""
    return RCColumn.lhpost(loading, outputs=("displacement", "base_shear"))


def stand_in(column, respond):
    """A model of one parameter whose response, (displacement, base shear), stands for the response of the column."""
    return FunctionModel(lambda theta: respond(theta[0]), ["factor"], column.channels, column.dt, column.n_steps)


def measured(measures, column, response):
    """The measures of one response by name."""
    return measures.split(evaluator(measures, column.channels, column.dt, column.n_steps).function(response))


LOOP = bare(Record("eight cycles", 0.001, np.zeros(8001)))
TIME = LOOP.dt * np.arange(LOOP.n_steps)
OMEGA, DAMPER = 2.0 * np.pi, 6e3


def loop(amplitude):
    """A viscous-elastic loop; it fails for negative amplitudes."""
    if amplitude < 0.0:
        raise SimulationFailed("negative amplitude")
    u, v = amplitude * np.sin(OMEGA * TIME), amplitude * OMEGA * np.cos(OMEGA * TIME)
    return np.stack([u + 0.01, 4e5 * u + DAMPER * v])


DRIFTS = damage_measures(LOOP, measures=("peak drift", "residual drift"))


@pytest.fixture(scope="module")
def column():
    motion = problems.bridge_column_data().record.trim(6.0, 12.0).resample(8 / 256)
    events = Events([motion, motion.scale(4.0), motion], rest=4.0, names=["EQ1", "EQ2", "EQ3"])
    plain = RCColumn.lhpost(events)
    return replace(plain, outputs=damage_outputs(plain))


@pytest.fixture(scope="module")
def prediction(column):
    samples = TRUTH * (1.0 + 0.1 * np.random.default_rng(1).standard_normal((12, 5)))
    return propagate(column, samples, quantity=damage_measures(column, park_ang=CONSTANTS), progress=False)


def test_collapsed_columns_reach_every_limit_state(prediction):
    """A third of the samples collapsed, and one failed otherwise: p = c + (1 - c) p' for the others."""
    fallen = replace(prediction, collapsed=np.arange(12, 18), failed=np.arange(12, 19))
    others, found = damage(prediction, noise=False), damage(fallen, noise=False)
    for name, each in others.presence.items():
        np.testing.assert_allclose(found.presence[name].probability, (6.0 + 12.0 * each.probability) / 18.0)
    assert all(each.probability.min() >= 1.0 / 3.0 for each in found.location.values())
    assert "6 of 19 structures collapsed" in str(found) and "1 of 19 samples failed" in str(found)
    options = {"values": prediction.values[:0], "n_samples": 0, "failed": np.arange(5), "collapsed": np.arange(5)}
    every = damage(replace(prediction, **options), noise=False)
    assert all((each.probability == 1.0).all() for each in every.presence.values()) and every.extent == {}
    assert "5 of 5 structures collapsed" in str(every)


def test_energy_drifts_and_index_of_a_loop():
    names = ("peak drift", "residual drift", "dissipated energy", "Park-Ang index")
    measures = damage_measures(LOOP, measures=names, park_ang=ParkAng(0.2, 8e3, 0.1), settle=2.0)
    found = measured(measures, LOOP, loop(0.05))
    energy = 8 * np.pi * DAMPER * OMEGA * 0.05**2  # eight cycles
    np.testing.assert_allclose(found["dissipated energy"], energy, rtol=1e-4)
    np.testing.assert_allclose(found["peak drift"], 0.06 / LOOP.height, rtol=1e-5)
    np.testing.assert_allclose(found["residual drift"], 0.01 / LOOP.height, rtol=1e-3)
    np.testing.assert_allclose(found["Park-Ang index"], 0.06 / 0.2 + 0.1 * energy / (8e3 * 0.2), rtol=1e-4)


def test_residual_drifts_of_a_structure_that_still_moves_are_said(rng):
    """An oscillator of 1 Hz beside a displacement that stays: free vibration of 8 or 60 s after each event."""
    motion = Record("EQ", 0.02, rng.standard_normal(500))
    for rests, moves in ((8.0, True), (60.0, False)):
        events = Events([motion, motion, Record("rest", 0.02, [0.0, 0.0])], rest=rests, names=["EQ1", "EQ2", "rest"])
        wave = LinearOscillator(events).simulate([1.0, 1.0])[1]
        column, u = bare(events), wave + 0.02 * np.abs(wave).max()
        model = stand_in(column, lambda factor, u=u: factor * np.stack([u, u]))
        model.record = events
        for settle in (0.1, 1.0):  # a mean over a period is known while the structure vibrates
            measures = damage_measures(column, measures=("residual drift",), settle=settle)
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                found = damage(propagate(model, np.ones((5, 1)), quantity=measures, progress=False), [], noise=False)
            texts = [each.text for each in found.prediction.findings if "still moves in the last 2 s" in each.text]
            assert len(texts) == len(told) == (moves and settle < 1.0)
            assert all(
                "after EQ1 of displacement (+- " in text and "after EQ2 of displacement (+- " in text for text in texts
            )
            assert ("CAUTION" in str(found)) == bool(texts)


def test_strains_of_a_column_are_the_largest_so_far_at_their_places(column):
    measures = damage_measures(column, park_ang=CONSTANTS)
    found = measured(measures, column, column.simulate(TRUTH))
    history = column.history(TRUTH)
    bar, radius, height = column.bar_circle_radius, 0.5 * column.diameter, column.section_heights[1]
    names = [channel.name for channel in column.channels]
    for k, x in enumerate((-bar, bar)):
        (name,) = [n for n in names if n.startswith(f"strain@{height:g}:") and abs(float(n.split(":")[1]) - x) < 1e-6]
        ends = [*(w.first for w in column.loading.windows[1:]), column.n_steps]
        expected = [history[name][:end].max() for end in ends]
        np.testing.assert_array_equal(found["bar tension"][:, 1, k], expected)
    surface = history[f"strain@0:{radius:.10g}"]
    assert found["cover compression"][2, 0, 1] == -surface.min()
    assert found["bar tension"].shape == (3, len(np.unique(np.round(column.section_heights, 9))), 2)
    assert (np.diff(found["bar tension"], axis=0) >= 0.0).all() and found["bar tension"].argmax(axis=1).max() == 0


def test_presence_location_and_extent(column, prediction):
    found = damage(prediction)
    tension = prediction.quantity.split(prediction.values)["bar tension"]
    limit = column.steel.fy / column.steel.es
    np.testing.assert_allclose(found.location["bar yield"].probability, (tension > limit).mean(axis=0))
    np.testing.assert_allclose(found.presence["bar yield"].probability, (tension.max(axis=(2, 3)) > limit).mean(axis=0))
    assert found.presence["bar yield"].threshold == limit and found.presence["bar yield"].probability[0] < 1.0
    assert found.presence["bar yield"].probability[1] == 1.0 and 0.5 < found.presence["bar yield"].lower[1] < 1.0
    np.testing.assert_allclose(
        found.extent["bar tension"], np.quantile(tension, prediction.probabilities, axis=0, method="weibull"), rtol=1e-6
    )
    drift = prediction.quantity.split(prediction.values)["residual drift"]
    share = damage(prediction, [LimitState("any", "residual drift", np.median(drift[:, 1]))]).presence["any"]
    assert share.probability[1] == 0.5 and share.standard_error[1] == pytest.approx(np.sqrt(0.25 / 12))
    text = found.table()
    assert "bar yield" in text and "1 (0.7" in text and "not the error of the model" in text
    assert found.events == ("EQ1", "EQ2", "EQ3")


def test_samples_that_failed_are_not_counted():
    amplitudes = np.array([[0.01], [-1.0], [0.02], [0.03]])  # peaks of 0.02, -, 0.03 and 0.04 m
    found = propagate(stand_in(LOOP, loop), amplitudes, quantity=DRIFTS, progress=False)
    limits = [LimitState("reached", "peak drift", 0.025 / LOOP.height)]
    assert damage(found, limits).presence["reached"].probability == pytest.approx(2.0 / 3.0)
    assert "\n1 of 4 samples failed and are not counted: probabilities may be too low." in damage(found, limits).table()
    with pytest.raises(ValueError, match="measures are peak drift, residual drift"):
        damage(found, [LimitState("reached", "bar tension", 0.1)])
    with pytest.raises(ValueError, match="interval_probability must be between 0 and 1; got 95"):
        damage(found, limits, interval_probability=95)
    with pytest.raises(ValueError, match="needs probabilities at sections"):
        plot_damage(damage(found, limits))


def pushed(column, constants, *places):
    """Force and strains at places of the base of a column that is pushed to its ultimate displacement."""
    push = DisplacementHistory("push", np.linspace(0.0, constants.ultimate_displacement, 120))
    outputs = ("force", *(f"strain@0:{place:.10g}" for place in places))
    return replace(column, loading=push, outputs=outputs, units=(), parameters=("Ec",)).simulate(np.ones(1))


def test_constants_of_the_index_are_those_of_the_pushed_column(column, caplog):
    """Limited by the hoops, or by a bar where it really is."""
    constants = park_ang_constants(column)
    force, tension, compression = pushed(column, constants, -column.bar_circle_radius, 0.5 * column.core_diameter)
    assert -compression[-1] == pytest.approx(column.confinement.ultimate_strain, rel=2e-3)
    at_yield = column.steel.fy / column.steel.es
    assert constants.yield_force == pytest.approx(np.interp(at_yield, tension, force), rel=2e-3)
    assert "hoops" in constants.source
    bars, steel = replace(column.bars, number=6, first_angle=np.pi / 6), replace(column.steel, ultimate_strain=0.04)
    other = replace(column, bars=bars, steel=steel, analysis=ColumnAnalysis(mesh=10))
    constants = park_ang_constants(other)
    assert "bars at their ultimate strain" in constants.source and not caplog.records
    force, tension = pushed(other, constants, -other.bar_circle_radius * np.cos(np.pi / 6))
    assert tension[-1] == pytest.approx(0.04, rel=5e-3)
    assert constants.yield_force == pytest.approx(np.interp(at_yield, tension, force), rel=2e-3)


def test_what_cannot_be_measured_or_judged_is_refused(column, prediction):
    plain, imposed = replace(column, outputs=None), DisplacementHistory("push", [0.0, 0.1])
    assert damage_measures(plain, measures=("peak drift",)).measures == ("peak drift",)
    state, two = LimitState("x", "peak drift", 0.1), EventRatios([[1.0, 1.1]] * 2)
    energy = {"measures": ("peak drift", "dissipated energy")}
    wrong = (
        (r"lacks the outputs base_shear, strain@0:.*damage_outputs", plain, {}),
        ("lacks the outputs base_shear that peak drift, dissipated energy need", plain, energy),
        ("measures must be some of", column, {"measures": ("crack width",)}),
        ("under a Record", RCColumn.lhpost(imposed, parameters=("Ec",)), {}),
        ("settle must be positive .s.; got '2 s'", column, {"park_ang": CONSTANTS, "settle": "2 s"}),
        ("ultimate_displacement of ParkAng .*got '0.3 m'", column, {"park_ang": ParkAng("0.3 m", 5e5)}),
        ("expected an RCColumn under a Record; got FunctionModel", stand_in(LOOP, loop), {}),
    )
    for message, model, options in wrong:
        with pytest.raises(ValueError, match=message):
            damage_measures(model, **options)
    listed = "limits must be a sequence of LimitState"
    for message, options in (
        *((listed, {"limits": each}) for each in (state, "bar yield", [tuple(state)], 0.1, [0.1])),
        ("different names", {"limits": [state] * 2}),
        *(
            ("the limit of 'x' must be a positive number", {"limits": [state._replace(limit=each)]})
            for each in ("0.2 %", 0.0, np.inf, np.ones(12))
        ),
        ("ratios of strain; the measures are", {"ratios": {"strain": EventRatios([1.0, 1.1])}}),
        ("must be EventRatios of one quantity", {"ratios": two}),
        ("noise of sensors does no damage", {"noise": True}),
    ):
        with pytest.raises(ValueError, match=message):
            damage(prediction, **options)
    for message, changes in (("propagate", {"quantity": None}), ("noise of sensors does no damage", {"noise": True})):
        with pytest.raises(ValueError, match=message):
            damage(replace(prediction, **changes))
    short = {"record": Record("short", column.dt, np.zeros(20)), "from_state": "virgin", "progress": False}
    with pytest.raises(ValueError, match="is for responses of .* samples, got 20"):
        propagate(column, TRUTH[None], quantity=prediction.quantity, **short)


def test_figure_has_the_probabilities_of_each_section(prediction):
    found = damage(prediction)
    figure = plot_damage(found)
    at_base = found.location["bar yield"].probability[1, 0]
    assert [text.get_text() for text in figure.axes[4].texts][:2] == [f"{100 * p:.0f}" for p in at_base]
    assert "not the error of the model" in figure.axes[-1].get_xlabel()
    assert "failed" not in found.table()
    figure = plot_damage(found._replace(prediction=replace(prediction, failed=np.arange(3))))
    assert "3 of 15 samples failed" in figure.axes[-1].get_xlabel()


def test_the_index_contains_the_largest_displacement_in_a_pause():
    column = bare(Events([Record("A", 0.1, np.ones(11)), Record("B", 0.1, np.ones(11))], rest=1.0))
    names, time = ("peak drift", "Park-Ang index"), 0.1 * np.arange(column.n_steps)
    measures = damage_measures(column, measures=names, park_ang=ParkAng(0.2, 8e3, 0.0), settle=0.3)
    response = np.stack([0.01 + 0.09 * np.isclose(time, 1.5), np.ones_like(time)])  # largest between the events
    assert measures.events == ("A", "B")
    found = measured(measures, column, response)
    np.testing.assert_allclose(found["peak drift"], 0.01 / column.height)
    np.testing.assert_allclose(found["Park-Ang index"], 0.1 / 0.2)


@pytest.mark.parametrize(("number", "first_angle"), [(5, 0.0), (6, np.pi / 6), (8, 0.0)])
def test_bars_are_judged_at_their_places(column, number, first_angle):
    bars = replace(column.bars, number=number, first_angle=first_angle)
    other = replace(column, bars=bars)
    places = -other.bar_circle_radius * np.cos(first_angle + 2.0 * np.pi * np.arange(number) / number)
    at_base = [float(name.split(":")[1]) for name in damage_outputs(other) if name.startswith("strain@0:")]
    assert at_base[::2] == pytest.approx([places.min(), places.max()])


def test_a_limit_with_a_distribution_is_integrated_over():
    """Lognormal drifts beyond a lognormal capacity: one normal distribution of the log ratio."""
    rng, capacity = np.random.default_rng(1), LogNormal(0.05, 0.3)
    column = bare(Record("two steps", 0.1, np.zeros(2)))
    model = stand_in(column, lambda drift: drift * column.height * np.array([[0.0, 1.0], [0.0, 1.0]]))
    measures = damage_measures(column, measures=("peak drift",))
    samples = 0.04 * np.exp(0.2 * rng.standard_normal((4000, 1)))
    prediction = propagate(model, samples, quantity=measures, progress=False)
    found = damage(prediction, [LimitState("failed", "peak drift", capacity)], noise=False)
    reached = found.presence["failed"]
    exact = stats.norm.cdf(np.log(0.04 / 0.05) / np.hypot(0.2, 0.3))
    assert abs(reached.probability[0] - exact) < 4.0 * reached.standard_error[0] < 0.03
    assert abs(np.mean(samples > 0.05) - exact) > 6.0 * reached.standard_error[0]  # control: the median alone
    assert (
        found.uncertainty
        == "the uncertainty of the parameters and the distribution of limits, not the error of the model"
    )


def test_ratios_add_the_error_of_the_model_to_limit_states_and_extent():
    rng, height = np.random.default_rng(1), LOOP.height
    samples = 0.05 * np.exp(0.1 * rng.standard_normal((400, 1)))
    prediction = propagate(stand_in(LOOP, loop), samples, quantity=DRIFTS, progress=False)
    states = [LimitState("moved", "peak drift", 0.07 / height), LimitState("stays", "residual drift", 0.02 / height)]
    ratios = EventRatios([1.1, 0.9, 1.3, 1.0], prior_events=1e-9)
    found = damage(prediction, states, ratios={"peak drift": ratios}, noise=False)
    drift = DRIFTS.split(prediction.values)["peak drift"][:, 0]
    t = stats.t(3, np.log(ratios.quantile(0.5)), ratios.sd * np.sqrt(1.25))
    moved = found.presence["moved"]
    assert moved.probability[0] == pytest.approx(t.sf(np.log(0.07 / height / drift)).mean(), rel=1e-9)
    assert moved.lower[0] < (drift > 0.07 / height).mean() < moved.upper[0] and moved.upper[0] - moved.lower[0] > 0.3
    assert moved.threshold == 0.07 / height
    np.testing.assert_allclose(
        found.extent["peak drift"][:, 0],
        np.quantile(np.exp(np.log(drift[:, None]) + t.rvs((1, 2000), random_state=1)), (0.05, 0.5, 0.95)),
        rtol=0.12,
    )
    assert "the error of the model in peak drift, not the distribution of limits" in found.uncertainty
    plain = damage(prediction, states, noise=False)
    assert (
        plain.uncertainty
        == "the uncertainty of the parameters, not the error of the model or the distribution of limits"
    )
    assert plain.presence["stays"].probability[0] == 0.0 == found.presence["stays"].probability[0]
    both = damage(prediction, states, ratios=ratios)
    assert both.presence["stays"].probability[0] == pytest.approx(t.sf(np.log(2.0)), rel=1e-2)  # stays at 0.01
    assert "and the error of the model, not the distribution of limits" in both.table()


def test_an_error_of_the_model_that_is_left_out_is_told(prediction):
    with pytest.warns(UserWarning, match=r"damage \(bar yield, .*the error of the model out"):
        damage(prediction)
    with pytest.warns(UserWarning, match=r"damage \(cover spalling"):
        damage(prediction, ratios={"bar tension": EventRatios([1.0, 1.1])})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        damage(prediction, noise=False)
        damage(prediction, ratios=EventRatios([1.0, 1.1]))
