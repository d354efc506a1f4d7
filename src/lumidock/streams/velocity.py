"""The velocity of the vehicle where a method's track has one: the only place that asks a fix for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lumidock.datatypes import Array, Fix
from lumidock.geometry import se3_inverse, skew
from lumidock.streams.vehicle import Vehicle

# 1 sigma, rad/s, of a turn rate that nobody measured: a vehicle that turns by a quarter in about ten seconds
_TURN_RATE_SIGMA = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class BodyVelocity:
    """Velocity (3,) m/s of the body's origin relative to the dock, in body axes, and its covariance (3, 3)."""

    linear_m_s: Array
    covariance: Array


def body_velocity(fix: Fix, vehicle: Vehicle) -> BodyVelocity | None:
    """The body's velocity by the camera's, in body axes (x forward, y left, z up); None where the track has none.

    A fix with a velocity holds `velocity` (3,) m/s of cam in dock axes and `velocity_covariance` (3, 3). The body's
    origin moves by the turn rate times its distance from the camera besides, which is counted as uncertainty.
    """
    found: Any = getattr(fix, "velocity", None)
    if found is None or fix.T_dock_cam is None:
        return None
    covariance_dock: Any = getattr(fix, "velocity_covariance", None)
    if covariance_dock is None or not (np.isfinite(found).all() and np.isfinite(covariance_dock).all()):
        return None
    T_dock_body = fix.T_dock_cam @ se3_inverse(vehicle.T_body_cam)
    R_body_dock = T_dock_body[:3, :3].T
    lever = skew(T_dock_body[:3, 3] - fix.T_dock_cam[:3, 3])
    full = np.asarray(covariance_dock, float) + _TURN_RATE_SIGMA**2 * (lever @ lever.T)
    return BodyVelocity(R_body_dock @ np.asarray(found, float), R_body_dock @ full @ R_body_dock.T)
