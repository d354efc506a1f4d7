"""Compiling ahead: a made-up docking through both doors, so that no vehicle waits for its first fix."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Frame, Image
from lumidock.geometry import se3_inverse, transform_points
from lumidock.localizer import Localizer
from lumidock.station import Station

_FRAMES, _STEP_NS = 4, 100_000_000
_FORMATS: dict[str, tuple[type, int]] = {"8 bits": (np.uint8, 3), "16 bits": (np.uint16, 1)}


def steps(station: Station, camera: Camera) -> Iterator[str]:
    """Name each format before its code is compiled; compiled code stays in numba's cache on disk."""
    for name, (dtype, channels) in _FORMATS.items():
        yield name
        localizer = Localizer(station, camera)
        for k in range(_FRAMES):
            image = _picture(station, camera, 9.0 - 0.05 * k, dtype, channels)
            localizer.process(Frame(str(k), k * _STEP_NS, image))


def _picture(station: Station, camera: Camera, z_m: float, dtype: type, channels: int) -> Image:
    """The station's lights as spots, seen head-on from `z_m`."""
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    T_dock_cam[2, 3] = z_m
    uv = camera.project(transform_points(se3_inverse(T_dock_cam), station.p_dock))
    image = np.random.default_rng(0).normal(12.0, 1.0, (camera.height, camera.width))
    for u, v in uv[np.isfinite(uv).all(axis=1)]:
        _add_spot(image, float(u), float(v))
    deep: Image = np.clip(image * (np.iinfo(dtype).max / 255.0), 0, np.iinfo(dtype).max).astype(dtype)
    return deep if channels == 1 else np.repeat(deep[:, :, None], channels, axis=2)


def _add_spot(image: Array, u: float, v: float) -> None:
    rows, columns = np.arange(int(v) - 8, int(v) + 9), np.arange(int(u) - 8, int(u) + 9)
    if rows[0] >= 0 and rows[-1] < image.shape[0] and columns[0] >= 0 and columns[-1] < image.shape[1]:
        profile = np.exp(-0.5 * ((rows[:, None] - v) ** 2 + (columns[None] - u) ** 2) / 2.25)
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += 150.0 * profile
