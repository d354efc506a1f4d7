"""Calibrations as OpenCV and the scripts around it leave them: matrices under many names, of one camera or of several.

What could be distortion is never passed over: a key that looks like it and is not known is refused by its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lumidock.camera import Camera, camera_from
from lumidock.errors import InputError

WAY_OUT = "write image_width, image_height, camera_matrix and distortion_coefficients as an OpenCV or ROS YAML file"
# names as they are written, less case and all but letters and digits
_MATRIX = (
    "cameramatrix,cameraintrinsics,cameraintrinsicmatrix,cammatrix,cammtx,cameramtx,mtx,intrinsics,intrinsic,"
    "intrinsicmatrix,intrinsicsmatrix,intrinsicparameters,kmatrix,matrix,camera,k,m"
)
_DISTORTION = (
    "distortioncoefficients,distortioncoefficient,distortioncoeffs,distortioncoeff,distortioncoefs,distortioncoef,"
    "distortionparameters,distortionparams,distortionvector,distortionmatrix,distortion,cameradistortion,lensdistortion,"
    "distcoefficients,distcoeffs,distcoeff,distcoefs,distcoef,distparams,dist,coeffs,d"
)
_SIDE = r"left|right|l|r|cam[0-9]+|camera[0-9]+"
_NAMED = re.compile(
    rf"(?P<before>{_SIDE})?(?:(?P<matrix>{'|'.join(_MATRIX.split(','))})|(?P<distortion>{'|'.join(_DISTORTION.split(','))}))"
    rf"(?P<after>{_SIDE}|[0-9]+)?"
)
_COULD_BE_DISTORTION = re.compile(
    r"dist|coef|radial|tangential|fisheye|prism|tilt|^xi$|^k[1-9]$|^p[1-4]$|^s[1-4]$|^tau[xy]$"
)
_IS_NOT = re.compile(
    r"error|^rms|rmse|reproj|extrinsic|pose|board|square|point|time|distance|undist|undistorted|frames|path|file|count"
)
_WIDTH, _HEIGHT = (
    ("imagewidth", "width", "imgwidth", "w", "framewidth"),
    ("imageheight", "height", "imgheight", "h", "frameheight"),
)
_SIZE = (
    "imagesize",
    "imgsize",
    "resolution",
    "size",
    "imageresolution",
    "framesize",
    "imagesizewh",
    "calibdimension",
    "dim",
)
_SHAPE = ("imageshape", "imgshape", "shape")  # of an array: rows first
_FLAGS = ("fisheyemodel", "fisheye", "isfisheye", "usefisheye")
_MODELS = (
    "model",
    "cameramodel",
    "distortionmodel",
    "distortiontype",
    "modeltype",
    "cameratype",
    "lensmodel",
    "projectionmodel",
)
_FISHEYE = re.compile(r"fisheye|equi|kannala|^kb4?$")
_OTHER_MODEL = re.compile(r"omni|mei|ucm|double|^ds$|^fov$|scaramuzza|ocam|spherical|panoram|unified")
_MOST_TANGENTIAL = 0.02  # no lens that is centred has more; the third and fourth coefficient of a fisheye often do


@dataclass(slots=True)
class _Found:
    """What belongs to one camera of a file: its matrix and its distortion, under the keys they stand."""

    matrix: dict[str, list[float]] = field(default_factory=dict)
    distortion: dict[str, list[float]] = field(default_factory=dict)


def read_opencv(path: Path, content: dict[str, Any], name: str | None, size: tuple[int, int] | None) -> Camera:
    """The camera of a file of OpenCV, as `content`; `name` chooses one of several, `size` stands in for one it lacks.

    Raises: InputError, one line, for what is incomplete, ambiguous or not supported.
    """
    cameras, leaves = dict[str, _Found](), list(_leaves(content))
    for label, key, value in leaves:
        _take(path, cameras, label, key, value)
    with_matrix = [label for label, found in cameras.items() if found.matrix]
    if not with_matrix:
        raise InputError(
            f"{path}: no calibration of a tool that is known: no camera matrix of 3 x 3 under any of its names; "
            f"{WAY_OUT}"
        )
    label = _chosen(path, cameras, with_matrix, name)
    _refuse_unknown(path, leaves)
    key, matrix = _only(path, "camera matrices", cameras[label].matrix)
    if len(matrix) != 9:
        hint = "; decimal commas? write 1043.5, not 1043,5" if len(matrix) > 9 else ""
        raise InputError(f"{path}: {key}: wanted 3 x 3 numbers, there are {len(matrix)}{hint}")
    distortion = cameras[label].distortion or (
        cameras[""].distortion if "" in cameras and len(with_matrix) == 1 else {}
    )
    if not distortion:
        raise InputError(
            f"{path}: {key} has no distortion beside it; add distortion_coefficients, all zero where pictures are "
            "rectified"
        )
    named, coefficients = _only(path, "distortions", distortion)
    found_size = _size(path, content) or size
    if found_size is None:
        raise InputError(f"{path}: says no image size; give --size WIDTHxHEIGHT to `lumidock calib import`")
    model = _model(path, leaves, label)
    if model == "" and len(coefficients) == 4:
        _refuse_ambiguous(path, named, coefficients, leaves)
    return camera_from(str(path), found_size, matrix, "" if model == "perspective" else model, coefficients)


def _leaves(content: dict[str, Any], label: str = "", deep: int = 3) -> Iterator[tuple[str, str, Any]]:
    """Every value of a file under its key, with the keys above it as its label; a matrix is one value."""
    for key, value in content.items():
        if isinstance(value, dict) and "data" not in value and deep:
            yield from _leaves(value, f"{label}.{key}".strip("."), deep - 1)
        else:
            yield label, str(key), value


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _numbers(value: object) -> list[float] | None:
    """The numbers of a matrix, a list or a text; None where it is anything else."""
    data = value.get("data") if isinstance(value, dict) else value
    if isinstance(data, str):
        data = data.split()
    if isinstance(data, bool) or data is None:
        return None
    try:
        found = np.array(data, float).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        return None
    return [float(number) for number in found]


def _take(path: Path, cameras: dict[str, _Found], label: str, key: str, value: object) -> None:
    """Keep a matrix or a distortion for the camera that its key belongs to."""
    named = _NAMED.fullmatch(_plain(key))
    if named is None:
        return
    numbers = _numbers(value)
    if named["matrix"] and (numbers is None or len(numbers) < 4):  # k1 and the like are no matrices
        return
    if numbers is None:
        if isinstance(value, (str, type(None))):
            return  # a name, or nothing
        raise InputError(f"{path}: {key}: not a matrix of numbers")
    if named["distortion"] and isinstance(value, (int, float)) and len(numbers) == 1 and named["after"]:
        return  # d1 and the like
    side = named["before"] or named["after"] or ""
    camera = cameras.setdefault(f"{label}.{side}".strip("."), _Found())
    (camera.matrix if named["matrix"] else camera.distortion)[key] = numbers


def _chosen(path: Path, cameras: dict[str, _Found], with_matrix: list[str], name: str | None) -> str:
    """The label of the camera that is meant. Raises: InputError that asks where there are several."""
    shown = {label: label or next(iter(cameras[label].matrix)) for label in with_matrix}
    if name is not None:
        for label in with_matrix:
            if name in (label, shown[label], *cameras[label].matrix):
                return label
        raise InputError(f"{path}: no camera {name}; there are {', '.join(shown.values())}")
    if len(with_matrix) > 1:
        raise InputError(f"{path}: several cameras; choose with --name: {', '.join(shown.values())}")
    return with_matrix[0]


def _only(path: Path, what: str, found: dict[str, list[float]]) -> tuple[str, list[float]]:
    """The key and the numbers, which must be the same under every name. Raises: InputError."""
    if len({tuple(numbers) for numbers in found.values()}) > 1:
        raise InputError(f"{path}: {what} that differ: {', '.join(found)}; leave one")
    return next(iter(found.items()))


def _refuse_unknown(path: Path, leaves: list[tuple[str, str, Any]]) -> None:
    """Raises: InputError for numbers under a key that could be distortion and is not known."""
    for _, key, value in leaves:
        plain, numbers = _plain(key), _numbers(value)
        named = _NAMED.fullmatch(plain)
        taken = named is not None and not (named["matrix"] and numbers is not None and len(numbers) < 4)
        if taken and isinstance(value, (int, float)) and named is not None and named["after"]:
            taken = False
        if taken or plain in (*_FLAGS, *_MODELS) or _IS_NOT.search(plain):
            continue
        if numbers is not None and any(numbers) and _COULD_BE_DISTORTION.search(plain):
            if plain == "xi":
                raise InputError(
                    f"{path}: key {key}: an omnidirectional camera (xi), which is not supported; calibrate as pinhole "
                    "or fisheye"
                )
            raise InputError(
                f"{path}: key {key}: could be distortion; put the coefficients k1, k2, p1, p2[, k3] under "
                "distortion_coefficients"
            )


def _refuse_ambiguous(path: Path, named: str, coefficients: list[float], leaves: list[tuple[str, str, Any]]) -> None:
    """Raises: InputError for four coefficients that may be a fisheye's: too large, or one below the other.

    cv2.fisheye.calibrate gives 4 x 1 numbers; cv2.calibrateCamera gives five or more, and its C forerunner gave 1 x 4.
    """
    column = any(key == named and _is_column(value) for _, key, value in leaves)
    if column or max(map(abs, coefficients[2:])) > _MOST_TANGENTIAL:
        what = "stand one below the other" if column else "of which the last two are no tangential ones"
        raise InputError(
            f"{path}: {named}: four coefficients {'that ' if column else ''}{what}; of a fisheye? say so with "
            "fisheye_model: 1 in the file, or fisheye_model: 0"
        )


def _is_column(value: object) -> bool:
    if isinstance(value, dict):
        return str(value.get("rows")).strip() == "4" and str(value.get("cols")).strip() == "1"
    return isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value)


def _model(path: Path, leaves: list[tuple[str, str, Any]], label: str) -> str:
    """The model that a file names or flags, equidistant or perspective; empty where it does not. Raises: InputError.

    The keys above a camera, `label`, may name it too, as Gyroflow's fisheye_params.
    """
    found = "equidistant" if "fisheye" in _plain(label) else ""
    for _, key, value in leaves:
        plain, word = _plain(key), str(value).strip().strip('"').lower()
        if plain in _FLAGS:
            found = "equidistant" if word not in ("0", "0.0", "false", "no", "none", "") else found or "perspective"
        elif plain in _MODELS and isinstance(value, str):
            if _OTHER_MODEL.search(word):
                raise InputError(
                    f"{path}: {key}: camera model {word[:40]!r} is not supported; calibrate as pinhole or fisheye"
                )
            found = "equidistant" if _FISHEYE.search(word) else found
    return found


def _size(path: Path, content: dict[str, Any]) -> tuple[int, int] | None:
    """Width and height by any of their names. Raises: InputError for what is no number of pixels."""
    flat = {_plain(key): value for key, value in content.items()}
    numbers: list[float] | None = None
    for key in (*_SIZE, *_SHAPE):
        entry = flat.get(key)
        if isinstance(entry, dict) and "data" not in entry:
            inner = {_plain(str(name)): value for name, value in entry.items()}
            entry = next(
                ([inner[a], inner[b]] for a, b in (("width", "height"), ("w", "h")) if {a, b} <= inner.keys()), None
            )
        numbers = _numbers(entry) if entry is not None else None
        if numbers and len(numbers) >= 2:
            numbers = numbers[1::-1] if key in _SHAPE else numbers[:2]
            break
    else:
        sides = [next((_numbers(flat[key]) for key in keys if key in flat), None) for keys in (_WIDTH, _HEIGHT)]
        numbers = [value for side in sides for value in side or ()]
    if not numbers or len(numbers) != 2:
        return None
    if not all(value.is_integer() and abs(value) < 1e6 for value in numbers):
        raise InputError(f"{path}: an image of {numbers[0]:g}x{numbers[1]:g} pixels")
    return int(numbers[0]), int(numbers[1])
