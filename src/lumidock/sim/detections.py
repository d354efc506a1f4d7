"""Bare detections without rendering: projected lights with noise, missing and spurious ones, and their truth.

All frames of a run are made at once, as arrays: N frames, G runs (one, or as many as there are draws), M lights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Attitude, Detections, Indices
from lumidock.pose import project_lights
from lumidock.sim.course import Course, course_of, mirror_image, project_each, shines
from lumidock.sim.measured import Appearance, DetectionTable, as_measured, detector_errors, with_false
from lumidock.sim.point_faults import bent, glints, seen_glints
from lumidock.sim.scenario import BlackOuts, Scenario, rotations, spurious_paths
from lumidock.station import Station

_P_REAR = (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
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
class RunDraws:
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
    """Indices (k,) of those of the front lights in view that are dark in this frame."""
    count = min(int(rng.integers(*scenario.faults.missing, endpoint=True)), len(front_in_view))
    return np.asarray(rng.choice(front_in_view, count, replace=False)) if count else np.empty(0, np.int64)


def simulated_frames(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Iterator[SimulatedFrame]:
    """All frames of a scenario as bare detections, in the order the lights have with the spurious ones last.

    Raises: InputError when no pose has the front layer in view.
    """
    course = course_of(scenario, station, camera, np.random.default_rng([seed, 0]))
    world = run_draws(scenario, station, course, np.random.default_rng([seed, 4]))
    world = replace(world, p_dock=bent(scenario.detections, world.p_dock, np.random.default_rng([seed, 16])))
    places = glints(scenario.detections, world.p_dock, world.dead, np.random.default_rng([seed, 17]))
    wander = _wandering(scenario, camera, course, np.random.default_rng([seed, 2]))
    rng = np.random.default_rng([seed, 1])
    uv, visible, range_m = _shown(scenario, station, camera, course, world)
    lit = visible & ~_dark(scenario, station, course, world, visible, rng)
    spurious = _spurious(scenario, world, wander, _box(scenario, camera, uv, visible), rng)
    fixed = seen_glints(scenario.detections, camera, course, places, world.black)
    spurious = np.concatenate([spurious[0], fixed[0]]), np.concatenate([spurious[1], fixed[1]])
    errors = detector_errors(scenario.detections.detector) if scenario.detections.detector else None
    detector_rng = np.random.default_rng([seed, 15])
    if errors:
        lit &= errors.found(_is_rear(station), range_m, detector_rng)
    table = _in_a_row(uv, lit, spurious, range_m, scenario.shows_dock)
    if errors:
        dock_m = np.linalg.norm(course.T_dock_cam[:, :3, 3], axis=1)
        table = with_false(table, errors, np.where(world.black, np.nan, dock_m), camera, detector_rng)
    attitudes = _attitudes(scenario, course, np.random.default_rng([seed, 5]))
    if not scenario.shows_dock:
        uv, visible = _unseen(scenario, camera, course, world, uv), np.zeros_like(visible)
    noise = rng.normal(0.0, 1.0, table.uv.shape) * scenario.detections.noise_px
    sure, p_rear = np.ones(len(noise)), _p_rear(scenario, station, table.light, rng)
    appearance = Appearance(noise, None, sure, p_rear)
    if errors:
        appearance = as_measured(
            errors, appearance, table, _is_rear(station), scenario.detections.noise_px, detector_rng
        )
    detections = _detections(course, table, appearance, attitudes)
    ends = _ends(course, table)
    light = [table.light[a:b] for a, b in pairwise(ends)]
    yield from map(
        SimulatedFrame, detections, course.T_dock_cam, light, uv, visible, course.run.tolist(), course.step.tolist()
    )


def run_draws(scenario: Scenario, station: Station, course: Course, rng: np.random.Generator) -> RunDraws:
    """What the run's draws decide; without survey and calibration errors, what the station and the camera say."""
    g, m, table = len(course.surface_m), len(station), scenario.detections
    off = rng.normal(size=(g, m, 3)) * station.sigma_light_m
    off += (rng.normal(size=(g, len(station.layers), 3)) * station.sigma_layer_m)[:, station.layer]
    front = ~_is_rear(station)
    front_m, rear_m = (rng.uniform(*reach, (g, 1)) for reach in (table.front_range_m, table.rear_range_m))
    lens = rng.normal(size=(g, 3)) * [station.sigma_focal, station.sigma_center_px, station.sigma_center_px]
    lens *= table.calibration
    return RunDraws(
        p_dock=station.p_dock + off * table.survey,
        reach_m=np.where(front, front_m, rear_m) if not table.detector else np.full((g, m), np.inf),
        dead=_some(np.ones((g, m), bool), rng.integers(*table.dead, g, endpoint=True), rng),
        focal=lens[:, 0] + scenario.lens.focal_error,
        center_px=lens[:, 1:],
        black=_black(table.black_outs, course.t_ns * 1e-9, rng),
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
    scenario: Scenario, station: Station, camera: Camera, course: Course, world: RunDraws
) -> tuple[Array, np.ndarray, Array]:
    """True pixels (N, M, 2) of all lights, or of their mirror images, which (N, M) can be seen, and ranges (N, M) m."""
    p_dock = world.p_dock[course.run]
    if scenario.detections.mirror == "only":
        p_dock = mirror_image(p_dock, course.surface_m[course.run])
    uv, p_cam = project_each(camera, course.T_dock_cam, p_dock)
    uv = _through_lens(camera, course, world, uv)
    range_m = np.linalg.norm(p_cam, axis=2)
    seen = camera.contains(uv) & (range_m < world.reach_m[course.run]) & shown_layers(scenario, station)
    shining = shines(station.axis, scenario, course.T_dock_cam, p_dock)
    return uv, seen & shining & scenario.detections.dock, range_m


def shown_layers(scenario: Scenario, station: Station) -> np.ndarray:
    """Which lights (M,) belong to a layer that shines."""
    front = ~_is_rear(station)
    return np.asarray({"all": np.ones_like(front), "front": front, "rear": ~front}[scenario.lamps.layers])


def failed(scenario: Scenario, station: Station, t_s: Array) -> np.ndarray:
    """Which lights (N, M) have failed by the times `t_s` (N,) since the start."""
    end_s = np.array([scenario.lamps.failures.get(light, np.inf) for light in station.ids])
    return np.asarray(t_s[:, None] >= end_s)


def _through_lens(camera: Camera, course: Course, world: RunDraws, uv: Array) -> Array:
    """Pixels (N, M, 2) as the lens really makes them, of those that the calibration says."""
    scale = 1.0 + world.focal[course.run, None, None]
    return np.asarray((uv - camera.center_px) * scale + camera.center_px + world.center_px[course.run, None])


def _unseen(scenario: Scenario, camera: Camera, course: Course, world: RunDraws, uv: Array) -> Array:
    """True pixels (N, M, 2) of a dock that is not seen; NaN when there is none."""
    if not scenario.detections.dock:
        return np.full_like(uv, np.nan)
    return _through_lens(camera, course, world, project_each(camera, course.T_dock_cam, world.p_dock[course.run])[0])


def _dark(
    scenario: Scenario,
    station: Station,
    course: Course,
    world: RunDraws,
    visible: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Which lights (N, M) make no spot although nothing hides them."""
    front = ~_is_rear(station)
    count = rng.integers(*scenario.faults.missing, len(visible), endpoint=True)
    missing = _some(visible & front, count, rng)[course.missing_from]
    dropped = rng.random(visible.shape) < scenario.detections.drop
    t_s = course.t_ns * 1e-9
    off = failed(scenario, station, t_s)
    for first, last in scenario.detections.front_off_s:
        off |= front & ((t_s >= first) & (t_s <= last))[:, None]
    return np.asarray(missing | dropped | world.dead[course.run] | world.black[:, None] | off)


def _box(scenario: Scenario, camera: Camera, uv: Array, visible: np.ndarray) -> tuple[Array, Array]:
    """Corners (N, 2) of where spurious spots are drawn: the picture, or the box of the array and 50 % around it."""
    low, high = np.full((len(uv), 2), -0.5), np.tile([camera.width - 0.5, camera.height - 0.5], (len(uv), 1))
    if scenario.detections.place == "picture":
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


def _spurious(
    scenario: Scenario, world: RunDraws, wander: Array, box: tuple[Array, Array], rng: np.random.Generator
) -> tuple[Indices, Array]:
    """Frame (S,) and pixels (S, 2) of all spurious spots: those that `wander` (N, W, 2), and those drawn anew."""
    n = len(wander)
    new = rng.poisson(scenario.detections.clutter, n)
    if scenario.path.kind == "draws":
        new += rng.integers(*scenario.faults.spurious, n, endpoint=True)
    frame = np.repeat(np.arange(n), new)
    low, high = box
    uv = low[frame] + rng.random((len(frame), 2)) * (high - low)[frame]
    frame = np.concatenate([np.repeat(np.arange(n), wander.shape[1]), frame])
    uv = np.concatenate([wander.reshape(-1, 2), uv])
    clear = ~world.black[frame]
    return frame[clear], uv[clear]


def _in_a_row(
    uv: Array, lit: np.ndarray, spurious: tuple[Indices, Array], range_m: Array, named: bool
) -> DetectionTable:
    """The lit lights and the spurious spots, frame by frame; of lights that are not `named` none is known."""
    frame, light = np.nonzero(lit)
    seen, nothing = np.concatenate([uv[frame, light], spurious[1]]), np.full(len(spurious[0]), -1)
    far = np.concatenate([range_m[frame, light] if named else np.full(len(light), np.nan), nothing * np.nan])
    light = np.concatenate([light if named else np.full(len(light), -1), nothing])
    frame = np.concatenate([frame, spurious[0]])
    order = np.argsort(frame, kind="stable")
    return DetectionTable(frame[order], seen[order], light[order], far[order])


def _is_rear(station: Station) -> np.ndarray:
    """Which lights (M,) are not of the front layer."""
    return np.asarray(station.layer != station.layers.index(station.layers_front_to_rear()[0]))


def _p_rear(scenario: Scenario, station: Station, light: Indices, rng: np.random.Generator) -> Array:
    """What the detector says of each spot's layer (S,); spurious ones look like front lights."""
    front = station.layers.index(station.layers_front_to_rear()[0])
    rear = (light >= 0) & (station.layer[light] != front)
    rear ^= rng.random(len(light)) < scenario.detections.wrong_layer
    return np.where(rear, _P_REAR[1], _P_REAR[0]) if scenario.detections.color else np.full(len(light), np.nan)


def _attitudes(scenario: Scenario, course: Course, rng: np.random.Generator) -> list[Attitude | None]:
    """What the vehicle's own sensors say in each of the N frames."""
    knobs = scenario.detections.attitude
    if knobs is None:
        return [None] * len(course.t_ns)
    bias = rng.normal(size=(len(course.surface_m), 3)) * np.deg2rad(knobs.bias_deg)
    w = bias[course.run] + rng.normal(size=(len(course.t_ns), 3)) * np.deg2rad(knobs.noise_deg)
    sigma_rad = float(np.deg2rad(np.hypot(knobs.bias_deg, knobs.noise_deg)))
    return [Attitude(R, sigma_rad) for R in rotations(w) @ course.T_dock_cam[:, :3, :3]]


def _ends(course: Course, table: DetectionTable) -> list[int]:
    """Where each frame's spots begin, and the last ones end: N + 1 places in the row."""
    ends: list[int] = np.searchsorted(table.frame, np.arange(len(course.t_ns) + 1)).tolist()
    return ends


def _detections(
    course: Course, table: DetectionTable, appearance: Appearance, attitudes: list[Attitude | None]
) -> Iterator[Detections]:
    """One frame's detections after the other; they are views of the arrays of all spots."""
    uv, cov, p_light, p_rear = table.uv + appearance.off_px, appearance.cov_px2, appearance.p_light, appearance.p_rear
    unknown, ends, t_ns = np.full(len(uv), np.nan), _ends(course, table), course.t_ns.tolist()
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
