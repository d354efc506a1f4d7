"""How much what was found looks like a lamp: soft, so that geometry can overrule it."""

from __future__ import annotations

import numpy as np

from lumidock._kernels import fields, inner
from lumidock.datatypes import Array

_LOG_BAD_PIXEL = -2.3  # prior log odds that a small spot is a bad pixel


@inner
def lamp_probability(spot: Array, q: Array) -> float:
    """Probability of being a lamp, from contrast, shape, size and blur: soft, so that geometry can overrule it."""
    radius = spot[fields.RADIUS]
    seen = _logistic(spot[fields.SNR] - 8.5)
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


@inner
def _logistic(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-x)))


@inner
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
            halo = m < k and spots[k, fields.SATURATED] > 0.0 and spots[k, fields.CORE] < 0.9 * spots[m, fields.CORE]
            if m != k and near and (weaker or halo) and before[m] > q[fields.GLINT_TRUST] * before[k]:
                spots[k, fields.P_LIGHT] = max(0.1 * before[k], 0.02)
                break


@inner
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
