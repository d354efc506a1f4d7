"""Line of sight with crab angle, at a speed by what is known, through the paper's four stages.

The docking stages of the paper (section 2.2) set the speeds: search slowly, approach on the front layer at cruising
speed, slow down where both layers are seen, enter on the rear layer at entry speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lumidock.docking.control import Wanted
from lumidock.docking.navigation import Navigator
from lumidock.docking.vehicle import Three, VehicleModel

_MOST_CRAB_RAD = math.radians(12.0)  # half of the camera's half field, so that the dock stays in view
_STRAIGHT_M, _CRAB_M = 1.5, 5.0  # before the entrance the hull lies straight; from here on out it may crab fully
_SIDE_M_S = 0.25  # fastest correction across the axis: half of the strongest current, so that thrust is left
_CORRIDOR_M, _OPENS = 0.3, 0.2  # the vehicle slows where it is further off the axis than this, opening with distance
_UNKNOWN_SHARE = 0.6  # of the cruising speed with bearing and range alone ...
_RECKONED_SHARE = 0.3  # ... and without either
_OLD_S = 2.0  # a fix older than this is none for choosing the speed
_SWEEP_RAD, _SWEEP_S = math.radians(20.0), 30.0  # of the search, when nothing has been seen for a while


@dataclass(frozen=True, slots=True)
class Course:
    """Where to go: a point ahead in `approach`, and the fastest that the vehicle may go there."""

    ahead_m: float
    fastest_m_s: float


def speed_known(navigator: Navigator, model: VehicleModel) -> float:
    """The fastest speed that what is known allows, m/s."""
    if navigator.since_fix_s < _OLD_S:
        return model.cruise_m_s
    return model.cruise_m_s * (_UNKNOWN_SHARE if navigator.since_guide_s < _OLD_S else _RECKONED_SHARE)


def steer(navigator: Navigator, course: Course, gain: float, current: Three) -> Wanted:
    """Velocity and heading on the docking axis toward a point on it; `gain` is that of the position loop, 1/s.

    Source: line of sight with a lookahead of speed / gain, Fossen 2011, section 10.3; the crab angle is the direction
    of the wanted velocity through the water.
    """
    x, left, up = navigator.position
    to_go = course.ahead_m - x
    off = math.hypot(left, up)
    wide = _CORRIDOR_M + _OPENS * max(-x, 0.0)
    ahead = max(-course.fastest_m_s, min(course.fastest_m_s, gain * to_go))
    ahead *= max(0.0, 1.0 - max(0.0, off / wide - 0.5)) if ahead > 0.0 else 1.0
    across = min(gain, _SIDE_M_S / off if off > 0.0 else gain)
    velocity = (ahead, -across * left, -across * up)
    return Wanted(velocity, crab_angle(velocity, current, -x))


def crab_angle(velocity: Three, current: Three, before_m: float) -> float:
    """Heading that lets the bow meet the water, as far as the camera and the distance to the entrance allow, rad."""
    share = max(0.0, min(1.0, (before_m - _STRAIGHT_M) / (_CRAB_M - _STRAIGHT_M)))
    angle = math.atan2(velocity[1] - current[1], max(velocity[0] - current[0], 0.1))
    return share * max(-_MOST_CRAB_RAD, min(_MOST_CRAB_RAD, angle))


def sweep(t_s: float) -> float:
    """Heading of the search beside the line of sight, rad."""
    return _SWEEP_RAD * math.sin(2.0 * math.pi * t_s / _SWEEP_S)
