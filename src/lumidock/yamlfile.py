"""Reading of YAML written by strangers: capped in size and depth, no aliases, no tags, no key given twice."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from lumidock.errors import InputError

MAX_BYTES = 1 << 20
MAX_DEPTH = 20

_KINDS = {
    "station": ("lights", "docking_point"),
    "vehicle": ("T_body_cam",),
    "camera": ("camera_matrix", "image_width", "cam0"),
    "config": ("detect", "integrity"),
}

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


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises: InputError, one line, when it cannot be read or parsed, is over 1 MiB, nested too deep or uses aliases
    or tags.
    """
    return parse_mapping(read_text(path), path)


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

    Raises: InputError, one line naming `origin`, the place in it and what is wrong there.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = " ".join(".".join(str(part) for part in first["loc"]).split())
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = "unknown key"
        raise InputError(f"{origin}: {place + ': ' if place else ''}{message}") from None


def kind_of_file(path: Path) -> str:
    """What a YAML file plainly is by its keys: station, camera, vehicle or config; empty where it is none of them."""
    try:
        content = read_mapping(path)
    except InputError:
        return ""
    for kind, keys in _KINDS.items():
        if any(key in content for key in keys):
            return kind
    return ""
