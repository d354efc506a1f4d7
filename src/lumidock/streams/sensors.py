"""Values of the vehicle's own sensors beside the frames: aiding.csv, and what gives them to a localizer in time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol, get_args

from lumidock.datatypes import SENSOR_VALUES, AidingMeasurement, SensorKind
from lumidock.errors import DataError, InputError

AIDING_COLUMNS = ("t_ns", "kind", "v0", "v1", "v2", "v3", "sigma")
_MAX_STAMP = 2**63 - 1
_KINDS: tuple[SensorKind, ...] = get_args(SensorKind)


class SensorFeed(Protocol):
    """What gives the vehicle's own sensors to a localizer."""

    def until(self, t_ns: int | None) -> Iterator[AidingMeasurement]:
        """The values that are there and have not been handed out, at least those up to the frame at `t_ns`."""
        ...


class AidingFeed:
    """Hands out values in the order in which they come, each before the first frame that is not earlier."""

    def __init__(self, values: Iterable[AidingMeasurement]) -> None:
        """Begin with the first value."""
        self._values = iter(values)
        self._next = next(self._values, None)

    def until(self, t_ns: int | None) -> Iterator[AidingMeasurement]:
        """The values up to `t_ns` that have not been handed out; none for a frame without a stamp."""
        while t_ns is not None and self._next is not None and self._next.t_ns <= t_ns:
            value, self._next = self._next, next(self._values, None)
            yield value


def aiding_in(rows: Iterable[dict[str, str]], path: Path) -> tuple[AidingMeasurement, ...]:
    """The values in the rows of an aiding.csv, at `path`, by rising stamp; those in broken rows are left out.

    Raises: InputError when no row is usable.
    """
    values = [value for row in rows if (value := _value(row)) is not None]
    if not values:
        raise InputError(f"{path}: no usable row; wanted {','.join(AIDING_COLUMNS)}, kind one of {', '.join(_KINDS)}")
    return tuple(sorted(values, key=lambda value: value.t_ns))


def _value(row: dict[str, str]) -> AidingMeasurement | None:
    kind = next((kind for kind in _KINDS if kind == row["kind"].strip()), None)
    if kind is None:
        return None
    try:
        t_ns = int(row["t_ns"])
        if abs(t_ns) > _MAX_STAMP:
            return None
        numbers = tuple(float(row.get(f"v{k}") or "nan") for k in range(SENSOR_VALUES[kind]))
        return AidingMeasurement(kind, t_ns, numbers, float(row.get("sigma") or math.nan))
    except (ValueError, DataError):
        return None
