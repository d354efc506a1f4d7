"""Bare detections without rendering: projected lights with noise, missing and spurious ones, and their truth.

All frames of a run are made at once, as arrays: N frames, G runs (one, or as many as there are draws), M lights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Attitude, Detections, Indices
from lumidock.errors import InputError
from lumidock.pose import project_lights
from lumidock.sim.measured import Looks, SpotTable, as_measured, detector_errors, with_false
from lumidock.sim.scenario import (
    R_DOCK_CAM_HEAD_ON,
    BlackOuts,
    Path3D,
    Scenario,
    draw_stamps,
    poses,
    rotations,
    spurious_paths,
    trajectory,
)
from lumidock.station import Station

_MAX_ROUNDS = 2000  # of drawing poses until all have the front layer in view
_EDGE_PX = 20.0  # kept clear in draws, so that no error of the lens puts a light outside
_MIRROR_SIDE_M, _MIRROR_DEPTH_M, _MIRROR_AIM_DEG = 1.0, 0.5, 15.0
_P_REAR = (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class SpotFrame:
    """One frame's detections and their truth.

    Pose `T_dock_cam` (4, 4); the `light` (N,) behind each detection, -1 for a spurious one; the true pixels `uv` (M, 2)
    of all lights where they really stand, through the lens as it really is, and which of them are `in_view` (M,) before
    any go dark. It is frame `step` of sequence number `sequence`; with step 0 there is no history to be used.
    """

    detections: Detections
    T_dock_cam: Array
    light: Indices
    uv: Array
    in_view: np.ndarray
    sequence: int = 0
    step: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Where the camera is, in N frames of G runs.

    `t_ns` (N,), `T_dock_cam` (N, 4, 4), the `run` (N,) that each frame belongs to and its `step` (N,) there;
    `missing_from` (N,) is the frame with the same missing lights; `surface_m` (G,) how high the water stands.
    """

    t_ns: np.ndarray
    T_dock_cam: Array
    run: Indices
    step: Indices
    missing_from: Indices
    surface_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """What stays so through a run; G runs, M lights, N frames.

    Where the lights really are, `p_dock` (G, M, 3) m, how far they are seen, `reach_m` (G, M), and which are `dead`
    (G, M); relative `focal` (G,) and `center_px` (G, 2) errors of the lens; which frames are `black` (N,).
    """

    p_dock: Array
    reach_m: Array
    dead: np.ndarray
    focal: Array
    center_px: Array
    black: np.ndarray


def in_view(station: Station, camera: Camera, T_dock_cam: Array) -> tuple[Array, np.ndarray]:
    """Pixels (M, 2) of all lights and which of them (M,) lie in the picture and shine toward the camera."""
    uv = project_lights(camera, T_dock_cam, station.p_dock)
    return uv, camera.contains(uv) & (emission_cosine(station.p_dock, station.axis, T_dock_cam[:3, 3]) > 0.0)


def emission_cosine(p_dock: Array, axis: Array, t_dock_cam: Array) -> Array:
    """Cosine (M,) of the angle between the `axis` (M, 3) of lamps at `p_dock` (M, 3) and the way to the camera."""
    to_camera = t_dock_cam - p_dock
    return np.asarray((to_camera * axis).sum(axis=1) / np.linalg.norm(to_camera, axis=1))


def dark_lights(scenario: Scenario, front_in_view: Indices, rng: np.random.Generator) -> Indices:
    """Which of the front lights in view are dark in this frame."""
    count = min(int(rng.integers(*scenario.faults.missing, endpoint=True)), len(front_in_view))
    return np.asarray(rng.choice(front_in_view, count, replace=False)) if count else np.empty(0, np.int64)


def spot_frames(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Iterator[SpotFrame]:
    """All frames of a scenario as bare detections, in the order the lights have with the spurious ones last.

    Raises: InputError when no pose has the front layer in view.
    """
    course = course_of(scenario, station, camera, np.random.default_rng([seed, 0]))
    world = world_of(scenario, station, course, np.random.default_rng([seed, 4]))
    wander = _wandering(scenario, camera, course, np.random.default_rng([seed, 2]))
    rng = np.random.default_rng([seed, 1])
    uv, visible, range_m = _shown(scenario, station, camera, course, world)
    lit = visible & ~_dark(scenario, station, course, world, visible, rng)
    strays = _strays(scenario, world, wander, _box(scenario, camera, uv, visible), rng)
    errors = detector_errors(scenario.spots.detector) if scenario.spots.detector else None
    detector_rng = np.random.default_rng([seed, 15])
    if errors:
        lit &= errors.found(_is_rear(station), range_m, detector_rng)
    spots = _in_a_row(uv, lit, strays, range_m, scenario.shows_dock)
    if errors:
        dock_m = np.linalg.norm(course.T_dock_cam[:, :3, 3], axis=1)
        spots = with_false(spots, errors, np.where(world.black, np.nan, dock_m), camera, detector_rng)
    attitudes = _attitudes(scenario, course, np.random.default_rng([seed, 5]))
    if not scenario.shows_dock:
        uv, visible = _unseen(scenario, camera, course, world, uv), np.zeros_like(visible)
    noise = rng.normal(0.0, 1.0, spots.uv.shape) * scenario.spots.noise_px
    sure, p_rear = np.ones(len(noise)), _p_rear(scenario, station, spots.light, rng)
    looks = Looks(noise, None, sure, p_rear)
    if errors:
        looks = as_measured(errors, looks, spots, _is_rear(station), scenario.spots.noise_px, detector_rng)
    detections = _detections(course, spots, looks, attitudes)
    ends = _ends(course, spots)
    light = [spots.light[a:b] for a, b in pairwise(ends)]
    yield from map(
        SpotFrame, detections, course.T_dock_cam, light, uv, visible, course.run.tolist(), course.step.tolist()
    )


def course_of(scenario: Scenario, station: Station, camera: Camera, rng: np.random.Generator) -> Course:
    """The camera's way. Raises: InputError when no pose has the front layer in view."""
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
    """Poses (count, hold, 4, 4) with all front lights in view, and the water's surface (count,) above the dock."""
    path = scenario.path
    z_m, surface_m = rng.uniform(*path.z_m, path.count), rng.uniform(*scenario.spots.surface_m, path.count)
    T_dock_cam, todo = np.empty((path.count, path.hold, 4, 4)), np.arange(path.count)
    for _ in range(_MAX_ROUNDS):
        if scenario.spots.mirror == "only":
            drawn = _looking_up(path, z_m[todo], surface_m[todo], rng)
        else:
            drawn = _looking_around(path, camera, z_m[todo], rng)
        held = _held(path, drawn, rng)
        good = _front_in_view(scenario, station, camera, held, surface_m[todo])
        T_dock_cam[todo[good]], todo = held[good], todo[~good]
        if not len(todo):
            return T_dock_cam, surface_m
    raise InputError(f"{scenario.name}: no pose at {z_m[todo[0]]:.2f} m has all lights of the front layer in view")


def _looking_around(path: Path3D, camera: Camera, z_m: Array, rng: np.random.Generator) -> Array:
    """Poses (n, 4, 4) at `z_m` (n,), the dock's origin anywhere in the picture, each place as likely."""
    R_dock_cam = _turned(path, len(z_m), rng)
    uv = rng.uniform(0.0, 1.0, (len(z_m), 2)) * [camera.width, camera.height] - 0.5
    ray_dock = (R_dock_cam @ camera.unproject(uv)[:, :, None])[:, :, 0]
    ray_dock[ray_dock[:, 2] >= -0.01] = np.nan  # the dock's plane is behind, or seen edge on
    return poses(R_dock_cam, ray_dock * (z_m / ray_dock[:, 2])[:, None])


def _turned(path: Path3D, n: int, rng: np.random.Generator) -> Array:
    """Attitudes (n, 3, 3): first the tilt, then the roll about the camera's own axis."""
    w = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.turn_deg)
    roll = w * [0.0, 0.0, 1.0]
    if path.tilt_deg is not None:
        angle, direction = rng.uniform(0.0, np.deg2rad(path.tilt_deg), n), rng.uniform(0.0, 2 * np.pi, n)
        w[:, 0], w[:, 1] = angle * np.cos(direction), angle * np.sin(direction)
    return np.asarray(R_DOCK_CAM_HEAD_ON @ rotations(w - roll) @ rotations(roll))


def _looking_up(path: Path3D, z_m: Array, surface_m: Array, rng: np.random.Generator) -> Array:
    """Poses (n, 4, 4) below the surface, pitched toward the place where it mirrors the dock."""
    n, aim = len(z_m), np.deg2rad(_MIRROR_AIM_DEG)
    x = rng.uniform(-_MIRROR_SIDE_M, _MIRROR_SIDE_M, n)
    y = rng.uniform(-_MIRROR_SIDE_M, np.minimum(surface_m - _MIRROR_DEPTH_M, _MIRROR_SIDE_M))
    pitch, still = np.arctan2(2.0 * surface_m - y, z_m) + rng.uniform(-aim, aim, n), np.zeros(n)
    R_pitch = rotations(np.stack([pitch, still, still], axis=1))
    R_turn = rotations(rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.turn_deg))
    return poses(R_DOCK_CAM_HEAD_ON @ R_pitch @ R_turn, np.stack([x, y, z_m], axis=1))


def _held(path: Path3D, drawn: Array, rng: np.random.Generator) -> Array:
    """Poses (n, hold, 4, 4) that follow from each of `drawn` (n, 4, 4): mostly ahead, turning slowly."""
    n, t_s = len(drawn), np.arange(path.hold) * path.frame_interval_s
    velocity = path.speed_m_s * np.stack([*(0.2 * rng.normal(size=(2, n))), np.full(n, -1.0)], axis=1)
    rate = rng.uniform(-1.0, 1.0, (n, 3)) * np.deg2rad(path.hold_deg_s)
    turn = rotations((rate[:, None] * t_s[:, None]).reshape(-1, 3)).reshape(n, path.hold, 3, 3)
    position = drawn[:, None, :3, 3] + velocity[:, None] * t_s[:, None]
    R_dock_cam = drawn[:, None, :3, :3] @ turn
    return poses(R_dock_cam.reshape(-1, 3, 3), position.reshape(-1, 3)).reshape(n, path.hold, 4, 4)


def _front_in_view(scenario: Scenario, station: Station, camera: Camera, held: Array, surface_m: Array) -> np.ndarray:
    """Which of `held` (n, K, 4, 4) have the whole front layer, or its mirror image, in view in all K frames: (n,)."""
    n, k = held.shape[:2]
    front = station.lights_of(station.layers_front_to_rear()[0])
    p_dock, T_dock_cam = np.broadcast_to(station.p_dock[front], (n * k, len(front), 3)), held.reshape(-1, 4, 4)
    if scenario.spots.mirror == "only":
        p_dock = _mirrored(p_dock, np.repeat(surface_m, k))
    uv, p_cam = _project(camera, T_dock_cam, p_dock)
    shining = _shining(station.axis[front], scenario, T_dock_cam, p_dock)
    good = camera.contains(uv, margin_px=_EDGE_PX) & (p_cam[..., 2] > 0.0) & shining
    return np.asarray(good.reshape(n, -1).all(axis=1))


def _mirrored(p_dock: Array, surface_m: Array) -> Array:
    """Where points (N, M, 3) are seen in a water surface `surface_m` (N,) above the dock's origin."""
    image = p_dock * [1.0, -1.0, 1.0]
    image[:, :, 1] += 2.0 * surface_m[:, None]
    return image


def _project(camera: Camera, T_dock_cam: Array, p_dock: Array) -> tuple[Array, Array]:
    """Pixels (N, M, 2) and camera coordinates (N, M, 3) of points `p_dock` (N, M, 3), each frame's from its pose."""
    p_cam = (p_dock - T_dock_cam[:, None, :3, 3]) @ T_dock_cam[:, :3, :3]
    return camera.project(p_cam.reshape(-1, 3)).reshape(*p_dock.shape[:2], 2), p_cam


def _shining(axis: Array, scenario: Scenario, T_dock_cam: Array, p_dock: Array) -> np.ndarray:
    """Which lights (N, M), or mirror images of them, send light toward the camera; `axis` (M, 3)."""
    if scenario.spots.mirror == "only":
        axis = axis * [1.0, -1.0, 1.0]
    return np.asarray(((T_dock_cam[:, None, :3, 3] - p_dock) * axis).sum(axis=2) > 0.0)


def world_of(scenario: Scenario, station: Station, course: Course, rng: np.random.Generator) -> World:
    """What the run's draws decide; without survey and calibration errors, what the station and the camera say."""
    g, m, spots = len(course.surface_m), len(station), scenario.spots
    off = rng.normal(size=(g, m, 3)) * station.sigma_light_m
    off += (rng.normal(size=(g, len(station.layers), 3)) * station.sigma_layer_m)[:, station.layer]
    front = ~_is_rear(station)
    front_m, rear_m = (rng.uniform(*reach, (g, 1)) for reach in (spots.front_range_m, spots.rear_range_m))
    lens = rng.normal(size=(g, 3)) * [station.sigma_focal, station.sigma_center_px, station.sigma_center_px]
    lens *= spots.calibration
    return World(
        p_dock=station.p_dock + off * spots.survey,
        reach_m=np.where(front, front_m, rear_m) if not spots.detector else np.full((g, m), np.inf),
        dead=_some(np.ones((g, m), bool), rng.integers(*spots.dead, g, endpoint=True), rng),
        focal=lens[:, 0] + scenario.lens.focal_error,
        center_px=lens[:, 1:],
        black=_black(spots.black_outs, course.t_ns * 1e-9, rng),
    )


def _some(among: np.ndarray, count: Indices, rng: np.random.Generator) -> np.ndarray:
    """In each row of `among` (n, M), `count` (n,) of those that are true, or all of them: (n, M)."""
    keys = np.where(among, rng.random(among.shape), 2.0)
    return np.asarray(among & (keys.argsort(axis=1).argsort(axis=1) < count[:, None]))


def _black(knobs: BlackOuts, t_s: Array, rng: np.random.Generator) -> np.ndarray:
    """Which frames (N,), `t_s` after the start, are black."""
    n = rng.integers(*knobs.count, endpoint=True)
    start, length = rng.uniform(0.0, t_s[-1], n), rng.uniform(*knobs.length_s, n)
    black = np.zeros(len(t_s), bool)
    for first, last in (*knobs.at_s, *zip(start, start + length, strict=True)):
        black |= (t_s >= first) & (t_s <= last)
    return black


def _shown(
    scenario: Scenario, station: Station, camera: Camera, course: Course, world: World
) -> tuple[Array, np.ndarray, Array]:
    """True pixels (N, M, 2) of all lights, or of their mirror images, which (N, M) can be seen, and ranges (N, M) m."""
    p_dock = world.p_dock[course.run]
    if scenario.spots.mirror == "only":
        p_dock = _mirrored(p_dock, course.surface_m[course.run])
    uv, p_cam = _project(camera, course.T_dock_cam, p_dock)
    uv = _through_lens(camera, course, world, uv)
    range_m = np.linalg.norm(p_cam, axis=2)
    seen = camera.contains(uv) & (range_m < world.reach_m[course.run]) & shown_layers(scenario, station)
    shining = _shining(station.axis, scenario, course.T_dock_cam, p_dock)
    return uv, seen & shining & scenario.spots.dock, range_m


def shown_layers(scenario: Scenario, station: Station) -> np.ndarray:
    """Which lights (M,) belong to a layer that shines."""
    front = ~_is_rear(station)
    return np.asarray({"all": np.ones_like(front), "front": front, "rear": ~front}[scenario.lamps.layers])


def failed(scenario: Scenario, station: Station, t_s: Array) -> np.ndarray:
    """Which lights (N, M) have failed by the times `t_s` (N,) since the start."""
    end_s = np.array([scenario.lamps.failures.get(light, np.inf) for light in station.ids])
    return np.asarray(t_s[:, None] >= end_s)


def _through_lens(camera: Camera, course: Course, world: World, uv: Array) -> Array:
    """Pixels (N, M, 2) as the lens really makes them, of those that the calibration says."""
    scale = 1.0 + world.focal[course.run, None, None]
    return np.asarray((uv - camera.center_px) * scale + camera.center_px + world.center_px[course.run, None])


def _unseen(scenario: Scenario, camera: Camera, course: Course, world: World, uv: Array) -> Array:
    """True pixels (N, M, 2) of a dock that is not seen; NaN when there is none."""
    if not scenario.spots.dock:
        return np.full_like(uv, np.nan)
    return _through_lens(camera, course, world, _project(camera, course.T_dock_cam, world.p_dock[course.run])[0])


def _dark(
    scenario: Scenario,
    station: Station,
    course: Course,
    world: World,
    visible: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Which lights (N, M) make no spot although nothing hides them."""
    front = ~_is_rear(station)
    count = rng.integers(*scenario.faults.missing, len(visible), endpoint=True)
    missing = _some(visible & front, count, rng)[course.missing_from]
    dropped = rng.random(visible.shape) < scenario.spots.drop
    off = failed(scenario, station, course.t_ns * 1e-9)
    return np.asarray(missing | dropped | world.dead[course.run] | world.black[:, None] | off)


def _box(scenario: Scenario, camera: Camera, uv: Array, visible: np.ndarray) -> tuple[Array, Array]:
    """Corners (N, 2) of where spurious spots are drawn: the picture, or the box of the array and 50 % around it."""
    low, high = np.full((len(uv), 2), -0.5), np.tile([camera.width - 0.5, camera.height - 0.5], (len(uv), 1))
    if scenario.spots.place == "picture":
        return low, high
    least = np.where(visible[..., None], uv, np.inf).min(axis=1)
    most = np.where(visible[..., None], uv, -np.inf).max(axis=1)
    some = visible.any(axis=1)
    margin = 0.25 * (most[some] - least[some])
    low[some] = np.maximum(low[some], least[some] - margin)
    high[some] = np.minimum(high[some], most[some] + margin)
    return low, high


def _wandering(scenario: Scenario, camera: Camera, course: Course, rng: np.random.Generator) -> Array:
    """Pixels (N, W, 2) of the spurious spots that wander through a run; in draws there are none."""
    if scenario.path.kind == "draws":
        return np.empty((len(course.t_ns), 0, 2))
    return spurious_paths(scenario, course.t_ns, (camera.width, camera.height), rng)


def _strays(
    scenario: Scenario, world: World, wander: Array, box: tuple[Array, Array], rng: np.random.Generator
) -> tuple[Indices, Array]:
    """Frame (S,) and pixels (S, 2) of all spurious spots: those that `wander` (N, W, 2), and those drawn anew."""
    n = len(wander)
    new = rng.poisson(scenario.spots.clutter, n)
    if scenario.path.kind == "draws":
        new += rng.integers(*scenario.faults.spurious, n, endpoint=True)
    frame = np.repeat(np.arange(n), new)
    low, high = box
    uv = low[frame] + rng.random((len(frame), 2)) * (high - low)[frame]
    frame = np.concatenate([np.repeat(np.arange(n), wander.shape[1]), frame])
    uv = np.concatenate([wander.reshape(-1, 2), uv])
    clear = ~world.black[frame]
    return frame[clear], uv[clear]


def _in_a_row(uv: Array, lit: np.ndarray, strays: tuple[Indices, Array], range_m: Array, named: bool) -> SpotTable:
    """The lit lights and the spurious spots, frame by frame; of lights that are not `named` none is known."""
    frame, light = np.nonzero(lit)
    seen, nothing = np.concatenate([uv[frame, light], strays[1]]), np.full(len(strays[0]), -1)
    far = np.concatenate([range_m[frame, light] if named else np.full(len(light), np.nan), nothing * np.nan])
    light = np.concatenate([light if named else np.full(len(light), -1), nothing])
    frame = np.concatenate([frame, strays[0]])
    order = np.argsort(frame, kind="stable")
    return SpotTable(frame[order], seen[order], light[order], far[order])


def _is_rear(station: Station) -> np.ndarray:
    """Which lights (M,) are not of the front layer."""
    return np.asarray(station.layer != station.layers.index(station.layers_front_to_rear()[0]))


def _p_rear(scenario: Scenario, station: Station, light: Indices, rng: np.random.Generator) -> Array:
    """What the detector says of each spot's layer (S,); spurious ones look like front lights."""
    front = station.layers.index(station.layers_front_to_rear()[0])
    rear = (light >= 0) & (station.layer[light] != front)
    rear ^= rng.random(len(light)) < scenario.spots.wrong_layer
    return np.where(rear, _P_REAR[1], _P_REAR[0]) if scenario.spots.color else np.full(len(light), np.nan)


def _attitudes(scenario: Scenario, course: Course, rng: np.random.Generator) -> list[Attitude | None]:
    """What the vehicle's own sensors say in each of the N frames."""
    knobs = scenario.spots.attitude
    if knobs is None:
        return [None] * len(course.t_ns)
    bias = rng.normal(size=(len(course.surface_m), 3)) * np.deg2rad(knobs.bias_deg)
    w = bias[course.run] + rng.normal(size=(len(course.t_ns), 3)) * np.deg2rad(knobs.noise_deg)
    sigma_rad = float(np.deg2rad(np.hypot(knobs.bias_deg, knobs.noise_deg)))
    return [Attitude(R, sigma_rad) for R in rotations(w) @ course.T_dock_cam[:, :3, :3]]


def _ends(course: Course, spots: SpotTable) -> list[int]:
    """Where each frame's spots begin, and the last ones end: N + 1 places in the row."""
    ends: list[int] = np.searchsorted(spots.frame, np.arange(len(course.t_ns) + 1)).tolist()
    return ends


def _detections(
    course: Course, spots: SpotTable, looks: Looks, attitudes: list[Attitude | None]
) -> Iterator[Detections]:
    """One frame's detections after the other; they are views of the arrays of all spots."""
    uv, cov, p_light, p_rear = spots.uv + looks.off_px, looks.cov_px2, looks.p_light, looks.p_rear
    unknown, ends, t_ns = np.full(len(uv), np.nan), _ends(course, spots), course.t_ns.tolist()
    for number, (a, b) in enumerate(pairwise(ends)):
        nothing, cov_px2 = unknown[a:b], None if cov is None else cov[a:b]
        yield Detections(
            f"{number:06d}",
            t_ns[number],
            uv[a:b],
            nothing,
            nothing,
            p_light[a:b],
            p_rear[a:b],
            cov_px2,
            attitudes[number],
        )
