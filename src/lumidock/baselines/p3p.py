"""Perspective three-point problem, many at once: poses from three rays and three lights each.

Source: J. A. Grunert, 1841, as given by R. M. Haralick et al., "Review and Analysis of Solutions of the Three Point
Perspective Pose Estimation Problem", 1994. Up to four poses a problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

_REAL = 1e-4  # imaginary part, of a root near 1, up to which it is a real double root that rounding has split
_POLISH = 3  # Newton steps on each root
_CLOSES = 1e-4  # relative error of the side lengths that a solution may leave; wrong roots leave percents
_CHUNK = 20_000  # poses projected at once, which bounds the memory to some 100 MB


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """K poses `R_cam_dock` (K, 3, 3), `t_cam_dock` (K, 3); `problem` (K,) is the row that each one solves."""

    R_cam_dock: Array
    t_cam_dock: Array
    problem: Indices

    def __len__(self) -> int:
        return len(self.problem)

    def T_dock_cam(self, k: int) -> Array:
        """Pose number k as (4, 4)."""
        T_dock_cam = np.eye(4)
        T_dock_cam[:3, :3] = self.R_cam_dock[k].T
        T_dock_cam[:3, 3] = -self.R_cam_dock[k].T @ self.t_cam_dock[k]
        return T_dock_cam


def solve(ray_cam: Array, p_dock: Array) -> Poses:
    """All poses from unit vectors `ray_cam` (B, 3, 3) to lights `p_dock` (B, 3, 3), one problem a row."""
    a2, b2, c2 = (_square(p_dock[:, i] - p_dock[:, j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    alpha, beta, gamma = (np.einsum("bi,bi->b", ray_cam[:, i], ray_cam[:, j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    with np.errstate(all="ignore"):  # degenerate triples give NaN, and NaN solves nothing
        ratio, other, c_b = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
        v = _real_roots(_quartic(a2 / b2, c_b, (alpha, beta, gamma)))
        column = [x[:, None] for x in (ratio, alpha, beta, gamma)]
        u = (column[0] - 1.0) * v**2 - 2.0 * column[0] * column[2] * v + 1.0 + column[0]
        u = u / (2.0 * (column[3] - v * column[1]))
        s1 = np.sqrt(b2[:, None] / (1.0 + v**2 - 2.0 * v * column[2]))
        sides = np.stack([u**2 + v**2 - 2.0 * u * v * column[1], 1.0 + u**2 - 2.0 * u * column[3]], axis=2)
        off = np.abs(sides * s1[..., None] ** 2 / np.stack([a2, c2], axis=1)[:, None] - 1.0).max(axis=2)
        good = (off < _CLOSES) & (s1 > 0.0) & (u > 0.0) & (v > 0.0) & (other[:, None] > 0.0)
    problem, root = np.nonzero(good)
    scale = np.stack([s1, s1 * u, s1 * v], axis=2)[problem, root]
    return _aligned(p_dock[problem], scale[..., None] * ray_cam[problem], problem.astype(np.int64))


def _square(d: Array) -> Array:
    return np.asarray((d**2).sum(axis=1))


def _quartic(a: Array, c: Array, cosines: tuple[Array, Array, Array]) -> Array:
    """Coefficients (B, 5) of the quartic in v = s3 / s1, highest first; `a`, `c` are squared sides over b squared."""
    alpha, beta, gamma = cosines
    k, m = a - c, a + c
    return np.stack(
        [
            (k - 1.0) ** 2 - 4.0 * c * alpha**2,
            4.0 * (k * (1.0 - k) * beta - (1.0 - m) * alpha * gamma + 2.0 * c * alpha**2 * beta),
            2.0
            * (
                k**2
                - 1.0
                + 2.0 * k**2 * beta**2
                + 2.0 * (1.0 - c) * alpha**2
                - 4.0 * m * alpha * beta * gamma
                + 2.0 * (1.0 - a) * gamma**2
            ),
            4.0 * (-k * (1.0 + k) * beta + 2.0 * a * gamma**2 * beta - (1.0 - m) * alpha * gamma),
            (1.0 + k) ** 2 - 4.0 * a * gamma**2,
        ],
        axis=1,
    )


def _real_roots(q: Array) -> Array:
    """Real roots (B, 4) of quartics (B, 5), NaN where there are fewer. Source: L. Ferrari, 1545, then Newton."""
    b, c, d, e = ((q[:, i] / q[:, 0]).astype(complex) for i in range(1, 5))
    p = c - 0.375 * b**2
    r1 = d - 0.5 * b * c + 0.125 * b**3
    r0 = e - 0.25 * b * d + 0.0625 * b**2 * c - 3.0 / 256.0 * b**4
    m = _largest_cubic_root(p, 0.25 * p**2 - r0, -0.125 * r1**2)
    s = np.sqrt(2.0 * m)
    roots = []
    for sign in (1.0, -1.0):
        inner = np.sqrt(-(2.0 * p + 2.0 * m + sign * 2.0 * r1 / s))
        roots += [0.5 * (sign * s + inner) - 0.25 * b, 0.5 * (sign * s - inner) - 0.25 * b]
    x = np.stack(roots, axis=1)
    real = np.where(np.abs(x.imag) < _REAL * np.maximum(np.abs(x), 1.0), x.real, np.nan)
    k = [q[:, i, None] for i in range(5)]
    for _ in range(_POLISH):
        value = (((k[0] * real + k[1]) * real + k[2]) * real + k[3]) * real + k[4]
        slope = ((4.0 * k[0] * real + 3.0 * k[1]) * real + 2.0 * k[2]) * real + k[3]
        step = value / slope
        real = np.where(np.abs(step) < 0.1, real - step, real)
    return np.asarray(real)


def _largest_cubic_root(b: Array, c: Array, d: Array) -> Array:
    """The root (B,) of x^3 + b x^2 + c x + d that is largest in magnitude. Source: G. Cardano, 1545."""
    p, q = b**2 - 3.0 * c, 2.0 * b**3 - 9.0 * b * c + 27.0 * d
    inner = np.sqrt(q**2 - 4.0 * p**3)
    cube = 0.5 * np.where(np.abs(q + inner) > np.abs(q - inner), q + inner, q - inner)
    first = cube ** (1.0 / 3.0)
    turns = np.exp(2j * np.pi / 3.0 * np.arange(3))
    c3 = first[:, None] * turns
    x = -(b[:, None] + c3 + p[:, None] / np.where(c3 == 0.0, 1.0, c3)) / 3.0
    return np.asarray(x[np.arange(len(x)), np.argmax(np.nan_to_num(np.abs(x)), axis=1)])


def _aligned(p_dock: Array, p_cam: Array, problem: Indices) -> Poses:
    """Rigid transforms that carry triangles `p_dock` (K, 3, 3) onto the congruent `p_cam` (K, 3, 3)."""
    R = _axes(p_cam) @ _axes(p_dock).transpose(0, 2, 1)
    t = p_cam[:, 0] - np.einsum("kij,kj->ki", R, p_dock[:, 0])
    good = np.isfinite(R).all(axis=(1, 2))
    return Poses(R[good], t[good], problem[good])


def _axes(p: Array) -> Array:
    """Orthonormal axes (K, 3, 3), as columns, of triangles (K, 3, 3)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        x = p[:, 1] - p[:, 0]
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
        z = np.cross(x, p[:, 2] - p[:, 0])
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def nearest(view: LayerView, poses: Poses, reach_px: float) -> tuple[Indices, Array]:
    """The detection (K, M) nearest to each light from each pose, -1 beyond `reach_px`, and its squared distance px^2.

    Lights behind the camera have none.
    """
    detection = np.empty((len(poses), len(view.p_dock)), np.int64)
    distance2 = np.empty(detection.shape)
    for first in range(0, len(poses), _CHUNK):
        part = slice(first, first + _CHUNK)
        p_cam = np.einsum("kij,mj->kmi", poses.R_cam_dock[part], view.p_dock) + poses.t_cam_dock[part, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(p_cam[..., 2:] > 0.0, p_cam[..., :2] / p_cam[..., 2:], np.inf)
        d2 = ((xy[:, :, None] - view.xy) ** 2).sum(axis=3) / view.px**2
        detection[part] = d2.argmin(axis=2)
        distance2[part] = d2.min(axis=2)
    detection[~(distance2 <= reach_px**2)] = -1
    return detection, distance2


def one_to_one(detection: Indices, distance2: Array, n_detections: int) -> Indices:
    """Light of each detection (N,) from the detection (M,) of each light: the nearest light keeps a contested one."""
    light = np.full(n_detections, -1, np.int64)
    for i in np.argsort(distance2, kind="stable"):
        if detection[i] >= 0 and light[detection[i]] < 0:
            light[detection[i]] = i
    return light
