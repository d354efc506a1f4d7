"""A page of sections with figures, tables and images, in one HTML file that loads nothing from elsewhere."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import ClassVar

from lumidock.errors import InputError, extra
from lumidock.streams.colors import ON_NIGHT, ON_PAPER, STAGES_ON_NIGHT, STAGES_ON_PAPER


@dataclass(frozen=True, slots=True)
class Plot:
    """A vector figure in two layouts, as SVG: `wide` for a desk and `narrow` for a phone."""

    kind: ClassVar[str] = "plot"
    name: str
    caption: str
    wide: str
    narrow: str


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text under `head`; the first cell of a row names it."""

    kind: ClassVar[str] = "table"
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Mark:
    """Something drawn over an image, at `x`, `y` px of it: a ring of radius `r`, or a cross when `r` is 0.

    The label of a ring stands on its right, or `on_left`.
    """

    x: float
    y: float
    r: float
    label: str
    color: str
    on_left: bool = False


@dataclass(frozen=True, slots=True)
class AnnotatedImage:
    """A JPEG image with marks over it, and `notes` below it."""

    kind: ClassVar[str] = "image"
    title: str
    caption: str
    jpeg_base64: str
    width: int
    height: int
    marks: Sequence[Mark]
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Listing:
    """Preformatted text that is folded away below its caption until it is opened."""

    kind: ClassVar[str] = "listing"
    caption: str
    text: str


@dataclass(frozen=True, slots=True)
class Tile:
    """One number in a card, what it means, and whether it is `good`, `bad` or neither."""

    value: str
    label: str
    verdict: str = ""


@dataclass(frozen=True, slots=True)
class PageSection:
    """A part of a page under its own title."""

    title: str
    text: str = ""
    tiles: Sequence[Tile] = ()
    items: Sequence[Plot | Table | AnnotatedImage | Listing] = field(default=())


def render(title: str, lead: str, sections: Sequence[PageSection]) -> str:
    """The page as HTML; all text in it is escaped. Raises: InputError when jinja2 is not installed (extra `report`)."""
    with extra("report"):
        from jinja2 import Environment, StrictUndefined
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((files("lumidock.report") / "page.html.j2").read_text(encoding="utf-8"))
    themes = {"paper": _theme(ON_PAPER, STAGES_ON_PAPER), "night": _theme(ON_NIGHT, STAGES_ON_NIGHT)}
    return template.render(title=title, lead=lead, sections=sections, themes=themes)


def _theme(layers: tuple[str, ...], stages: dict[str, str]) -> str:
    """The variables of the style sheet for layers and stages, from their one definition."""
    return " ".join(f"--{name}: {color};" for name, color in (stages | {"accent": layers[3]}).items())


def write(path: Path, text: str) -> None:
    """Write a page. Raises: InputError for a path that is a folder."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", errors="backslashreplace")


def markdown(table: Table) -> str:
    """A table as Markdown."""
    rows = [list(table.head), ["---"] * len(table.head), *table.rows]
    lines = ["| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |" for row in rows]
    return "\n".join([f"**{table.caption}**", "", *lines]) + "\n"


def escaped(text: str) -> str:
    """Text made safe for an SVG attribute."""
    return html.escape(text, quote=True)
