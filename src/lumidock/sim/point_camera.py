"""A camera at point level for a vehicle that steers itself: detections of one frame after the other, at any pose.

The draws are those of `sim.detections`, made ahead for the longest docking, since a closed loop decides its own path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Attitude, Detections, Indices
from lumidock.errors import InputError
from lumidock.sim.course import Course, project_each, shines
from lumidock.sim.detections import RunDraws, failed, run_draws, shown_layers
from lumidock.sim.draws import Draw
from lumidock.sim.point_faults import Extras, bent, glints, no_lens_faults, seen_extras
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, Scenario, poses, rotations, spurious_paths
from lumidock.sim.stream import Row, rows_of
from lumidock.station import Station

_P_REAR = (0.05, 0.95)  # of front and rear lights, as colour tells them


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One frame at point level: its `detections`, and the index `light` (S,) of the light behind each, -1 for none."""

    detections: Detections
    light: Indices


@dataclass(frozen=True, eq=False)
class PointCamera:
    """The camera of one docking, with all that is drawn once for it.

    `front` (M,): which lights are of the front layer; `shown` (M,): which are of a layer that is lit; `rows`: the
    frames that arrive, by number.
    """

    scenario: Scenario
    station: Station
    camera: Camera
    drawn: RunDraws
    course: Course
    wander_uv: Array
    glints: Extras
    attitude_bias_rad: Array
    front: np.ndarray
    shown: np.ndarray
    rows: dict[int, Row]
    rng: np.random.Generator

    def see(self, number: int, T_dock_cam: Array) -> Seen:
        """The detections of frame `number`, taken from the true pose `T_dock_cam` (4, 4)."""
        one = one_frame(self.course, number, T_dock_cam)
        uv, visible = self.project(one)
        lit = visible & ~self.dark(number, visible)
        spurious = self.spurious(number, one, uv[visible])
        light = np.concatenate([np.flatnonzero(lit), np.full(len(spurious), -1)])
        where = np.concatenate([uv[lit], spurious])
        where = where + self.rng.normal(0.0, self.scenario.detections.noise_px, where.shape)
        nothing = np.full(len(light), np.nan)
        detections = Detections(
            frame=f"{number:06d}",
            t_ns=int(self.course.t_ns[number]),
            uv=where,
            radius_px=nothing,
            flux=nothing,
            p_light=np.ones(len(light)),
            p_rear=self._p_rear(light),
            attitude=self._attitude(T_dock_cam),
        )
        return Seen(detections, light)

    def project(self, one: Course) -> tuple[Array, np.ndarray]:
        """Pixels (M, 2) of the lights where they truly are, through the true lens; which of them (M,) can be seen."""
        uv, p_cam = project_each(self.camera, one.T_dock_cam, self.drawn.p_dock)
        uv = (uv[0] - self.camera.center_px) * (1.0 + self.drawn.focal[0])
        uv += self.camera.center_px + self.drawn.center_px[0]
        near = np.linalg.norm(p_cam[0], axis=1) < self.drawn.reach_m[0]
        shining = shines(self.station.axis, self.scenario, one.T_dock_cam, self.drawn.p_dock)[0]
        ahead = p_cam[0][:, 2] > 0.0
        return uv, self.camera.contains(uv) & near & ahead & shining & self.shown

    def dark(self, number: int, visible: np.ndarray) -> np.ndarray:
        """Which lights (M,) give no detection although they are in view."""
        knobs, t_s = self.scenario.detections, float(self.course.t_ns[number]) * 1e-9
        dark = self.drawn.dead[0] | (self.rng.random(len(visible)) < knobs.drop)
        dark |= failed(self.scenario, self.station, np.array([t_s]))[0] | bool(self.drawn.black[number])
        if any(first <= t_s <= last for first, last in knobs.front_off_s):
            dark |= self.front
        if self.scenario.faults.missing[1] == 0:
            return np.asarray(dark)
        among = np.flatnonzero(visible & self.front)
        count = min(int(self.rng.integers(*self.scenario.faults.missing, endpoint=True)), len(among))
        dark[self.rng.choice(among, count, replace=False)] = True
        return np.asarray(dark)

    def spurious(self, number: int, one: Course, lights_uv: Array) -> Array:
        """Pixels (S, 2) of spurious detections: those that wander, those of this frame alone, and glints."""
        if self.drawn.black[number]:
            return np.empty((0, 2))
        knobs = self.scenario.detections
        low, high = np.full(2, -0.5), np.array([self.camera.width, self.camera.height]) - 0.5
        if knobs.place == "beside" and len(lights_uv):
            margin = 0.25 * np.ptp(lights_uv, axis=0)
            low, high = (
                np.maximum(low, lights_uv.min(axis=0) - margin),
                np.minimum(high, lights_uv.max(axis=0) + margin),
            )
        new = low + self.rng.random((int(self.rng.poisson(knobs.clutter)), 2)) * (high - low)
        glints = replace(self.glints, on=self.glints.on[number : number + 1])
        fixed = seen_extras(knobs, self.camera, one, glints, no_lens_faults(1), np.zeros(1, bool))[1]
        return np.concatenate([self.wander_uv[number], new, fixed])

    def _p_rear(self, light: Indices) -> Array:
        if not self.scenario.detections.color:
            return np.full(len(light), np.nan)
        rear = (light >= 0) & ~self.front[light]
        rear ^= self.rng.random(len(light)) < self.scenario.detections.wrong_layer
        return np.where(rear, _P_REAR[1], _P_REAR[0])

    def _attitude(self, T_dock_cam: Array) -> Attitude | None:
        knobs = self.scenario.detections.attitude
        if knobs is None:
            return None
        w = self.attitude_bias_rad + self.rng.normal(size=3) * np.deg2rad(knobs.noise_deg)
        sigma_rad = float(np.deg2rad(np.hypot(knobs.bias_deg, knobs.noise_deg)))
        return Attitude(rotations(w[None])[0] @ T_dock_cam[:3, :3], sigma_rad)


def point_camera(scenario: Scenario, station: Station, camera: Camera, seed: int, frames: int) -> PointCamera:
    """The camera of a docking of at most so many `frames`.

    Raises: InputError for settings that a single frame at point level cannot have.
    """
    knobs = scenario.detections
    if knobs.detector or knobs.mirror != "none" or scenario.path.kind != "approach":
        raise InputError(f"{scenario.name}: a closed loop takes no detections.detector, mirror or path of draws")
    t_ns = np.round(np.arange(frames) * scenario.path.frame_interval_s * 1e9).astype(np.int64)
    stays = np.arange(frames)
    still = poses(np.tile(R_DOCK_CAM_HEAD_ON, (frames, 1, 1)), np.zeros((frames, 3)))
    course = Course(t_ns, still, np.zeros_like(stays), stays, stays, np.array([np.inf]))
    drawn = run_draws(scenario, station, course, np.random.default_rng([seed, Draw.RUN]))
    moved = bent(knobs, drawn.p_dock, np.random.default_rng([seed, Draw.BENT_LIGHT]))
    moved = (
        moved + np.random.default_rng([seed, Draw.STATION]).normal(size=moved.shape) * scenario.docking.station_off_m
    )
    drawn = replace(drawn, p_dock=moved)
    bias = np.random.default_rng([seed, Draw.ATTITUDE]).normal(size=3)
    front = station.layer == station.layers.index(station.layers_front_to_rear()[0])
    glint_rng = np.random.default_rng([seed, Draw.STRUCTURE_GLINTS])
    return PointCamera(
        scenario,
        station,
        camera,
        drawn,
        course,
        wander_uv=spurious_paths(
            scenario, t_ns, (camera.width, camera.height), np.random.default_rng([seed, Draw.WANDERING_LIGHTS])
        ),
        glints=glints(knobs, drawn.p_dock, course, drawn.dead, ~front, rng=glint_rng),
        attitude_bias_rad=bias * np.deg2rad(knobs.attitude.bias_deg if knobs.attitude else 0.0),
        front=front,
        shown=shown_layers(scenario, station),
        rows={
            row.number: row for row in rows_of(scenario.stream, t_ns, np.random.default_rng([seed, Draw.STREAM_FAULTS]))
        },
        rng=np.random.default_rng([seed, Draw.DETECTIONS]),
    )


def one_frame(course: Course, number: int, T_dock_cam: Array) -> Course:
    """A course of one frame."""
    first = np.zeros(1, np.int64)
    return Course(course.t_ns[number : number + 1], T_dock_cam[None], first, first, first, course.surface_m)
