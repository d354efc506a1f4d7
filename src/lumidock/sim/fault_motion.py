"""Faults of a vehicle's motion and of its stream of frames, at point level, in a single run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.datatypes import Array
from lumidock.sim.course import Course
from lumidock.sim.fault_knobs import PointFaults
from lumidock.sim.scenario import poses, rotations

_TURN_DEG, _EVERY_S, _HOLD_S = 20.0, (3.0, 5.0), 1.2  # of the turns of `turn_deg_s`, from one to the next and back
_PULSE_S, _REST_S = (0.2, 0.6), (1.0, 3.0)  # of the pulses of `jerk_m_s2`
_BUMPS, _BUMP_S = 3, 0.7
_BETWEEN_GAPS_S = (2.0, 4.0)


def moved(course: Course, faults: PointFaults, rng: np.random.Generator) -> Course:
    """The course with roll, turns, jerks, bumps and a jump added to it."""
    t_s, n = course.t_ns * 1e-9, len(course.t_ns)
    roll = np.deg2rad(rng.uniform(*faults.roll_deg) * rng.choice([-1.0, 1.0]))
    about_y, about_z = np.zeros((n, 3)), np.tile([0.0, 0.0, roll], (n, 1))
    about_y[:, 1] = np.deg2rad(_turns(faults, t_s, rng))
    R_dock_cam = course.T_dock_cam[:, :3, :3] @ rotations(about_y) @ rotations(about_z)
    dt = float(t_s[1] - t_s[0]) if n > 1 else 0.0
    velocity = np.cumsum(_pulses(faults, t_s, rng), axis=0) * dt + _bumps(faults, t_s, rng)
    shift = np.cumsum(velocity, axis=0) * dt + _jump(faults, n, rng)
    return replace(course, T_dock_cam=poses(R_dock_cam, course.T_dock_cam[:, :3, 3] + shift))


def _turns(faults: PointFaults, t_s: Array, rng: np.random.Generator) -> Array:
    """Yaw (N,) degrees."""
    yaw, rate = np.zeros(len(t_s)), faults.turn_deg_s
    begin = rng.uniform(1.0, 3.0)
    while rate and begin < t_s[-1]:
        there = np.clip((t_s - begin) * rate, 0.0, _TURN_DEG)
        back = np.clip((t_s - begin - _HOLD_S) * rate, 0.0, _TURN_DEG)
        yaw += rng.choice([-1.0, 1.0]) * (there - back)
        begin += rng.uniform(*_EVERY_S)
    return yaw


def _direction(rng: np.random.Generator) -> Array:
    way = rng.normal(size=3)
    return np.asarray(way / np.linalg.norm(way))


def _pulses(faults: PointFaults, t_s: Array, rng: np.random.Generator) -> Array:
    """Acceleration (N, 3) m/s^2: a pulse, its opposite twice as long, and the pulse again, so that none drifts off."""
    accel, begin = np.zeros((len(t_s), 3)), rng.uniform(1.0, 3.0)
    while faults.jerk_m_s2[1] and begin < t_s[-1]:
        length, pulse = rng.uniform(*_PULSE_S), rng.uniform(*faults.jerk_m_s2) * _direction(rng)
        for first, last, sign in ((0, 1, 1.0), (1, 3, -1.0), (3, 4, 1.0)):
            accel[(t_s >= begin + first * length) & (t_s < begin + last * length)] += sign * pulse
        begin += 4.0 * length + rng.uniform(*_REST_S)
    return accel


def _bumps(faults: PointFaults, t_s: Array, rng: np.random.Generator) -> Array:
    """Velocity (N, 3) m/s that sets in and ends at once."""
    velocity = np.zeros((len(t_s), 3))
    if faults.bump_m_s[1]:
        for begin in rng.uniform(2.0, max(float(t_s[-1]) - 4.0, 2.0), _BUMPS):
            hit = (t_s >= begin) & (t_s < begin + _BUMP_S)
            velocity[hit] += rng.uniform(*faults.bump_m_s) * _direction(rng)
    return velocity


def _jump(faults: PointFaults, n: int, rng: np.random.Generator) -> Array:
    """Shift (N, 3) m from some frame on."""
    shift, first = np.zeros((n, 3)), int(rng.uniform(0.25, 0.7) * n)
    shift[first:] = rng.uniform(*faults.jump_m) * _direction(rng)
    return shift


def stamps_ns(course: Course, faults: PointFaults, rng: np.random.Generator) -> np.ndarray:
    """Stamps (N,) as the camera gives them, in their order."""
    off_ns = np.round(rng.uniform(-1.0, 1.0, len(course.t_ns)) * faults.jitter_s * 1e9).astype(np.int64)
    late = np.maximum.accumulate(course.t_ns + off_ns)
    return np.asarray(late + 1000 * np.arange(len(late))) if faults.jitter_s else course.t_ns


def arriving(t_s: Array, faults: PointFaults, rng: np.random.Generator) -> np.ndarray:
    """Which frames (N,) arrive."""
    kept, begin = np.ones(len(t_s), bool), rng.uniform(1.0, 2.0)
    while faults.gap_s[1] and begin < t_s[-1]:
        length = rng.uniform(*faults.gap_s)
        kept[(t_s > begin) & (t_s < begin + length)] = False
        begin += length + rng.uniform(*_BETWEEN_GAPS_S)
    return kept
