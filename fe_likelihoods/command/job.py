"""An update as its TOML file describes it: read and checked before anything is computed, and the data that it names."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from samplers.estimates.genealogy import FEWEST_FOR_VARIANCE as FEWEST

from ..signals.channels import Channel, Measurements
from ..signals.datasets import Dataset, read_dataset
from ..signals.read import read_columns, read_record
from ..signals.records import Record
from ..signals.sampling import SAME_TIME
from .keys import (
    FREE_SECTIONS,
    MODEL_KINDS,
    SECTIONS,
    USER_MODELS,
    Budget,
    LoadTest,
    Measured,
    Modes,
    Motion,
    Noise,
    Predictions,
    Sampler,
    check_known,
    did_you_mean,
    keys_of,
    model_keys,
    read_keys,
    read_quantity,
    table_keys,
)

HDF5 = (".h5", ".hdf5")
DATA = "measurements", "modes", "load_test"  # sections of data sets; each may have its own model, [modes.model]


@dataclass(frozen=True, kw_only=True)
class Job:
    """Contents of a TOML file, section by section. Values are in SI units; files are relative to `folder`."""

    file: Path
    text: str  # of the file
    folder: Path
    kind: str  # of the model, one of `MODEL_KINDS`
    model: dict[str, Any]
    priors: dict[str, str]  # distributions as text, by parameter
    record: Motion | None = None
    measurements: Measured | None = None
    modes: Modes | None = None
    load_test: LoadTest | None = None
    noise: Noise | None = None
    sampler: Sampler = field(default_factory=Sampler)
    budget: Budget = field(default_factory=Budget)
    prediction: Predictions = field(default_factory=Predictions)
    own_models: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)  # kind and model of data sets
    shared: tuple[str, ...] = ()  # data sets that one run of ``[model]`` answers
    model_section: str = "model"  # the section of the model, such as modes.model

    def where(self, section: str) -> str:
        """File and section, for messages."""
        return f"{self.file.name}: [{self.model_section if section == 'model' else section}]"

    def located(self, section: str, make: Any, *arguments: Any, **options: Any) -> Any:
        """What ``make(...)`` returns; its errors have file and section before them."""
        try:
            return make(*arguments, **options)
        except ValueError as error:
            known = str(error).startswith(f"{self.file.name}:")
            raise (error if known else ValueError(f"{self.where(section)} {error}")) from error

    def data_sets(self) -> dict[str, "Job"]:
        """The same update with one data set each, by section; the section may have a model of its own."""
        there = [name for name in DATA if getattr(self, name)] or ["measurements"]
        found = {}
        for name in there:
            kind, model = self.own_models.get(name, (self.kind, self.model))
            others = [other for other in DATA if other != name]
            others += ["record", "noise"] if name != "measurements" and len(there) > 1 else []
            where = f"{name}.model" if name in self.own_models else "model"
            found[name] = replace(self, kind=kind, model=model, model_section=where, **dict.fromkeys(others))
        return found

    def path(self, section: str, key: str, name: str) -> Path:
        """An existing file that a key names; ValueError if there is none."""
        path = self.folder / Path(name).expanduser()
        if not path.is_file():
            near = "files are relative to the folder of the TOML file"
            if path.parent.is_dir():
                near = did_you_mean(path.name, sorted(p.name for p in path.parent.iterdir() if p.is_file()))
            raise ValueError(f"{self.where(section)} {key}: there is no file {path}; {near}")
        return path


def read_job(file: str | Path) -> Job:
    """Read a TOML file; ValueError, which names the key, if it is unreadable, or a section, key or value is wrong."""
    file = Path(file)
    try:
        text = file.read_text(encoding="utf-8-sig")  # editors of Windows write a byte order mark
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text in UTF-8"
        raise ValueError(
            f"cannot read {file}: {reason}; give the TOML file of an update (`fe-likelihoods new column DIR` makes one)"
        ) from error
    return parse_job(text, file, file.parent)


def parse_job(text: str, file: Path, folder: Path) -> Job:
    """As `read_job`, from the text of a file whose paths are relative to `folder`."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(
            f"{file.name}: not a TOML file: {error}; a text needs quotes, true and false have small letters, each key "
            "stands once, a section is a line such as [record]"
        ) from error
    check_known(content, (*FREE_SECTIONS, *SECTIONS), f"{file.name}:", "unknown section")
    for name, value in content.items():
        if not isinstance(value, dict):
            raise ValueError(f"{file.name}: {name}: expected a section [{name}]; got {value!r}")
    if "model" not in content:
        raise ValueError(f"{file.name}: [model]: this section is missing; it says what the structure is")
    data, base = [name for name in DATA if name in content], content["model"]
    if "record" in content and data and "measurements" not in data:
        raise ValueError(f"{file.name}: [record]: modes and load tests have no motion, and [measurements] is missing")
    given = {name: own for name in data if isinstance(own := content[name].pop("model", None), dict)}
    shared = tuple(name for name in given if "kind" not in given[name] and base.get("kind") in USER_MODELS)
    own = {
        name: _read_model(base | each if name in shared else each, f"{file.name}: [{name}.model")
        for name, each in given.items()
    }
    whole = shared and len(own) == len(data)
    kind, model = own[shared[0]] if whole else _read_model(base, f"{file.name}: [model")
    values: dict[str, Any] = {
        name: section(**read_keys(content[name], keys_of(section), f"{file.name}: [{name}]"))
        for name, section in SECTIONS.items()
        if name in content
    }
    values |= {"kind": kind, "model": model, "own_models": own, "shared": shared, "priors": content.get("priors", {})}
    return Job(file=file, text=text, folder=folder, **values)


def _read_model(given: dict[str, Any], where: str) -> tuple[str, dict[str, Any]]:
    kind = given.get("kind")
    if kind not in MODEL_KINDS:
        near = did_you_mean(kind, MODEL_KINDS)
        raise ValueError(f"{where}] kind: expected the kind of the structure; got {kind!r}; {near}")
    keys, tables = model_keys(kind), table_keys(kind)
    known = *(key.name for key in keys), *tables  # the names of tables are proposed as well
    own = {name: value for name, value in given.items() if name not in (*tables, "kind")}
    check_known(own, known, f"{where}]", f"unknown key of kind {kind}")
    values = read_keys(own, keys, f"{where}]")
    for name in given.keys() & tables.keys():
        if not isinstance(given[name], dict):
            section = f"{where.partition(': ')[2]}.{name}]"
            raise ValueError(f"{where}] {name}: expected a section {section}; got {given[name]!r}")
        values[name] = read_keys(given[name], tables[name], f"{where}.{name}]")
    return kind, values


def is_dataset(job: Job, section: str) -> bool:
    """Whether the file of a section is a data set in HDF5, which has record and measurements."""
    given = getattr(job, section)
    return given is not None and Path(given.file or "").suffix.lower() in HDF5


def _file(job: Job, section: str) -> tuple[Path, Dataset | None]:
    """The file that a section names, and its contents if it is a data set."""
    given = getattr(job, section)
    if given is None or given.file is None:
        raise ValueError(f'{job.where(section)} file: this key is missing; it names the data, such as file = "top.csv"')
    path = job.path(section, "file", given.file)
    if not is_dataset(job, section):
        return path, None
    stated = {"column", "columns", "units", *given.READING, *({"zero"} if section == "measurements" else ())}
    if idle := [name for name in given.given() if name in stated]:
        raise ValueError(f"{job.where(section)} {idle[0]}: a data set states this itself: leave the key out")
    return path, job.located(section, read_dataset, path)


def read_base_motion(job: Job) -> Record | None:
    """The excitation, scaled but not shortened, or None without a section ``[record]``."""
    given = job.record
    if (job.kind == "bridge deck") != (given is not None and given.supports is not None):
        raise ValueError(
            f'{job.where("record")} supports: a bridge deck needs three, supports = ["base.csv", "first.csv", '
            '"second.csv"], and other structures have one motion, file'
        )
    if given is None and job.kind in USER_MODELS:
        return None
    if given is not None and given.supports is not None:
        return read_supports(job)[0]
    path, dataset = _file(job, "record")
    options = given.given("column", "units", "missing", *given.READING)
    record = dataset.record if dataset else job.located("record", read_record, path, **options)
    return record if given.scale is None else record.scale(given.scale)


def read_supports(job: Job) -> list[Record]:
    """The motions of several supports, as `read_base_motion`."""
    if more := job.record.given("file", "column"):
        raise ValueError(f"{job.where('record')} {[*more][0]}: leave it out with supports, which name files")
    places = [text.partition(":") for text in job.record.supports]
    alone = [replace(job.record, supports=None, file=file, column=column or None) for file, _, column in places]
    return [read_base_motion(replace(job, kind="", record=one)) for one in alone]


def within_duration(job: Job, data: Any) -> Any:
    """The part of a record or of measurements within the duration that is used."""
    wanted = job.record and job.record.duration
    return data if wanted is None or data is None else job.located("record", data.trim, 0.0, wanted)


def read_measured(job: Job, channels: Sequence[Channel], record: Record | None) -> Measurements:
    """The measurements of a model's channels, without samples before and after the record."""
    path, dataset = _file(job, "measurements")
    given = job.measurements
    measured = dataset.measurements if dataset else job.located("measurements", _read_columns, path, given, channels)
    steps = {"reversed": _turned, "missing": _left_out, "baseline": _straightened, "channels": Measurements.select}
    asked = {key: getattr(given, key) for key in steps if getattr(given, key)}
    if record is not None and dataset is None:
        asked["zero"] = record
    for key, value in asked.items():
        try:
            measured = steps.get(key, _within)(measured, value)
        except ValueError as error:
            raise ValueError(f"{job.where('measurements')} {key}: {error}") from error
    return measured


def _read_columns(path: Path, given: Measured, channels: Sequence[Channel]) -> Measurements:
    by_name = {channel.name: channel for channel in channels}
    columns, units = given.columns or {name: name for name in by_name}, given.units or {}
    for key, names, known in (("columns", columns, tuple(by_name)), ("units", units, tuple(columns))):
        check_known(names, known, f"{key}:", "unknown channel")
    if lacking := [name for name in by_name if name not in columns]:
        raise ValueError(
            f"columns: expected a column for each channel of the model, {', '.join(by_name)}; there is none for "
            f"{', '.join(lacking)}"
        )
    options = given.given("zero", *given.READING)
    marks = [each for each in given.missing or () if not isinstance(each, list)]
    if named := [each for each in marks if each in by_name]:
        raise ValueError(f"missing: a time span is a list of its own, missing = [[{named[0]!r}, 12.3, 12.8]]")
    if marks or given.missing == []:
        options["missing"] = marks
    return read_columns(
        path,
        list(by_name.values()),
        [columns[name] for name in by_name],
        [units.get(name) for name in by_name] if units else None,
        description=f"measurements of {path.name}",
        **options,
    )


def _changed(measured: Measurements, values: np.ndarray, what: str) -> Measurements:
    return replace(measured, values=values, description=f"{measured.description}, {what}")


def _turned(measured: Measurements, names: Sequence[str]) -> Measurements:
    """Measurements with the channels `names` multiplied by -1."""
    turned = measured.select(names).channels
    signs = np.array([[-1.0 if channel in turned else 1.0] for channel in measured.channels])
    return _changed(measured, signs * measured.values, f"reversed: {', '.join(names)}")


def _left_out(measured: Measurements, missing: Sequence[Any]) -> Measurements:
    """Measurements without the samples at the times that `missing` lists, for one channel or all."""
    spans = [each for each in missing if isinstance(each, list)]
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for *name, first, last in spans:
        for channel in measured.select(name or names).channels:
            row, times = names.index(channel.name), measured.times(channel.name)
            margin = 0.1 * measured.steps[row]
            values[row, (times >= first - margin) & (times <= last + margin)] = np.nan
    counts = (np.isfinite(measured.values) & np.isnan(values)).sum(axis=1)
    text = ", ".join(f"{count} of {name}" for name, count in zip(names, counts, strict=True) if count)
    return _changed(measured, values, f"samples left out: {text or 'none'}") if spans else measured


def _straightened(measured: Measurements, points: Mapping[str, Any]) -> Measurements:
    """Measurements less the polynomial through points of time and level, for each channel that has some."""
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for channel in measured.select([*points]).channels:
        times, levels = zip(*points[channel.name], strict=True)
        levels = [read_quantity(level, channel.dimension) for level in levels]
        line = np.polynomial.Polynomial.fit(times, levels, len(levels) - 1)
        values[names.index(channel.name)] -= line(measured.times(channel.name))
    return _changed(measured, values, f"less a baseline: {', '.join(points)}")


def _within(measured: Measurements, record: Record) -> Measurements:
    """The samples within a record, with NaN where the measurements are shorter; the description says what is left out.

    ValueError if a channel has no sample within the record, or fewer than `FEWEST` while others were left out.
    """
    end, rows, starts, notes = record.time[-1], [], [], []
    for channel, values, step in zip(measured.channels, measured.values, measured.steps, strict=True):
        times, name = measured.times(channel.name), channel.name
        inside = np.flatnonzero((times >= -SAME_TIME * step) & (times <= end + SAME_TIME * step))
        found, used = np.isfinite(values).sum(), np.isfinite(values[inside]).sum()
        share = f"{used} of {found} samples of {name} lie within the record"
        if not used or used < min(found, FEWEST):
            raise ValueError(
                f"{share}, 0 to {end:g} s; expected {FEWEST} or more. They were measured from {times[0]:g} to "
                f"{times[-1]:g} s: check time_unit, and set zero to the time in the file at which the base motion "
                'begins (a clock time such as "10:32:07" where the file has clock times)'
            )
        missing = int((end - times[inside[-1]]) / step + SAME_TIME)
        rows.append(np.append(values[inside], np.full(missing, np.nan)))
        starts.append(0.0 if abs(times[inside[0]]) <= SAME_TIME * step else float(times[inside[0]]))
        notes += [f"without {found - used} samples of {name} before or after the record"] if used < found else []
        notes += [f"CAUTION: only {share}: check time_unit and zero, and the record"] if used < found - used else []
        notes += [f"{name} ends {missing * step:.3g} s before the record"] if missing else []
    text = ", ".join([measured.description, *notes])
    return Measurements(measured.channels, measured.steps, rows, text, starts)
