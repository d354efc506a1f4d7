"""The tables of docs/cli.md: every command with its arguments and options, from the code that defines them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import typer.main

from lumidock.cli.shared import app


def main() -> tuple[dict[str, object], list[str]]:
    """A section for each command, in the order of `lumidock --help`."""
    import lumidock.cli  # noqa: F401  # its modules register the commands

    commands = list(_commands(typer.main.get_command(app), "lumidock"))
    lines = [line for name, command in commands for line in _section(name, command)]
    return {"commands": [name for name, _ in commands]}, lines[:-1]


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:  # noqa: ANN401  # typer does not export its type
    """The commands without those that only group others."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield name, command
        return
    for word, one in inner.items():
        yield from _commands(one, f"{name} {word}")


def _section(name: str, command: Any) -> Iterator[str]:  # noqa: ANN401
    yield from (f"## {name}", "", " ".join(inspect.cleandoc(command.help or "").split()), "")
    yield from ("| Argument or option | Meaning | Default |", "|---|---|---|")
    for parameter in command.params:
        if parameter.name != "help":
            yield _row(parameter)
    yield ""


def _row(parameter: Any) -> str:  # noqa: ANN401
    metavar = parameter.metavar or ""
    if parameter.param_type_name == "argument":
        words, meaning = f"`{metavar or parameter.human_readable_name}`", parameter.help or ""
    else:
        names = [*parameter.opts, *parameter.secondary_opts]
        words = ", ".join(f"`{word}`" for word in names) + (f" `{metavar}`" if metavar else "")
        meaning = parameter.help or ""
    default = "required" if parameter.required else _default(parameter.default)
    cells = (words, " ".join(meaning.split()), default)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _default(value: object) -> str:
    """A default as it would be written; nothing where there is none, or where a switch is off."""
    if value is True:
        return "on"
    plain = value is not None and value is not False and value != () and isinstance(value, str | int | float)
    return f"`{value}`" if plain else ""
