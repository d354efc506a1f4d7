"""Coherent Point Drift, rigid with scale: the lights as a Gaussian mixture that the detections are drawn from.

Source: A. Myronenko, X. Song, "Point Set Registration: Coherent Point Drift", 2010, figure 2 (rigid).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock.baselines.hungarian import normalized
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

OUTLIERS = 0.1  # w: weight of the uniform component
_ITERATIONS = 150
_SETTLED = 1e-10  # change of sigma^2 at which the iteration ends
_MIN_POSTERIOR = 0.3  # of an association; below it the detection is spurious


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Similarity from mixture to data: `scale`, `R` (2, 2), `t` (2,); posteriors (M, N); the objective by iteration."""

    scale: float
    R: Array
    t: Array
    posterior: Array
    objective: Array


def register(data: Array, mixture: Array, outliers: float = OUTLIERS) -> Drift:
    """Move the points `mixture` (M, D) onto `data` (N, D) by expectation maximisation from no motion."""
    (n, dimensions), m = data.shape, len(mixture)
    scale = 1.0
    R: Array = np.eye(dimensions)
    t: Array = np.zeros(dimensions)
    moved = mixture.copy()
    sigma2 = float(((data[None] - moved[:, None]) ** 2).sum() / (dimensions * n * m))
    objective = []
    for _ in range(_ITERATIONS):
        gaussian = np.exp(-((data[None] - moved[:, None]) ** 2).sum(axis=2) / (2.0 * sigma2))
        uniform = (2.0 * np.pi * sigma2) ** (dimensions / 2) * outliers / max(1.0 - outliers, 1e-12) * m / n
        total = gaussian.sum(axis=0) + uniform
        density = total / (2.0 * np.pi * sigma2) ** (dimensions / 2)
        objective.append(-float(np.log(np.maximum(density, 1e-300)).sum()))
        posterior = gaussian / np.maximum(total, 1e-300)
        before = sigma2
        scale, R, t, sigma2 = _maximized(data, mixture, posterior)
        moved = scale * mixture @ R.T + t
        if abs(before - sigma2) < _SETTLED:
            break
    return Drift(scale, R, t, posterior, np.array(objective))


def _maximized(data: Array, mixture: Array, posterior: Array) -> tuple[float, Array, Array, float]:
    """The M step: the most probable scale, rotation, shift and variance for given posteriors (M, N)."""
    total, dimensions = float(posterior.sum()), data.shape[1]
    mean_data, mean_mixture = posterior.sum(axis=0) @ data / total, posterior.sum(axis=1) @ mixture / total
    x, y = data - mean_data, mixture - mean_mixture
    A = x.T @ posterior.T @ y
    U, _, Vt = np.linalg.svd(A)
    turn = np.ones(dimensions)
    turn[-1] = np.linalg.det(U @ Vt)
    R = U @ np.diag(turn) @ Vt
    explained = float(np.trace(A.T @ R))
    scale = explained / max(float((posterior.sum(axis=1) * (y**2).sum(axis=1)).sum()), 1e-12)
    spread = float((posterior.sum(axis=0) * (x**2).sum(axis=1)).sum())
    sigma2 = max((spread - scale * explained) / (total * dimensions), 1e-9)
    return scale, R, mean_data - scale * R @ mean_mixture, sigma2


def associate(view: LayerView, _rng: np.random.Generator) -> Indices | None:
    """Light of each detection by the largest product of posteriors, one to one."""
    drift = register(normalized(view.xy_up), normalized(view.p_dock[:, :2]))
    posterior = drift.posterior.T
    light = assign(-np.log(np.maximum(posterior, 1e-300)))
    return np.where(posterior[np.arange(len(light)), light] >= _MIN_POSTERIOR, light, -1)
