"""Camera calibrations of other tools, in and out, and whether one looks fit for use in water."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from lumidock.camera import Camera, camera_from, load_camera, save_camera
from lumidock.errors import InputError
from lumidock.yamlfile import parse_mapping, read_text, validate

WATER = 1.333  # refractive index, relative to the air behind a flat port
_FLAT_PORT_CURVATURE = (WATER**2 - 1.0) / 2.0  # see `curvature`
_LOOKS_DRY = 0.15  # a curvature below it: lenses seldom add or take more than 0.2
_RATIO_MIDDLE = 1.0 + (WATER - 1.0) / 2.0
_MAX_CENTER_OFFSET, _MAX_ASPECT_ERROR = 0.1, 0.02  # of the image's width; of fx / fy
_KALIBR_MODELS = {"radtan": "plumb_bob", "equi": "equidistant", "equidistant": "equidistant", "none": "plumb_bob"}
_OPENCV_NAMES = {
    "matrix": ("camera_matrix", "cameraMatrix", "K", "M1", "intrinsics"),
    "distortion": ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "D1"),
}


def read_calibration(path: Path, *, name: str | None = None, size: tuple[int, int] | None = None) -> Camera:
    """Read ROS camera_info, a Kalibr camchain or an OpenCV FileStorage (YAML, XML or JSON), told apart by content.

    `name` chooses a camera of a camchain, `size` (width, height) px stands in where the file has none.
    Raises: InputError, one line, for what is none of these, incomplete or absurd.
    """
    text = read_text(path).lstrip()
    if text.startswith(("%YAML:", "<", "{")) or "!!opencv-matrix" in text:
        camera = _read_opencv(path, text, size)
    else:
        content = parse_mapping(text, path)
        if any(isinstance(entry, dict) and "intrinsics" in entry for entry in content.values()):
            camera = _read_kalibr(path, content, name)
        else:
            camera = load_camera(path)
    if size is not None and size != (camera.width, camera.height):
        raise InputError(f"{path}: made for {camera.width}x{camera.height} pixels, not for {size[0]}x{size[1]}")
    return camera


class _KalibrCamera(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    camera_model: str
    intrinsics: Annotated[list[float], Field(min_length=4, max_length=4)]
    distortion_model: str = "none"
    distortion_coeffs: list[float] = []
    resolution: tuple[int, int]


def _read_kalibr(path: Path, content: dict[str, Any], name: str | None) -> Camera:
    cameras = [key for key, entry in content.items() if isinstance(entry, dict) and "intrinsics" in entry]
    if name is None and len(cameras) > 1:
        raise InputError(f"{path}: several cameras; choose with --name: {', '.join(map(str, cameras))}")
    chosen = name if name is not None else cameras[0]
    if chosen not in cameras:
        raise InputError(f"{path}: no camera {chosen}; there are {', '.join(map(str, cameras))}")
    found = validate(_KalibrCamera, content[chosen], f"{path}: {chosen}")
    if found.camera_model != "pinhole":
        raise InputError(f"{path}: {chosen}: camera model {found.camera_model[:40]!r} is not supported, only pinhole")
    model = _KALIBR_MODELS.get(found.distortion_model)
    if model is None:
        raise InputError(f"{path}: {chosen}: distortion model {found.distortion_model[:40]!r} is not supported")
    fu, fv, pu, pv = found.intrinsics
    coefficients = [0.0] * 5 if found.distortion_model == "none" else found.distortion_coeffs
    return camera_from(
        f"{path}: {chosen}", found.resolution, [fu, 0.0, pu, 0.0, fv, pv, 0.0, 0.0, 1.0], model, coefficients
    )


def _read_opencv(path: Path, text: str, size: tuple[int, int] | None) -> Camera:
    """OpenCV's own parser ends the process on a damaged file, so it is not asked."""
    content = _opencv_content(path, text)
    matrix, distortion = (_numbers(path, content, names) for names in _OPENCV_NAMES.values())
    if matrix is None or len(matrix) != 9:
        raise InputError(f"{path}: no camera_matrix of 3 x 3")
    size = _opencv_size(path, content) or size
    if size is None:
        raise InputError(f"{path}: says no image size; give --size WIDTHxHEIGHT")
    d = [0.0] * 5 if distortion is None else distortion
    d = d[:8] if len(d) > 8 and not any(d[8:]) else d
    fisheye = str(content.get("fisheye_model", "0")).strip() not in ("0", "0.0", "False")
    model = "equidistant" if fisheye else "rational_polynomial" if len(d) > 5 else "plumb_bob"
    return camera_from(str(path), size, matrix, model, d)


def _opencv_content(path: Path, text: str) -> dict[str, Any]:
    if text.startswith("<"):
        return _xml_content(path, text)
    if text.startswith("{"):
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not valid JSON: {' '.join(str(error).split())}") from None
        return content if isinstance(content, dict) else {}
    lines = text.replace("!!opencv-matrix", "").splitlines()
    return parse_mapping("\n".join(line for line in lines if not line.startswith(("%YAML", "---"))), path)


def _xml_content(path: Path, text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise InputError(f"{path}: document types and entities are not allowed")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid XML: {' '.join(str(error).split())}") from None
    return {
        entry.tag: {part.tag: part.text or "" for part in entry} if len(entry) else entry.text or "" for entry in root
    }


def _numbers(path: Path, content: dict[str, Any], names: tuple[str, ...]) -> list[float] | None:
    """The numbers of the first of `names` that is there: a matrix, a list, or a text of numbers."""
    for name in names:
        entry = content.get(name)
        if entry is None:
            continue
        data = entry.get("data") if isinstance(entry, dict) else entry
        values = data.split() if isinstance(data, str) else data
        try:
            found = np.array(values, float).reshape(-1)
        except (ValueError, TypeError, OverflowError):
            raise InputError(f"{path}: {name}: not a matrix of numbers") from None
        return [float(value) for value in found]
    return None


def _opencv_size(path: Path, content: dict[str, Any]) -> tuple[int, int] | None:
    sides = [_numbers(path, content, (name,)) for name in ("image_width", "image_height")]
    both = _numbers(path, content, ("imageSize", "image_size"))
    numbers = both or [value for side in sides for value in side or ()]
    if len(numbers) != 2:
        return None
    if not all(value.is_integer() and abs(value) < 1e6 for value in numbers):
        raise InputError(f"{path}: an image of {numbers[0]:g}x{numbers[1]:g} pixels")
    return int(numbers[0]), int(numbers[1])


def write_calibration(camera: Camera, path: Path, form: str) -> None:
    """Write a camera as `ros`, `kalibr` or `opencv`. Raises: InputError for a lens that the form has no words for."""
    writers: dict[str, Callable[[Camera, Path], None]] = {
        "ros": save_camera,
        "kalibr": _write_kalibr,
        "opencv": _write_opencv,
    }
    if form not in writers:
        raise InputError(f"--to {form}: not one of {', '.join(writers)}")
    writers[form](camera, path)


def _write_kalibr(camera: Camera, path: Path) -> None:
    d = [float(value) for value in camera.distortion]
    if camera.model == "rational_polynomial" or (camera.model == "plumb_bob" and len(d) == 5 and d[4] != 0.0):
        raise InputError(f"{path}: Kalibr has no distortion model for this lens ({camera.model}, k3 or more)")
    content = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": [float(v) for v in (*camera.focal_px, *camera.center_px)],
            "distortion_model": "equi" if camera.model == "equidistant" else "radtan",
            "distortion_coeffs": d[:4],
            "resolution": [camera.width, camera.height],
        }
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")


def _write_opencv(camera: Camera, path: Path) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    if not storage.isOpened():
        raise InputError(f"{path}: cannot be written")
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("fisheye_model", int(camera.model == "equidistant"))
    storage.write("camera_matrix", np.asarray(camera.K, float))
    storage.write("distortion_coefficients", np.asarray(camera.distortion, float).reshape(1, -1))
    storage.release()


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a calibration says of its camera: field of view (horizontal, vertical, diagonal) deg, and what is odd."""

    field_of_view_deg: tuple[float, float, float]
    curvature: float
    focal_ratio: float | None
    warnings: tuple[str, ...]


def check(camera: Camera, *, lens_mm: float | None = None, pixel_um: float | None = None) -> Verdict:
    """Hold a calibration against what a camera in water should look like; the lens's data make it certain."""
    ratio = None
    if lens_mm is not None and pixel_um is not None:
        ratio = float(camera.focal_px.mean()) / (1000.0 * lens_mm / pixel_um)
    bend = curvature(camera)
    warnings = [*_dry(bend, ratio, bool(camera.distortion.any())), *_odd(camera)]
    return Verdict(_field_of_view(camera), bend, ratio, tuple(warnings))


def curvature(camera: Camera) -> float:
    """The factor c in r = f x (1 + c x^2), x = tan of the angle to the axis, near the axis.

    Snell's law at a flat port, n sin(water) = sin(air), multiplies the focal length by n and adds (n^2 - 1) / 2, which
    is 0.39 in water: no lens looks like that in air. A dome port changes neither.
    """
    if camera.model == "equidistant":
        return float(camera.distortion[0]) - 1.0 / 3.0
    denominator = float(camera.distortion[5]) if len(camera.distortion) == 8 else 0.0
    return float(camera.distortion[0]) - denominator


def _dry(bend: float, ratio: float | None, distorted: bool) -> list[str]:
    """Signs of a calibration in air; without distortion, as of rectified pictures, only the focal length has any."""
    if ratio is not None:
        if ratio < _RATIO_MIDDLE:
            return [
                f"the focal length is {ratio:.2f} times the lens's: made in air; behind a flat port in water it is "
                f"{WATER:.2f} times, and ranges would be {100 * (1 - ratio / WATER):.0f} % short"
            ]
        return []
    if bend < _LOOKS_DRY and distorted:
        return [
            f"looks like made in air: the radial term is {bend:+.2f}, a flat port in water gives about "
            f"{_FLAT_PORT_CURVATURE:+.2f}; behind a dome port it is fine, behind a flat one ranges come out "
            f"{100 * (1 - 1 / WATER):.0f} % short"
        ]
    return []


def _odd(camera: Camera) -> list[str]:
    found = []
    offset = (camera.center_px - (np.array([camera.width, camera.height]) - 1.0) / 2.0) / camera.width
    if np.abs(offset).max() > _MAX_CENTER_OFFSET:
        found.append(f"the principal point is {100 * np.abs(offset).max():.0f} % of the width off the image's middle")
    aspect = float(camera.focal_px[0] / camera.focal_px[1])
    if abs(aspect - 1.0) > _MAX_ASPECT_ERROR:
        found.append(f"fx / fy is {aspect:.3f}: pixels of machine vision cameras are square")
    blind = np.isnan(camera.unproject(_border(camera))).any(axis=1).mean()
    if blind:
        found.append(
            f"{100 * blind:.0f} % of the image's border has no ray: the distortion folds over inside the image"
        )
    return found


def _border(camera: Camera) -> np.ndarray:
    u, v = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33)
    top, left = np.stack([u, 0 * u], 1), np.stack([0 * v, v], 1)
    down, right = np.array([0.0, camera.height - 1.0]), np.array([camera.width - 1.0, 0.0])
    return np.concatenate([top, top + down, left, left + right])


def _field_of_view(camera: Camera) -> tuple[float, float, float]:
    """Angles between the rays of opposite edges and corners, deg; NaN where the lens has no ray there."""
    w, h = camera.width - 1.0, camera.height - 1.0
    cx, cy = (float(v) for v in camera.center_px)
    pairs = [[(0, cy), (w, cy)], [(cx, 0), (cx, h)], [(0, 0), (w, h)]]
    rays = [camera.unproject(np.array(pair, float)) for pair in pairs]
    across, down, diagonal = (float(np.rad2deg(np.arccos(np.clip(a @ b, -1.0, 1.0)))) for a, b in rays)
    return across, down, diagonal
