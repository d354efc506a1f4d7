"""The update of the filter and its bank by a sensor of the vehicle, linear in the error of the state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.tracking.bank import Bank
from lumidock._kernels.tracking.track import FilterState, apply
from lumidock.datatypes import Array, Indices


class SensorRows(NamedTuple):
    """K independent numbers of one measurement, linearised at the filter's state.

    `residual` (K,) and its noise `var` (K,); `H` (K, C): what each means for the states `columns` (C,).
    """

    columns: Indices
    H: Array
    residual: Array
    var: Array


class SensorRules(NamedTuple):
    """How it updates: the states from `first` to before `last` are considered, and subset `blind` does not see it."""

    blind: int
    first: int
    last: int


@entry
def update_by_sensor(state: FilterState, bank: Bank, rows: SensorRows, rules: SensorRules) -> None:
    """Update the filter and all subsets that have begun, but the blind one, in place."""
    dx, n = np.zeros(len(state.x)), len(state.x)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 1 and s != rules.blind:
            _update_one(bank.P[s], bank.offset[s], rows, rules)
    _update_one(state.P, dx, rows, rules)
    apply(state.R, state.t, state.x, dx)
    for s in range(len(bank.begun)):
        if bank.begun[s] == 1:
            for i in range(n):
                bank.offset[s, i] -= dx[i]


@part
def _update_one(P: Array, off: Array, rows: SensorRows, rules: SensorRules) -> None:
    """Update one covariance `P` (n, n), and how far its state is `off` (n,) the one of linearisation."""
    n, (columns, H, residual, var) = len(P), rows
    g = np.empty(n)
    for k in range(len(residual)):
        for j in range(n):
            g[j] = 0.0
        r, S = residual[k], var[k]
        for c in range(len(columns)):
            h = H[k, c]
            r -= h * off[columns[c]]
            if h != 0.0:
                for j in range(n):
                    g[j] += h * P[columns[c], j]
        for c in range(len(columns)):
            S += H[k, c] * g[columns[c]]
        for i in range(n):
            considered = rules.first <= i < rules.last
            if not considered:
                off[i] += g[i] * r / S
            a = g[i] / S
            for j in range(n):
                if not considered or j < rules.first or j >= rules.last:
                    P[i, j] -= a * g[j]
