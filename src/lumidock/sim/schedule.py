"""For every frame of a scenario: pose, exposure, and which lights are dark or spurious."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_exp, se3_inverse, se3_log
from lumidock.sim.course import Course, course_of
from lumidock.sim.detections import RunDraws, dark_lights, failed, in_view, run_draws
from lumidock.sim.draws import Draw
from lumidock.sim.frames import FrameConditions, FrameRenderer
from lumidock.sim.knobs import AutoExposure, WaterSurface
from lumidock.sim.lens import Lens
from lumidock.sim.scenario import Scenario, spurious_paths
from lumidock.sim.sensor import LEVELS, electrons_per_level
from lumidock.sim.water import green_index
from lumidock.station import Station

_METER_BINS = np.logspace(-2.0, 6.0, 161)  # edges of the bins of exposure metering, electrons per ms
_BRIGHT_SHARE = 1e-3  # of the pixels may exceed the level `AutoExposure.bright`


@dataclass(frozen=True, eq=False)
class Schedule:
    """A scenario with all draws that hold for longer than one frame; it gives the conditions of each frame by number.

    `drawn` holds for a run; `spurious_uv` (N, W, 2) px are spurious lights that wander through the run; `exposure_s`
    (N,) are the exposures of the frames.
    """

    scenario: Scenario
    station: Station
    camera: Camera
    seed: int
    course: Course
    drawn: RunDraws
    spurious_uv: Array
    exposure_s: Array
    _renderer: dict[int, FrameRenderer] = field(default_factory=dict, init=False)

    def __len__(self) -> int:
        return len(self.course.t_ns)

    def renderer(self, number: int) -> FrameRenderer:
        """The renderer of a frame, with the true lens of its run; the renderer of the last run is kept."""
        run = int(self.course.run[number])
        if run not in self._renderer:
            focal, center = float(self.drawn.focal[run]) - self.scenario.lens.focal_error, self.drawn.center_px[run]
            lens = Lens.of(self.scenario.lens, self.camera, green_index(self.scenario.water), focal, center)
            self._renderer.clear()
            self._renderer[run] = FrameRenderer(self.scenario, self.station, lens, (self.seed, run))
        return self._renderer[run]

    def conditions(self, number: int) -> FrameConditions:
        """The conditions of a frame."""
        scenario, course = self.scenario, self.course
        run, t_s = int(course.run[number]), float(course.t_ns[number]) * 1e-9
        exposure_s = float(self.exposure_s[number])
        draws = (self.seed, run)
        only_mirror = scenario.detections.mirror == "only"
        surface = scenario.around.surface
        if only_mirror:
            surface = (surface or WaterSurface()).model_copy(update={"height_m": float(course.surface_m[run])})
        share = np.random.default_rng([*draws, Draw.FOULING]).uniform(*scenario.lamps.fouling, len(self.station))
        return FrameConditions(
            t_s=t_s,
            exposure_s=exposure_s,
            T_dock_cam=course.T_dock_cam[number],
            T_cam_later=self._later(number, exposure_s),
            p_dock=self.drawn.p_dock[run],
            transmission=share,
            dark=self._dark(number, t_s),
            spurious=self._spurious(number),
            surface=surface,
            dock=scenario.shows_dock,
            draws=draws,
        )

    def _later(self, number: int, exposure_s: float) -> Array:
        """T_cam_later (4, 4), the motion during the exposure, from that between this frame and a neighbour."""
        T, run = self.course.T_dock_cam, self.course.run
        other = number + 1 if number + 1 < len(T) and run[number + 1] == run[number] else number - 1
        if other < 0 or run[other] != run[number]:
            return np.eye(4)
        lapse_s = float(self.course.t_ns[other] - self.course.t_ns[number]) * 1e-9
        return np.asarray(se3_exp(se3_log(se3_inverse(T[number]) @ T[other]) * (exposure_s / lapse_s)))

    def _dark(self, number: int, t_s: float) -> Indices:
        """Indices of the lights that are dark."""
        scenario, station, drawn = self.scenario, self.station, self.drawn
        if drawn.black[number] or not scenario.detections.dock:
            return np.arange(len(station))
        run = int(self.course.run[number])
        rng = np.random.default_rng([self.seed, Draw.MISSING_LIGHTS, int(self.course.missing_from[number])])
        front = station.lights_of(station.layers_front_to_rear()[0])
        lit = in_view(station, self.camera, self.course.T_dock_cam[number])[1]
        off = drawn.dead[run] | failed(scenario, station, np.array([t_s]))[0]
        off[dark_lights(scenario, front[lit[front]], rng)] = True
        dropped = np.random.default_rng([self.seed, Draw.DROPPED_LIGHTS, number]).random(len(off))
        return np.flatnonzero(off | (dropped < scenario.detections.drop))

    def _spurious(self, number: int) -> Array:
        """Pixels (S, 2) of the spurious lights: those that wander, and those of this frame alone."""
        scenario, camera = self.scenario, self.camera
        if self.drawn.black[number]:
            return np.empty((0, 2))
        rng = np.random.default_rng([self.seed, Draw.SPURIOUS_LIGHTS, number])
        new = int(rng.poisson(scenario.detections.clutter))
        if scenario.path.kind == "draws":
            new += int(rng.integers(*scenario.faults.spurious, endpoint=True))
        low, high = np.full(2, -0.5), np.array([camera.width, camera.height]) - 0.5
        uv, lit = in_view(self.station, camera, self.course.T_dock_cam[number])
        if scenario.detections.place == "beside" and lit.any():
            margin = 0.25 * np.ptp(uv[lit], axis=0)
            low, high = np.maximum(low, uv[lit].min(axis=0) - margin), np.minimum(high, uv[lit].max(axis=0) + margin)
        return np.concatenate([self.spurious_uv[number], low + rng.random((new, 2)) * (high - low)])


def schedule_of(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Schedule:
    """Draw the schedule of a scenario; automatic exposure is not yet applied."""
    course = course_of(scenario, station, camera, np.random.default_rng([seed, Draw.COURSE]))
    drawn = run_draws(scenario, station, course, np.random.default_rng([seed, Draw.RUN]))
    wander: Array = np.empty((len(course.t_ns), 0, 2))
    if scenario.path.kind != "draws":
        size = (camera.width, camera.height)
        wander = spurious_paths(scenario, course.t_ns, size, np.random.default_rng([seed, Draw.WANDERING_LIGHTS]))
    exposure_s = np.full(len(course.t_ns), scenario.sensor.exposure_ms * 1e-3)
    return Schedule(
        scenario, station, camera, seed, course=course, drawn=drawn, spurious_uv=wander, exposure_s=exposure_s
    )


def with_auto_exposure(schedule: Schedule) -> Schedule:
    """The same schedule with the exposures that automatic exposure sets, if the scenario has it."""
    control = schedule.scenario.sensor.auto_exposure
    if control is None:
        return schedule
    return replace(
        schedule, exposure_s=controlled(schedule, control, [metered(schedule, k) for k in range(len(schedule))])
    )


def metered(schedule: Schedule, number: int) -> Indices:
    """Histogram (160,) of the light in a frame, in electrons per ms; each 2 x 2 cell of a mosaic counts once."""
    conditions = schedule.conditions(number)
    electrons = schedule.renderer(number).expect(conditions).electrons
    step = 2 if schedule.scenario.output.color else 1
    cells = cv2.resize(electrons, None, fx=1.0 / step, fy=1.0 / step, interpolation=cv2.INTER_AREA)
    light = cells / (1e3 * conditions.exposure_s)
    counts = np.histogram(np.clip(light, _METER_BINS[0], 0.999 * _METER_BINS[-1]), _METER_BINS)[0]
    return np.asarray(counts, np.int64)


def controlled(schedule: Schedule, knobs: AutoExposure, light: list[Indices]) -> Array:
    """Exposures (N,) s set by the control loop; each depends on the histograms `light` of the frames before it."""
    sensor, middle = schedule.scenario.sensor, np.sqrt(_METER_BINS[1:] * _METER_BINS[:-1])
    full_e = LEVELS * electrons_per_level(sensor)
    exposure_ms = np.empty(len(light))
    now = float(np.clip(sensor.exposure_ms, knobs.min_ms, knobs.max_ms))
    for number, counts in enumerate(light):
        exposure_ms[number] = now
        level = np.minimum(middle * now / full_e, 1.0) ** (1.0 / sensor.gamma)
        share = np.cumsum(counts[::-1])[::-1] / counts.sum()  # share of pixels that are at least as bright
        bright = float(level[np.flatnonzero(share >= _BRIGHT_SHARE)[-1]])
        wanted = min(np.log(knobs.mean / float((level * counts).sum() / counts.sum())), np.log(knobs.bright / bright))
        now = float(np.clip(now * np.exp(knobs.gain * sensor.gamma * wanted), knobs.min_ms, knobs.max_ms))
    return exposure_ms * 1e-3
