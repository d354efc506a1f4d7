"""A plain particle swarm with constriction: no falling coefficients, no restart, no history.

Source: M. Clerc, J. Kennedy, "The Particle Swarm: Explosion, Stability, and Convergence in a Multidimensional Complex
Space", 2002; the settings as compared by R. C. Eberhart, Y. Shi, 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock._kernels.compiling import entry
from lumidock.baselines.hungarian import normalized
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

CHI = 0.7298  # constriction for c1 + c2 = 4.1
PULL = 1.49618  # chi times 2.05, toward the own best and toward the swarm's
PARTICLES, ITERATIONS = 80, 120  # as many evaluations as the paper's swarm has in the recommended preset
# theta rad, s, tx, ty; both sets have unit rms radius, so that missing lights and spurious detections change s by less
LOW, HIGH = np.array([-0.1745, 0.4, -2.0, -2.0]), np.array([0.1745, 6.0, 2.0, 2.0])


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """The best place (D,), its value, and the best value after each iteration (I,)."""

    at: Array
    value: float
    values: Array


def minimize(
    cost: Callable[[Array], Array], bounds: tuple[Array, Array], size: tuple[int, int], rng: np.random.Generator
) -> Minimum:
    """Minimise `cost` of places (P, D) -> (P,) within `bounds`; `size` is particles, iterations."""
    low, high = bounds
    at = low + rng.random((size[0], len(low))) * (high - low)
    velocity = (rng.random(at.shape) - 0.5) * (high - low)
    best, best_at = cost(at), at.copy()
    values = np.empty(size[1])
    for iteration in range(size[1]):
        champion = best_at[best.argmin()]
        pulls = PULL * (rng.random(at.shape) * (best_at - at) + rng.random(at.shape) * (champion - at))
        velocity = np.clip(CHI * velocity + pulls, low - high, high - low)
        at = at + velocity
        value = np.where(((at >= low) & (at <= high)).all(axis=1), cost(at), np.inf)
        better = value < best
        best, best_at = np.where(better, value, best), np.where(better[:, None], at, best_at)
        values[iteration] = best.min()
    return Minimum(best_at[best.argmin()], float(best.min()), values)


@entry
def residuals(at: Array, seen: Array, lights: Array) -> Array:
    """Sum (P,) of the distances of detections (N, 2), moved by [theta, s, tx, ty], to lights (M, 2), one to one."""
    total = np.zeros(len(at))
    cost = np.empty((len(seen), len(lights)))
    for k in range(len(at)):
        a, b = at[k, 1] * np.cos(at[k, 0]), at[k, 1] * np.sin(at[k, 0])
        for i in range(len(seen)):
            x = a * seen[i, 0] - b * seen[i, 1] + at[k, 2]
            y = b * seen[i, 0] + a * seen[i, 1] + at[k, 3]
            for j in range(len(lights)):
                cost[i, j] = np.sqrt((x - lights[j, 0]) ** 2 + (y - lights[j, 1]) ** 2)
        column = assign(cost)
        for i in range(len(column)):
            if column[i] >= 0:
                total[k] += cost[i, column[i]]
    return total


def associate(view: LayerView, rng: np.random.Generator) -> Indices | None:
    """Light of each detection at the best similarity found."""
    seen, lights = normalized(view.xy_up), normalized(view.p_dock[:, :2])
    found = minimize(lambda at: residuals(at, seen, lights), (LOW, HIGH), (PARTICLES, ITERATIONS), rng)
    theta, s, tx, ty = found.at
    R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    moved = s * seen @ R.T + [tx, ty]
    return assign(np.linalg.norm(moved[:, None] - lights[None], axis=2))
