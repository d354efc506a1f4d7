"""What pictures of lights cannot tell: where the dock's frame is, and how large the whole is. M lights."""

from __future__ import annotations

import numpy as np

from lumidock.datatypes import Array


def similarity_generators(p_dock: Array) -> Array:
    """How lights (M, 3) move (3M, 7) under three shifts in m, three turns in rad, and growth by a share."""
    p = p_dock - p_dock.mean(axis=0)
    G = np.zeros((len(p), 3, 7))
    G[:, :, :3] = np.eye(3)
    for axis in range(3):
        G[:, :, 3 + axis] = np.cross(np.eye(3)[axis], p)
    G[:, :, 6] = p
    return G.reshape(-1, 7)


def shape_covariance(covariance: Array, p_dock: Array, seen: np.ndarray) -> Array:
    """Covariance (3M, 3M) of the shape: of positions after the best similarity fit of the lights `seen` (M,)."""
    n = p_dock.size
    E = np.eye(n) - similarity_generators(p_dock) @ _fit(p_dock, seen)
    return np.asarray(E @ covariance[:n, :n] @ E.T)


def scale_sigma(covariance: Array, p_dock: Array, seen: np.ndarray) -> float:
    """Relative 1-sigma error of the size of the array of the lights `seen` (M,)."""
    size = _fit(p_dock, seen)[6]
    return float(np.sqrt(size @ covariance[: p_dock.size, : p_dock.size] @ size))


def _fit(p_dock: Array, seen: np.ndarray) -> Array:
    """The similarity (7, 3M) that small moves of the lights amount to, by the lights `seen` (M,)."""
    return np.linalg.pinv(similarity_generators(p_dock) * np.repeat(seen, 3)[:, None])


def aligned(p: Array, target: Array, *, scale: bool = False) -> Array:
    """Points `p` (M, 3) moved rigidly, and with `scale` resized, to fit `target` (M, 3) best.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    a, b = p - p.mean(axis=0), target - target.mean(axis=0)
    U, D, Vt = np.linalg.svd(b.T @ a)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(S) @ Vt
    size = float((D * S).sum() / (a**2).sum()) if scale else 1.0
    return np.asarray(size * a @ R.T + target.mean(axis=0))
