"""The velocity of the vehicle where a method's track has one: the only place that asks a fix for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array, Fix
from lumidock.geometry import se3_inverse, skew
from lumidock.streams.vehicle import Vehicle


@dataclass(frozen=True, slots=True, eq=False)
class BodyVelocity:
    """Motion of the body's origin relative to the dock in body axes: (3,) m/s and (3,) rad/s; `covariance` (6, 6)."""

    linear_m_s: Array
    angular_rad_s: Array
    covariance: Array


def body_velocity(fix: Fix, vehicle: Vehicle) -> BodyVelocity | None:
    """The body's motion by the camera's, in body axes (x forward, y left, z up); None where the track has none.

    The `velocity` of a fix is that of cam in dock, in axes of cam: `linear_m_s` (3,), `angular_rad_s` (3,) and the
    `covariance` (6, 6) of both. The body's origin moves by the turn rate times its distance from the camera besides.
    """
    if fix.velocity is None:
        return None
    covariance = fix.velocity.covariance
    motion_cam = np.concatenate([fix.velocity.linear_m_s, fix.velocity.angular_rad_s])
    if not (np.isfinite(motion_cam).all() and np.isfinite(covariance).all()):
        return None
    R_body_cam, lever_cam = vehicle.T_body_cam[:3, :3], se3_inverse(vehicle.T_body_cam)[:3, 3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R_body_cam
    J[:3, 3:] = -R_body_cam @ skew(lever_cam)
    motion_body = J @ motion_cam
    return BodyVelocity(motion_body[:3], motion_body[3:], J @ covariance @ J.T)
