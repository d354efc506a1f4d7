"""What several sections of a reproduction compute; every function takes plain records and gives what JSON can hold."""

from __future__ import annotations

import platform
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS
from lumidock.app.run import Setup, run
from lumidock.camera import Camera, load_camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Fix, Frame, Indices, Unusable
from lumidock.errors import FrameError
from lumidock.evaluation.campaign import plan, run_shard
from lumidock.evaluation.campaign_table import row_of
from lumidock.evaluation.claims import pose_error
from lumidock.evaluation.counts import Tally
from lumidock.evaluation.metrics import evaluate, true_poses
from lumidock.methods import Method, localizer_of
from lumidock.reproduce.plan import Dock, resolved
from lumidock.reproduce.trials import verdict
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import Scenario, load_scenario, spurious_paths, station_of, trajectory
from lumidock.sim.sequence import file_of, render_frame, rendered
from lumidock.sim.stream import Row
from lumidock.station import Station, load_station
from lumidock.streams.images import decode_image
from lumidock.streams.replay import read_fixes
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.source import Source

_FOUR = 4  # identified lights of a layer that give a pose by it alone
_SAME_PX = 4.0  # a detection so near to the projection of a light is that light; at least, its own radius
Methods = tuple[str, ...]
Pictures = list[tuple[Row, bytes]]  # a sequence in memory, as `rendered` gives it


@dataclass(frozen=True, slots=True)
class Simulation:
    """A scenario with its settings on a dock, and a seed."""

    dock: Dock
    scenario: str
    settings: tuple[str, ...]
    seed: int

    def load(self) -> tuple[Scenario, Station, Camera]:
        """The scenario, the station that it names or else that of the dock, and the camera. Raises: InputError."""
        scenario = load_scenario(self.scenario, self.settings)
        return scenario, load_station(self.station_file(scenario)), load_camera(Path(self.dock.camera))

    def station_file(self, scenario: Scenario) -> Path:
        """The station that the scenario names, else that of the dock."""
        return station_of(scenario) if scenario.station else Path(self.dock.station)


def machine() -> str:
    """The processor that times were taken on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(errors="replace").splitlines() if cpuinfo.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(names, "") or platform.processor() or platform.machine()


# At point level


def acquisition_trial(simulation: Simulation, methods: Methods, config: Config) -> dict[str, Any]:
    """Independent frames without history: answers, right ones and those with a wrong identity, by method."""
    scenario, station, camera = simulation.load()
    frames = list(simulated_frames(scenario, station, camera, simulation.seed))
    result: dict[str, Any] = {"frames": len(frames)}
    for name in methods:
        method, settings = resolved(name, config)
        localizer = localizer_of(method, station, camera, settings, cold=True)
        fixes = [localizer.process_detections(frame.detections) for frame in frames]
        verdicts = np.array([verdict(fix, frame) for fix, frame in zip(fixes, frames, strict=True)]).reshape(-1, 2)
        answered = sum(fix.status != "none" for fix in fixes)
        right, wrong = (int(column.sum()) for column in verdicts.T)
        result[name] = {"answered": answered, "right": right, "wrong": wrong}
    return result


def campaign(simulation: Simulation) -> dict[str, Any]:
    """One seed of a shipped scenario at point level by our method: a row of a campaign's table."""
    dock, tally, seed = simulation.dock, Tally(), simulation.seed
    scenario = load_scenario(simulation.scenario, simulation.settings)
    files = simulation.station_file(scenario), Path(dock.camera)
    for shard in plan([scenario], ["lumidock"], (seed, seed + 1), *files).shards:
        tally.merge(Tally.from_dict(run_shard(shard)["tally"]))
    return row_of(tally)


# Rendered


def docking(simulation: Simulation, folder: str, keep: bool, methods: Methods, config: Config) -> dict[str, Any]:
    """Render a scenario in memory and run the methods on it, into `folder`; pictures only to `keep` are written."""
    scenario, station, camera = simulation.load()
    place = Path(folder)
    shutil.rmtree(place, ignore_errors=True)
    sequence = place / "sequence"
    sequence.mkdir(parents=True)
    station_file = simulation.station_file(scenario)
    shutil.copyfile(station_file, sequence / "station.yaml")
    pictures = rendered(scenario, station, camera, simulation.seed, sequence)
    if keep:
        (sequence / "frames").mkdir()
        for row, content in pictures:
            (sequence / "frames" / file_of(row, scenario)).write_bytes(content)
    result: dict[str, Any] = {"machine": machine()}
    for name in methods:
        setup = Setup(*_setup(name, config), station_file, sequence / "camera.yaml")
        result[name] = _run_method(setup, pictures, place / name)
    return result


def docking_leaves(folder: Path, keep: bool, methods: Methods) -> tuple[Path, ...]:
    """The files of `docking` that a page needs."""
    of_sequence = ("truth.csv", "lights_truth.csv", "timestamps.csv", "station.yaml", "camera.yaml", *["frames"] * keep)
    of_run = ("fixes.csv", "lights.csv", "run.json", "station.yaml", "camera.yaml")
    sequence = tuple(folder / "sequence" / name for name in of_sequence)
    return sequence + tuple(folder / method / name for method in methods for name in of_run)


def _setup(name: str, config: Config) -> tuple[str, bool, Config]:
    method, settings = resolved(name, config)
    return method, False, settings


def _run_method(setup: Setup, pictures: Pictures, out: Path) -> dict[str, Any]:
    station, camera = load_station(setup.station), load_camera(setup.camera)
    sequence = setup.camera.parent
    inputs = (sequence / "timestamps.csv",)
    source = Source(sequence, "sequence", lambda _: _items(pictures), len(pictures), inputs=inputs)
    _warm(localizer_of(setup.method, station, camera, setup.config), pictures)
    timed = _Timed(localizer_of(setup.method, station, camera, setup.config))
    with RunFolder(out, station.ids) as run_folder:
        for file, name in ((setup.station, "station.yaml"), (setup.camera, "camera.yaml")):
            shutil.copyfile(file, out / name)
        run(source, timed, run_folder, setup)
    return evaluate(out, sequence) | reach(out, sequence, timed.cpu_ms)


class _Timed:
    """A method whose CPU time is kept by frame: unlike the time that passes, it bears other work on the machine."""

    def __init__(self, localizer: Method) -> None:
        self.cpu_ms: dict[str, float] = {}
        self.process_detections, self.forget = localizer.process_detections, localizer.forget
        self._process = localizer.process

    def process(self, frame: Frame) -> Fix:
        """Fix of one frame. Raises: FrameError."""
        start = time.process_time()
        fix = self._process(frame)
        self.cpu_ms[frame.name] = 1e3 * (time.process_time() - start)
        return fix


def _items(pictures: Pictures) -> Iterator[Frame | Unusable]:
    """Frames, or what is wrong with their pictures."""
    for row, content in pictures:
        try:
            yield Frame(row.name, row.t_ns, decode_image(content, row.name))
        except FrameError as error:
            yield Unusable(row.name, row.t_ns, error.reason, str(error))


def _warm(localizer: Method, pictures: Pictures) -> None:
    """Compile before times are taken, for frames with and without a frame before: the first of them take seconds."""
    count = len(pictures)
    chosen = {*range(0, count, max(1, count // 6)), *range(count // 2, count // 2 + 6), *range(count - 4, count)}
    for item in _items([pictures[k] for k in sorted(chosen & set(range(count)))]):
        with suppress(FrameError):
            if isinstance(item, Frame):
                localizer.process(item)


def reach(run_folder: Path, truth: Path, cpu_ms: Mapping[str, float]) -> dict[str, Any]:
    """Where a run could first and last be used, by true z: at all, and by four or more identified lights of each layer.

    Also how far from the dock's axis its poses were, and its CPU times with one layer identified and with more.
    """
    station, true = load_station(run_folder / "station.yaml"), true_poses(truth)
    fixes = [fix for fix, _, _ in read_fixes(run_folder, station.ids) if fix.frame in true]
    identified = np.array([_identified_by_layer(fix, station) for fix in fixes]).reshape(len(fixes), -1)
    z = np.array([true[fix.frame][2, 3] for fix in fixes])
    valid = np.array([fix.valid for fix in fixes], bool)
    guided = np.array([fix.guide is not None for fix in fixes], bool)
    ms = np.array([cpu_ms.get(fix.frame, np.nan) for fix in fixes])
    layers = (identified >= _FOUR).sum(axis=1)
    off_axis = [float(np.hypot(*fix.T_dock_cam[:2, 3])) for fix in fixes if fix.T_dock_cam is not None]
    usable = valid | guided
    by_layer = {
        name: first_and_last(z, usable & (identified[:, k] >= _FOUR)) for name, k in (("front", 0), ("rear", -1))
    }
    return {
        "reach": {
            "valid": first_and_last(z, valid),
            "guide": first_and_last(z, guided),
            "usable": first_and_last(z, usable),
            **by_layer,
        },
        "off_axis_m": max(off_axis, default=None),
        "ms": {"single": _median(ms[layers == 1]), "dual": _median(ms[layers > 1])},
    }


def _identified_by_layer(fix: Fix, station: Station) -> list[int]:
    light = np.empty(0, np.int64) if fix.match is None else fix.match.light[fix.match.light >= 0]
    return [int(np.isin(light, station.lights_of(layer)).sum()) for layer in station.layers_front_to_rear()]


def first_and_last(z: Array, which: np.ndarray) -> list[float] | None:
    """First and last of the z m of those frames (N,) in `which`; None of none."""
    found = z[which]
    return [float(found[0]), float(found[-1])] if len(found) else None


def _median(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


def rendered_frames(simulation: Simulation) -> Iterator[tuple[Array, Frame]]:
    """True T_dock_cam and picture of each frame of a scenario."""
    scenario, station, camera = simulation.load()
    t_ns, poses = trajectory(scenario, np.random.default_rng([simulation.seed, 0]))
    paths = np.random.default_rng([simulation.seed, 2])
    spurious = spurious_paths(scenario, t_ns, (camera.width, camera.height), paths)
    for number, (t, T_dock_cam) in enumerate(zip(t_ns.tolist(), poses, strict=True)):
        rng, nothing = np.random.default_rng([simulation.seed, 3, number]), np.empty(0, np.int64)
        image, _, _ = render_frame(
            scenario, station, camera, T_dock_cam, spurious[number], dark=nothing, rng=rng
        )  # fmt: skip
        yield T_dock_cam, Frame(f"{number:06d}", t, image)


def true_lights(detections: Detections, uv: Array) -> Indices:
    """Light (N,) of each detection, -1 where none is near; `uv` (M, 2) px of the lights, NaN for those not to be seen.

    A light belongs to the nearest detection within 4 px, or within that detection's own radius.
    """
    light = np.full(len(detections), -1, np.int64)
    for i in np.flatnonzero(np.isfinite(uv[:, 0])):
        away = np.linalg.norm(detections.uv - uv[i], axis=1)
        if len(away) and away.min() <= max(_SAME_PX, float(np.nan_to_num(detections.radius_px[away.argmin()]))):
            light[away.argmin()] = i
    return light


def over_limit(T_dock_cam: Array, true_T_dock_cam: Array) -> bool:
    """Whether the error of a pose is over the alert limit at its distance."""
    error = pose_error(T_dock_cam, true_T_dock_cam)
    sizes = np.hypot(*error[:2]), abs(error[2]), np.linalg.norm(error[3:])
    return bool((np.array(sizes) > DEFAULT_ALERT_LIMITS.of_pose(float(T_dock_cam[2, 3]), 0.0)).any())
