"""One candidate measured in a close-up of its own: where it ends, and whether it is a spot at all."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import part
from lumidock._kernels.detection import fields, patch, peaks, region, samples, tiles
from lumidock._kernels.detection.describe import FILTER_PX, describe, holds_another, peak_value, small_snr
from lumidock._kernels.detection.patch import CloseUp
from lumidock._kernels.detection.samples import Picture
from lumidock.datatypes import Array, Image

LEVELS = (0.5, 0.7, 0.85, 0.95)  # shares of the peak at which a spot is cut out, until it is round and alone
_FARTHER = (4, 8, 16)  # tiles at which the flanks of a wide light show
_MAX_TILES = 20  # a light is not wider
_ROUNDS = 4
_QUICK = 1.45  # sigmas of noise that 3 x 3 pixels must clear; a light worth having clears 1.8
# share of a peak's height that a lens that blurs by 0.65 px, 1 sigma, gives the pixels around it; on a mosaic those of
# other colours get a quarter of it from a lamp of one colour
_AROUND, _AROUND_OF_MOSAIC = 0.24, 0.06
_MOST_SHARED = 36.0  # samples over which noise is the same; more is a texture
_LEAST_STEP = 30.0  # levels by which a saturated light stands out in the plane that shows it best


@part
def measure(
    picture: Picture,
    known: tiles.Map,
    close: CloseUp,
    tile: tuple[int, int],
    v: int,
    u: int,
    p: int,
    noise: float,
    q: Array,
    spots: Array,
    n: int,
) -> int:
    """Measure the spot of one candidate tile into `spots[n]`: 1 if there is one, 0 if not, -1 if that was cheap."""
    (i, j), planes, weight, ground = tile, picture.planes, close.weight, close.ground
    clipped = picture.scale * peaks.largest(known.peak, i, j) >= q[fields.CLIPPED]
    radius = _radius(picture, known, close, tile, v, u, p, noise, clipped, q)
    if radius == 0.0:
        return -1
    shared = samples.mean_by_square(weight, known.shared, 1)
    expected = noise * np.sqrt(samples.square(weight))
    share, reach = 0.0, min(max(3.5 * radius, 1.5 * q[fields.RING_PX]), 3.5 * q[fields.MAX_RADIUS_PX])
    for turn in range(_ROUNDS):
        patch.cut(picture, v, u, reach, patch.COARSE_SIDE, close)
        _surroundings(close, 0.9 * reach, expected, q[fields.MIN_NOISE] * expected / noise, clipped)
        if turn == 0 and not clipped:
            width = max(FILTER_PX / close.where[patch.UNIT], 0.7)
            x, y = float(close.where[patch.START_X]), float(close.where[patch.START_Y])
            if small_snr(close, x, y, width, shared) < 0.5 * q[fields.MIN_SNR]:
                return -1
        if clipped:
            patch.smooth(close)
        share = _level(picture, close, q, spots, n)
        if share == 0.0:
            if not clipped:
                _own(known.seen, close)
                return 0
            if close.sums[region.OPEN] == 0.0 or reach >= 3.5 * q[fields.MAX_RADIUS_PX]:
                _own_plateau(picture, close, v, u, reach, q, known.seen)
                return 0
            reach = min(2.0 * reach, 3.5 * q[fields.MAX_RADIUS_PX])
            continue
        found = np.sqrt(close.sums[region.N] / np.pi) * close.where[patch.UNIT]
        wanted = min(max(3.5 * found, 1.5 * q[fields.RING_PX]), 3.5 * q[fields.MAX_RADIUS_PX])
        if 0.6 * reach <= wanted <= 1.25 * reach or turn == _ROUNDS - 1:
            break
        reach = wanted
    if share == 0.0:
        return 0
    if np.sqrt(close.sums[region.N] / np.pi) * close.where[patch.UNIT] > q[fields.MAX_RADIUS_PX]:
        _own_plateau(picture, close, v, u, reach, q, known.seen)  # lights may stand in its halo
        return 0
    _own(known.seen, close)
    ground[patch.SHARED] = samples.mean_by_square(weight, known.shared, 2)
    if planes == 3:  # in the sum of channels fine noise is what JPEG leaves, and coarse noise that of the sensor
        more = ground[patch.SHARED] * (expected / ground[patch.NOISE]) ** 2
        ground[patch.SHARED] = min(max(more, 1.0), _MOST_SHARED)
    spots[n, fields.CORE] = 0.0
    for k in range(planes):
        spots[n, fields.CORE] += samples.core_mean(picture, k, v, u) / planes
    spots[n, fields.BY_LENS] = np.inf
    if planes != 3 and not clipped and radius <= tiles.TILE_PX:  # colour is spread by demosaicing, by the lens or not
        around = _AROUND if planes == 1 else _AROUND_OF_MOSAIC
        spots[n, fields.BY_LENS] = samples.log_lens_over_bad_pixel(
            picture, v, u, q[fields.RING_PX], around, noise, close.rings
        )
    return int(describe(picture, close, u, v, share, shared, q, spots, n))


@part
def _radius(
    picture: Picture,
    known: tiles.Map,
    close: CloseUp,
    tile: tuple[int, int],
    v: int,
    u: int,
    p: int,
    noise: float,
    clipped: bool,
    q: Array,
) -> float:
    """Radius px that a candidate seems to have, for which the planes are weighed; 0 if it does not stand out."""
    if clipped:
        return samples.weigh_clipped(picture, v, u, _LEAST_STEP, q[fields.MAX_RADIUS_PX], close.weight, close.rings)
    radius = min(_extent(known.peak, tile[0], tile[1], known.level), q[fields.MAX_RADIUS_PX])
    plane, small = p + (p == 2 and picture.planes == 4), radius < tiles.TILE_PX
    ring, sigma = max(radius, q[fields.RING_PX]), noise * np.sqrt(known.shared[p])
    if not samples.stands_out(picture, plane, v, u, ring, sigma, _QUICK, small, close.rings[0]):
        return 0.0
    samples.weigh(picture, v, u, radius, close.weight, close.rings)
    return radius


@part
def _surroundings(close: CloseUp, reach: float, expected: float, least: float, clipped: bool) -> None:
    """Flatten the close-up by the ring of `reach` px, and write what that says of the surroundings to its `ground`."""
    ground = close.ground
    level, spread, uneven = patch.flatten(close, reach)
    rim = patch.rim_noise(close)
    noise = max(rim, max(0.5 * expected, least))
    ground[patch.LEVEL], ground[patch.NOISE], ground[patch.RIM] = level, noise, rim
    ground[patch.HIDES] = 0.0 if clipped else np.sqrt(max(spread**2 - 2.0 * noise**2, 0.0))
    ground[patch.MOVES] = np.sqrt(max(uneven**2 - 2.0 * noise**2, 0.0))


@part
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
    for far in _FARTHER:
        step = max(step, peaks.over_pairs(peak[p], i, j, far))
    half = float(peak[p, i, j]) - 0.5 * min(most, 0.5 * step)
    width, height = 1, 1
    for way in (-1, 1):
        k = 1
        while k < _MAX_TILES and 0 <= j + way * k < peak.shape[2] and peak[p, i, j + way * k] > half:
            k += 1
        width += k - 1
        k = 1
        while k < _MAX_TILES and 0 <= i + way * k < peak.shape[1] and peak[p, i + way * k, j] > half:
            k += 1
        height += k - 1
    return 0.5 * tiles.TILE_PX * min(width, height)


@part
def _level(picture: Picture, close: CloseUp, q: Array, spots: Array, n: int) -> float:
    """Grow the spot at the lowest share of its peak where it is round and alone.

    If it is round nowhere, at the lowest where it is alone. Returns the share, 0 where the spot is never alone. A
    saturated core in one plane is swollen at half height by its halo, which no colour tells apart: there the lowest
    share is left out.
    """
    top, floor, sums, fallback = peak_value(close), close.ground[patch.LEVEL], close.sums, 0.0
    if top <= floor:
        region.take_all(close)
        return 0.0
    for k in range(1 if picture.planes == 1 and top >= q[fields.CLIPPED] else 0, len(LEVELS) + 1):
        again = k == len(LEVELS)
        if again and fallback == 0.0:
            return 0.0
        share = fallback if again else LEVELS[k]
        region.grow(picture, close, floor + share * (top - floor), q[fields.CLIPPED])
        if holds_another(close, spots, n):
            sums[region.OPEN] = 0.0  # a wider window does not help
            continue
        if sums[region.OPEN] > 0.0:
            continue
        elongation, fill = region.shape(sums)
        if again or sums[region.N] < 12.0 or (elongation > q[fields.MIN_ELONGATION] and fill > q[fields.MIN_FILL]):
            return share
        if fallback == 0.0:
            fallback = share
    return 0.0


@part
def _own(seen: Image, close: CloseUp) -> None:
    """Mark the tiles that the grown region touches: nobody looks there again."""
    stamp, sums, where, t = close.stamp, close.sums, close.where, tiles.TILE_PX
    mark, unit, columns = np.int32(where[patch.MARK]), where[patch.UNIT], int(sums[region.LAST_COLUMN]) + 1
    for y in range(int(sums[region.FIRST_ROW]), int(sums[region.LAST_ROW]) + 1):
        line, x = stamp[y + 1], int(sums[region.FIRST_COLUMN])
        top = where[patch.TOP] + y * unit
        last_row = min((top + unit - 1) // t + 1, seen.shape[0])
        while x < columns:
            if line[x + 1] != mark:
                x += 1
                continue
            first = x
            while x < columns and line[x + 1] == mark:
                x += 1
            left, right = where[patch.LEFT] + first * unit, where[patch.LEFT] + x * unit - 1
            for i in range(top // t, last_row):
                seen[i, left // t : min(right // t + 1, seen.shape[1])] = 1


@part
def _own_plateau(picture: Picture, close: CloseUp, v: int, u: int, reach: float, q: Array, seen: Image) -> None:
    """Mark the tiles of what is too large to be a light, as far as it is as bright as here in every plane."""
    darkest, least = 0, 1e9
    for p in range(picture.planes):
        core = samples.core_mean(picture, p, v, u)
        if core <= least:
            darkest, least = p, core
    close.weight[:] = 0.0
    close.weight[darkest] = 1.0
    patch.cut(picture, v, u, reach, patch.COARSE_SIDE, close)
    region.grow(picture, close, LEVELS[-1] * least, q[fields.CLIPPED])
    for p in range(picture.planes):
        region.unmark(close, p, LEVELS[-1] * samples.core_mean(picture, p, v, u))
    _own(seen, close)
