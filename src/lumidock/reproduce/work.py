"""What the jobs of a reproduction compute; every function takes plain arguments and gives what JSON can hold."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.app.run import Setup, run
from lumidock.camera import Camera, load_camera
from lumidock.config import Config, PaperConfig
from lumidock.datatypes import Array, Fix, Frame, Unusable
from lumidock.errors import FrameError
from lumidock.evaluation.campaign import plan, run_shard
from lumidock.evaluation.campaign_table import row_of
from lumidock.evaluation.counts import Tally
from lumidock.evaluation.metrics import evaluate, true_poses
from lumidock.localizer import Localizer
from lumidock.methods import METHODS, Method, localizer_of
from lumidock.paper import PaperLocalizer, btekf
from lumidock.paper.layer import LayerLocalizer
from lumidock.pose import project_lights
from lumidock.reproduce.trials import Counts, trial, trials_scenario, verdict
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import Scenario, load_scenario, spurious_paths, station_of, trajectory
from lumidock.sim.sequence import file_of, render_frame, rendered
from lumidock.sim.stream import Row
from lumidock.station import Station, load_station
from lumidock.streams.images import decode_image
from lumidock.streams.replay import read_fixes
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.source import Source

_FOUR = 4  # named lights of a layer that give a pose by it alone
Dock = tuple[str, str]  # station and camera file
Pictures = list[tuple[Row, bytes]]  # a sequence in memory, as `rendered` gives it


def _load(dock: Dock) -> tuple[Station, Camera]:
    return load_station(Path(dock[0])), load_camera(Path(dock[1]))


def _dock_of(scenario: Scenario, dock: Dock) -> Dock:
    """The station that a scenario names, in place of the one of the reproduction, and the camera."""
    return (str(station_of(scenario)), dock[1]) if scenario.station else dock


# At point level


def table_1(dock: Dock, missing: int, spurious: int, first: int, stop: int, clean_start: bool) -> dict[str, Any]:
    """Trials `first` to `stop` - 1 of a row of Table 1."""
    station, camera = _load(dock)
    trials = (trial(station, camera, missing, spurious, seed, clean_start=clean_start) for seed in range(first, stop))
    return asdict(sum(trials, Counts()))


def acquisition_trial(dock: Dock, scenario: str, settings: list[str], seed: int) -> dict[str, Any]:
    """Independent frames without history by both methods: answers, right ones and those with a wrong name."""
    station, camera = _load(dock)
    loaded = load_scenario(scenario, tuple(settings))
    frames = list(simulated_frames(loaded, station, camera, seed))
    result: dict[str, Any] = {"frames": len(frames)}
    for method in METHODS:
        localizer = localizer_of(method, station, camera, Config(), cold=True)
        fixes = [localizer.process_detections(frame.detections) for frame in frames]
        verdicts = np.array([verdict(fix, frame) for fix, frame in zip(fixes, frames, strict=True)]).reshape(-1, 2)
        answered = sum(fix.status != "none" for fix in fixes)
        right, wrong = (int(column.sum()) for column in verdicts.T)
        result[method] = {"answered": answered, "right": right, "wrong": wrong}
    return result


def campaign(dock: Dock, scenario: str, settings: list[str], first: int, stop: int) -> dict[str, Any]:
    """Seeds of a shipped scenario at point level by our method: a row of a campaign's table."""
    loaded, tally = load_scenario(scenario, tuple(settings)), Tally()
    dock = _dock_of(loaded, dock)
    for shard in plan([loaded], ["lumidock"], (first, stop), Path(dock[0]), Path(dock[1])).shards:
        tally.merge(Tally.from_dict(run_shard(shard)["tally"]))
    return row_of(tally)


# Rendered


def docking(
    dock: Dock,
    scenario: str,
    settings: list[str],
    seed: int,
    folder: str,
    keep: bool,
    methods: Sequence[str] = tuple(METHODS),
) -> dict[str, Any]:
    """Render a scenario in memory and run the methods on it, into `folder`; pictures only to `keep` land there."""
    loaded, place = load_scenario(scenario, tuple(settings)), Path(folder)
    dock = _dock_of(loaded, dock)
    station, camera = _load(dock)
    shutil.rmtree(place, ignore_errors=True)
    sequence = place / "sequence"
    sequence.mkdir(parents=True)
    shutil.copyfile(dock[0], sequence / "station.yaml")
    pictures = rendered(loaded, station, camera, seed, sequence)
    if keep:
        (sequence / "frames").mkdir()
        for row, content in pictures:
            (sequence / "frames" / file_of(row, loaded)).write_bytes(content)
    return {method: _run_method(dock, method, sequence, pictures, place / method) for method in methods}


def _run_method(dock: Dock, method: str, sequence: Path, pictures: Pictures, out: Path) -> dict[str, Any]:
    station, camera = _load(dock)
    files = Path(dock[0]), sequence / "camera.yaml"
    setup, inputs = Setup(method, False, Config(), *files), (sequence / "timestamps.csv",)
    source = Source(sequence, "sequence", lambda _: _items(pictures), len(pictures), inputs=inputs)
    _warm(localizer_of(method, station, camera, Config()), pictures)
    with RunFolder(out, station.ids) as run_folder:
        for file, name in zip(files, ("station.yaml", "camera.yaml"), strict=True):
            shutil.copyfile(file, out / name)
        run(source, localizer_of(method, station, load_camera(files[1]), Config()), run_folder, setup)
    return evaluate(out, sequence) | reach(out, sequence)


def _items(pictures: Pictures) -> Iterator[Frame | Unusable]:
    """Frames, or what is wrong with their pictures."""
    for row, content in pictures:
        try:
            yield Frame(row.name, row.t_ns, decode_image(content, row.name))
        except FrameError as error:
            yield Unusable(row.name, row.t_ns, error.reason, str(error))


def _warm(localizer: Method, pictures: Pictures) -> None:
    """Compile before times are taken: the first frames of a machine take seconds more."""
    for item in _items(pictures[:: max(1, len(pictures) // 6)]):
        with suppress(FrameError):
            if isinstance(item, Frame):
                localizer.process(item)


def reach(run_folder: Path, truth: Path) -> dict[str, Any]:
    """Where a run could first and last be used, by true z: at all, and by four or more named lights of each layer.

    Also how far from the dock's axis its poses were, and its times with one layer named and with more.
    """
    station, true = load_station(run_folder / "station.yaml"), true_poses(truth)
    rows = [(fix, us) for fix, _, us in read_fixes(run_folder, station.ids) if fix.frame in true]
    named = np.array([_named_by_layer(fix, station) for fix, _ in rows]).reshape(len(rows), -1)
    z = np.array([true[fix.frame][2, 3] for fix, _ in rows])
    valid = np.array([fix.valid for fix, _ in rows], bool)
    guided = np.array([fix.guide is not None for fix, _ in rows], bool)
    ms = np.array([np.nan if us is None else us * 1e-3 for _, us in rows])
    layers = (named >= _FOUR).sum(axis=1)
    off_axis = [float(np.hypot(*fix.T_dock_cam[:2, 3])) for fix, _ in rows if fix.T_dock_cam is not None]
    usable = valid | guided
    by_layer = {name: _ends(z, usable & (named[:, k] >= _FOUR)) for name, k in (("front", 0), ("rear", -1))}
    return {
        "reach": {"valid": _ends(z, valid), "guide": _ends(z, guided), "usable": _ends(z, usable), **by_layer},
        "off_axis_m": max(off_axis, default=None),
        "ms": {"single": _median(ms[layers == 1]), "dual": _median(ms[layers > 1])},
    }


def _named_by_layer(fix: Fix, station: Station) -> list[int]:
    light = np.empty(0, np.int64) if fix.match is None else fix.match.light[fix.match.light >= 0]
    return [int(np.isin(light, station.lights_of(layer)).sum()) for layer in station.layers_front_to_rear()]


def _ends(z: Array, which: np.ndarray) -> list[float] | None:
    found = z[which]
    return [float(found[0]), float(found[-1])] if len(found) else None


def _median(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


def envelope(dock: Dock, settings: list[str], seed: int) -> dict[str, Any]:
    """First and last use of each method on an approach that is rendered in memory, every frame by both."""
    station, camera = _load(dock)
    scenario = load_scenario("approach", tuple(settings))
    localizers = {method: localizer_of(method, station, camera, Config()) for method in METHODS}
    seen: dict[str, list[tuple[float, bool, bool]]] = {method: [] for method in METHODS}
    for z, frame in _rendered(scenario, station, camera, seed):
        for method, localizer in localizers.items():
            fix = localizer.process(frame)
            seen[method].append((z, fix.valid, fix.guide is not None))
    return {method: _used(rows) for method, rows in seen.items()}


def _used(rows: list[tuple[float, bool, bool]]) -> dict[str, Any]:
    z, valid, guide = (np.array(column) for column in zip(*rows, strict=True))
    return {"frames": len(rows), "valid": _ends(z, valid), "guide": _ends(z, guide), "valid_frames": int(valid.sum())}


def _rendered(scenario: Scenario, station: Station, camera: Camera, seed: int) -> Iterator[tuple[float, Frame]]:
    """True z and picture of each frame of a scenario."""
    t_ns, poses = trajectory(scenario, np.random.default_rng([seed, 0]))
    spurious = spurious_paths(scenario, t_ns, (camera.width, camera.height), np.random.default_rng([seed, 2]))
    for number, (t, T_dock_cam) in enumerate(zip(t_ns.tolist(), poses, strict=True)):
        rng = np.random.default_rng([seed, 3, number])
        nothing = np.empty(0, np.int64)
        image, _, _ = render_frame(scenario, station, camera, T_dock_cam, spurious[number], nothing, rng)
        yield float(T_dock_cam[2, 3]), Frame(f"{number:06d}", t, image)


# The paper's figures


def search_sides(run_folder: str, sequence: str) -> dict[str, Any]:
    """Frames of the rectangular search by side: all, those used, and those with four or more named lights."""
    folder, true = Path(run_folder), true_poses(Path(sequence))
    station = load_station(folder / "station.yaml")
    sides: dict[str, dict[str, int]] = {}
    reached = np.abs([T[:2, 3] for T in true.values()]).max(axis=0)
    for fix, _, _ in read_fixes(folder, station.ids):
        x, y = true[fix.frame][:2, 3] / reached
        side = ("left" if x < 0 else "right") if abs(x) > abs(y) else ("below" if y < 0 else "above")
        row = sides.setdefault(side, {"frames": 0, "used": 0, "valid": 0})
        row["frames"] += 1
        row["used"] += fix.valid or fix.guide is not None
        row["valid"] += fix.valid
    return sides


def swarm(dock: Dock, seed: int, iterations: list[int]) -> dict[str, Any]:
    """Figure 6: the same swarm stopped after more and more iterations, on one frame with a light missing."""
    station, camera = _load(dock)
    layer = station.layers_front_to_rear()[0]
    frames = [f for f in simulated_frames(trials_scenario(1, 0), station, camera, seed) if f.T_dock_cam[2, 3] < 9.0]
    frame, config = frames[0], PaperConfig()
    rows = []
    for count in iterations:
        stopped = config.model_copy(update={"pso": config.pso.model_copy(update={"iterations": count})})
        localizer = LayerLocalizer(station, layer, camera, stopped)
        found = localizer.register(frame.detections.uv)
        assert found is not None
        right = int((found.light == frame.light).sum())
        rows.append([count, *map(float, found.transform), found.fitness, right])
    return {"z_m": float(frame.T_dock_cam[2, 3]), "detections": len(frame.light), "rows": rows}


def backtracking(dock: Dock, seed: int) -> dict[str, Any]:
    """Figures 7 and 11: a spurious light appears, and stays while a true one disappears; what each method makes of it.

    Frames: two clean ones, two with a spurious light, one with a light missing as well, which is given in full.
    """
    station, camera = _load(dock)
    layer = station.layers_front_to_rear()[0]
    runs = [
        list(simulated_frames(trials_scenario(*faults), station, camera, seed)) for faults in ((0, 0), (0, 1), (1, 1))
    ]
    near = [
        k
        for k, frame in enumerate(runs[0])
        if frame.T_dock_cam[2, 3] < 9.0 and frame.in_view[station.lights_of(layer)].all()
    ]
    order = [runs[0][near[0]], runs[0][near[1]], runs[1][near[2]], runs[1][near[3]], runs[2][near[4]]]
    localizer, ours = PaperLocalizer(station, camera), Localizer(station, camera)
    filtered = LayerLocalizer(station, layer, camera, PaperConfig())
    rows: list[dict[str, Any]] = []
    for frame in order:
        fixes = {
            "paper": localizer.process_detections(frame.detections),
            "lumidock": ours.process_detections(frame.detections),
        }
        seen = {"lights": int((frame.light >= 0).sum()), "spurious": int((frame.light < 0).sum())}
        rows.append(seen | {method: verdict(fix, frame) for method, fix in fixes.items()})
    for frame in order[:-1]:
        filtered.locate(frame.detections.t_ns, frame.detections.uv)
    return {"rows": rows} | _last_frame(order[-1], filtered, station, camera)


def _last_frame(frame: SimulatedFrame, filtered: LayerLocalizer, station: Station, camera: Camera) -> dict[str, Any]:
    """The spots of a frame, where the filter's track expects the lights, and the names by the swarm and the filter."""
    d = frame.detections
    alone = LayerLocalizer(station, filtered.layer, camera, filtered.config).register(d.uv)
    expected: Array = np.empty((0, 2))
    if filtered.track is not None:
        track = btekf.predict(filtered.track, d.t_ns, filtered.config.btekf)
        expected = project_lights(camera, track.T_dock_cam, filtered.p_dock)
    return {
        "uv": d.uv.tolist(),
        "true": frame.light.tolist(),
        "expected": expected.tolist(),
        "swarm": [] if alone is None else alone.light.tolist(),
        "filter": filtered.locate(d.t_ns, d.uv).light.tolist(),
        "ids": [station.ids[i] for i in filtered.lights],
    }
