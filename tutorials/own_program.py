"""Example of an external program: ``python own_program.py INPUT`` reads text files and writes ``response.txt``.

It simulates a mass on a bilinear spring under a base motion with the standard library only, and represents any
executable.
"""

import sys


def solve(stiffness: float, strength: float, hardening: float, damping: float, dt: float, ground: list) -> list:
    """Absolute acceleration and displacement at each sample, by the average-acceleration method of Newmark (1959).

    The bilinear spring has linear kinematic hardening; its force is found by a return map (Simo & Hughes, 1998,
    section 1.4).
    """
    kinematic = hardening * stiffness / (1.0 - hardening)  # hardening modulus of the plastic part
    u = v = plastic = 0.0
    a = -ground[0]
    rows = [(a + ground[0], u)]
    for g in ground[1:]:
        predicted, free = u + dt * v + 0.25 * dt * dt * a, v + 0.5 * dt * a
        new, slip = u, plastic
        for _ in range(50):
            trial = stiffness * (new - plastic) - kinematic * plastic
            excess = abs(trial) - strength
            slip, force, tangent = plastic, stiffness * (new - plastic), stiffness
            if excess > 0.0:
                slip = plastic + (1.0 if trial > 0.0 else -1.0) * excess / (stiffness + kinematic)
                force, tangent = stiffness * (new - slip), stiffness * kinematic / (stiffness + kinematic)
            acceleration = 4.0 * (new - predicted) / (dt * dt)
            residual = acceleration + damping * (free + 0.5 * dt * acceleration) + force + g
            correction = residual / (4.0 / (dt * dt) + 2.0 * damping / dt + tangent)
            new -= correction
            if abs(correction) < 1e-12:
                break
        a = 4.0 * (new - predicted) / (dt * dt)
        v = free + 0.5 * dt * a
        u, plastic = new, slip
        rows.append((a + g, u))
    return rows


if __name__ == "__main__":
    numbers = [line.split() for line in open(sys.argv[1]) if not line.startswith("#")]
    of_stiffness, of_strength, stiffness, strength, hardening, damping, dt = (float(word) for word in numbers[0])
    motion = [float(line) for line in open("motion.txt")]
    response = solve(stiffness * of_stiffness, strength * of_strength, hardening, damping, dt, motion)
    with open("response.txt", "w") as out:
        out.writelines(f"{k} {a!r} {u!r}\n" for k, (a, u) in enumerate(response))
