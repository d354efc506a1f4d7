"""A scenario, read from YAML: the path of the camera, and settings of water, lights, camera and faults."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from lumidock.datatypes import Array
from lumidock.errors import InputError
from lumidock.sim.fault_knobs import PointFaults
from lumidock.sim.knobs import (
    AidingKnobs,
    Angle,
    Angles,
    Counts,
    Daylight,
    Distance,
    DockingKnobs,
    Interval,
    KnobSection,
    Lamps,
    Lengths,
    LensKnobs,
    Output,
    Probability,
    Reaches,
    Sensor,
    StreamFaults,
    Surroundings,
    WaterKnobs,
)
from lumidock.sim.matter import Matter
from lumidock.yamlfile import read_mapping, validate

R_DOCK_CAM_HEAD_ON = np.diag([1.0, -1.0, -1.0])
_MAX_FRAMES = 100_000
_DEFAULT_STATION = "cage-2x2x5"
_BETWEEN_DRAWS_S = 60.0  # more than the time after which every track is dropped


_OF_DRAWS = ("count", "hold", "hold_deg_s", "z_m", "turn_deg", "tilt_deg")  # knobs of a path of kind draws alone


class Path3D(KnobSection):
    """The camera's path.

    approach: along the dock's axis. rectangle: once around a rectangle at constant z. draws: independent random poses,
    each with the whole front layer in view.
    """

    kind: Literal["approach", "rectangle", "draws"] = "approach"
    start_z_m: Distance = 30.0
    end_z_m: Distance = -3.0
    speed_m_s: PositiveFloat = 1.0
    speed_spread_m_s: NonNegativeFloat = 0.0  # a run's speed is uniform within this of speed_m_s
    frame_interval_s: PositiveFloat = 0.15
    half_width_m: Annotated[float, Field(gt=0, le=1000)] = 9.0  # half width of the rectangle
    half_height_m: Annotated[float, Field(gt=0, le=1000)] = 7.5
    sway_m: Reaches = (0.7, 0.7, 0.0)  # largest deviation from the path in x, y, z, far from the dock
    sway_deg: Angles = (2.1, 2.1, 3.0)  # largest pitch, yaw, roll, far from the dock
    near_sway_m: Reaches = (0.035, 0.035, 0.0)  # the same from taper_z_m[1] on
    near_sway_deg: Angles = (0.35, 0.35, 0.5)
    taper_z_m: tuple[float, float] = (15.0, 2.0)  # z between which the sway shrinks
    sway_period_s: tuple[PositiveFloat, PositiveFloat] = (7.0, 20.0)  # shortest and longest period in the sway
    rock_deg: Angle = 0.0  # largest pitch and roll of a dock that swings about its origin ...
    rock_period_s: PositiveFloat = 6.0  # ... with this period
    count: PositiveInt = 1000  # number of draws
    hold: PositiveInt = 1  # consecutive frames of each draw, moving toward the dock at speed_m_s
    hold_deg_s: NonNegativeFloat = 2.0  # largest rate about each axis in these frames
    z_m: Lengths = (3.0, 19.0)  # of the draws
    turn_deg: Angles = (3.0, 3.0, 3.0)  # largest pitch, yaw, roll of the draws, each uniform
    tilt_deg: Angle | None = None  # replaces pitch and yaw: largest tilt, in any direction

    @model_validator(mode="after")
    def _draws_alone_are_counted(self) -> Self:
        given = "" if self.kind == "draws" else next((name for name in _OF_DRAWS if name in self.model_fields_set), "")
        if given:
            how = "its frames follow from its length, speed_m_s and frame_interval_s"
            raise ValueError(f"{given}: belongs to a path of kind draws, and this one is of kind {self.kind}; {how}")
        return self

    @model_validator(mode="after")
    def _path_has_frames(self) -> Self:
        if self.speed_spread_m_s >= self.speed_m_s:
            raise ValueError("speed_spread_m_s: has to be less than speed_m_s")
        if self.kind == "draws":
            if self.count * self.hold > _MAX_FRAMES:
                raise ValueError(f"count times hold is more than {_MAX_FRAMES} frames")
            if not 1e-6 <= self.frame_interval_s * self.hold <= _BETWEEN_DRAWS_S / 2:
                raise ValueError(f"frame_interval_s times hold is not within 1e-6 and {_BETWEEN_DRAWS_S / 2:g} s")
            return self
        length = (
            abs(self.start_z_m - self.end_z_m)
            if self.kind == "approach"
            else 4.0 * (self.half_width_m + self.half_height_m)
        )
        slowest = self.speed_m_s - self.speed_spread_m_s
        step = slowest * self.frame_interval_s
        if not 0.0 < step < 1e6 or length / step > _MAX_FRAMES:
            raise ValueError(f"speed_m_s times frame_interval_s gives no path of at most {_MAX_FRAMES} frames")
        if self.frame_interval_s < 1e-6 or length / slowest > 1e9:
            raise ValueError("stamps of this path do not fit into nanoseconds")
        if self.taper_z_m[0] <= self.taper_z_m[1]:
            raise ValueError("taper_z_m: the larger distance has to come first")
        if self.sway_period_s[0] > self.sway_period_s[1]:
            raise ValueError("sway_period_s: the shorter period has to come first")
        return self


class Faults(KnobSection):
    """Missing and spurious lights."""

    missing: Counts = (0, 0)  # front lights that are dark, drawn in each frame, once for the frames of a draw
    spurious: Counts = (0, 0)  # that wander over the picture, drawn once a run; in a path of draws in each frame


class AttitudeSensor(KnobSection):
    """Errors of the vehicle's own compass and tilt sensors, 1 sigma about each axis."""

    bias_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 2.0  # constant through a run
    noise_deg: Angle = 0.1  # independent in each frame


class BlackOuts(KnobSection):
    """Times in which nothing is detected."""

    at_s: tuple[Interval, ...] = ()  # begin and end of each, since the start
    count: Counts = (0, 0)  # number of further ones, at random times of a run
    length_s: Lengths = (0.2, 2.0)  # duration of each of these


class DetectionKnobs(KnobSection):
    """Bare detections, made without rendering. Each draw of a path of draws is a run of its own."""

    # name of a shipped scenario: detections are made as the detector was measured on its rendered frames, with misses,
    # errors of centroid and layer, and false detections; noise_px, the ranges, wrong_layer and color are then not used
    detector: str = ""
    noise_px: NonNegativeFloat = 0.5
    front_range_m: Lengths = (40.0, 40.0)  # range beyond which front lights are not seen, drawn once a run
    rear_range_m: Lengths = (20.0, 20.0)
    wrong_layer: Probability = 0.0  # that p_rear is wrong; of spurious ones, that it is not of front lights
    color: bool = True  # False: p_rear is unknown
    drop: Probability = 0.0  # that a light is missed, for each light in each frame
    dead: Counts = (0, 0)  # number of lights that are dark through a run
    # mean number of further spurious detections in each frame, Poisson distributed
    clutter: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    place: Literal["picture", "beside"] = "picture"  # of these; beside: within 1.5 times the box of the lights
    dock: bool = True  # whether there is a dock
    mirror: Literal["none", "only"] = "none"  # only: the mirror image in the water surface is seen, not the dock
    surface_m: Lengths = (1.0, 4.0)  # height of the water surface above the dock's origin
    glints: Counts = (0, 0)  # number of glints fixed to the structure beside lamps, those of dead lamps first
    glint_m: Lengths = (0.05, 0.15)  # distance of a glint from its lamp
    bent_m: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0  # by which one light is off its surveyed position
    front_off_s: tuple[Interval, ...] = ()  # times since the start in which the front layer is dark
    survey: bool = False  # whether lights are displaced by errors of the station's survey_sigma
    calibration: bool = False  # whether the lens has errors of the station's calibration_sigma
    black_outs: BlackOuts = BlackOuts()
    attitude: AttitudeSensor | None = None
    faults: PointFaults = PointFaults()
    aiding: AidingKnobs | None = None


class Scenario(KnobSection):
    """Everything that defines a simulation beside the seed, the station and the camera."""

    name: str = "approach"
    about: str = ""
    station: str | None = None  # shipped station of the scenario; without one the cage of the paper
    path: Path3D = Path3D()
    water: WaterKnobs = WaterKnobs()
    daylight: Daylight = Daylight()
    lamps: Lamps = Lamps()
    around: Surroundings = Surroundings()
    matter: Matter = Matter()
    lens: LensKnobs = LensKnobs()
    sensor: Sensor = Sensor()
    output: Output = Output()
    stream: StreamFaults = StreamFaults()
    faults: Faults = Faults()
    detections: DetectionKnobs = DetectionKnobs()
    docking: DockingKnobs = DockingKnobs()
    config: dict[str, Any] = Field(default_factory=dict)  # configuration of the localizer that the scenario needs
    # of a scenario of faults: whether it lies within the assumptions of the safety case, at their edge, or outside
    assumptions: Literal["", "inside", "edge", "outside"] = ""
    says: str = ""  # the reason that has to end the trust in the pose, of a fault outside them that can be told

    @model_validator(mode="after")
    def _path_suits(self) -> Self:
        if self.detections.mirror == "only" and self.path.kind != "draws":
            raise ValueError("detections.mirror: only needs a path of draws, whose camera is turned up to the surface")
        if self.detections.faults.any and self.path.kind == "draws":
            raise ValueError("detections.faults: are those of a run along a path, not of draws")
        return self

    @property
    def shows_dock(self) -> bool:
        """Whether a detection can be a light of the dock."""
        return self.detections.dock and self.detections.mirror == "none"


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with the package, but for those of faults."""
    return _names("scenarios")


def fault_scenarios() -> list[str]:
    """Names of the shipped scenarios of faults at point level: `faults/NAME`."""
    return [f"faults/{name}" for name in _names("scenarios/faults")]


def _names(folder: str) -> list[str]:
    """Names of the scenarios in a folder of the package."""
    entries = (files("lumidock.sim") / folder).iterdir()
    return sorted(Path(entry.name).stem for entry in entries if entry.name.endswith(".yaml"))


def station_of(scenario: Scenario) -> Path:
    """File of the shipped station that a scenario is made for: its `station`, or the cage of the paper.

    Raises: InputError when no such station is shipped.
    """
    folder = Path(str(files("lumidock"))) / "stations"
    path = folder / f"{scenario.station or _DEFAULT_STATION}.yaml"
    if not path.is_file():
        shipped = ", ".join(sorted(entry.stem for entry in folder.glob("*.yaml")))
        raise InputError(f"{scenario.name}: station {scenario.station} is not shipped; there are {shipped}")
    return path


def load_scenario(name: str, settings: tuple[str, ...] = ()) -> Scenario:
    """Read a shipped scenario or a file, and apply settings of the form `key.subkey=value`.

    Raises: InputError, one line, for an unknown name, key or value.
    """
    if name in shipped_scenarios() or name in fault_scenarios():
        with as_file(files("lumidock.sim") / "scenarios" / f"{name}.yaml") as path:
            content = read_mapping(path)
    elif Path(name).suffix in (".yaml", ".yml"):
        content = read_mapping(Path(name), "scenario")
    else:
        near = difflib.get_close_matches(name, shipped_scenarios(), n=1)
        meant = f", did you mean {near[0]}? There" if near else "; there"
        raise InputError(f"{name}: no such scenario{meant} are {', '.join(shipped_scenarios())}, or give a .yaml file")
    for setting in settings:
        _apply(content, setting)
    return validate(Scenario, content, name)


def load_scenarios(names: Sequence[str], settings: tuple[str, ...] = ()) -> list[Scenario]:
    """Read scenarios as `load_scenario` does; `faults` stands for all of faults at point level. Raises: InputError."""
    wanted = [one for name in names for one in (fault_scenarios() if name == "faults" else [name])]
    return [load_scenario(name, settings) for name in wanted]


def _apply(content: dict[str, Any], setting: str) -> None:
    """Change the value of one `key.subkey=value` in nested content."""
    key, equals, value = setting.partition("=")
    *parents, last = key.strip().split(".")
    for parent in parents:
        content = content.setdefault(parent, {})
        if not isinstance(content, dict):
            raise InputError(f"--set {setting}: {parent} takes no sub-keys")
    if not equals or not last:
        raise InputError(f"--set {setting}: wanted key=value")
    try:
        content[last] = yaml.safe_load(value)
    except yaml.YAMLError:
        raise InputError(f"--set {setting}: the value is not valid YAML") from None


def trajectory(
    scenario: Scenario, rng: np.random.Generator, *, interval_s: float | None = None, rocking: bool = True
) -> tuple[np.ndarray, Array]:
    """Stamps `t_ns` (N,) and true poses `T_dock_cam` (N, 4, 4) of a scenario that has a path.

    At another interval than that of the frames on demand; without `rocking` the dock is where it is on average.
    Raises: InputError for a path of draws, which has no trajectory.
    """
    path = scenario.path if interval_s is None else scenario.path.model_copy(update={"frame_interval_s": interval_s})
    if path.kind == "draws":
        raise InputError(f"{scenario.name}: draws can only be simulated as bare detections (--detections)")
    speed_m_s = path.speed_m_s
    if path.speed_spread_m_s:
        speed_m_s += rng.uniform(-path.speed_spread_m_s, path.speed_spread_m_s)
    nominal = _approach(path, speed_m_s) if path.kind == "approach" else _rectangle(path, speed_m_s)
    t_s = np.arange(len(nominal)) * path.frame_interval_s
    share = np.clip((nominal[:, 2] - path.taper_z_m[1]) / (path.taper_z_m[0] - path.taper_z_m[1]), 0.0, 1.0)[:, None]
    sway = _wander(t_s, 6, path.sway_period_s, rng)
    shift = sway[:, :3] * (np.array(path.near_sway_m) * (1 - share) + np.array(path.sway_m) * share)
    turn = sway[:, 3:] * np.deg2rad(np.array(path.near_sway_deg) * (1 - share) + np.array(path.sway_deg) * share)
    T_dock_cam = poses(R_DOCK_CAM_HEAD_ON @ rotations(turn), nominal + shift)
    if path.rock_deg and rocking:
        T_dock_cam = _rocked(path, t_s, T_dock_cam, rng)
    return np.round(t_s * 1e9).astype(np.int64), T_dock_cam


def _rocked(path: Path3D, t_s: Array, T_mean_cam: Array, rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) in a dock that pitches and rolls about its origin, from those in the dock's mean pose."""
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    swing = np.sin(2 * np.pi * t_s[:, None] / path.rock_period_s + phase) * np.deg2rad(path.rock_deg) * [1.0, 0.0, 1.0]
    R_dock_mean = rotations(-swing)
    R, t = R_dock_mean @ T_mean_cam[:, :3, :3], (R_dock_mean @ T_mean_cam[:, :3, 3:])[:, :, 0]
    return poses(R, t)


def rotations(w: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors `w` (N, 3) rad. Source: Rodrigues."""
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    W = np.zeros((len(w), 3, 3))
    W[:, 2, 1], W[:, 0, 2], W[:, 1, 0] = w.T
    W -= W.transpose(0, 2, 1)
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + first * W + second * (W @ W))


def poses(R_dock_cam: Array, t_dock_cam: Array) -> Array:
    """Poses `T_dock_cam` (N, 4, 4) of rotations (N, 3, 3) and positions (N, 3) m."""
    T_dock_cam = np.zeros((len(t_dock_cam), 4, 4))
    T_dock_cam[:, :3, :3], T_dock_cam[:, :3, 3], T_dock_cam[:, 3, 3] = R_dock_cam, t_dock_cam, 1.0
    return T_dock_cam


def draw_stamps(path: Path3D) -> np.ndarray:
    """Stamps `t_ns` (count, hold) of draws, so far apart that no track survives from one draw to the next."""
    start, step = np.arange(path.count) * _BETWEEN_DRAWS_S, np.arange(path.hold) * path.frame_interval_s
    return np.round((start[:, None] + step) * 1e9).astype(np.int64)


def _approach(path: Path3D, speed_m_s: float) -> Array:
    step = speed_m_s * path.frame_interval_s
    count = round(abs(path.start_z_m - path.end_z_m) / step) + 1
    z = path.start_z_m + np.arange(count) * np.sign(path.end_z_m - path.start_z_m) * step
    return np.stack([np.zeros(count), np.zeros(count), z], axis=1)


def _rectangle(path: Path3D, speed_m_s: float) -> Array:
    w, h = path.half_width_m, path.half_height_m
    corners = np.array([[-w, -h], [-w, h], [w, h], [w, -h], [-w, -h]])
    sides = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.arange(0.0, sides[-1], speed_m_s * path.frame_interval_s)
    x, y = (np.interp(along, sides, corners[:, axis]) for axis in (0, 1))
    return np.stack([x, y, np.full(len(along), path.start_z_m)], axis=1)


def _wander(t_s: Array, count: int, period_s: tuple[float, float], rng: np.random.Generator) -> Array:
    """Smooth random signals (N, count) within [-1, 1], each a sum of three sines."""
    periods = rng.uniform(*period_s, (3, count))
    phases = rng.uniform(0.0, 2 * np.pi, (3, count))
    shares = rng.dirichlet(np.full(3, 3.0), count).T
    return np.asarray((shares * np.sin(2 * np.pi * t_s[:, None, None] / periods + phases)).sum(axis=1))


def spurious_paths(scenario: Scenario, t_ns: np.ndarray, size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Pixels (N, S, 2) of spurious lights that wander over an image of `size` (width, height)."""
    count = int(rng.integers(*scenario.faults.spurious, endpoint=True))
    steps = _wander(t_ns * 1e-9, 2 * count, (3.0, 12.0), rng).reshape(len(t_ns), count, 2)
    return np.asarray((0.5 + 0.49 * np.clip(1.6 * steps, -1.0, 1.0)) * np.array(size))
