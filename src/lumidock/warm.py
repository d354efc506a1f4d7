"""Compiling ahead: a made-up docking before the first real frame, so that no vehicle waits for its first fix."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Fix, Frame
from lumidock.geometry import se3_inverse, transform_points
from lumidock.station import Station

_FRAMES, _STEP_NS, _STEP = 8, 100_000_000, 0.02
_BLANK = 5  # the frame without lights, after which the track has to be taken up again
_FORMATS = {"8 bits": ("bgr8", 255), "16 bits": ("bayer_rggb16", 65535)}
_AWAY = 3.0  # and _STEP in widths of the array, all of whose lights are in the picture then


def warm_up(process: Callable[[Frame], Fix], station: Station, camera: Camera) -> Iterator[tuple[str, Fix]]:
    """Show the image door of a localizer, to be thrown away after, a drawn dock in every format of pixels.

    Yields each format and its last fix. What is compiled stays in this process and in numba's cache on disk.
    """
    water = np.random.default_rng(0).normal(12.0, 1.0, (camera.height, camera.width))
    for number, (name, (encoding, white)) in enumerate(_FORMATS.items()):
        for k in range(_FRAMES):
            levels = _picture(water, station, camera, k) * (white / 255.0)
            image = np.clip(levels, 0, white).astype(np.uint8 if white == 255 else np.uint16)
            pixels = np.repeat(image[:, :, None], 3, axis=2) if encoding == "bgr8" else image
            t_ns = (100 * number + k) * _STEP_NS  # far enough apart that no history is carried across
            fix = process(Frame(f"{name} {k}", t_ns, pixels, encoding=encoding))
        yield name, fix


def _picture(water: Array, station: Station, camera: Camera, k: int) -> Array:
    """Levels (H, W), white 255, of the station's lights as spots in `water`, head-on and a step nearer each frame."""
    if k == _BLANK:
        return water
    image = water.copy()
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    width = float(np.ptp(station.p_dock[:, :2], axis=0).max())
    T_dock_cam[:2, 3] = station.p_dock[:, :2].mean(axis=0)
    T_dock_cam[2, 3] = station.p_dock[:, 2].max() + (_AWAY - _STEP * k) * width
    uv = camera.project(transform_points(se3_inverse(T_dock_cam), station.p_dock))
    for u, v in uv[np.isfinite(uv).all(axis=1)]:
        _add_spot(image, float(u), float(v))
    return image


def _add_spot(image: Array, u: float, v: float) -> None:
    rows, columns = np.arange(int(v) - 8, int(v) + 9), np.arange(int(u) - 8, int(u) + 9)
    if rows[0] >= 0 and rows[-1] < image.shape[0] and columns[0] >= 0 and columns[-1] < image.shape[1]:
        profile = np.exp(-0.5 * ((rows[:, None] - v) ** 2 + (columns[None] - u) ** 2) / 2.25)
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += 150.0 * profile
