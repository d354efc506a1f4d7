"""Which frames would help a survey next: what a second of them, seen from elsewhere, would take off the errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.geometry import so3_exp
from lumidock.setup import bundle
from lumidock.setup.bundle import CALIBRATION, Estimate
from lumidock.setup.gauge import shape_covariance
from lumidock.setup.observations import Observations
from lumidock.setup.survey import Survey

_FRAMES = 10.0  # independent frames that a view is held for
_HEAD_ON = np.diag([1.0, -1.0, -1.0])
_RANGES_M, _ASIDE_DEG = (1.5, 3.0, 5.0, 8.0, 12.0), (-30.0, 0.0, 30.0)


@dataclass(frozen=True, slots=True)
class View:
    """A place to look from: distance from the nearest layer, degrees to the right and above, and what it brings.

    `lights` are then in view; the rms error of the positions would be `share` of what it is now.
    """

    range_m: float
    right_deg: float
    above_deg: float
    lights: int
    share: float


def helpful_views(found: Survey, camera: Camera, most: int = 3) -> list[View]:
    """The views that would lower the rms error of the positions most, the best first."""
    p_dock = found.adjusted.estimate.p_dock
    now, seen = np.trace(found.covariance), found.adjusted.seen
    information = np.linalg.inv(found.adjusted.covariance)
    noise = float(np.median(found.observed.sigma_px)) * float(np.median(found.adjusted.noise))
    views = []
    for range_m in _RANGES_M:
        for right in _ASIDE_DEG:
            for above in _ASIDE_DEG:
                T_dock_cam = _looking(p_dock, range_m, right, above)
                gained, lights = _gained(found, camera, T_dock_cam, noise)
                if lights >= 4:
                    after = np.trace(shape_covariance(np.linalg.inv(information + gained), p_dock, seen))
                    views.append(View(range_m, right, above, lights, float(np.sqrt(after / now))))
    return sorted(views, key=lambda view: view.share)[:most]


def _looking(p_dock: Array, range_m: float, right_deg: float, above_deg: float) -> Array:
    """The pose (4, 4) of a camera that looks at the middle of the nearest lights from there."""
    near = p_dock[p_dock[:, 2] > p_dock[:, 2].max() - 0.5]
    turn = so3_exp(np.array([0.0, np.deg2rad(right_deg), 0.0])) @ so3_exp(np.array([-np.deg2rad(above_deg), 0.0, 0.0]))
    T = np.eye(4)
    T[:3, :3] = turn @ _HEAD_ON
    T[:3, 3] = near.mean(axis=0) + turn @ np.array([0.0, 0.0, range_m])
    return T


def _gained(found: Survey, camera: Camera, T_dock_cam: Array, noise_px: float) -> tuple[Array, int]:
    """Information (S, S) on positions and calibration that a second of this view adds, and how many lights it shows."""
    station, p_dock = found.after, found.adjusted.estimate.p_dock
    p_cam = (p_dock - T_dock_cam[:3, 3]) @ T_dock_cam[:3, :3]
    uv = camera.project(p_cam)
    to_camera = T_dock_cam[:3, 3] - p_dock
    cosine = (to_camera * station.axis).sum(axis=1) / np.linalg.norm(to_camera, axis=1)
    lit = camera.contains(uv, margin_px=10.0) & (cosine > np.cos(np.deg2rad(station.beam_deg / 2.0)))
    uv = np.where(lit[:, None], uv, np.nan)[None]
    frame = Observations(uv, np.full((1, len(p_dock)), noise_px), np.zeros(1, np.int64), np.zeros(1, np.int64), ("",))
    at = Estimate(p_dock, T_dock_cam[None], np.zeros(CALIBRATION))
    return bundle.information(frame, camera, at) * _FRAMES / found.adjusted.repeats, int(lit.sum())
