"""A program: a mass on a bilinear spring with a damper under a base motion. It stands for an executable of your own.

It reads ``input.txt`` (multiples of stiffness and strength, time step [s]) and ``record.txt`` (base acceleration
[m/s²], one sample per line) in its working folder, and writes ``response.txt``: time [s], absolute acceleration [m/s²]
and relative displacement [m], one line per sample.
"""

import math

STIFFNESS = (2.0 * math.pi / 0.8) ** 2  # per unit mass [1/s²]: a period of 0.8 s
STRENGTH = 0.02 * STIFFNESS  # per unit mass [m/s²]: yields at 20 mm
HARDENING = 0.05  # ratio of the stiffness after yielding to the initial one
DAMPING = 2.0 * 0.03 * math.sqrt(STIFFNESS)  # per unit mass [1/s]: 3 % of critical damping
SUBSTEPS = 16  # per step of the record


def main() -> None:
    """Read the input files, integrate by central differences, write the response."""
    with open("input.txt") as file:
        given = dict(line.split() for line in file)
    with open("record.txt") as file:
        motion = [float(line) for line in file]
    stiffness, strength = STIFFNESS * float(given["stiffness"]), STRENGTH * float(given["strength"])
    dt = float(given["step"])
    step, limit = dt / SUBSTEPS, (1.0 - HARDENING) * strength
    displacement = velocity = spring = 0.0
    rows = ["0.0 0.0 0.0"]
    for i in range(1, len(motion)):
        for k in range(SUBSTEPS):  # the motion is linear between its samples
            base = motion[i - 1] + (motion[i] - motion[i - 1]) * (k + 1) / SUBSTEPS
            velocity += step * (-base - DAMPING * velocity - spring)
            displacement += step * velocity
            centre = HARDENING * stiffness * displacement
            spring = min(max(spring + stiffness * step * velocity, centre - limit), centre + limit)
        rows.append(f"{i * dt!r} {-DAMPING * velocity - spring!r} {displacement!r}")
    with open("response.txt", "w") as file:
        file.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
