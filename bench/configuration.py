"""The tables of docs/configuration.md: every setting and every scenario knob, from the code that defines them."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Iterator
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lumidock.app.settings_text import field_comments
from lumidock.config import Config
from lumidock.sim.scenario import Scenario

UNITS = {
    "m_s2": "m/s²",
    "rad_s2": "rad/s²",
    "w_m2": "W/m²",
    "m_s": "m/s",
    "rad_s": "rad/s",
    "deg_s": "deg/s",
    "px_s": "px/s",
    "e_s": "electrons/s",
    "m3": "1/m³",
    "deg": "deg",
    "rad": "rad",
    "px": "px",
    "mm": "mm",
    "ms": "ms",
    "hz": "Hz",
    "db": "dB",
    "psu": "psu",
    "c": "°C",
    "e": "electrons",
    "w": "W",
    "m": "m",
    "s": "s",
}
_LIMITS = {Ge: "ge", Gt: "gt", Le: "le", Lt: "lt"}
_SMALLEST, _LARGEST = 1e-12, 1e9  # of config.PositiveFloat


def main() -> tuple[dict[str, object], list[str]]:
    """A table for each section."""
    parts = {"Settings of the methods": Config, "Knobs of a scenario": Scenario}
    lines = []
    for title, model in parts.items():
        lines += [f"## {title}", "", *_section(model, "")]
    return {title: len(list(_models(model))) for title, model in parts.items()}, lines[:-1]


def _section(model: type[BaseModel], path: str) -> Iterator[str]:
    """The table of a section, then those of the sections inside it."""
    if path:
        yield from (f"### `{path}`", "")
    yield from (*(inspect.getdoc(model) or "").splitlines(), "")
    inner = [(name, found) for name, field in model.model_fields.items() if (found := _model_of(field))]
    plain = [name for name in model.model_fields if name not in dict(inner)]
    if plain:
        yield from ("| key | default | unit | values | meaning and origin |", "|---|---|---|---|---|")
        yield from (_row(model, name) for name in plain)
        yield ""
    for name, found in inner:
        yield from _section(found, f"{path}.{name}" if path else name)


def _row(model: type[BaseModel], name: str) -> str:
    field = model.model_fields[name]
    default = "required" if field.is_required() else _plain(field.get_default(call_default_factory=True))
    cells = (f"`{name}`", default, unit_of(name), _values(field), field_comments(model).get(name, ""))
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def unit_of(name: str) -> str:
    """The unit that a name ends in; what has none is a number, a share or a word."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(f"_{ending}")), "")


def _plain(value: Any) -> str:  # noqa: ANN401  # whatever a setting holds
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "empty"


def _values(field: FieldInfo) -> str:
    """The words or the range that a field accepts."""
    if typing.get_origin(field.annotation) is typing.Literal:
        return ", ".join(map(str, typing.get_args(field.annotation)))
    if field.annotation is bool:
        return "true, false"
    found = {
        name: getattr(one, name) for one in field.metadata for kind, name in _LIMITS.items() if isinstance(one, kind)
    }
    if found.get("gt") == 0 or found.get("ge") == _SMALLEST:
        return f"positive, up to {found['le']:g}" if found.get("le", _LARGEST) < _LARGEST else "positive"
    if found.keys() == {"ge", "le"}:
        return f"{found['ge']:g} to {found['le']:g}"
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    return ", ".join(f"{signs[name]} {value:g}" for name, value in found.items())


def _model_of(field: FieldInfo) -> type[BaseModel] | None:
    """The section that a field holds, also where it is none by default."""
    kind = field.annotation
    kinds = typing.get_args(kind) if isinstance(kind, types.UnionType) or typing.get_origin(kind) else (kind,)
    return next((one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)), None)


def _models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        if found := _model_of(field):
            yield from _models(found)
