"""Dockings behind a flat port: localized with the port in the calibration, and with the pinhole that comes nearest.

Bare detections of the true lens behind its port. The pinhole is fitted to points at the distances of a calibration; its
origin is not the entrance pupil but the point that fits best, and its poses are judged there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock.alert_limits import DEFAULT_ALERT_LIMITS
from lumidock.camera import Camera
from lumidock.datatypes import Array, Fix
from lumidock.evaluation.claims import pose_error
from lumidock.localizer import Localizer
from lumidock.port import FlatPort
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario

PORTS = {"2 cm": FlatPort(0.02, 1.34), "8 cm, 1 cm of glass": FlatPort(0.08, 1.34, 0.01), "20 cm": FlatPort(0.2, 1.34)}
CALIBRATED_M = {"0.5-1.5 m": (0.5, 1.5), "2-6 m": (2.0, 6.0)}
SEEDS = range(9700, 9704)
_GRID, _STEPS = 15, 8  # points along each side of the picture; Gauss-Newton steps


def behind(port: FlatPort) -> Camera:
    """The shipped camera with the lens in air that gives its focal length in the water."""
    camera = shipped_camera()
    K = camera.K.copy()
    K[[0, 1], [0, 1]] /= port.index
    return replace(camera, K=K, port=port)


def nearest_pinhole(camera: Camera, between_m: tuple[float, float]) -> tuple[Camera, float]:
    """The plumb_bob camera that fits best at these distances, and how far its origin lies before the pupil, m."""
    u, v = (np.linspace(0.0, size - 1.0, _GRID) for size in (camera.width, camera.height))
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    p = np.concatenate([rays * (z / rays[:, 2:]) for z in np.linspace(*between_m, 5)])
    uv = camera.project(p) - camera.center_px
    before = 0.0
    for _ in range(_STEPS):
        z = p[:, 2:] - before
        xy = p[:, :2] / z
        r2 = (xy * xy).sum(axis=1, keepdims=True)
        columns = np.stack([(xy * r2**power).ravel() for power in range(4)], axis=1)
        terms = np.linalg.lstsq(columns, uv.ravel(), rcond=None)[0]
        slope = sum((2 * power + 1) * terms[power] * r2**power for power in range(4)) * xy / z
        terms = np.linalg.lstsq(np.column_stack([columns, slope.ravel()]), uv.ravel(), rcond=None)[0]
        before += float(terms[4])
    K = camera.K.copy()
    K[0, 0] = K[1, 1] = terms[0]
    k1, k2, k3 = terms[1:4] / terms[0]
    return Camera(camera.width, camera.height, K, "plumb_bob", np.array([k1, k2, 0.0, 0.0, k3])), before


def judged(fix: Fix, T_dock_cam: Array) -> tuple[bool, bool]:
    """Whether a valid fix is over its level, and whether it is over its alert limit."""
    assert fix.T_dock_cam is not None
    assert fix.protection is not None
    error = pose_error(fix.T_dock_cam, T_dock_cam)
    sizes = np.array([np.hypot(*error[:2]), abs(error[2]), np.linalg.norm(error[3:])])
    level = np.array([fix.protection.lateral_m, fix.protection.axial_m, fix.protection.angle_rad])
    limit = DEFAULT_ALERT_LIMITS.of_pose(float(fix.T_dock_cam[2, 3]), level[1])
    return bool((sizes > level).any()), bool((sizes > limit).any())


def dockings(true: Camera, used: Camera, before_m: float) -> dict[str, int]:
    """Frames, valid ones, those over their level and those over their limit, of nominal dockings."""
    station, counts = shipped_station(), {"frames": 0, "valid": 0, "over level": 0, "misleading": 0}
    T_pupil_used = np.eye(4)
    T_pupil_used[2, 3] = before_m
    for seed in SEEDS:
        localizer = Localizer(station, used)
        for frame in simulated_frames(load_scenario("nominal"), station, true, seed):
            fix = localizer.process_detections(frame.detections)
            counts["frames"] += 1
            counts["valid"] += fix.valid
            if fix.valid:
                over, misleading = judged(fix, frame.T_dock_cam @ T_pupil_used)
                counts["over level"] += over
                counts["misleading"] += misleading
    return counts


def main() -> tuple[dict[str, dict[str, int]], list[str]]:
    """A row for each port and calibration."""
    rows: dict[str, dict[str, int]] = {}
    for name, port in PORTS.items():
        true = behind(port)
        rows[f"{name}, port in the calibration"] = dockings(true, true, 0.0)
        for between, distances in CALIBRATED_M.items():
            rows[f"{name}, pinhole at {between}"] = dockings(true, *nearest_pinhole(true, distances))
    heads = list(next(iter(rows.values())))
    lines = ["| air before the window, calibration | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    return rows, lines + [f"| {name} | " + " | ".join(map(str, row.values())) + " |" for name, row in rows.items()]
