"""Writes simulated sequence folders: rendered frames or bare detections, with their truth."""

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
from lumidock.datatypes import Array, Indices, in_seconds
from lumidock.errors import InputError, LumidockError
from lumidock.geometry import quat_xyzw_from_rotation
from lumidock.sim.aiding import measured
from lumidock.sim.children import end_children, start_child
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.draws import Draw
from lumidock.sim.frames import ExpectedFrame, FrameConditions, FrameRenderer
from lumidock.sim.knobs import Output
from lumidock.sim.lens import Lens, calibrated_in_water
from lumidock.sim.optics import Emitters
from lumidock.sim.scenario import Scenario
from lumidock.sim.schedule import Schedule, controlled, metered, schedule_of, with_auto_exposure
from lumidock.sim.stream import OVER_EXPOSED, Row, rows_of
from lumidock.sim.video import as_video, seen_by_field, woven
from lumidock.sim.water import green_index
from lumidock.station import Station

# matched-filter SNR over which a light is visible, and over which other sources are listed in spurious_truth.csv
_VISIBLE_SNR, _NOTED_SNR = 8.0, 4.0
_VIDEO_CODEC = "mp4v"
_PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # fast
Progress = Callable[[int, int], None]  # called with the number of finished steps and of all steps
Line = list[object]


@dataclass(frozen=True, slots=True)
class _Written:
    """Truth of one frame: lines of lights_truth.csv and spurious_truth.csv, without the name of the frame."""

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
    """One picture of a still camera, the station's M lamps as emitters, and their matched-filter SNR (M,).

    `spurious` (S, 2) px are images of lamps that do not belong to the dock, `dark` the indices of lights that are off.
    """
    lens = Lens.of(scenario.lens, camera, green_index(scenario.water))
    renderer, m = FrameRenderer(scenario, station, lens), len(station)
    conditions = FrameConditions(
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
    expected = renderer.expect(conditions)
    own = Emitters(*(getattr(expected.emitters, name)[:m] for name in Emitters.__slots__))
    return renderer.picture_of(expected, rng), own, expected.snr[:m]


def require_possible(scenario: Scenario, *, detections: bool = False, video: bool = False) -> None:
    """Raises: InputError where a scenario cannot be made as bare detections, or as pictures, or as a video."""
    if detections and scenario.lens.port is not None:
        raise InputError(f"{scenario.name}: has a flat port, which bare detections do not model; render it")
    if not detections and scenario.detections.faults.any:
        raise InputError(f"{scenario.name}: detections.faults are made as bare detections alone; give --detections")
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
    """Render a scenario into the sequence folder `out`; `workers` does not change the bytes. Returns the row count.

    With `video` the pictures go into video.mp4 instead of frames/.
    """
    require_possible(scenario, video=video)
    schedule, rows = _scheduled(scenario, station, camera, seed)
    (out / "frames").mkdir(parents=True, exist_ok=True)
    control = scenario.sensor.auto_exposure
    unique = _unique(rows)
    total = len(unique) + (len(schedule) if control else 0)
    with _mapping(workers or os.cpu_count() or 1) as mapping:
        if control:
            light = _counted(mapping(partial(metered, schedule), range(len(schedule))), progress, 0, total)
            schedule = replace(schedule, exposure_s=controlled(schedule, control, light))
        job = partial(_write_frame, schedule, out)
        written = _counted(mapping(job, unique), progress, total - len(unique), total)
    _write_truth(schedule, rows, dict(zip(unique, written, strict=True)), out)
    if video:
        _into_video(rows, out, scenario)
    return len(rows)


def rendered(scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path) -> list[tuple[Row, bytes]]:
    """Render in this process and in memory; returns every row of timestamps.csv and the content of its picture file.

    All other files of the sequence are written into the folder `out`.
    """
    schedule, rows = _scheduled(scenario, station, camera, seed)
    schedule, unique = with_auto_exposure(schedule), _unique(rows)
    pictures, truths = zip(*(_rendered_row(schedule, row) for row in unique), strict=True)
    _write_truth(schedule, rows, dict(zip(unique, truths, strict=True)), out)
    picture = {row.number: content for row, content in zip(unique, pictures, strict=True)}
    return [(row, picture[row.number]) for row in rows]


def _unique(rows: list[Row]) -> list[Row]:
    """The rows without duplicates, as a duplicated row has one file."""
    return list({row.number: row for row in reversed(rows)}.values())[::-1]


def _scheduled(scenario: Scenario, station: Station, camera: Camera, seed: int) -> tuple[Schedule, list[Row]]:
    """The schedule and the rows of timestamps.csv. Raises: InputError when there are no rows."""
    schedule = schedule_of(scenario, station, camera, seed)
    rows = rows_of(scenario.stream, schedule.course.t_ns, np.random.default_rng([seed, Draw.STREAM_FAULTS]))
    if not rows:
        raise InputError(f"{scenario.name}: every frame is dropped")
    return schedule, rows


def _counted(results: Iterable[Any], progress: Progress, done: int, total: int) -> list[Any]:
    """Collect all results and report the progress after each."""
    collected = []
    for result in results:
        collected.append(result)
        progress(done + len(collected), total)
    return collected


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """A function like `map` that runs in this process or in worker processes."""
    if workers == 1:
        yield map
        return
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=start_child) as pool:
        try:
            yield partial(_mapped, pool)
        except SystemExit:  # SIGTERM: nobody waits for pictures that are begun
            end_children()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _mapped(pool: ProcessPoolExecutor, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
    """`map` over worker processes that block SIGINT from their start on, so that only their parent handles Ctrl-C."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.map(function, items)  # one at a time: what has begun is finished after Ctrl-C
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _write_frame(schedule: Schedule, out: Path, row: Row) -> _Written:
    """Render the picture of one row into its file; returns its truth."""
    picture, truth = _rendered_row(schedule, row)
    (out / "frames" / file_of(row, schedule.scenario)).write_bytes(picture)
    return truth


def _rendered_row(schedule: Schedule, row: Row) -> tuple[bytes, _Written]:
    """The content of the picture file of one row, and its truth."""
    renderer, conditions = schedule.renderer(row.shows), schedule.conditions(row.shows)
    if row.fault == "over_exposed":
        conditions = replace(conditions, exposure_s=conditions.exposure_s * OVER_EXPOSED)
    rng = np.random.Generator(np.random.SFC64([schedule.seed, Draw.SENSOR_NOISE, row.shows]))
    expected, image = _expose(renderer, conditions, rng)
    image = as_video(image, schedule.scenario.output)
    if row.fault in ("black", "white"):
        image[...] = 0 if row.fault == "black" else np.iinfo(image.dtype).max
    content = encoded(image, schedule.scenario.output)
    if row.fault == "half_written":
        content = content[: len(content) // 2]
    lost = row.fault in ("black", "white", "half_written")
    return content, _truth_of(renderer, expected, lost)


def _expose(
    renderer: FrameRenderer, conditions: FrameConditions, rng: np.random.Generator
) -> tuple[ExpectedFrame, np.ndarray]:
    """One frame and its picture. In a frame of two fields the true pixels of lamps are means over both fields."""
    if renderer.scenario.output.fields != "woven":
        expected = renderer.expect(conditions)
        return expected, renderer.picture_of(expected, rng)
    half_s, m = 0.5 * renderer.scenario.output.field_s, len(renderer.station)
    first = renderer.expect(conditions.shifted(-half_s))
    even = renderer.picture_of(first, rng)
    electrons = first.electrons.copy()
    second = renderer.expect(conditions.shifted(half_s))
    uv = first.emitters.uv.copy()
    uv[:m] = 0.5 * (first.emitters.uv[:m] + second.emitters.uv[:m])
    expected = replace(first, electrons=electrons, emitters=replace(first.emitters, uv=uv))
    return expected, woven(even, renderer.picture_of(second, rng))


def encoded(image: np.ndarray, output: Output) -> bytes:
    """Content of the file for a picture (H, W[, 3]). Raises: LumidockError when it cannot be encoded."""
    options = [cv2.IMWRITE_JPEG_QUALITY, output.quality] if output.file == "jpg" else _PNG_OPTIONS
    done, content = cv2.imencode(f".{output.file}", image, options)
    if not done:
        raise LumidockError(f"a picture cannot be encoded as {output.file}")
    return content.tobytes()


def file_of(row: Row, scenario: Scenario) -> str:
    """Name of the picture file of a row."""
    return f"{row.name}.{scenario.output.file}"


def _truth_of(renderer: FrameRenderer, expected: ExpectedFrame, lost: bool) -> _Written:
    """Truth of one picture; in a picture that is `lost` no light is visible."""
    emitters, m = expected.emitters, len(renderer.station)
    single_field = renderer.scenario.output.fields == "single"
    scale = np.array([1.0, 0.5 if single_field else 1.0])  # of u and v in the picture as written
    uv = emitters.uv * scale
    snr = np.zeros(len(emitters)) if lost else expected.snr
    lights: list[Line] = [
        [light, f"{u:.4f}", f"{v:.4f}", int(s > _VISIBLE_SNR), f"{s:.2f}"]
        for light, (u, v), s in zip(renderer.station.ids, uv[:m], snr[:m], strict=True)
        if np.isfinite([u, v]).all()
    ]
    noted = (snr > _NOTED_SNR) | (emitters.kind == "injected")
    noted[:m] = False
    spurious: list[Line] = [
        [str(emitters.kind[i]), f"{uv[i, 0]:.4f}", f"{uv[i, 1]:.4f}"] for i in np.flatnonzero(noted)
    ]
    shown = slice(0) if lost else slice(None)
    for kind, places in (("reflection", expected.reflections), ("hot_pixel", renderer.hot_at[::-1].T)):
        spurious += [[kind, f"{u:.4f}", f"{v:.4f}"] for u, v in places[shown] * scale]
    return _Written(lights, spurious)


def _write_truth(schedule: Schedule, rows: list[Row], written: dict[Row, _Written], out: Path) -> None:
    """Write camera.yaml, timestamps.csv and the tables of truth."""
    scenario = schedule.scenario
    lens = schedule.renderer(0).lens
    written_camera = seen_by_field(calibrated_in_water(lens, schedule.camera), scenario.output)
    save_camera(written_camera, out / "camera.yaml")
    raw = scenario.output.pixels.startswith("bayer")
    columns = ("frame", "file", "t_ns", *(("encoding",) if raw else ()))
    encoding = [f"bayer_{scenario.output.pattern}{scenario.output.pixels.removeprefix('bayer')}"] if raw else []
    _write_csv(out / "timestamps.csv", columns, ([r.name, file_of(r, scenario), r.t_ns, *encoding] for r in rows))
    names = [row.name for row in written]
    poses = schedule.course.T_dock_cam[[row.number for row in written]]
    _write_poses(out, names, [row.t_ns for row in written], poses)
    _write_aiding(scenario, schedule.seed, out)
    _write_lights_truth(out, names, [truth.lights for truth in written.values()])
    _write_spurious(out, names, [truth.spurious for truth in written.values()])
    if any(row.fault for row in rows):
        _write_csv(out / "stream_truth.csv", ("frame", "fault"), ([r.name, r.fault] for r in rows if r.fault))


def _into_video(rows: list[Row], out: Path, scenario: Scenario) -> None:
    """Move the pictures into video.mp4; files that cannot be decoded are left out."""
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
        raise LumidockError(f"{video}: there is no picture that can be decoded")
    writer.release()
    shutil.rmtree(out / "frames")


def write_detections(scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path) -> int:
    """Write a scenario as bare detections into the folder `out`; returns the frame count.

    Raises: InputError where the scenario has a flat port, which bare detections do not model.
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
    _write_aiding(scenario, seed, out)
    _write_csv(out / "detections.csv", DETECTION_COLUMNS, _detection_rows(frames))
    _write_lights_truth(out, names, [_detection_truth(frame, station) for frame in frames])
    _write_spurious(out, names, [_detection_spurious(frame) for frame in frames])
    return len(frames)


def _write_aiding(scenario: Scenario, seed: int, out: Path) -> None:
    """Write aiding.csv where the scenario has sensors."""
    knobs = scenario.detections.aiding
    if knobs is not None and scenario.path.kind != "draws":
        values = measured(scenario, knobs, seed)
        lines = ([one.t_ns, one.kind, *one.value, *[""] * (4 - len(one.value)), one.sigma] for one in values)
        _write_csv(out / "aiding.csv", ("t_ns", "kind", "v0", "v1", "v2", "v3", "sigma"), lines)


DETECTION_COLUMNS = ("frame", "u_px", "v_px", "radius_px", "flux", "p_light", "p_rear")


def _detection_rows(frames: list[SimulatedFrame]) -> Iterator[list[object]]:
    for frame in frames:
        d = frame.detections
        for (u, v), p_light, p_rear in zip(d.uv, d.p_light, d.p_rear, strict=True):
            yield [d.frame, f"{u:.4f}", f"{v:.4f}", "", "", f"{p_light:.3g}", f"{p_rear:.3f}"]


def _detection_spurious(frame: SimulatedFrame) -> list[Line]:
    return [["injected", f"{u:.4f}", f"{v:.4f}"] for u, v in frame.detections.uv[frame.light < 0]]


def _detection_truth(frame: SimulatedFrame, station: Station) -> list[Line]:
    """Lines of lights_truth.csv: a light is visible when it made a detection; there is no signal-to-noise ratio."""
    rows: list[Line] = []
    for i in np.flatnonzero(frame.in_view):
        u, v = frame.uv[i]
        rows.append([station.ids[i], f"{u:.4f}", f"{v:.4f}", int(i in frame.light), ""])
    return rows


def _write_poses(out: Path, names: list[str], t_ns: Iterable[int], poses: Array) -> None:
    """Write truth.csv, and truth.tum with a line for each time at which there is a frame."""
    columns = ("frame", "t_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    rows = [
        [name, str(t), *(f"{value:.9f}" for value in (*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])))]
        for name, t, T in zip(names, t_ns, poses, strict=True)
    ]
    _write_csv(out / "truth.csv", columns, rows)
    at = {int(t): numbers for _, t, *numbers in rows}
    lines = [" ".join([in_seconds(t), *at[t]]) for t in sorted(at)]
    (out / "truth.tum").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


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
