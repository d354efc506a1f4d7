"""One docking: the vehicle in the water, the camera, the method, guidance and the state machine, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Fix
from lumidock.docking.cage import Frame
from lumidock.docking.control import Controller
from lumidock.docking.guidance import steer, sweep
from lumidock.docking.instruments import Instruments
from lumidock.docking.methods import AIDED, docking_method
from lumidock.docking.navigation import Navigator
from lumidock.docking.states import DOCKED_M, Machine, Step, Transition
from lumidock.docking.vehicle import R_DOCK_APPROACH, Current, Motion, Rocking, T_dock_cam_of, Three, VehicleModel
from lumidock.go_no_go import Passage
from lumidock.localizer import Localizer
from lumidock.methods import Method
from lumidock.sim.draws import Draw
from lumidock.sim.point_camera import PointCamera, point_camera
from lumidock.sim.rendered_camera import RenderedCamera
from lumidock.sim.scenario import Scenario
from lumidock.station import Station
from lumidock.yamlfile import validate

Outcome = Literal["docked", "aborted", "out_of_time"]
_CONTROL_S = 0.05  # between two steps of the control: 20 Hz, a quarter of the thrusters' lag
_NEAR_M = 1.0  # before the entrance the hull, behind the camera, cannot touch the frame yet
_POSE_LIGHTS = 4  # with fewer no pose can be had


@dataclass(frozen=True, slots=True, eq=False)
class Docking:
    """What one docking needs: where, with what, by which method, and the seed of all its draws.

    `rendered`: the method is given pictures, not detections; slower by far.
    """

    scenario: Scenario
    station: Station
    camera: Camera
    vehicle: VehicleModel
    method: str
    seed: int
    rendered: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame of a docking: the truth, what the vehicle reckoned, what it decided, and the fix, if a frame came."""

    t_s: float
    T_dock_cam: Array
    reckoned: Three  # the camera's position in approach
    level_m: float
    step: Step
    fix: Fix | None
    lights_seen: int
    room_m: float
    error_m: float  # of the pose that was used in this frame; NaN without one


@dataclass(frozen=True, slots=True)
class DockingResult:
    """What came of a docking.

    `miss_m`: true distance of the camera from the docking point at the end; `room_m`: least distance between hull and
    frame; `worst_fix_m`: largest error of a pose that was followed, `misleading`: how many of these were over the alert
    limit. `right`: whether an abort had a cause in the truth. `log`: the changes of state with their reasons.
    """

    seed: int
    outcome: Outcome
    word: str
    time_s: float
    miss_m: float
    room_m: float
    worst_fix_m: float
    misleading: int
    right: bool
    current_m_s: float
    tries: int
    valid: int
    frames: int
    log: tuple[Transition, ...]

    @property
    def contact(self) -> bool:
        """Whether the hull touched the frame."""
        return self.room_m < 0.0

    @property
    def docked(self) -> bool:
        """Whether the vehicle said that it was docked, and was."""
        return self.outcome == "docked" and self.miss_m <= DOCKED_M and not self.contact

    def as_dict(self) -> dict[str, Any]:
        """For JSON; infinite and unknown numbers are None."""
        plain = {name: getattr(self, name) for name in self.__slots__ if name != "log"}
        plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in plain.items()}
        log = [{"t_s": round(one.t_s, 3), "state": one.state, "why": one.why} for one in self.log]
        return {"docked": self.docked, "contact": self.contact, **plain, "log": log}


@dataclass(slots=True)
class World:
    """The truth of one docking as it runs."""

    motion: Motion
    rocking: Rocking
    water: Current
    instruments: Instruments
    frame: Frame
    room_m: float = math.inf

    def pose(self, t_s: float) -> Array:
        """True pose of cam in dock (4, 4)."""
        pitch, roll = self.rocking.at(t_s)
        return T_dock_cam_of(self.motion.model, self.motion.position, (self.motion.heading_rad, pitch, roll))

    def measure_room(self) -> float:
        """Distance of the hull from the frame now, m; keeps the least."""
        c, s = math.cos(self.motion.heading_rad), math.sin(self.motion.heading_rad)
        R_approach_body = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        R_dock_body = R_DOCK_APPROACH @ R_approach_body
        room_m = self.frame.room_m(self.motion.model, R_dock_body, R_DOCK_APPROACH @ np.array(self.motion.position))
        self.room_m = min(self.room_m, room_m)
        return room_m


def start(docking: Docking) -> World:
    """The vehicle at its drawn place, in its drawn current."""
    rng, knobs = np.random.default_rng([docking.seed, Draw.VEHICLE]), docking.scenario.docking
    speed, way = rng.uniform(*knobs.current_m_s), rng.uniform(0.0, 2.0 * math.pi)
    off = rng.normal(size=2) * knobs.start_off_m
    heading = float(rng.normal()) * math.radians(knobs.start_yaw_deg)
    place = (-float(rng.uniform(*knobs.start_z_m)) - docking.vehicle.half_m[0], float(off[0]), float(off[1]))
    mean = (speed * math.cos(way), speed * math.sin(way), 0.0)
    return World(
        Motion(docking.vehicle, place, heading),
        Rocking.drawn(math.radians(knobs.rocking_deg), rng),
        Current(mean, knobs.turbulence * speed, np.random.default_rng([docking.seed, Draw.VEHICLE, 1])),
        Instruments.drawn(np.random.default_rng([docking.seed, Draw.VEHICLE, 2])),
        Frame.of(docking.scenario, docking.station),
    )


@dataclass(slots=True)
class Pilot:
    """All that is aboard: navigation, state machine, control and the method; `aided` is it, where it takes aiding."""

    navigator: Navigator
    machine: Machine
    controller: Controller
    method: Method
    aided: Localizer | None = None
    wanted_step: Step | None = None
    moments: list[Moment] = field(default_factory=list)


def aboard(docking: Docking, world: World) -> Pilot:
    """The pilot at the start: it knows of the dock what acoustic homing and the compass tell."""
    reading = world.instruments.read(world.motion, world.rocking.at(0.0))
    model, station = docking.vehicle, docking.station
    navigator = Navigator(model, world.instruments.homed(model, world.motion), reading.heading_rad)
    passage = replace(Passage.of(station, model.radius_m), entry_m_s=2.0 * model.entry_m_s)
    machine = Machine(passage, model, -float(station.docking_point[2]))
    config = validate(Config, docking.scenario.config, f"{docking.scenario.name}: config")
    method = docking_method(docking.method, station, docking.camera, config)
    aided = method if docking.method == AIDED and isinstance(method, Localizer) else None
    return Pilot(navigator, machine, Controller(model), method, aided)


def run(docking: Docking) -> tuple[DockingResult, list[Moment]]:
    """One docking from the start to its end. Raises: InputError for a scenario that cannot be a closed loop."""
    interval_s = docking.scenario.path.frame_interval_s
    frames = int(docking.scenario.docking.time_limit_s / interval_s)
    world = start(docking)
    pilot = aboard(docking, world)
    eye = camera_of(docking, docking.camera, frames)
    look = _looker(docking, pilot.method, eye)
    for number in range(frames):
        if _frame(number, docking, world, pilot, look if number in eye.rows else None):
            break
        _sail(world, pilot, number * interval_s, interval_s)
    return _result(docking, world, pilot), pilot.moments


def camera_of(docking: Docking, camera: Camera, frames: int) -> PointCamera:
    """The camera of a docking of at most so many frames, with its lens or one like it."""
    return point_camera(docking.scenario, docking.station, camera, docking.seed, frames)


Look = Callable[[int, Array], tuple[Fix, int]]


def _looker(docking: Docking, method: Method, eye: PointCamera) -> Look:
    """What turns a frame's number and true pose into the method's fix, and the number of lights that were seen."""
    if not docking.rendered:

        def look(number: int, T_dock_cam: Array) -> tuple[Fix, int]:
            seen = eye.see(number, T_dock_cam)
            return method.process_detections(seen.detections), int((seen.light >= 0).sum())

        return look
    rendered = RenderedCamera(eye, docking.seed)

    def look_at_picture(number: int, T_dock_cam: Array) -> tuple[Fix, int]:
        fix = method.process(rendered.see(number, T_dock_cam))
        return fix, fix.n_used

    return look_at_picture


def _frame(number: int, docking: Docking, world: World, pilot: Pilot, look: Look | None) -> bool:
    """Look, localize, decide; True when the docking is over."""
    t_s = number * docking.scenario.path.frame_interval_s
    T_dock_cam, fix, lights, error_m = world.pose(t_s), None, 0, math.nan
    if look is not None:
        fix, lights = look(number, T_dock_cam)
        pilot.navigator.take(fix)
        if fix.T_dock_cam is not None:
            error_m = float(np.linalg.norm(fix.T_dock_cam[:3, 3] - T_dock_cam[:3, 3]))
    pilot.machine, pilot.wanted_step = pilot.machine.step(pilot.navigator, t_s)
    navigator = pilot.navigator
    moment = Moment(
        t_s,
        T_dock_cam,
        navigator.position,
        navigator.level_m,
        step=pilot.wanted_step,
        fix=fix,
        lights_seen=lights,
        room_m=world.measure_room() if T_dock_cam[2, 3] < _NEAR_M else math.inf,
        error_m=error_m,
    )
    pilot.moments.append(moment)
    return pilot.wanted_step.over


def _sail(world: World, pilot: Pilot, t_s: float, interval_s: float) -> None:
    """Steer and move until the next frame."""
    step, navigator, gain = pilot.wanted_step, pilot.navigator, pilot.controller.position_gain
    assert step is not None
    count = max(1, math.ceil(interval_s / _CONTROL_S))
    dt_s = interval_s / count
    for k in range(count):
        reading = world.instruments.read(world.motion, world.rocking.at(t_s + k * dt_s))
        wanted = steer(navigator, step.course, gain, pilot.controller.current)
        if step.state == "search" and t_s - pilot.machine.since_s > 10.0:
            wanted = replace(wanted, heading_rad=wanted.heading_rad + sweep(t_s))
        thrust = pilot.controller.step(wanted, reading, navigator.heading_rad, dt_s)
        before_s, after_s = t_s + k * dt_s, t_s + (k + 1) * dt_s
        T_dock_cam = world.pose(before_s) if pilot.aided is not None else None
        world.motion.step(thrust, world.water.step(dt_s), dt_s)
        if pilot.aided is not None and T_dock_cam is not None:
            for value in world.instruments.aiding(T_dock_cam, world.pose(after_s), round(after_s * 1e9), dt_s):
                pilot.aided.aid(value)
        navigator.reckon(reading, dt_s)


def _result(docking: Docking, world: World, pilot: Pilot) -> DockingResult:
    moments, log = pilot.moments, pilot.machine.log
    last, state = moments[-1], pilot.machine.state
    outcome: Outcome = "docked" if state == "docked" else "aborted" if state == "abort" else "out_of_time"
    fixes = [moment for moment in moments if math.isfinite(moment.error_m)]
    return DockingResult(
        seed=docking.seed,
        outcome=outcome,
        word=log[-1].why if outcome != "out_of_time" else state,
        time_s=last.t_s,
        miss_m=float(np.linalg.norm(last.T_dock_cam[:3, 3] - docking.station.docking_point)),
        room_m=world.room_m,
        worst_fix_m=max((moment.error_m for moment in fixes), default=math.nan),
        misleading=sum(is_misleading(moment, docking.station) for moment in fixes),
        right=outcome == "aborted" and had_a_cause(docking, pilot),
        current_m_s=math.hypot(*world.water.mean),
        tries=pilot.machine.tries,
        valid=len(fixes),
        frames=len(moments),
        log=log,
    )


def is_misleading(moment: Moment, station: Station) -> bool:
    """Whether the pose of a moment was over the alert limit across or along the axis."""
    fix = moment.fix
    if fix is None or fix.T_dock_cam is None:
        return False
    error = fix.T_dock_cam[:3, 3] - moment.T_dock_cam[:3, 3]
    lateral_m, axial_m, _ = station.alert_limits.of_pose(float(fix.T_dock_cam[2, 3]), 0.0)
    return bool(math.hypot(error[0], error[1]) > lateral_m or abs(error[2]) > axial_m)


def had_a_cause(docking: Docking, pilot: Pilot) -> bool:
    """Whether an abort was right: the station is not as surveyed, too few lights were seen, or the way was missed."""
    scenario = docking.scenario
    if scenario.docking.station_off_m > 0.0 or scenario.detections.bent_m > 0.0 or scenario.lens.focal_error != 0.0:
        return True
    leaving = next(one.t_s for one in reversed(pilot.machine.log) if one.state in ("back_out", "abort"))
    before = [one for one in pilot.moments if leaving - pilot.machine.passage.blind_s <= one.t_s <= leaving]
    dark = sum(one.lights_seen < _POSE_LIGHTS for one in before) > 0.5 * len(before)
    x, y, z = before[-1].T_dock_cam[:3, 3]
    return bool(dark or (z < pilot.machine.passage.gate_m and math.hypot(x, y) > pilot.machine.passage.clearance_m))
