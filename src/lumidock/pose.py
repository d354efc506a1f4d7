"""Matched points -> pose: projection of lights from a pose, and SQPnP."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse, skew, so3_exp, transform_points

_MIN_POINTS = 3


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
    in_front = transform_points(T_cam_dock, p_dock)[:, 2] > 0.0
    return se3_inverse(T_cam_dock) if in_front.all() else None


def reprojection_rms_px(camera: Camera, T_dock_cam: Array, p_dock: Array, uv: Array) -> float:
    """Root mean square distance in px between `uv` (N, 2) and the lights `p_dock` (N, 3) projected from a pose."""
    error = project_lights(camera, T_dock_cam, p_dock) - uv
    return float(np.sqrt((error**2).sum(axis=1).mean()))
