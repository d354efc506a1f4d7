"""Whether a calibration can be a camera's at all, and whether it looks fit for use in water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.errors import InputError

WATER = 1.333  # refractive index, relative to the air behind a flat port
_FLAT_PORT_CURVATURE = (WATER**2 - 1.0) / 2.0  # see `curvature`
_LOOKS_DRY = 0.15  # a curvature below it: lenses seldom add or take more than 0.2
_RATIO_MIDDLE = 1.0 + (WATER - 1.0) / 2.0
_MAX_CENTER_OFFSET, _MAX_ASPECT_ERROR = 0.1, 0.02  # of the image's width; of fx / fy
# beyond these it is no odd camera but a calibration of something else: another picture size, millimetres, metres
_MIDDLE_HALF = 0.25  # of each side, that the principal point keeps from the edges
# of a picture that was scaled the middle is off in both directions alike; assembly puts it 5 % off at most
_LEAST_SCALE, _SAME_SCALE = 0.15, 0.08
_FIELD_DEG = (
    2.0,
    165.0,
)  # across, of a perspective lens: 800 mm on full frame is 2.6, 9 mm is 127, bent ones a little more
_FISHEYE_FIELD_DEG = (2.0, 300.0)  # the widest fisheyes made have 280
_ASPECT = (0.5, 2.0)  # fx / fy; anamorphic cameras have up to 1.33 of it
_LEAST_SIDE_PX = 3  # a mosaic's pixels have neighbours of every colour from here on
_MOST_BLIND = 0.5  # of the image's border without a ray


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a calibration says of its camera: field of view (horizontal, vertical, diagonal) deg, and what is odd."""

    field_of_view_deg: tuple[float, float, float]
    curvature: float
    focal_ratio: float | None
    impossible: str
    warnings: tuple[str, ...]


def check(
    camera: Camera, *, lens_mm: float | None = None, pixel_um: float | None = None, rectified: bool = False
) -> Verdict:
    """Hold a calibration against what a camera in water should look like; the lens's data make it certain.

    That pictures known to be `rectified` have no distortion needs no comment, and behind a stated port the lens is that
    in air.
    """
    ratio = None
    if lens_mm is not None and pixel_um is not None:
        ratio = float(camera.focal_px.mean()) / (1000.0 * lens_mm / pixel_um)
    bend = curvature(camera)
    dry = [] if rectified or camera.port is not None else _dry(bend, ratio, bool(camera.distortion.any()))
    warnings = [*dry, *_odd(camera)]
    return Verdict(_field_of_view(camera), bend, ratio, impossible(camera), tuple(warnings))


def require_possible(camera: Camera, origin: str, *, trusted: bool = False) -> None:
    """Raises: InputError, one line with the numbers, for a calibration that no camera has, unless it is `trusted`."""
    why = "" if trusted else impossible(camera)
    if why:
        raise InputError(
            f"{origin}: {why}; is it of another picture size, or in other units? give the right one with --camera, or "
            "accept it with --trust-calibration"
        )


def impossible(camera: Camera) -> str:
    """Why no camera has this calibration; empty where one may."""
    width, height = camera.width, camera.height
    fx, fy, cx, cy = (float(value) for value in (*camera.focal_px, *camera.center_px))
    if min(width, height) < _LEAST_SIDE_PX:
        return f"the calibration is for pictures of {width}x{height} pixels"
    share = np.array([(cx + 0.5) / width, (cy + 0.5) / height])
    if not ((share > _MIDDLE_HALF) & (share < 1.0 - _MIDDLE_HALF)).all():
        return f"the principal point ({cx:.1f}, {cy:.1f}) is outside the middle half of {width}x{height} pixels"
    scale = 2.0 * share
    if (np.abs(scale - 1.0) > _LEAST_SCALE).all() and abs(scale[0] / scale[1] - 1.0) < _SAME_SCALE:
        w, h = (round(side * scale.mean()) for side in (width, height))
        return (
            f"the principal point ({cx:.1f}, {cy:.1f}) is the middle of pictures of about {w}x{h} pixels, not of "
            f"{width}x{height}"
        )
    if not _ASPECT[0] <= fx / fy <= _ASPECT[1]:
        return f"fx / fy is {fx / fy:.3g} ({fx:g} / {fy:g} px)"
    for focal, side, word in ((fx, width, "across"), (fy, height, "down")):
        field = _ideal_field_deg(camera, focal, side)
        limits = _FISHEYE_FIELD_DEG if camera.model == "equidistant" else _FIELD_DEG
        if not limits[0] <= field <= limits[1]:
            return f"a focal length of {focal:g} px on {side} px is a field of view of {field:.3g} degrees {word}"
    blind = _blind(camera)
    if blind > _MOST_BLIND:
        return f"{100 * blind:.0f} % of the image's border has no ray: the distortion folds over inside the image"
    return ""


def _ideal_field_deg(camera: Camera, focal_px: float, side_px: int) -> float:
    """Field of view of the lens without its distortion."""
    if camera.model == "equidistant":
        return float(np.rad2deg(side_px / focal_px))
    return float(np.rad2deg(2.0 * np.arctan(0.5 * side_px / focal_px)))


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
    """Signs of a calibration in air; without distortion there are none."""
    if ratio is not None:
        if ratio < _RATIO_MIDDLE:
            return [
                f"the focal length is {ratio:.2f} times the lens's: made in air; behind a flat port in water it is "
                f"{WATER:.2f} times, and ranges would be {100 * (1 - ratio / WATER):.0f} % short"
            ]
        return []
    if not distorted:
        return [
            "no distortion at all, as only rectified pictures have; so nothing tells whether it was made in water, and "
            f"if it was made in air, ranges come out {100 * (1 - 1 / WATER):.0f} % short"
        ]
    if bend < _LOOKS_DRY:
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
    blind = _blind(camera)
    if blind:
        found.append(
            f"{100 * blind:.0f} % of the image's border has no ray: the distortion folds over inside the image"
        )
    return found


def _blind(camera: Camera) -> float:
    """Share of the image's border that no ray reaches."""
    return float(np.isnan(camera.unproject(_border(camera))).any(axis=1).mean())


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
