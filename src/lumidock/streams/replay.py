"""A run folder read back as fixes."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np

from lumidock.datatypes import (
    Array,
    Detections,
    Fix,
    Guide,
    Match,
    Protection,
    SensorKind,
    SensorState,
    SensorUse,
    Stage,
    Status,
    Velocity,
)
from lumidock.errors import InputError
from lumidock.geometry import pose_from_quat
from lumidock.streams.run_folder import (
    COVARIANCE_COLUMNS,
    FIX_COLUMNS,
    GUIDE_COLUMNS,
    LIGHT_COLUMNS,
    PROTECTION_COLUMNS,
    VELOCITY_COLUMNS,
)

Row = dict[str, str]
_LATER_COLUMNS = (*VELOCITY_COLUMNS, "aiding")  # which runs of the first versions do not have
_POSE_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def read_fixes(folder: Path, light_ids: tuple[str, ...]) -> Iterator[tuple[Fix, int | None, int | None]]:
    """Fix, stamp ns and latency us of each row of a run, in its order.

    Raises: InputError, one line, for a folder that is no run or a row that is damaged.
    """
    path = folder / "fixes.csv"
    lights = _lights(folder / "lights.csv")
    needed = tuple(name for name in FIX_COLUMNS if name not in _LATER_COLUMNS)
    for number, row in enumerate(_rows(path, needed), start=2):
        try:
            yield _fix(row, lights.get(row["frame"], []), light_ids), _integer(row["t_ns"]), _integer(row["latency_us"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: line {number}: {' '.join(str(error).split())}") from None


def _rows(path: Path, columns: tuple[str, ...]) -> Iterator[Row]:
    try:
        with path.open(newline="", encoding="utf-8", errors="replace") as file:
            reader = csv.DictReader(file)
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: no column {missing[0]}")
            yield from reader
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def _lights(path: Path) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in _rows(path, LIGHT_COLUMNS):
        found.setdefault(row["frame"], []).append(row)
    return found


def _integer(text: str) -> int | None:
    return int(text) if text else None


def _numbers(row: Row, columns: tuple[str, ...]) -> Array | None:
    """The numbers of some columns; None when they are empty."""
    if not all(row[name] for name in columns):
        return None
    return np.array([float(row[name]) for name in columns])


def _fix(row: Row, lights: list[Row], light_ids: tuple[str, ...]) -> Fix:
    pose, levels, guide = (_numbers(row, names) for names in (_POSE_COLUMNS, PROTECTION_COLUMNS, GUIDE_COLUMNS))
    triangle = _numbers(row, COVARIANCE_COLUMNS)
    return Fix(
        row["frame"],
        _integer(row["t_ns"]) or 0,
        _word(row["status"], Status),
        _word(row["stage"], Stage),
        n_seen=int(row["n_seen"]),
        n_used=int(row["n_used"]),
        T_dock_cam=None if pose is None else pose_from_quat(pose[:3], pose[3:]),
        reason=row["reason"],
        match=_match(row, lights, light_ids),
        covariance=None if triangle is None else _symmetric(triangle),
        protection=None if levels is None else Protection(*map(float, levels)),
        guide=Guide(*map(float, guide)) if guide is not None and row["guide"] == "1" else None,
        velocity=_velocity(row),
        aiding=tuple(_sensor_use(text) for text in (row.get("aiding") or "").split()),
    )


def _velocity(row: Row) -> Velocity | None:
    """Velocity and rates; of their covariance a run folder holds the diagonal."""
    numbers = _numbers({name: row.get(name) or "" for name in VELOCITY_COLUMNS}, VELOCITY_COLUMNS)
    return None if numbers is None else Velocity(numbers[:3], numbers[3:6], np.diag(numbers[6:] ** 2))


def _sensor_use(text: str) -> SensorUse:
    kind, _, said = text.partition("=")
    state, _, reason = said.partition(":")
    return SensorUse(_word(kind, SensorKind), _word(state, SensorState), reason)


def _word(text: str, kind: Any) -> Any:  # noqa: ANN401  # a Literal of typing
    if text not in get_args(kind):
        raise ValueError(f"{text[:40]!r} is none of {', '.join(get_args(kind))}")
    return text


def _symmetric(triangle: Array) -> Array:
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = triangle
    return np.asarray(matrix + np.triu(matrix, 1).T)


def _match(row: Row, lights: list[Row], light_ids: tuple[str, ...]) -> Match | None:
    if not lights:
        return None
    number = {name: i for i, name in enumerate(light_ids)} | {"": -1}
    columns = {name: np.array([float(light[name] or "nan") for light in lights]) for name in LIGHT_COLUMNS[1:-1]}
    detections = Detections(
        row["frame"],
        _integer(row["t_ns"]) or 0,
        np.stack([columns["u_px"], columns["v_px"]], axis=1),
        radius_px=columns["radius_px"],
        flux=columns["flux"],
        p_light=columns["p_light"],
        p_rear=columns["p_rear"],
    )
    return Match(detections, np.array([number[light["light"]] for light in lights], np.int64))
