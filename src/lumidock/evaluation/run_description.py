"""The run.json of a run folder: what the run was made with and from, and its counts."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from lumidock.errors import InputError

_MAPPINGS = ("source", "inputs_sha256", "inputs_sampled", "config", "counts")


def read_description(folder: Path) -> dict[str, Any]:
    """The content of run.json. Raises: InputError, one line, for a folder without one or one that is damaged."""
    path = folder / "run.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if not isinstance(content, dict) or not all(isinstance(content.get(part, {}), dict) for part in _MAPPINGS):
        raise InputError(f"{path}: not the description of a run")
    return content


def description_if_any(folder: Path) -> dict[str, Any]:
    """The same, but empty where another program wrote the run folder and left no readable run.json."""
    try:
        return read_description(folder)
    except InputError:
        return {}


def frame_in_source(frame: str, known: Container[str]) -> str:
    """The name of a frame in its source: that of a live run, in a later pass over a recording, has a number before it.

    `2.000017` is frame 000017 in the third pass, unless the source knows a frame of that name.
    """
    number, point, name = frame.partition(".")
    return name if frame not in known and point and number.isdecimal() and name in known else frame


_Known = TypeVar("_Known")


def with_passes(content: Mapping[str, _Known], frames: Iterable[str]) -> dict[str, _Known]:
    """What is known of each frame of a source, by the names that a run over one or several passes has for them."""
    names = {frame: frame_in_source(frame, content) for frame in frames}
    return {**content, **{frame: content[name] for frame, name in names.items() if name in content}}


def source_kind(description: Mapping[str, Any]) -> str:
    """What the frames came from: `sequence`, `detections`, `bag`, ...; empty where that is not known."""
    return str(description.get("source", {}).get("kind", ""))


def mean_nis(description: Mapping[str, Any]) -> dict[str, float] | None:
    """Mean normalised innovation squared per degree of freedom over the tracked frames, as the run summed it up."""
    try:
        nis = description["counts"]["nis"]
        return None if nis is None else {"frames": int(nis["frames"]), "mean": float(nis["mean"])}
    except (KeyError, TypeError, ValueError):
        return None


def contradictions(description: Mapping[str, Any]) -> list[tuple[str, str, int]]:
    """What the lights said against the files: the sentence, the reason and the frames; empty where none are noted."""
    try:
        found = description["counts"]["contradictions"]
        return [(str(one["text"]), str(one["file"]), int(one["frames"])) for one in found]
    except (KeyError, TypeError, ValueError):
        return []


def finished(description: Mapping[str, Any]) -> bool | None:
    """Whether the run came to its end; False where it was interrupted or goes on, None where that is not known."""
    found = description.get("counts", {}).get("finished")
    return found if isinstance(found, bool) else None


def over_limit_in_words(description: Mapping[str, Any]) -> list[str]:
    """For each kind of error whose protection level kept frames from being valid: how many, and by which factor."""
    try:
        found = description["counts"]["over_limit"]
        return [
            f"{of} level over its alert limit in {int(one['frames'])} frames, "
            f"{float(one['least']):.3g} to {float(one['most']):.3g} times"
            for of, one in found.items()
        ]
    except (KeyError, TypeError, ValueError, AttributeError):
        return []
