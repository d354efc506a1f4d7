"""Where the vehicle takes itself to be: by the last usable fix, and reckoned with its own instruments since then.

A valid pose replaces what was known, across and along the axis, unless that has a smaller level and agrees. A guide
(bearing and range) gives a position with the vehicle's own attitude, and replaces what is known where its level is
smaller. Between fixes velocity over ground and yaw rate are integrated, and the levels grow by what these may be wrong.
Positions are those of the camera, in `approach`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lumidock.datatypes import Array, Fix
from lumidock.docking.instruments import DVL_BIAS_M_S, DVL_SCALE, HEADING_SIGMA_RAD, HOMING_SIGMA_M, Reading
from lumidock.docking.vehicle import R_BODY_CAM_AHEAD, R_DOCK_APPROACH, T_dock_cam_of, Three, VehicleModel
from lumidock.go_no_go import Situation

_LEVEL_SIGMAS = 5.0  # of a level over its 1 sigma: two dimensions at 1e-6 have 5.3
_YAW_KNOWN_RAD = math.radians(0.5)  # 1 sigma of the heading of a valid pose
_GYRO_SIGMA_RAD_S = math.radians(0.05)


@dataclass(slots=True)
class Navigator:
    """Position and heading as the vehicle has them; `level_m` across and `level_z_m` along the docking axis."""

    model: VehicleModel
    position: Three
    heading_rad: float
    level_m: float = _LEVEL_SIGMAS * HOMING_SIGMA_M
    level_z_m: float = _LEVEL_SIGMAS * HOMING_SIGMA_M
    heading_sigma_rad: float = HEADING_SIGMA_RAD
    since_fix_s: float = math.inf
    since_guide_s: float = math.inf
    reason: str = ""
    velocity: Three = (0.0, 0.0, 0.0)  # of the body over ground, in approach
    tilt: tuple[float, float] = field(default=(0.0, 0.0))  # pitch, roll

    def reckon(self, reading: Reading, dt_s: float) -> None:
        """Move on by one reading of the own instruments."""
        self.heading_rad += reading.yaw_rate * dt_s
        self.heading_sigma_rad += _GYRO_SIGMA_RAD_S * dt_s
        if self.heading_sigma_rad > HEADING_SIGMA_RAD:
            self.heading_rad, self.heading_sigma_rad = reading.heading_rad, HEADING_SIGMA_RAD
        self.tilt = (reading.pitch_rad, reading.roll_rad)
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        u, v, w = reading.over_ground
        self.velocity = (c * u - s * v, s * u + c * v, w)
        nose = self.model.half_m[0] * reading.yaw_rate  # the camera swings with the nose
        x, y, z = self.position
        self.position = (
            x + dt_s * (self.velocity[0] - s * nose),
            y + dt_s * (self.velocity[1] + c * nose),
            z + dt_s * self.velocity[2],
        )
        speed = math.hypot(u, v)
        # of a wrong heading the vehicle drifts aside, of a wrong scale it comes too far or not far enough
        self.level_m += _LEVEL_SIGMAS * dt_s * math.hypot(DVL_BIAS_M_S, self.heading_sigma_rad * speed)
        self.level_z_m += _LEVEL_SIGMAS * dt_s * math.hypot(DVL_BIAS_M_S, DVL_SCALE * speed)
        self.since_fix_s += dt_s
        self.since_guide_s += dt_s

    def take(self, fix: Fix) -> None:
        """Use the fix of the present frame, as far as it may be used."""
        self.reason = fix.reason
        if fix.T_dock_cam is not None:
            self._take_pose(fix, fix.T_dock_cam)
        elif fix.guide is not None:
            self._take_guide(fix)

    def _take_pose(self, fix: Fix, T_dock_cam: Array) -> None:
        self.since_fix_s = self.since_guide_s = 0.0
        level_m, level_z_m = (fix.protection.lateral_m, fix.protection.axial_m) if fix.protection else (0.0, 0.0)
        x, y, z = (float(value) for value in R_DOCK_APPROACH.T @ T_dock_cam[:3, 3])
        if level_z_m <= self.level_z_m or abs(x - self.position[0]) > level_z_m:
            self.position, self.level_z_m = (x, *self.position[1:]), level_z_m
        apart_m = math.hypot(y - self.position[1], z - self.position[2])
        if level_m > self.level_m and apart_m < level_m:
            return  # what an earlier pose and the own instruments say is better known, and agrees
        ahead = R_DOCK_APPROACH.T @ T_dock_cam[:3, :3] @ R_BODY_CAM_AHEAD.T[:, 0]
        self.position, self.level_m = (self.position[0], y, z), level_m
        self.heading_rad, self.heading_sigma_rad = math.atan2(float(ahead[1]), float(ahead[0])), _YAW_KNOWN_RAD

    def _take_guide(self, fix: Fix) -> None:
        guide = fix.guide
        assert guide is not None
        self.since_guide_s = 0.0
        angle = math.hypot(guide.pl_bearing_rad, _LEVEL_SIGMAS * self.heading_sigma_rad)
        level_m = guide.range_m * angle
        if level_m + guide.pl_range_m > self.level_m + self.level_z_m:
            return
        ray_cam = np.array([math.tan(guide.bearing_x_rad), math.tan(guide.bearing_y_rad), 1.0])
        R_dock_cam = T_dock_cam_of(self.model, (0.0, 0.0, 0.0), (self.heading_rad, *self.tilt))[:3, :3]
        p_dock = -guide.range_m * (R_dock_cam @ (ray_cam / np.linalg.norm(ray_cam)))
        x, y, z = (float(value) for value in R_DOCK_APPROACH.T @ p_dock)
        self.position, self.level_m, self.level_z_m = (x, y, z), level_m, guide.pl_range_m

    def situation(self) -> Situation:
        """What the go / no-go rests on."""
        x, y, z = self.position
        return Situation(
            off_m=math.hypot(y, z),
            z_m=-x,
            level_m=self.level_m,
            level_z_m=self.level_z_m,
            closing_m_s=self.velocity[0],
            since_fix_s=self.since_fix_s,
            since_guide_s=self.since_guide_s,
            reason=self.reason,
        )
