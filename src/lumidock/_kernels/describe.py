"""A grown spot described: its centre and covariance, radius, flux and shape."""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import constant, fields, gauss, patch, samples
from lumidock._kernels.patch import Window
from lumidock.datatypes import Array, Image, Indices

FILTER_PX = 1.2  # width of the window that judges a small spot ...
_FILTERED_PX = 3.0  # ... up to this radius
_GRID, _GRID_OF_MOSAIC = 0.015, 0.05  # 1 sigma, of a sample's side, that the grid leaves to a small spot's balance
_GRID_OF_FIELD = 0.1  # px, the same of the way between fields, of which each has every other row
_WIDTHS = 3  # times the width of what stands over the noise, from which a fit is tried: faint flanks are not seen
_LEAST_NOISE = 0.7  # of what a search allows for: a sample's rounding, and noise too small to show beside it
_BETWEEN = np.sqrt(1.0 / 12.0)  # 1 sigma of an instant between two fields, of the way between them
_SOFT = 0.2  # of a spot's height, by which the weights of its balance reach below the level of its region ...
_BROAD_PX = 2.4  # ... if its edge is no wider, which is none or a halo's; from a pixel less on, all of that
_STEEP, _STEEP_PX, _NARROW_PX, _STEEPEST = 3.6, 1.18, 0.2, 6.0  # times a smooth spot's error by the grid that a steep
# edge adds; as wide, and per so much less as many times more; and the most
_BURNT = 0.95  # of saturation, on the average of all planes, from which an edge may be steep
_FINER = 1.6  # times the samples that a picture of one plane has of an edge: colours were interpolated
_PLATEAU = 0.9  # of the height; less is edge
_WIDEST_PX2 = 500.0  # area of a spot whose edge is told from its inside; of a wider one it matters little
_HAZE, _HAZE_PX = 0.28, 8.0  # px, 1 sigma, by a halo as bright as the spot; in proportion to the radius up to this one
_FINE_MARK, _SKEW_MARK = constant(100), constant(101)  # of regions grown again, beside those of the levels tried


@njit(inline="always", error_model="numpy")
def describe(
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
    top = window[0][start[1], start[0]]
    level = ground[0] + share * (top - ground[0])
    _size(window, where, start, ground, level, shared, spot)
    if spot[fields.SNR] < q[fields.MIN_SNR] or _is_known(spots, n):
        return False
    spot[fields.LEVEL] = share
    radius, noise = spot[fields.RADIUS], ground[1]
    halo = _around(window[0], where, start, sums, ground[0]) / (top - ground[0])
    merged = _unresolved(sums, q, where[patch.UNIT])
    slope = (where[patch.SLOPE_U], where[patch.SLOPE_V]) if planes < 4 else (0.0, 0.0)
    if where[patch.UNIT] > (2.0 if planes == 4 else 1.0):  # again, as finely as the room allows
        patch.cut(image, planes, scale, weight, v, u, 1.6 * radius + 3.0, patch.SIDE, window[0], where)
        start[0], start[1] = index(u, where[0], where[2], where[3]), index(v, where[1], where[2], where[4])
        peak_value(window[0], where, start)
        patch.grow(window, where, image, start[0], start[1], level, q[fields.CLIPPED], _FINE_MARK)
    center, cov = np.empty(2), np.empty(3)
    variance = noise**2 + q[fields.SIGNAL_NOISE] * max(sums[patch.W] / sums[patch.N], 0.0)
    unit = where[patch.UNIT]
    edge = _edge(image, planes, scale, weight, window, where, start, ground[0], top)
    soft = _SOFT * (top - ground[0]) * min(max(_BROAD_PX - edge, 0.0), 1.0)
    on_grid = q[fields.SATURATED_PX] * (
        _steepness(planes, edge) if spot[fields.CORE] > _BURNT * q[fields.CLIPPED] else 1.0
    )
    patch.soften(window, where, start, level, level - soft)
    patch.balance(sums, variance * gauss.averaging(ground[4], radius), center, cov)
    between_u, between_v = patch.fields_apart(window, where, start, level - soft)
    shift_u, shift_v = _plane_shift(image, planes, scale, weight, window, where, start, level - soft)
    center[0] = where[patch.LEFT] + unit * (start[0] + center[0]) + shift_u
    center[1] = where[patch.TOP] + unit * (start[1] + center[1]) + shift_v
    higher = level + 0.5 * (top - level)
    skew_u, skew_v = _skew(image, window, where, start, higher, soft, q, unit)
    if skew_u != 0.0 or skew_v != 0.0:
        other_u, other_v = _plane_shift(image, planes, scale, weight, window, where, start, higher - soft)
        skew_u, skew_v = skew_u + other_u - shift_u, skew_v + other_v - shift_v
    noise_of_balance = unit * unit * (cov[0] + cov[2] + 2.0 * (_GRID_OF_MOSAIC if planes == 4 else _GRID) ** 2)
    # the higher region is a part of the lower one, so that half of their noise is common
    skewed = _disagreement(skew_u, skew_v, 0.5 * unit * unit * (cov[0] + cov[2] + 2.0 * _GRID**2))
    # half of it along the skew, half of it any way: a grid skews a spot one way and displaces it another
    haze = _HAZE * min(max(halo, 0.0), 1.0) * min(radius / _HAZE_PX, 1.0)
    astray = 0.25 * (skewed[0] + skewed[2]) + (on_grid * unit) ** 2 * unit / radius + haze**2
    cov[0], cov[1], cov[2] = (
        unit * unit * cov[0] + 0.5 * skewed[0] + astray,
        unit * unit * cov[1] + 0.5 * skewed[1],
        unit * unit * cov[2] + 0.5 * skewed[2] + astray,
    )
    if radius <= q[fields.SMALL_PX] * (1.6 if planes == 4 else 1.0) and sums[patch.EDGE] == 0.0:
        sample_noise = noise
        if planes == 4:
            sample_noise = max(ground[5] / np.sqrt(samples.square(weight)), _LEAST_NOISE * q[fields.MIN_NOISE])
        balanced = center[0], center[1]
        width = 0.0
        for wider in range(_WIDTHS):
            if width == 0.0:
                width = gauss.fit(
                    image,
                    planes,
                    scale,
                    weight,
                    slope,
                    center,
                    max(radius / 1.18, 0.8) * (1.0 + wider),
                    sample_noise,
                    q[fields.SIGNAL_NOISE],
                    ground[4],
                    _is_coarse(planes, weight),
                    q[fields.CLIPPED],
                    cov,
                )
        if width > 0.0:
            merged = _disagreement(center[0] - balanced[0], center[1] - balanced[1], noise_of_balance)
            spot[fields.RADIUS] = 1.18 * width
    apart = _disagreement(_BETWEEN * between_u, _BETWEEN * between_v, noise_of_balance + 2.0 * _GRID_OF_FIELD**2)
    spot[fields.U], spot[fields.V] = center
    floor = _floor(planes, weight, spot, sums, q) + (q[fields.TEXTURE] * ground[3] * radius / (top - ground[0])) ** 2
    spot[fields.VAR_UU] = cov[0] + floor + merged[0] + apart[0]
    spot[fields.VAR_UV] = spot[fields.VAR_VU] = cov[1] + merged[1] + apart[1]
    spot[fields.VAR_VV] = cov[2] + floor + merged[2] + apart[2]
    return not _is_known(spots, n)


@njit(error_model="numpy")
def _size(
    window: Window, where: Array, start: Indices, ground: Array, level: float, shared: float, spot: Array
) -> None:
    """What the region grown at `level` says of a spot: all but its exact centre and covariance."""
    sums, floor, noise, unit = window[3], ground[0], ground[1], where[patch.UNIT]
    area = sums[patch.N]
    x, y = start[0] + sums[patch.X] / area, start[1] + sums[patch.Y] / area
    spot[fields.U], spot[fields.V] = where[patch.LEFT] + unit * x, where[patch.TOP] + unit * y
    spot[fields.RADIUS] = np.sqrt(area / np.pi) * unit
    flux = sums[patch.W] + area * (level - floor)
    spot[fields.FLUX] = flux * unit * unit
    spot[fields.SNR] = flux / (area * np.sqrt(shared * noise**2 / area + ground[2] ** 2))
    if spot[fields.RADIUS] < _FILTERED_PX:
        spot[fields.SNR] = small_snr(window[0], where, x, y, max(FILTER_PX / unit, 0.7), ground, shared)
    spot[fields.ELONGATION], spot[fields.FILL] = patch.shape(sums)
    spot[fields.SATURATED], spot[fields.CUT] = sums[patch.CLIPPED] / area, sums[patch.EDGE] / area


@njit(error_model="numpy")
def _floor(planes: int, weight: Array, spot: Array, sums: Array, q: Array) -> float:
    """Variance of a centre that has no noise."""
    variance = q[fields.FLOOR_PX] ** 2
    if _is_coarse(planes, weight):  # along a longer outline the error of a sample averages out
        variance = q[fields.COARSE_PX] ** 2 * min(q[fields.SMALL_PX] / spot[fields.RADIUS], 1.0)
    if sums[patch.EDGE] > 0.0:
        variance += (q[fields.CUT_SHARE] * spot[fields.RADIUS]) ** 2
    return float(variance)


@njit(error_model="numpy")
def _is_coarse(planes: int, weight: Array) -> bool:
    """Whether a spot shows most in a colour that has half of the samples: blue or red."""
    return bool(planes == 3 and weight[1] < max(weight[0], weight[2]))


@njit(error_model="numpy")
def small_snr(part: Array, where: Array, x: float, y: float, width: float, ground: Array, shared: float) -> float:
    """How far a Gaussian window stands out of noise, which averages out in it, and texture, which does not."""
    amplitude, averaged = patch.filtered(part, where, x, y, width, ground[0])
    return float(amplitude / np.sqrt(shared * ground[1] ** 2 / averaged + ground[2] ** 2))


@njit(error_model="numpy")
def index(x: int, first: float, unit: float, count: float) -> int:
    """Sample of a window that holds pixel `x`."""
    return min(int((x - first) / unit), int(count) - 1)


@njit(error_model="numpy")
def peak_value(part: Array, where: Array, start: Indices) -> float:
    """Largest sample around the start of a spot."""
    best = -1e9
    for y in range(max(start[1] - 1, 0), min(start[1] + 2, int(where[patch.ROWS]))):
        for x in range(max(start[0] - 1, 0), min(start[0] + 2, int(where[patch.COLUMNS]))):
            if part[y, x] > best:
                best = part[y, x]
                at_x, at_y = x, y
    start[0], start[1] = at_x, at_y
    return best


@njit(error_model="numpy")
def _around(part: Array, where: Array, start: Indices, sums: Array, floor: float) -> float:
    """Mean level over the floor on a circle around a region's centre, of twice its radius."""
    radius = 2.0 * np.sqrt(sums[patch.N] / np.pi) + 1.0
    x, y = start[0] + sums[patch.X] / sums[patch.N], start[1] + sums[patch.Y] / sums[patch.N]
    total, count = 0.0, 0
    for k in range(12):
        a, b = int(x + radius * samples.COS[2 * k] + 0.5), int(y + radius * samples.SIN[2 * k] + 0.5)
        if 0 <= a < where[patch.COLUMNS] and 0 <= b < where[patch.ROWS]:
            total += part[b, a] - floor
            count += 1
    return total / max(count, 1)


@njit(error_model="numpy")
def _plane_shift(
    image: Image, planes: int, scale: float, weight: Array, window: Window, where: Array, start: Indices, level: float
) -> tuple[float, float]:
    """Where the samples of a cell lie on the average: planes of a mosaic stand a pixel apart.

    A plane counts by its share of what the region holds over the contour at `level`, which lies between the samples
    inside that have a neighbour outside and the reverse. It follows from the derivative of the balance by a plane's
    place.
    """
    if planes != 4:
        return 0.0, 0.0
    stamp, mark, unit = window[1], window[1][start[1], start[0]], int(where[patch.UNIT])
    rim, count = np.zeros((2, 5)), np.zeros((2, 2))  # outside, inside; planes and their mean
    a = b = c = d = 0.0  # of the planes inside
    sums, rows, columns = window[3], int(where[patch.ROWS]), int(where[patch.COLUMNS])
    left, right = max(int(sums[patch.FIRST_COLUMN]) - 1, 1), min(int(sums[patch.LAST_COLUMN]) + 2, columns - 1)
    for i in range(max(int(sums[patch.FIRST_ROW]) - 1, 1), min(int(sums[patch.LAST_ROW]) + 2, rows - 1)):
        y = int(where[patch.TOP]) + i * unit
        for j in range(left, right):
            inside = int(stamp[i, j] == mark)
            alike = (stamp[i - 1, j] == mark) + (stamp[i + 1, j] == mark)
            alike += (stamp[i, j - 1] == mark) + (stamp[i, j + 1] == mark)
            on_rim = alike < 4 if inside else alike > 0
            if not (inside or on_rim):
                continue
            x = int(where[patch.LEFT]) + j * unit
            value = (
                scale * samples.sample(image, planes, 0, y, x),
                scale * samples.sample(image, planes, 1, y, x),
                scale * samples.sample(image, planes, 2, y, x),
                scale * samples.sample(image, planes, 3, y, x),
            )
            if inside:
                a, b, c, d = a + value[0], b + value[1], c + value[2], d + value[3]
            count[inside, 0] += 1.0
            if not on_rim:
                continue
            count[inside, 1] += 1.0
            mixed = 0.0
            for p in range(4):
                mixed += weight[p] * value[p]
                rim[inside, p] += value[p]
            rim[inside, 4] += mixed
    share, total = weight.copy(), (a, b, c, d)
    if count[0, 1] > 0.0 and count[1, 1] > 0.0:
        inner, outer = rim[1] / count[1, 1], rim[0] / count[0, 1]
        part = min(max((inner[4] - level) / max(inner[4] - outer[4], 1e-6), 0.0), 1.0)
        for p in range(4):
            contour = inner[p] + part * (outer[p] - inner[p])
            share[p] *= max(total[p] / count[1, 0] - contour, 0.0)
    if share.sum() <= 0.0:
        share[:] = weight
    return float((share[1] + share[3]) / share.sum()), float((share[2] + share[3]) / share.sum())


@njit(error_model="numpy")
def _edge(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    window: Window,
    where: Array,
    start: Indices,
    floor: float,
    top: float,
) -> float:
    """Width px of a spot's edge, from its region, grown last, to its inside of nine tenths of the height.

    In the picture as it is, for the window may be smoothed. Infinite for a wide spot.
    """
    stamp, sums, mark, unit = window[1], window[3], window[1][start[1], start[0]], int(where[patch.UNIT])
    area = sums[patch.N]
    if area * unit * unit > _WIDEST_PX2:
        return np.inf
    high, inner = floor + _PLATEAU * (top - floor), 0.0
    for i in range(int(sums[patch.FIRST_ROW]), int(sums[patch.LAST_ROW]) + 1):
        for j in range(int(sums[patch.FIRST_COLUMN]), int(sums[patch.LAST_COLUMN]) + 1):
            if stamp[i, j] == mark:
                y, x, value = int(where[patch.TOP]) + i * unit, int(where[patch.LEFT]) + j * unit, 0.0
                for p in range(planes):
                    value += weight[p] * scale * samples.sample(image, planes, p, y, x)
                inner += value > high
    return float((np.sqrt(area / np.pi) - np.sqrt(inner / np.pi)) * unit)


@njit(error_model="numpy")
def _steepness(planes: int, edge: float) -> float:
    """How many times the error that the grid leaves to a smooth spot is that of one with an edge so wide.

    That of an overexposed light is narrower than a sample, whose values then hardly tell where it is.
    """
    wide = edge * (1.0 if planes == 3 else _FINER)
    return float(min(1.0 + _STEEP * np.exp((_STEEP_PX - wide) / _NARROW_PX), _STEEPEST))


@njit(error_model="numpy")
def _skew(
    image: Image, window: Window, where: Array, start: Indices, level: float, soft: float, q: Array, unit: float
) -> tuple[float, float]:
    """How far the centre moves, px, when the spot is cut out higher: what an uneven halo or a glint does to it."""
    sums = window[3]
    x, y = sums[patch.WX] / sums[patch.W], sums[patch.WY] / sums[patch.W]
    kept = sums.copy()
    patch.grow(window, where, image, start[0], start[1], level, q[fields.CLIPPED], _SKEW_MARK)
    skew = (0.0, 0.0)
    if sums[patch.N] >= 4.0:
        patch.soften(window, where, start, level, level - soft)
        skew = unit * (sums[patch.WX] / sums[patch.W] - x), unit * (sums[patch.WY] / sums[patch.W] - y)
    sums[:] = kept
    return skew


@njit(error_model="numpy")
def _disagreement(du: float, dv: float, expected: float) -> tuple[float, float, float]:
    """Covariance by two estimates of a centre, for what they differ beyond two sigma: its profile is uneven."""
    square = du * du + dv * dv
    share = max(1.0 - 4.0 * expected / max(square, 1e-12), 0.0)
    return share * du * du, share * du * dv, share * dv * dv


@njit(error_model="numpy")
def _unresolved(sums: Array, q: Array, unit: float) -> tuple[float, float, float]:
    """Covariance of a region too long for one light: two that are not told apart, and either may be the one meant."""
    uu, uv, vv = patch.moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    if sums[patch.N] < 12.0 or np.sqrt(max(half - turn, 0.0) / (half + turn)) > q[fields.MIN_ELONGATION] or turn <= 0.0:
        return 0.0, 0.0, 0.0
    excess = unit * unit
    return excess * (turn + 0.5 * (uu - vv)), excess * uv, excess * (turn - 0.5 * (uu - vv))


@njit(error_model="numpy")
def _is_known(spots: Array, n: int) -> bool:
    for k in range(n):
        du, dv = spots[k, fields.U] - spots[n, fields.U], spots[k, fields.V] - spots[n, fields.V]
        near = max(0.7 * spots[k, fields.RADIUS], 1.5)
        if abs(du) < near and abs(dv) < near and np.hypot(du, dv) < near:
            return True
    return False
