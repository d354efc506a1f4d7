"""Calibrations of other tools than OpenCV, each by the page that defines it, and those that are refused by their name.

Sources: Kalibr wiki (camera models), EuRoC data set (sensor.yaml), ORB-SLAM3 calibration tutorial, camodocal (VINS),
COLMAP documentation (cameras.txt, camera models), Agisoft Metashape Pro user manual (appendix: camera models), calib.io
(the reader it publishes), Camera Calibration Toolbox for Matlab (J.-Y. Bouguet, description of the parameters), ROS
camera_calibration_parsers (INI files, "oST").
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lumidock.camera import Camera, camera_from
from lumidock.errors import InputError
from lumidock.setup.calibration_opencv import WAY_OUT
from lumidock.yamlfile import validate

_KALIBR_MODELS = {"radtan": "plumb_bob", "radial-tangential": "plumb_bob", "equi": "equidistant"}
_KALIBR_MODELS |= {"equidistant": "equidistant", "none": "none"}
_WAY_OUT = "calibrate with a pinhole model (radtan) or a fisheye one (equi)"
_COLMAP_LINE = re.compile(r"\s*(\d+)\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.0-9eE]+)+)\s*")
# number of focal lengths, then what the parameters after cx, cy are in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6
_COLMAP = {
    "SIMPLE_PINHOLE": (1, 0, "none"),
    "PINHOLE": (2, 0, "none"),
    "SIMPLE_RADIAL": (1, 1, ""),
    "RADIAL": (1, 2, ""),
    "OPENCV": (2, 4, ""),
    "FULL_OPENCV": (2, 8, ""),
    "OPENCV_FISHEYE": (2, 4, "equidistant"),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, "equidistant"),
    "RADIAL_FISHEYE": (1, 2, "equidistant"),
}
_BOUGUET = re.compile(r"^\s*(fc|cc|kc|alpha_c|nx|ny)\s*=\s*(?:\[([^\]]*)\]|([^;%\s]+))", re.MULTILINE)


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> list[float]:
    """The nine numbers of a camera matrix, row by row."""
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def choose(path: Path, names: list[str], wanted: str | None) -> str:
    """The one camera that is meant. Raises: InputError that asks where there are several."""
    if wanted is not None and wanted not in names:
        raise InputError(f"{path}: no camera {wanted}; there are {', '.join(names)}")
    if wanted is None and len(names) > 1:
        raise InputError(f"{path}: several cameras; choose with --name: {', '.join(names)}")
    return wanted if wanted is not None else names[0]


class _KalibrCamera(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    camera_model: str = "pinhole"
    intrinsics: Annotated[list[float], Field(min_length=4)]
    distortion_model: str = "none"
    distortion_coeffs: list[float] | None = None
    distortion_coefficients: list[float] | None = None  # as EuRoC calls them
    resolution: tuple[int, int]


def read_kalibr(path: Path, content: dict[str, Any], name: str | None) -> Camera:
    """A camera of a Kalibr camchain (also with an IMU, or as OpenVINS writes it), or a sensor.yaml of EuRoC."""
    if "intrinsics" in content:
        return _kalibr_camera(f"{path}", content)
    cameras = [str(key) for key, entry in content.items() if isinstance(entry, dict) and "intrinsics" in entry]
    chosen = choose(path, cameras, name)
    return _kalibr_camera(f"{path}: {chosen}", content[chosen])


def _kalibr_camera(origin: str, entry: dict[str, Any]) -> Camera:
    model = str(entry.get("camera_model", "pinhole"))
    if model != "pinhole":
        raise InputError(f"{origin}: Kalibr's camera model {model[:40]!r} is not supported; {_WAY_OUT}")
    found = validate(_KalibrCamera, entry, origin)
    lens = _KALIBR_MODELS.get(found.distortion_model)
    if lens is None:
        raise InputError(
            f"{origin}: Kalibr's distortion model {found.distortion_model[:40]!r} is not supported; {_WAY_OUT}"
        )
    if len(found.intrinsics) != 4:
        raise InputError(f"{origin}: intrinsics: wanted fu, fv, pu, pv, there are {len(found.intrinsics)} numbers")
    coefficients = found.distortion_coeffs or found.distortion_coefficients or []
    if lens != "none" and not coefficients:
        raise InputError(f"{origin}: {found.distortion_model} without distortion_coeffs")
    return camera_from(origin, found.resolution, pinhole_matrix(*found.intrinsics), lens, coefficients)


def read_orbslam(path: Path, content: dict[str, Any], name: str | None) -> Camera:
    """A settings file of ORB-SLAM2 or 3: Camera.fx or Camera1.fx, and Camera2 of a stereo camera."""
    form = str(content.get("Camera.type", "PinHole"))
    cameras = [prefix for prefix in ("Camera", "Camera1", "Camera2") if f"{prefix}.fx" in content]
    prefix = choose(path, cameras, name)
    origin = f"{path}: {prefix}"

    def value(key: str, default: float | None = None) -> float:
        found = content.get(f"{prefix}.{key}", default)
        if found is None or isinstance(found, bool) or not isinstance(found, (int, float)):
            raise InputError(f"{origin}: no number {prefix}.{key}")
        return float(found)

    size = [content.get(f"Camera.{side}") for side in ("width", "height")]
    if not all(isinstance(side, int) for side in size):
        raise InputError(f"{origin}: no Camera.width and Camera.height; add them")
    matrix = pinhole_matrix(value("fx"), value("fy"), value("cx"), value("cy"))
    models = {"PinHole": "", "Rectified": "none", "KannalaBrandt8": "equidistant"}
    if form not in models:
        raise InputError(f"{origin}: ORB-SLAM's camera type {form[:40]!r} is not supported")
    if models[form] == "equidistant":
        coefficients = [value(key) for key in ("k1", "k2", "k3", "k4")]
    else:
        coefficients = [value(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    return camera_from(origin, (int(size[0] or 0), int(size[1] or 0)), matrix, models[form], coefficients)


def read_camodocal(path: Path, content: dict[str, Any]) -> Camera:
    """A file of camodocal, as VINS-Mono and VINS-Fusion use it."""
    form = str(content["model_type"])
    if form not in ("PINHOLE", "KANNALA_BRANDT"):
        raise InputError(f"{path}: camodocal's model {form[:40]!r} is not supported; {_WAY_OUT}")
    p, d = content.get("projection_parameters"), content.get("distortion_parameters", {})
    if not isinstance(p, dict) or not isinstance(d, dict):
        raise InputError(f"{path}: no projection_parameters")
    try:
        size = int(content["image_width"]), int(content["image_height"])
        if form == "PINHOLE":
            numbers = [float(p[key]) for key in ("fx", "fy", "cx", "cy")]
            return camera_from(
                str(path), size, pinhole_matrix(*numbers), "", [float(d[key]) for key in ("k1", "k2", "p1", "p2")]
            )
        numbers = [float(p[key]) for key in ("mu", "mv", "u0", "v0")]
        coefficients = [float(p[key]) for key in ("k2", "k3", "k4", "k5")]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: {' '.join(str(error).split())} is missing or no number") from None
    return camera_from(str(path), size, pinhole_matrix(*numbers), "equidistant", coefficients)


def is_colmap(text: str) -> bool:
    """Whether a text is a cameras.txt of COLMAP."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return bool(lines) and all(_COLMAP_LINE.fullmatch(line) for line in lines)


def read_colmap(path: Path, text: str, name: str | None) -> Camera:
    """A camera of a cameras.txt of COLMAP, whose pixel (0, 0) is the corner of the picture, half a pixel from ours."""
    lines = [found for line in text.splitlines() if (found := _COLMAP_LINE.fullmatch(line))]
    chosen = choose(path, [found[1] for found in lines], name)
    line = next(found for found in lines if found[1] == chosen)
    origin, model = f"{path}: camera {chosen}", line[2]
    if model not in _COLMAP:
        raise InputError(f"{origin}: COLMAP's model {model} is not supported; calibrate as OPENCV or OPENCV_FISHEYE")
    focals, terms, lens = _COLMAP[model]
    try:
        numbers = [float(number) for number in line[5].split()]
    except ValueError:
        raise InputError(f"{origin}: not all parameters are numbers") from None
    if len(numbers) != focals + 2 + terms:
        raise InputError(f"{origin}: {model} takes {focals + 2 + terms} parameters, there are {len(numbers)}")
    cx, cy = (value - 0.5 for value in numbers[focals : focals + 2])
    coefficients = numbers[focals + 2 :]
    if coefficients:
        coefficients += [0.0] * (4 - len(coefficients))
    matrix = pinhole_matrix(numbers[0], numbers[focals - 1], cx, cy)
    return camera_from(origin, (int(line[3]), int(line[4])), matrix, lens, coefficients)


def read_metashape(path: Path, root: Element) -> Camera:
    """A camera calibration of Agisoft Metashape (XML): centre from the picture's middle, P1 and P2 the other way round.

    Older files of PhotoScan have fx, fy and the centre from the picture's corner.
    """
    values = {entry.tag.lower(): (entry.text or "").strip() for entry in root}
    form = values.get("projection", "frame")
    if form not in ("frame", "fisheye"):
        raise InputError(f"{path}: Metashape's projection {form[:40]!r} is not supported; calibrate as frame")
    if form == "fisheye":
        raise InputError(f"{path}: Metashape's fisheye is another model than OpenCV's; export it in the OpenCV format")

    def value(key: str, default: float | None = None) -> float:
        try:
            found = float(values[key]) if key in values or default is None else default
            if not np.isfinite(found):
                raise ValueError
            return found
        except (KeyError, ValueError):
            raise InputError(f"{path}: Metashape calibration: {key} is missing or no number") from None

    size = int(value("width")), int(value("height"))
    for key, what in (("k4", "k4"), ("b2", "skew (b2)"), ("skew", "skew"), ("p3", "p3"), ("p4", "p4")):
        if value(key, 0.0):
            raise InputError(f"{path}: Metashape calibration with {what}, which is not supported; calibrate without it")
    if "fx" in values:
        fx, fy, cx, cy = value("fx"), value("fy"), value("cx") - 0.5, value("cy") - 0.5
    else:
        fx, fy = value("f") + value("b1", 0.0), value("f")
        cx, cy = (0.5 * side + value(key, 0.0) - 0.5 for side, key in zip(size, ("cx", "cy"), strict=True))
    coefficients = [value(key, 0.0) for key in ("k1", "k2", "p2", "p1", "k3")]
    return camera_from(str(path), size, pinhole_matrix(fx, fy, cx, cy), "", coefficients)


def read_calibio(path: Path, content: dict[str, Any], name: str | None) -> Camera:
    """A camera of calib.io's Calibrator (JSON), with its OpenCV model."""
    try:
        cameras = content["Calibration"]["cameras"]
        chosen = choose(path, [f"cam{number}" for number in range(len(cameras))], name)
        model = cameras[int(chosen.removeprefix("cam"))]["model"]
        form = str(model["polymorphic_name"]).removeprefix("libCalib::")
        if form != "CameraModelOpenCV":
            raise InputError(
                f"{path}: {chosen}: calib.io's {form[:60]} is not supported; calibrate with its OpenCV model"
            )
        data = model["ptr_wrapper"]["data"]
        size = data["CameraModelCRT"]["CameraModelBase"]["imageSize"]
        p = {key: float(entry["val"]) for key, entry in data["parameters"].items()}
        matrix = pinhole_matrix(p["f"], p["f"] * p["ar"], p["cx"], p["cy"])
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
        coefficients = [p.get(key, 0.0) for key in names]
        wide, high = int(size["width"]), int(size["height"])
    except (KeyError, TypeError, ValueError, OverflowError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path}: calib.io calibration: {' '.join(str(error).split())} is missing or no number"
        ) from None
    return camera_from(f"{path}: {chosen}", (wide, high), matrix, "", coefficients)


def read_bouguet(path: Path, text: str) -> Camera:
    """A Calib_Results.m of the Camera Calibration Toolbox for Matlab, whose pixel (0, 0) is ours."""
    try:
        found = {
            key: [float(word) for word in re.split(r"[\s;,]+", body.strip(" ;\t")) if word]
            for key, body in _entries(path, text)
        }
    except ValueError as error:
        raise InputError(f"{path}: Matlab toolbox calibration: {error}") from None
    for key, count in {"fc": 2, "cc": 2, "kc": 5, "nx": 1, "ny": 1}.items():
        if len(found.get(key, [])) != count:
            raise InputError(f"{path}: Matlab toolbox calibration: {key} of {count} numbers is missing")
    if any(found.get("alpha_c", [])):
        raise InputError(f"{path}: Matlab toolbox calibration with skew (alpha_c), which is not supported")
    size = int(found["nx"][0]), int(found["ny"][0])
    return camera_from(str(path), size, pinhole_matrix(*found["fc"], *found["cc"]), "", found["kc"])


def _entries(path: Path, text: str) -> list[tuple[str, str]]:
    entries = [(found[1], found[2] or found[3] or "") for found in _BOUGUET.finditer(text)]
    for _, body in entries:
        if re.search(r"[^-+.0-9eE\s;,]", body):
            raise InputError(f"{path}: Matlab toolbox calibration: {body.strip()[:40]!r} is no list of numbers")
    return entries


def read_ost(path: Path, text: str, name: str | None) -> Camera:
    """A camera of an INI file of ROS ("oST"), as camera_calibration prints it."""
    sections, section = dict[str, list[str]](), ""
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("["):
            section = line.strip("[] ")
            sections[section] = []
        elif line and not line.startswith("#") and section:
            sections[section].append(line)
    cameras = [key for key, lines in sections.items() if "camera matrix" in lines]
    if not cameras or "image" not in sections:
        raise InputError(f"{path}: ROS INI file without [image] and a camera matrix")
    chosen = choose(path, cameras, name)
    lines, image = sections[chosen], sections["image"]
    try:
        width, height = (int(image[image.index(key) + 1]) for key in ("width", "height"))
        at = lines.index("camera matrix")
        matrix = [float(number) for line in lines[at + 1 : at + 4] for number in line.split()]
        coefficients = [float(number) for number in lines[lines.index("distortion") + 1].split()]
    except (ValueError, IndexError):
        raise InputError(f"{path}: ROS INI file: width, height, camera matrix or distortion is missing") from None
    if len(coefficients) == 4:
        raise InputError(
            f"{path}: ROS INI file with four coefficients, which does not say of which model; use the YAML file"
        )
    return camera_from(f"{path}: {chosen}", (width, height), matrix, "", coefficients)


# what is no XML, JSON or YAML, or reads as other than it is, by what its text says of itself
REFUSED_TEXTS = {
    "OCamCalib": (re.compile(r"\A#polynomial coefficients"), "calibrate as a fisheye (OpenCV or Kalibr's equi)"),
    "a direct VO (DSO, mono-VO)": (
        re.compile(r"\A(Pinhole|FOV|RadTan|EquiDistant|KannalaBrandt|ATAN)\s+[-.\d]"),
        WAY_OUT,
    ),
    "ZED": (re.compile(r"^\[LEFT_CAM_", re.MULTILINE), "take K and D of the resolution in use from ZED's CameraInfo"),
    "RealityCapture": (re.compile(r"capturingreality\.com/ns/xcr"), "export to COLMAP"),
}
REFUSED: dict[str, tuple[Callable[[dict[str, Any]], bool], str]] = {
    "Basalt": (lambda c: "value0" in c, "convert it to Kalibr's camchain"),
    "nerfstudio or instant-ngp": (
        lambda c: "fl_x" in c or "camera_angle_x" in c,
        "use the COLMAP cameras.txt it came from",
    ),
    "DepthAI": (lambda c: "cameraData" in c, "take K and D of the resolution in use from DepthAI's CameraInfo"),
    "RealSense": (lambda c: {"ppx", "ppy"} <= c.keys(), "take K and D from the CameraInfo of realsense2_camera"),
    "SVO or OKVIS": (lambda c: isinstance(c.get("cameras"), list), "convert it to Kalibr's camchain"),
    "KITTI": (lambda c: "P0" in c or "P_rect_00" in c, WAY_OUT),
    "MATLAB": (
        lambda c: any(key in c for key in ("RadialDistortion", "IntrinsicMatrix", "PrincipalPoint")),
        f"convert it with MATLAB's cameraIntrinsicsToOpenCV and {WAY_OUT}",
    ),
    "Azure Kinect": (lambda c: "CalibrationInformation" in c or "CameraCalibration" in c, _WAY_OUT),
    "OpenSfM": (
        lambda c: bool(c) and all(isinstance(v, dict) and "projection_type" in v for v in c.values()),
        "export to COLMAP",
    ),
}
