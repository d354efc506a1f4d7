"""What a dock's lights are good for, before it is built: what is seen where, what is confused, how good a pose is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Indices
from lumidock.evaluation.confusion import worst_confusion
from lumidock.evaluation.cramer_rao import Bound
from lumidock.integrity import alert_limit
from lumidock.pose import project_lights
from lumidock.station import Station

CONFUSION_AT_M = 18.0  # where confusions are told in pixels
_START_Z_M, _SPEED_M_S, _RATE_HZ = 30.0, 1.0, 10.0
_ROWS_Z_M = (30, 24, 20, 18, 15, 12, 10, 8, 6, 5, 4, 3, 2, 1.5, 1, 0.5, 0, -0.5, -1, -2, -3)
_MAX_NAMINGS = 2_000_000  # that are tried for one row of confusions
_LEAST_NAMED = 4


@dataclass(frozen=True, slots=True)
class Limits:
    """What a dock is held to: least worst confusion of four lights in pixels at 18 m, and lights in view down to z."""

    confusion_px: float
    lights: int
    from_z_m: float


def inspect_station(station: Station, camera: Camera, config: Config, limits: Limits) -> dict[str, Any]:
    """Visibility, confusions and expected accuracy of a dock, and which of the `limits` it does not meet."""
    corridor = _corridor(station, camera, config)
    confusions = [row for layer in station.layers_front_to_rear() for row in _confusions(station, camera, layer)]
    return {
        "name": station.name,
        "layers": {layer: len(station.lights_of(layer)) for layer in station.layers_front_to_rear()},
        "corridor": corridor,
        "confusions": confusions,
        "failed": [*_weak_layouts(confusions, limits), *_dark_stretches(corridor, limits)],
    }


def visible_lights(station: Station, camera: Camera, T_dock_cam: Array) -> Indices:
    """Indices of the lights inside the picture and within their beams, as seen from a pose; water is not considered."""
    uv = project_lights(camera, T_dock_cam, station.p_dock)
    to_camera = T_dock_cam[:3, 3] - station.p_dock
    distance = np.maximum(np.linalg.norm(to_camera, axis=1), 1e-9)
    off_axis = np.arccos(np.clip((to_camera * station.axis).sum(axis=1) / distance, -1.0, 1.0))
    return np.flatnonzero(camera.contains(uv) & (np.rad2deg(off_axis) <= station.beam_deg / 2.0)).astype(np.int64)


def _corridor(station: Station, camera: Camera, config: Config) -> list[dict[str, Any]]:
    """Rows along a head-on approach down the axis; the bound follows every frame of it."""
    end = min(float(station.docking_point[2]), 0.0)
    wanted = sorted((z for z in _ROWS_Z_M if z >= end), reverse=True)
    bound, rows = Bound(station, camera, config), []
    steps = round((_START_Z_M - end) / _SPEED_M_S * _RATE_HZ)
    for k in range(steps + 1):
        z = _START_Z_M - k * _SPEED_M_S / _RATE_HZ
        T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
        T_dock_cam[:3, 3] = 0.0, 0.0, z
        seen = visible_lights(station, camera, T_dock_cam)
        level = bound.step(round(k * 1e9 / _RATE_HZ), T_dock_cam, seen)
        while wanted and z <= wanted[0] + 1e-9:
            rows.append(_row(station, wanted.pop(0), seen, level))
    return rows


def _row(station: Station, z_m: float, seen: Indices, level: Array | None) -> dict[str, Any]:
    counts = {layer: int(np.isin(station.lights_of(layer), seen).sum()) for layer in station.layers_front_to_rear()}
    row: dict[str, Any] = {"z_m": z_m, "lights": counts, "stage": _stage(counts)}
    if level is None or not np.isfinite(level).all():
        return row | {"lateral_m": None, "axial_m": None, "angle_deg": None, "valid": False}
    lateral, axial, angle = (float(value) for value in level)
    limit_m, limit_rad = alert_limit(z_m, axial)
    return row | {
        "lateral_m": lateral,
        "axial_m": axial,
        "angle_deg": math.degrees(angle),
        "valid": max(lateral, axial) < limit_m and angle < limit_rad,
    }


def _stage(counts: dict[str, int]) -> str:
    """The docking stage by which layers are in view; the last layer is the rear one."""
    seen = [count >= 3 for count in counts.values()]
    if not any(seen):
        return "search"
    if all(seen) and len(seen) > 1:
        return "transition"
    return "rear" if seen[-1] else "front"


def _confusions(station: Station, camera: Camera, layer: str) -> list[dict[str, Any]]:
    """The wrong naming that fits best, for each number of lights seen, plain and mirrored; None where it is costly."""
    p_dock = station.p_dock[station.lights_of(layer)]
    n, rows = len(p_dock), []
    for seen in range(min(_LEAST_NAMED, n), n + 1):
        row: dict[str, Any] = {"layer": layer, "seen": seen}
        for kind, mirrored in (("naming", False), ("mirror", True)):
            costly = math.comb(n, seen) * math.perm(n, seen) > _MAX_NAMINGS
            worst_m = None if costly else worst_confusion(p_dock, seen=seen, mirrored=mirrored)
            worst_px = None if worst_m is None else worst_m * float(camera.focal_px.mean()) / CONFUSION_AT_M
            row |= {f"{kind}_m": worst_m, f"{kind}_px": worst_px}
        rows.append(row)
    return rows


def _weak_layouts(confusions: list[dict[str, Any]], limits: Limits) -> list[str]:
    found = []
    for row in confusions:
        if row["seen"] == _LEAST_NAMED:
            for kind in ("naming", "mirror"):
                px = row[f"{kind}_px"]
                if px is not None and px < limits.confusion_px:
                    what = "a wrong naming of" if kind == "naming" else "the mirror image of"
                    text = f"{what} {row['seen']} lights fits within {px:.2f} px at {CONFUSION_AT_M:g} m"
                    found.append(f"layer {row['layer']}: {text}, wanted {limits.confusion_px:g}")
    return found


def _dark_stretches(corridor: list[dict[str, Any]], limits: Limits) -> list[str]:
    short = [
        row["z_m"] for row in corridor if row["z_m"] <= limits.from_z_m and max(row["lights"].values()) < limits.lights
    ]
    if not short:
        return []
    return [f"fewer than {limits.lights} lights of any layer in view at z {', '.join(f'{z:g}' for z in short)} m"]
