"""Predictions of measured tests from one calibration: a steel coupon, a frame on a shake table, a bridge.

``transfer_coupon``: cyclic test of a bar of reinforcing steel, first half to second half
(``tutorials/09_steel_coupon.py``). ``transfer_frame``: three-storey frame on a shake table, first shaking, floors 1 and
3, to all floors in the two later shakings (``tutorials/07_shake_table_frame.py``). ``transfer_meloland``: Meloland Road
Overcrossing in the Imperial Valley earthquake of 1979, weak to strong part of the record
(``tutorials/06_real_bridges.py``, where the sources of the data are). Priors are those of the tutorials. The rows are
explained in `benchmarks.measured_transfer`.
"""

import numpy as np

from fe_likelihoods import (
    BridgeDeck,
    Channel,
    GaussianNoise,
    LinearStructure,
    LogNormal,
    Measurements,
    Record,
    ShearFrame,
    Steel,
    SteelCoupon,
    TruncatedNormal,
    Uniform,
    arias_intensity,
    dissipated_energy,
    peak,
    read_columns,
    read_record,
)

from .measured_transfer import Case, calibrate, ratios_of, score_case, skipped, within
from .rows import Row
from .targets import SHARED

__all__ = ["coupon", "frame", "frame_model", "meloland", "meloland_part", "read_frame"]

_MEASURED = SHARED / "measured"
_COUPON = ("steel_coupon/stress.1.coords", "steel_coupon/calDataField.csv")
FRAME = "mini_shake_table/Flexible_3_story__Northridge.csv"
MELOLAND = "meloland_bridge/imperialvalley79_ce01336p.zip"
_MPA = 1e6
FLOORS = {"floor1": 1, "floor2": 2, "floor3": 3}
SHAKINGS = {"shaking 1": (18.0, 26.0), "shaking 2": (36.0, 44.0), "shaking 3": (54.0, 62.0)}  # [s]
_REST = 9.0  # [s] at rest before the first shaking
MELOLAND_PARTS = {"weak": (9.0, None), "strong": (0.0, 9.0)}  # [s]
FRAME_PRIOR = {f"stiffness_{i}": LogNormal(1.0, 0.5) for i in (1, 2, 3)}
FRAME_PRIOR |= {f"damping_{i}": LogNormal(0.01, 1.0) for i in (1, 2, 3)}
MELOLAND_PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
_NOMINAL = 2912.0  # stiffness / mass of a storey [1/s²], of a frame with the measured first frequency


def coupon(repeats: int = 1) -> list[Row]:
    """Stress, its peak and its work in the second half of the test, from the first half."""
    if rows := skipped("transfer_coupon", *_COUPON):
        return rows
    strain = np.loadtxt(_MEASURED / _COUPON[0])
    stress = _MPA * np.loadtxt(_MEASURED / _COUPON[1], delimiter=",").ravel()
    steel = Steel(fy=450 * _MPA, fu=650 * _MPA, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
    whole = SteelCoupon(strain, steel)
    half = len(strain) // 2
    model = whole.with_record(strain[:half])
    measured = Measurements(model.channels, model.dt, stress[None, :half])
    sd = {"fy": 0.1, "fu": 0.1, "Es": 0.03, "Esh": 0.5, "eps_sh": 0.3, "eps_u": 0.3}
    prior = {name: TruncatedNormal(1.0, each) for name, each in sd.items()}
    (name,) = (channel.name for channel in model.channels)
    later = slice(half, None)
    noise = GaussianNoise(whole.channels, level="response", window=20 * model.dt, sensor=[1.5 * _MPA], deformation=0.01)
    case = Case(
        "coupon, second half",
        whole,
        Measurements(whole.channels, whole.dt, stress[None]),
        later,
        {"peak": peak(name, later), "energy": dissipated_energy(name, strain, later)},
        noise,
    )
    rows, scored = [], []
    for seed in range(1, repeats + 1):
        fit, modulated = (calibrate(model, measured, prior, 50 * _MPA, seed, noise=each) for each in (None, noise))
        ratios = ratios_of(fit, model, {"peak": peak(name), "energy": dissipated_energy(name, strain[:half])})
        found, numbers = score_case(case, fit, modulated, ratios, seed)
        rows += found
        scored.append(numbers)
    return rows + within(scored)


def read_frame() -> tuple[Measurements, float]:
    """Accelerations of table and floors [m/s²] without their means at rest, and the noise of the sensors."""
    columns = {"table": "ground_x", "floor1": "1st_x", "floor2": "2nd_x", "floor3": "3rd_x"}
    channels = [Channel(name, "absolute acceleration", "g") for name in columns]
    raw = read_columns(_MEASURED / FRAME, channels, list(columns.values()), units="m/s2")
    rest = raw.values[:, : round(_REST / raw.dt)]
    data = Measurements(raw.channels, raw.dt, raw.values - rest.mean(axis=1, keepdims=True))
    return data, float(rest[1:].std(axis=1).mean())


def frame_model(data: Measurements, floors: tuple[str, ...], shaking: str) -> LinearStructure:
    """The frame in one shaking, with these floors as channels."""
    start, stop = SHAKINGS[shaking]
    table = Record("table", data.dt, data.channel("table")).trim(_REST, stop)
    parts = ShearFrame({name: FLOORS[name] for name in floors}, [1.0] * 3, [_NOMINAL] * 3, ())
    return LinearStructure(parts, table, lead=start - _REST)


def frame(repeats: int = 1) -> list[Row]:
    """Accelerations, their peaks and Arias intensities in later shakings, from the first one."""
    if rows := skipped("transfer_frame", FRAME):
        return rows
    data, sensor = read_frame()
    used = ("floor1", "floor3")
    model, measured = frame_model(data, used, "shaking 1"), data.select(used).trim(*SHAKINGS["shaking 1"])
    noise = GaussianNoise(model.channels, level="response", window=0.5, sensor=[sensor] * len(used))
    rows, scored = [], []
    for seed in range(1, repeats + 1):
        fit, modulated = (calibrate(model, measured, FRAME_PRIOR, 3.0, seed, noise=each) for each in (None, noise))
        known = ratios_of(fit, model, _of_accelerations(used))
        for what in ("peak", "energy"):  # of the floor that was not measured: between the two others
            known[f"{what} floor2"] = np.sqrt(known[f"{what} floor1"] * known[f"{what} floor3"])
        for shaking in ("shaking 2", "shaking 3"):
            floors = tuple(FLOORS)
            later = data.select(floors).trim(*SHAKINGS[shaking])
            predicted, numbers = frame_model(data, floors, shaking), _of_accelerations(floors)
            case = Case(f"frame, {shaking}", predicted, later, slice(None), numbers, noise)
            found, numbers = score_case(case, fit, modulated, known, seed)
            rows += found
            scored.append(numbers)
    return rows + within(scored)


def meloland_part(name: str) -> tuple[LinearStructure, Measurements]:
    """Model and measurements of the deck in the weak or the strong part of the record."""
    start, stop = MELOLAND_PARTS[name]
    records = {k: read_record(_MEASURED / MELOLAND, k, member=f"CHAN{k:02d}.V2") for k in (2, 3, 13, 7)}
    model = LinearStructure(BridgeDeck("ch7"), [records[k].trim(0.0, stop) for k in (2, 3, 13)], lead=start)
    return model, Measurements(model.channels, model.dt, [records[7].trim(start, stop).acceleration])


def meloland(repeats: int = 1) -> list[Row]:
    """Acceleration of the middle of the deck, its peak and Arias intensity in the strong part, from the weak part."""
    if rows := skipped("transfer_meloland", MELOLAND):
        return rows
    weak, strong = meloland_part("weak"), meloland_part("strong")
    noise = GaussianNoise(weak[0].channels, level="response", window=1.0, sensor=[0.002])
    rows, scored = [], []
    for seed in range(1, repeats + 1):
        fit, modulated = (calibrate(*weak, MELOLAND_PRIOR, 1.0, seed, noise=each) for each in (None, noise))
        case = Case("Meloland, strong part", *strong, slice(None), _of_accelerations(("ch7",)), noise)
        found, numbers = score_case(case, fit, modulated, ratios_of(fit, weak[0], case.numbers), seed)
        rows += found
        scored.append(numbers)
    return rows + within(scored)


def _of_accelerations(names: tuple[str, ...]) -> dict:
    """Peaks and Arias intensities of channels by name."""
    several = len(names) > 1
    found = {}
    for name in names:
        suffix = f" {name}" if several else ""
        found |= {f"peak{suffix}": peak(name), f"energy{suffix}": arias_intensity(name)}
    return found
