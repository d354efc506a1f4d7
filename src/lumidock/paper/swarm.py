"""The enhanced particle swarm of paper section 3.2.1, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock._kernels.compiling import entry, part
from lumidock.datatypes import Array

_CANDIDATES = 8  # random places that a restarted particle chooses from; the paper gives no number
_START_SPEED = 0.2  # width of the initial velocities, as a share of the search space; the paper gives none


class PointSets(NamedTuple):
    """What is registered: normalised detections `seen` (N, 2) and `lights` (M, 2).

    `previous` (M, 2) is where the previous frame's transform put the detection of each light, NaN where there is none;
    `theta_previous` its angle in rad, NaN without a previous frame.
    """

    seen: Array
    lights: Array
    previous: Array
    theta_previous: float


class Tuning(NamedTuple):
    """The swarm's parameters: `low` and `high` (4,) bound [theta rad, s, tx, ty]; the others as in `PsoConfig`."""

    low: Array
    high: Array
    w1: float
    w2: float
    penalty: float
    inertia: float
    c1_base: float
    c1_final: float
    c2_base: float
    c2_final: float
    k: float
    particles: int
    iterations: int
    patience: int
    all_pairs: bool


@entry
def registration_cost(x: Array, sets: PointSets, w1: float, w2: float) -> Array:
    """Cost (N, M) of assigning each light to each detection, moved by x = [theta, s, tx, ty].

    Source: paper eqs. (2) and (8), read one to one.
    """
    a, b = x[1] * np.cos(x[0]), x[1] * np.sin(x[0])
    seen, lights, previous = sets.seen, sets.lights, sets.previous
    cost = np.empty((len(seen), len(lights)))
    for i in range(len(seen)):
        u = a * seen[i, 0] - b * seen[i, 1] + x[2]
        v = b * seen[i, 0] + a * seen[i, 1] + x[3]
        for j in range(len(lights)):
            cost[i, j] = w1 * np.sqrt((u - lights[j, 0]) ** 2 + (v - lights[j, 1]) ** 2)
            if not np.isnan(previous[j, 0]):
                cost[i, j] += w2 * np.sqrt((u - previous[j, 0]) ** 2 + (v - previous[j, 1]) ** 2)
    return cost


@part
def _fitness(x: Array, sets: PointSets, tuning: Tuning) -> float:
    cost = registration_cost(x, sets, tuning.w1, tuning.w2)
    total = 0.0
    if tuning.all_pairs:
        total = cost.sum()  # Eq. (2) as printed
    else:
        column = assign(cost)
        for i in range(len(column)):
            if column[i] >= 0:
                total += cost[i, column[i]]
    turned_deg = abs(x[0] - sets.theta_previous) * 180.0 / np.pi  # NaN without a previous frame: no penalty
    if turned_deg >= 10.0:  # Eq. (7)
        total += tuning.penalty * (1.0 + (turned_deg - 10.0) / 5.0)
    return total


@part
def _under_explored(best_at: Array, low: Array, high: Array, rng: np.random.Generator) -> Array:
    """The random candidate that lies farthest from the best place of every particle so far."""
    farthest, place = -1.0, low.copy()
    for _ in range(_CANDIDATES):
        candidate = low + rng.random(4) * (high - low)
        nearest = np.inf
        for i in range(len(best_at)):
            nearest = min(nearest, (((candidate - best_at[i]) / (high - low)) ** 2).sum())
        if nearest > farthest:
            farthest, place = nearest, candidate
    return place


@entry
def swarm(sets: PointSets, tuning: Tuning, rng: np.random.Generator, trace: Array) -> tuple[Array, float]:
    """Best transform [theta, s, tx, ty] (4,) and its fitness, found by the enhanced particle swarm.

    A `trace` (iterations, particles, 5) is filled with every particle's place and fitness; one of length 0 is not.
    Source: paper eqs. (3)-(8).
    """
    low, high, width = tuning.low, tuning.high, tuning.high - tuning.low
    at = np.empty((tuning.particles, 4))
    velocity = np.empty((tuning.particles, 4))
    best_at = np.empty((tuning.particles, 4))
    best = np.full(tuning.particles, np.inf)
    idle = np.zeros(tuning.particles, np.int64)
    champion, champion_at = np.inf, low.copy()
    for i in range(tuning.particles):
        at[i] = low + rng.random(4) * width
        velocity[i] = (rng.random(4) - 0.5) * _START_SPEED * width
        best_at[i] = at[i]
    for iteration in range(tuning.iterations):
        falling = 1.0 - iteration / tuning.iterations
        c1 = tuning.c1_final + (tuning.c1_base - tuning.c1_final) * falling  # Eq. (5), falling as the text says
        c2 = tuning.c2_final + (tuning.c2_base - tuning.c2_final) * falling  # Eq. (6)
        for i in range(tuning.particles):
            value = _fitness(at[i], sets, tuning)
            if iteration < len(trace):
                trace[iteration, i, :4] = at[i]
                trace[iteration, i, 4] = value
            idle[i] += 1
            if value < best[i] * 0.999:
                idle[i] = 0
            if value < best[i]:
                best[i] = value
                best_at[i] = at[i]
            if value < champion:
                champion = value
                champion_at = at[i].copy()
        for i in range(tuning.particles):
            if idle[i] > tuning.patience and best[i] > champion:
                at[i] = _under_explored(best_at, low, high, rng)
                velocity[i] = (rng.random(4) - 0.5) * _START_SPEED * width
                best_at[i] = at[i]
                best[i] = np.inf
                idle[i] = 0
                continue
            pull_own = c1 * rng.random(4) * (best_at[i] - at[i])
            pull_all = c2 * rng.random(4) * (champion_at - at[i])
            velocity[i] = tuning.inertia * velocity[i] + pull_own + pull_all  # Eq. (3)
            at[i] = np.minimum(np.maximum(at[i] + tuning.k * velocity[i], low), high)  # Eq. (4), bounded
    return champion_at, champion
