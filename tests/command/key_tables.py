"""Tables of the keys of the TOML file: ``python -m tests.command.key_tables`` writes them into docs/command.rst."""

from pathlib import Path

from fe_likelihoods.command.priors import FORMS
from fe_likelihoods.command.schema import EVENT, MODELS, PARTS, SECTIONS, Key
from fe_likelihoods.units import DIMENSIONS

__all__ = ["PAGE", "key_tables"]

PAGE = Path(__file__).resolve().parents[2] / "docs" / "command.rst"
START, END = ".. keys begin\n", ".. keys end\n"


def _kind(key: Key) -> str:
    name = {"displacement": "length", "rotation": "angle"}.get(key.kind, key.kind)
    return f"{name} [{DIMENSIONS[key.kind]}]" if key.kind in DIMENSIONS else name


def _table(title: str, keys: tuple[Key, ...]) -> str:
    lines = [f".. list-table:: ``{title}``", "   :header-rows: 1", "   :widths: 22 22 56", ""]
    lines += ["   * - key", "     - value", "     - meaning"]
    for key in keys:
        required = " (required)" if key.required else ""
        lines += [f"   * - ``{key.name}``", f"     - {_kind(key)}", f"     - {key.meaning}{required}"]
    return "\n".join(lines) + "\n"


def key_tables() -> str:
    """All tables as reStructuredText."""
    blocks = []
    for kind, keys in MODELS.items():
        blocks.append(_table(f'[model] kind = "{kind}"', keys))
        seen = {}
        for part, part_keys in PARTS.get(kind, {}).items():
            seen.setdefault(part_keys, []).append(f"[model.{part}]")
        blocks += [_table(", ".join(parts), part_keys) for part_keys, parts in seen.items()]
    blocks += [_table(f"[{section}]", keys) for section, keys in SECTIONS.items()]
    blocks.append(_table("[events.NAME]", EVENT))
    forms = tuple(Key(name, "text", form) for name, (form, _) in FORMS.items())
    blocks.append(_table("[priors]", forms).replace("   * - key\n     - value", "   * - distribution\n     - value"))
    return "\n".join(blocks)


def main() -> None:
    """Write the tables into the page."""
    before, _, rest = PAGE.read_text().partition(START)
    PAGE.write_text(f"{before}{START}\n{key_tables()}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
