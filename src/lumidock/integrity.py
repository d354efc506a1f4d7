"""May a pose be used: protection levels against the alert limits, and the docking stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from lumidock._kernels.tracking.levels import levels
from lumidock.alert_limits import AlertLimits
from lumidock.config import IntegrityConfig
from lumidock.datatypes import Array, Guide, Protection, Stage
from lumidock.match import Plan
from lumidock.track import Track

_ANY_BEARING = math.sqrt(2.0) * math.pi  # at the origin itself a bearing says nothing ...
_CLEAR, _STEEP = 2.0, 0.3  # ... which begins so many range levels away, or with a bearing level of so many rad
_IDENTITY = np.eye(4)


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """A pose `T_dock_cam` (4, 4), its covariance (6, 6) in dock axes, its guide and all their protection levels."""

    T_dock_cam: Array
    covariance: Array
    protection: Protection
    guide: Guide


def bounds(beliefs: Sequence[Track], config: IntegrityConfig) -> Bounds:
    """Protection of the first belief, wide enough to hold every other that is likelier than the risk.

    Without a fault the levels are factors on sigma; with six or more lights they also hold when any one of them is at
    fault (M. Joerger et al., "Solution separation versus residual-based RAIM", 2014).
    """
    first = beliefs[0]
    cov = np.empty((9, 9))
    pl = _levels(first, config, cov)
    for other in beliefs[1:]:
        if first.log_weight - other.log_weight < -math.log(config.risk):
            apart = _apart(first, other)
            wider = apart + np.array(_levels(other, config, np.empty((9, 9))))
            pl = tuple(np.maximum(pl, wider).tolist())
    T_dock_cam, R_dock_cam = _IDENTITY.copy(), first.R.T
    T_dock_cam[:3, :3], T_dock_cam[:3, 3] = R_dock_cam, -(R_dock_cam @ first.t)
    x, y, z = first.t.tolist()
    reach = math.sqrt(x * x + y * y + z * z)
    lateral, axial, angle, bearing, distance = pl
    linear = bearing < _STEEP and min(math.hypot(x, z), math.hypot(y, z)) > _CLEAR * distance
    return Bounds(
        T_dock_cam,
        cov[:6, :6],
        Protection(lateral, axial, angle),
        Guide(
            math.atan2(x, z),
            math.atan2(y, z),
            reach,
            bearing if linear else max(bearing, _ANY_BEARING),
            distance,
        ),
    )


def _levels(track: Track, config: IntegrityConfig, cov: Array) -> tuple[float, ...]:
    """Lateral m, axial m, angle rad, bearing rad, range m of one belief; fills `cov` (9, 9)."""
    used = track.n_used
    fault_risk = min(config.risk / (config.fault * max(used, 1)), 0.5)
    return levels(
        track.R,
        track.t,
        track.P,
        track.apart,
        track.plane,
        sigma_factors(config.risk),
        sigma_factors(fault_risk),
        used >= config.separate_from,
        cov,
    )


@cache
def sigma_factors(risk: float) -> Array:
    """Sigmas (3,) that the length of a normal vector of 1, 2 and 3 dimensions exceeds with probability `risk`."""
    return np.array([_sigma_factor(risk, dimensions) for dimensions in (1, 2, 3)])


def _sigma_factor(risk: float, dimensions: int) -> float:
    low, high = 0.0, 40.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _tail(middle, dimensions) > risk else (low, middle)
    return high


def _tail(k: float, dimensions: int) -> float:
    """Probability that a standard normal vector is longer than `k`."""
    if dimensions == 2:
        return math.exp(-0.5 * k * k)
    one = math.erfc(k / math.sqrt(2.0))
    return one if dimensions == 1 else one + math.sqrt(2.0 / math.pi) * k * math.exp(-0.5 * k * k)


def _apart(a: Track, b: Track) -> Array:
    """How far two poses lie apart in what the levels bound: lateral, axial, angle, bearing, range (5,)."""
    at = -(a.R.T @ a.t) + b.R.T @ b.t
    turn = math.acos(min(max(0.5 * (float(np.trace(a.R.T @ b.R)) - 1.0), -1.0), 1.0))
    between = [math.atan2(a.t[k], a.t[2]) - math.atan2(b.t[k], b.t[2]) for k in (0, 1)]
    bearing = math.hypot(*(math.remainder(angle, 2.0 * math.pi) for angle in between))
    distance = abs(float(np.linalg.norm(a.t) - np.linalg.norm(b.t)))
    return np.array([math.hypot(at[0], at[1]), abs(at[2]), turn, bearing, distance])


def pose_holds(bound: Bounds, limits: AlertLimits) -> bool:
    """Whether the full pose's protection levels are inside the alert limits of the dock."""
    pl = bound.protection
    lateral_m, axial_m, angle_rad = limits.of_pose(float(bound.T_dock_cam[2, 3]), pl.axial_m)
    return pl.lateral_m < lateral_m and pl.axial_m < axial_m and pl.angle_rad < angle_rad


def guide_holds(bound: Bounds, limits: AlertLimits) -> bool:
    """Whether bearing and range may be used: by their own limits from afar, near the dock where the pose may be."""
    guide = bound.guide
    near_end_m = guide.range_m - guide.pl_range_m
    if not limits.applies_to_guide(guide.bearing_x_rad, near_end_m):
        return pose_holds(bound, limits)
    bearing_rad, range_m = limits.of_guide(near_end_m)
    return guide.pl_bearing_rad < bearing_rad and guide.pl_range_m < range_m


def stage(track: Track, plan: Plan) -> Stage | None:
    """Docking stage by the layers that the pose rests on (paper section 2.2); None without a light."""
    rear = sum(c for c, is_rear in zip(track.count, plan.is_rear, strict=True) if is_rear)
    front = track.n_used - rear
    if front and rear:
        return "transition"
    return "rear" if rear else "front" if front else None
