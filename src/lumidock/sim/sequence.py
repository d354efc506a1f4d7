"""Writing of simulated sequences: rendered frames or bare detections, with their truth."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lumidock.camera import Camera, save_camera
from lumidock.datatypes import Array, Image, Indices
from lumidock.errors import LumidockError
from lumidock.geometry import quat_xyzw_from_rotation
from lumidock.sim import optics, sensor
from lumidock.sim.scenario import Scenario, spurious_paths, trajectory
from lumidock.sim.spots import SpotFrame, dark_lights, spot_frames
from lumidock.station import Station

_JPEG_QUALITY = 95
_VISIBLE_SNR = 8.0
Progress = Callable[[int, int], None]


def render_frame(
    scenario: Scenario,
    station: Station,
    camera: Camera,
    T_dock_cam: Array,
    strays: Array,
    dark: Indices,
    rng: np.random.Generator,
) -> tuple[Image, optics.Lamps, Array]:
    """One picture (H, W, 3) bgr8, its lamps and their matched-filter SNR (M,).

    `strays` (S, 2) px are lamps that belong to no dock, `dark` the lights that are out in this frame.
    """
    seen = optics.lamps(scenario, station, camera, T_dock_cam)
    seen.lit[dark] = False
    snr = optics.matched_filter_snr(scenario, seen)
    electrons = optics.expose(scenario, optics.with_strays(seen, strays), camera)
    return sensor.picture(electrons, scenario.sensor, rng), seen, snr


def write_rendered(
    scenario: Scenario,
    station: Station,
    camera: Camera,
    seed: int,
    out: Path,
    *,
    workers: int | None = None,
    progress: Progress = lambda _done, _total: None,
) -> int:
    """Render a scenario into the sequence folder `out`; the same bytes whatever `workers`. Returns the frame count."""
    t_ns, poses = trajectory(scenario, np.random.default_rng([seed, 0]))
    (out / "frames").mkdir(parents=True, exist_ok=True)
    job = partial(_write_frame, scenario, station, camera, seed, out)
    rows = []
    with _mapping(workers or os.cpu_count() or 1) as mapping:
        for row in mapping(job, range(len(t_ns))):
            rows.append(row)
            progress(len(rows), len(t_ns))
    names = [f"{number:06d}" for number in range(len(t_ns))]
    _write_common(out, camera, names, [f"{name}.jpg" for name in names], t_ns, poses)
    lights_truth, spurious = zip(*rows, strict=True)
    _write_lights_truth(out, names, lights_truth)
    _write_spurious(out, names, spurious)
    return len(t_ns)


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """`map`, in this process or over worker processes."""
    if workers == 1:
        yield map
        return
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        yield partial(pool.map, chunksize=4)


def _write_frame(
    scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path, number: int
) -> tuple[list[list[object]], Array]:
    """Render one frame to its file; returns its rows of lights_truth.csv and its spurious pixels (S, 2)."""
    t_ns, poses = trajectory(scenario, np.random.default_rng([seed, 0]))
    size = (camera.width, camera.height)
    strays = spurious_paths(scenario, t_ns, size, np.random.default_rng([seed, 2]))[number]
    rng = np.random.default_rng([seed, 3, number])
    front = station.lights_of(station.layers_front_to_rear()[0])
    lit = optics.lamps(scenario, station, camera, poses[number]).lit
    dark = dark_lights(scenario, front[lit[front]], rng)
    image, seen, snr = render_frame(scenario, station, camera, poses[number], strays, dark, rng)
    path = out / "frames" / f"{number:06d}.jpg"
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
        raise LumidockError(f"{path}: cannot be written")
    rows: list[list[object]] = [
        [light, f"{u:.4f}", f"{v:.4f}", int(s > _VISIBLE_SNR), f"{s:.2f}"]
        for light, (u, v), s in zip(station.ids, seen.uv, snr, strict=True)
        if np.isfinite([u, v]).all()
    ]
    return rows, strays


def write_detections(scenario: Scenario, station: Station, camera: Camera, seed: int, out: Path) -> int:
    """Write a scenario as bare detections into the folder `out`; returns the frame count."""
    out.mkdir(parents=True, exist_ok=True)
    frames = list(spot_frames(scenario, station, camera, seed))
    names = [frame.detections.frame for frame in frames]
    t_ns = np.array([frame.detections.t_ns for frame in frames])
    poses = np.array([frame.T_dock_cam for frame in frames])
    _write_common(out, camera, names, [""] * len(names), t_ns, poses)
    _write_csv(out / "detections.csv", DETECTION_COLUMNS, _detection_rows(frames))
    _write_lights_truth(out, names, [_spot_truth(frame, station) for frame in frames])
    _write_spurious(out, names, [frame.detections.uv[frame.light < 0] for frame in frames])
    return len(frames)


DETECTION_COLUMNS = ("frame", "u_px", "v_px", "radius_px", "flux", "p_light", "p_rear")


def _detection_rows(frames: list[SpotFrame]) -> Iterator[list[object]]:
    for frame in frames:
        d = frame.detections
        for (u, v), p_rear in zip(d.uv, d.p_rear, strict=True):
            yield [d.frame, f"{u:.4f}", f"{v:.4f}", "", "", "1", f"{p_rear:.3f}"]


def _spot_truth(frame: SpotFrame, station: Station) -> list[list[object]]:
    """A light is visible when it made a detection; bare detections have no signal-to-noise ratio."""
    rows: list[list[object]] = []
    for i in np.flatnonzero(frame.in_view):
        u, v = frame.uv[i]
        rows.append([station.ids[i], f"{u:.4f}", f"{v:.4f}", int(i in frame.light), ""])
    return rows


def _write_common(
    out: Path, camera: Camera, names: list[str], frame_files: list[str], t_ns: np.ndarray, poses: Array
) -> None:
    """Calibration, stamps and true poses."""
    save_camera(camera, out / "camera.yaml")
    _write_csv(out / "timestamps.csv", ("frame", "file", "t_ns"), zip(names, frame_files, t_ns, strict=True))
    columns = ("frame", "t_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    rows = (
        [name, t, *(f"{value:.9f}" for value in (*T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])))]
        for name, t, T in zip(names, t_ns, poses, strict=True)
    )
    _write_csv(out / "truth.csv", columns, rows)


def _write_lights_truth(out: Path, names: list[str], rows: Iterable[list[list[object]]]) -> None:
    columns = ("frame", "light", "u_px", "v_px", "visible", "snr")
    _write_csv(
        out / "lights_truth.csv",
        columns,
        ([name, *row] for name, group in zip(names, rows, strict=True) for row in group),
    )


def _write_spurious(out: Path, names: list[str], pixels: Iterable[Array]) -> None:
    columns = ("frame", "kind", "u_px", "v_px")
    rows = (
        [name, "injected", f"{u:.4f}", f"{v:.4f}"] for name, group in zip(names, pixels, strict=True) for u, v in group
    )
    _write_csv(out / "spurious_truth.csv", columns, rows)


def _write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
