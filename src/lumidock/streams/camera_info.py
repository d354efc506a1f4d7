"""What a CameraInfo says of the camera of its pictures: binning, region of interest, rectification as ROS means them.

Source: the comments of sensor_msgs/CameraInfo. K, D and P belong to the full sensor; the region of interest is given in
its pixels and is cut out first, then pixels are binned. Pictures that were rectified are those of P, without
distortion, in a camera frame that R turns against the raw one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera, camera_from, windowed
from lumidock.errors import InputError
from lumidock.streams.calibration_check import require_possible

# image_rect, image_rect_color, image_rectified, rect/image, image_undistorted, ...
_RECTIFIED = re.compile(r"(?:^|[/_])(?:rect|rectified|undistorted|undist)(?:[/_]|$)")
_LEAST_TURN_RAD = 1e-3  # of the rectified frame against the raw one that is worth a word: 1 cm at 10 m


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """The content of a CameraInfo message; `roi` is x, y, width, height px, all zero where there is none."""

    origin: str
    frame_id: str
    size: tuple[int, int]
    model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)

    @property
    def calibrated(self) -> bool:
        """Whether it says anything of the lens: a driver without a calibration sends zeros."""
        return any(self.k)


def is_rectified(topic: str) -> bool:
    """Whether a topic's name says that its pictures were rectified."""
    return _RECTIFIED.search(topic) is not None


def camera_of(info: CameraInfo, *, rectified: bool = False, trusted: bool = False) -> tuple[Camera, tuple[str, ...]]:
    """The camera of the pictures that a CameraInfo describes, and what a person should know of it.

    Raises: InputError, one line, for one that is not calibrated, absurd or not `trusted`.
    """
    if not info.calibrated:
        raise InputError(f"{info.origin}: the camera is not calibrated; give --camera FILE")
    sensor, notes = _rectified(info) if rectified else (_raw(info), ())
    require_possible(sensor, info.origin, trusted=trusted)
    camera = windowed(sensor, info.origin, info.roi, info.binning)
    if camera is not sensor:
        notes = (*notes, _window_note(info, camera))
    return camera, notes


def _raw(info: CameraInfo) -> Camera:
    return camera_from(info.origin, info.size, list(info.k), info.model, list(info.d))


def _rectified(info: CameraInfo) -> tuple[Camera, tuple[str, ...]]:
    """The camera of rectified pictures of the full sensor."""
    if not any(info.p):
        if any(info.d):
            raise InputError(
                f"{info.origin}: pictures are rectified by their topic's name, and the projection matrix P is zero; "
                "give --camera FILE"
            )
        return _raw(info), ()
    matrix = [info.p[i] for i in (0, 1, 2, 4, 5, 6, 8, 9, 10)]
    camera = camera_from(info.origin, info.size, matrix, "none", [])
    notes = [f"{info.origin}: the topic is rectified by its name: P is used, without distortion"]
    R = np.array(info.r or np.eye(3)).reshape(3, 3)
    turn = float(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))) if R.any() else 0.0
    if turn > _LEAST_TURN_RAD:
        notes.append(
            f"{info.origin}: the pose is that of the rectified camera, which R turns by {np.rad2deg(turn):.2f} degrees "
            "against the raw one"
        )
    return camera, tuple(notes)


def _window_note(info: CameraInfo, camera: Camera) -> str:
    x, y, width, height = info.roi
    parts = [f"region of interest {width}x{height} at ({x}, {y})"] if width and height else []
    parts += [f"binning {info.binning[0]}x{info.binning[1]}"] if info.binning != (1, 1) else []
    return (
        f"{info.origin}: {' and '.join(parts)} of {info.size[0]}x{info.size[1]}: a camera of "
        f"{camera.width}x{camera.height} pixels"
    )


def difference(before: Camera, after: Camera) -> str:
    """What a calibration says differently from the one before; empty where both are the same."""
    if (before.width, before.height) != (after.width, after.height):
        return f"{before.width}x{before.height} pixels become {after.width}x{after.height}"
    names = ("fx", "fy", "cx", "cy")
    old, new = ((*camera.focal_px, *camera.center_px) for camera in (before, after))
    for name, a, b in zip(names, old, new, strict=True):
        if a != b:
            return f"{name} becomes {b:g} from {a:g} px"
    if before.model != after.model:
        return f"{before.model} becomes {after.model}"
    return "" if np.array_equal(before.distortion, after.distortion) else "the distortion becomes another"
