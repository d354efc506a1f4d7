"""Camera calibrations of other tools, in and out: told apart by their content, and refused by their name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from lumidock.camera import Camera, camera_of_mapping, save_camera
from lumidock.errors import InputError
from lumidock.setup import calibration_dialects as dialects
from lumidock.setup.calibration_opencv import WAY_OUT, read_opencv
from lumidock.streams.camera_info import CameraInfo, camera_of
from lumidock.yamlfile import parse_mapping, read_text

_HEAD = 128  # bytes that tell files that are no text
_BINARY = {b"MATLAB 5.0 MAT-file": "a MAT-file of MATLAB", b"\x89HDF": "a MAT-file of MATLAB (7.3) or HDF5"}
_BINARY |= {b"PK\x03\x04": "an archive (.npz of NumPy?)", b"\x93NUMPY": "a NumPy array", b"\x80\x04": "a Python pickle"}
_OPENCV_TAG = re.compile(r"!!opencv-[a-z-]+|!<tag:[^>]*>")


def read_calibration(path: Path, *, name: str | None = None, size: tuple[int, int] | None = None) -> Camera:
    """Read a camera calibration of any of the tools that docs/formats-supported.md lists, told apart by content.

    `name` chooses a camera of several, `size` (width, height) px stands in where the file has none.
    Raises: InputError, one line, for what is none of these, incomplete or absurd.
    """
    return read_with_dialect(path, name=name, size=size)[1]


def read_with_dialect(
    path: Path, *, name: str | None = None, size: tuple[int, int] | None = None
) -> tuple[str, Camera]:
    """What wrote a calibration, `ros` or another tool, and its camera; as `read_calibration`."""
    dialect, camera = _read(path, _text(path), name, size)
    if size is not None and size != (camera.width, camera.height):
        raise InputError(f"{path}: made for {camera.width}x{camera.height} pixels, not for {size[0]}x{size[1]}")
    return dialect, camera


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    for magic, what in _BINARY.items():
        if head.startswith(magic):
            raise InputError(f"{path}: {what}, which is not read; {WAY_OUT}")
    return read_text(path).lstrip()


def _read(path: Path, text: str, name: str | None, size: tuple[int, int] | None) -> tuple[str, Camera]:
    for tool, (pattern, way_out) in dialects.REFUSED_TEXTS.items():
        if pattern.search(text):
            raise InputError(f"{path}: a calibration of {tool}, which is not read; {way_out}")
    if text.startswith("<"):
        return _read_xml(path, text, name, size)
    if text.startswith("# oST") or re.match(r"\[[A-Za-z_ ]+\]\s", text):
        return "ROS INI", dialects.read_ost(path, text, name)
    if dialects.is_colmap(text):
        return "COLMAP", dialects.read_colmap(path, text, name)
    if re.search(r"^\s*fc\s*=\s*\[", text, re.MULTILINE) and re.search(r"^\s*cc\s*=\s*\[", text, re.MULTILINE):
        return "Matlab toolbox", dialects.read_bouguet(path, text)
    content, is_opencv = _json(path, text) if text.startswith(("{", "[")) else _yaml(path, text)
    return _read_mapping(path, content, name, size, is_opencv=is_opencv)


def _read_mapping(
    path: Path, content: dict[str, Any], name: str | None, size: tuple[int, int] | None, *, is_opencv: bool
) -> tuple[str, Camera]:
    for tool, (matches, way_out) in dialects.REFUSED.items():
        if matches(content):
            raise InputError(f"{path}: a calibration of {tool}, which is not read; {way_out}")
    if "Calibration" in content:
        return "calib.io", dialects.read_calibio(path, content, name)
    if "model_type" in content and "projection_parameters" in content:
        return "camodocal", dialects.read_camodocal(path, content)
    if any(str(key).startswith(("Camera.fx", "Camera1.fx")) for key in content):
        return "ORB-SLAM", dialects.read_orbslam(path, content, name)
    if _is_kalibr(content):
        return "Kalibr", dialects.read_kalibr(path, content, name)
    if not is_opencv and {"width", "height"} <= content.keys() and ("k" in content or "K" in content):
        return "CameraInfo message", _read_message(path, content)
    matrix = content.get("camera_matrix")
    ros = not is_opencv and isinstance(matrix, dict) and "data" in matrix and "distortion_coefficients" in content
    if ros and "image_width" in content:
        _refuse_more(path, content)
        return "ros", camera_of_mapping(content, path)
    if "lights" in content or "T_body_cam" in content:
        what = "a station file" if "lights" in content else "a vehicle file"
        raise InputError(f"{path}: {what}, not a camera calibration")
    return "OpenCV", read_opencv(path, content, name, size)


def _is_kalibr(content: dict[str, Any]) -> bool:
    """Whether this is a camchain, or one camera of EuRoC."""
    if isinstance(content.get("intrinsics"), list) and "camera_model" in content:
        return True
    return any(isinstance(entry, dict) and isinstance(entry.get("intrinsics"), list) for entry in content.values())


def _refuse_more(path: Path, content: dict[str, Any]) -> None:
    """Raises: InputError for a ROS file that has a second distortion, which ROS would pass over."""
    for key in content:
        if key != "distortion_coefficients" and re.fullmatch(r"(?i)d|dist(_?coeff?s?)?|distCoeffs", str(key)):
            raise InputError(f"{path}: key {key} beside distortion_coefficients could be distortion; leave one")


def _read_message(path: Path, content: dict[str, Any]) -> Camera:
    """A CameraInfo message as `ros2 topic echo` or `rostopic echo` prints it."""

    def numbers(key: str) -> tuple[float, ...]:
        value = content.get(key, content.get(key.upper(), []))
        try:
            return tuple(float(number) for number in value)
        except (TypeError, ValueError):
            raise InputError(f"{path}: {key}: not a list of numbers") from None

    roi = content.get("roi") if isinstance(content.get("roi"), dict) else {}
    try:
        size = int(content["width"]), int(content["height"])
        window = tuple(int(roi.get(key, 0)) for key in ("x_offset", "y_offset", "width", "height")) if roi else (0,) * 4
        binning = max(int(content.get("binning_x", 0)), 1), max(int(content.get("binning_y", 0)), 1)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: CameraInfo message: width, height, roi or binning is no whole number") from None
    k, p = numbers("k"), numbers("p")
    if len(k) != 9 or len(p) not in (0, 12):
        raise InputError(f"{path}: CameraInfo message: wanted 9 numbers of k and 12 of p")
    model = str(content.get("distortion_model", ""))
    x, y, wide, high = window
    info = CameraInfo(
        str(path), "", size, model, d=numbers("d"), k=k, r=(), p=p, binning=binning, roi=(x, y, wide, high)
    )
    return camera_of(info, trusted=True)[0]  # whether it can be a camera's is asked of every calibration alike


def _json(path: Path, text: str) -> tuple[dict[str, Any], bool]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: JSON without keys; {WAY_OUT}")
    return content, True


def _yaml(path: Path, text: str) -> tuple[dict[str, Any], bool]:
    """The content of a file in YAML, without what OpenCV adds to it; and whether it is OpenCV's."""
    is_opencv = "opencv-matrix" in text
    lines = [line for line in _OPENCV_TAG.sub("", text).splitlines() if not line.startswith("%")]
    first = "\n".join(lines).removeprefix("---").split("\n---", 1)[0]
    try:
        return parse_mapping(first, path), is_opencv
    except InputError as error:
        raise InputError(f"{error}; {WAY_OUT}") from None


def _read_xml(path: Path, text: str, name: str | None, size: tuple[int, int] | None) -> tuple[str, Camera]:
    if "<!" in text.replace("<!--", ""):
        raise InputError(f"{path}: document types and entities are not allowed")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid XML: {' '.join(str(error).split())}") from None
    if root.tag == "calibration" and root.find("projection") is not None:
        return "Metashape", dialects.read_metashape(path, root)
    if root.tag == "document":
        raise InputError(
            f"{path}: a project of Metashape; export the camera calibration alone (Tools, Camera Calibration)"
        )
    if root.tag != "opencv_storage":
        raise InputError(f"{path}: XML of <{root.tag[:40]}>, which is not read; {WAY_OUT}")
    content: dict[str, Any] = {
        entry.tag: {part.tag: part.text or "" for part in entry} if len(entry) else entry.text or "" for entry in root
    }
    return "OpenCV", read_opencv(path, content, name, size)


def write_calibration(camera: Camera, path: Path, form: str) -> None:
    """Write a camera as `ros`, `kalibr` or `opencv`. Raises: InputError for a lens that the form has no words for."""
    writers: dict[str, Callable[[Camera, Path], None]] = {
        "ros": save_camera,
        "kalibr": _write_kalibr,
        "opencv": _write_opencv,
    }
    if form not in writers:
        raise InputError(f"--to {form}: not one of {', '.join(writers)}")
    if camera.port is not None and form != "ros":
        raise InputError(f"--to {form}: has no words for the flat port of this camera; --to ros keeps it")
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
