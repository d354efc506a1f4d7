"""What a dock's lights allow, before it is built: which are in view where, which are confused, how good a pose is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Indices
from lumidock.evaluation.confusion import CONFUSION_AT_M, Confusion, apparent, worst_confusion
from lumidock.evaluation.cramer_rao import Bound
from lumidock.evaluation.symmetry import SelfFit, self_fits, unsafe_roll_rad
from lumidock.pose import project_lights
from lumidock.station import Station

_START_Z_M, _SPEED_M_S, _RATE_HZ = 30.0, 1.0, 10.0
_ROWS_Z_M = (30, 24, 20, 18, 15, 12, 10, 8, 6, 5, 4, 3, 2, 1.5, 1, 0.5, 0, -0.5, -1, -2, -3)
_MAX_ASSIGNMENTS = 2_000_000  # that are tried for one row of confusions
_LEAST_IDENTIFIED = 4  # lights of a layer that identify each other in one frame
_NEARLY = 5.0  # times the misfit that is required, within which the array nearly fits itself
_MOST_FITS = 4  # of a kind that are listed
_DEG = 180.0 / math.pi
LEVELS = ("lateral_m", "axial_m", "angle_deg", "bearing_deg", "range_m")  # protection levels of a row of the corridor
_STAGE_LIGHTS = 3  # of a layer in view, from which a pose can rest on it


@dataclass(frozen=True, slots=True)
class Requirements:
    """What a dock has to meet: the misfit px of the worst confusion of four lights, and lights in view down to z."""

    confusion_px: float
    lights: int
    from_z_m: float


@dataclass(frozen=True, slots=True, eq=False)
class InView:
    """Of all N lights from one pose: which are `inside` the image, and which of those shine `toward` the camera."""

    inside: np.ndarray
    toward: np.ndarray

    @property
    def lights(self) -> Indices:
        """Indices of the lights that are seen."""
        return np.flatnonzero(self.inside & self.toward).astype(np.int64)


def inspect_station(station: Station, camera: Camera, config: Config, required: Requirements) -> dict[str, Any]:
    """Visibility, confusions and expected accuracy of a dock, and in `failed` the requirements it does not meet."""
    corridor = _corridor(station, camera, config)
    confusions = [row for layer in station.layers_front_to_rear() for row in _confusions(station, camera, layer)]
    metre_px = float(camera.focal_px.mean()) / CONFUSION_AT_M
    fits = self_fits(station, _NEARLY * required.confusion_px / metre_px)
    unsafe = unsafe_roll_rad(fits, required.confusion_px / metre_px)
    return {
        "name": station.name,
        "layers": {layer: len(station.lights_of(layer)) for layer in station.layers_front_to_rear()},
        "docking_point": station.docking_point.tolist(),
        "alert_limits": station.alert_limits.as_text(),
        "corridor": corridor,
        "confusions": confusions,
        "self_fits": _listed(fits, metre_px),
        "unsafe_roll_deg": None if unsafe is None else math.degrees(unsafe),
        "failed": [*_weak_layouts(confusions, required), *_too_few_in_view(station, camera, corridor, required)],
    }


def _listed(fits: list[SelfFit], metre_px: float) -> list[dict[str, Any]]:
    """The best rotations, shifts and mirror images under which the array nearly fits itself, as rows."""
    some = [one for kind in ("rotation", "shift", "mirror") for one in [f for f in fits if f.kind == kind][:_MOST_FITS]]
    return [
        {
            "kind": one.kind,
            "angle_deg": math.degrees(one.angle_rad),
            "shift_m": one.shift_m,
            "lights": one.lights,
            "misfit_m": one.residual_m,
            "misfit_px": one.residual_m * metre_px,
        }
        for one in some
    ]


def in_view(station: Station, camera: Camera, T_dock_cam: Array) -> InView:
    """Which lights are inside the image and within their beams, as seen from a pose; water is not considered."""
    uv = project_lights(camera, T_dock_cam, station.p_dock)
    to_camera = T_dock_cam[:3, 3] - station.p_dock
    distance = np.maximum(np.linalg.norm(to_camera, axis=1), 1e-9)
    off_axis = np.arccos(np.clip((to_camera * station.axis).sum(axis=1) / distance, -1.0, 1.0))
    return InView(np.asarray(camera.contains(uv)), np.rad2deg(off_axis) <= station.beam_deg / 2.0)


def head_on(z_m: float) -> Array:
    """Pose `T_dock_cam` (4, 4) on the dock's axis at `z_m`, looking straight at the dock."""
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    T_dock_cam[2, 3] = z_m
    return T_dock_cam


def _corridor(station: Station, camera: Camera, config: Config) -> list[dict[str, Any]]:
    """Rows along a head-on approach down the axis to the docking point; the bound follows every frame of it."""
    end = float(station.docking_point[2])
    start = max(_START_Z_M, end)
    wanted = sorted({*(z for z in _ROWS_Z_M if z > end), end}, reverse=True)
    bound, rows = Bound(station, camera, config), []
    steps = math.ceil((start - end) / _SPEED_M_S * _RATE_HZ - 1e-9)
    for k in range(steps + 1):
        z = max(start - k * _SPEED_M_S / _RATE_HZ, end)
        seen = in_view(station, camera, head_on(z)).lights
        level = bound.step(round(k * 1e9 / _RATE_HZ), head_on(z), seen)
        while wanted and z <= wanted[0] + 1e-9:
            rows.append(_row(station, wanted.pop(0), seen, level))
    return rows


def _row(station: Station, z_m: float, seen: Indices, level: Array | None) -> dict[str, Any]:
    """One row of the corridor; without a light in view a pose would only be predicted, so none is stated.

    Near the dock, where guidance has no limits of its own, its levels are None.
    """
    counts = {layer: int(np.isin(station.lights_of(layer), seen).sum()) for layer in station.layers_front_to_rear()}
    row: dict[str, Any] = {"z_m": z_m, "lights": counts, "stage": _stage(counts)}
    if level is None or not np.isfinite(level).all() or not len(seen):
        return row | dict.fromkeys(LEVELS) | {"valid": False, "guide": False}
    limits, near_end_m = station.alert_limits, abs(z_m) - float(level[4])
    row |= dict(zip(LEVELS, (level * [1.0, 1.0, _DEG, _DEG, 1.0]).tolist(), strict=True))
    valid = bool((level[:3] < limits.of_pose(z_m, float(level[1]))).all())
    ahead_rad = 0.0 if z_m > 0.0 else math.pi  # past the entrance its origin is behind the camera
    if not limits.applies_to_guide(ahead_rad, near_end_m):
        return row | dict.fromkeys(LEVELS[3:]) | {"valid": valid, "guide": valid}
    return row | {"valid": valid, "guide": bool((level[3:] < limits.of_guide(near_end_m)).all())}


def _stage(counts: dict[str, int]) -> str:
    """The docking stage by the layers in view, front first; of a dock with one layer that layer is the front one."""
    seen = [count >= _STAGE_LIGHTS for count in counts.values()]
    if not any(seen):
        return "search"
    if len(seen) == 1:
        return "front"
    if all(seen):
        return "transition"
    return "rear" if seen[-1] else "front"


def _confusions(station: Station, camera: Camera, layer: str) -> list[dict[str, Any]]:
    """The best-fitting wrong assignment, plain and mirrored, for each number of lights seen; None where costly."""
    lights = station.lights_of(layer)
    n, rows = len(lights), []
    for seen in range(min(_LEAST_IDENTIFIED, n), n + 1):
        row: dict[str, Any] = {"layer": layer, "seen": seen}
        for kind, mirrored in (("assignment", False), ("mirror", True)):
            costly = math.comb(n, seen) * math.perm(n, seen) > _MAX_ASSIGNMENTS
            worst = None if costly else worst_confusion(apparent(station.p_dock[lights]), seen=seen, mirrored=mirrored)
            row |= _confusion_fields(kind, worst, [station.ids[light] for light in lights], camera)
        rows.append(row)
    return rows


def _confusion_fields(kind: str, worst: Confusion | None, ids: list[str], camera: Camera) -> dict[str, Any]:
    if worst is None:
        return {f"{kind}_m": None, f"{kind}_px": None, f"{kind}_lights": None, f"{kind}_taken_for": None}
    return {
        f"{kind}_m": worst.residual_m,
        f"{kind}_px": worst.residual_m * float(camera.focal_px.mean()) / CONFUSION_AT_M,
        f"{kind}_lights": [ids[i] for i in worst.seen],
        f"{kind}_taken_for": [ids[i] for i in worst.taken_for],
    }


def _weak_layouts(confusions: list[dict[str, Any]], required: Requirements) -> list[str]:
    """A line for each layer of which four lights are easily confused, with the lights that are."""
    found = []
    for row in confusions:
        if row["seen"] == _LEAST_IDENTIFIED:
            for kind in ("assignment", "mirror"):
                px = row[f"{kind}_px"]
                if px is not None and px < required.confusion_px:
                    seen, taken_for = (" ".join(row[f"{kind}_{part}"]) for part in ("lights", "taken_for"))
                    what = f"{'the mirror image of ' if kind == 'mirror' else ''}{seen} taken for {taken_for}"
                    fits = f"fits within {px:.2f} px at {CONFUSION_AT_M:g} m"
                    found.append(f"layer {row['layer']}: {what} {fits}, wanted {required.confusion_px:g}")
    return found


def _too_few_in_view(
    station: Station, camera: Camera, corridor: list[dict[str, Any]], required: Requirements
) -> list[str]:
    """One line for the distances at which no layer shows enough lights, with what hides the others at the nearest."""
    short = [
        row["z_m"]
        for row in corridor
        if row["z_m"] <= required.from_z_m and max(row["lights"].values()) < required.lights
    ]
    if not short:
        return []
    view = in_view(station, camera, head_on(short[0]))
    hidden = {
        "seen": view.inside & view.toward,
        "outside the image": ~view.inside,
        "shining past the camera": view.inside & ~view.toward,
    }
    parts = [
        f"{' '.join(station.ids[light] for light in np.flatnonzero(which))} {what}"
        for what, which in hidden.items()
        if which.any()
    ]
    where = ", ".join(f"{z:g}" for z in short)
    text = f"fewer than {required.lights} lights of any layer in view at z {where} m"
    return [f"{text}; at {short[0]:g} m: {', '.join(parts)}"]
