"""One candidate measured in a window of its own: where it ends, and whether it is a spot at all."""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import constant, fields, patch, peaks, samples, tiles
from lumidock._kernels.describe import FILTER_PX, describe, index, peak_value, small_snr
from lumidock._kernels.patch import Window
from lumidock.datatypes import Array, Image, Indices

LEVELS = (0.5, 0.7, 0.85, 0.95)  # shares of the peak at which a spot is cut out, until it is round and alone
_MAX_TILES = 20  # a light is not wider
_ROUNDS = 4
_ONLY_MARK = constant(1)
_QUICK = 1.45  # sigmas of noise that 3 x 3 pixels must clear; a light worth having clears 1.8
# share of a peak's height that a lens that blurs by 0.65 px, 1 sigma, gives the pixels around it; on a mosaic those of
# other colours get a quarter of it from a lamp of one colour
_AROUND, _AROUND_OF_MOSAIC = 0.24, 0.06
_MOST_SHARED = 36.0  # samples over which noise is the same; more is a texture
_LEAST_STEP = 30.0  # levels by which a saturated light stands out in the plane that shows it best


@njit(error_model="numpy")
def measure(
    image: Image,
    planes: int,
    scale: float,
    peak: Image,
    i: int,
    j: int,
    v: int,
    u: int,
    p: int,
    level: Array,
    noise: float,
    shared_by_plane: Array,
    q: Array,
    window: Window,
    seen: Image,
    spots: Array,
    n: int,
) -> int:
    """Measure the spot of one candidate tile into `spots[n]`: 1 if there is one, 0 if not, -1 if that was cheap."""
    weight, where, start = np.zeros(4), np.zeros(7), np.zeros(2, np.int64)
    radius, clipped = 0.0, scale * peak[:, i, j].max() >= q[fields.CLIPPED]
    if clipped:
        radius = samples.weigh_clipped(image, planes, scale, v, u, _LEAST_STEP, q[fields.MAX_RADIUS_PX], weight)
        if radius == 0.0:
            return -1
    else:
        radius = min(_extent(peak, i, j, level), q[fields.MAX_RADIUS_PX])
        sigma = noise * np.sqrt(shared_by_plane[p])
        plane, small, ring = p + (p == 2 and planes == 4), radius < tiles.TILE_PX, max(radius, q[fields.RING_PX])
        if not samples.stands_out(image, planes, scale, plane, v, u, ring, sigma, _QUICK, small):
            return -1
        samples.weigh(image, planes, scale, v, u, radius, weight)
    shared = samples.mean_by_square(weight, shared_by_plane)
    expected = noise * np.sqrt(samples.square(weight))
    reach = min(max(3.5 * radius, 1.5 * q[fields.RING_PX]), 3.5 * q[fields.MAX_RADIUS_PX])
    # of the surroundings: level, noise, texture that hides a spot, texture that moves it, how far noise is shared, and
    # the noise that shows
    part, ground = 0.0, np.zeros(6)
    for turn in range(_ROUNDS):
        patch.cut(image, planes, scale, weight, v, u, reach, patch.COARSE_SIDE, window[0], where)
        start[0], start[1] = index(u, where[0], where[2], where[3]), index(v, where[1], where[2], where[4])
        ring = 0.9 * reach / where[patch.UNIT]
        ground[0], spread, uneven = patch.flatten(window[0], where, float(start[0]), float(start[1]), ring)
        ground[5] = patch.rim_noise(window[0], where)
        ground[1] = max(ground[5], 0.5 * expected, q[fields.MIN_NOISE] * expected / noise)
        ground[2] = 0.0 if clipped else np.sqrt(max(spread**2 - 2.0 * ground[1] ** 2, 0.0))
        ground[3] = np.sqrt(max(uneven**2 - 2.0 * ground[1] ** 2, 0.0))
        if turn == 0 and not clipped:
            width = max(FILTER_PX / where[patch.UNIT], 0.7)
            if (
                small_snr(window[0], where, float(start[0]), float(start[1]), width, ground, shared)
                < 0.5 * q[fields.MIN_SNR]
            ):
                return -1
        if clipped:
            patch.smooth(window[0], where)
        part = _level(image, planes, window, where, start, ground[0], q, spots, n)
        sums = window[3]
        if part == 0.0:
            if not clipped:
                _own(seen, window, where, start)
                return 0
            if sums[patch.OPEN] == 0.0 or reach >= 3.5 * q[fields.MAX_RADIUS_PX]:
                _own_plateau(image, planes, scale, weight, v, u, reach, q, window, where, start, seen)
                return 0
            reach = min(2.0 * reach, 3.5 * q[fields.MAX_RADIUS_PX])
            continue
        found = np.sqrt(sums[patch.N] / np.pi) * where[patch.UNIT]
        wanted = min(max(3.5 * found, 1.5 * q[fields.RING_PX]), 3.5 * q[fields.MAX_RADIUS_PX])
        if 0.6 * reach <= wanted <= 1.25 * reach or turn == _ROUNDS - 1:
            break
        reach = wanted
    if part == 0.0:
        return 0
    if np.sqrt(sums[patch.N] / np.pi) * where[patch.UNIT] > q[fields.MAX_RADIUS_PX]:  # lights may stand in its halo
        _own_plateau(image, planes, scale, weight, v, u, reach, q, window, where, start, seen)
        return 0
    _own(seen, window, where, start)
    ground[4] = samples.mean_by_square(weight, shared_by_plane**2)
    if planes == 3:  # in the sum of channels fine noise is what JPEG leaves, and coarse noise that of the sensor
        ground[4] = min(max(ground[4] * (expected / ground[1]) ** 2, 1.0), _MOST_SHARED)
    spots[n, fields.CORE] = 0.0
    for k in range(planes):
        spots[n, fields.CORE] += samples.core_mean(image, planes, scale, k, v, u) / planes
    spots[n, fields.BY_LENS] = np.inf
    if planes != 3 and not clipped and radius <= tiles.TILE_PX:  # colour is spread by demosaicing, by the lens or not
        share = _AROUND if planes == 1 else _AROUND_OF_MOSAIC
        spots[n, fields.BY_LENS] = samples.log_lens_over_bad_pixel(
            image, planes, scale, v, u, q[fields.RING_PX], share, noise
        )
    return int(describe(image, planes, scale, weight, window, where, start, u, v, part, ground, shared, q, spots, n))


@njit(error_model="numpy")
def _extent(peak: Image, i: int, j: int, level: Array) -> float:
    """Radius px that the tiles give a spot at half height: of its narrower side, half a tile at least.

    In the plane in which it stands out most, over the background or what is left of it on the halo of something larger.
    """
    p, most = 0, -1e9
    for k in range(len(peak)):
        over = float(peak[k, i, j]) - level[k, i // tiles.BLOCK, j // tiles.BLOCK]
        if over > most:
            p, most = k, over
    step = 0
    for far in (4, 8, 16):
        step = max(step, peaks.over_pairs(peak[p], i, j, far))
    half = float(peak[p, i, j]) - 0.5 * min(most, 0.5 * step)
    width, height = 1, 1
    for step in (-1, 1):
        k = 1
        while k < _MAX_TILES and 0 <= j + step * k < peak.shape[2] and peak[p, i, j + step * k] > half:
            k += 1
        width += k - 1
        k = 1
        while k < _MAX_TILES and 0 <= i + step * k < peak.shape[1] and peak[p, i + step * k, j] > half:
            k += 1
        height += k - 1
    return 0.5 * tiles.TILE_PX * min(width, height)


@njit(error_model="numpy")
def _level(
    image: Image,
    planes: int,
    window: Window,
    where: Array,
    start: Indices,
    floor: float,
    q: Array,
    spots: Array,
    n: int,
) -> float:
    """Grow the spot at the lowest share of its peak where it is round and alone.

    If it is round nowhere, at the lowest where it is alone. Returns the share, 0 where the spot is never alone. A
    saturated core in one plane is swollen at half height by its halo, which no colour tells apart: there the lowest
    share is left out.
    """
    top = peak_value(window[0], where, start)
    window[1][:] = 0
    first = 1 if planes == 1 and top >= q[fields.CLIPPED] else 0
    fallback = 0.0
    if top <= floor:
        patch.take_all(window[3], where)
        return 0.0
    for k in range(first, len(LEVELS) + 1):
        again = k == len(LEVELS)
        if again and fallback == 0.0:
            return 0.0
        share = fallback if again else LEVELS[k]
        patch.grow(window, where, image, start[0], start[1], floor + share * (top - floor), q[fields.CLIPPED], k + 1)
        sums = window[3]
        if _holds_another(window[1], where, k + 1, spots, n):
            sums[patch.OPEN] = 0.0  # a wider window does not help
            continue
        if sums[patch.OPEN] > 0.0:
            continue
        elongation, fill = patch.shape(sums)
        if again or sums[patch.N] < 12.0 or (elongation > q[fields.MIN_ELONGATION] and fill > q[fields.MIN_FILL]):
            return share
        if fallback == 0.0:
            fallback = share
    return 0.0


@njit(error_model="numpy")
def _holds_another(stamp: Image, where: Array, mark: int, spots: Array, n: int) -> bool:
    """Whether the grown region covers the centre of a spot found before."""
    for k in range(n):
        x = int((spots[k, fields.U] - where[patch.LEFT]) / where[patch.UNIT] + 0.5)
        y = int((spots[k, fields.V] - where[patch.TOP]) / where[patch.UNIT] + 0.5)
        if 0 <= x < where[patch.COLUMNS] and 0 <= y < where[patch.ROWS] and stamp[y, x] == mark:
            return True
    return False


@njit(error_model="numpy")
def _own(seen: Image, window: Window, where: Array, start: Indices) -> None:
    """Mark the tiles that the grown region touches: nobody looks there again."""
    stamp, sums, t = window[1], window[3], tiles.TILE_PX
    mark, unit, columns = stamp[start[1], start[0]], int(where[patch.UNIT]), int(sums[patch.LAST_COLUMN]) + 1
    for y in range(int(sums[patch.FIRST_ROW]), int(sums[patch.LAST_ROW]) + 1):
        line, x = stamp[y], int(sums[patch.FIRST_COLUMN])
        top = int(where[patch.TOP]) + y * unit
        last_row = min((top + unit - 1) // t + 1, seen.shape[0])
        while x < columns:
            if line[x] != mark:
                x += 1
                continue
            first = x
            while x < columns and line[x] == mark:
                x += 1
            left, right = int(where[patch.LEFT]) + first * unit, int(where[patch.LEFT]) + x * unit - 1
            for i in range(top // t, last_row):
                seen[i, left // t : min(right // t + 1, seen.shape[1])] = 1


@njit(error_model="numpy")
def _own_plateau(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    v: int,
    u: int,
    reach: float,
    q: Array,
    window: Window,
    where: Array,
    start: Indices,
    seen: Image,
) -> None:
    """Mark the tiles of what is too large to be a light, as far as it is as bright as here in every plane."""
    darkest, bright = 0, np.zeros(4)
    for p in range(planes):
        bright[p] = LEVELS[-1] * samples.core_mean(image, planes, scale, p, v, u)
        if bright[p] <= bright[darkest]:
            darkest = p
    weight[:] = 0.0
    weight[darkest] = 1.0
    patch.cut(image, planes, scale, weight, v, u, reach, patch.COARSE_SIDE, window[0], where)
    start[0], start[1] = index(u, where[0], where[2], where[3]), index(v, where[1], where[2], where[4])
    stamp, sums, unit = window[1], window[3], int(where[patch.UNIT])
    stamp[:] = 0
    patch.grow(window, where, image, start[0], start[1], bright[darkest], q[fields.CLIPPED], _ONLY_MARK)
    for i in range(int(sums[patch.FIRST_ROW]), int(sums[patch.LAST_ROW]) + 1):
        for j in range(int(sums[patch.FIRST_COLUMN]), int(sums[patch.LAST_COLUMN]) + 1):
            y, x = int(where[patch.TOP]) + i * unit, int(where[patch.LEFT]) + j * unit
            for p in range(planes):
                if (i != start[1] or j != start[0]) and scale * samples.sample(image, planes, p, y, x) < bright[p]:
                    stamp[i, j] = 0
    _own(seen, window, where, start)
