"""Tables of the keys of the TOML file: ``python -m tests.command.key_tables`` writes them into docs/keys.rst."""

import re
from collections.abc import Collection, Iterable
from pathlib import Path

from fe_likelihoods.command.keys import (
    FORMS,
    MODEL_KINDS,
    SECTIONS,
    USER,
    USER_MODELS,
    Key,
    keys_of,
    model_keys,
    table_keys,
)
from fe_likelihoods.units import DIMENSIONS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "keys.rst"
START, END = ".. keys begin\n", ".. keys end\n"


def _kind(key: Key) -> str:
    if key.kind.startswith("one of "):
        return ", ".join(f'``"{each}"``' for each in key.kind.removeprefix("one of ").split(", "))
    return f"[{DIMENSIONS[key.kind]}]" if key.kind in DIMENSIONS else key.kind


def _literal(meaning: str) -> str:
    """Names in backticks, and texts in quotes as they are typed, not as typographic quotes, as literals."""
    return re.sub(r'``[^`]+``|`[^`]+`|"[^"]+"', lambda found: f"``{found[0].strip('`')}``", meaning)


def _cell(text: str) -> str:
    quoted = text.replace('"', '""')
    return f'"{quoted}"' if set(text) & set(',"') else text


def _table(title: str, keys: Iterable[Key]) -> str:
    lines = [f".. csv-table:: {title}", "   :header: key, value, meaning", "   :widths: 22 22 56", ""]
    for key in keys:
        cells = f"``{key.name}``", _kind(key), _literal(key.meaning) + (" (required)" if key.required else "")
        lines.append(f"   {', '.join(map(_cell, cells))}")
    return "\n".join(lines) + "\n"


def _without(keys: Iterable[Key], others: Collection[Key]) -> list[Key]:
    return [key for key in keys if key not in others]


def key_tables() -> str:
    """All tables as reStructuredText; keys that several sections have are in one of them."""
    blocks = []
    for kind in MODEL_KINDS:
        keys = model_keys(kind)
        blocks.append(_table(f'``[model] kind = "{kind}"``', _without(keys, USER if kind in USER_MODELS else ())))
        seen = {}
        for part, keys in table_keys(kind).items():
            seen.setdefault(keys, []).append(f"``[model.{part}]``")
        blocks += [_table(", ".join(parts), keys) for keys, parts in seen.items()]
    kinds = ", ".join(f'``"{kind}"``' for kind in USER_MODELS)
    blocks.append(_table(f"``[model]`` of the kinds {kinds}", USER))
    blocks += [_table(f"``[{section}]``", keys_of(each)) for section, each in SECTIONS.items()]
    forms = "".join(f"* {form}\n" for _, form in FORMS.values())
    blocks.append(f"Distributions of ``[priors]``:\n\n{forms}")
    return "\n".join(blocks)


def main() -> None:
    """Write the tables into the page."""
    before, _, rest = PAGE.read_text().partition(START)
    PAGE.write_text(f"{before}{START}\n{key_tables()}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
