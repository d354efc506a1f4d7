"""A run folder as arrays for its report, with the truth and the images where they are at hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from lumidock.alert_limits import AlertLimits
from lumidock.camera import Camera, load_camera
from lumidock.datatypes import Array, Fix, Stage
from lumidock.errors import InputError
from lumidock.evaluation import run_folders
from lumidock.evaluation.claims import GuideClaims, error_sizes, pose_error, true_guide
from lumidock.evaluation.metrics import evaluate, read_rows, true_poses
from lumidock.evaluation.run_description import frame_in_source, read_description, with_passes
from lumidock.station import Station, load_station
from lumidock.streams.replay import read_fixes
from lumidock.streams.source import Source

KINDS = ("lateral", "axial", "angle")
STAGES: tuple[Stage, ...] = get_args(Stage)


@dataclass(frozen=True, slots=True, eq=False)
class RunView:
    """A run of N frames.

    `t_s` (N,) since the first stamp, NaN without one; `position` (N, 3) m, `levels` and `limits` (N, 3) lateral m,
    axial m and angle rad, NaN without a valid pose; `guide` (N, 3) bearings rad and range m, `guide_levels` and
    `guide_limits` (N, 2) bearing rad and range m, NaN without a guide. Against the truth, NaN where there is none:
    `true_position` (N, 3), `errors` (N, 3) and `guide_errors` (N, 2); `visible` (N, M) says which lights could be seen,
    None where that is not known. `latency_ms` (N,).
    """

    name: str
    folder: Path
    station: Station
    camera: Camera
    described: dict[str, Any]
    fixes: list[Fix]
    t_s: Array
    latency_ms: Array
    position: Array
    levels: Array
    limits: Array
    guide: Array
    guide_levels: Array
    guide_limits: Array
    true_position: Array
    errors: Array
    guide_errors: Array
    visible: np.ndarray | None
    source: Source | None
    evaluation: dict[str, Any] | None

    @property
    def has_truth(self) -> bool:
        """Whether any frame's true pose is known."""
        return bool(np.isfinite(self.true_position).any())

    @property
    def valid(self) -> np.ndarray:
        """Which frames (N,) have a valid fix."""
        return np.array([fix.valid for fix in self.fixes], bool)

    @property
    def guided(self) -> np.ndarray:
        """Which frames (N,) have a guide."""
        return np.array([fix.guide is not None for fix in self.fixes], bool)


def load_run(folder: Path, source: Path | None = None) -> RunView:
    """Read a run folder; images and truth from `source`, or from the recorded sequence in the run folder or beside it.

    Raises: InputError, one line, for a folder that is no run, or a source that it was not made from.
    """
    description = read_description(folder)
    station, camera = load_station(folder / "station.yaml"), load_camera(folder / "camera.yaml")
    rows = list(read_fixes(folder, station.ids))
    if not rows:
        raise InputError(f"{folder}: a run without frames")
    fixes = [fix for fix, _, _ in rows]
    opened = run_folders.source_of(folder, description, source)
    truth = with_passes(_truth_of(opened), (fix.frame for fix in fixes))
    start = next((t for _, t, _ in rows if t is not None), 0)
    guide, guide_levels, guide_limits, guide_errors = _guide_columns(fixes, truth, station.alert_limits)
    position, levels, limits = _pose_columns(fixes, station.alert_limits)
    return RunView(
        name="/".join(folder.resolve().parts[-2:]),
        folder=folder,
        station=station,
        camera=camera,
        described=description,
        fixes=fixes,
        t_s=np.array([np.nan if t is None else (t - start) * 1e-9 for _, t, _ in rows]),
        latency_ms=np.array([np.nan if us is None else us * 1e-3 for _, _, us in rows]),
        position=position,
        levels=levels,
        limits=limits,
        guide=guide,
        guide_levels=guide_levels,
        guide_limits=guide_limits,
        true_position=_true_positions(fixes, truth),
        errors=_pose_errors(fixes, truth),
        guide_errors=guide_errors,
        visible=_visible(fixes, station, opened),
        source=opened,
        evaluation=evaluate(folder, opened.path) if truth and opened is not None else None,
    )


def _truth_of(source: Source | None) -> dict[str, Array]:
    """True poses by frame name; none without a truth.csv."""
    if source is None or not (source.path / "truth.csv").is_file():
        return {}
    return true_poses(source.path)


def _pose_columns(fixes: list[Fix], limits: AlertLimits) -> tuple[Array, Array, Array]:
    """Positions, protection levels and alert limits of the frames, each (N, 3)."""
    position, levels = np.full((len(fixes), 3), np.nan), np.full((len(fixes), 3), np.nan)
    for k, fix in enumerate(fixes):
        if fix.T_dock_cam is not None:
            position[k] = fix.T_dock_cam[:3, 3]
        if fix.protection is not None:
            levels[k] = fix.protection.lateral_m, fix.protection.axial_m, fix.protection.angle_rad
    at_fixes = limits.of_poses(position[:, 2], np.nan_to_num(levels[:, 1]))
    return position, levels, np.where(np.isfinite(position[:, 2:]), at_fixes, np.nan)


def _guide_columns(fixes: list[Fix], truth: dict[str, Array], limits: AlertLimits) -> tuple[Array, Array, Array, Array]:
    """Guides (N, 3), their levels and limits (N, 2), and their errors (N, 2)."""
    n = len(fixes)
    guide, levels, true = np.full((n, 3), np.nan), np.full((n, 2), np.nan), np.full((n, 3), np.nan)
    for k, fix in enumerate(fixes):
        if fix.guide is not None:
            guide[k] = fix.guide.bearing_x_rad, fix.guide.bearing_y_rad, fix.guide.range_m
            levels[k] = fix.guide.pl_bearing_rad, fix.guide.pl_range_m
        if fix.frame in truth:
            true[k] = true_guide(truth[fix.frame])
    claims = GuideClaims(guide, true, levels, limits)
    known = np.isfinite(guide[:, 2:])
    return guide, levels, np.where(known, claims.limits(), np.nan), np.where(known, claims.sizes(), np.nan)


def _true_positions(fixes: list[Fix], truth: dict[str, Array]) -> Array:
    unknown = np.full(3, np.nan)
    return np.array([truth[fix.frame][:3, 3] if fix.frame in truth else unknown for fix in fixes]).reshape(-1, 3)


def _pose_errors(fixes: list[Fix], truth: dict[str, Array]) -> Array:
    """Errors of the poses (N, 3): lateral m, axial m, angle rad."""
    n = len(fixes)
    errors = np.full((n, 6), np.nan)
    for k, fix in enumerate(fixes):
        if fix.T_dock_cam is not None and fix.frame in truth:
            errors[k] = pose_error(fix.T_dock_cam, truth[fix.frame])
    return error_sizes(errors)


def _visible(fixes: list[Fix], station: Station, source: Source | None) -> np.ndarray | None:
    """Which of the M lights could be seen in each frame (N, M), by the truth of a simulated source."""
    path = source.path / "lights_truth.csv" if source is not None else Path()
    if not path.is_file():
        return None
    light, seen = {name: i for i, name in enumerate(station.ids)}, dict[str, list[int]]()
    for row in read_rows(path, ("frame", "light", "visible")):
        lights = seen.setdefault(row["frame"], [])
        if row["visible"] == "1" and row["light"] in light:
            lights.append(light[row["light"]])
    visible = np.zeros((len(fixes), len(station.ids)), bool)
    for k, fix in enumerate(fixes):
        visible[k, seen.get(frame_in_source(fix.frame, seen), [])] = True
    return visible
