"""One fix as the page shows it: plain numbers, words and sentences, ready for JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from lumidock.app.console.limits import limits_view
from lumidock.app.reasons import explain
from lumidock.camera import Camera
from lumidock.datatypes import Array, Fix, Match
from lumidock.geometry import quat_xyzw_from_rotation
from lumidock.pose import project_lights
from lumidock.station import Station

_SHOWN = (  # fields of a fix that have a place of their own on the page
    *("frame", "t_ns", "status", "stage", "n_seen", "n_used", "T_dock_cam", "reason", "match", "by_layer"),
    *("covariance", "protection", "guide", "nis", "alternatives"),
)
_UNLIKELY = 0.1  # p_light below which a detection is called no lamp
_FAR_PX = 1e5  # a light projected further outside is not drawn


@dataclass(frozen=True, slots=True)
class Scene:
    """The dock and the camera that fixes are shown with."""

    station: Station
    camera: Camera


def scene_view(scene: Scene) -> dict[str, Any]:
    """What does not change from frame to frame: lights, docking point, picture size and alert limits."""
    station, camera = scene.station, scene.camera
    return {
        "station": station.name,
        "width": camera.width,
        "height": camera.height,
        "docking_point": _numbers(station.docking_point),
        "limits": limits_view(station.alert_limits),
        "layers": list(station.layers_front_to_rear()),
        "lights": [
            {"id": station.ids[i], "layer": station.layers[station.layer[i]], "p_dock": _numbers(station.p_dock[i])}
            for i in range(len(station))
        ],
    }


def frame_view(fix: Fix, scene: Scene, latency_us: int | None) -> dict[str, Any]:
    """A fix as JSON: trust and its reason, pose, levels with their limits, detections, predicted lights."""
    why = explain(fix)
    predicted = _predicted(fix, scene)
    return {
        "frame": fix.frame,
        "t_ns": str(fix.t_ns),  # JavaScript has no integers of 64 bits
        "trust": trust(fix),
        "status": fix.status,
        "stage": fix.stage,
        "reason": fix.reason,
        "sentence": why.meaning,
        "remedy": why.remedy,
        "n_seen": fix.n_seen,
        "n_used": fix.n_used,
        "latency_ms": None if latency_us is None else latency_us / 1000.0,
        "nis": _number(fix.nis),
        "pose": _pose(fix.T_dock_cam),
        "levels": _levels(fix, scene),
        "guide": _guide(fix),
        "detections": _detections(fix, scene, predicted),
        "predicted": _marks(predicted, scene),
        "alternatives": [
            {"probability": round(one.probability, 4), **(_pose(one.T_dock_cam) or {})} for one in fix.alternatives
        ],
        "more": _more(fix),
    }


def trust(fix: Fix) -> str:
    """How far a fix may be trusted: valid, guide or none."""
    return "valid" if fix.valid else "guide" if fix.guide is not None else "none"


def _pose(T_dock_cam: Array | None) -> dict[str, Any] | None:
    """Position m in `dock` and the viewing direction, a unit vector in `dock`."""
    if T_dock_cam is None:
        return None
    return {
        "position": _numbers(T_dock_cam[:3, 3]),
        "ahead": _numbers(T_dock_cam[:3, 2]),
        "quat_xyzw": _numbers(quat_xyzw_from_rotation(T_dock_cam[:3, :3])),
    }


def _levels(fix: Fix, scene: Scene) -> list[dict[str, Any]]:
    """Protection levels with their alert limits, of the pose and of the guide; none where the method gives none."""
    limits, rows = scene.station.alert_limits, []
    if fix.protection is not None and fix.T_dock_cam is not None:
        pl = fix.protection
        lateral_m, axial_m, angle_rad = limits.of_pose(float(fix.T_dock_cam[2, 3]), pl.axial_m)
        rows += [
            _level("lateral", pl.lateral_m, lateral_m, "m"),
            _level("axial", pl.axial_m, axial_m, "m"),
            _level("angle", math.degrees(pl.angle_rad), math.degrees(angle_rad), "deg"),
        ]
    if fix.guide is not None:
        guide = fix.guide
        near_end_m = guide.range_m - guide.pl_range_m
        if limits.applies_to_guide(guide.bearing_x_rad, near_end_m):
            bearing_rad, range_m = limits.of_guide(near_end_m)
            rows += [
                _level("bearing", math.degrees(guide.pl_bearing_rad), math.degrees(bearing_rad), "deg"),
                _level("range", guide.pl_range_m, range_m, "m"),
            ]
    return rows


def _level(name: str, level: float, limit: float, unit: str) -> dict[str, Any]:
    return {"name": name, "level": _number(level), "limit": _number(limit), "unit": unit}


def _guide(fix: Fix) -> dict[str, Any] | None:
    if fix.guide is None:
        return None
    guide = fix.guide
    return {
        "bearing_x_deg": _number(math.degrees(guide.bearing_x_rad)),
        "bearing_y_deg": _number(math.degrees(guide.bearing_y_rad)),
        "range_m": _number(guide.range_m),
        "pl_bearing_deg": _number(math.degrees(guide.pl_bearing_rad)),
        "pl_range_m": _number(guide.pl_range_m),
    }


def _predicted(fix: Fix, scene: Scene) -> Array | None:
    """Where the valid pose, or else the likeliest alternative, puts the lights (M, 2) px; None without either."""
    T_dock_cam = fix.T_dock_cam
    if T_dock_cam is None and fix.alternatives:
        T_dock_cam = fix.alternatives[0].T_dock_cam
    return None if T_dock_cam is None else project_lights(scene.camera, T_dock_cam, scene.station.p_dock)


def _marks(predicted: Array | None, scene: Scene) -> list[dict[str, Any]]:
    if predicted is None:
        return []
    near = np.isfinite(predicted).all(axis=1) & (np.abs(np.nan_to_num(predicted)) < _FAR_PX).all(axis=1)
    return [{"light": scene.station.ids[i], "uv": _numbers(predicted[i], 2)} for i in np.flatnonzero(near)]


def _detections(fix: Fix, scene: Scene, predicted: Array | None) -> list[dict[str, Any]]:
    if fix.match is None:
        return []
    d, ids = fix.match.detections, scene.station.ids
    return [
        {
            "uv": _numbers(d.uv[k], 2),
            "radius_px": _number(d.radius_px[k]),
            "p_light": _number(d.p_light[k]),
            "p_rear": _number(d.p_rear[k]),
            "light": ids[light] if light >= 0 else None,
            "why": "" if light >= 0 else _why_rejected(k, fix, scene, predicted),
        }
        for k, light in enumerate(fix.match.light.tolist())
    ]


def _why_rejected(k: int, fix: Fix, scene: Scene, predicted: Array | None) -> str:
    """What is known of a detection that no light was assigned to, in a sentence."""
    assert fix.match is not None
    p_light = float(fix.match.detections.p_light[k])
    if p_light < _UNLIKELY:
        return f"No lamp by its shape: the probability that it is one is {100 * p_light:.1f} %."
    if predicted is None or not np.isfinite(predicted).any():
        return f"Nothing is associated in this frame ({fix.reason or 'no prediction'})."
    return _nearest(fix.match, k, scene, predicted)


def _nearest(match: Match, k: int, scene: Scene, predicted: Array) -> str:
    away_px = np.linalg.norm(np.nan_to_num(predicted, nan=np.inf) - match.detections.uv[k], axis=1)
    nearest = int(np.argmin(away_px))
    taken = nearest in match.light.tolist()
    state = "another detection fits it better" if taken else "too far to be it"
    return f"Where no light is predicted: {away_px[nearest]:.1f} px from {scene.station.ids[nearest]}, {state}."


def _more(fix: Fix) -> dict[str, Any]:
    """Whatever else a fix carries, by the names of its fields, in words and numbers."""
    found = {one.name: _plain(getattr(fix, one.name)) for one in fields(fix) if one.name not in _SHOWN}
    return {name: value for name, value in found.items() if value not in (None, "", {}, [])}


def _plain(value: Any) -> Any:  # noqa: ANN401  # fields of any type
    if is_dataclass(value) and not isinstance(value, type):
        found = {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
        return {name: inner for name, inner in found.items() if inner not in (None, "")}
    if isinstance(value, float | np.floating):
        return _number(value)
    if isinstance(value, np.ndarray):
        return _numbers(value) if value.ndim == 1 else None
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    return value if isinstance(value, str | int | bool) or value is None else str(value)


def _number(value: float | np.floating[Any], digits: int = 5) -> float | None:
    """A rounded number, or None where it is not finite, which JSON cannot say."""
    return round(float(value), digits) if math.isfinite(value) else None


def _numbers(values: Array, digits: int = 5) -> list[float | None]:
    return [_number(value, digits) for value in np.asarray(values, float)]
