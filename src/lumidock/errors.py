"""What lumidock raises on purpose: one line of text each, fit to be shown to a person."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class LumidockError(Exception):
    """Base class of every error lumidock raises on purpose."""


class InputError(LumidockError):
    """A file, folder or option that cannot be used at all."""


class DataError(LumidockError, ValueError):
    """A value handed to the library that cannot be what its argument stands for: its type, its shape or its range."""


class FrameError(LumidockError):
    """One frame that cannot be used; `reason` is the fixed word for the `reason` column."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Import an optional library within this. Raises: InputError that names the extra when it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("lumidock"):
            raise
        raise InputError(f"{error.name} is not installed; pip install 'lumidock[{name}]'") from None
