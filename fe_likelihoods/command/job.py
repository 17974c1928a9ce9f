"""An update as its TOML file describes it, read and checked before anything is computed."""

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from . import sections
from .keys import check_known, did_you_mean, keys_of, read_keys
from .sections import FREE_SECTIONS, MODEL_KINDS, SECTIONS, USER_MODELS, model_keys, part_keys

__all__ = ["HDF5", "Job", "parse_job", "read_job"]

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
    record: sections.Motion | None = None
    measurements: sections.Measured | None = None
    modes: sections.Modes | None = None
    load_test: sections.LoadTest | None = None
    noise: sections.Noise | None = None
    sampler: sections.Sampler = field(default_factory=sections.Sampler)
    budget: sections.Budget = field(default_factory=sections.Budget)
    prediction: sections.Predictions = field(default_factory=sections.Predictions)
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
    keys, parts = model_keys(kind), part_keys(kind)
    known = *(key.name for key in keys), *parts  # the names of parts are proposed as well
    own = {name: value for name, value in given.items() if name not in (*parts, "kind")}
    check_known(own, known, f"{where}]", f"unknown key of kind {kind}")
    values = read_keys(own, keys, f"{where}]")
    for name in given.keys() & parts.keys():
        if not isinstance(given[name], dict):
            section = f"{where.partition(': ')[2]}.{name}]"
            raise ValueError(f"{where}] {name}: expected a section {section}; got {given[name]!r}")
        values[name] = read_keys(given[name], parts[name], f"{where}.{name}]")
    return kind, values
