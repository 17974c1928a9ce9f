"""Data of an oscillator for runs of the console command."""

from fe_likelihoods import LinearOscillator
from fe_likelihoods.problems import table_motion


def write_data(folder):
    """Write ``base.csv`` and ``top.csv``: a motion of the base, and what was measured on top."""
    record = table_motion().trim(0.0, 6.0).resample(0.02)
    response = LinearOscillator(record, 0.8).simulate([1.1, 0.9]) / [[9.80665], [1e-3]]
    base = [f"{t:.2f},{a!r}" for t, a in zip(record.time, record.acceleration.tolist(), strict=True)]
    rows = enumerate(zip(record.time, *response, strict=True))
    top = [f"{t:.2f},{a + 0.01 * (-1) ** (k // 2):.6f},{d + (-1) ** k:.4f}" for k, (t, a, d) in rows]
    (folder / "base.csv").write_text("\n".join(["time_s,base_m_s2", *base]))
    (folder / "top.csv").write_text("\n".join(["time_s,top [g],top [mm]", *top]))
