"""Calibration of a camera in the water it works in, from views of a flat board.

Zhang's method (Z. Zhang, "A Flexible New Technique for Camera Calibration", 2000) for the start, then robust least
squares over the camera and the pose of every view, with the Jacobians of OpenCV's projection. V views.

The camera is ten numbers: fx, fy, cx, cy px, four coefficients, and of a flat port the changes of its distance m and of
the water's index from where they start, which a camera without a port holds at zero and ignores.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.errors import InputError, extra
from lumidock.port import FlatPort
from lumidock.setup.boards import Board, Sighting

Model = Literal["plumb_bob", "equidistant"]
_LEAST_VIEWS = 6  # three fix a pinhole without distortion; twice that leaves something to check it by
_HELD_OUT = 4  # every so many views has no part in the fit that is tested on it
_LOSS_PX = 1.0  # residual at which a corner counts half
_OUTLIER = 4.0  # times the rms residual: a corner beyond it was misread
_CELLS = (5, 4)  # of the coverage map, across and down
_COVERED = 20  # corners in a cell that hold its distortion down; a board seen once in it
_STEEP_DEG = 20.0  # tilt from which a view separates focal length from distance
_CAMERA = 10  # numbers of a camera
_PORT_M, WATER_INDEX = 0.05, 1.34  # start of a distance that is estimated; fresh to sea water at 589 nm, 1.333 to 1.341
_HELD, _STEP = 1e6, 1e-7  # weight of a number that is known; step of a numeric derivative by distance or index


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera with its errors.

    `sigma` (10,): 1 sigma of fx, fy, cx, cy px, the four coefficients, the port's distance m and the index; `rms_px` of
    all corners used, `held_out_px` of views that had no part in the fit; `view_px` (V,) of each view; `coverage` (rows,
    columns) corners in each cell of the picture; `advice` says which views to add.
    """

    camera: Camera
    sigma: Array
    rms_px: float
    held_out_px: float
    view_px: Array
    coverage: np.ndarray
    advice: tuple[str, ...]

    @property
    def sigma_focal(self) -> float:
        """Relative 1-sigma error of the focal length, as `calibration_sigma.focal` wants it."""
        return float((self.sigma[:2] / self.camera.focal_px).max())

    @property
    def sigma_center_px(self) -> float:
        """1-sigma error of the principal point, as `calibration_sigma.center_px` wants it."""
        return float(self.sigma[2:4].max())


@dataclass(frozen=True, slots=True)
class PortGuess:
    """A flat port of which the distance m from the entrance pupil to the water and its index are known, or estimated.

    The glass counts as air: what it adds is a shift by half a millimetre for each of its millimetres.
    """

    distance_m: float | None = None
    index: float | None = WATER_INDEX


@dataclass(frozen=True, slots=True, eq=False)
class _Kind:
    """What is fitted: the lens model, the start (2,) of distance and index, and their weights (2,) as known numbers."""

    model: Model
    port: bool
    start: Array
    weight: Array

    @classmethod
    def of(cls, model: Model, port: PortGuess | None) -> _Kind:
        if port is None:
            return cls(model, False, np.array([0.0, 1.0]), np.full(2, _HELD))
        known = [port.distance_m is not None, port.index is not None]
        start = [_PORT_M if port.distance_m is None else port.distance_m, port.index or WATER_INDEX]
        return cls(model, True, np.array(start), np.where(known, _HELD, 0.0))

    def port_of(self, change: Array) -> FlatPort:
        """The port whose distance and index are the start's and a `change` (2,)."""
        distance_m, index = self.start + change
        return FlatPort(float(distance_m), float(index))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Camera parameters (10,), poses (V, 6) rotation vector and m, residuals (n, 2) px, their view (n,), covariance."""

    parameters: Array
    poses: Array
    residual: Array
    view: np.ndarray
    covariance: Array


def calibrate(
    board: Board,
    sightings: Sequence[Sighting],
    size: tuple[int, int],
    model: Model = "plumb_bob",
    port: PortGuess | None = None,
) -> Calibration:
    """The camera of `size` (width, height) px that the sightings of a board fit best.

    With a `port`, the lens in air behind it; without, the pinhole that comes nearest to what the water does.

    Raises: InputError for fewer than six views; where scipy is not installed (extra `setup`).
    """
    if len(sightings) < _LEAST_VIEWS:
        raise InputError(f"{len(sightings)} views show the board, wanted at least {_LEAST_VIEWS}")
    kind = _Kind.of(model, port)
    whole = _fit(board, sightings, size, kind)
    kept = [k for k in range(len(sightings)) if k % _HELD_OUT]
    part = _fit(board, [sightings[k] for k in kept], size, kind)
    held_out = [_view_rms(board, sightings[k], part.parameters, kind) for k in range(0, len(sightings), _HELD_OUT)]
    view_px = np.array([_rms(whole.residual[whole.view == k]) for k in range(len(sightings))])
    coverage = _coverage(sightings, size)
    return Calibration(
        camera=_camera(whole.parameters, size, kind),
        sigma=np.sqrt(np.diagonal(whole.covariance)[:_CAMERA]),
        rms_px=_rms(whole.residual),
        held_out_px=_rms(np.array(held_out)[:, None]),
        view_px=view_px,
        coverage=coverage,
        advice=_advice(coverage, whole.poses),
    )


def _camera(parameters: Array, size: tuple[int, int], kind: _Kind) -> Camera:
    fx, fy, cx, cy = parameters[:4]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = np.append(parameters[4:8], 0.0) if kind.model == "plumb_bob" else parameters[4:8].copy()
    port = kind.port_of(parameters[8:]) if kind.port else None
    return Camera(*size, K, kind.model, distortion, port)


def _rms(residual: Array) -> float:
    """Root mean square length of residuals (n, 2), or of lengths (n, 1)."""
    return float(np.sqrt((residual**2).sum(axis=1).mean())) if len(residual) else math.nan


def _fit(board: Board, sightings: Sequence[Sighting], size: tuple[int, int], kind: _Kind) -> _Fit:
    with extra("setup"):
        from scipy.optimize import least_squares
    corners = board.corners_m()
    x0 = _start(corners, sightings, size, kind)
    n = _CAMERA
    used = [np.ones(len(one.corner), bool) for one in sightings]
    for last in (False, True):

        def residual(x: Array) -> Array:
            rows = [r[keep].ravel() for r, keep in zip(_residuals(x), used, strict=True)]  # noqa: B023
            return np.concatenate([*rows, kind.weight * x[8:10]])

        def jacobian(x: Array) -> Array:
            rows = []
            for k, (one, keep) in enumerate(zip(sightings, used, strict=True)):  # noqa: B023
                own = slice(n + 6 * k, n + 6 * k + 6)
                _, J = _project(corners[one.corner], x[own], x[:n], kind)
                block = np.zeros((len(one.corner), 2, len(x)))
                block[:, :, :n], block[:, :, own] = J[:, :, 6:], J[:, :, :6]
                rows.append(block[keep].reshape(-1, len(x)))
            held = np.zeros((2, len(x)))
            held[[0, 1], [8, 9]] = kind.weight
            return np.concatenate([*rows, held])

        def _residuals(x: Array) -> list[Array]:
            return [
                _project(corners[one.corner], x[n + 6 * k : n + 6 * k + 6], x[:n], kind)[0] - one.uv
                for k, one in enumerate(sightings)
            ]

        loss = "linear" if last else "cauchy"
        found = least_squares(residual, x0, jacobian, loss=loss, f_scale=_LOSS_PX, x_scale="jac", method="trf")
        x0 = np.asarray(found.x)
        if not last:
            typical = float(np.median([np.median(np.linalg.norm(r, axis=1)) for r in _residuals(x0)])) * 1.2
            used = [np.linalg.norm(r, axis=1) < _OUTLIER * max(typical, 0.02) for r in _residuals(x0)]
    r = np.asarray(found.fun)[:-2]
    noise2 = float(r @ r) / max(len(r) - len(x0), 1)
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * noise2
    view = np.concatenate([np.full(int(keep.sum()), k) for k, keep in enumerate(used)])
    return _Fit(x0[:n], x0[n:].reshape(-1, 6), r.reshape(-1, 2), view, covariance)


def _project(p: Array, pose: Array, parameters: Array, kind: _Kind) -> tuple[Array, Array]:
    """Pixels (n, 2) of board points and their Jacobian (n, 2, 16) by the pose (6,) and the camera (10,)."""
    if not kind.port:
        uv, J = _project_in_air(p, pose, parameters, kind.model)
        return uv, np.concatenate([J, np.zeros((len(p), 2, 2))], axis=2)
    R, J_R = cv2.Rodrigues(pose[:3])
    p_cam = p @ R.T + pose[3:]
    J_p_rotation = np.einsum("irc,nc->nri", J_R.reshape(3, 3, 3), p)
    at, J_at_p = kind.port_of(parameters[8:]).in_air(p_cam)
    by_port = [(kind.port_of(parameters[8:] + step).in_air(p_cam)[0] - at) / _STEP for step in _STEP * np.eye(2)]
    uv, J = _project_in_air(np.column_stack([at, np.ones(len(at))]), np.zeros(6), parameters, kind.model)
    J_uv_at = J[:, :, 3:5]  # as by a translation
    J_uv_p = J_uv_at @ J_at_p
    J_uv_port = J_uv_at @ np.stack(by_port, axis=2)
    return uv, np.concatenate([J_uv_p @ J_p_rotation, J_uv_p, J[:, :, 6:], J_uv_port], axis=2)


def _project_in_air(p: Array, pose: Array, parameters: Array, model: Model) -> tuple[Array, Array]:
    """Pixels (n, 2) of points and their Jacobian (n, 2, 14) by the pose and the first eight numbers of the camera."""
    fx, fy, cx, cy = parameters[:4]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if model == "equidistant":
        uv, J = cv2.fisheye.projectPoints(p[None], pose[:3, None], pose[3:, None], K, parameters[4:8, None])[:2]
        J = np.asarray(J).reshape(-1, 2, 15)  # f, c, k1-k4, rotation, translation, skew
        order = [8, 9, 10, 11, 12, 13, 0, 1, 2, 3, 4, 5, 6, 7]
    else:
        uv, J = cv2.projectPoints(p, pose[:3], pose[3:], K, np.append(parameters[4:8], 0.0))
        J = np.asarray(J).reshape(-1, 2, 15)  # rotation, translation, f, c, k1, k2, p1, p2, k3
        order = list(range(14))
    return np.asarray(uv, float).reshape(-1, 2), np.asarray(J[:, :, order], float)


def _start(corners: Array, sightings: Sequence[Sighting], size: tuple[int, int], kind: _Kind) -> Array:
    """Zhang's closed form for the focal length, then the pose of every view by it. Water magnifies by its index."""
    objects = [corners[one.corner].astype(np.float32) for one in sightings]
    pixels = [one.uv.astype(np.float32)[:, None] for one in sightings]
    K = cv2.initCameraMatrix2D(objects, pixels, size)
    if not (np.isfinite(K).all() and 0.2 < K[0, 0] / max(size) < 20.0):  # nearly frontal views leave it open
        K = np.array([[max(size), 0.0, size[0] / 2], [0.0, max(size), size[1] / 2], [0.0, 0.0, 1.0]])
    poses = []
    for one in sightings:
        found, rvec, tvec = cv2.solvePnP(corners[one.corner], one.uv, K, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise InputError(f"frame {one.frame}: the board's corners do not lie as on a board")
        poses.append(np.concatenate([np.ravel(rvec), np.ravel(tvec)]))
    focal = np.array([K[0, 0], K[1, 1]]) / kind.start[1]
    first = np.array([*focal, K[0, 2], K[1, 2], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return np.concatenate([first, *poses])


def _view_rms(board: Board, one: Sighting, parameters: Array, kind: _Kind) -> float:
    """Rms residual of a view whose pose is fitted with the camera as it is."""
    from scipy.optimize import least_squares

    camera = _camera(parameters, (2, 2), kind)
    p = board.corners_m()[one.corner]
    ray = camera.unproject(one.uv)
    ahead = np.isfinite(ray).all(axis=1) & (ray[:, 2] > 0.0)
    if ahead.sum() < 4:
        return math.nan
    xy = ray[ahead, :2] / ray[ahead, 2:]
    _, rvec, tvec = cv2.solvePnP(p[ahead], xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    start = np.concatenate([np.ravel(rvec), np.ravel(tvec)])
    found = least_squares(
        lambda pose: (_project(p, pose, parameters, kind)[0] - one.uv).ravel(),
        start,
        lambda pose: _project(p, pose, parameters, kind)[1][:, :, :6].reshape(-1, 6),
        x_scale="jac",
    )
    return _rms(found.fun.reshape(-1, 2))


def _coverage(sightings: Sequence[Sighting], size: tuple[int, int]) -> np.ndarray:
    uv = np.concatenate([one.uv for one in sightings])
    bins = [np.linspace(-0.5, side - 0.5, cells + 1) for side, cells in zip(size, _CELLS, strict=True)]
    counts = np.histogram2d(uv[:, 1], uv[:, 0], bins=[bins[1], bins[0]])[0]
    return np.asarray(counts.astype(np.int64))


def _advice(coverage: np.ndarray, poses: Array) -> tuple[str, ...]:
    said, (rows, columns) = [], coverage.shape
    for row, column in np.argwhere(coverage < _COVERED):
        down = "top" if row == 0 else "bottom" if row == rows - 1 else "middle"
        across = "left" if column == 0 else "right" if column == columns - 1 else "centre"
        said.append(f"few corners in the {down} {across} of the picture: bring the board there")
    tilts = []
    for pose in poses:
        R = cv2.Rodrigues(pose[:3])[0]
        tilts.append(math.degrees(math.acos(min(abs(float(R[2, 2])), 1.0))))
    if sum(tilt > _STEEP_DEG for tilt in tilts) < len(tilts) / 3:
        said.append(f"fewer than a third of the views are tilted by {_STEEP_DEG:g} degrees: tilt the board more")
    far, near = poses[:, 5].max(), poses[:, 5].min()
    if far < 1.5 * near:
        said.append("all views are from one distance: a flat port bends nearer ones more; show the board at others")
    return tuple(dict.fromkeys(said))
