"""The tiles that may hold the peak of a light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import part
from lumidock._kernels.detection.tiles import BLOCK
from lumidock.datatypes import Array, Image, Indices

_NEARLY = 1.0 - 1e-9  # of a margin that rounding may not raise
_BESIDE, _FAR = 1, 4  # tiles at which the slopes of a wide light show
_HALO = 40.0  # sigmas over the background that only the halo of something bright reaches beside its peak


@part
def candidates(
    peak: Image,
    level: Array,
    sigma: Array,
    spread: float,
    shot: float,
    contrast: float,
    clipped: float,
    together: Image,
    rect: Indices,
    scratch: tuple[tuple[NDArray[np.int32], NDArray[np.int32]], Image],
    seen: Image,
    found: Array,
) -> int:
    """Write the tiles of `rect` that may hold a light's peak to `found`: row, column, sigmas over the background.

    Of one plane: `peak` (h, w), `level` of its blocks, and `spread` times `sigma` for its noise. Such a tile clears its
    background by `contrast` sigmas; no two neighbours on opposite sides are brighter together, as on a slope, and next
    to it or a few tiles away they are darker by a margin, as on a halo they are not; on a bright one its noise has
    `shot`, a variance per value, on top. A tile that with all around it is saturated in the maps that count `together`
    (Q, h, w) is left to those at the region's rim; so are tiles that are `seen` (h, w), and the others become it.
    Returns how many there are. `scratch`: of a row of tiles, see `tiles.Map`.
    """
    n, count, (least, margin), worth = rect[3] - rect[2], 0, scratch[0], scratch[1]
    eight = worth.view(np.uint64)[: (n + 7) // 8]  # most are 0
    worth[: 8 * len(eight)] = 0
    for i in range(rect[0], rect[1]):
        b = i // BLOCK
        if i == rect[0] or i % BLOCK == 0:
            for k in range(rect[2] // BLOCK, (rect[3] + BLOCK - 1) // BLOCK):
                value = int(min(np.ceil(level[b, k] + contrast * spread * sigma[b, k]), clipped))
                rise = max(int(_NEARLY * 1.5 * contrast * spread * sigma[b, k]), 2)
                for j in range(max(k * BLOCK, rect[2]), min((k + 1) * BLOCK, rect[3])):
                    least[j], margin[j] = value, rise
        if not _worth_a_look(peak, i, least, margin, int(clipped), rect[2], rect[3], worth):
            continue
        for piece in range(len(eight)):
            if not eight[piece]:
                continue
            for j in range(rect[2] + 8 * piece, min(rect[2] + 8 * piece + 8, rect[3])):
                if not worth[j - rect[2]] or seen[i, j] or count == len(found):
                    continue
                if peak[i, j] >= clipped and _is_inner(together, i, j, int(clipped)):
                    continue
                here, over = spread * sigma[b, j // BLOCK], peak[i, j] - level[b, j // BLOCK]
                if not _rises(peak, i, j, margin[j], int(clipped)):
                    continue
                local = np.sqrt(here * here + shot * max(over - _HALO * here, 0.0))
                if not _stands_out(peak, i, j, max(int(1.5 * contrast * local), 2), int(clipped)):
                    continue
                seen[i, j] = 1
                found[count, 0], found[count, 1] = i, j
                found[count, 2] = over / here
                count += 1
    return count


@part
def _worth_a_look(
    peak: Image, i: int, least: Image, margin: Image, clipped: int, first: int, last: int, worth: Image
) -> bool:
    """Mark the tiles of a part of a row that reach the `least` value and stand on no slope; whether any reach it.

    And, where many do, rise over their row by the `margin`.
    """
    here, limit, mark = peak[i, first:last], least[first:last], worth[: last - first]
    total = np.int32(0)
    for x in range(len(here)):
        reached = np.int32(here[x]) >= limit[x]
        mark[x] = reached
        total += reached
    if total == 0:
        return False
    above, below = peak[max(i - 1, 0), first:last], peak[min(i + 1, len(peak) - 1), first:last]
    total = np.int32(0)
    for x in range(1, len(here) - 1):
        most = max(np.int32(here[x - 1]) + np.int32(here[x + 1]), np.int32(above[x]) + np.int32(below[x]))
        most = max(most, np.int32(above[x - 1]) + np.int32(below[x + 1]))
        most = max(most, np.int32(above[x + 1]) + np.int32(below[x - 1]))
        mark[x] &= np.int32(2) * np.int32(here[x]) >= most
        total += mark[x]
    if 8 * total > len(here):  # in a halo many are left, which would be looked at one by one
        _drop_flat(here, margin[first:last], np.int32(clipped), mark)
    return True


@part
def _drop_flat(here: Image, margin: Image, clipped: np.int32, mark: Image) -> None:
    """Leave only those marks of a row that rise by the `margin`, see `_rises`, or are too near its end to tell."""
    for x in range(_FAR, len(here) - _FAR):
        twice = np.int32(2) * np.int32(here[x])
        beside = twice - np.int32(here[x - 1]) - np.int32(here[x + 1]) >= margin[x]
        far = twice - np.int32(here[x - _FAR]) - np.int32(here[x + _FAR]) >= margin[x]
        mark[x] &= beside | far | (np.int32(here[x]) >= clipped)


@part
def _stands_out(peak: Image, i: int, j: int, margin: int, clipped: int) -> bool:
    """Whether a tile is neither on a slope nor on a halo, see `candidates`."""
    if not _rises(peak, i, j, margin, clipped):
        return False
    near = over_pairs(peak, i, j, _BESIDE)
    if near < 0:
        return False
    if peak[i, j] >= clipped or near >= margin:
        return True
    for d in range(_BESIDE + 1, _FAR):  # the top of a wide light, and not every bump on its flanks
        if over_pairs(peak, i, j, d) < 0:
            return False
    return over_pairs(peak, i, j, _FAR) >= margin


@part
def _rises(peak: Image, i: int, j: int, margin: int, clipped: int) -> bool:
    """Whether a tile stands out along its row, next to it or a few tiles away: it settles most."""
    w, twice = peak.shape[1], 2 * int(peak[i, j])
    near = twice - int(peak[i, max(j - 1, 0)]) - int(peak[i, min(j + 1, w - 1)])
    if near < 0 or near >= margin or twice >= 2 * clipped:
        return near >= 0
    return twice - int(peak[i, max(j - _FAR, 0)]) - int(peak[i, min(j + _FAR, w - 1)]) >= margin


@part
def _is_inner(together: Image, i: int, j: int, clipped: int) -> bool:
    """Whether a tile and all around it are saturated in every map."""
    _, h, w = together.shape
    if i == 0 or j == 0 or i == h - 1 or j == w - 1:
        return False
    for q in range(len(together)):
        least = together[q, i, j]
        for y in range(i - 1, i + 2):
            least = min(least, min(together[q, y, j - 1], min(together[q, y, j], together[q, y, j + 1])))
        if least < clipped:
            return False
    return True


@part
def over_pairs(peak: Image, i: int, j: int, d: int) -> int:
    """Twice the value of a tile less that of two on opposite sides, `d` tiles away, the least of four ways."""
    h, w = peak.shape
    top, bottom, left, right = max(i - d, 0), min(i + d, h - 1), max(j - d, 0), min(j + d, w - 1)
    most = max(
        max(int(peak[top, j]) + int(peak[bottom, j]), int(peak[i, left]) + int(peak[i, right])),
        max(int(peak[top, left]) + int(peak[bottom, right]), int(peak[top, right]) + int(peak[bottom, left])),
    )
    return 2 * int(peak[i, j]) - most


@part
def largest(peak: Image, i: int, j: int) -> int:
    """The largest value of a tile in any map."""
    most = int(peak[0, i, j])
    for p in range(1, len(peak)):
        most = max(most, int(peak[p, i, j]))
    return most
