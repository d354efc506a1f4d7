"""Bare detections without rendering: projected lights with noise, missing lights, spurious detections, and truth.

All frames are computed at once, as arrays. A scenario with a path is one run; with a path of draws every draw is a run.
Shapes: N frames, G runs, M lights, S detections.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import AidingMeasurement, Array, Attitude, Detections, Indices
from lumidock.pose import project_lights
from lumidock.sim.aiding import sensor_values
from lumidock.sim.course import Course, course_of, mirror_image, project_each, shines
from lumidock.sim.draws import Draw
from lumidock.sim.measured import Appearance, DetectionTable, as_measured, detector_errors, with_false
from lumidock.sim.point_faults import bent, glints, seen_glints
from lumidock.sim.scenario import BlackOuts, Scenario, rotations, spurious_paths
from lumidock.station import Station

_P_REAR = (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
    """One frame's detections and their truth.

    Pose `T_dock_cam` (4, 4); the index `light` (S,) of the light that made each detection, -1 for a spurious one; the
    pixels `uv` (M, 2) of all lights with their true positions and the true lens; and which lights would be seen if none
    were dark, `in_view` (M,). The frame is number `step` of run number `sequence`; before step 0 there is no history.
    `aiding`: what the vehicle's own sensors have said since the frame before.
    """

    detections: Detections
    T_dock_cam: Array
    light: Indices
    uv: Array
    in_view: np.ndarray
    sequence: int = 0
    step: int = 0
    aiding: tuple[AidingMeasurement, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RunDraws:
    """Draws that hold for a whole run; G runs, M lights, N frames.

    True positions of the lights, `p_dock` (G, M, 3) m; the range beyond which each is not seen, `reach_m` (G, M) m;
    which lights are `dead` (G, M); calibration errors, relative of the focal length, `focal` (G,), and of the principal
    point, `center_px` (G, 2); which frames are `black` (N,).
    """

    p_dock: Array
    reach_m: Array
    dead: np.ndarray
    focal: Array
    center_px: Array
    black: np.ndarray


def in_view(station: Station, camera: Camera, T_dock_cam: Array) -> tuple[Array, np.ndarray]:
    """Pixels (M, 2) of all lights at their surveyed positions; which (M,) of them the camera can see."""
    uv = project_lights(camera, T_dock_cam, station.p_dock)
    return uv, camera.contains(uv) & (emission_cosine(station.p_dock, station.axis, T_dock_cam[:3, 3]) > 0.0)


def emission_cosine(p_dock: Array, axis: Array, t_dock_cam: Array) -> Array:
    """Cosine (M,) between the `axis` (M, 3) of lamps at `p_dock` (M, 3) and the direction to the camera."""
    to_camera = t_dock_cam - p_dock
    return np.asarray((to_camera * axis).sum(axis=1) / np.linalg.norm(to_camera, axis=1))


def dark_lights(scenario: Scenario, front_in_view: Indices, rng: np.random.Generator) -> Indices:
    """Indices (k,) of the lights that are dark in one frame, out of those in `front_in_view`."""
    count = min(int(rng.integers(*scenario.faults.missing, endpoint=True)), len(front_in_view))
    return np.asarray(rng.choice(front_in_view, count, replace=False)) if count else np.empty(0, np.int64)


def simulated_frames(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Iterator[SimulatedFrame]:
    """All frames of a scenario as bare detections; in each frame lights come first, in the order of the station.

    Raises: InputError when no pose has the front layer in view.
    """
    course = course_of(scenario, station, camera, np.random.default_rng([seed, Draw.COURSE]))
    drawn = run_draws(scenario, station, course, np.random.default_rng([seed, Draw.RUN]))
    bent_p = bent(scenario.detections, drawn.p_dock, np.random.default_rng([seed, Draw.BENT_LIGHT]))
    drawn = replace(drawn, p_dock=bent_p)
    places = glints(scenario.detections, drawn.p_dock, drawn.dead, np.random.default_rng([seed, Draw.STRUCTURE_GLINTS]))
    wander = _wandering(scenario, camera, course, np.random.default_rng([seed, Draw.WANDERING_LIGHTS]))
    rng = np.random.default_rng([seed, Draw.DETECTIONS])
    uv, visible, range_m = _in_view_of_each(scenario, station, camera, course, drawn)
    lit = visible & ~_dark(scenario, station, course, drawn, visible, rng)
    spurious = _spurious(scenario, drawn, wander, _box(scenario, camera, uv, visible), rng)
    fixed = seen_glints(scenario.detections, camera, course, places, drawn.black)
    spurious = np.concatenate([spurious[0], fixed[0]]), np.concatenate([spurious[1], fixed[1]])
    errors = detector_errors(scenario.detections.detector) if scenario.detections.detector else None
    detector_rng = np.random.default_rng([seed, Draw.DETECTOR_ERRORS])
    if errors:
        lit &= errors.found(_is_rear(station), range_m, detector_rng)
    table = _table(uv, lit, spurious, range_m, scenario.shows_dock)
    if errors:
        dock_m = np.linalg.norm(course.T_dock_cam[:, :3, 3], axis=1)
        table = with_false(table, errors, np.where(drawn.black, np.nan, dock_m), camera, detector_rng)
    attitudes = _attitudes(scenario, course, np.random.default_rng([seed, Draw.ATTITUDE]))
    if not scenario.shows_dock:
        uv, visible = _pixels_of_hidden_dock(scenario, camera, course, drawn, uv), np.zeros_like(visible)
    noise = rng.normal(0.0, 1.0, table.uv.shape) * scenario.detections.noise_px
    sure, p_rear = np.ones(len(noise)), _p_rear(scenario, station, table.light, rng)
    appearance = Appearance(noise, None, sure, p_rear)
    if errors:
        appearance = as_measured(
            errors, appearance, table, _is_rear(station), scenario.detections.noise_px, detector_rng
        )
    detections = _detections(course, table, appearance, attitudes)
    bounds, aiding = _bounds(course, table), sensor_values(scenario, course, seed)
    for number, (frame, (a, b)) in enumerate(zip(detections, pairwise(bounds), strict=True)):
        yield SimulatedFrame(
            frame,
            course.T_dock_cam[number],
            table.light[a:b],
            uv[number],
            visible[number],
            sequence=int(course.run[number]),
            step=int(course.step[number]),
            aiding=aiding[number],
        )


def run_draws(scenario: Scenario, station: Station, course: Course, rng: np.random.Generator) -> RunDraws:
    """Draw what holds for a whole run; survey and calibration errors are zero unless the scenario asks for them."""
    g, m, table = len(course.surface_m), len(station), scenario.detections
    off = rng.normal(size=(g, m, 3)) * np.reshape(station.sigma_light_m, (-1, 1))
    off += (rng.normal(size=(g, len(station.layers), 3)) * station.sigma_layer_m)[:, station.layer]
    front = ~_is_rear(station)
    front_m, rear_m = (rng.uniform(*reach, (g, 1)) for reach in (table.front_range_m, table.rear_range_m))
    lens = rng.normal(size=(g, 3)) * [station.sigma_focal, station.sigma_center_px, station.sigma_center_px]
    lens *= table.calibration
    return RunDraws(
        p_dock=station.p_dock + off * table.survey,
        reach_m=np.where(front, front_m, rear_m) if not table.detector else np.full((g, m), np.inf),
        dead=_random_choice(np.ones((g, m), bool), rng.integers(*table.dead, g, endpoint=True), rng),
        focal=lens[:, 0] + scenario.lens.focal_error,
        center_px=lens[:, 1:],
        black=_black(table.black_outs, course.t_ns * 1e-9, rng),
    )


def _random_choice(among: np.ndarray, count: Indices, rng: np.random.Generator) -> np.ndarray:
    """Choose at random in each row `count` (n,) of the entries of `among` (n, M) that are true, or all if fewer."""
    keys = np.where(among, rng.random(among.shape), 2.0)
    return np.asarray(among & (keys.argsort(axis=1).argsort(axis=1) < count[:, None]))


def _black(knobs: BlackOuts, t_s: Array, rng: np.random.Generator) -> np.ndarray:
    """Which of the frames taken at `t_s` (N,) are black."""
    n = rng.integers(*knobs.count, endpoint=True)
    start, length = rng.uniform(0.0, t_s[-1], n), rng.uniform(*knobs.length_s, n)
    black = np.zeros(len(t_s), bool)
    for first, last in (*knobs.at_s, *zip(start, start + length, strict=True)):
        black |= (t_s >= first) & (t_s <= last)
    return black


def _in_view_of_each(
    scenario: Scenario, station: Station, camera: Camera, course: Course, drawn: RunDraws
) -> tuple[Array, np.ndarray, Array]:
    """True pixels (N, M, 2) of all lights or of their mirror images, which (N, M) are in view, and ranges (N, M) m."""
    p_dock = drawn.p_dock[course.run]
    if scenario.detections.mirror == "only":
        p_dock = mirror_image(p_dock, course.surface_m[course.run])
    uv, p_cam = project_each(camera, course.T_dock_cam, p_dock)
    uv = _through_lens(camera, course, drawn, uv)
    range_m = np.linalg.norm(p_cam, axis=2)
    seen = camera.contains(uv) & (range_m < drawn.reach_m[course.run]) & shown_layers(scenario, station)
    shining = shines(station.axis, scenario, course.T_dock_cam, p_dock)
    return uv, seen & shining & scenario.detections.dock, range_m


def shown_layers(scenario: Scenario, station: Station) -> np.ndarray:
    """Which lights (M,) belong to a layer that is lit."""
    front = ~_is_rear(station)
    return np.asarray({"all": np.ones_like(front), "front": front, "rear": ~front}[scenario.lamps.layers])


def failed(scenario: Scenario, station: Station, t_s: Array) -> np.ndarray:
    """Which lights (N, M) have failed at the times `t_s` (N,)."""
    end_s = np.array([scenario.lamps.failures.get(light, np.inf) for light in station.ids])
    return np.asarray(t_s[:, None] >= end_s)


def _through_lens(camera: Camera, course: Course, drawn: RunDraws, uv: Array) -> Array:
    """Pixels (N, M, 2) through the true lens, from the pixels `uv` (N, M, 2) through the calibrated camera."""
    scale = 1.0 + drawn.focal[course.run, None, None]
    return np.asarray((uv - camera.center_px) * scale + camera.center_px + drawn.center_px[course.run, None])


def _pixels_of_hidden_dock(scenario: Scenario, camera: Camera, course: Course, drawn: RunDraws, uv: Array) -> Array:
    """True pixels (N, M, 2) of the lights of a dock that the picture does not show; NaN when there is no dock."""
    if not scenario.detections.dock:
        return np.full_like(uv, np.nan)
    return _through_lens(camera, course, drawn, project_each(camera, course.T_dock_cam, drawn.p_dock[course.run])[0])


def _dark(
    scenario: Scenario,
    station: Station,
    course: Course,
    drawn: RunDraws,
    visible: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Which lights (N, M) give no detection although they are in view."""
    front = ~_is_rear(station)
    count = rng.integers(*scenario.faults.missing, len(visible), endpoint=True)
    missing = _random_choice(visible & front, count, rng)[course.missing_from]
    dropped = rng.random(visible.shape) < scenario.detections.drop
    t_s = course.t_ns * 1e-9
    off = failed(scenario, station, t_s)
    for first, last in scenario.detections.front_off_s:
        off |= front & ((t_s >= first) & (t_s <= last))[:, None]
    return np.asarray(missing | dropped | drawn.dead[course.run] | drawn.black[:, None] | off)


def _box(scenario: Scenario, camera: Camera, uv: Array, visible: np.ndarray) -> tuple[Array, Array]:
    """Corners (N, 2) px of the box in which spurious detections are drawn.

    It is the whole picture, or the bounding box of the lights in view, enlarged by a quarter of its size on every side.
    """
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
    """Pixels (N, W, 2) of the spurious lights that wander through a run; a path of draws has none."""
    if scenario.path.kind == "draws":
        return np.empty((len(course.t_ns), 0, 2))
    return spurious_paths(scenario, course.t_ns, (camera.width, camera.height), rng)


def _spurious(
    scenario: Scenario, drawn: RunDraws, wander: Array, box: tuple[Array, Array], rng: np.random.Generator
) -> tuple[Indices, Array]:
    """Frame (S,) and pixels (S, 2) of all spurious detections: those that `wander` (N, W, 2) and those of one frame."""
    n = len(wander)
    new = rng.poisson(scenario.detections.clutter, n)
    if scenario.path.kind == "draws":
        new += rng.integers(*scenario.faults.spurious, n, endpoint=True)
    frame = np.repeat(np.arange(n), new)
    low, high = box
    uv = low[frame] + rng.random((len(frame), 2)) * (high - low)[frame]
    frame = np.concatenate([np.repeat(np.arange(n), wander.shape[1]), frame])
    uv = np.concatenate([wander.reshape(-1, 2), uv])
    clear = ~drawn.black[frame]
    return frame[clear], uv[clear]


def _table(
    uv: Array, lit: np.ndarray, spurious: tuple[Indices, Array], range_m: Array, dock_is_shown: bool
) -> DetectionTable:
    """Table of all lit lights and spurious detections, frame by frame; without the dock no detection has a light."""
    frame, light = np.nonzero(lit)
    seen, nothing = np.concatenate([uv[frame, light], spurious[1]]), np.full(len(spurious[0]), -1)
    far = np.concatenate([range_m[frame, light] if dock_is_shown else np.full(len(light), np.nan), nothing * np.nan])
    light = np.concatenate([light if dock_is_shown else np.full(len(light), -1), nothing])
    frame = np.concatenate([frame, spurious[0]])
    order = np.argsort(frame, kind="stable")
    return DetectionTable(frame[order], seen[order], light[order], far[order])


def _is_rear(station: Station) -> np.ndarray:
    """Which lights (M,) are not of the front layer."""
    return np.asarray(station.layer != station.layers.index(station.layers_front_to_rear()[0]))


def _p_rear(scenario: Scenario, station: Station, light: Indices, rng: np.random.Generator) -> Array:
    """Probability (S,) that a detection is of the rear layer; spurious ones start as front, `wrong_layer` flips any."""
    front = station.layers.index(station.layers_front_to_rear()[0])
    rear = (light >= 0) & (station.layer[light] != front)
    rear ^= rng.random(len(light)) < scenario.detections.wrong_layer
    return np.where(rear, _P_REAR[1], _P_REAR[0]) if scenario.detections.color else np.full(len(light), np.nan)


def _attitudes(scenario: Scenario, course: Course, rng: np.random.Generator) -> list[Attitude | None]:
    """Attitude measured by the vehicle's own sensors in each of the N frames."""
    knobs = scenario.detections.attitude
    if knobs is None:
        return [None] * len(course.t_ns)
    bias = rng.normal(size=(len(course.surface_m), 3)) * np.deg2rad(knobs.bias_deg)
    w = bias[course.run] + rng.normal(size=(len(course.t_ns), 3)) * np.deg2rad(knobs.noise_deg)
    sigma_rad = float(np.deg2rad(np.hypot(knobs.bias_deg, knobs.noise_deg)))
    return [Attitude(R, sigma_rad) for R in rotations(w) @ course.T_dock_cam[:, :3, :3]]


def _bounds(course: Course, table: DetectionTable) -> list[int]:
    """Index of the first detection of each frame, and the number of all: N + 1 indices."""
    bounds: list[int] = np.searchsorted(table.frame, np.arange(len(course.t_ns) + 1)).tolist()
    return bounds


def _detections(
    course: Course, table: DetectionTable, appearance: Appearance, attitudes: list[Attitude | None]
) -> Iterator[Detections]:
    """Detections of each frame in turn; they are views of the arrays of all frames."""
    uv, cov, p_light, p_rear = table.uv + appearance.off_px, appearance.cov_px2, appearance.p_light, appearance.p_rear
    unknown, bounds, t_ns = np.full(len(uv), np.nan), _bounds(course, table), course.t_ns.tolist()
    for number, (a, b) in enumerate(pairwise(bounds)):
        nothing, cov_px2 = unknown[a:b], None if cov is None else cov[a:b]
        yield Detections(
            frame=f"{number:06d}",
            t_ns=t_ns[number],
            uv=uv[a:b],
            radius_px=nothing,
            flux=nothing,
            p_light=p_light[a:b],
            p_rear=p_rear[a:b],
            cov_px2=cov_px2,
            attitude=attitudes[number],
        )
