"""Files to start from: the templates of the command ``new``."""

from importlib import resources
from pathlib import Path

__all__ = ["TEMPLATES", "write_templates"]

_DATA = ("synthetic_record.csv", "synthetic_measured.csv")
TEMPLATES = {
    "column": ("column.toml",),
    "bridge": ("bridge.toml",),
    "function": ("function.toml", "my_function.py", *_DATA),
    "opensees": ("opensees.toml", "my_opensees.py", *_DATA),
    "modal": ("modal.toml", "synthetic_modes.csv"),
    "load-test": ("load-test.toml", "my_girder.py", "synthetic_load_test.csv"),
    "executable": ("executable.toml", "my_program.py", "my_input.txt", "synthetic_logger.csv"),
}
"""Files of each kind, in the folder ``templates`` of the bundled data."""


def write_templates(kind: str, folder: Path) -> tuple[str, ...]:
    """Copy the templates of a kind, a key of `TEMPLATES`, to a folder, which is created; names of the files.

    ValueError if one of the files exists.
    """
    names = TEMPLATES[kind]
    if there := [name for name in names if (folder / name).exists()]:
        raise ValueError(f"{folder} already contains {', '.join(there)}; give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    source = resources.files("fe_likelihoods.data") / "templates"
    for name in names:
        (folder / name).write_bytes((source / name).read_bytes())
    return names
