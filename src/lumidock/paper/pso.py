"""Tag matching by an enhanced particle swarm with Hungarian assignment, paper section 3.2.1.

The swarm looks for the similarity (roll, scale, shift) that lays the spots of one layer over its lights. Eq. (2) as
printed sums over all pairs and has no minimum at the alignment, so the residual is taken one to one: the assignment is
solved inside the fitness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.config import PsoConfig
from lumidock.datatypes import Array, Indices
from lumidock.paper.normalize import normalize
from lumidock.paper.swarm import assign, registration_cost, swarm


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What one frame's swarm found.

    `light` (N,) the light of each spot, -1 for none; `transform` = theta rad, s, tx, ty; `placed` (M, 2) where it puts
    each light's spot, NaN for lights without one: the next frame's continuity term needs it.
    """

    light: Indices
    transform: Array
    fitness: float
    placed: Array


def register(
    xy: Array, lights_xy: Array, previous: Registration | None, config: PsoConfig, rng: np.random.Generator
) -> Registration:
    """Name the spots `xy` (N, 2) of one layer after its lights `lights_xy` (M, 2), both with y up.

    `xy` are undistorted image coordinates of any unit; `lights_xy` the lights on the frontal plane, depth dropped.
    """
    seen, lights = normalize(xy).points, normalize(lights_xy).points
    theta = np.deg2rad(config.theta_deg)
    bounds = np.array([theta, config.scale, config.shift, config.shift])
    placed = np.full(lights.shape, np.nan) if previous is None else previous.placed
    transform, fitness = swarm(
        seen,
        lights,
        placed,
        np.nan if previous is None else float(previous.transform[0]),
        np.ascontiguousarray(bounds[:, 0]),
        np.ascontiguousarray(bounds[:, 1]),
        np.array([config.w1, config.w2, config.penalty]),
        config.inertia,
        np.array([*config.c1, *config.c2]),
        config.k,
        (config.particles, config.iterations, config.stagnation),
        config.residual == "all_pairs",
        rng,
    )
    cost = registration_cost(transform, seen, lights, placed, config.w1, config.w2)
    light = assign(cost)
    return Registration(light, transform, float(fitness), _placed(transform, seen, light, len(lights)))


def _placed(transform: Array, seen: Array, light: Indices, n_lights: int) -> Array:
    """Where the transform puts the spot of each light (M, 2)."""
    theta, s, tx, ty = transform
    T = s * np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])  # below eq. (2)
    placed = np.full((n_lights, 2), np.nan)
    named = light >= 0
    placed[light[named]] = seen[named] @ T.T + [tx, ty]
    return placed
