"""The paper's hot loops: one-to-one assignment and the enhanced particle swarm."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock.datatypes import Array, Indices


@entry
def assign(cost: Array) -> Indices:
    """Column of each row (N,) in the cheapest one-to-one assignment of `cost` (N, M); -1 for rows left over.

    All are -1 when no assignment has a finite cost.

    Source: H. W. Kuhn, 1955, in the O(n^2 m) form of shortest augmenting paths (R. Jonker, A. Volgenant, 1987).
    """
    if cost.shape[0] > cost.shape[1]:
        column_of_row = np.full(cost.shape[0], -1, np.int64)
        row_of_column = _assign_rows(cost.T)
        for column in range(cost.shape[1]):
            if row_of_column[column] >= 0:
                column_of_row[row_of_column[column]] = column
        return column_of_row
    return _assign_rows(cost)


@part
def _assign_rows(cost: Array) -> Indices:
    """`assign` for N <= M. Row and column 0 of the work arrays are sentinels."""
    n, m = cost.shape
    row_price, column_price = np.zeros(n + 1), np.zeros(m + 1)
    row_at, came_from = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.int64)
    distance, done = np.empty(m + 1), np.empty(m + 1, np.bool_)
    for start in range(1, n + 1):
        row_at[0] = start
        distance[:] = np.inf
        done[:] = False
        column = 0
        while row_at[column] != 0:
            done[column] = True
            row, step, nearest = row_at[column], np.inf, 0
            for j in range(1, m + 1):
                if done[j]:
                    continue
                reduced = cost[row - 1, j - 1] - row_price[row] - column_price[j]
                if reduced < distance[j]:
                    distance[j] = reduced
                    came_from[j] = column
                if distance[j] < step:
                    step, nearest = distance[j], j
            if nearest == 0:  # only infinite or NaN costs are left
                return np.full(n, -1, np.int64)
            for j in range(m + 1):
                if done[j]:
                    row_price[row_at[j]] += step
                    column_price[j] -= step
                else:
                    distance[j] -= step
            column = nearest
        while column != 0:
            row_at[column] = row_at[came_from[column]]
            column = came_from[column]
    column_of_row = np.full(n, -1, np.int64)
    for j in range(1, m + 1):
        if row_at[j] > 0:
            column_of_row[row_at[j] - 1] = j - 1
    return column_of_row


@entry
def registration_cost(x: Array, seen: Array, lights: Array, previous: Array, w1: float, w2: float) -> Array:
    """Cost (N, M) of giving each normalised spot `seen` (N, 2), moved by x = [theta, s, tx, ty], each light's name.

    `lights` (M, 2) and `previous` (M, 2), where the previous frame's transform put the light's spot, or NaN.
    Source: paper eqs. (2) and (8), read one to one.
    """
    a, b = x[1] * np.cos(x[0]), x[1] * np.sin(x[0])
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
def _fitness(
    x: Array,
    seen: Array,
    lights: Array,
    previous: Array,
    theta_previous: float,
    w1: float,
    w2: float,
    penalty: float,
    all_pairs: bool,
) -> float:
    cost = registration_cost(x, seen, lights, previous, w1, w2)
    total = 0.0
    if all_pairs:
        total = cost.sum()  # Eq. (2) as printed
    else:
        column = assign(cost)
        for i in range(len(column)):
            if column[i] >= 0:
                total += cost[i, column[i]]
    turned_deg = abs(x[0] - theta_previous) * 180.0 / np.pi  # NaN without a previous frame: no penalty
    if turned_deg >= 10.0:  # Eq. (7)
        total += penalty * (1.0 + (turned_deg - 10.0) / 5.0)
    return total


@part
def _under_explored(best_at: Array, low: Array, high: Array, rng: np.random.Generator) -> Array:
    """The one of eight random places that lies farthest from every particle's best so far."""
    farthest, place = -1.0, low.copy()
    for _ in range(8):
        candidate = low + rng.random(4) * (high - low)
        nearest = np.inf
        for i in range(len(best_at)):
            nearest = min(nearest, (((candidate - best_at[i]) / (high - low)) ** 2).sum())
        if nearest > farthest:
            farthest, place = nearest, candidate
    return place


@entry
def swarm(
    seen: Array,
    lights: Array,
    previous: Array,
    theta_previous: float,
    low: Array,
    high: Array,
    weights: Array,
    inertia: float,
    coefficients: Array,
    k: float,
    size: tuple[int, int, int],
    all_pairs: bool,
    rng: np.random.Generator,
) -> tuple[Array, float]:
    """Best transform [theta, s, tx, ty] (4,) and its fitness, found by the enhanced particle swarm.

    `weights` = w1, w2, penalty; `coefficients` = c1 base, c1 final, c2 base, c2 final; `size` = particles, iterations,
    iterations without gain before a restart. Source: paper eqs. (3)-(8).
    """
    particles, iterations, patience = size
    w1, w2, penalty = weights
    at = np.empty((particles, 4))
    velocity = np.empty((particles, 4))
    best_at = np.empty((particles, 4))
    best = np.full(particles, np.inf)
    idle = np.zeros(particles, np.int64)
    champion, champion_at = np.inf, low.copy()
    for i in range(particles):
        at[i] = low + rng.random(4) * (high - low)
        velocity[i] = (rng.random(4) - 0.5) * 0.2 * (high - low)
        best_at[i] = at[i]
    for iteration in range(iterations):
        falling = 1.0 - iteration / iterations
        c1 = coefficients[1] + (coefficients[0] - coefficients[1]) * falling  # Eq. (5), falling as the text says
        c2 = coefficients[3] + (coefficients[2] - coefficients[3]) * falling  # Eq. (6)
        for i in range(particles):
            value = _fitness(at[i], seen, lights, previous, theta_previous, w1, w2, penalty, all_pairs)
            idle[i] += 1
            if value < best[i] * 0.999:
                idle[i] = 0
            if value < best[i]:
                best[i] = value
                best_at[i] = at[i]
            if value < champion:
                champion = value
                champion_at = at[i].copy()
        for i in range(particles):
            if idle[i] > patience and best[i] > champion:
                at[i] = _under_explored(best_at, low, high, rng)
                velocity[i] = (rng.random(4) - 0.5) * 0.2 * (high - low)
                best_at[i] = at[i]
                best[i] = np.inf
                idle[i] = 0
                continue
            pull_own = c1 * rng.random(4) * (best_at[i] - at[i])
            pull_all = c2 * rng.random(4) * (champion_at - at[i])
            velocity[i] = inertia * velocity[i] + pull_own + pull_all  # Eq. (3)
            at[i] = np.minimum(np.maximum(at[i] + k * velocity[i], low), high)  # Eq. (4), bounded
    return champion_at, champion
