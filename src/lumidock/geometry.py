"""SE(3): exponential, logarithm, inverse, adjoint, Jacobians and the transport of covariances.

A tangent vector is xi = [translation m, rotation rad]; perturbations stand on the right, T_dock_cam @ se3_exp(xi).
Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018 (equation numbers).
"""

from __future__ import annotations

import math

import numpy as np

from lumidock.datatypes import Array

_SMALL_ANGLE = 1e-4  # rad; below it the Taylor series is exact to double precision


def skew(v: Array) -> Array:
    """Cross-product matrix (3, 3): `skew(v) @ w` is v x w."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _angle_terms(angle: float) -> tuple[float, float, float]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, also near zero."""
    if angle < _SMALL_ANGLE:
        a2 = angle * angle
        return 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    return (
        math.sin(angle) / angle,
        2.0 * (math.sin(0.5 * angle) / angle) ** 2,
        (angle - math.sin(angle)) / angle**3,
    )


def so3_exp(w: Array) -> Array:
    """Rotation matrix (3, 3) of the rotation vector `w` (3,) rad. Source: Sola eq. (135)."""
    a, b, _ = _angle_terms(float(np.linalg.norm(w)))
    W = skew(w)
    R: Array = np.eye(3) + a * W + b * (W @ W)
    return R


def so3_log(R: Array) -> Array:
    """Rotation vector (3,) rad, length 0..pi, of the rotation matrix `R` (3, 3). Source: through the quaternion."""
    q = quat_xyzw_from_rotation(R)
    sine, cosine = float(np.linalg.norm(q[:3])), float(q[3])
    scale = 2.0 * math.atan2(sine, cosine) / sine if sine > 1e-12 else 2.0
    return np.asarray(q[:3] * scale)


def so3_left_jacobian(w: Array) -> Array:
    """Left Jacobian (3, 3) of SO(3) at `w` (3,) rad. Source: Sola eq. (145)."""
    _, b, c = _angle_terms(float(np.linalg.norm(w)))
    W = skew(w)
    J: Array = np.eye(3) + b * W + c * (W @ W)
    return J


def se3_exp(xi: Array) -> Array:
    """Transform (4, 4) of the tangent vector `xi` (6,) [m, rad]. Source: Sola eq. (172)."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(xi[3:])
    T[:3, 3] = so3_left_jacobian(xi[3:]) @ xi[:3]
    return T


def se3_log(T: Array) -> Array:
    """Tangent vector (6,) [m, rad] of the transform `T` (4, 4). Source: Sola eq. (173)."""
    w = so3_log(T[:3, :3])
    return np.concatenate([np.linalg.solve(so3_left_jacobian(w), T[:3, 3]), w])


def se3_inverse(T: Array) -> Array:
    """Inverse (4, 4) of the transform `T` (4, 4); swaps the two frames of its name."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def se3_adjoint(T: Array) -> Array:
    """Adjoint (6, 6): T @ exp(xi) = exp(adjoint(T) @ xi) @ T. Source: Sola eq. (175)."""
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = T[:3, :3]
    adjoint[:3, 3:] = skew(T[:3, 3]) @ T[:3, :3]
    return adjoint


def se3_right_jacobian(xi: Array) -> Array:
    """Right Jacobian (6, 6): exp(xi + d) = exp(xi) @ exp(J @ d) for small d. Source: Sola eqs. (76), (179)."""
    return _se3_left_jacobian(-np.asarray(xi))


def _se3_left_jacobian(xi: Array) -> Array:
    """Left Jacobian (6, 6) of SE(3) at `xi` (6,). Source: Sola eqs. (179), (180)."""
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = so3_left_jacobian(xi[3:])
    J[:3, 3:] = _left_jacobian_q(xi[:3], xi[3:])
    return J


def _left_jacobian_q(rho: Array, w: Array) -> Array:
    """The translation-rotation block Q (3, 3) of the left Jacobian. Source: Sola eq. (180)."""
    angle = float(np.linalg.norm(w))
    P, W = skew(rho), skew(w)
    WP, PW = W @ P, P @ W
    WPW = W @ PW
    if angle < 0.05:  # the closed form cancels catastrophically here
        a2 = angle * angle
        b = 1.0 / 6.0 - a2 / 120.0 + a2 * a2 / 5040.0
        c = 1.0 / 24.0 - a2 / 720.0 + a2 * a2 / 40320.0
        d = 1.0 / 120.0 - a2 / 2520.0 + a2 * a2 / 120960.0
    else:
        s, k = math.sin(angle), math.cos(angle)
        b = (angle - s) / angle**3
        c = (angle**2 + 2.0 * k - 2.0) / (2.0 * angle**4)
        d = (2.0 * angle - 3.0 * s + angle * k) / (2.0 * angle**5)
    Q: Array = 0.5 * P + b * (WP + PW + WPW) + c * (W @ WP + PW @ W - 3.0 * WPW) + d * (WPW @ W + W @ WPW)
    return Q


def transform_points(T_a_b: Array, p_b: Array) -> Array:
    """Points `p_b` (N, 3) expressed in frame a: p_a = T_a_b @ p_b."""
    return np.asarray(p_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def rotation_from_quat_xyzw(quat_xyzw: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) of any non-zero length.

    Raises: ValueError when the quaternion has no finite, non-zero length.
    """
    length = float(np.linalg.norm(quat_xyzw))
    if not (math.isfinite(length) and length > 1e-12):
        raise ValueError("a quaternion must have a finite, non-zero length")
    x, y, z, w = np.asarray(quat_xyzw) / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_xyzw_from_rotation(R: Array) -> Array:
    """Unit quaternion (4,), w >= 0, of the rotation matrix `R` (3, 3). Source: S. W. Shepperd, 1978."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    k = int(np.argmax(squares))
    if k == 3:
        q = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.empty(4)
        q[k] = 1.0 + 2.0 * R[k, k] - trace
        q[i], q[j] = R[i, k] + R[k, i], R[j, k] + R[k, j]
        q[3] = R[j, i] - R[i, j]
    q /= np.linalg.norm(q)
    return np.asarray(-q if q[3] < 0 else q)


def pose_from_quat(position: Array, quat_xyzw: Array) -> Array:
    """Transform (4, 4) from a position (3,) m and a quaternion (4,). Raises: ValueError for a bad quaternion."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_quat_xyzw(quat_xyzw)
    T[:3, 3] = position
    return T


def covariance_in_dock_axes(cov: Array, R_dock_cam: Array) -> Array:
    """Transport a right-perturbation covariance (6, 6) of T_dock_cam to dock axes.

    The result is the covariance of [t_est - t_true, w] with R_est = Exp(w) R_true, order x, y, z, wx, wy, wz (ROS).
    Source: first order of T @ se3_exp(xi): t moves by R @ xi[:3], and R @ Exp(phi) = Exp(R @ phi) @ R.
    """
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R_dock_cam
    return np.asarray(A @ cov @ A.T)


def bearing_and_range(T_dock_cam: Array) -> tuple[float, float, float]:
    """Bearings atan2(x, z), atan2(y, z) rad and distance m of the dock's origin in `cam`."""
    x, y, z = se3_inverse(T_dock_cam)[:3, 3]
    return math.atan2(x, z), math.atan2(y, z), math.sqrt(x * x + y * y + z * z)
