"""A program as others have it: ``python own_program.py INPUT`` reads text, solves, writes ``response.txt``.

The bilinear oscillator of `own_models`, standard library alone; stands for any executable.
"""

import sys

numbers = [line.split() for line in open(sys.argv[1]) if not line.startswith("#")]
of_stiffness, of_strength, stiffness, strength, hardening, damping, dt = (float(word) for word in numbers[0])
stiffness, strength = stiffness * of_stiffness, strength * of_strength
kinematic = hardening * stiffness / (1.0 - hardening)
ground = [float(line) for line in open("motion.txt")]
with open("response.txt", "w") as out:
    u = v = plastic = 0.0
    a = -ground[0]
    out.write(f"0 {a + ground[0]!r} {u!r}\n")
    for k in range(1, len(ground)):
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
            residual = acceleration + damping * (free + 0.5 * dt * acceleration) + force + ground[k]
            correction = residual / (4.0 / (dt * dt) + 2.0 * damping / dt + tangent)
            new -= correction
            if abs(correction) < 1e-12:
                break
        a = 4.0 * (new - predicted) / (dt * dt)
        v = free + 0.5 * dt * a
        u, plastic = new, slip
        out.write(f"{k} {a + ground[k]!r} {u!r}\n")
