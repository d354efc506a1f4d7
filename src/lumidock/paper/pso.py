"""Tag matching by an enhanced particle swarm with Hungarian assignment, paper section 3.2.1.

Its particles search the similarity (roll, scale, shift) that lays the detections of one layer over its lights. Eq. (2)
as printed sums over all pairs and has no minimum at the alignment, so the residual is taken one to one: the assignment
is solved inside the fitness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock.config import PsoConfig
from lumidock.datatypes import Array, Indices
from lumidock.paper.normalize import normalize
from lumidock.paper.swarm import PointSets, Tuning, registration_cost, swarm

_NO_TRACE = np.empty((0, 0, 5))


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What the swarm found in one frame.

    `light` (N,) the light of each detection, -1 for none; `transform` = theta rad, s, tx, ty; `placed` (M, 2) where it
    puts the detection of each light, NaN for lights without one: the continuity term of the next frame needs it.
    """

    light: Indices
    transform: Array
    fitness: float
    placed: Array


def register(
    xy: Array,
    lights_xy: Array,
    previous: Registration | None,
    config: PsoConfig,
    rng: np.random.Generator,
    trace: Array = _NO_TRACE,
) -> Registration:
    """Associate the detections `xy` (N, 2) of one layer with its lights `lights_xy` (M, 2), both with y up.

    `xy` are undistorted image coordinates of any unit; `lights_xy` the lights on the frontal plane, depth dropped.
    A `trace` (iterations, particles, 5) receives [theta, s, tx, ty, fitness] of every particle in every iteration.
    """
    seen, lights = normalize(xy).points, normalize(lights_xy).points
    sets = PointSets(
        seen=seen,
        lights=lights,
        previous=np.full(lights.shape, np.nan) if previous is None else previous.placed,
        theta_previous=np.nan if previous is None else float(previous.transform[0]),
    )
    transform, fitness = swarm(sets, tuning_of(config), rng, trace)
    light = assign(registration_cost(transform, sets, config.w1, config.w2))
    return Registration(light, transform, float(fitness), _placed(transform, seen, light, len(lights)))


def tuning_of(config: PsoConfig) -> Tuning:
    """The parameters as the compiled swarm takes them."""
    bounds = np.array([np.deg2rad(config.theta_deg), config.scale, config.shift, config.shift])
    return Tuning(
        low=np.ascontiguousarray(bounds[:, 0]),
        high=np.ascontiguousarray(bounds[:, 1]),
        w1=config.w1,
        w2=config.w2,
        penalty=config.penalty,
        inertia=config.inertia,
        c1_base=config.c1[0],
        c1_final=config.c1[1],
        c2_base=config.c2[0],
        c2_final=config.c2[1],
        k=config.k,
        particles=config.particles,
        iterations=config.iterations,
        patience=config.stagnation,
        all_pairs=config.residual == "all_pairs",
    )


def _placed(transform: Array, seen: Array, light: Indices, n_lights: int) -> Array:
    """Where the transform puts the detection of each light (M, 2)."""
    theta, s, tx, ty = transform
    T = s * np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])  # below eq. (2)
    placed = np.full((n_lights, 2), np.nan)
    identified = light >= 0
    placed[light[identified]] = seen[identified] @ T.T + [tx, ty]
    return placed
