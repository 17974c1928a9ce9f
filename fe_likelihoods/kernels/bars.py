"""Bars of a section side by side: trials and commits of `reinforcing_steel` without branches.

Between two transitions of the law a bar follows one curve of Menegotto and Pinto, the knee of a backbone included::

    z [(E0-Ep)/(1+q^10)^0.1 + Ep]  =  E0 z [Q - (Q-1)/(1+t^R)^(1/R)],   t = q,  Q = Ep/E0,  R = 10

So the curve of every bar is kept beside its memory, with the strains between which a trial stays on it, and a second
curve on which a trial has reversed. A trial within these strains needs no memory. Any other trial works on a copy of
the memory, which is kept: a reversal is fitted once, and a commit on the second curve takes the copy.

The memory itself does not change by this: it is brought up to the last commit before the law needs it.
"""

from __future__ import annotations

import math

from . import bar_fatigue
from .elementary import log
from .jit import SUM_REORDERING, kernel
from .menegotto_pinto import EA, QQ, RR, SA, XA, XB, evaluate, evaluate_curve, rate_of
from .reinforcing_steel import (
    A_SHIFT,
    BRANCH,
    E0,
    EP,
    F0,
    ON,
    OP,
    SC,
    SHP,
    TIE,
    XC,
    YP,
    backbone,
    curve_slot,
    switch_backbone,
    update,
)

__all__ = ["N_PATH", "bar_stress", "commit_bars", "initialise_bars", "sum_bars", "switch_backbones"]

# Rows of the paths of a section: for each of two curves the natural strains between which it holds, and its constants;
# then the committed engineering strain, and the limit that follows it (-1 the lower one, 1 the upper one, 0 none).
LOW, HIGH, START, STRESS, SLOPE, RATE, Q, R = range(8)
SECOND = 8
COMMITTED, FOLLOWER = 16, 17
N_PATH = 18


@kernel(inline=True)
def _natural(eps):
    """Return the natural strain; NaN for an impossible strain."""
    return log(1.0 + eps) if -0.95 < eps < 1e3 else math.nan


@kernel
def _set_curve(first, low, high, state, c, path, i):
    """Write the curve of bar `i` on its branch to the rows from `first`."""
    b = int(state[BRANCH])
    path[first + LOW, i], path[first + HIGH, i] = low, high
    if b > 2:
        curve = state[curve_slot(b) :]
        path[first + START, i], path[first + STRESS, i] = curve[XA], curve[SA]
        path[first + SLOPE, i], path[first + RATE, i] = curve[EA], rate_of(curve)
        path[first + Q, i], path[first + R, i] = curve[QQ], curve[RR]
    else:
        path[first + START, i], path[first + STRESS, i] = state[ON if b == 2 else OP], 0.0
        path[first + SLOPE, i], path[first + RATE, i] = c[E0], (c[E0] - c[EP]) / c[F0]
        path[first + Q, i], path[first + R, i] = c[EP] / c[E0], 10.0


@kernel
def initialise_bars(memory, path, c):
    """Put the bars with this memory, all zeros, on the knee of the virgin backbone; empty bars stay there."""
    n_bars = memory.shape[0]
    for i in range(path.shape[1]):
        limit = c[A_SHIFT] if i < n_bars else math.inf
        _set_curve(0, -limit, limit, memory[0], c, path, i)
        _set_curve(SECOND, math.inf, -math.inf, memory[0], c, path, i)
        path[COMMITTED, i] = path[FOLLOWER, i] = 0.0


@kernel
def _renew(eps, state, c, path, i):
    """Write the curve of bar `i` from its memory, committed at the strain `eps`, and forget the second curve."""
    x = _natural(eps)
    b, limit = int(state[BRANCH]), min(c[YP], c[A_SHIFT])
    low, high, follower = -limit, limit, 0.0
    if b > 2:
        end = state[curve_slot(b) + XB]
        if b % 4 <= 1:
            low, high, follower = x, end - TIE, -1.0
        else:
            low, high, follower = end + TIE, x, 1.0
    elif b > 0:
        sign = 1.0 if b == 1 else -1.0
        origin = state[OP] if b == 1 else state[ON]
        e = sign * (x - origin)
        if e <= limit:  # a reversal does not change the memory; beyond zero stress the other backbone follows
            near, far = min(e, -limit if state[OP] == state[ON] else TIE), limit
        else:  # nothing holds if near > far: hardening is not a curve of this kind
            near, far, follower = e, c[A_SHIFT], -sign
        low, high = (origin + near, origin + far) if b == 1 else (origin - far, origin - near)
    _set_curve(0, low, high, state, c, path, i)
    path[SECOND + LOW, i], path[SECOND + HIGH, i] = math.inf, -math.inf
    path[COMMITTED, i], path[FOLLOWER, i] = eps, follower


@kernel
def _evaluate(x, path, k, i):
    """Return natural stress and modulus on the curve of bar `i` in the rows from `k`."""
    p = path[k:, i]
    return evaluate(x, p[START], p[STRESS], p[SLOPE], p[RATE], p[Q], p[R])


@kernel
def _catch_up(committed, state, c, path, i):
    """Write the last committed point of bar `i` to a memory, in place."""
    x = math.log(1.0 + path[COMMITTED, i])
    if x != committed[XC]:
        b = int(committed[BRANCH])
        state[XC] = x
        state[SC], _ = evaluate_curve(x, committed[curve_slot(b) :]) if b > 2 else backbone(x - path[START, i], c)


@kernel
def _try(eps, memory, trial, c, path, i):
    """Return stress and tangent of bar `i` at a strain outside its curves; keep the memory and the curve in `trial`."""
    for k in range(memory.shape[0]):
        trial[k] = memory[k]
    _catch_up(memory, trial, c, path, i)
    old, committed = int(memory[BRANCH]), trial[XC]
    stress, tangent = update(eps, trial, c)
    path[SECOND + LOW, i], path[SECOND + HIGH, i] = math.inf, -math.inf
    new, x = int(trial[BRANCH]), _natural(eps)
    if new != old and old > 0:
        # A farther trial makes the same transitions, and a nearer one too after a single reversal.
        if new > 2:
            curve = trial[curve_slot(new) :]
            near, end, up = _natural(path[COMMITTED, i]) if curve[XA] == committed else x, curve[XB], new % 4 <= 1
            low, high = (near, end - TIE) if up else (end + TIE, near)
        else:
            low, high = (x, trial[OP] + c[A_SHIFT]) if new == 1 else (trial[ON] - c[A_SHIFT], x)
        # A curve from a backbone differs if the trial is beyond the onset of hardening; small strains are elastic.
        if new > 2 and old == 1:
            onset = memory[OP] + c[SHP]
            low = max(low, onset + TIE if x >= onset else memory[OP] + c[YP])
            high = high if x >= onset else min(high, onset - TIE)
        elif new > 2 and old == 2:
            onset = memory[ON] - c[SHP]
            high = min(high, onset - TIE if x <= onset else memory[ON] - c[YP])
            low = low if x <= onset else max(low, onset + TIE)
        _set_curve(SECOND, low, high, trial, c, path, i)
    return stress, tangent


@kernel
def bar_stress(eps, memory, trial, c, failure, path, i):
    """Return stress and tangent of bar `i` at a trial strain; only `trial` and the second curve are overwritten."""
    if failure.shape[0] > 0:
        for k in range(memory.shape[0]):
            trial[k] = memory[k]
        return bar_fatigue.update(eps, trial, c, failure)
    x = _natural(eps)
    for k in (0, SECOND):
        if path[k + LOW, i] <= x <= path[k + HIGH, i]:
            s, modulus = _evaluate(x, path, k, i)
            return s / (1.0 + eps), (modulus - s) / ((1.0 + eps) * (1.0 + eps))
    return _try(eps, memory, trial, c, path, i)


@kernel(fastmath=SUM_REORDERING)
def sum_bars(e0, kappa, y, area, memory, trial, c, failure, path):
    """Return N, M and the tangent of all bars of a section at a trial strain; see `fiber_section.forces`."""
    n_force, moment, k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0, 0.0, 0.0
    outside = 1.0
    if failure.shape[0] == 0:
        outside = 0.0
        # all loads precede the choices, as in `fiber_section.forces`
        for i in range(path.shape[1]):
            yi = y[i]
            low, high, low2, high2 = path[LOW, i], path[HIGH, i], path[SECOND + LOW, i], path[SECOND + HIGH, i]
            xa, xa2 = path[START, i], path[SECOND + START, i]
            sa, sa2 = path[STRESS, i], path[SECOND + STRESS, i]
            ea, ea2 = path[SLOPE, i], path[SECOND + SLOPE, i]
            rate, rate2 = path[RATE, i], path[SECOND + RATE, i]
            q, q2 = path[Q, i], path[SECOND + Q, i]
            r, r2 = path[R, i], path[SECOND + R, i]
            eps = e0 - yi * kappa
            x = log(1.0 + eps)
            first = (low <= x) & (x <= high)
            inside = (first | ((low2 <= x) & (x <= high2))) & (eps > -0.95)
            outside += 0.0 if inside else 1.0
            xa, sa, ea = xa if first else xa2, sa if first else sa2, ea if first else ea2
            rate, q, r = rate if first else rate2, q if first else q2, r if first else r2
            s, modulus = evaluate(x, xa, sa, ea, rate, q, r)
            inverse = 1.0 / (1.0 + eps)
            force = s * inverse * area[i]
            stiffness = (modulus - s) * inverse * inverse * area[i]
            n_force += force
            moment -= force * yi
            k_axial += stiffness
            k_coupling -= stiffness * yi
            k_bending += stiffness * yi * yi
    if outside == 0.0:
        return n_force, moment, k_axial, k_coupling, k_bending
    n_force, moment, k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(memory.shape[0]):
        stress, tangent = bar_stress(e0 - y[i] * kappa, memory[i], trial[i], c, failure, path, i)
        force = stress * area[i]
        stiffness = tangent * area[i]
        n_force += force
        moment -= force * y[i]
        k_axial += stiffness
        k_coupling -= stiffness * y[i]
        k_bending += stiffness * y[i] * y[i]
    return n_force, moment, k_axial, k_coupling, k_bending


@kernel
def commit_bars(e0, kappa, y, memory, trial, c, failure, path):
    """Advance all bars of a section to the strains of (e0, kappa), in place."""
    for i in range(memory.shape[0]):
        eps = e0 - y[i] * kappa
        if failure.shape[0] > 0:
            bar_fatigue.update(eps, memory[i], c, failure)
            continue
        x = _natural(eps)
        if memory[i, BRANCH] > 0.0 and path[LOW, i] <= x <= path[HIGH, i]:
            path[COMMITTED, i] = eps
            path[LOW, i] = x if path[FOLLOWER, i] < 0.0 else path[LOW, i]
            path[HIGH, i] = x if path[FOLLOWER, i] > 0.0 else path[HIGH, i]
            path[SECOND + LOW, i], path[SECOND + HIGH, i] = math.inf, -math.inf
            continue
        if path[SECOND + LOW, i] <= x <= path[SECOND + HIGH, i]:
            for k in range(memory.shape[1]):
                memory[i, k] = trial[i, k]
        else:
            _catch_up(memory[i], memory[i], c, path, i)
            update(eps, memory[i], c)
        _renew(eps, memory[i], c, path, i)


@kernel
def switch_backbones(memory, c, failure, path):
    """Move the bars at the origin of their backbone to the other backbone, in place; return how many have moved."""
    count = 0
    for i in range(memory.shape[0]):
        if failure.shape[0] == 0:
            _catch_up(memory[i], memory[i], c, path, i)
        if switch_backbone(memory[i], c):
            count += 1
            if failure.shape[0] == 0:
                _renew(path[COMMITTED, i], memory[i], c, path, i)
    return count
