"""The search of the detector: candidate tiles in order of strength, each measured in its own window.

What is found goes to rows of `spots`; the columns are named here. Lengths in pixels, values in 8-bit grey levels.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import patch, tiles
from lumidock._kernels.patch import Window
from lumidock.datatypes import Array, Image, Indices

U, V, RADIUS, FLUX, SNR, ELONGATION, FILL, LEVEL, SATURATED, CUT, HALO, CORE, P_LIGHT, VAR_UU, VAR_UV, VAR_VV = range(
    16
)
COLUMNS = 16
# what may be tuned, see `DetectConfig`
(
    CONTRAST,
    MIN_SNR,
    RING_PX,
    MAX_RADIUS_PX,
    MIN_RADIUS_PX,
    SMALL_PX,
    MIN_ELONGATION,
    MIN_FILL,
    SIGNAL_NOISE,
    FLOOR_PX,
    SATURATED_PX,
    CUT_SHARE,
    GLINT_RADII,
    GLINT_RATIO,
    GLINT_TRUST,
    CLIPPED,
    MIN_NOISE,
    KIN,
    LAMPS,
    RANGE,
    PROMINENT,
    COARSE_PX,
) = range(22)
PARAMETERS = 22
_LEVELS = (0.5, 0.7, 0.85, 0.95)  # shares of the peak at which a spot is cut out, until it is round and alone
_MAX_TILES = 20  # a light is not wider
_FILTER_PX = 1.2  # width of the window that judges a small spot ...
_FILTERED_PX = 3.0  # ... up to this radius
_ROUNDS = 4
_QUICK = 1.45  # sigmas of noise that 3 x 3 pixels must clear; a light worth having clears 1.8
_LEAST_STEP = 30.0  # levels by which a saturated light stands out in the plane that shows it best


@njit(cache=True)
def search(
    image: Image,
    planes: int,
    scale: float,
    peak: Image,
    level: Array,
    sigma: Array,
    spread: Array,
    shared_by_plane: Array,
    rects: Indices,
    most: tuple[int, int],
    q: Array,
    seen: Image,
    found: Array,
    spots: Array,
) -> int:
    """Write the spots of the tiles in `rects` (n, 4) to `spots` (N, COLUMNS), the strongest first; returns how many.

    `image` (H, W, C); `planes` 1, 3 or, for a mosaic, 4; `scale` makes 8-bit levels of its samples. `peak` (P, h, w)
    of its tiles, `level` (P, h, w) and `sigma` (h, w) of its blocks in samples, `spread` (P,), see `tiles`. `most`:
    candidates and measurements.
    """
    count = 0
    clipped = q[CLIPPED] / scale
    contrast = q[CONTRAST] * np.sqrt(shared_by_plane.max())
    for p in range(len(peak)):
        seen[:] = 0  # a tile may hold a light in one plane and noise in another
        for k in range(len(rects)):
            more = tiles.candidates(
                peak[p], level[p], sigma, spread[p], contrast, clipped, rects[k], seen, found[count:]
            )
            found[count : count + more, 4] = p
            count += more
    count = _most_outstanding(found, count, most[0])
    order = _brightest_first(image, planes, found, count)
    seen[:] = 0  # from here on: tiles of spots
    n, work = 0, most[1]
    side = patch.SIDE + 16
    window = (
        np.empty((side, side)),
        np.zeros((side, side), np.int16),
        np.empty((side * side, 2), np.int32),
        np.empty(12),
    )
    for k in order:
        if n == len(spots) or work <= 0:
            break
        i, j = int(found[k, 0]), int(found[k, 1])
        if seen[i, j] or seen[int(found[k, 2]) // tiles.TILE_PX, int(found[k, 3]) // tiles.TILE_PX]:
            continue
        noise = max(scale * sigma[i // tiles.BLOCK, j // tiles.BLOCK], q[MIN_NOISE])
        v, u, p = int(found[k, 2]), int(found[k, 3]), int(found[k, 4])
        status = _measure(
            image, planes, scale, peak, i, j, v, u, p, level, noise, shared_by_plane, q, window, seen, spots, n
        )
        work -= status >= 0
        n += status > 0
    for k in range(n):
        spots[k, P_LIGHT] = _lamp_probability(spots[k], q)
    _dim_glints(spots, n, q)
    _dim_small_fry(spots, n, q)
    return n


@njit(cache=True)
def _most_outstanding(found: Array, count: int, most: int) -> int:
    """Move the `most` candidates that stand out most to the front; returns how many there are."""
    if count <= most:
        return count
    least = np.sort(found[:count, 2])[count - most]
    kept = 0
    for k in range(count):
        if found[k, 2] >= least and kept < most:
            found[kept] = found[k]
            kept += 1
    return kept


@njit(cache=True)
def _brightest_first(image: Image, planes: int, found: Array, count: int) -> Indices:
    """Order of the candidates by their brightest pixel, whose row and column go to columns 2 and 3 of `found`.

    A candidate that has a brighter pixel right beyond its tile's border is no peak and left out.
    """
    key = np.empty(count)
    peaks = 0
    for k in range(count):
        i, j, p = int(found[k, 0]), int(found[k, 1]), int(found[k, 4])
        found[k, 2], found[k, 3], rank = _brightest(image, planes, p, i, j)
        key[k] = -rank
        peaks += rank > 0
    return np.argsort(key, kind="mergesort")[:peaks]


@njit(cache=True)
def _brightest(image: Image, planes: int, p: int, i: int, j: int) -> tuple[int, int, int]:
    """Row, column and rank of a tile's brightest pixel of a map; rank 0 where one next to it is brighter."""
    best, row, column = -1, 0, 0
    top, left = i * tiles.TILE_PX, j * tiles.TILE_PX
    for v in range(top, min(top + tiles.TILE_PX, image.shape[0])):
        for u in range(left, min(left + tiles.TILE_PX, image.shape[1])):
            rank = _rank(image, planes, p, v, u)
            if rank > best:
                best, row, column = rank, v, u
    reach = 2 if planes == 4 else 1
    for v in range(max(row - reach, 0), min(row + reach + 1, image.shape[0])):
        for u in range(max(column - reach, 0), min(column + reach + 1, image.shape[1])):
            if _rank(image, planes, p, v, u) > best:
                return row, column, 0
    for _ in range(2):  # to the middle of a plateau
        row = _middle_of_run(image, planes, p, row, column, 1, 0, best)
        column = _middle_of_run(image, planes, p, row, column, 0, 1, best)
    return row, column, best


@njit(cache=True)
def _middle_of_run(image: Image, planes: int, p: int, v: int, u: int, dv: int, du: int, rank: int) -> int:
    """Row or column in the middle of the run of pixels of at least this rank through a pixel, along one of both."""
    pitch = 2 if planes == 4 else 1
    ends = [0, 0]
    for side in range(2):
        sign = 1 if side else -1
        k = pitch
        while k < 64 * pitch:
            y, x = v + sign * dv * k, u + sign * du * k
            if not (0 <= y < image.shape[0] and 0 <= x < image.shape[1]) or _rank(image, planes, p, y, x) < rank:
                break
            k += pitch
        ends[side] = sign * (k - pitch)
    return (v if dv else u) + (ends[0] + ends[1]) // (2 * pitch) * pitch


@njit(cache=True)
def _rank(image: Image, planes: int, p: int, v: int, u: int) -> int:
    """Order of a pixel in map `p`: by its value there, among equals by all channels, which tell a saturated core."""
    if planes == 1:
        return int(image[v, u, 0])
    if planes == 4:
        return int(image[v, u, 0]) if (v & 1) + (u & 1) == p else -1
    return 1024 * int(image[v, u, p]) + int(image[v, u, 0]) + int(image[v, u, 1]) + int(image[v, u, 2])


@njit(cache=True)
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
        step = max(step, tiles.over_pairs(peak[p], i, j, far))
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


@njit(cache=True)
def _measure(
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
    radius, clipped = 0.0, scale * peak[:, i, j].max() >= q[CLIPPED]
    if clipped:
        radius = patch.weigh_clipped(image, planes, scale, v, u, _LEAST_STEP, q[MAX_RADIUS_PX], weight)
        if radius == 0.0:
            return -1
    else:
        radius = min(_extent(peak, i, j, level), q[MAX_RADIUS_PX])
        sigma = noise * np.sqrt(shared_by_plane[p])
        if radius < tiles.TILE_PX and not patch.stands_out(
            image, planes, scale, p + (p == 2 and planes == 4), v, u, q[RING_PX], sigma, _QUICK
        ):
            return -1
        patch.weigh(image, planes, scale, v, u, radius, weight)
    shared = (weight**2 * shared_by_plane).sum() / (weight**2).sum()
    expected = noise * np.sqrt((weight**2).sum())
    reach = min(max(3.5 * radius, 1.5 * q[RING_PX]), 3.5 * q[MAX_RADIUS_PX])
    part, ground = 0.0, np.zeros(3)  # level, noise and texture of the surroundings
    for turn in range(_ROUNDS):
        patch.cut(image, planes, scale, weight, v, u, reach, patch.COARSE_SIDE, window[0], where)
        start[0], start[1] = _index(u, where[0], where[2], where[3]), _index(v, where[1], where[2], where[4])
        ring = 0.9 * reach / where[patch.UNIT]
        ground[0], spread = patch.flatten(window[0], where, float(start[0]), float(start[1]), ring)
        ground[1] = max(patch.rim_noise(window[0], where), 0.5 * expected, q[MIN_NOISE] * expected / noise)
        ground[2] = 0.0 if clipped else np.sqrt(max(spread**2 - 2.0 * ground[1] ** 2, 0.0))
        if turn == 0 and not clipped:
            width = max(_FILTER_PX / where[patch.UNIT], 0.7)
            if _snr(window[0], where, float(start[0]), float(start[1]), width, ground, shared) < 0.5 * q[MIN_SNR]:
                return -1
        if clipped:
            patch.smooth(window[0], where)
        part = _level(image, planes, window, where, start, ground[0], q, spots, n)
        sums = window[3]
        if part == 0.0:
            if not clipped:
                _own(seen, window[1], where, start)
                return 0
            if sums[patch.OPEN] == 0.0 or reach >= 3.5 * q[MAX_RADIUS_PX]:
                _own_plateau(image, planes, scale, weight, v, u, reach, q, window, where, start, seen)
                return 0
            reach = min(2.0 * reach, 3.5 * q[MAX_RADIUS_PX])
            continue
        found = np.sqrt(sums[patch.N] / np.pi) * where[patch.UNIT]
        wanted = min(max(3.5 * found, 1.5 * q[RING_PX]), 3.5 * q[MAX_RADIUS_PX])
        if 0.6 * reach <= wanted <= 1.25 * reach or turn == _ROUNDS - 1:
            break
        reach = wanted
    if part == 0.0:
        return 0
    _own(seen, window[1], where, start)
    spots[n, CORE] = 0.0
    for p in range(planes):
        spots[n, CORE] += patch.core_mean(image, planes, scale, p, v, u) / planes
    return int(_describe(image, planes, scale, weight, window, where, start, u, v, part, ground, shared, q, spots, n))


@njit(cache=True)
def _snr(part: Array, where: Array, x: float, y: float, width: float, ground: Array, shared: float) -> float:
    """How far a Gaussian window stands out of noise, which averages out in it, and texture, which does not."""
    amplitude, averaged = patch.filtered(part, where, x, y, width, ground[0])
    return float(amplitude / np.sqrt(shared * ground[1] ** 2 / averaged + ground[2] ** 2))


@njit(cache=True)
def _index(x: int, first: float, unit: float, count: float) -> int:
    """Sample of a window that holds pixel `x`."""
    return min(int((x - first) / unit), int(count) - 1)


@njit(cache=True)
def _peak_value(part: Array, where: Array, start: Indices) -> float:
    """Largest sample around the start of a spot."""
    best = -1e9
    for y in range(max(start[1] - 1, 0), min(start[1] + 2, int(where[patch.ROWS]))):
        for x in range(max(start[0] - 1, 0), min(start[0] + 2, int(where[patch.COLUMNS]))):
            if part[y, x] > best:
                best = part[y, x]
                at_x, at_y = x, y
    start[0], start[1] = at_x, at_y
    return best


@njit(cache=True)
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
    top = _peak_value(window[0], where, start)
    window[1][:] = 0
    first = 1 if planes == 1 and top >= q[CLIPPED] else 0
    fallback = 0.0
    if top <= floor:
        return 0.0
    for k in range(first, len(_LEVELS) + 1):
        again = k == len(_LEVELS)
        if again and fallback == 0.0:
            return 0.0
        share = fallback if again else _LEVELS[k]
        patch.grow(window, where, image, start[0], start[1], floor + share * (top - floor), q[CLIPPED], k + 1)
        sums = window[3]
        if _holds_another(window[1], where, k + 1, spots, n):
            sums[patch.OPEN] = 0.0  # a wider window does not help
            continue
        if sums[patch.OPEN] > 0.0:
            continue
        elongation, fill = patch.shape(sums)
        if again or sums[patch.N] < 12.0 or (elongation > q[MIN_ELONGATION] and fill > q[MIN_FILL]):
            return share
        if fallback == 0.0:
            fallback = share
    return 0.0


@njit(cache=True)
def _holds_another(stamp: Image, where: Array, mark: int, spots: Array, n: int) -> bool:
    """Whether the grown region covers the centre of a spot found before."""
    for k in range(n):
        x = int((spots[k, U] - where[patch.LEFT]) / where[patch.UNIT] + 0.5)
        y = int((spots[k, V] - where[patch.TOP]) / where[patch.UNIT] + 0.5)
        if 0 <= x < where[patch.COLUMNS] and 0 <= y < where[patch.ROWS] and stamp[y, x] == mark:
            return True
    return False


@njit(cache=True)
def _describe(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    window: Window,
    where: Array,
    start: Indices,
    u: int,
    v: int,
    share: float,
    ground: Array,
    shared: float,
    q: Array,
    spots: Array,
    n: int,
) -> bool:
    """Fill `spots[n]` from the grown region; False for what is too faint, or a spot that is there already."""
    spot, sums = spots[n], window[3]
    floor, noise = ground[0], ground[1]
    top = window[0][start[1], start[0]]
    level = floor + share * (top - floor)
    unit = where[patch.UNIT]
    area = sums[patch.N]
    radius = np.sqrt(area / np.pi) * unit
    spot[HALO] = _around(window[0], where, start, sums, 2.0, floor) / max(top - floor, 1e-6)
    flux = sums[patch.W] + area * (level - floor)
    snr = flux / (area * np.sqrt(shared * noise**2 / area + ground[2] ** 2))
    if radius < _FILTERED_PX:
        x, y = start[0] + sums[patch.X] / area, start[1] + sums[patch.Y] / area
        snr = _snr(window[0], where, x, y, max(_FILTER_PX / unit, 0.7), ground, shared)
    if snr < q[MIN_SNR]:
        return False
    pitch = 2.0 if planes == 4 else 1.0
    spot[RADIUS], spot[FLUX], spot[SNR], spot[LEVEL] = radius, flux * unit * unit, snr, share
    spot[ELONGATION], spot[FILL] = patch.shape(sums)
    spot[SATURATED], spot[CUT] = sums[patch.CLIPPED] / area, sums[patch.EDGE] / area
    spread = _unresolved(sums, q, unit)
    slope_u, slope_v = where[patch.SLOPE_U], where[patch.SLOPE_V]
    skew_u, skew_v = _skew(image, window, where, start, level + 0.5 * (top - level), q, unit)
    if unit > pitch:  # again, as finely as the room allows
        patch.cut(image, planes, scale, weight, v, u, 1.6 * radius + 3.0, patch.SIDE, window[0], where)
        unit = where[patch.UNIT]
        start[0], start[1] = _index(u, where[0], where[2], where[3]), _index(v, where[1], where[2], where[4])
        _peak_value(window[0], where, start)
        patch.grow(window, where, image, start[0], start[1], level, q[CLIPPED], len(_LEVELS) + 2)
        area = sums[patch.N]
    center, cov = np.empty(2), np.empty(3)
    variance = noise**2 + q[SIGNAL_NOISE] * max(sums[patch.W] / area, 0.0)
    patch.balance(sums, variance * shared, center, cov)
    cov *= unit * unit
    shift_u, shift_v = _plane_shift(weight, planes, spot[SATURATED] > 0.0)
    center[0] = where[patch.LEFT] + unit * (start[0] + center[0]) + shift_u
    center[1] = where[patch.TOP] + unit * (start[1] + center[1]) + shift_v
    fitted = False
    slope = (slope_u, slope_v) if planes < 4 else (0.0, 0.0)
    if radius <= q[SMALL_PX] * (1.6 if planes == 4 else 1.0) and sums[patch.EDGE] == 0.0:
        sample_noise = noise if planes < 4 else max(noise / np.sqrt((weight**2).sum()), q[MIN_NOISE])
        width = patch.fit(
            image,
            planes,
            scale,
            weight,
            slope,
            center,
            max(radius / 1.18, 0.8),
            sample_noise,
            q[SIGNAL_NOISE],
            q[CLIPPED],
            cov,
        )
        if width > 0.0:
            fitted = True
            cov *= shared
            spot[RADIUS] = 1.18 * width
    spot[U], spot[V] = center
    coarse = planes == 3 and weight[1] < max(weight[0], weight[2])
    floor_px = (q[COARSE_PX] if coarse else q[FLOOR_PX]) ** 2 + (q[SATURATED_PX] ** 2 if spot[SATURATED] > 0.0 else 0.0)
    if sums[patch.EDGE] > 0.0:
        floor_px += (q[CUT_SHARE] * radius) ** 2
    if not fitted:
        spread = spread[0] + skew_u * skew_u, spread[1] + skew_u * skew_v, spread[2] + skew_v * skew_v
    spot[VAR_UU] = cov[0] + floor_px + spread[0]
    spot[VAR_UV] = cov[1] + spread[1]
    spot[VAR_VV] = cov[2] + floor_px + spread[2]
    return not _is_known(spots, n)


@njit(cache=True)
def _around(part: Array, where: Array, start: Indices, sums: Array, radii: float, floor: float) -> float:
    """Mean level over the floor on a circle around a region's centre, of so many of its radii."""
    radius = radii * np.sqrt(sums[patch.N] / np.pi) + 1.0
    x, y = start[0] + sums[patch.X] / sums[patch.N], start[1] + sums[patch.Y] / sums[patch.N]
    total, count = 0.0, 0
    for k in range(12):
        a, b = int(x + radius * np.cos(k * np.pi / 6.0) + 0.5), int(y + radius * np.sin(k * np.pi / 6.0) + 0.5)
        if 0 <= a < where[patch.COLUMNS] and 0 <= b < where[patch.ROWS]:
            total += part[b, a] - floor
            count += 1
    return total / max(count, 1)


@njit(cache=True)
def _plane_shift(weight: Array, planes: int, clipped: bool) -> tuple[float, float]:
    """Where the samples of a cell lie on the average: planes of a mosaic stand a pixel apart."""
    if planes != 4:
        return 0.0, 0.0
    # a plane's weight goes with its share of the light, its part of the sum with the square; clipped, all are alike
    part = weight if clipped else weight**2
    total = part.sum()
    return float((part[1] + part[3]) / total), float((part[2] + part[3]) / total)


@njit(cache=True)
def _skew(
    image: Image, window: Window, where: Array, start: Indices, level: float, q: Array, unit: float
) -> tuple[float, float]:
    """How far the centre moves, px, when the spot is cut out higher: what an uneven halo or a glint does to it."""
    sums = window[3]
    x, y = sums[patch.WX] / sums[patch.W], sums[patch.WY] / sums[patch.W]
    kept = sums.copy()
    patch.grow(window, where, image, start[0], start[1], level, q[CLIPPED], len(_LEVELS) + 3)
    skew = (0.0, 0.0)
    if sums[patch.N] >= 4.0:
        skew = unit * (sums[patch.WX] / sums[patch.W] - x), unit * (sums[patch.WY] / sums[patch.W] - y)
    sums[:] = kept
    return skew


@njit(cache=True)
def _unresolved(sums: Array, q: Array, unit: float) -> tuple[float, float, float]:
    """Covariance of a region too long for one light: two that are not told apart, and either may be the one meant."""
    uu, uv, vv = patch.moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    if sums[patch.N] < 12.0 or np.sqrt(max(half - turn, 0.0) / (half + turn)) > q[MIN_ELONGATION] or turn <= 0.0:
        return 0.0, 0.0, 0.0
    excess = unit * unit
    return excess * (turn + 0.5 * (uu - vv)), excess * uv, excess * (turn - 0.5 * (uu - vv))


@njit(cache=True)
def _is_known(spots: Array, n: int) -> bool:
    for k in range(n):
        if np.hypot(spots[k, U] - spots[n, U], spots[k, V] - spots[n, V]) < max(0.7 * spots[k, RADIUS], 1.5):
            return True
    return False


@njit(cache=True)
def _own(seen: Image, stamp: Image, where: Array, start: Indices) -> None:
    """Mark the tiles that the grown region touches: nobody looks there again."""
    mark, t = stamp[start[1], start[0]], tiles.TILE_PX
    unit = int(where[patch.UNIT])
    for y in range(int(where[patch.ROWS])):
        top = int(where[patch.TOP]) + y * unit
        for x in range(int(where[patch.COLUMNS])):
            if stamp[y, x] == mark:
                left = int(where[patch.LEFT]) + x * unit
                for i in range(top // t, (top + unit - 1) // t + 1):
                    for j in range(left // t, (left + unit - 1) // t + 1):
                        if i < seen.shape[0] and j < seen.shape[1]:
                            seen[i, j] = 1


@njit(cache=True)
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
    """Mark the tiles of what is too large to be a light, as far as it is as bright as here in its weakest plane."""
    darkest, least = 0, 1e9
    for p in range(planes):
        mean = patch.core_mean(image, planes, scale, p, v, u)
        if mean <= least:
            darkest, least = p, mean
    weight[:] = 0.0
    weight[darkest] = 1.0
    patch.cut(image, planes, scale, weight, v, u, reach, patch.COARSE_SIDE, window[0], where)
    start[0], start[1] = _index(u, where[0], where[2], where[3]), _index(v, where[1], where[2], where[4])
    window[1][:] = 0
    patch.grow(window, where, image, start[0], start[1], _LEVELS[-1] * least, q[CLIPPED], 1)
    _own(seen, window[1], where, start)


@njit(cache=True)
def _lamp_probability(spot: Array, q: Array) -> float:
    """Probability of being a lamp, from contrast, shape and size: soft, so that geometry can overrule it."""
    radius = spot[RADIUS]
    seen = _logistic(spot[SNR] - 8.5)
    small = np.exp(-radius / 3.0)  # the outline of a small spot says little of its shape
    round_ = _logistic((spot[ELONGATION] - 0.5) / 0.06)
    full = _logistic((spot[FILL] - 0.75) / 0.04)
    shape = small + (1.0 - small) * round_ * full
    largest = q[MAX_RADIUS_PX]
    size = _logistic((0.5 * largest - radius) / (0.1 * largest)) * _logistic((radius - q[MIN_RADIUS_PX]) / 0.1)
    usual = 0.7 if spot[SATURATED] > 0.0 else 0.5
    alone = 1.0 - 2.0 * max(spot[LEVEL] - usual, 0.0)
    return float(min(max(seen * shape * size * alone, 0.02), 0.98))


@njit(cache=True)
def _logistic(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-x)))


@njit(cache=True)
def _dim_glints(spots: Array, n: int, q: Array) -> None:
    """Make little of a spot near a much stronger one that may be a lamp: its reflection on the frame beside it."""
    before = spots[:n, P_LIGHT].copy()
    for k in range(n):
        for m in range(n):
            near = np.hypot(spots[k, U] - spots[m, U], spots[k, V] - spots[m, V]) < q[GLINT_RADII] * spots[m, RADIUS]
            weaker = spots[m, FLUX] > q[GLINT_RATIO] * spots[k, FLUX] and spots[m, CORE] > 0.9 * spots[k, CORE]
            halo = m < k and spots[k, SATURATED] > 0.0 and spots[k, CORE] < 0.9 * spots[m, CORE]
            if m != k and near and (weaker or halo) and before[m] > q[GLINT_TRUST] * before[k]:
                spots[k, P_LIGHT] = max(0.1 * before[k], 0.02)
                break


@njit(cache=True)
def _dim_small_fry(spots: Array, n: int, q: Array) -> None:
    """Make less of spots that are many of a kind, or faint beside the lamps in view.

    A dock has a dozen or two lamps, of fluxes within a few hundred of each other; a wall or a cloud of snow has crowds.
    """
    before = spots[:n, P_LIGHT].copy()
    brightest = 0.0
    for k in range(n):
        if before[k] > 0.5:
            brightest = max(brightest, spots[k, FLUX])
    for k in range(n):
        alike = 0.0
        for m in range(n):
            if q[KIN] * spots[m, FLUX] > spots[k, FLUX] > spots[m, FLUX] / q[KIN]:
                alike += before[m]
        crowd = 1.0
        if spots[k, FLUX] < q[PROMINENT] * brightest:
            crowd = min(1.0, q[LAMPS] / max(alike, 1.0))
        dim = 1.0
        if brightest > 0.0 and spots[k, FLUX] > 0.0:
            dim = _logistic(np.log(spots[k, FLUX] * q[RANGE] / brightest))
        spots[k, P_LIGHT] = max(before[k] * crowd * dim, 0.02)
