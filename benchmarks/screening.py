"""Faults of sensors that their samples show: how many are named in right and in spoiled channels.

Right channels are the motions and measurements of the reference material and the bundled synthetic data. Faults are
put in at random places; where a size is given, it is a share of the peak. "Strong" places lie where the middle 90 %
of the squared steps are.
"""

import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator

import numpy as np

from fe_likelihoods.checks.screening import find_sensor_faults
from tests.checks.real_channels import RealChannel, real_channels

from .rows import Row
from .targets import SHARED

__all__ = ["screening", "spoiled"]


def _place(x: np.ndarray, length: int, strong: bool, rng: np.random.Generator) -> int:
    """First sample of a fault."""
    steps = np.nancumsum(np.square(np.diff(x)))
    low, high = np.searchsorted(steps, [0.05 * steps[-1], 0.95 * steps[-1]]) if strong else (10, len(x))
    return int(rng.integers(low, max(low + 1, min(high, len(x) - length - 10))))


def spoiled(channel: RealChannel, rng: np.random.Generator) -> Iterator[tuple[str, str, np.ndarray]]:
    """Case, kind of fault, and the samples with it."""
    x, peak, deviation = channel.values, float(np.nanmax(np.abs(channel.values))), float(np.nanstd(channel.values))
    for share in (0.9, 0.8, 0.6, 0.3):
        yield f"clipped at {share} of the peak", "clipped", np.clip(x, -share * peak, share * peak)
    yield "clipped on one side at 0.6", "clipped", np.minimum(x, 0.6 * np.nanmax(x))
    for seconds in (0.2, 0.5, 2.0):
        length = max(int(seconds / channel.step), 6)
        for strong in (True, False):
            where, first = "strong" if strong else "any", _place(x, length, strong, rng)
            for name, value in (("stuck", x[first]), ("dead", 0.0)):
                y = x.copy()
                y[first : first + length] = value
                yield f"{name} for {seconds} s, {where}", "stuck", y
    for share in (0.001, 0.003):
        first, y = _place(x, int(2.0 / channel.step), True, rng), x.copy()
        y[first : first + int(2.0 / channel.step)] = 0.0
        part = y[first : first + int(2.0 / channel.step)]
        part += share * peak * rng.standard_normal(len(part))
        yield f"dead for 2 s with noise of {share}", "stuck", y
    first, y = _place(x, 50, True, rng), x.copy()
    y[first:] = 0.0
    yield "dead to the end", "stuck", y
    for count, share in ((1, 0.5), (1, 1.0), (1, 3.0), (5, 1.0), (30, 2.0)):
        y = x.copy()
        y[rng.choice(np.arange(5, len(x) - 5), count, replace=False)] += share * peak * rng.choice([-1, 1], count)
        yield f"{count} spike(s) of {share}", "spikes", y
    sign, time = rng.choice([-1, 1]), np.linspace(0.0, 1.0, len(x))
    for share in (0.03, 0.05, 0.1, 0.3) if channel.dimension in ("acceleration", "displacement") else ():
        yield f"offset of {share}", "offset", x + sign * share * peak
    for share in (0.1, 0.2, 0.5):
        yield f"drift of {share}", "drift", x + sign * share * peak * time
    yield "parabola of 0.5", "drift", x + sign * 0.5 * peak * time**2
    for ratio in (0.3, 1.0, 4.0):
        yield f"noise of {ratio} deviations (right)", "", x + ratio * deviation * rng.standard_normal(len(x))


def screening(repeats: int, every: int = 1) -> Iterator[Row]:
    """Right channels that are named, and spoiled ones that are named rightly, with another cause, or not."""
    warnings.simplefilter("ignore")
    counts, named = defaultdict[str, Counter](Counter), []
    for k, channel in enumerate(real_channels(SHARED)):
        right = find_sensor_faults(channel.values, channel.dimension)
        counts["right"]["silent" if not right else "other"] += 1
        named += [f"{channel.name}: {each.kind}" for each in right]
        for seed in range(repeats) if not right and k % every == 0 else ():
            for case, kind, values in spoiled(channel, np.random.default_rng((seed, k))):
                kinds = {each.kind for each in find_sensor_faults(values, channel.dimension)}
                counts[case]["named" if kind in kinds else "other" if kinds else "silent"] += 1
    for case, found in counts.items():
        good = "silent" if case == "right" or "(right)" in case else "named"
        total = found.total()
        note = f"{total}: " + ", ".join(f"{found[name]} {name}" for name in ("named", "silent", "other"))
        yield Row("right answers", case, 100.0 * found[good] / total, "%", note)
    yield Row("right channels that are named", "", len(named), "", "; ".join(named))
