"""Writing of simulated sequences: rendered frames or bare detections, with their truth."""

from __future__ import annotations

import csv
import os
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lumidock.camera import Camera, save_camera
from lumidock.datatypes import Array, Indices
from lumidock.errors import InputError, LumidockError
from lumidock.geometry import quat_xyzw_from_rotation
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.frames import Moment, Shot, Studio
from lumidock.sim.knobs import Output
from lumidock.sim.lens import Lens, calibrated_in_water
from lumidock.sim.optics import Emitters
from lumidock.sim.scenario import Scenario
from lumidock.sim.schedule import Schedule, controlled, exposed, metered, schedule_of
from lumidock.sim.stream import OVER_EXPOSED, Row, rows_of
from lumidock.sim.video import as_video, seen_by_field, woven
from lumidock.sim.water import green_index
from lumidock.station import Station

_VISIBLE_SNR, _NOTED_SNR = 8.0, 4.0
_VIDEO_CODEC = "mp4v"
_PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1]
Progress = Callable[[int, int], None]
Line = list[object]


@dataclass(frozen=True, slots=True)
class _Written:
    """Truth of one frame: lines for lights_truth.csv and spurious_truth.csv, without the frame's name."""

    lights: list[Line]
    spurious: list[Line]


def render_frame(
    scenario: Scenario,
    station: Station,
    camera: Camera,
    T_dock_cam: Array,
    spurious: Array,
    dark: Indices,
    rng: np.random.Generator,
) -> tuple[np.ndarray, Emitters, Array]:
    """One picture of a still camera, its lamps and their matched-filter SNR (M,).

    `strays` (S, 2) px are lamps that belong to no dock, `dark` the lights that are out in this frame.
    """
    lens = Lens.of(scenario.lens, camera, green_index(scenario.water))
    studio, m = Studio(scenario, station, lens), len(station)
    moment = Moment(
        t_s=0.0,
        exposure_s=scenario.sensor.exposure_ms * 1e-3,
        T_dock_cam=T_dock_cam,
        T_cam_later=np.eye(4),
        p_dock=station.p_dock,
        transmission=np.ones(m),
        dark=np.asarray(dark, np.int64),
        spurious=spurious,
        surface=scenario.around.surface,
    )
    shot = studio.shoot(moment)
    own = Emitters(*(getattr(shot.seen, name)[:m] for name in Emitters.__slots__))
    return studio.develop(shot, rng), own, shot.snr[:m]


def require_possible(scenario: Scenario, *, detections: bool = False, video: bool = False) -> None:
    """Raises: InputError where a scenario has no bare detections, or no video can hold its pictures."""
    if detections and scenario.lens.port is not None:
        raise InputError(f"{scenario.name}: a flat port is only rendered, it has no bare detections")
    if video and scenario.output.pixels not in ("bgr8", "mono8"):
        raise InputError(f"output.pixels: a video holds bgr8 or mono8, not {scenario.output.pixels}")


def write_rendered(
    scenario: Scenario,
    station: Station,
    camera: Camera,
    seed: int,
    out: Path,
    *,
    video: bool = False,
    workers: int | None = None,
    progress: Progress = lambda _done, _total: None,
) -> int:
    """Render a scenario into the sequence folder `out`; the same bytes whatever `workers`. Returns the number of rows.

    With `video` the pictures go into video.mp4 instead of frames/.
    """
    require_possible(scenario, video=video)
    plan, rows = _planned(scenario, station, camera, seed)
    (out / "frames").mkdir(parents=True, exist_ok=True)
    control = scenario.sensor.auto_exposure
    once = _once(rows)
    total = len(once) + (len(plan) if control else 0)
    with _mapping(workers or os.cpu_count() or 1) as mapping:
        if control:
            light = _counted(mapping(partial(metered, plan), range(len(plan))), progress, 0, total)
            plan = replace(plan, exposure_s=controlled(plan, control, light))
        job = partial(_write_frame, plan, out)
        written = _counted(mapping(job, once), progress, total - len(once), total)
    _write_truth(plan, rows, dict(zip(once, written, strict=True)), out)
    if video:
        _into_video(rows, out, scenario)
    return len(rows)


def rendered(scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path) -> list[tuple[Row, bytes]]:
    """Render in this process and in memory: every row of timestamps.csv, and the content of its picture's file.

    What `write_rendered` writes beside the pictures is written into the folder `out`.
    """
    plan, rows = _planned(scenario, station, camera, seed)
    plan, once = exposed(plan), _once(rows)
    pictures, truths = zip(*(_taken(plan, row) for row in once), strict=True)
    _write_truth(plan, rows, dict(zip(once, truths, strict=True)), out)
    picture = {row.number: content for row, content in zip(once, pictures, strict=True)}
    return [(row, picture[row.number]) for row in rows]


def _once(rows: list[Row]) -> list[Row]:
    """The rows with a picture of their own: a doubled row has one file."""
    return list({row.number: row for row in reversed(rows)}.values())[::-1]


def _planned(scenario: Scenario, station: Station, camera: Camera, seed: int) -> tuple[Schedule, list[Row]]:
    """What is rendered, and the rows of timestamps.csv. Raises: InputError when there would be none."""
    plan = schedule_of(scenario, station, camera, seed)
    rows = rows_of(scenario.stream, plan.course.t_ns, np.random.default_rng([seed, 6]))
    if not rows:
        raise InputError(f"{scenario.name}: every frame is dropped")
    return plan, rows


def _counted(results: Iterable[Any], progress: Progress, done: int, total: int) -> list[Any]:
    """All results, with `progress` told of each."""
    collected = []
    for result in results:
        collected.append(result)
        progress(done + len(collected), total)
    return collected


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """`map`, in this process or over worker processes."""
    if workers == 1:
        yield map
        return
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        try:
            yield partial(_mapped, pool)
        finally:
            pool.shutdown(cancel_futures=True)


def _mapped(pool: ProcessPoolExecutor, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
    """`map` over workers that never hear of Ctrl-C, not even while they start: it is their parent that ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.map(function, items, chunksize=4)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _write_frame(plan: Schedule, out: Path, row: Row) -> _Written:
    """Render the picture of one row to its file, and say what is in it."""
    picture, truth = _taken(plan, row)
    (out / "frames" / file_of(row, plan.scenario)).write_bytes(picture)
    return truth


def _taken(plan: Schedule, row: Row) -> tuple[bytes, _Written]:
    """The file with the picture of one row, and what is in it."""
    studio, moment = plan.studio(row.shows), plan.moment(row.shows)
    if row.fault == "over_exposed":
        moment = replace(moment, exposure_s=moment.exposure_s * OVER_EXPOSED)
    rng = np.random.Generator(np.random.SFC64([plan.seed, 9, row.shows]))
    shot, image = _exposed(studio, moment, rng)
    image = as_video(image, plan.scenario.output)
    if row.fault in ("black", "white"):
        image[...] = 0 if row.fault == "black" else np.iinfo(image.dtype).max
    content = encoded(image, plan.scenario.output)
    if row.fault == "half_written":
        content = content[: len(content) // 2]
    lost = row.fault in ("black", "white", "half_written")
    return content, _truth_of(studio, shot, lost)


def _exposed(studio: Studio, moment: Moment, rng: np.random.Generator) -> tuple[Shot, np.ndarray]:
    """The shot of one frame and its picture; of two fields the places of the lamps are those in the middle of them."""
    if studio.scenario.output.fields != "woven":
        shot = studio.shoot(moment)
        return shot, studio.develop(shot, rng)
    half_s, m = 0.5 * studio.scenario.output.field_s, len(studio.station)
    first = studio.shoot(moment.shifted(-half_s))
    even = studio.develop(first, rng)
    electrons = first.electrons.copy()
    second = studio.shoot(moment.shifted(half_s))
    uv = first.seen.uv.copy()
    uv[:m] = 0.5 * (first.seen.uv[:m] + second.seen.uv[:m])
    shot = replace(first, electrons=electrons, seen=replace(first.seen, uv=uv))
    return shot, woven(even, studio.develop(second, rng))


def encoded(image: np.ndarray, output: Output) -> bytes:
    """The content of the file of a picture (H, W[, 3]). Raises: LumidockError when it cannot be encoded."""
    options = [cv2.IMWRITE_JPEG_QUALITY, output.quality] if output.file == "jpg" else _PNG_OPTIONS
    done, content = cv2.imencode(f".{output.file}", image, options)
    if not done:
        raise LumidockError(f"a picture cannot be encoded as {output.file}")
    return content.tobytes()


def file_of(row: Row, scenario: Scenario) -> str:
    """Name of the row's picture."""
    return f"{row.name}.{scenario.output.file}"


def _truth_of(studio: Studio, shot: Shot, lost: bool) -> _Written:
    """What truth says of one picture; in one that is `lost` nothing is visible."""
    seen, m = shot.seen, len(studio.station)
    rows = np.array([1.0, 0.5 if studio.scenario.output.fields == "single" else 1.0])  # of what is written
    uv = seen.uv * rows
    snr = np.zeros(len(seen)) if lost else shot.snr
    lights: list[Line] = [
        [light, f"{u:.4f}", f"{v:.4f}", int(s > _VISIBLE_SNR), f"{s:.2f}"]
        for light, (u, v), s in zip(studio.station.ids, uv[:m], snr[:m], strict=True)
        if np.isfinite([u, v]).all()
    ]
    noted = (snr > _NOTED_SNR) | (seen.kind == "injected")
    noted[:m] = False
    spurious: list[Line] = [[str(seen.kind[i]), f"{uv[i, 0]:.4f}", f"{uv[i, 1]:.4f}"] for i in np.flatnonzero(noted)]
    shown = slice(0) if lost else slice(None)
    for kind, places in (("reflection", shot.reflections), ("hot_pixel", studio.hot_at[::-1].T)):
        spurious += [[kind, f"{u:.4f}", f"{v:.4f}"] for u, v in places[shown] * rows]
    return _Written(lights, spurious)


def _write_truth(plan: Schedule, rows: list[Row], written: dict[Row, _Written], out: Path) -> None:
    """Calibration, stamps and truth, a row for each frame of the sequence."""
    scenario = plan.scenario
    lens = plan.studio(0).lens
    written_camera = seen_by_field(calibrated_in_water(lens, plan.camera), scenario.output)
    save_camera(written_camera, out / "camera.yaml")
    raw = scenario.output.pixels.startswith("bayer")
    columns = ("frame", "file", "t_ns", *(("encoding",) if raw else ()))
    encoding = [f"bayer_{scenario.output.pattern}{scenario.output.pixels.removeprefix('bayer')}"] if raw else []
    _write_csv(out / "timestamps.csv", columns, ([r.name, file_of(r, scenario), r.t_ns, *encoding] for r in rows))
    names = [row.name for row in written]
    poses = plan.course.T_dock_cam[[row.number for row in written]]
    _write_poses(out, names, [row.t_ns for row in written], poses)
    _write_lights_truth(out, names, [truth.lights for truth in written.values()])
    _write_spurious(out, names, [truth.spurious for truth in written.values()])
    if any(row.fault for row in rows):
        _write_csv(out / "stream_truth.csv", ("frame", "fault"), ([r.name, r.fault] for r in rows if r.fault))


def _into_video(rows: list[Row], out: Path, scenario: Scenario) -> None:
    """Make a video of the pictures, which are then gone; what cannot be decoded is left out as a recorder would."""
    video, writer = out / "video.mp4", None
    for row in rows:
        image = cv2.imread(str(out / "frames" / file_of(row, scenario)), cv2.IMREAD_COLOR)
        if image is None:
            continue
        if writer is None:
            codec, fps = cv2.VideoWriter.fourcc(*_VIDEO_CODEC), 1.0 / scenario.path.frame_interval_s
            writer = cv2.VideoWriter(str(video), codec, fps, (image.shape[1], image.shape[0]))
        writer.write(image)
    if writer is None:
        raise LumidockError(f"{video}: no picture to put into it")
    writer.release()
    shutil.rmtree(out / "frames")


def write_detections(scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path) -> int:
    """Write a scenario as bare detections into the folder `out`; returns the frame count.

    Raises: InputError where the scenario has a port, which bare detections do not know.
    """
    require_possible(scenario, detections=True)
    out.mkdir(parents=True, exist_ok=True)
    frames = list(simulated_frames(scenario, station, camera, seed))
    names = [frame.detections.frame for frame in frames]
    t_ns = [frame.detections.t_ns for frame in frames]
    poses = np.array([frame.T_dock_cam for frame in frames])
    save_camera(camera, out / "camera.yaml")
    _write_csv(
        out / "timestamps.csv", ("frame", "file", "t_ns"), ([name, "", t] for name, t in zip(names, t_ns, strict=True))
    )
    _write_poses(out, names, t_ns, poses)
    _write_csv(out / "detections.csv", DETECTION_COLUMNS, _detection_rows(frames))
    _write_lights_truth(out, names, [_detection_truth(frame, station) for frame in frames])
    _write_spurious(out, names, [_detection_spurious(frame) for frame in frames])
    return len(frames)


DETECTION_COLUMNS = ("frame", "u_px", "v_px", "radius_px", "flux", "p_light", "p_rear")


def _detection_rows(frames: list[SimulatedFrame]) -> Iterator[list[object]]:
    for frame in frames:
        d = frame.detections
        for (u, v), p_light, p_rear in zip(d.uv, d.p_light, d.p_rear, strict=True):
            yield [d.frame, f"{u:.4f}", f"{v:.4f}", "", "", f"{p_light:.3g}", f"{p_rear:.3f}"]


def _detection_spurious(frame: SimulatedFrame) -> list[Line]:
    return [["injected", f"{u:.4f}", f"{v:.4f}"] for u, v in frame.detections.uv[frame.light < 0]]


def _detection_truth(frame: SimulatedFrame, station: Station) -> list[Line]:
    """A light is visible when it made a detection; bare detections have no signal-to-noise ratio."""
    rows: list[Line] = []
    for i in np.flatnonzero(frame.in_view):
        u, v = frame.uv[i]
        rows.append([station.ids[i], f"{u:.4f}", f"{v:.4f}", int(i in frame.light), ""])
    return rows


def _write_poses(out: Path, names: list[str], t_ns: Iterable[int], poses: Array) -> None:
    """True poses."""
    columns = ("frame", "t_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    rows = (
        [name, t, *(f"{value:.9f}" for value in (*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])))]
        for name, t, T in zip(names, t_ns, poses, strict=True)
    )
    _write_csv(out / "truth.csv", columns, rows)


def _write_lights_truth(out: Path, names: list[str], rows: Iterable[list[Line]]) -> None:
    columns = ("frame", "light", "u_px", "v_px", "visible", "snr")
    _write_csv(
        out / "lights_truth.csv",
        columns,
        ([name, *row] for name, group in zip(names, rows, strict=True) for row in group),
    )


def _write_spurious(out: Path, names: list[str], lines: Iterable[list[Line]]) -> None:
    rows = ([name, *line] for name, group in zip(names, lines, strict=True) for line in group)
    _write_csv(out / "spurious_truth.csv", ("frame", "kind", "u_px", "v_px"), rows)


def _write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
