"""One detection per light: the sharpest of the blobs that one light makes over planes and scales."""

from __future__ import annotations

import math

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.detection.blobs import HEIGHT, PLANE, SIZE, U, V
from lumidock.datatypes import Array, Indices

_ON_BORDER = 0.3  # of its size from the border, within which a blob may be merged with its mirror image
_NEAR, _NEAR_ON_BORDER = 0.7, 1.5  # of the strongest blob's size, within which a more precise one may be its core
_SAME_CORE = 0.5  # of its size, within which blobs of other planes may be the same core
_ALIKE = 2.1  # ratio of two sizes, one octave, up to which blobs of two planes may be one core


@entry
def strongest(
    blobs: Array, edge: Array, order: Indices, reach: float, wide: float, texture: float, kept: Array
) -> None:
    """Mark in `kept` (N,) the blobs that stand for themselves in their own plane.

    A stronger blob of the same plane takes those within `reach` times the larger of the two sizes; one more than `wide`
    times as large takes only what is less than `texture` of its height, so that cores in a common halo stay apart. One
    that stands on the border takes none that does not: it is a light and its own mirror image. `edge` (N,) px is the
    distance from the border.
    """
    n = len(blobs)
    for a in range(n):
        k = order[a]
        if not kept[k]:
            continue
        for b in range(a + 1, n):
            m = order[b]
            if not kept[m] or blobs[m, PLANE] != blobs[k, PLANE]:
                continue
            away = math.hypot(blobs[m, U] - blobs[k, U], blobs[m, V] - blobs[k, V])
            if away >= reach * max(blobs[k, SIZE], blobs[m, SIZE]):
                continue
            inside = blobs[k, SIZE] > wide * blobs[m, SIZE] and away >= reach * blobs[m, SIZE]
            if edge[k] < _ON_BORDER * blobs[k, SIZE] and edge[m] >= _ON_BORDER * blobs[m, SIZE]:
                continue
            if not inside or blobs[m, HEIGHT] < texture * blobs[k, HEIGHT]:
                kept[m] = False


@entry
def group(
    blobs: Array,
    edge: Array,
    var: Array,
    order: Indices,
    share: float,
    reach: float,
    best: Indices,
    partner: Indices,
) -> int:
    """Write the index of the blob that stands for each light to `best`; returns how many lights there are.

    `blobs` (N, columns of `blobs`), `var` (N,) px^2 of their centroids, `order` (N,) by falling height. The strongest
    blob that is left looks near its centre for the most precise one of at least `share` of its height;
    whatever overlaps that one, and what is weaker around the strongest, belongs to the same light. `partner` (N, 4):
    the blob of each plane that shows the same core as the best one, -1 where there is none.
    """
    n, count = len(blobs), 0
    left = [True] * n
    for k in order:
        if not left[k]:
            continue
        strong, a = blobs[k], k
        near = _NEAR if edge[k] >= _ON_BORDER * strong[SIZE] else _NEAR_ON_BORDER
        for m in order:
            away = math.hypot(blobs[m, U] - strong[U], blobs[m, V] - strong[V])
            if left[m] and away < near * strong[SIZE] and blobs[m, HEIGHT] >= share * strong[HEIGHT]:
                a = m if var[m] < var[a] else a
        best[count] = a
        _find_partners(blobs, var, a, share, partner[count])
        count += 1
        for m in range(n):
            if left[m]:
                to_best = math.hypot(blobs[m, U] - blobs[a, U], blobs[m, V] - blobs[a, V])
                to_strong = math.hypot(blobs[m, U] - strong[U], blobs[m, V] - strong[V])
                same = to_best < reach * max(blobs[m, SIZE], blobs[a, SIZE])
                weak = blobs[m, HEIGHT] < share * strong[HEIGHT]
                left[m] = not (same or (weak and to_strong < reach * strong[SIZE]))
        left[k] = False
    return count


@part
def _find_partners(blobs: Array, var: Array, a: int, share: float, partner: Indices) -> None:
    """Write the most precise blob of each plane, within half a size of blob `a` and alike in size and height."""
    partner[:] = -1
    for m in range(len(blobs)):
        p = int(blobs[m, PLANE])
        away = math.hypot(blobs[m, U] - blobs[a, U], blobs[m, V] - blobs[a, V])
        alike = max(blobs[m, SIZE], blobs[a, SIZE]) < _ALIKE * min(blobs[m, SIZE], blobs[a, SIZE])
        if (
            alike
            and away < _SAME_CORE * blobs[a, SIZE]
            and blobs[m, HEIGHT] >= share * blobs[a, HEIGHT]
            and (partner[p] < 0 or var[m] < var[partner[p]])
        ):
            partner[p] = m
