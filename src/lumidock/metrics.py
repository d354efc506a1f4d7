"""A run against the truth: errors, gaps, labels, and how the two layers agree."""

from __future__ import annotations

import csv
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.datatypes import Array
from lumidock.errors import InputError
from lumidock.geometry import pose_from_quat, se3_inverse, so3_log
from lumidock.station import Station, load_station

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_SAME_SPOT_PX = 3.0  # a named detection this close to its light's true centre was made by it
_RANGE_BINS_M = (-3.0, 0.0, 3.0, 8.0, 12.0, 18.0, 24.0, 30.0)

Row = dict[str, str]


def true_poses(truth: Path) -> dict[str, Array]:
    """True poses `T_dock_cam` (4, 4) by frame name, from a simulated sequence folder or a truth.csv.

    Raises: InputError, one line.
    """
    path = truth / "truth.csv" if truth.is_dir() else truth
    return {row["frame"]: _pose(path, row) for row in _rows(path, ("frame", *_POSE))}


def evaluate(run_folder: Path, truth: Path) -> dict[str, Any]:
    """Compare a run folder with a simulated sequence folder, or with a truth.csv alone.

    Errors are in dock axes: lateral hypot(x, y), axial |z|, angle the total rotation. Raises: InputError, one line.
    """
    folder = truth if truth.is_dir() else truth.parent
    true, path = true_poses(truth), run_folder / "fixes.csv"
    fixes = _rows(path, ("frame", "t_ns", "valid", "reason", *_POSE))
    if fixes and not any(row["frame"] in true for row in fixes):
        raise InputError(f"{truth}: knows none of the run's frames")
    found = [(row["frame"], _pose(path, row)) for row in fixes if row["valid"] == "1"]
    common = [name for name, _ in found if name in true]
    errors = np.array([_error(T, true[name]) for name, T in found if name in true]).reshape(-1, 3)
    result: dict[str, Any] = {
        "frames": len(fixes),
        "valid": len(found),
        "reasons": dict(Counter(row["reason"] for row in fixes if row["reason"])),
        "error": _error_summary(errors),
        "by_true_z": _by_range(true, common, errors),
        "longest_gap_s": _longest_gap_s(path, fixes),
    }
    if (run_folder / "layers.csv").exists():
        result["layers"] = _layers(run_folder, true)
    if (folder / "lights_truth.csv").exists():
        result["labels"] = _labels(run_folder, folder, true)
    return result


def _rows(path: Path, columns: tuple[str, ...]) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="")
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: no column {missing[0]}")
            return list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def _numbers(path: Path, row: Row, names: tuple[str, ...]) -> Array:
    """Fields of a row of `path`, all of them finite."""
    try:
        values = np.array([float(row[name]) for name in names])
    except ValueError as error:
        raise InputError(f"{path}: frame {row['frame']}: {error}") from None
    if not np.isfinite(values).all():
        raise InputError(f"{path}: frame {row['frame']}: a number is not finite")
    return values


def _pose(path: Path, row: Row) -> Array:
    values = _numbers(path, row, _POSE)
    try:
        return pose_from_quat(values[:3], values[3:])
    except ValueError as error:
        raise InputError(f"{path}: frame {row['frame']}: {error}") from None


def _error(T_dock_cam: Array, T_dock_cam_true: Array) -> tuple[float, float, float]:
    """Lateral m, axial m and total rotation rad."""
    x, y, z = T_dock_cam[:3, 3] - T_dock_cam_true[:3, 3]
    angle = np.linalg.norm(so3_log(T_dock_cam[:3, :3] @ T_dock_cam_true[:3, :3].T))
    return float(np.hypot(x, y)), float(abs(z)), float(angle)


def _error_summary(errors: Array) -> dict[str, Any]:
    """Median and 95th percentile of each error."""
    if not len(errors):
        return {}
    scaled = errors * [1.0, 1.0, 180.0 / np.pi]
    names = ("lateral_m", "axial_m", "angle_deg")
    return {
        name: {"median": float(np.median(column)), "p95": float(np.percentile(column, 95))}
        for name, column in zip(names, scaled.T, strict=True)
    }


def _by_range(true: dict[str, Array], common: list[str], errors: Array) -> list[dict[str, Any]]:
    """Availability and errors over bins of true z."""
    z_all, z_found = (np.array([true[name][2, 3] for name in names]) for names in (true, common))
    table = []
    for low, high in pairwise(_RANGE_BINS_M):
        top = high + (high == _RANGE_BINS_M[-1]) * 1e-9  # the last range holds its upper end as well
        frames = int(((z_all >= low) & (z_all < top)).sum())
        inside = (z_found >= low) & (z_found < top)
        if frames:
            table.append(
                {"z_m": [low, high], "frames": frames, "valid": int(inside.sum())} | _error_summary(errors[inside])
            )
    return table


def _longest_gap_s(path: Path, fixes: list[Row]) -> float | None:
    """Longest time between two valid fixes in a row, from the first to the last one."""
    try:
        stamps = [int(row["t_ns"]) for row in fixes if row["valid"] == "1"]
    except ValueError as error:
        raise InputError(f"{path}: t_ns: {error}") from None
    return max((b - a for a, b in pairwise(stamps)), default=0) * 1e-9 if len(stamps) > 1 else None


def _layers(run_folder: Path, true: dict[str, Array]) -> dict[str, Any]:
    """First and last true z of each layer's fixes, and the offset between the layers where both gave one."""
    poses: dict[str, dict[str, Array]] = {}
    path, station_file = run_folder / "layers.csv", run_folder / "station.yaml"
    for row in _rows(path, ("frame", "layer", *_POSE)):
        if row["frame"] in true:
            poses.setdefault(row["layer"], {})[row["frame"]] = _pose(path, row)
    result: dict[str, Any] = {}
    for layer, by_frame in poses.items():
        z = [float(true[name][2, 3]) for name in by_frame]
        result[layer] = {"fixes": len(z), "first_z_m": z[0], "last_z_m": z[-1]}
    station = load_station(station_file) if station_file.exists() else None
    if station is not None and len(poses) == 2 and set(poses) == set(station.layers):
        result["offset_m"] = layer_offset_m(station, poses)
    return result


def layer_offset_m(station: Station, poses: dict[str, dict[str, Array]]) -> float | None:
    """Largest distance in `cam` x, y between the two places that the layers' poses give the dock's axis.

    Each pose places the axis at its own layer's depth; None without a frame that has both. Source: paper section 4.2.
    """
    front, rear = station.layers_front_to_rear()
    centers = {name: np.array([0.0, 0.0, station.p_dock[station.lights_of(name), 2].mean()]) for name in (front, rear)}
    offsets = []
    for name in poses[front].keys() & poses[rear].keys():
        T_cam_dock_front, T_cam_dock_rear = se3_inverse(poses[front][name]), se3_inverse(poses[rear][name])
        p_cam_front = T_cam_dock_front[:3, :3] @ centers[front] + T_cam_dock_front[:3, 3]
        p_cam_rear = T_cam_dock_rear[:3, :3] @ centers[rear] + T_cam_dock_rear[:3, 3]
        offsets.append(float(np.linalg.norm((p_cam_front - p_cam_rear)[:2])))
    return max(offsets, default=None)


def _labels(run_folder: Path, truth_folder: Path, true: dict[str, Array]) -> dict[str, int]:
    """Named detections of the frames that the truth knows, and those whose light did not make them."""
    truth_path, path, pixel = truth_folder / "lights_truth.csv", run_folder / "lights.csv", ("u_px", "v_px")
    lights = {
        (row["frame"], row["light"]): _numbers(truth_path, row, pixel)
        for row in _rows(truth_path, ("frame", "light", *pixel, "visible"))
        if row["visible"] == "1"
    }
    named = [row for row in _rows(path, ("frame", "light", *pixel)) if row["light"] and row["frame"] in true]
    wrong = 0
    for row in named:
        at, seen = lights.get((row["frame"], row["light"])), _numbers(path, row, pixel)
        wrong += at is None or bool(np.hypot(*(at - seen)) > _SAME_SPOT_PX)
    return {"named": len(named), "wrong": wrong}
