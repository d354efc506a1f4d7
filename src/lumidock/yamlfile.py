"""Reading of YAML files that users write: capped in size and depth, no aliases, no tags, no key given twice."""

from __future__ import annotations

import codecs
import difflib
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from lumidock.errors import InputError

MAX_BYTES = 1 << 20
MAX_DEPTH = 20
_MOST_KEYS_LISTED = 40  # more would not fit into one line that a person reads

Model = TypeVar("Model", bound=BaseModel)


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} given twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def _check_structure(text: str) -> None:
    """Refuse aliases, tags and deep nesting before anything is built from the text."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not allowed")
        if getattr(event, "tag", None) is not None:
            raise yaml.YAMLError("tags are not allowed")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise yaml.YAMLError(f"nested deeper than {MAX_DEPTH}")


def read_mapping(path: Path, kind: str = "") -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    `kind` is what the file should be, a key of `_KINDS`. Raises: InputError, one line, when it cannot be read or
    parsed, is over 1 MiB, nested too deep, uses aliases or tags, or is recognised as a file of another kind.
    """
    content = parse_mapping(read_text(path), path)
    found = kind_of(content)
    if kind and found not in ("", kind):
        advice = "; convert it with `lumidock calib import`" if (found, kind) == ("Kalibr camchain", "camera") else ""
        raise InputError(f"{path}: this is a {found} file, wanted a {kind} file{advice}")
    return content


# keys that only one kind of file has at its top level
_KINDS = {
    "station": {"lights", "docking_point", "survey_sigma"},
    "camera": {"camera_matrix", "image_width", "distortion_model"},
    "vehicle": {"T_body_cam", "body_frame"},
    "scenario": {"path", "water", "daylight", "lamps", "around", "faults", "detections"},
    "configuration": {"paper", "prior", "match", "track", "integrity", "detect", "label"},
}


def kind_of(content: dict[str, Any]) -> str:
    """Which kind of lumidock's files the keys belong to, or `Kalibr camchain`; empty where they do not tell."""
    if any(isinstance(entry, dict) and "intrinsics" in entry for entry in content.values()):
        return "Kalibr camchain"
    found = [kind for kind, keys in _KINDS.items() if keys & content.keys()]
    return found[0] if len(found) == 1 else ""


def read_text(path: Path) -> str:
    """The text of a small file. Raises: InputError, one line, when it cannot be read or is over 1 MiB."""
    try:
        with path.open("rb") as file:
            content_bytes = file.read(MAX_BYTES + 1)  # not the size on disk: a device or a pipe has none
        if len(content_bytes) > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES} bytes")
        return _decoded(content_bytes)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:  # no UTF-8, or a name that no file can have
        raise InputError(f"{path}: not valid YAML: {error}") from None


def _decoded(content: bytes) -> str:
    """Text by its byte order mark, which editors on Windows write; UTF-8 without one. Raises: ValueError."""
    for mark, encoding in (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    ):
        if content.startswith(mark):
            return content[len(mark) :].decode(encoding)
    return content.decode("utf-8")


def parse_mapping(text: str, path: Path) -> dict[str, Any]:
    """The mapping that a text in YAML stands for; `path` is what an error calls it. Raises: as `read_mapping`."""
    try:
        _check_structure(text)
        content = yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: wanted keys and values at the top level")
    return content


def validate(model: type[Model], content: dict[str, Any], origin: str) -> Model:
    """Check `content` against a pydantic model.

    Raises: InputError, one line with `origin`, the place in it and what is wrong there; of an unknown key also the
    nearest known one, and all keys of its section.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = _most_telling(error.errors())
        place = " ".join(_place_in(content, first["loc"]).split())
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = f"unknown key{_known_keys(model, first['loc'])}"
        raise InputError(f"{origin}: {place + ': ' if place else ''}{message}") from None


def _place_in(content: Any, loc: tuple[int | str, ...]) -> str:  # noqa: ANN401  # whatever a YAML file holds
    """A place in words of the file: keys with points between them, an entry of a list by its `id` or counted from 1."""
    words = ""
    for part in loc:
        if isinstance(part, int) and isinstance(content, list):
            content = content[part] if part < len(content) else None
            name = " ".join(str(content.get("id", "")).split()) if isinstance(content, dict) else ""
            words += f" {name}: " if name else f" entry {part + 1}: "
        elif isinstance(content, dict) and not str(part).startswith("_"):
            content = content.get(part)
            words += f".{part}" if words and not words.endswith(" ") else str(part)
        # else the name of a model or a type, where a key may hold one of several
    return words.rstrip(": ")


def _most_telling(errors: list[ErrorDetails]) -> ErrorDetails:
    """The first error, or for a missing key an unknown one beside it, which often is the missing one misspelt."""
    first = errors[0]
    beside = (one for one in errors if one["type"] == "extra_forbidden" and one["loc"][:-1] == first["loc"][:-1])
    return next(beside, first) if first["type"] == "missing" else first


def kind_of_file(path: Path) -> str:
    """What a YAML file plainly is by its keys, as `kind_of`; empty where it cannot be read."""
    try:
        return kind_of(read_mapping(path))
    except InputError:
        return ""


def _known_keys(model: type[BaseModel], place: tuple[int | str, ...]) -> str:
    """What could have been meant by the unknown key at the end of `place`."""
    section: Any = model
    for part in place[:-1]:
        if isinstance(part, str):
            section = _section_within(section, part)
    if section is None:
        return ""
    keys = [field.alias or name for name, field in section.model_fields.items()]
    near = difflib.get_close_matches(str(place[-1]), keys, n=1)
    meant = f", did you mean {near[0]}?" if near else ""
    return f"{meant} (known here: {', '.join(keys)})" if len(keys) <= _MOST_KEYS_LISTED else meant


def _section_within(model: type[BaseModel] | None, key: str) -> type[BaseModel] | None:
    """The model of one key of a model; None where the key has none of its own, or several."""
    field = model.model_fields.get(key) if model is not None else None
    models = [] if field is None else _models_in(field.annotation)
    return models[0] if len(models) == 1 else model if field is None else None


def _models_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401  # any type annotation
    """The pydantic models that a type annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for inner in get_args(annotation) for found in _models_in(inner)]
