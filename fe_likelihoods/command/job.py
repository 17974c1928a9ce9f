"""An update as its TOML file describes it, read and checked before anything is computed."""

import re
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from .priors import parse_prior
from .schema import EVENT, FREE_SECTIONS, MODEL_KINDS, SECTIONS, Key, did_you_mean, model_keys, part_keys, read_keys

__all__ = ["Job", "parse_job", "read_job"]


DATA = "measurements", "modes", "load_test"  # sections of data sets; each may have its own model, [modes.model]


@dataclass(frozen=True)
class Job:
    """Contents of a TOML file, section by section. Values are in SI units; files are relative to `folder`."""

    file: Path
    text: str  # of the file
    folder: Path
    kind: str  # of the model, one of `MODEL_KINDS`
    model: dict[str, Any]
    record: dict[str, Any]
    measurements: dict[str, Any]
    priors: dict[str, str]  # distributions as text, by parameter
    noise: dict[str, Any]
    sampler: dict[str, Any]
    budget: dict[str, Any]
    prediction: dict[str, Any]
    modes: dict[str, Any] = field(default_factory=dict)
    load_test: dict[str, Any] = field(default_factory=dict)
    own_models: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)  # kind and model of data sets
    events: dict[str, dict[str, Any]] = field(default_factory=dict)  # keys of the events to predict, by name
    model_section: str = "model"  # the section of the model, such as modes.model
    event: str = ""  # to which record and measurements belong; empty for the calibration

    def where(self, section: str) -> str:
        """File and section, for messages."""
        own = self.event and section in ("record", "measurements")
        section = self.model_section if section == "model" else section
        return f"{self.file.name}: [{f'events.{self.event}' if own else section}]"

    def data_sets(self) -> dict[str, "Job"]:
        """The same update with one data set each, by section; the section may have a model of its own."""
        there = [name for name in DATA if getattr(self, name)] or ["measurements"]
        found = {}
        for name in there:
            kind, model = self.own_models.get(name, (self.kind, self.model))
            others: dict[str, Any] = {other: {} for other in DATA if other != name and len(there) > 1}
            if name != "measurements" and len(there) > 1:
                others |= {"record": {}, "noise": {}}
            where = f"{name}.model" if name in self.own_models else "model"
            found[name] = replace(self, kind=kind, model=model, model_section=where, **others)
        return found

    def of_event(self, name: str) -> "Job":
        """The same update with record and measurements of one event; `measurements` is empty without them."""
        given = dict(self.events[name])
        measured = {"file": given.pop("measured")} if "measured" in given else {}
        if measured and "zero" in given:
            measured["zero"] = given.pop("zero")
        if measured and not measured["file"].lower().endswith((".h5", ".hdf5")):
            kept = {key: each for key, each in self.measurements.items() if key not in ("file", "bundled", "baseline")}
            if "missing" in kept:  # times are those of the other file
                kept["missing"] = [each for each in kept["missing"] if not isinstance(each, list)]
            measured = kept | measured
        return replace(self, record=given, measurements=measured, event=name)

    def path(self, section: str, key: str, name: str) -> Path:
        """An existing file that a key names; ValueError if there is none."""
        path = self.folder / Path(name).expanduser()
        if path.is_dir():
            raise ValueError(f"{self.where(section)} {key}: expected a file; {name!r} is a folder")
        if not path.is_file():
            near = (
                did_you_mean(path.name, sorted(p.name for p in path.parent.iterdir() if p.is_file()))
                if (path.parent.is_dir())
                else f"there is no folder {path.parent}"
            )
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
            f"{file.name}: not a TOML file: {error}; a text needs quotes, a section is a line such as [record]"
        ) from error
    sections = (*FREE_SECTIONS, *SECTIONS)
    for name, value in content.items():
        if name not in sections:
            raise ValueError(f"{file.name}: [{name}]: unknown section; {did_you_mean(name, sections)}")
        if not isinstance(value, dict):
            raise ValueError(f"{file.name}: {name}: expected a section [{name}]; got {value!r}")
    if "model" not in content:
        raise ValueError(f"{file.name}: [model]: this section is missing; it says what the structure is")
    kind, model = _read_model(content["model"], f"{file.name}: [model")
    own = {
        name: _read_model(content[name].pop("model"), f"{file.name}: [{name}.model")
        for name in DATA
        if isinstance(content.get(name, {}).get("model"), dict)
    }
    values = {
        name: read_keys(content[name], keys, f"{file.name}: [{name}]") if name in content else {}
        for name, keys in SECTIONS.items()
    }
    data = [name for name in DATA if name in content]
    if data and "measurements" not in data and "record" in content:
        raise ValueError(f"{file.name}: [record]: modes and load tests have no [record]; it belongs to [measurements]")
    if len(data) > 1 and "events" in content:
        raise ValueError(f"{file.name}: [events]: only a file with one data set predicts events; got {', '.join(data)}")
    priors = content.get("priors", {})
    for name, prior in priors.items():
        try:
            parse_prior(prior)
        except ValueError as error:
            raise ValueError(f"{file.name}: [priors] {name}: {error}") from None
    events = _read_events(content.get("events", {}), file.name)
    return Job(file, text, folder, kind, model, priors=priors, events=events, own_models=own, **values)


def _read_events(given: dict[str, Any], file: str) -> dict[str, dict[str, Any]]:
    events = {}
    for name, keys in given.items():
        if not isinstance(keys, dict):
            raise ValueError(f"{file}: [events] {name}: expected a section [events.{name}]; got {keys!r}")
        if not re.fullmatch(r"[\w-]+", name):
            raise ValueError(
                f"{file}: [events.{name}]: expected a name of letters, digits, - and _, for names of files"
            )
        events[name] = read_keys(keys, EVENT, f"{file}: [events.{name}]")
        for key, needed in (("zero", "measured"), ("rest", "from_state")):
            if key in keys and needed not in keys:
                raise ValueError(f"{file}: [events.{name}] {key}: this key has no effect without {needed}")
    return events


def _read_model(given: dict[str, Any], where: str) -> tuple[str, dict[str, Any]]:
    kind = given.get("kind")
    if kind not in MODEL_KINDS:
        known = did_you_mean(kind, MODEL_KINDS) if isinstance(kind, str) else f"known are {', '.join(MODEL_KINDS)}"
        raise ValueError(f"{where}] kind: expected the kind of the structure; got {kind!r}; {known}")
    parts = part_keys(kind)
    keys = (*model_keys(kind), Key("kind", "text", "Kind of the structure", True))
    known = (*(key.name for key in keys), *parts)  # the names of parts are proposed as well
    plain = {name: value for name, value in given.items() if name not in parts}
    if unknown := [name for name in plain if name not in known]:
        raise ValueError(f"{where}] {unknown[0]}: unknown key of kind {kind}; {did_you_mean(unknown[0], known)}")
    values = read_keys(plain, keys, f"{where}]")
    for name, keys in parts.items():
        if name in given:
            if not isinstance(given[name], dict):
                raise ValueError(
                    f"{where}] {name}: expected a section {where.partition(': ')[2]}.{name}]; got {given[name]!r}"
                )
            values[name] = read_keys(given[name], keys, f"{where}.{name}]")
    values.pop("kind")
    return kind, values
