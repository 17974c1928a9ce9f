"""Fatigue of bars: closed forms, rainflow counting, OpenSees, tangents, and bars that do not fail."""

import numpy as np

from fe_likelihoods.kernels import bar_fatigue
from fe_likelihoods.kernels.bar_fatigue import DAMAGE, N_FAILURE, N_STATE
from tests.opensees_bar import bar_stresses
from tests.opensees_column import require_opensees

from . import golden

STEEL = (415e6, 620e6, 2e11, 8e9, 0.008, 0.1)  # fy, fu, Es, Esh [Pa], eps_sh, eps_u
FY, ES = STEEL[0], STEEL[2]
ALPHA, CD = 0.506, 0.389
MODULUS = FY * (1.0 + FY / ES) / np.log1p(FY / ES)  # natural


def path(*turns, n=200):
    """Strains from zero through `turns`, `n` steps from one to the next."""
    return np.interp(np.arange(len(turns) * n + 1) / n, np.arange(len(turns) + 1), [0.0, *turns])


def failure(cf, cd=CD):
    """Constants of the law and of its failure."""
    c, f = golden.steel_constants(STEEL), np.zeros(N_FAILURE)
    bar_fatigue.constants(cf, ALPHA, cd, f)
    return c, f


def follow(strain, **options):
    """Stress, tangent and Miner's sum (3, n) of a new bar."""
    c, f = failure(**options)
    state, out = np.zeros(N_STATE), np.empty((3, len(strain)))
    for i, eps in enumerate(strain):
        out[0, i], out[1, i] = bar_fatigue.update(eps, state, c, f)
        out[2, i] = state[DAMAGE]
    return out


def lawful(strain):
    """Stress of a bar that does not fail."""
    out = np.empty((3, len(strain)))
    golden.steel_history(strain, golden.steel_constants(STEEL), out)
    return out[0]


def natural(strain, stress):
    """Natural strain and stress."""
    return np.log1p(strain), stress * (1.0 + strain)


def random_turns(rng, n, low=-0.03, high=0.03):
    return path(*rng.uniform(low, high, n), n=40)


def coffin_manson(x, s, cf):
    """Damage of a half cycle with the natural strain `x` and stress `s` from its start."""
    return (max(abs(x) - abs(s) / MODULUS, 0.0) / cf) ** (1.0 / ALPHA)


def rainflow(x, s, cf):
    """Miner's sum by rainflow counting (ASTM E1049, 5.4.4) of a history of natural strain and stress."""
    turns = [0, *(np.flatnonzero(np.diff(x)[1:] * np.diff(x)[:-1] < 0.0) + 1), len(x) - 1]
    stack, total = [], 0.0

    def add(i, j, weight):
        nonlocal total
        total += weight * coffin_manson(x[i] - x[j], s[i] - s[j], cf)

    for turn in turns:
        stack.append(turn)
        while len(stack) > 2 and abs(x[stack[-1]] - x[stack[-2]]) >= abs(x[stack[-2]] - x[stack[-3]]):
            if len(stack) == 3:
                add(stack[0], stack[1], 1)
                del stack[0]
            else:
                add(stack[-3], stack[-2], 2)
                del stack[-3:-1]
    for i, j in zip(stack[:-1], stack[1:], strict=True):
        add(i, j, 1)
    return total


def test_a_bar_that_hardly_fails_is_that_of_the_law(rng):
    for strain in (random_turns(rng, 20), random_turns(rng, 20, -0.01, 0.06)):
        np.testing.assert_array_equal(follow(strain, cf=1e9, cd=1e18)[0], lawful(strain))


def test_half_cycles_of_constant_amplitude_follow_coffin_and_manson():
    """The number of half cycles to fracture is as in the closed form, over a factor of ten in life."""
    found, expected = [], []
    for amplitude in (0.02, 0.03, 0.045, 0.06):
        strain = path(*[amplitude, -amplitude] * 40)
        stress, _, damage = follow(strain, cf=0.26, cd=10.0)
        ends = slice(2 * 200, None, 200)
        x, s = natural(strain, lawful(strain))
        # stable loops: each half cycle from the fourth on adds the same
        one = coffin_manson(x[4 * 200] - x[5 * 200], s[4 * 200] - s[5 * 200], 0.26)
        steps = np.diff(damage[ends])
        steps = steps[: np.argmax(damage[ends] > 1.0) - 1]
        np.testing.assert_allclose(steps[3:], one, rtol=2e-3)
        found.append(np.argmax(damage > 1.0) / 200.0)
        expected.append(1.0 / one)
    assert expected[0] / expected[-1] > 8.0
    # the first half cycle begins at zero, the last is not complete
    np.testing.assert_allclose(found, expected, atol=1.5)


def test_strength_decreases_with_the_damage_and_ends_with_fracture():
    strain = path(*[0.03, -0.03] * 40)
    stress, tangent, damage = follow(strain, cf=0.2)
    loss = (0.2 / CD) ** (1.0 / ALPHA)
    factor = 1.0 - loss * damage - np.maximum(damage - 1.0, 0.0) / 0.04
    broken = int(np.argmax(factor <= 0.0))
    assert 1.0 < damage[broken] < 1.04
    np.testing.assert_allclose(stress[:broken], factor[:broken] * lawful(strain)[:broken], rtol=1e-12)
    assert not stress[broken:].any()
    assert not tangent[broken:].any()


def test_damage_is_that_of_rainflow_counting(rng):
    """An independent count; loops of the law overshoot their start a little before they close, so it is not exact."""
    ratios = []
    for _ in range(30):
        strain = random_turns(rng, 30)
        damage = follow(strain, cf=0.26)[2, -1]
        ratios.append(damage / rainflow(*natural(strain, lawful(strain)), 0.26))
    assert np.abs(np.array(ratios) - 1.0).max() < 0.01


def test_fatigue_is_that_of_opensees(rng):
    """Equal to round-off in simple histories; in others OpenSees departs from rainflow counting (see the theory)."""
    require_opensees()
    cf = 0.15
    simple = [path(0.2), path(-0.15), path(*[0.02, -0.02] * 30, n=50), path(*[0.05, -0.01] * 20, n=50)]
    nested = [random_turns(rng, 20) for _ in range(20)]
    stresses = bar_stresses(STEEL, ("-CMFatigue", cf, ALPHA, CD), [*simple, *nested])
    for strain, theirs in zip(simple, stresses[: len(simple)], strict=True):
        ours = follow(strain, cf=cf)[0]
        np.testing.assert_allclose(ours / FY, theirs / FY, atol=1e-9)
    assert any((stress[1:] == 0.0).any() for stress in stresses[: len(simple)])  # some of these bars fracture
    off, agree = [], 0
    for strain, theirs in zip(nested, stresses[len(simple) :], strict=True):
        ours, _, damage = follow(strain, cf=cf)
        sound = damage < 0.98
        difference = np.abs(ours - theirs)[sound] / FY
        agree += difference.max() < 1e-3
        off.append(np.median(difference))
    assert agree >= 5
    assert max(off) < 0.01
