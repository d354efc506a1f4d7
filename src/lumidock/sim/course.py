"""True poses of the camera in every frame: along the path of a scenario, or drawn at random with the dock in view.

A scenario with a path is one run; with a path of draws every draw is a run. Shapes: N frames, G runs, M lights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.errors import InputError
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, Path3D, Scenario, draw_stamps, poses, rotations, trajectory
from lumidock.station import Station

_MAX_ROUNDS = 2000  # attempts at drawing poses that have the front layer in view
_EDGE_PX = 20.0  # margin of the picture in draws, so that calibration errors do not move a light out of it
# draws that show the mirror image: largest x and y, least depth below the surface, largest error of the pitch
_MIRROR_SIDE_M, _MIRROR_DEPTH_M, _MIRROR_AIM_DEG = 1.0, 0.5, 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Stamps and true poses of the camera in N frames of G runs.

    `t_ns` (N,), `T_dock_cam` (N, 4, 4), the `run` (N,) of each frame and its number `step` (N,) in that run;
    `missing_from` (N,) is the frame whose missing lights are missing in this one too; `surface_m` (G,) is the height of
    the water surface above the dock's origin.
    """

    t_ns: np.ndarray
    T_dock_cam: Array
    run: Indices
    step: Indices
    missing_from: Indices
    surface_m: Array


def course_of(scenario: Scenario, station: Station, camera: Camera, rng: np.random.Generator) -> Course:
    """The course of a scenario. Raises: InputError when no pose has the front layer in view."""
    path = scenario.path
    if path.kind == "draws":
        T_dock_cam, surface_m = _draws(scenario, station, camera, rng)
        run, step = np.divmod(np.arange(path.count * path.hold), path.hold)
        stamps = draw_stamps(path).ravel()
        return Course(stamps, T_dock_cam.reshape(-1, 4, 4), run, step, run * path.hold, surface_m)
    t_ns, T_dock_cam = trajectory(scenario, rng)
    frames = np.arange(len(t_ns))
    return Course(t_ns, T_dock_cam, np.zeros_like(frames), frames, frames, np.array([np.inf]))


def _draws(scenario: Scenario, station: Station, camera: Camera, rng: np.random.Generator) -> tuple[Array, Array]:
    """Poses T_dock_cam (count, hold, 4, 4) with all front lights in view; heights (count,) m of the water surface."""
    path = scenario.path
    z_m, surface_m = rng.uniform(*path.z_m, path.count), rng.uniform(*scenario.detections.surface_m, path.count)
    T_dock_cam, todo = np.empty((path.count, path.hold, 4, 4)), np.arange(path.count)
    for _ in range(_MAX_ROUNDS):
        if scenario.detections.mirror == "only":
            drawn = _poses_facing_mirror(path, z_m[todo], surface_m[todo], rng)
        else:
            drawn = _poses_facing_dock(path, camera, z_m[todo], rng)
        held = _continued(path, drawn, rng)
        good = _front_in_view(scenario, station, camera, held, surface_m[todo])
        T_dock_cam[todo[good]], todo = held[good], todo[~good]
        if not len(todo):
            return T_dock_cam, surface_m
    raise InputError(f"{scenario.name}: no pose at {z_m[todo[0]]:.2f} m has all lights of the front layer in view")


def _poses_facing_dock(path: Path3D, camera: Camera, z_m: Array, rng: np.random.Generator) -> Array:
    """Poses T_dock_cam (n, 4, 4) at `z_m` (n,) whose pictures show the dock's origin at a uniformly drawn pixel."""
    R_dock_cam = _drawn_attitudes(path, len(z_m), rng)
    uv = rng.uniform(0.0, 1.0, (len(z_m), 2)) * [camera.width, camera.height] - 0.5
    ray_dock = (R_dock_cam @ camera.unproject(uv)[:, :, None])[:, :, 0]
    ray_dock[ray_dock[:, 2] >= -0.01] = np.nan  # the dock's plane is behind the camera or seen edge-on
    return poses(R_dock_cam, ray_dock * (z_m / ray_dock[:, 2])[:, None])


def _drawn_attitudes(path: Path3D, n: int, rng: np.random.Generator) -> Array:
    """Attitudes R_dock_cam (n, 3, 3): the tilt, then the roll about the optical axis."""
    w = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.turn_deg)
    roll = w * [0.0, 0.0, 1.0]
    if path.tilt_deg is not None:
        angle, direction = rng.uniform(0.0, np.deg2rad(path.tilt_deg), n), rng.uniform(0.0, 2 * np.pi, n)
        w[:, 0], w[:, 1] = angle * np.cos(direction), angle * np.sin(direction)
    return np.asarray(R_DOCK_CAM_HEAD_ON @ rotations(w - roll) @ rotations(roll))


def _poses_facing_mirror(path: Path3D, z_m: Array, surface_m: Array, rng: np.random.Generator) -> Array:
    """Poses T_dock_cam (n, 4, 4) below the surface, pitched up toward the mirror image of the dock."""
    n, aim = len(z_m), np.deg2rad(_MIRROR_AIM_DEG)
    x = rng.uniform(-_MIRROR_SIDE_M, _MIRROR_SIDE_M, n)
    y = rng.uniform(-_MIRROR_SIDE_M, np.minimum(surface_m - _MIRROR_DEPTH_M, _MIRROR_SIDE_M))
    pitch, still = np.arctan2(2.0 * surface_m - y, z_m) + rng.uniform(-aim, aim, n), np.zeros(n)
    R_pitch = rotations(np.stack([pitch, still, still], axis=1))
    R_turn = rotations(rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.turn_deg))
    return poses(R_DOCK_CAM_HEAD_ON @ R_pitch @ R_turn, np.stack([x, y, z_m], axis=1))


def _continued(path: Path3D, drawn: Array, rng: np.random.Generator) -> Array:
    """Poses T_dock_cam (n, hold, 4, 4): from each of `drawn` (n, 4, 4) on the camera moves ahead and turns slowly."""
    n, t_s = len(drawn), np.arange(path.hold) * path.frame_interval_s
    velocity = path.speed_m_s * np.stack([*(0.2 * rng.normal(size=(2, n))), np.full(n, -1.0)], axis=1)
    rate = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.hold_deg_s)
    turn = rotations((rate[:, None] * t_s[:, None]).reshape(-1, 3)).reshape(n, path.hold, 3, 3)
    position = drawn[:, None, :3, 3] + velocity[:, None] * t_s[:, None]
    R_dock_cam = drawn[:, None, :3, :3] @ turn
    return poses(R_dock_cam.reshape(-1, 3, 3), position.reshape(-1, 3)).reshape(n, path.hold, 4, 4)


def _front_in_view(scenario: Scenario, station: Station, camera: Camera, held: Array, surface_m: Array) -> np.ndarray:
    """Which of the poses `held` (n, K, 4, 4) show the whole front layer, or its mirror image, in all K frames: (n,)."""
    n, k = held.shape[:2]
    front = station.lights_of(station.layers_front_to_rear()[0])
    p_dock, T_dock_cam = np.broadcast_to(station.p_dock[front], (n * k, len(front), 3)), held.reshape(-1, 4, 4)
    if scenario.detections.mirror == "only":
        p_dock = mirror_image(p_dock, np.repeat(surface_m, k))
    uv, p_cam = project_each(camera, T_dock_cam, p_dock)
    shining = shines(station.axis[front], scenario, T_dock_cam, p_dock)
    good = camera.contains(uv, margin_px=_EDGE_PX) & (p_cam[..., 2] > 0.0) & shining
    return np.asarray(good.reshape(n, -1).all(axis=1))


def mirror_image(p_dock: Array, surface_m: Array) -> Array:
    """Mirror images (N, M, 3) of points `p_dock` (N, M, 3) in a water surface at y = `surface_m` (N,) in `dock`."""
    image = p_dock * [1.0, -1.0, 1.0]
    image[:, :, 1] += 2.0 * surface_m[:, None]
    return image


def project_each(camera: Camera, T_dock_cam: Array, p_dock: Array) -> tuple[Array, Array]:
    """Pixels (N, M, 2) and `p_cam` (N, M, 3) of points `p_dock` (N, M, 3), for each frame from its pose (N, 4, 4)."""
    p_cam = (p_dock - T_dock_cam[:, None, :3, 3]) @ T_dock_cam[:, :3, :3]
    return camera.project(p_cam.reshape(-1, 3)).reshape(*p_dock.shape[:2], 2), p_cam


def shines(axis: Array, scenario: Scenario, T_dock_cam: Array, p_dock: Array) -> np.ndarray:
    """Which lights (N, M), or mirror images of them, shine toward the camera; `axis` (M, 3) are those of the lights."""
    if scenario.detections.mirror == "only":
        axis = axis * [1.0, -1.0, 1.0]
    return np.asarray(((T_dock_cam[:, None, :3, 3] - p_dock) * axis).sum(axis=2) > 0.0)
