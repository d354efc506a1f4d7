"""How well a layer's lights can be told apart: the wrong naming that fits the view best, and by how much it misses."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from lumidock.datatypes import Array

_Complex = NDArray[np.complex128]
_SCALE = (
    0.5,
    2.0,
)  # a layer seen at half or double its true size is a wrong range that the approach excludes


def worst_confusion(
    p_dock: Array, *, seen: int, max_roll_rad: float = np.deg2rad(15.0), mirrored: bool = False
) -> float:
    """RMS residual in metres of the best-fitting wrong naming of any `seen` lights of `p_dock` (N, 3).

    The view is the frontal one (depth dropped) and a naming may be helped by any shift, scale of 0.5-2 and roll up to
    `max_roll_rad`. With `mirrored` the lights are seen in the water surface or in a wall, where every naming is wrong.

    Source: the closed-form similarity of S. Umeyama, 1991, in complex numbers.
    """
    z = p_dock[:, 0] + 1j * p_dock[:, 1]
    names = np.array(list(permutations(range(len(z)), seen)))
    worst = np.inf
    for subset in combinations(range(len(z)), seen):
        wrong = names if mirrored else names[(names != np.array(subset)).any(axis=1)]
        observed = z[list(subset)]
        views = (observed.conj(), -observed.conj()) if mirrored else (observed,)
        worst = min(worst, *(float(_residuals(z[wrong], view, max_roll_rad).min()) for view in views))
    return worst


def _residuals(named: _Complex, observed: _Complex, max_roll: float) -> Array:
    """RMS of |a w + b - z| for each row w of `named` (M, K) against `observed` z (K,), at the best allowed a, b."""
    w = named - named.mean(axis=1, keepdims=True)
    z = observed - observed.mean()
    power = (np.abs(w) ** 2).sum(axis=1)
    cross = (w.conj() * z).sum(axis=1)
    roll = np.clip(np.angle(cross), -max_roll, max_roll)
    along = (cross * np.exp(-1j * roll)).real
    scale = np.clip(along / np.maximum(power, np.finfo(float).tiny), *_SCALE)  # power 0: all in one line of sight
    squares = (np.abs(z) ** 2).sum() - 2.0 * scale * along + scale**2 * power
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / len(z)))
