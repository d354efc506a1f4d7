"""One-to-one assignment of rows to columns at the least total cost."""

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
