"""The hot loops of the detector: plain arrays in, plain arrays out, compiled by numba.

Pictures come as (H, W, C) uint8 of 1 or 3 channels; a pixel's value is that of its largest channel.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lumidock.datatypes import Array, Image, Indices

TILE_PX = 8
# columns of a measured spot, see `measure`
U, V, RADIUS, FLUX, SNR, ELONGATION, FILL, LEVEL, SATURATED, CUT, COARSE, VAR_UU, VAR_UV, VAR_VV = range(14)
COLUMNS = 14
_SATURATED = 250
_TILE_RINGS = (4.0, 12.0)
_LEVELS = (0.5, 0.7, 0.85, 0.95)  # shares of the peak at which a spot is cut out, until it is round and alone
_COS, _SIN = np.cos(np.arange(24) * np.pi / 12.0), np.sin(np.arange(24) * np.pi / 12.0)
_MARKS = len(_LEVELS) + 1  # one for each, and one to go back to the lowest
_SETTLE_ROUNDS = 3
_REFINE_ROUNDS = 8
Work = tuple[NDArray[np.int32], Image, Indices]  # region of each pixel (H, W), regions of spots, stack (2, n)
_FILTER_PX, _FILTERED_PX = 1.2, 3.0  # width of the window, and up to which radius it judges a spot


@njit(cache=True)
def tile_statistics(rows: Image, channels: int) -> tuple[Image, Array, Array]:
    """Largest value, mean and variance (h, w) of each tile of the picture `rows` (H, W * channels).

    The largest value is of all pixels; mean and variance are of one even and one odd row, which hold every phase of a
    Bayer mosaic.
    """
    height, width = rows.shape[0], rows.shape[1] // channels
    h, w = (height + TILE_PX - 1) // TILE_PX, (width + TILE_PX - 1) // TILE_PX
    peak = np.zeros((h, w), np.uint8)
    mean = np.zeros((h, w), np.float32)
    variance = np.zeros((h, w), np.float32)
    line = np.empty(rows.shape[1], np.uint8)
    for i in range(h):
        top, bottom = i * TILE_PX, min((i + 1) * TILE_PX, height)
        line[:] = rows[top]
        for v in range(top + 1, bottom):
            _keep_larger(line, rows[v])
        _tile_peaks(line, channels, peak[i])
        even, odd = rows[min(top + 2, bottom - 1)], rows[min(top + 5, bottom - 1)]
        _tile_moments(even, odd, channels, mean[i], variance[i])
    return peak, mean, variance


@njit(cache=True)
def _keep_larger(line: Image, row: Image) -> None:
    """Raise each element of `line` (n,) to that of `row` (n,)."""
    for x in range(len(line)):
        line[x] = max(line[x], row[x])


@njit(cache=True)
def _tile_peaks(line: Image, channels: int, peak: Image) -> None:
    """Write the largest values of the tiles of `line` (W * channels) to `peak` (w,)."""
    step = TILE_PX * channels
    for j in range(len(peak)):
        highest = np.uint8(0)
        for x in range(j * step, min((j + 1) * step, len(line))):
            highest = max(highest, line[x])
        peak[j] = highest


@njit(cache=True)
def _tile_moments(even: Image, odd: Image, channels: int, mean: Array, variance: Array) -> None:
    """Write mean and variance of the tiles of two rows (W * channels) to `mean` and `variance` (w,)."""
    width = len(even) // channels
    for j in range(len(mean)):
        low, high = j * TILE_PX, min((j + 1) * TILE_PX, width)
        total, squares = np.int32(0), np.int32(0)
        if channels == 1:
            for u in range(low, high):
                a, b = np.int32(even[u]), np.int32(odd[u])
                total += a + b
                squares += a * a + b * b
        else:
            for x in range(3 * low, 3 * high, 3):
                a = np.int32(max(even[x], even[x + 1], even[x + 2]))
                b = np.int32(max(odd[x], odd[x + 1], odd[x + 2]))
                total += a + b
                squares += a * a + b * b
        count = 2.0 * (high - low)
        mean[j] = total / count
        variance[j] = max(squares / count - (total / count) ** 2, 0.0)


@njit(cache=True)
def _value(image: Image, v: int, u: int) -> int:
    """Value of one pixel: its largest channel."""
    if image.shape[2] == 1:
        return int(image[v, u, 0])
    return int(max(image[v, u, 0], image[v, u, 1], image[v, u, 2]))


@njit(cache=True)
def _mean_value(image: Image, v: int, u: int) -> int:
    """Mean of the channels of one pixel: where the largest is saturated, it still tells a white core from its halo."""
    if image.shape[2] == 1:
        return int(image[v, u, 0])
    return (int(image[v, u, 0]) + int(image[v, u, 1]) + int(image[v, u, 2])) // 3


@njit(cache=True)
def _read(image: Image, v: int, u: int, mean: bool) -> int:
    """Mean or value of one pixel."""
    return _mean_value(image, v, u) if mean else _value(image, v, u)


@njit(cache=True)
def _rank(image: Image, v: int, u: int) -> int:
    """Order of brightness: by value, and by mean among equals."""
    return 256 * _value(image, v, u) + _mean_value(image, v, u)


@njit(cache=True)
def _ring_level(image: Image, u: float, v: float, radius: float, mean: bool) -> float:
    """Mean of the middle half of the values on a circle; 0 where the circle is outside the picture."""
    values = np.empty(len(_COS))
    count = 0
    for k in range(len(_COS)):
        x, y = int(np.floor(u + radius * _COS[k] + 0.5)), int(np.floor(v + radius * _SIN[k] + 0.5))
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            count = _insert(values, count, _read(image, y, x, mean))
    return _middle_mean(values, count)


@njit(cache=True)
def _tile_ring_median(mean: Array, i: int, j: int, radius: float) -> float:
    """Median of the tile means on a circle of `radius` tiles; the own mean when the circle is outside the picture."""
    values = np.empty(len(_COS))
    count = 0
    for k in range(len(_COS)):
        x, y = int(np.floor(j + radius * _COS[k] + 0.5)), int(np.floor(i + radius * _SIN[k] + 0.5))
        if 0 <= x < mean.shape[1] and 0 <= y < mean.shape[0]:
            count = _insert(values, count, mean[y, x])
    return float(values[count // 2] if count else mean[i, j])


@njit(cache=True)
def _middle_mean(values: Array, count: int) -> float:
    """Mean of the middle half of the first `count` of the sorted `values`: as robust as a median, and finer."""
    if count == 0:
        return 0.0
    skip = count // 4
    return float(values[skip : count - skip].mean())


@njit(cache=True)
def _insert(values: Array, count: int, value: float) -> int:
    """Insert into the first `count` of the sorted `values`; returns the new count."""
    k = count
    while k > 0 and values[k - 1] > value:
        values[k] = values[k - 1]
        k -= 1
    values[k] = value
    return count + 1


@njit(cache=True)
def _brightest(image: Image, i: int, j: int) -> tuple[int, int, int]:
    """Row, column and rank of a tile's brightest pixel, the first of several."""
    best, row, column = -1, 0, 0
    for v in range(i * TILE_PX, min((i + 1) * TILE_PX, image.shape[0])):
        for u in range(j * TILE_PX, min((j + 1) * TILE_PX, image.shape[1])):
            rank = _rank(image, v, u)
            if rank > best:
                best, row, column = rank, v, u
    return row, column, best


@njit(cache=True)
def _small_mean(image: Image, v: int, u: int) -> tuple[float, int]:
    """Mean value and largest rank of the 3 x 3 pixels around one."""
    total, count, highest = 0, 0, 0
    for y in range(max(v - 1, 0), min(v + 2, image.shape[0])):
        for x in range(max(u - 1, 0), min(u + 2, image.shape[1])):
            total += _value(image, y, x)
            count += 1
            highest = max(highest, _rank(image, y, x))
    return total / count, highest


@njit(cache=True)
def _is_tile_peak(mean: Array, i: int, j: int) -> bool:
    """Whether no tile around has a larger mean."""
    for b in range(max(i - 1, 0), min(i + 2, mean.shape[0])):
        for a in range(max(j - 1, 0), min(j + 2, mean.shape[1])):
            if mean[b, a] > mean[i, j]:
                return False
    return True


@njit(cache=True)
def _contrast(
    image: Image, mean: Array, u: int, v: int, small: float, noise: float, ring_px: float, step: float
) -> float:
    """How far a peak stands out, in sigmas: the best of three scales, see `peaks`."""
    best = (small - _ring_level(image, u, v, ring_px, False)) / noise
    i, j = v // TILE_PX, u // TILE_PX
    if small < _SATURATED and not _is_tile_peak(mean, i, j):  # noise on the halo of something larger
        return best
    for radius in _TILE_RINGS:
        best = max(best, (mean[i, j] - _tile_ring_median(mean, i, j, radius)) / max(noise, step))
    return best


@njit(cache=True)
def peaks(
    image: Image,
    mean: Array,
    background: Array,
    noise: Array,
    tiles: Indices,
    ring_px: float,
    step: float,
    least: float,
) -> Array:
    """Local maxima (n, 4), columns u, v, rank, contrast, of the `tiles` (N, 2) that stand out from their surroundings.

    The contrast is the best of three scales, in sigmas: 3 x 3 pixels against a ring of `ring_px`, and a tile's mean
    against rings of 4 and of 12 tiles, where `step` grey levels count as one sigma at least. `mean`, `background` and
    `noise` (h, w) are of the tiles; `least` is the contrast wanted.
    """
    found = np.empty((len(tiles), 4))
    count = 0
    for n in range(len(tiles)):
        i, j = tiles[n]
        v, u, rank = _brightest(image, i, j)
        small, highest = _small_mean(image, v, u)
        # the slope of something brighter in the next tile, or a lone pixel
        if highest > rank or small - background[i, j] < least * noise[i, j]:
            continue
        contrast = _contrast(image, mean, u, v, small, noise[i, j], ring_px, step)
        if contrast >= least:
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = u, v, rank, contrast
            count += 1
    return found[:count]


@njit(cache=True)
def _add_run(
    sums: Array, image: Image, v: int, low: int, high: int, start: tuple[int, int], level: float, mean: bool
) -> None:
    """Add the pixels `low` to `high`, exclusive, of row `v` to the sums of `_flood`."""
    y, height, width = float(v - start[1]), image.shape[0], image.shape[1]
    for u in range(low, high):
        value = _read(image, v, u, mean)
        x, weight = float(u - start[0]), value - level
        sums[1] += x
        sums[3] += x * x
        sums[6] += weight
        sums[7] += weight * x
        sums[8] += weight * y
        sums[9] += _value(image, v, u) >= _SATURATED
    count, along = float(high - low), 0.5 * (low + high - 1) - start[0]
    sums[0] += count
    sums[2] += count * y
    sums[4] += count * along * y
    sums[5] += count * y * y
    sums[10] += low == 0 or high == width or v == 0 or v == height - 1


@njit(cache=True)
def _flood(
    image: Image,
    work: Work,
    mark: int,
    start: tuple[int, int],
    level: float,
    most: int,
    mean: bool,
    sums: Array,
) -> int:
    """Sum up the connected pixels above `level` around `start` (u, v), run by run; returns their number.

    `sums` becomes [n, u, v, uu, uv, vv, w, wu, wv, saturated, cut, failed], coordinates relative to `start`, weights
    w = value - level, with the mean of the channels for value if `mean`. The pixels get `mark`. It fails where they
    meet those of a spot already found or are more than `most`.
    """
    stamp, owned, stack = work
    sums[:] = 0.0
    height, width = image.shape[:2]
    stack[0, 0], stack[1, 0] = start
    top = 1
    while top:
        top -= 1
        u, v = stack[0, top], stack[1, top]
        if stamp[v, u] == mark:
            continue
        low, high = u, u + 1
        while low > 0 and stamp[v, low - 1] != mark and _read(image, v, low - 1, mean) > level:
            low -= 1
        while high < width and stamp[v, high] != mark and _read(image, v, high, mean) > level:
            high += 1
        for x in range(low, high):
            if owned[stamp[v, x]]:
                sums[11] = 1.0
                return int(sums[0])
            stamp[v, x] = mark
        _add_run(sums, image, v, low, high, start, level, mean)
        if sums[0] > most:
            sums[11] = 1.0
            return int(sums[0])
        for b in (v - 1, v + 1):
            if b < 0 or b >= height:
                continue
            inside = False
            for x in range(max(low - 1, 0), min(high + 1, width)):  # 8-connected
                lit = stamp[b, x] != mark and _read(image, b, x, mean) > level
                if lit and not inside and top < stack.shape[1]:
                    stack[0, top], stack[1, top] = x, b
                    top += 1
                inside = lit
    return int(sums[0])


@njit(cache=True)
def _shape(sums: Array) -> tuple[float, float]:
    """Ratio of the axes of the ellipse with the region's second moments, and the region's area over the ellipse's."""
    n = sums[0]
    uu = (sums[3] - sums[1] ** 2 / n) / n + 1.0 / 12.0
    vv = (sums[5] - sums[2] ** 2 / n) / n + 1.0 / 12.0
    uv = (sums[4] - sums[1] * sums[2] / n) / n
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    area = 4.0 * np.pi * np.sqrt(max(uu * vv - uv * uv, 1e-12))
    return np.sqrt(max(half - turn, 1e-12) / (half + turn)), n / area


@njit(cache=True)
def _filter_snr(image: Image, center: Array, width: float, background: float, noise: float) -> float:
    """Signal-to-noise ratio of what lies under a Gaussian window at `center` (2,)."""
    reach = int(np.ceil(2.5 * width))
    total, power = 0.0, 0.0
    for y in range(max(int(center[1]) - reach, 0), min(int(center[1]) + reach + 2, image.shape[0])):
        for x in range(max(int(center[0]) - reach, 0), min(int(center[0]) + reach + 2, image.shape[1])):
            a, b = x - center[0], y - center[1]
            window = np.exp(-0.5 * (a * a + b * b) / (width * width))
            total += window * (_value(image, y, x) - background)
            power += window * window
    return float(total / (noise * np.sqrt(power)))


@njit(cache=True)
def _refine(image: Image, center: Array, radius: float, background: float, variance: float, cov: Array) -> bool:
    """Move `center` (2,) to where a Gaussian window of the spot's own width balances; its noise goes to `cov` (3,).

    False, and nothing changed, when it does not settle within a radius. Source: E. Bertin, SExtractor, windowed
    positions.
    """
    width = max(radius / 1.18, 0.8)
    reach = int(np.ceil(3.0 * width))
    u, v = center
    low_v, high_v = max(int(v) - reach, 0), min(int(v) + reach + 2, image.shape[0])
    low_u, high_u = max(int(u) - reach, 0), min(int(u) + reach + 2, image.shape[1])
    uu, uv, vv, total = 0.0, 0.0, 0.0, 0.0
    for _ in range(_REFINE_ROUNDS):
        total, du, dv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for y in range(low_v, high_v):
            for x in range(low_u, high_u):
                a, b = x - u, y - v
                window = np.exp(-0.5 * (a * a + b * b) / (width * width))
                signal = window * (_value(image, y, x) - background)
                total += signal
                du += signal * a
                dv += signal * b
                uu += window * window * a * a
                uv += window * window * a * b
                vv += window * window * b * b
        if total <= 0.0:
            return False
        u += 2.0 * du / total
        v += 2.0 * dv / total
        if np.hypot(u - center[0], v - center[1]) > max(radius, 1.0):
            return False
    center[0], center[1] = u, v
    cov[0], cov[1], cov[2] = uu, uv, vv
    cov *= 4.0 * variance / total**2
    return True


@njit(cache=True)
def _is_coarse(image: Image, v: int, u: int) -> bool:
    """Whether the spot at a pixel is seen coarsely.

    So are blue and red, of which a mosaic and JPEG have fewer samples, and a saturated core in a mono picture, where
    nothing tells it from its halo.
    """
    if image.shape[2] == 1:
        return bool(image[v, u, 0] >= _SATURATED)
    return bool(image[v, u, 1] < max(image[v, u, 0], image[v, u, 2]))


@njit(cache=True)
def _cut_out(
    image: Image,
    work: Work,
    mark: int,
    start: tuple[int, int],
    peak: float,
    background: float,
    most: int,
    mean: bool,
    sums: Array,
    roundness: Array,
) -> tuple[float, int]:
    """Cut a spot out at the lowest of `_LEVELS` where it is round and alone, at the lowest where it is alone otherwise.

    Returns the level's share of the peak, 0 where the spot is never alone, and how many pixels were looked at.
    `roundness` holds the least ratio of axes and the least fill; marks from `mark` on are used. A spot has at most
    `most` pixels.
    """
    fallback, looked = 0.0, 0
    clipped = (
        image.shape[2] == 1 and peak >= _SATURATED
    )  # at half height its halo swells it, which no colour tells apart
    for k in range(1 if clipped else 0, len(_LEVELS)):
        share = _LEVELS[k]
        level = background + share * (peak - background)
        looked += _flood(image, work, mark + k, start, level, most, mean, sums)
        if sums[11] > 0.0:
            continue
        elongation, fill = _shape(sums)
        if sums[0] < 12.0 or (elongation > roundness[0] and fill > roundness[1]):
            return share, looked
        if fallback == 0.0:
            fallback = share
    if fallback > 0.0:
        level = background + fallback * (peak - background)
        looked += _flood(image, work, mark + len(_LEVELS), start, level, most, mean, sums)
    return fallback, looked


@njit(cache=True)
def _settle(
    image: Image,
    work: Work,
    mark: int,
    start: tuple[int, int],
    coarse: float,
    largest: int,
    ring_px: float,
    roundness: Array,
    sums: Array,
) -> tuple[float, float, float, int]:
    """Cut a spot out over the background of the ring around it, whose radius follows the spot's.

    Returns the level's share of the peak, 0 where there is no spot, the level, the background and how many pixels were
    looked at. `coarse` is the background of the wider surroundings, for spots that cover their first ring.
    """
    u0, v0 = start
    mean = _value(image, v0, u0) >= _SATURATED
    peak = float(_read(image, v0, u0, mean))
    background, room = _ring_level(image, u0, v0, ring_px, mean), int(4.0 * np.pi * ring_px**2)
    if background > 0.5 * (peak + coarse):
        background, room = min(coarse, 0.5 * peak), largest
    share, level, total = 0.0, 0.0, 0
    for turn in range(_SETTLE_ROUNDS):
        first = mark + turn * _MARKS
        share, looked = _cut_out(image, work, first, start, peak, background, room, mean, sums, roundness)
        total += looked
        if share == 0.0:
            if room == largest and work[0][v0, u0] > 0:  # too large for a light: nobody looks there again
                work[1][work[0][v0, u0]] = 1
            break
        level = background + share * (peak - background)
        reach = max(ring_px, 3.0 * np.sqrt(sums[0] / np.pi))
        u, v = u0 + sums[1] / sums[0], v0 + sums[2] / sums[0]
        rim, room = min(_ring_level(image, u, v, reach, mean), peak - 1.0), min(int(np.pi * reach**2), largest)
        settled = abs(rim - background) < 0.05 * (peak - background)
        background = rim
        if settled:
            break
    return share, level, background, total


@njit(cache=True)
def _weigh(sums: Array, start: tuple[int, int], variance: float, center: Array, cov: Array) -> None:
    """Write the weighted centre (2,) of a region and what noise of `variance` per pixel does to it, `cov` (3,)."""
    x, y = sums[7] / sums[6], sums[8] / sums[6]
    center[0], center[1] = start[0] + x, start[1] + y
    cov[0] = sums[3] - 2.0 * x * sums[1] + sums[0] * x * x
    cov[1] = sums[4] - x * sums[2] - y * sums[1] + sums[0] * x * y
    cov[2] = sums[5] - 2.0 * y * sums[2] + sums[0] * y * y
    cov *= variance / sums[6] ** 2


@njit(cache=True)
def measure(
    image: Image,
    found: Array,
    noise: Array,
    coarse: Array,
    limits: tuple[int, int, int],
    small_px: float,
    ring_px: float,
    roundness: Array,
    signal_noise: float,
    least: float,
) -> Array:
    """Spots (n, COLUMNS) around the peaks `found` (N, 4), which are ordered by strength.

    `noise` and `coarse` (N,) are the noise and the background around each peak, `limits` the largest number of spots,
    of pixels in one and of pixels looked at in all. Spots up to `small_px` of radius that are not saturated get their
    centre from a Gaussian window. `signal_noise` is the variance of a pixel per grey level of signal, `least` the
    signal-to-noise ratio wanted.
    """
    most, largest, budget = limits
    stamp = np.zeros(image.shape[:2], np.int32)  # which region each pixel was last in
    owned = np.zeros(1 + _SETTLE_ROUNDS * _MARKS * len(found), np.uint8)  # whether a region is a spot's
    work = (stamp, owned, np.empty((2, largest), np.int64))
    spots = np.empty((most, COLUMNS))
    sums, center, cov = np.empty(12), np.empty(2), np.empty(3)
    count = 0
    for n in range(len(found)):
        u0, v0 = int(found[n, 0]), int(found[n, 1])
        if count == most or budget <= 0:
            break
        if owned[stamp[v0, u0]]:
            continue
        mark, start = 1 + n * _SETTLE_ROUNDS * _MARKS, (u0, v0)
        share, level, background, looked = _settle(
            image, work, mark, start, coarse[n], largest, ring_px, roundness, sums
        )
        budget -= looked
        if share == 0.0:
            continue
        area, radius = sums[0], np.sqrt(sums[0] / np.pi)
        flux = sums[6] + area * (level - background)
        variance = noise[n] ** 2 + signal_noise * flux / area
        _weigh(sums, start, variance, center, cov)
        if sums[9] == 0.0 and sums[10] == 0.0 and radius <= small_px:
            _refine(image, center, radius, background, variance, cov)
        snr = flux / np.sqrt(area) / noise[n]
        if radius < _FILTERED_PX:
            snr = _filter_snr(image, center, _FILTER_PX, background, noise[n])
        if snr < least:
            continue
        spot = spots[count]
        spot[: V + 1] = center
        spot[RADIUS], spot[FLUX], spot[LEVEL], spot[SNR] = radius, flux, share, snr
        spot[ELONGATION], spot[FILL] = _shape(sums)
        spot[SATURATED], spot[CUT] = sums[9] / area, sums[10] / area
        spot[COARSE] = _is_coarse(image, v0, u0)
        spot[VAR_UU:] = cov
        count += 1
        owned[stamp[v0, u0]] = 1
    return spots[:count]
