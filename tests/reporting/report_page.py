"""A report as a reader of the file sees it: well-formed markup, its tables, notes, images and addresses."""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

ADDRESSES = ("src", "href", "action", "data", "poster", "srcset")


class Page(NamedTuple):
    """The parts of a page that tests look at."""

    text: str  # all text that is shown
    tables: list  # cells (str) of the rows of each table
    notes: dict  # text of each note by its title
    images: list  # (PNG bytes, alternative text)
    addresses: list  # values of all attributes that a browser would load
    tags: set
    style: str
    path: Path


def read_page(path: Path) -> Page:
    """Parse strictly, as XML: a tag that is not closed, or a text that is not escaped, is an error."""
    markup = path.read_text(encoding="utf-8")
    assert markup.startswith("<!DOCTYPE html>\n")
    root = ElementTree.fromstring(markup.split("\n", 1)[1])
    body = root.find("body")
    notes = {}
    for note in body.iter("div"):
        if (note.get("class") or "").startswith("note"):
            notes[note.find("strong").text] = _text(note)
    tables = [[[_text(cell) for cell in row] for row in table.iter("tr")] for table in body.iter("table")]
    images = []
    for image in body.iter("img"):
        kind, _, data = image.get("src").partition(",")
        assert kind == "data:image/png;base64"
        images.append((base64.b64decode(data, validate=True), image.get("alt")))
    addresses = [element.get(name) for element in root.iter() for name in ADDRESSES if element.get(name) is not None]
    style = "".join(element.text for element in root.iter("style"))
    return Page(_text(body), tables, notes, images, addresses, {element.tag for element in root.iter()}, style, path)


def _text(element: ElementTree.Element) -> str:
    return " ".join("".join(_pieces(element)).split())


def _pieces(element: ElementTree.Element) -> Iterator[str]:
    yield element.text or ""
    for child in element:
        yield from _pieces(child)
        yield " " + (child.tail or "")
