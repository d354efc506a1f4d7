"""How easily the lights of a layer are confused: the wrong assignment that fits a view best, and how badly it fits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from lumidock.datatypes import Array

_Complex = NDArray[np.complex128]
_SCALE = (0.5, 2.0)  # a layer seen at half or double its size means a range that is wrong by as much, which is noticed
CONFUSED_WITHIN_RAD = math.radians(15.0)  # roll of a vehicle that its own attitude sensor would not notice
CONFUSION_AT_M = 18.0  # range from which lights are compared, and at which a misfit is given in pixels


@dataclass(frozen=True, slots=True)
class Confusion:
    """A wrong assignment: the lights `seen` are taken for the lights `taken_for`, with this RMS residual in metres."""

    residual_m: float
    seen: tuple[int, ...] = ()
    taken_for: tuple[int, ...] = ()


def worst_confusion(
    p_dock: Array, *, seen: int, max_roll_rad: float = CONFUSED_WITHIN_RAD, mirrored: bool = False
) -> Confusion:
    """The best-fitting wrong assignment of any `seen` lights of `p_dock` (N, 3); lights are indices into it.

    The view is the frontal one (depth dropped); an assignment may be fitted by any shift, a scale of 0.5-2 and a roll
    of up to `max_roll_rad`. With `mirrored` the lights are seen as a mirror image in the water surface or a wall, where
    every assignment is wrong.

    Source: the closed-form similarity of S. Umeyama, 1991, in complex numbers.
    """
    z = p_dock[:, 0] + 1j * p_dock[:, 1]
    assignments = np.array(list(permutations(range(len(z)), seen)))
    worst = Confusion(np.inf)
    for subset in combinations(range(len(z)), seen):
        wrong = assignments if mirrored else assignments[(assignments != np.array(subset)).any(axis=1)]
        observed = z[list(subset)]
        for view in (observed.conj(), -observed.conj()) if mirrored else (observed,):
            residuals = _residuals(z[wrong], view, max_roll_rad)
            best = int(residuals.argmin())
            if residuals[best] < worst.residual_m:
                worst = Confusion(float(residuals[best]), subset, tuple(wrong[best].tolist()))
    return worst


def apparent(p_dock: Array) -> Array:
    """Lights (N, 3) where they seem to stand in the plane of the nearest, seen from `CONFUSION_AT_M` before it."""
    behind = p_dock[:, 2:].max() - p_dock[:, 2:]
    return np.asarray(p_dock * (CONFUSION_AT_M / (CONFUSION_AT_M + behind)))


def _residuals(assigned: _Complex, observed: _Complex, max_roll: float) -> Array:
    """RMS of |a w + b - z| for each row w of `assigned` (M, K) against `observed` z (K,), at the best allowed a, b."""
    w = assigned - assigned.mean(axis=1, keepdims=True)
    z = observed - observed.mean()
    power = (np.abs(w) ** 2).sum(axis=1)
    cross = (w.conj() * z).sum(axis=1)
    roll = np.clip(np.angle(cross), -max_roll, max_roll)
    along = (cross * np.exp(-1j * roll)).real
    scale = np.clip(along / np.maximum(power, np.finfo(float).tiny), *_SCALE)  # power 0: all in one line of sight
    squares = (np.abs(z) ** 2).sum() - 2.0 * scale * along + scale**2 * power
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / len(z)))
