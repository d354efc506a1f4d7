"""Matched points -> pose: projection of lights from a pose, SQPnP, and the most probable poses of one frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lumidock._kernels.pose import flipped
from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.geometry import covariance_in_dock_axes, se3_exp, se3_inverse, se3_log, skew, so3_exp, transform_points
from lumidock.station import Station

_MIN_POINTS = 3
_MAX_STEPS, _CONVERGED = 60, 1e-6  # Gauss-Newton steps; square of the last one, in sigmas
_OPEN = 1e14  # condition number beyond which the lights leave the pose open
_SAME = 0.01  # square of sigmas; closer solutions are one
_AS_LIKELY = 13.8  # chi-square by which the other pose of a plane may fit worse, 1 in 1000


def project_lights(camera: Camera, T_dock_cam: Array, p_dock: Array) -> Array:
    """Pixels `uv` (N, 2) of lights `p_dock` (N, 3) seen from `T_dock_cam`; NaN where out of the lens's sight."""
    return camera.project(transform_points(se3_inverse(T_dock_cam), p_dock))


def project_lights_with_jacobian(camera: Camera, T_dock_cam: Array, p_dock: Array) -> tuple[Array, Array]:
    """Pixels `uv` (N, 2) and J_uv_pose (N, 2, 6) for a right perturbation [m, rad] of `T_dock_cam`.

    Source: p_cam moves by -rho - phi x p_cam to first order.
    """
    p_cam = transform_points(se3_inverse(T_dock_cam), p_dock)
    uv, J_uv_p = camera.project_with_jacobian(p_cam)
    J_p_pose = np.zeros((len(p_dock), 3, 6))
    J_p_pose[:, :, :3] = -np.eye(3)
    J_p_pose[:, :, 3:] = np.array([skew(p) for p in p_cam]).reshape(-1, 3, 3)
    return uv, J_uv_p @ J_p_pose


def sqpnp(camera: Camera, p_dock: Array, uv: Array) -> Array | None:
    """`T_dock_cam` (4, 4) from lights `p_dock` (N, 3) and their pixels `uv` (N, 2); None when there is no solution.

    Source: G. Terzakis, M. Lourakis, "A Consistently Fast and Globally Optimal Solution to the Perspective-n-Point
    Problem", 2020; paper section 3.3. Solved on undistorted rays, so that any lens model will do.
    """
    ray = camera.unproject(uv)
    if len(uv) < _MIN_POINTS or not np.isfinite(ray).all() or (ray[:, 2] <= 0.0).any():
        return None
    xy = ray[:, :2] / ray[:, 2:]
    try:
        found, rvec, tvec = cv2.solvePnP(np.ascontiguousarray(p_dock), xy, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # collinear or coincident points
        return None
    if not found or not (np.isfinite(rvec).all() and np.isfinite(tvec).all()):
        return None
    T_cam_dock = np.eye(4)
    T_cam_dock[:3, :3] = so3_exp(np.asarray(rvec, float).ravel())
    T_cam_dock[:3, 3] = np.asarray(tvec, float).ravel()
    if camera.port is not None:
        T_cam_dock[2, 3] -= camera.port.viewpoint_m  # where the rays near the axis meet
    in_front = transform_points(T_cam_dock, p_dock)[:, 2] > 0.0
    return se3_inverse(T_cam_dock) if in_front.all() else None


def reprojection_rms_px(camera: Camera, T_dock_cam: Array, p_dock: Array, uv: Array) -> float:
    """Root mean square distance in px between `uv` (N, 2) and the lights `p_dock` (N, 3) projected from a pose."""
    error = project_lights(camera, T_dock_cam, p_dock) - uv
    return float(np.sqrt((error**2).sum(axis=1).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class PoseSolution:
    """A pose that fits: `T_dock_cam` (4, 4), its covariance (6, 6) in dock axes as in `Fix`, and its chi-square."""

    T_dock_cam: Array
    covariance: Array
    chi2: float


def solve_pose(
    station: Station, camera: Camera, lights: Indices, uv: Array, cov_px2: Array | None = None, noise_px: float = 0.5
) -> tuple[PoseSolution, ...]:
    """The poses that one frame's identified lights allow, likeliest first: two where the flip of a plane leaves two.

    `lights` (N,) indices into the station, their pixels `uv` (N, 2) and covariance `cov_px2` (N, 2, 2), else
    `noise_px`. SQPnP, then Gauss-Newton under the covariance of all errors together: pixels, survey (each light, each
    layer) and calibration. None where no pose fits, or the lights leave one open. The covariance is linear: of a plane
    beyond some 12 m, whose tilt it leaves open, it is too small.
    Source of the flip: D. Oberkampf, D. DeMenthon, L. Davis, 1996.
    """
    p_dock = station.p_dock[lights]
    start = sqpnp(camera, p_dock, uv)
    if start is None:
        return ()
    cov = np.tile(np.eye(2) * noise_px**2, (len(uv), 1, 1)) if cov_px2 is None else cov_px2
    first = _refined(start, station, camera, lights, uv, cov)
    found = [first, _refined(_flipped(first.T_dock_cam, p_dock), station, camera, lights, uv, cov)] if first else []
    solutions = sorted((one for one in found if one is not None), key=lambda one: one.chi2)
    others = [
        one for one in solutions[1:] if one.chi2 < solutions[0].chi2 + _AS_LIKELY and _apart(one, solutions[0]) > _SAME
    ]
    return tuple(solutions[:1] + others)


def _refined(
    T_dock_cam: Array, station: Station, camera: Camera, lights: Indices, uv: Array, cov_px2: Array
) -> PoseSolution | None:
    """The most probable pose near one; the errors' covariance is that at the pose, so it is taken anew once."""
    for _ in range(2):
        noise = _error_covariance(T_dock_cam, station, camera, lights, cov_px2)
        if not np.isfinite(noise).all():
            return None
        found = _gauss_newton(T_dock_cam, camera, station.p_dock[lights], uv, noise)
        if found is None:
            return None
        T_dock_cam = found.T_dock_cam
    return found


def _gauss_newton(T_dock_cam: Array, camera: Camera, p_dock: Array, uv: Array, noise: Array) -> PoseSolution | None:
    """Least squares under the covariance `noise` (2N, 2N); steps that make it worse are halved. None if unsettled."""
    chi2, T = np.inf, T_dock_cam
    step: Array = np.zeros(6)
    for _ in range(_MAX_STEPS):
        ahead = T @ se3_exp(step)
        expected, J_uv_pose = project_lights_with_jacobian(camera, ahead, p_dock)
        e, J = (uv - expected).ravel(), J_uv_pose.reshape(-1, 6)
        now = float(e @ np.linalg.solve(noise, e)) if np.isfinite(e).all() else np.inf
        if now > chi2 + 1e-9 or now == np.inf:
            step *= 0.5
            continue
        T, chi2, WJ = ahead, now, np.linalg.solve(noise, J)
        H: Array = J.T @ WJ
        if np.linalg.cond(H) > _OPEN:
            return None
        step = np.linalg.solve(H, WJ.T @ e)
        if float(step @ H @ step) < _CONVERGED:
            return PoseSolution(T, covariance_in_dock_axes(np.linalg.inv(H), T[:3, :3]), chi2)
    return None


def _error_covariance(T_dock_cam: Array, station: Station, camera: Camera, lights: Indices, cov_px2: Array) -> Array:
    """Covariance (2N, 2N) px^2 of the pixels of lights from one pose: centres, survey and calibration together."""
    T_cam_dock = se3_inverse(T_dock_cam)
    uv, J_uv_p = camera.project_with_jacobian(transform_points(T_cam_dock, station.p_dock[lights]))
    n, J_uv_dock = len(lights), J_uv_p @ T_cam_dock[:3, :3]
    together = station.layer[lights][:, None] == station.layer[lights][None, :]
    position = (
        np.diag(np.broadcast_to(station.sigma_light_m, len(station))[lights] ** 2) + together * station.sigma_layer_m**2
    )
    total = np.einsum("ij,iak,jbk->iajb", position, J_uv_dock, J_uv_dock).reshape(2 * n, 2 * n)
    offset = (uv - camera.center_px).ravel()
    total += np.outer(offset, offset) * station.sigma_focal**2
    total += np.kron(np.ones((n, n)), np.eye(2)) * station.sigma_center_px**2
    for i in range(n):
        total[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += cov_px2[i]
    return np.asarray(total)


def _flipped(T_dock_cam: Array, p_dock: Array) -> Array:
    """The other pose from which a plane seen from afar looks nearly the same."""
    T_cam_dock = se3_inverse(T_dock_cam)
    R, t = np.ascontiguousarray(T_cam_dock[:3, :3]), T_cam_dock[:3, 3].copy()
    flipped(np.ascontiguousarray(p_dock), R, t)
    T_cam_dock[:3, :3], T_cam_dock[:3, 3] = R, t
    return se3_inverse(T_cam_dock)


def _apart(one: PoseSolution, best: PoseSolution) -> float:
    """Squared distance of a pose from the best, in sigmas of the best."""
    R_dock_cam = best.T_dock_cam[:3, :3]
    xi = se3_log(se3_inverse(best.T_dock_cam) @ one.T_dock_cam)
    e = np.concatenate([R_dock_cam @ xi[:3], R_dock_cam @ xi[3:]])
    return float(e @ np.linalg.solve(best.covariance, e))
