"""A calibrated camera: projection, unprojection, their Jacobians, and ROS camera_info files.

Points `p_cam` and rays `ray_cam` are in the optical frame (x right, y down, z forward); pixel (0, 0) is the centre of
the top-left pixel. What the lens model cannot see (behind the camera, beyond the fold of its polynomial) is NaN.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from lumidock.datatypes import Array, require_shape
from lumidock.errors import InputError
from lumidock.port import FlatPort
from lumidock.yamlfile import read_mapping, validate

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
_COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}
_MODEL_NAMES: dict[str, tuple[str, ...]] = {
    "plumb_bob": ("", "plumb_bob", "radtan", "radial_tangential", "brown_conrady", "brown", "opencv"),
    "rational_polynomial": ("rational_polynomial", "rational", "full_opencv"),
    "equidistant": ("equidistant", "equi", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye"),
    "none": ("none", "pinhole", "no_distortion"),
}
_MODELS, _MAX_SIDE_PX = ", ".join(_COEFFICIENTS), 32768
_FOLD_MARGIN, _FOLD_STEPS = 0.999, 10_000
_NEWTON_STEPS = 40
_FAR_M = 1e4  # where the place in the port that a ray crosses no longer matters
_NEWTON_TOLERANCE, _NEWTON_ACCEPTED = 1e-10, 1e-9  # in normalised image units: 2e-7, 2e-6 px at f = 2000 px


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Image size, camera matrix `K` (3, 3) px and distortion coefficients in OpenCV's order.

    Behind a flat `port` they are those of the lens in air, and the origin of `cam` is its entrance pupil.
    """

    width: int
    height: int
    K: Array
    model: DistortionModel = "plumb_bob"
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    port: FlatPort | None = None
    _pinhole: bool = field(init=False)
    _fold: float = field(init=False)  # where the lens model ends: normalised radius, or angle in rad

    def __post_init__(self) -> None:
        require_shape("K", self.K, 3, 3)
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            raise ValueError(f"{self.model} takes {_COEFFICIENTS[self.model]} coefficients")
        object.__setattr__(self, "_pinhole", self.model != "equidistant" and not np.any(self.distortion))
        object.__setattr__(self, "_fold", _fold_of(self.model, self.distortion))

    @property
    def focal_px(self) -> Array:
        """Focal lengths fx, fy (2,) px."""
        return np.array([self.K[0, 0], self.K[1, 1]])

    @property
    def center_px(self) -> Array:
        """Principal point cx, cy (2,) px."""
        return np.asarray(self.K[:2, 2])

    def lens(self) -> Array:
        """The flat array (20,) that the kernels project with; see `_kernels.lens`."""
        flat = np.zeros(20)
        flat[0] = self.model == "equidistant"
        flat[1:3], flat[3:5] = self.focal_px, self.center_px
        flat[5:8] = self._fold, self.width, self.height
        if self.model == "equidistant":
            flat[8:12] = self.distortion
        else:
            num, den, p1, p2 = _rational_terms(self.distortion)
            flat[8:16] = *num[1:], *den[1:], p1, p2
        if self.port is not None:
            flat[16:20] = self.port.distance_m, self.port.glass_m, self.port.glass_index, self.port.index
        return flat

    def contains(self, uv: Array, *, margin_px: float = 0.0) -> np.ndarray:
        """Whether pixels `uv` (N, 2) lie inside the image by at least `margin_px`; NaN is outside. Returns (N,)."""
        limit = np.array([self.width, self.height]) - 0.5 - margin_px
        inside = ((uv > margin_px - 0.5) & (uv < limit)).all(axis=-1)
        return np.asarray(inside)

    def project(self, p_cam: Array) -> Array:
        """Pixels `uv` (N, 2) of points `p_cam` (N, 3) m; NaN where the lens does not see the point."""
        return self.project_with_jacobian(p_cam)[0]

    def project_with_jacobian(self, p_cam: Array) -> tuple[Array, Array]:
        """Pixels `uv` (N, 2) and J_uv_p (N, 2, 3) px/m of points `p_cam` (N, 3).

        Source: OpenCV "Camera Calibration and 3D Reconstruction"; J. Kannala, S. Brandt, 2006 (equidistant); `port`.
        """
        if self.port is None:
            return self._lens_with_jacobian(p_cam)
        xy, J_xy_p = self.port.in_air(p_cam)
        uv, J_uv_air = self._lens_with_jacobian(np.column_stack([xy, np.ones(len(xy))]))
        return uv, J_uv_air[:, :, :2] @ J_xy_p

    def _lens_with_jacobian(self, p_cam: Array) -> tuple[Array, Array]:
        if self.model == "equidistant":
            xy, J = _distort_equidistant(p_cam, self.distortion, self._fold)
        else:
            xy, J = _distort_rational(p_cam, self.distortion, self._fold)
        return xy * self.focal_px + self.center_px, J * self.focal_px[:, None]

    def unproject(self, uv: Array) -> Array:
        """Unit rays `ray_cam` (N, 3) of pixels `uv` (N, 2); NaN where no ray reaches the pixel.

        Behind a port, the directions in the water; near the axis they meet `port.viewpoint_m` behind the origin.
        """
        ray = self._lens_rays(uv)
        return ray if self.port is None else self.port.in_water(ray)

    def _lens_rays(self, uv: Array) -> Array:
        xy = (uv - self.center_px) / self.focal_px
        if self._pinhole:
            ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
            return np.asarray(ray / np.sqrt((ray * ray).sum(axis=1, keepdims=True)))
        if self.model == "equidistant":
            return _undistort_equidistant(xy, self.distortion, self._fold)
        return _undistort_rational(xy, self.distortion, self._fold)

    def unproject_with_jacobian(self, uv: Array) -> tuple[Array, Array]:
        """Unit rays `ray_cam` (N, 3) and J_ray_uv (N, 3, 2) 1/px of pixels `uv` (N, 2).

        Source: implicit function theorem on `project_with_jacobian`; a unit ray moves only across itself, so its
        Jacobian is the pseudo-inverse of J_uv_p at unit distance (behind a port, of a far point).
        """
        ray = self.unproject(uv)
        distance = 1.0 if self.port is None else _FAR_M
        J_uv_ray = self.project_with_jacobian(distance * ray)[1] * distance
        J = np.full((len(uv), 3, 2), np.nan)
        good = np.isfinite(J_uv_ray).all(axis=(1, 2))
        J[good] = np.linalg.pinv(J_uv_ray[good])
        return ray, J


def _rational_terms(distortion: Array) -> tuple[Array, Array, float, float]:
    """Numerator and denominator polynomials in r^2 (lowest power first), and the tangential p1, p2."""
    d = np.zeros(8)
    d[: len(distortion)] = distortion
    return np.array([1.0, d[0], d[1], d[4]]), np.array([1.0, d[5], d[6], d[7]]), float(d[2]), float(d[3])


def _fold_of(model: str, distortion: Array) -> float:
    """Radius (angle for equidistant) within which the lens map is one to one; infinite if it always is.

    A perspective lens map is a gradient, so it is one to one on a disk where its Hessian is positive definite: where
    the radial slope and the magnification both exceed 6 |p| r, the most that the tangential terms take away.
    """
    if model == "equidistant":
        theta = np.linspace(0.0, np.pi, _FOLD_STEPS)
        return min(_last_before(_theta_distorted(theta, distortion)[1] <= 0.0, theta), np.pi)
    num, den, p1, p2 = _rational_terms(distortion)
    r = np.tan(np.linspace(0.0, np.pi / 2, _FOLD_STEPS, endpoint=False))
    with np.errstate(all="ignore"):  # absurd coefficients overflow, and fail the comparison
        g, dg = _radial(num, den, r * r)
        sound = np.minimum(g, g + 2.0 * r * r * dg) > 6.0 * np.hypot(p1, p2) * r  # beyond a pole g is negative
    return _last_before(~sound, r)


def _last_before(ended: NDArray[np.bool_], r: Array) -> float:
    """The last `r` (N,) before the first that has `ended` (N,), infinite if none has.

    A hair less than that, where Newton's method still converges.
    """
    return _FOLD_MARGIN * float(r[max(int(ended.argmax()) - 1, 0)]) if ended.any() else np.inf


def _horner(coefficients: Array, u: Array) -> Array:
    return np.polynomial.polynomial.polyval(u, coefficients)


def _radial(num: Array, den: Array, u: Array) -> tuple[Array, Array]:
    """Magnification N/D at the squared radius `u` (N,) and its derivative."""
    poly = np.polynomial.polynomial
    D = _horner(den, u)
    g = _horner(num, u) / D
    return g, (_horner(poly.polyder(num), u) - g * _horner(poly.polyder(den), u)) / D


def _distort_xy(xy: Array, distortion: Array) -> tuple[Array, Array]:
    """Distorted normalised coordinates (N, 2) and their Jacobian (N, 2, 2)."""
    num, den, p1, p2 = _rational_terms(distortion)
    x, y = xy[:, 0], xy[:, 1]
    u = x * x + y * y
    g, dg = _radial(num, den, u)
    out = np.stack([x * g + 2 * p1 * x * y + p2 * (u + 2 * x * x), y * g + p1 * (u + 2 * y * y) + 2 * p2 * x * y], 1)
    cross = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
    J = np.empty((len(xy), 2, 2))
    J[:, 0, 0] = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
    J[:, 1, 1] = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
    J[:, 0, 1] = J[:, 1, 0] = cross
    return out, J


def _distort_rational(p_cam: Array, distortion: Array, fold: float) -> tuple[Array, Array]:
    z = np.where(p_cam[:, 2] > 0.0, p_cam[:, 2], np.nan)
    xy = p_cam[:, :2] / z[:, None]
    xy[np.hypot(xy[:, 0], xy[:, 1]) >= fold] = np.nan
    out, J_xy = _distort_xy(xy, distortion)
    J_p = np.zeros((len(p_cam), 2, 3))
    J_p[:, 0, 0] = J_p[:, 1, 1] = 1.0 / z
    J_p[:, :, 2] = -xy / z[:, None]
    return out, J_xy @ J_p


def _undistort_rational(xy_distorted: Array, distortion: Array, fold: float) -> Array:
    """Newton's method on the analytic Jacobian, kept inside the fold; NaN where it does not arrive.

    A step that does not come nearer is halved: within the fold the map is the gradient of a convex function.
    """
    xy, share = _shorten(xy_distorted.copy(), fold), np.ones(len(xy_distorted))
    with np.errstate(all="ignore"):  # a step that leaves the model is a NaN, and a NaN is the answer
        out, J = _distort_xy(xy, distortion)
        error = out - xy_distorted
        for _ in range(_NEWTON_STEPS):
            if np.all(np.abs(error) < _NEWTON_TOLERANCE):
                break
            det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            step_x = (J[:, 1, 1] * error[:, 0] - J[:, 0, 1] * error[:, 1]) / det
            step_y = (J[:, 0, 0] * error[:, 1] - J[:, 1, 0] * error[:, 0]) / det
            tried = _shorten(xy - share[:, None] * np.stack([step_x, step_y], 1), fold)
            out, J_tried = _distort_xy(tried, distortion)
            nearer = np.linalg.norm(out - xy_distorted, axis=1) < np.linalg.norm(error, axis=1)
            share = np.where(nearer, 1.0, 0.5 * share)
            xy[nearer], J[nearer], error[nearer] = tried[nearer], J_tried[nearer], (out - xy_distorted)[nearer]
    xy[~(np.abs(error).max(axis=1) < _NEWTON_ACCEPTED)] = np.nan
    ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _shorten(xy: Array, limit: float) -> Array:
    """Pull points beyond radius `limit` back to it."""
    if not np.isfinite(limit):
        return xy
    r = np.maximum(np.hypot(xy[:, 0], xy[:, 1]), 1e-300)
    return np.asarray(xy * np.minimum(1.0, limit / r)[:, None])


def _theta_distorted(theta: Array, distortion: Array) -> tuple[Array, Array]:
    """Distorted angle and its derivative."""
    powers = np.concatenate([[1.0], distortion])
    u = theta * theta
    return theta * _horner(powers, u), _horner(powers * np.array([1.0, 3.0, 5.0, 7.0, 9.0]), u)


def _distort_equidistant(p_cam: Array, distortion: Array, fold: float) -> tuple[Array, Array]:
    x, y, z = np.where((p_cam != 0.0).any(axis=1), p_cam.T, np.nan)  # the lens itself has no direction
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    theta = np.where(theta < fold, theta, np.nan)
    bent, slope = _theta_distorted(theta, distortion)
    near = r < 1e-9 * np.abs(z)  # on the axis bent / r tends to 1 / z
    r_safe = np.where(near, 1.0, r)
    scale = np.where(near, 1.0 / np.where(near, np.abs(z), 1.0), bent / r_safe)
    out = p_cam[:, :2] * scale[:, None] + 0.0 * theta[:, None]
    direction = np.where(near[:, None], 0.0, p_cam[:, :2] / r_safe[:, None])
    norm2 = r * r + z * z
    # d(bent)/d(r, z) = slope * (z, -r) / (r^2 + z^2)
    radial = np.where(near, 0.0, slope * z / norm2 - scale)
    J = np.zeros((len(p_cam), 2, 3))
    J[:, :, :2] = radial[:, None, None] * direction[:, :, None] * direction[:, None, :]
    J[:, 0, 0] += scale
    J[:, 1, 1] += scale
    J[:, :, 2] = -(slope * r / norm2)[:, None] * direction
    J[np.isnan(theta)] = np.nan
    return out, J


def _undistort_equidistant(xy_distorted: Array, distortion: Array, fold: float) -> Array:
    bent = np.hypot(xy_distorted[:, 0], xy_distorted[:, 1])
    theta = np.minimum(bent, fold)
    for _ in range(_NEWTON_STEPS):
        value, slope = _theta_distorted(theta, distortion)
        error = value - bent
        if np.all(np.abs(error) < _NEWTON_TOLERANCE):
            break
        theta = np.clip(theta - error / slope, 0.0, fold)
    theta = np.where(np.abs(_theta_distorted(theta, distortion)[0] - bent) < _NEWTON_ACCEPTED, theta, np.nan)
    direction = xy_distorted / np.maximum(bent, 1e-300)[:, None]
    return np.concatenate([np.sin(theta)[:, None] * direction, np.cos(theta)[:, None]], axis=1)


class _Matrix(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    rows: int = 0
    cols: int = 0
    dt: str = ""  # that OpenCV writes
    data: list[float]


class _Port(BaseModel):
    """A flat port, as `FlatPort` has it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    kind: Literal["flat"]
    distance_m: Annotated[float, Field(ge=0.0, le=1.0)]
    index: Annotated[float, Field(ge=1.0, le=1.5)] = 1.34
    glass_m: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    glass_index: Annotated[float, Field(ge=1.0, le=2.5)] = 1.5


class _Window(BaseModel):
    """A region of interest; all zero is the whole sensor."""

    model_config = ConfigDict(extra="ignore")
    x_offset: Annotated[int, Field(ge=0)] = 0
    y_offset: Annotated[int, Field(ge=0)] = 0
    width: Annotated[int, Field(ge=0)] = 0
    height: Annotated[int, Field(ge=0)] = 0


class _CameraInfo(BaseModel):
    """The part of ROS camera_info that lumidock reads; its other keys are let pass."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    image_width: Annotated[int, Field(gt=0, le=_MAX_SIDE_PX)]
    image_height: Annotated[int, Field(gt=0, le=_MAX_SIDE_PX)]
    camera_matrix: _Matrix
    distortion_model: str | None = None
    camera_model: str | None = None  # what some writers call it
    distortion_coefficients: _Matrix
    binning_x: Annotated[int, Field(ge=0)] = 0
    binning_y: Annotated[int, Field(ge=0)] = 0
    roi: _Window | None = None
    port: _Port | None = None


def load_camera(path: Path | str) -> Camera:
    """Read a ROS camera_info YAML file.

    Raises: InputError, one line, for what is missing, not finite, of the wrong length or not supported.
    """
    return camera_of_mapping(read_mapping(Path(path), "camera"), Path(path))


def camera_of_mapping(content: dict[str, Any], path: Path) -> Camera:
    """The camera of the content of a ROS camera_info file, which an error calls `path`. Raises: as `load_camera`."""
    if "lights" in content:
        raise InputError(f"{path}: a station file, not a camera; it belongs to --station")
    if "camera_matrix" not in content and "image_width" not in content:
        raise InputError(
            f"{path}: not a ROS camera_info file: no image_width and no camera_matrix; `lumidock calib import` turns "
            "calibrations of other tools into one"
        )
    info = validate(_CameraInfo, content, str(path))
    model = info.distortion_model or info.camera_model or ""
    size = info.image_width, info.image_height
    camera = camera_from(str(path), size, info.camera_matrix.data, model, info.distortion_coefficients.data)
    if info.port is not None:
        values = info.port.model_dump(exclude={"kind"})
        camera = replace(camera, port=FlatPort(**values))
    roi = info.roi or _Window()
    window = roi.x_offset, roi.y_offset, roi.width, roi.height
    return windowed(camera, str(path), window, (max(info.binning_x, 1), max(info.binning_y, 1)))


def windowed(camera: Camera, origin: str, roi: tuple[int, int, int, int], binning: tuple[int, int]) -> Camera:
    """The camera of the pixels that are sent: region of interest (x, y, width, height px) first, then binning.

    A region without width or height is the whole sensor. Raises: InputError, which calls the calibration `origin`.
    """
    x, y, width, height = roi
    if width and height:
        if x + width > camera.width or y + height > camera.height:
            raise InputError(
                f"{origin}: a region of interest of {width}x{height} pixels at ({x}, {y}) is not on a sensor of "
                f"{camera.width}x{camera.height}; width and height have to be the full sensor's. Give --camera FILE"
            )
        if (x, y, width, height) != (0, 0, camera.width, camera.height):
            camera = cropped(camera, (x, y), (width, height))
    if binning == (1, 1):
        return camera
    if min(camera.width // binning[0], camera.height // binning[1]) < 1:
        raise InputError(f"{origin}: a binning of {binning[0]}x{binning[1]} leaves no pixel")
    return binned(camera, binning)


def binned(camera: Camera, binning: tuple[int, int]) -> Camera:
    """The camera of pictures whose pixels each stand for `binning` (across, down) of `camera`'s.

    Pixel (0, 0) of both is the centre of its own top-left pixel, so centres move by half a pixel more than ROS's
    image_geometry has them.
    """
    b = np.array(binning, float)
    K = camera.K.copy()
    K[[0, 1], [0, 1]] /= b
    K[:2, 2] = (K[:2, 2] + 0.5) / b - 0.5
    return replace_matrix(camera, (camera.width // binning[0], camera.height // binning[1]), K)


def cropped(camera: Camera, offset: tuple[int, int], size: tuple[int, int]) -> Camera:
    """The camera of a window of `size` (width, height) px whose first pixel is `offset` (x, y) of `camera`'s."""
    K = camera.K.copy()
    K[:2, 2] -= offset
    return replace_matrix(camera, size, K)


def replace_matrix(camera: Camera, size: tuple[int, int], K: Array) -> Camera:
    """The same lens before another sensor: `size` (width, height) px, `K` (3, 3) px."""
    return replace(camera, width=size[0], height=size[1], K=K)


def lens_of(origin: str, model: str, coefficients: list[float]) -> tuple[DistortionModel, list[float]]:
    """Distortion model and coefficients, as `Camera` has them, of what a calibration calls and lists them.

    Zeros at the end say nothing and are left out; more than five coefficients of `plumb_bob` are those of the rational
    polynomial, as in OpenCV, and a model without a name is told by their number, as ROS does.
    Raises: InputError, one line that names `origin`, for a lens that is not supported.
    """
    name = model.strip().lower().replace("-", "_").replace(" ", "_")
    found = next((known for known, names in _MODEL_NAMES.items() if name in names), None)
    if found is None:
        raise InputError(f"{origin}: distortion model {model[:40]!r} is not supported; there are {_MODELS}")
    if not np.isfinite(coefficients).all():
        raise InputError(f"{origin}: not all numbers are finite")
    if found == "none":
        if any(coefficients):
            raise InputError(f"{origin}: distortion model {model[:40]!r} with coefficients that are not zero")
        return "plumb_bob", [0.0] * 5
    if found == "equidistant":
        return "equidistant", _trimmed(origin, found, coefficients, (4,))
    if not coefficients:
        return "plumb_bob", [0.0] * 5
    most = 8 if any(coefficients[5:]) or (found == "rational_polynomial" and len(coefficients) != 5) else 5
    if len(coefficients) > 8 and any(coefficients[8:]):
        what = "tilted sensor (tau_x, tau_y)" if any(coefficients[12:]) else "thin prism (s1 to s4)"
        raise InputError(
            f"{origin}: coefficients of a {what}, which is not supported; calibrate without it (OpenCV's flags "
            "CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL off)"
        )
    allowed = (4, 5) if most == 5 else (8,)
    return "plumb_bob" if most == 5 else "rational_polynomial", _trimmed(origin, found, coefficients, allowed)


def _trimmed(origin: str, model: str, coefficients: list[float], allowed: tuple[int, ...]) -> list[float]:
    """As many coefficients as a model takes; zeros at the end of more are left out."""
    if len(coefficients) > max(allowed) and not any(coefficients[max(allowed) :]):
        coefficients = coefficients[: max(allowed)]
    if len(coefficients) not in allowed:
        wanted = " or ".join(map(str, _COEFFICIENTS[model]))
        raise InputError(
            f"{origin}: distortion_coefficients: {model} takes {wanted} numbers, there are {len(coefficients)}"
        )
    return coefficients


def camera_from(origin: str, size: tuple[int, int], matrix: list[float], model: str, distortion: list[float]) -> Camera:
    """Camera of the numbers of a calibration: `size` (width, height) px, `matrix` row by row.

    Raises: InputError, one line that names `origin`, for what is not finite, of the wrong length or not supported.
    """
    if not all(0 < side <= _MAX_SIDE_PX for side in size):
        raise InputError(f"{origin}: an image of {size[0]}x{size[1]} pixels")
    if len(matrix) != 9:
        raise InputError(f"{origin}: camera_matrix: wanted 9 numbers, there are {len(matrix)}")
    K = np.array(matrix).reshape(3, 3)
    if not np.isfinite(K).all():
        raise InputError(f"{origin}: not all numbers are finite")
    if K[0, 1] != 0:
        raise InputError(
            f"{origin}: camera_matrix: a skew of {K[0, 1]:g} px; calibrate without, only positive fx and fy are read"
        )
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise InputError(f"{origin}: camera_matrix: wanted [fx, 0, cx, 0, fy, cy, 0, 0, 1] with positive fx and fy")
    lens, coefficients = lens_of(origin, model, distortion)
    camera = Camera(*size, K, lens, np.array(coefficients))
    if camera._fold == 0.0:
        raise InputError(f"{origin}: distortion_coefficients: no lens bends light like this")
    return camera


def save_camera(camera: Camera, path: Path, *, name: str = "camera") -> None:
    """Write a ROS camera_info YAML file, with the key `port` of lumidock for a camera behind a flat port."""
    fx, fy, cx, cy = (float(v) for v in (*camera.focal_px, *camera.center_px))

    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, object]:
        return {"rows": rows, "cols": cols, "data": data}

    coefficients = [float(v) for v in camera.distortion]
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        "distortion_model": camera.model,
        "distortion_coefficients": matrix(1, len(coefficients), coefficients),
        "rectification_matrix": matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": matrix(3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    if camera.port is not None:
        content["port"] = {"kind": "flat", **asdict(camera.port)}
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")
