"""How much what was found looks like a lamp: soft, so that geometry can overrule it."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.detection import fields
from lumidock.datatypes import Array

_LOG_BAD_PIXEL = -2.3  # prior log odds that a small spot is a bad pixel
_USUAL_SNR = 8.5  # at which half of the lamps are found
_STEADY = 5.0  # odds of a lamp for a spot that was there before: nearly all lamps were, one in five of the rest
_STEADY_FLUX = 0.3  # 1 sigma of the logarithm of a lamp's flux from frame to frame
_APPEARS, _NEW = 0.05, 0.7  # share of the lamps, and of all else, that were not there in the frame before


@part
def lamp_probability(spot: Array, q: Array) -> float:
    """Probability of being a lamp, from contrast, shape, size and blur: soft, so that geometry can overrule it."""
    radius = spot[fields.RADIUS]
    seen = _logistic(spot[fields.SNR] - _USUAL_SNR)
    small = np.exp(-radius / 3.0)  # the outline of a small spot says little of its shape
    round_ = _logistic((spot[fields.ELONGATION] - 0.5) / 0.06)
    full = _logistic((spot[fields.FILL] - 0.75) / 0.04)
    shape = small + (1.0 - small) * round_ * full
    largest = q[fields.MAX_RADIUS_PX]
    size = _logistic((0.5 * largest - radius) / (0.1 * largest)) * _logistic((radius - q[fields.MIN_RADIUS_PX]) / 0.1)
    usual = 0.7 if spot[fields.SATURATED] > 0.0 else 0.5
    alone = 1.0 - 2.0 * max(spot[fields.LEVEL] - usual, 0.0)
    blurred = _logistic(min(spot[fields.BY_LENS], 50.0) - _LOG_BAD_PIXEL)
    return float(min(max(seen * shape * size * alone * blurred, 0.02), 0.98))


@part
def _logistic(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-x)))


@part
def weigh_steadiness(spots: Array, n: int, past: Array, reach_px: float, saw_all: bool) -> None:
    """Make more of spots that were there in the frame before, and less of those that were not if it was all looked at.

    `past` (m, 4): its spots; only of one within `reach_px` and of much the same flux is a spot the continuation. A
    faint lamp may have been missed.
    """
    for k in range(n):
        steady = 0.0
        for m in range(len(past)):
            du, dv = spots[k, fields.U] - past[m, fields.U], spots[k, fields.V] - past[m, fields.V]
            if abs(du) < reach_px and abs(dv) < reach_px and min(spots[k, fields.FLUX], past[m, fields.FLUX]) > 0.0:
                change = np.log(spots[k, fields.FLUX] / past[m, fields.FLUX]) / _STEADY_FLUX
                steady = max(steady, np.exp(-0.5 * change * change))
        missed = max(1.0 - _logistic(spots[k, fields.SNR] - _USUAL_SNR), _APPEARS)
        new = min(missed / _NEW, 1.0) if saw_all else 1.0
        odds = (new + (_STEADY - new) * steady) * spots[k, fields.P_LIGHT] / (1.0 - spots[k, fields.P_LIGHT])
        spots[k, fields.P_LIGHT] = min(max(odds / (1.0 + odds), 0.02), 0.98)


@part
def dim_glints(spots: Array, n: int, q: Array, before: Array) -> None:
    """Make little of a spot near a much stronger one that may be a lamp: its reflection on the frame beside it.

    `before` (n,): scratch.
    """
    for k in range(n):
        before[k] = spots[k, fields.P_LIGHT]
    for k in range(n):
        for m in range(n):
            du, dv = spots[k, fields.U] - spots[m, fields.U], spots[k, fields.V] - spots[m, fields.V]
            reach = q[fields.GLINT_RADII] * spots[m, fields.RADIUS]
            near = abs(du) < reach and abs(dv) < reach and np.hypot(du, dv) < reach
            weaker = (
                spots[m, fields.FLUX] > q[fields.GLINT_RATIO] * spots[k, fields.FLUX]
                and spots[m, fields.CORE] > 0.9 * spots[k, fields.CORE]
            )
            halo = m < k and spots[k, fields.CORE] < 0.9 * spots[m, fields.CORE]
            halo &= spots[k, fields.SATURATED] > 0.0 or np.hypot(du, dv) < spots[k, fields.RADIUS]
            if m != k and near and (weaker or halo) and before[m] > q[fields.GLINT_TRUST] * before[k]:
                spots[k, fields.P_LIGHT] = 0.02 if halo else max(0.1 * before[k], 0.02)
                break


@part
def dim_small_fry(spots: Array, n: int, q: Array, before: Array) -> None:
    """Make less of spots that are many of a kind, or faint beside the lamps in view.

    A dock has a dozen or two lamps, of fluxes within a few hundred of each other; a wall or a cloud of snow has crowds.
    `before` (n,): scratch.
    """
    for k in range(n):
        before[k] = spots[k, fields.P_LIGHT]
    brightest = 0.0
    for k in range(n):
        if before[k] > 0.5:
            brightest = max(brightest, spots[k, fields.FLUX])
    for k in range(n):
        alike = 0.0
        for m in range(n):
            if q[fields.KIN] * spots[m, fields.FLUX] > spots[k, fields.FLUX] > spots[m, fields.FLUX] / q[fields.KIN]:
                alike += before[m]
        crowd = 1.0
        if spots[k, fields.FLUX] < q[fields.PROMINENT] * brightest:
            crowd = min(1.0, q[fields.LAMPS] / max(alike, 1.0))
        dim = 1.0
        if brightest > 0.0 and spots[k, fields.FLUX] > 0.0:
            dim = _logistic(np.log(spots[k, fields.FLUX] * q[fields.RANGE] / brightest))
        spots[k, fields.P_LIGHT] = max(before[k] * crowd * dim, 0.02)
