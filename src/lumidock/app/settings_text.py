"""Settings as commented YAML: the comments beside the fields in the source are their documentation."""

from __future__ import annotations

import ast
import inspect
import io
import tokenize
from collections.abc import Iterator
from functools import cache
from typing import Any

import yaml
from pydantic import BaseModel

_MAX_WIDTH = 118


def as_yaml(settings: BaseModel) -> str:
    """All fields of nested settings as YAML, each with its comment in the source: unit, meaning and origin."""
    return "".join(f"{line}\n" for line in _lines(settings, 0))


def _lines(settings: BaseModel, depth: int) -> Iterator[str]:
    indent, comments = "  " * depth, field_comments(type(settings))
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, BaseModel):
            summary = (inspect.getdoc(type(value)) or "").partition("\n")[0].rstrip(".")
            yield f"{indent}{name}:  # {summary}"
            yield from _lines(value, depth + 1)
            continue
        entry = f"{indent}{name}: {_scalar(settings.model_dump(mode='json')[name])}"
        comment = comments.get(name, "")
        if comment and len(entry) + len(comment) + 4 <= _MAX_WIDTH:
            yield f"{entry}  # {comment}"
            continue
        if comment:
            yield f"{indent}# {comment}"
        yield entry


def _scalar(value: Any) -> str:  # noqa: ANN401  # whatever a setting holds
    """A value as YAML on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("...\n").strip()


@cache
def field_comments(model: type[BaseModel]) -> dict[str, str]:
    """The comment of each field of a settings model: beside it, or on the lines directly above it."""
    found: dict[str, str] = {}
    for parent in reversed(model.__mro__):
        if parent is not BaseModel and isinstance(parent, type) and issubclass(parent, BaseModel):
            found |= _comments_in(inspect.getsource(parent))
    return found


def _comments_in(source: str) -> dict[str, str]:
    """Comments by field name in the source of one class."""
    comments = {
        token.start[0]: (token.string.lstrip("# ").rstrip(), token.line.lstrip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    found = {}
    (body,) = (node.body for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            above, line = list[str](), node.lineno - 1
            while line in comments and comments[line][1]:
                above.insert(0, comments[line][0])
                line -= 1
            beside = [comments[k][0] for k in range(node.lineno, (node.end_lineno or node.lineno) + 1) if k in comments]
            found[node.target.id] = " ".join([*above, *beside])
    return found
