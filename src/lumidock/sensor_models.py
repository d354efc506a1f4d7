"""What the vehicle's sensors are expected to measure: each kind against a predicted track, linear in its error.

Errors that do not average out over values are states of the filter, behind those of the lights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.tracking.aiding import SensorRows
from lumidock._kernels.tracking.track import TWIST
from lumidock.config import AidingConfig, DockMotionConfig
from lumidock.datatypes import Array, SensorKind
from lumidock.geometry import rotation_from_quat_xyzw, skew
from lumidock.track import Track

# Error states behind those of the lights: bias rad/s and delay s of the gyro; relative scale, mount rad and delay s of
# the DVL; reading of the depth sensor at the height of the dock's origin m; x and z of the direction that is upward in
# `dock`, whose y is 1.
GYRO, GYRO_DELAY, SCALE, MOUNT, VELOCITY_DELAY, DEPTH, UP, ERRORS = 0, 3, 4, 5, 8, 9, 10, 12
_CORRELATED_S = 1.0  # what a wrong mount makes of a rate changes as fast as the motion of a vehicle does


class Group(NamedTuple):
    """The mean of some values of one sensor at their mean time, delay removed; `sigma` of its noise."""

    kind: SensorKind
    t_ns: int
    value: tuple[float, ...]
    sigma: float


class SensorModel(NamedTuple):
    """A group against a track's prediction: its rows in the filter and their degrees of freedom.

    `errors` (K, ERRORS): what the error states do to its numbers. `parts`: those of one source, which the lights have
    to have measured before the sensor is proven; `delay`: that of the delay, or -1.
    """

    rows: SensorRows
    errors: Array
    dof: int
    parts: tuple[slice, ...]
    delay: int = -1


def declared(config: AidingConfig) -> Array:
    """Variances (ERRORS,) of the error states as the settings have them."""
    var = np.empty(ERRORS)
    var[GYRO:GYRO_DELAY] = math.radians(config.gyro.bias_deg_s) ** 2
    var[GYRO_DELAY], var[VELOCITY_DELAY] = config.gyro.delay_sigma_s**2, config.velocity.delay_sigma_s**2
    var[SCALE] = config.velocity.scale**2
    var[MOUNT:VELOCITY_DELAY] = math.radians(config.velocity.mount_sigma_deg) ** 2
    var[DEPTH] = config.depth.dock_depth_sigma_m**2
    var[UP:] = math.radians(config.dock_level_deg) ** 2
    return var


def walk(kind: SensorKind, config: AidingConfig) -> Array:
    """Variances (ERRORS,) that a second adds to the error states of one sensor."""
    var = np.zeros(ERRORS)
    if kind == "gyro":
        var[GYRO:GYRO_DELAY] = math.radians(config.gyro.walk_deg_s) ** 2
    elif kind == "velocity":
        var[SCALE:VELOCITY_DELAY] = config.velocity.walk**2
    elif kind == "depth":
        var[DEPTH] = config.depth.walk_m**2
    return var


def dock_noise(dock: DockMotionConfig) -> tuple[float, float]:
    """Variances that a second adds to the twist, (m/s)^2 and (rad/s)^2, where the dock moves: 2 sigma^2 / tau."""
    spread = _swing_s(dock.position_m, dock.velocity_m_s), _swing_s(dock.angle_deg, dock.rate_deg_s)
    sigma = dock.velocity_m_s, math.radians(dock.rate_deg_s)
    linear, angular = (2.0 * s * s / tau if tau > 0.0 else 0.0 for s, tau in zip(sigma, spread, strict=True))
    return linear, angular


def _swing_s(amplitude: float, rate: float) -> float:
    """Correlation time s of a swing of an amplitude and a rate."""
    return amplitude / rate if rate > 0.0 else 0.0


def only(state: int) -> slice:
    """The part of the error states that is one of them."""
    return slice(state, state + 1)


class _Timing(NamedTuple):
    """Rate of change of a sensor's value, its noise variance, lateness of a group s, time from group to group s."""

    change: Array
    var: float
    late_s: float
    dt_s: float

    def repeats(self, correlated_s: float) -> float:
        """By how much white noise has to be larger than a noise of this correlation time, to do as much in the end."""
        return max(2.0 * correlated_s / self.dt_s, 1.0)


class Before(NamedTuple):
    """The group of a sensor before this one: its time, and its mean; none: an empty one."""

    t_ns: int
    value: tuple[float, ...]


def model_of(one: Track, group: Group, before: Before, config: AidingConfig) -> SensorModel:
    """A group against a predicted track. Beside its noise it is off by what the settings say of the dock's motion."""
    dt = max((group.t_ns - before.t_ns) * 1e-9, 1e-3) if before.value else math.inf
    change = np.subtract(group.value, before.value) / dt if before.value else np.zeros(len(group.value))
    late_s = max((one.t_ns - group.t_ns) * 1e-9, 0.0)
    timing = _Timing(change, 2.0 * group.sigma**2 / dt**2, late_s, min(dt, 1.0))
    if group.kind == "gyro":
        return _gyro(one, group, timing, config)
    if group.kind == "velocity":
        return _velocity(one, group, timing, config)
    return _depth(one, group, timing, config) if group.kind == "depth" else _tilt(one, group, timing, config)


def _gyro(one: Track, group: Group, timing: _Timing, config: AidingConfig) -> SensorModel:
    """Rates of a while ago: z = w + bias - (delay + lateness) dw/dt, and what the dock turns."""
    how, dock, state = config.gyro, config.dock_motion, one.state
    n, R_cam_sensor = len(state.x) - ERRORS, rotation_from_quat_xyzw(np.array(how.quat_xyzw))
    z, change = R_cam_sensor @ group.value, R_cam_sensor @ timing.change
    errors = np.zeros((3, ERRORS))
    errors[:, GYRO:GYRO_DELAY], errors[:, GYRO_DELAY] = np.eye(3), -change
    turned = math.radians(how.mount_sigma_deg) ** 2 * float(z @ z) * timing.repeats(_CORRELATED_S)
    rocking = math.radians(dock.rate_deg_s) ** 2 * timing.repeats(_swing_s(dock.angle_deg, dock.rate_deg_s))
    var = group.sigma**2 + timing.var * (how.delay_sigma_s + timing.late_s) ** 2 + turned + rocking
    columns = np.concatenate([np.arange(TWIST + 3, TWIST + 6), n + np.arange(GYRO, SCALE)])
    expected = state.x[TWIST + 3 : TWIST + 6] + errors @ state.x[n:] - change * timing.late_s
    rows = SensorRows(columns, np.hstack([np.eye(3), errors[:, GYRO:SCALE]]), z - expected, np.full(3, var))
    return SensorModel(rows, errors, 3, (slice(GYRO, GYRO_DELAY),), GYRO_DELAY)


def _velocity(one: Track, group: Group, timing: _Timing, config: AidingConfig) -> SensorModel:
    """Velocity over ground at r, of a while ago: z = u + scale u + mount x u - (delay + lateness) du/dt; u = v + w x r.

    And what the dock moves.
    """
    how, dock, state = config.velocity, config.dock_motion, one.state
    n, r = len(state.x) - ERRORS, np.array(how.position_m)
    R_cam_sensor = rotation_from_quat_xyzw(np.array(how.quat_xyzw))
    z, change = R_cam_sensor @ group.value, R_cam_sensor @ timing.change
    u = state.x[TWIST : TWIST + 3] + np.cross(state.x[TWIST + 3 : TWIST + 6], r)
    M = (1.0 + state.x[n + SCALE]) * np.eye(3) + skew(state.x[n + MOUNT : n + VELOCITY_DELAY])
    errors = np.zeros((3, ERRORS))
    errors[:, SCALE], errors[:, MOUNT:VELOCITY_DELAY], errors[:, VELOCITY_DELAY] = u, -skew(u), -change
    swing = _swing_s(dock.position_m, dock.velocity_m_s), _swing_s(dock.angle_deg, dock.rate_deg_s)
    rocking = dock.velocity_m_s**2 * timing.repeats(swing[0])
    rocking += (math.radians(dock.rate_deg_s) * float(np.linalg.norm(state.t))) ** 2 * timing.repeats(swing[1])
    var = group.sigma**2 + timing.var * (how.delay_sigma_s + timing.late_s) ** 2 + rocking
    columns = np.concatenate([np.arange(TWIST, TWIST + 6), n + np.arange(SCALE, DEPTH)])
    H = np.hstack([M, -M @ skew(r), errors[:, SCALE:DEPTH]])
    expected = u + errors @ state.x[n:] - change * timing.late_s
    parts = only(SCALE), slice(MOUNT, VELOCITY_DELAY)
    return SensorModel(SensorRows(columns, H, z - expected, np.full(3, var)), errors, 3, parts, VELOCITY_DELAY)


def _depth(one: Track, group: Group, timing: _Timing, config: AidingConfig) -> SensorModel:
    """Depth of a sensor at r: z = depth of the dock's origin - up . p, p its position in `dock`."""
    how, dock, state = config.depth, config.dock_motion, one.state
    n = len(state.x) - ERRORS
    up = np.array([state.x[n + UP], 1.0, state.x[n + UP + 1]])
    p = state.R.T @ (np.array(how.position_m) - state.t)
    errors = np.zeros((1, ERRORS))
    errors[0, DEPTH], errors[0, UP:] = 1.0, -p[[0, 2]]
    swing_s = _swing_s(dock.angle_deg, dock.rate_deg_s)
    rocking = (math.radians(dock.angle_deg) * float(np.linalg.norm(p))) ** 2 + dock.position_m**2
    var = group.sigma**2 + float(timing.change @ timing.change) * timing.late_s**2 + rocking * timing.repeats(swing_s)
    columns = np.concatenate([np.arange(6), n + np.arange(DEPTH, ERRORS)])
    H = np.concatenate([up, np.cross(p, up), errors[0, DEPTH:]])[None]
    residual = np.array([group.value[0] - (state.x[n + DEPTH] - up @ p)])
    return SensorModel(SensorRows(columns, H, residual, np.array([var])), errors, 1, (slice(DEPTH, ERRORS),))


def _tilt(one: Track, group: Group, timing: _Timing, config: AidingConfig) -> SensorModel:
    """The direction upward: z = R_cam_dock up."""
    how, dock, state = config.tilt, config.dock_motion, one.state
    n = len(state.x) - ERRORS
    z = rotation_from_quat_xyzw(np.array(how.quat_xyzw)) @ group.value
    up = np.array([state.x[n + UP], 1.0, state.x[n + UP + 1]])
    length = float(np.linalg.norm(up))
    up /= length
    errors = np.zeros((3, ERRORS))
    errors[:, UP:] = (state.R @ (np.eye(3) - np.outer(up, up)))[:, [0, 2]] / length
    rocking = math.radians(dock.angle_deg) ** 2 * timing.repeats(_swing_s(dock.angle_deg, dock.rate_deg_s))
    var = group.sigma**2 + float(timing.change @ timing.change) * timing.late_s**2 + rocking
    columns = np.concatenate([np.arange(3, 6), n + np.arange(UP, ERRORS)])
    H = np.hstack([-state.R @ skew(up), errors[:, UP:]])
    residual = z / float(np.linalg.norm(z)) - state.R @ up
    return SensorModel(SensorRows(columns, H, residual, np.full(3, var)), errors, 2, (slice(UP, ERRORS),))
