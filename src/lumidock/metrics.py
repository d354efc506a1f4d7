"""A run against the truth: errors, gaps, labels, and how the two layers agree."""

from __future__ import annotations

import csv
from collections import Counter
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
    return {row["frame"]: _pose(row) for row in _rows(path, ("frame", *_POSE))}


def evaluate(run_folder: Path, truth: Path) -> dict[str, Any]:
    """Compare a run folder with a simulated sequence folder, or with a truth.csv alone.

    Errors are in dock axes: lateral hypot(x, y), axial |z|, angle the total rotation. Raises: InputError, one line.
    """
    folder = truth if truth.is_dir() else truth.parent
    true = true_poses(truth)
    fixes = _rows(run_folder / "fixes.csv", ("frame", "t_ns", "valid", "reason", *_POSE))
    if fixes and not any(row["frame"] in true for row in fixes):
        raise InputError(f"{truth}: knows none of the run's frames")
    found = {row["frame"]: _pose(row) for row in fixes if row["valid"] == "1"}
    common = [name for name in found if name in true]
    errors = np.array([_error(found[name], true[name]) for name in common]).reshape(-1, 3)
    result: dict[str, Any] = {
        "frames": len(fixes),
        "valid": len(found),
        "reasons": dict(Counter(row["reason"] for row in fixes if row["reason"])),
        "error": _error_summary(errors),
        "by_true_z": _by_range(true, common, errors),
        "longest_gap_s": _longest_gap_s(fixes),
    }
    if (run_folder / "layers.csv").exists():
        result["layers"] = _layers(run_folder, true)
    if (folder / "lights_truth.csv").exists():
        result["labels"] = _labels(run_folder, folder)
    return result


def _rows(path: Path, columns: tuple[str, ...]) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, restval="")
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: no column {missing[0]}")
            return list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def _pose(row: Row) -> Array:
    try:
        values = np.array([float(row[name]) for name in _POSE])
        if not np.isfinite(values).all():
            raise ValueError("a number is not finite")
        return pose_from_quat(values[:3], values[3:])
    except ValueError as error:
        raise InputError(f"frame {row['frame']}: no pose: {error}") from None


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
    for low, high in zip(_RANGE_BINS_M[:-1], _RANGE_BINS_M[1:], strict=True):
        frames = int(((z_all >= low) & (z_all < high)).sum())
        inside = (z_found >= low) & (z_found < high)
        if frames:
            table.append(
                {"z_m": [low, high], "frames": frames, "valid": int(inside.sum())} | _error_summary(errors[inside])
            )
    return table


def _longest_gap_s(fixes: list[Row]) -> float | None:
    """Longest time between two valid fixes in a row, from the first to the last one."""
    stamps = np.array([int(row["t_ns"]) for row in fixes if row["valid"] == "1"])
    return float(np.diff(stamps).max() * 1e-9) if len(stamps) > 1 else None


def _layers(run_folder: Path, true: dict[str, Array]) -> dict[str, Any]:
    """First and last true z of each layer's fixes, and the offset between the layers where both gave one."""
    poses: dict[str, dict[str, Array]] = {}
    for row in _rows(run_folder / "layers.csv", ("frame", "layer", *_POSE)):
        if row["frame"] in true:
            poses.setdefault(row["layer"], {})[row["frame"]] = _pose(row)
    result: dict[str, Any] = {}
    for layer, by_frame in poses.items():
        z = [float(true[name][2, 3]) for name in by_frame]
        result[layer] = {"fixes": len(z), "first_z_m": z[0], "last_z_m": z[-1]}
    if len(poses) == 2 and (run_folder / "station.yaml").exists():
        result["offset_m"] = layer_offset_m(load_station(run_folder / "station.yaml"), poses)
    return result


def layer_offset_m(station: Station, poses: dict[str, dict[str, Array]]) -> float | None:
    """Largest distance in `cam` x, y between the dock's axis at the front layer's depth, placed by the front pose, and at
    the rear layer's depth, placed by the rear pose; None without a frame that has both. Source: paper section 4.2.
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


def _labels(run_folder: Path, truth_folder: Path) -> dict[str, int]:
    """Named detections, and those whose light did not make them."""
    columns = ("frame", "light", "u_px", "v_px")
    true = {
        (row["frame"], row["light"]): np.array([float(row["u_px"]), float(row["v_px"])])
        for row in _rows(truth_folder / "lights_truth.csv", (*columns, "visible"))
        if row["visible"] == "1"
    }
    named = [row for row in _rows(run_folder / "lights.csv", columns) if row["light"]]
    wrong = 0
    for row in named:
        at = true.get((row["frame"], row["light"]))
        distance = np.inf if at is None else np.hypot(*(at - [float(row["u_px"]), float(row["v_px"])]))
        wrong += bool(distance > _SAME_SPOT_PX)
    return {"named": len(named), "wrong": wrong}
