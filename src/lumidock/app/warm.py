"""Compiling ahead: a made-up docking before the first real frame, so that no vehicle waits for its first fix."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Literal

import numpy as np

from lumidock import detect, layers
from lumidock._kernels import compiling
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import AidingMeasurement, Array, Attitude, Detections, Fix, Frame
from lumidock.geometry import se3_inverse, transform_points
from lumidock.localizer import Localizer
from lumidock.station import Station

_FRAMES, _STEP_NS, _STEP = 8, 100_000_000, 0.02
_BLANK = 5  # the frame without lights, after which the track has to be taken up again
_FORMATS = {"8 bits": ("bgr8", 255), "16 bits": ("bayer_rggb16", 65535)}
_OBJECTS = 50_000  # made between two searches for garbage, of which compiling leaves little
_AWAY = 3.0  # and _STEP in widths of the array, all of whose lights are in the picture then
_SENSOR_RAD = 0.05  # error of the attitude sensor in the last frame, whose kernels are compiled with it
_OTHERS = (
    "swarm",
    "pose",
    "assignment",
)  # kernel modules whose entries only the paper's method and the calibration call


@dataclass(frozen=True, slots=True)
class CompiledCode:
    """Whether the next run finds its kernels compiled: ok, not yet, or never; and a sentence that says so.

    `first`: not one is compiled, so that the next run is the first of this installation.
    """

    mark: Literal["ok", "note", "bad"]
    text: str
    first: bool = False


def compiled_code() -> CompiledCode:
    """Look at what is compiled on disk for the sources and the numba at hand."""
    done, needed = compiling.compiled_entries(_OTHERS)
    if compiling.DISABLED:
        return CompiledCode("bad", "NUMBA_DISABLE_JIT is set: nothing is compiled, which is too slow for pictures")
    if compiling.FOLDER is None:
        text = "no folder for compiled code can be written, so every run compiles for one to two minutes before its"
        return CompiledCode("bad", f"{text} first fix; set NUMBA_CACHE_DIR to a folder that can be written")
    if done < needed:
        text = f"{done} of {needed} kernels are compiled in {compiling.FOLDER}; the next run compiles the rest,"
        return CompiledCode("note", f"{text} up to two minutes, unless `lumidock warm` has done so", first=not done)
    return CompiledCode("ok", f"all {needed} kernels are compiled in {compiling.FOLDER}; no run waits for them")


def compile_ahead(station: Station, camera: Camera) -> None:
    """Compile detection and matching for the runs to come, at the same time in two processes.

    What one of them could not, `warm_up` does.
    """
    spawn = get_context("spawn")  # a fork would inherit the locks of OpenCV's threads
    parts = [spawn.Process(target=_run, args=(part, station, camera), daemon=True) for part in (_detection, _matching)]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is the parent's, whose end is theirs
    try:
        for part in parts:
            part.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    for part in parts:
        part.join()


def compile_all(station: Station, camera: Camera) -> Iterator[str]:
    """Compile everything that a run needs; yields each pixel format that is ready."""
    compile_ahead(station, camera)
    for name, _ in warm_up(Localizer(station, camera).process, station, camera):
        yield name


def _run(part: Callable[[Station, Camera], None], station: Station, camera: Camera) -> None:
    gc.set_threshold(_OBJECTS)
    part(station, camera)


def _detection(station: Station, camera: Camera) -> None:
    config = Config()
    for _, frames in _films(station, camera):
        frame = next(frames)
        found = detect.lights(frame, config.detect, detect.Scan(frame, config.detect), None)
        layers.label(frame, found, config.label)


def _matching(station: Station, camera: Camera) -> None:
    localizer, head_on = Localizer(station, camera), Attitude(np.diag([1.0, -1.0, -1.0]), _SENSOR_RAD)
    for k in range(_FRAMES):
        found = Detections.from_uv(str(k), k * _STEP_NS, _view(station, camera, k))
        localizer.aid(AidingMeasurement("gyro", k * _STEP_NS, (0.0, 0.0, 0.0), _SENSOR_RAD))
        localizer.process_detections(replace(found, attitude=head_on) if k == _FRAMES - 1 else found)


def warm_up(process: Callable[[Frame], Fix], station: Station, camera: Camera) -> Iterator[tuple[str, Fix]]:
    """Let the `process` of a localizer see a drawn dock in every pixel format; the localizer is discarded afterwards.

    Yields each format and its last fix. What is compiled stays in this process and on disk.
    """
    for name, frames in _films(station, camera):
        yield name, [process(frame) for frame in frames][-1]


def _films(station: Station, camera: Camera) -> Iterator[tuple[str, Iterator[Frame]]]:
    """The name of each format, and frames of it."""
    water = np.random.default_rng(0).normal(12.0, 1.0, (camera.height, camera.width))
    for number, name in enumerate(_FORMATS):
        pictures = (_picture(water, _view(station, camera, k)) for k in range(_FRAMES))
        yield name, (_frame(name, 100 * number + k, picture) for k, picture in enumerate(pictures))


def _frame(name: str, number: int, picture: Array) -> Frame:
    """A picture in one of the formats; numbers of two formats are too far apart for history to be carried across."""
    encoding, white = _FORMATS[name]
    image = np.clip(picture * (white / 255.0), 0, white).astype(np.uint8 if white == 255 else np.uint16)
    pixels = np.repeat(image[:, :, None], 3, axis=2) if encoding == "bgr8" else image
    return Frame(f"{name} {number}", number * _STEP_NS, pixels, encoding=encoding)


def _view(station: Station, camera: Camera, k: int) -> Array:
    """Pixels (n, 2) of the station's lights, head-on and a step nearer each frame; none in the blank one."""
    if k == _BLANK:
        return np.empty((0, 2))
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    width = float(np.ptp(station.p_dock[:, :2], axis=0).max())
    T_dock_cam[:2, 3] = station.p_dock[:, :2].mean(axis=0)
    T_dock_cam[2, 3] = station.p_dock[:, 2].max() + (_AWAY - _STEP * k) * width
    uv = camera.project(transform_points(se3_inverse(T_dock_cam), station.p_dock))
    return uv[np.isfinite(uv).all(axis=1)]


def _picture(water: Array, uv: Array) -> Array:
    """Levels (H, W), white 255, of blobs in `water`."""
    image = water.copy()
    for u, v in uv:
        _add_blob(image, float(u), float(v))
    return image


def _add_blob(image: Array, u: float, v: float) -> None:
    rows, columns = np.arange(int(v) - 8, int(v) + 9), np.arange(int(u) - 8, int(u) + 9)
    if rows[0] >= 0 and rows[-1] < image.shape[0] and columns[0] >= 0 and columns[-1] < image.shape[1]:
        profile = np.exp(-0.5 * ((rows[:, None] - v) ** 2 + (columns[None] - u) ** 2) / 2.25)
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += 150.0 * profile
