"""Four ways from identified lights to a pose, on the same undistorted rays.

Sources: SQPnP: G. Terzakis, M. Lourakis, 2020 (the paper's choice). EPnP: V. Lepetit, F. Moreno-Noguer, P. Fua, 2009.
IPPE: T. Collins, A. Bartoli, 2014, for planes only. Iterative: Levenberg-Marquardt from a homography or DLT, OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse, so3_exp, transform_points

SOLVERS = {
    "SQPnP": cv2.SOLVEPNP_SQPNP,
    "EPnP": cv2.SOLVEPNP_EPNP,
    "IPPE": cv2.SOLVEPNP_IPPE,
    "iterative": cv2.SOLVEPNP_ITERATIVE,
}


def solutions(solver: str, camera: Camera, p_dock: Array, uv: Array) -> list[Array]:
    """All poses `T_dock_cam` (4, 4) that a solver gives, best first, with every light in front of the camera.

    `p_dock` (N, 3) m, `uv` (N, 2) px, N at least 4. An empty list where the solver fails.
    """
    ray = camera.unproject(uv)
    if not np.isfinite(ray).all() or (ray[:, 2] <= 0.0).any():
        return []
    xy = np.ascontiguousarray(ray[:, :2] / ray[:, 2:])
    try:
        found, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            np.ascontiguousarray(p_dock), xy, np.eye(3), None, flags=SOLVERS[solver]
        )
    except cv2.error:  # collinear, coincident, or for IPPE not in a plane
        return []
    pairs = zip(rvecs, tvecs, strict=True) if found else ()
    poses = [_T_cam_dock(np.asarray(r, float).ravel(), np.asarray(t, float).ravel()) for r, t in pairs]
    good = (T for T in poses if np.isfinite(T).all() and (transform_points(T, p_dock)[:, 2] > 0.0).all())
    return [se3_inverse(T) for T in good]


def _T_cam_dock(rvec: Array, tvec: Array) -> Array:
    T_cam_dock = np.eye(4)
    T_cam_dock[:3, :3], T_cam_dock[:3, 3] = so3_exp(rvec), tvec
    return T_cam_dock
