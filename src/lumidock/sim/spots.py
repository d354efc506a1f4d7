"""Bare detections without rendering: projected lights with noise, missing and spurious ones, and their truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Detections, Indices
from lumidock.geometry import se3_inverse, transform_points
from lumidock.pose import project_lights
from lumidock.sim.scenario import Scenario, spurious_paths, trajectory
from lumidock.station import Station


@dataclass(frozen=True, slots=True, eq=False)
class SpotFrame:
    """One frame's detections and their truth.

    Pose `T_dock_cam` (4, 4); the `light` (N,) behind each detection, -1 for a spurious one; the true pixels `uv` (M, 2)
    of all lights, and which of them are `in_view` (M,) before any go dark.
    """

    detections: Detections
    T_dock_cam: Array
    light: Indices
    uv: Array
    in_view: np.ndarray


def in_view(station: Station, camera: Camera, T_dock_cam: Array) -> tuple[Array, np.ndarray]:
    """Pixels (M, 2) of all lights and which of them (M,) lie in the picture and shine toward the camera."""
    uv = project_lights(camera, T_dock_cam, station.p_dock)
    return uv, camera.contains(uv) & (emission_cosine(station, T_dock_cam) > 0.0)


def emission_cosine(station: Station, T_dock_cam: Array) -> Array:
    """Cosine (M,) of the angle between each lamp's axis and the direction to the camera."""
    to_camera = T_dock_cam[:3, 3] - station.p_dock
    return np.asarray((to_camera * station.axis).sum(axis=1) / np.linalg.norm(to_camera, axis=1))


def spot_frames(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Iterator[SpotFrame]:
    """All frames of a scenario as bare detections, in the order the lights have with the spurious ones last."""
    rng = np.random.default_rng([seed, 1])
    t_ns, poses = trajectory(scenario, np.random.default_rng([seed, 0]))
    strays = spurious_paths(scenario, t_ns, (camera.width, camera.height), np.random.default_rng([seed, 2]))
    for number, (t, T_dock_cam, stray) in enumerate(zip(t_ns, poses, strays, strict=True)):
        yield _spot_frame(scenario, station, camera, f"{number:06d}", int(t), T_dock_cam, stray, rng)


def _spot_frame(
    scenario: Scenario,
    station: Station,
    camera: Camera,
    name: str,
    t_ns: int,
    T_dock_cam: Array,
    stray: Array,
    rng: np.random.Generator,
) -> SpotFrame:
    front = station.lights_of(station.layers_front_to_rear()[0])
    is_front = np.isin(np.arange(len(station)), front)
    uv, visible = in_view(station, camera, T_dock_cam)
    distance = np.linalg.norm(transform_points(se3_inverse(T_dock_cam), station.p_dock), axis=1)
    visible &= distance < np.where(is_front, scenario.spots.front_range_m, scenario.spots.rear_range_m)
    lit = visible.copy()
    lit[dark_lights(scenario, front[visible[front]], rng)] = False
    light = np.concatenate([np.flatnonzero(lit), np.full(len(stray), -1)]).astype(np.int64)
    seen = np.concatenate([uv[lit], stray])
    seen = seen + rng.normal(0.0, 1.0, seen.shape) * scenario.spots.noise_px
    rear = (light >= 0) & ~is_front[light]
    rear ^= rng.random(len(light)) < scenario.spots.wrong_layer
    detections = Detections.from_uv(name, t_ns, seen, p_rear=np.where(rear, 0.95, 0.05))
    return SpotFrame(detections, T_dock_cam, light, uv, visible)


def dark_lights(scenario: Scenario, front_in_view: Indices, rng: np.random.Generator) -> Indices:
    """Which of the front lights in view are dark in this frame."""
    count = min(scenario.faults.missing, len(front_in_view))
    return np.asarray(rng.choice(front_in_view, count, replace=False)) if count else np.empty(0, np.int64)
