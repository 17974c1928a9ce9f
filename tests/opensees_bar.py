"""A reinforcing bar in OpenSees, a peer for tests: the material ReinforcingSteel with fatigue."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def bar_stresses(steel: tuple, options: tuple, histories: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Stresses (n,) of new bars under several strain histories (n,).

    `steel` is fy, fu, Es, Esh in any unit of stress, eps_sh, eps_u; `options` are further arguments of the material,
    such as ``("-CMFatigue", cf, alpha, cd)``.
    """
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder, "job"), Path(folder, "result")
        job.write_bytes(pickle.dumps((steel, options, histories)))
        command = [sys.executable, "-m", "tests.opensees_bar", str(job), str(result)]
        subprocess.run(command, check=True, capture_output=True, cwd=Path(__file__).parents[1])
        return pickle.loads(result.read_bytes())


def _stress(steel: tuple, options: tuple, strain: np.ndarray) -> np.ndarray:
    import openseespy.opensees as ops

    ops.wipe()
    ops.uniaxialMaterial("ReinforcingSteel", 1, *steel, *options)
    ops.testUniaxialMaterial(1)
    out = np.empty(len(strain))
    for i, value in enumerate(strain):
        ops.setStrain(float(value))
        out[i] = ops.getStress()
    return out


if __name__ == "__main__":
    steel, options, histories = pickle.loads(Path(sys.argv[1]).read_bytes())
    Path(sys.argv[2]).write_bytes(pickle.dumps([_stress(steel, options, strain) for strain in histories]))
