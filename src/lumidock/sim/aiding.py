"""What gyro, DVL, depth and tilt sensors of the vehicle measure along a scenario's path."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lumidock.datatypes import AidingMeasurement, Array, SensorKind
from lumidock.sim.course import Course
from lumidock.sim.draws import Draw
from lumidock.sim.knobs import AidingKnobs, SensorKnobs
from lumidock.sim.scenario import Scenario, rotations, trajectory

_STEP_S = 0.005  # between the true poses that rates and velocities are taken from


class _Motion(NamedTuple):
    """True motion at N times `t_s` (N,), in axes of `cam`: rates, velocities over ground, directions upward; height."""

    t_s: Array
    rate: Array
    velocity: Array
    upward: Array
    height_m: Array


def sensor_values(scenario: Scenario, course: Course, seed: int) -> list[tuple[AidingMeasurement, ...]]:
    """What the sensors have said before each of the N frames of a course since the frame before.

    A path of draws has no motion, and no values.
    """
    knobs = scenario.detections.aiding
    stamps = course.t_ns.tolist()
    values: list[list[AidingMeasurement]] = [[] for _ in stamps]
    if knobs is None or scenario.path.kind == "draws":
        return [() for _ in stamps]
    for one in measured(scenario, knobs, seed):
        frame = bisect_right(stamps, one.t_ns - 1)  # the first frame that is not before it
        if frame < len(values):
            values[frame].append(one)
    return [tuple(group) for group in values]


def measured(scenario: Scenario, knobs: AidingKnobs, seed: int) -> Iterator[AidingMeasurement]:
    """All values of all sensors in the order of their stamps."""
    _, poses = trajectory(scenario, np.random.default_rng([seed, Draw.COURSE]), interval_s=_STEP_S, rocking=False)
    motion = _motion(poses)
    sensors: dict[SensorKind, SensorKnobs | None] = {
        "gyro": knobs.gyro,
        "velocity": knobs.velocity,
        "depth": knobs.depth,
        "tilt": knobs.tilt,
    }
    found: list[AidingMeasurement] = []
    for number, (kind, sensor) in enumerate(sensors.items()):
        if sensor is not None:
            found += _values(kind, sensor, motion, np.random.default_rng([seed, Draw.AIDING, number]))
    yield from sorted(found, key=lambda one: one.t_ns)


def _motion(T: Sequence[Array] | Array) -> _Motion:
    """The motion between successive true poses (N + 1, 4, 4)."""
    T = np.asarray(T)
    R, t = T[:, :3, :3], T[:, :3, 3]
    D = R[:-1].transpose(0, 2, 1) @ R[1:]
    rate = 0.5 * np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], axis=1)
    velocity = (R[:-1].transpose(0, 2, 1) @ np.diff(t, axis=0)[:, :, None])[:, :, 0]
    t_s = (np.arange(len(D)) + 0.5) * _STEP_S
    return _Motion(t_s, rate / _STEP_S, velocity / _STEP_S, R[:-1, 1], t[:-1, 1])


def _values(kind: SensorKind, how: SensorKnobs, motion: _Motion, rng: np.random.Generator) -> list[AidingMeasurement]:
    """Values of one sensor: late, turned by its mount, scaled, biased and noisy."""
    bias, direction, phase_s = rng.normal(size=3) * how.bias, rng.normal(size=3), rng.random() / how.rate_hz
    scale = 1.0 + how.scale * rng.normal()
    R_mount = rotations((np.deg2rad(how.mount_deg) * direction / np.linalg.norm(direction))[None])[0]
    t_s = np.arange(phase_s, motion.t_s[-1], 1.0 / how.rate_hz)
    wrong = (t_s >= how.wrong_from_s)[:, None]
    true = {
        "gyro": motion.rate,
        "velocity": motion.velocity,
        "depth": -motion.height_m[:, None],
        "tilt": motion.upward,
    }[kind]
    now = np.stack([np.interp(t_s, motion.t_s, column) for column in true.T], axis=1)
    if kind != "depth":
        now = now @ R_mount
    k = now.shape[1]
    now = now * (scale + wrong * how.wrong_scale) + bias[:k] + wrong * np.array(how.wrong_bias)[:k]
    now += rng.normal(size=now.shape) * how.noise
    stamps = np.round((t_s + how.late_s) * 1e9).astype(np.int64).tolist()
    return [
        AidingMeasurement(kind, t_ns, tuple(value), how.noise)
        for t_ns, value in zip(stamps, now.tolist(), strict=True)
        if t_ns >= 0
    ]
