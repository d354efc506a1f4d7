"""A run against the truth: errors, availability, gaps, identities of lights, and whether its stated errors hold."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS, AlertLimits
from lumidock.camera import load_camera
from lumidock.datatypes import Array
from lumidock.errors import InputError
from lumidock.evaluation import claims
from lumidock.evaluation.claims import GuideClaims, PoseClaims
from lumidock.evaluation.run_description import description_if_any, finished, mean_nis, source_kind, with_passes
from lumidock.geometry import pose_from_quat, se3_inverse, transform_points
from lumidock.station import Station, load_station
from lumidock.streams.run_folder import COVARIANCE_COLUMNS, GUIDE_COLUMNS, PROTECTION_COLUMNS

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_COLUMNS = ("frame", "t_ns", "valid", "reason", *_POSE)
_SAME_DETECTION_PX = 3.0  # a detection this close to a light's true centre was made by it
_STAMPED = ("sequence", "detections", "bag")  # sources whose times are not made up or measured anew
_STAMP = re.compile(r"-?[0-9]{1,18}")
_RANGE_BINS_M = (-3.0, 0.0, 3.0, 8.0, 12.0, 18.0, 24.0, 30.0)

Row = dict[str, str]


def true_poses(truth: Path) -> dict[str, Array]:
    """True poses `T_dock_cam` (4, 4) by frame name, from a simulated sequence folder or a truth.csv.

    Raises: InputError, one line.
    """
    path = truth / "truth.csv" if truth.is_dir() else truth
    return {row["frame"]: _pose(path, row) for row in read_rows(path, ("frame", *_POSE))}


def evaluate(run_folder: Path, truth: Path) -> dict[str, Any]:
    """Compare a run folder with a simulated sequence folder, or with a truth.csv alone.

    Errors are in dock axes: lateral hypot(x, y), axial |z|, angle the total rotation. Alert limits are those of the run
    folder's station file. Raises: InputError, one line.
    """
    folder = truth if truth.is_dir() else truth.parent
    true, path = true_poses(truth), run_folder / "fixes.csv"
    fixes = read_rows(path, _COLUMNS)
    true = with_passes(true, (row["frame"] for row in fixes))
    description = description_if_any(run_folder)
    _require_same_frames(truth, fixes, true, stamped=source_kind(description) in _STAMPED)
    poses = {row["frame"]: _pose(path, row) for row in fixes if row["valid"] == "1"}
    result = _counted(path, fixes, description)
    known = [row for row in fixes if row["frame"] in true]
    result |= _errors_and_claims(path, known, true, _alert_limits(run_folder))
    if (run_folder / "layers.csv").exists():
        result["layers"] = _layers(run_folder, true)
    if (folder / "lights_truth.csv").exists():
        result["identities"] = _identities(run_folder, folder, true)
    if all((run_folder / name).exists() for name in ("lights.csv", "station.yaml", "camera.yaml")):
        result["residual_rms_px"] = _residual_rms_px(run_folder, poses)
    return result


def count_run(run_folder: Path) -> dict[str, Any]:
    """What can be said of a run folder without truth: the part of `evaluate` that needs none. Raises: InputError."""
    path = run_folder / "fixes.csv"
    return _counted(path, read_rows(path, _COLUMNS), description_if_any(run_folder))


def _counted(path: Path, fixes: list[Row], description: Mapping[str, Any]) -> dict[str, Any]:
    gaps = {word: claims.continuity(_stamps(path, fixes, word)) for word in ("valid", "guide")}
    result: dict[str, Any] = {
        "frames": len(fixes),
        "valid": _count(fixes, "valid"),
        "guide": _count(fixes, "guide"),
        "guide_only": sum(row["valid"] != "1" and row.get("guide") == "1" for row in fixes),
        "reasons": dict(Counter(row["reason"] for row in fixes if row["reason"])),
        "longest_gap_s": gaps["valid"]["longest_gap_s"],
        "continuity": gaps,
    }
    result["availability"] = _shares(result)
    result["nis"] = mean_nis(description)
    result["over_limit"] = description.get("counts", {}).get("over_limit")
    result["finished"] = finished(description)
    return result


def _require_same_frames(truth: Path, fixes: list[Row], true: dict[str, Array], *, stamped: bool) -> None:
    """Raises: InputError for a truth of other frames, recognised by their names or, in a `stamped` run, their times.

    Names alone do not decide: every simulated sequence has a frame 000000. Stamps may be broken, or off by a constant.
    """
    known = [row for row in fixes if row["frame"] in true]
    if fixes and not known:
        raise InputError(f"{truth}: knows none of the run's frames")
    path = truth / "truth.csv" if truth.is_dir() else truth
    true_stamp = {row["frame"]: row.get("t_ns", "") for row in read_rows(path, ("frame",))}
    true_stamp = with_passes(true_stamp, (row["frame"] for row in known))
    pairs = [(row["t_ns"], true_stamp[row["frame"]]) for row in known]
    t_ns = np.array([pair for pair in pairs if all(map(_STAMP.fullmatch, pair))], np.int64).reshape(-1, 2)
    steps = np.diff(t_ns, axis=0)
    usual = np.median(np.abs(steps[:, 1])) if len(steps) else 0.0
    if stamped and usual > 0.0 and (np.abs(steps[:, 0] - steps[:, 1]) > 0.25 * usual).mean() > 0.5:
        raise InputError(f"{truth}: its frames were not taken at the times of the run's: another sequence")


def _alert_limits(run_folder: Path) -> AlertLimits:
    """Those of the dock that the run was made for; the defaults where another program left no station file."""
    station_file = run_folder / "station.yaml"
    return load_station(station_file).alert_limits if station_file.exists() else DEFAULT_ALERT_LIMITS


def _errors_and_claims(path: Path, fixes: list[Row], true: dict[str, Array], limits: AlertLimits) -> dict[str, Any]:
    """Errors of the fixes whose true pose is known, and whether the uncertainty that they state holds."""
    valid, guided = ([row for row in fixes if row.get(word) == "1"] for word in ("valid", "guide"))
    poses, guides = _pose_claims(path, valid, true, limits), _guide_claims(path, guided, true, limits)
    result: dict[str, Any] = {
        "error": _error_summary(poses.sizes()),
        "by_true_z": _by_range(true, valid, guided, poses.sizes()),
        "hazardous": {"frames": len(fixes), "valid": claims.hazardous(poses), "guide": claims.hazardous(guides)},
        "over_level": claims.over_level(poses) | claims.over_level(guides),
        "nees": claims.consistency(poses),
    }
    if np.isfinite(poses.levels).any():  # a method without protection levels has no such diagram
        result["stanford"] = claims.stanford_of(poses, len(fixes))
    return result


def _pose_claims(path: Path, rows: list[Row], true: dict[str, Array], limits: AlertLimits) -> PoseClaims:
    """The valid rows of fixes.csv against the truth."""
    T = [_pose(path, row) for row in rows]
    errors = [claims.pose_error(T_est, true[row["frame"]]) for T_est, row in zip(T, rows, strict=True)]
    triangles = np.array([_numbers_if_any(path, row, COVARIANCE_COLUMNS) for row in rows]).reshape(-1, 21)
    return PoseClaims(
        np.array([T_est[2, 3] for T_est in T]),
        np.array(errors).reshape(-1, 6),
        np.array([_numbers_if_any(path, row, PROTECTION_COLUMNS) for row in rows]).reshape(-1, 3),
        _symmetric(triangles),
        [row.get("stage", "") for row in rows],
        limits,
    )


def _guide_claims(path: Path, rows: list[Row], true: dict[str, Array], limits: AlertLimits) -> GuideClaims:
    """The rows of fixes.csv with a guide against the truth."""
    return GuideClaims(
        np.array([_numbers(path, row, GUIDE_COLUMNS[:3]) for row in rows]).reshape(-1, 3),
        np.array([claims.true_guide(true[row["frame"]]) for row in rows]).reshape(-1, 3),
        np.array([_numbers_if_any(path, row, GUIDE_COLUMNS[3:]) for row in rows]).reshape(-1, 2),
        limits,
    )


def _symmetric(triangles: Array) -> Array:
    """Matrices (N, 6, 6) of their upper triangles (N, 21), row by row."""
    upper = np.zeros((len(triangles), 6, 6))
    rows, columns = np.triu_indices(6)
    upper[:, rows, columns] = triangles
    return np.where(np.tri(6, k=-1, dtype=bool), upper.transpose(0, 2, 1), upper)


def _count(fixes: list[Row], word: str) -> int:
    return sum(row.get(word) == "1" for row in fixes)


def _shares(counts: dict[str, Any]) -> dict[str, float | None]:
    """Availability: the shares of `counts["frames"]` that are valid and that have a guide."""
    return {word: counts[word] / counts["frames"] if counts["frames"] else None for word in ("valid", "guide")}


def read_rows(path: Path, columns: tuple[str, ...]) -> list[Row]:
    """Rows of a CSV file that has these columns. Raises: InputError, one line."""
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
        values = np.array([float(row.get(name, "")) for name in names])
    except ValueError as error:
        raise InputError(f"{path}: frame {row['frame']}: {error}") from None
    if not np.isfinite(values).all():
        raise InputError(f"{path}: frame {row['frame']}: a number is not finite")
    return values


def _numbers_if_any(path: Path, row: Row, names: tuple[str, ...]) -> Array:
    """The same, but NaN where all of the fields are empty because the method does not give them."""
    return _numbers(path, row, names) if any(row.get(name) for name in names) else np.full(len(names), np.nan)


def _pose(path: Path, row: Row) -> Array:
    values = _numbers(path, row, _POSE)
    try:
        return pose_from_quat(values[:3], values[3:])
    except ValueError as error:
        raise InputError(f"{path}: frame {row['frame']}: {error}") from None


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


def _by_range(true: dict[str, Array], valid: list[Row], guided: list[Row], errors: Array) -> list[dict[str, Any]]:
    """Availability and errors over bins of true z; `errors` (N, 3) are those of the rows `valid`."""
    frames = (true, *([row["frame"] for row in rows] for rows in (valid, guided)))
    z_all, z_valid, z_guided = (np.array([true[name][2, 3] for name in names]) for names in frames)
    table = []
    for low, high in pairwise(_RANGE_BINS_M):
        top = high + (high == _RANGE_BINS_M[-1]) * 1e-9  # the last range holds its upper end as well
        inside_all, inside, inside_guided = ((z >= low) & (z < top) for z in (z_all, z_valid, z_guided))
        counts = {"frames": inside_all.sum(), "valid": inside.sum(), "guide": inside_guided.sum()}
        row: dict[str, Any] = {"z_m": [low, high]} | {name: int(count) for name, count in counts.items()}
        if row["frames"]:
            table.append(row | {"availability": _shares(row)} | _error_summary(errors[inside]))
    return table


def _stamps(path: Path, fixes: list[Row], word: str) -> list[int]:
    """Stamps of the rows whose field `word` is 1."""
    try:
        return [int(row["t_ns"]) for row in fixes if row.get(word) == "1"]
    except ValueError as error:
        raise InputError(f"{path}: t_ns: {error}") from None


def _layers(run_folder: Path, true: dict[str, Array]) -> dict[str, Any]:
    """First and last true z of each layer's fixes, and the offset between the layers where both gave one."""
    poses: dict[str, dict[str, Array]] = {}
    path, station_file = run_folder / "layers.csv", run_folder / "station.yaml"
    for row in read_rows(path, ("frame", "layer", *_POSE)):
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


@dataclass(frozen=True, slots=True, eq=False)
class _TrueLights:
    """Of one frame: true centres `uv` (K, 2) px by light id, and which of the lights are visible."""

    uv: dict[str, Array]
    visible: set[str]

    def nearest(self, uv: Array, own: str) -> tuple[str, float]:
        """The light whose centre is nearest to `uv` (2,) px, and how far that is, among `own` and the visible ones.

        `own` counts although it may not be visible: a lamp that saturates its surroundings has an SNR of 0.
        """
        away = {
            name: float(np.hypot(*(at - uv))) for name, at in self.uv.items() if name == own or name in self.visible
        }
        name = min(away, key=lambda name: away[name], default="")
        return name, away.get(name, np.inf)


def _true_lights(path: Path) -> dict[str, _TrueLights]:
    """The lights of each frame, by its name, from lights_truth.csv."""
    pixel, frames = ("u_px", "v_px"), dict[str, _TrueLights]()
    for row in read_rows(path, ("frame", "light", *pixel, "visible")):
        lights = frames.setdefault(row["frame"], _TrueLights({}, set()))
        lights.uv[row["light"]] = _numbers(path, row, pixel)
        if row["visible"] == "1":
            lights.visible.add(row["light"])
    return frames


def _identities(run_folder: Path, truth_folder: Path, true: dict[str, Array]) -> dict[str, int]:
    """Detections that were identified as a light, in the frames that the truth knows.

    `wrong`: another lit lamp is nearer to the detection than its own. `displaced`: its own is the nearest, but more
    than 3 px away, as where a reflection or a lit edge beside the lamp was detected.
    """
    lights, path, pixel = _true_lights(truth_folder / "lights_truth.csv"), run_folder / "lights.csv", ("u_px", "v_px")
    lights = with_passes(lights, true)
    counts = {"identified": 0, "wrong": 0, "displaced": 0}
    for row in read_rows(path, ("frame", "light", *pixel)):
        if not row["light"] or row["frame"] not in true:
            continue
        seen = lights.get(row["frame"], _TrueLights({}, set()))
        nearest, away_px = seen.nearest(_numbers(path, row, pixel), row["light"])
        counts["identified"] += 1
        counts["wrong"] += nearest != row["light"]
        counts["displaced"] += nearest == row["light"] and away_px > _SAME_DETECTION_PX
    return counts


def _residual_rms_px(run_folder: Path, poses: dict[str, Array]) -> float | None:
    """Rms distance of identified detections to the pixels where the estimated poses put their lights, per coordinate.

    `poses` are by frame name. None without an identified detection in a valid frame.
    """
    station, camera = load_station(run_folder / "station.yaml"), load_camera(run_folder / "camera.yaml")
    path, pixel = run_folder / "lights.csv", ("u_px", "v_px")
    index = {light: i for i, light in enumerate(station.ids)}
    identified: dict[str, list[Row]] = {}
    for row in read_rows(path, ("frame", "light", *pixel)):
        if row["light"] in index and row["frame"] in poses:
            identified.setdefault(row["frame"], []).append(row)
    squares = [np.empty(0)]
    for frame, rows in identified.items():
        p_cam = transform_points(se3_inverse(poses[frame]), station.p_dock[[index[row["light"]] for row in rows]])
        uv = np.array([_numbers(path, row, pixel) for row in rows])
        squares.append(((camera.project(p_cam) - uv) ** 2).ravel())
    seen = np.concatenate(squares)
    seen = seen[np.isfinite(seen)]
    return float(np.sqrt(seen.mean())) if len(seen) else None
