"""A grown spot described: its centre and covariance, radius, flux and shape."""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock._kernels import fields, gauss, patch
from lumidock._kernels.patch import Window
from lumidock.datatypes import Array, Image, Indices

FILTER_PX = 1.2  # width of the window that judges a small spot ...
_FILTERED_PX = 3.0  # ... up to this radius
_FINE_MARK, _SKEW_MARK = 100, 101  # of regions grown again, beside those of the levels tried


@njit(cache=True)
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
    floor, noise = ground[0], ground[1]
    top = window[0][start[1], start[0]]
    level = floor + share * (top - floor)
    unit = where[patch.UNIT]
    area = sums[patch.N]
    radius = np.sqrt(area / np.pi) * unit
    spot[fields.HALO] = _around(window[0], where, start, sums, 2.0, floor) / max(top - floor, 1e-6)
    flux = sums[patch.W] + area * (level - floor)
    snr = flux / (area * np.sqrt(shared * noise**2 / area + ground[2] ** 2))
    if radius < _FILTERED_PX:
        x, y = start[0] + sums[patch.X] / area, start[1] + sums[patch.Y] / area
        snr = small_snr(window[0], where, x, y, max(FILTER_PX / unit, 0.7), ground, shared)
    if snr < q[fields.MIN_SNR]:
        return False
    pitch = 2.0 if planes == 4 else 1.0
    spot[fields.RADIUS], spot[fields.FLUX], spot[fields.SNR], spot[fields.LEVEL] = (
        radius,
        flux * unit * unit,
        snr,
        share,
    )
    spot[fields.ELONGATION], spot[fields.FILL] = patch.shape(sums)
    spot[fields.SATURATED], spot[fields.CUT] = sums[patch.CLIPPED] / area, sums[patch.EDGE] / area
    spread = _unresolved(sums, q, unit)
    slope_u, slope_v = where[patch.SLOPE_U], where[patch.SLOPE_V]
    skew_u, skew_v = _skew(image, window, where, start, level + 0.5 * (top - level), q, unit)
    if unit > pitch:  # again, as finely as the room allows
        patch.cut(image, planes, scale, weight, v, u, 1.6 * radius + 3.0, patch.SIDE, window[0], where)
        unit = where[patch.UNIT]
        start[0], start[1] = index(u, where[0], where[2], where[3]), index(v, where[1], where[2], where[4])
        peak_value(window[0], where, start)
        patch.grow(window, where, image, start[0], start[1], level, q[fields.CLIPPED], _FINE_MARK)
        area = sums[patch.N]
    center, cov = np.empty(2), np.empty(3)
    variance = noise**2 + q[fields.SIGNAL_NOISE] * max(sums[patch.W] / area, 0.0)
    patch.balance(sums, variance * shared, center, cov)
    cov *= unit * unit
    shift_u, shift_v = _plane_shift(weight, planes, spot[fields.SATURATED] > 0.0)
    center[0] = where[patch.LEFT] + unit * (start[0] + center[0]) + shift_u
    center[1] = where[patch.TOP] + unit * (start[1] + center[1]) + shift_v
    fitted = False
    slope = (slope_u, slope_v) if planes < 4 else (0.0, 0.0)
    if radius <= q[fields.SMALL_PX] * (1.6 if planes == 4 else 1.0) and sums[patch.EDGE] == 0.0:
        sample_noise = noise if planes < 4 else max(noise / np.sqrt((weight**2).sum()), q[fields.MIN_NOISE])
        width = gauss.fit(
            image,
            planes,
            scale,
            weight,
            slope,
            center,
            max(radius / 1.18, 0.8),
            sample_noise,
            q[fields.SIGNAL_NOISE],
            q[fields.CLIPPED],
            cov,
        )
        if width > 0.0:
            fitted = True
            cov *= shared
            spot[fields.RADIUS] = 1.18 * width
    spot[fields.U], spot[fields.V] = center
    coarse = planes == 3 and weight[1] < max(weight[0], weight[2])
    floor_px = (q[fields.COARSE_PX] if coarse else q[fields.FLOOR_PX]) ** 2 + (
        q[fields.SATURATED_PX] ** 2 if spot[fields.SATURATED] > 0.0 else 0.0
    )
    if sums[patch.EDGE] > 0.0:
        floor_px += (q[fields.CUT_SHARE] * radius) ** 2
    if not fitted:
        spread = spread[0] + skew_u * skew_u, spread[1] + skew_u * skew_v, spread[2] + skew_v * skew_v
    spot[fields.VAR_UU] = cov[0] + floor_px + spread[0]
    spot[fields.VAR_UV] = cov[1] + spread[1]
    spot[fields.VAR_VV] = cov[2] + floor_px + spread[2]
    return not _is_known(spots, n)


@njit(cache=True)
def small_snr(part: Array, where: Array, x: float, y: float, width: float, ground: Array, shared: float) -> float:
    """How far a Gaussian window stands out of noise, which averages out in it, and texture, which does not."""
    amplitude, averaged = patch.filtered(part, where, x, y, width, ground[0])
    return float(amplitude / np.sqrt(shared * ground[1] ** 2 / averaged + ground[2] ** 2))


@njit(cache=True)
def index(x: int, first: float, unit: float, count: float) -> int:
    """Sample of a window that holds pixel `x`."""
    return min(int((x - first) / unit), int(count) - 1)


@njit(cache=True)
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
    patch.grow(window, where, image, start[0], start[1], level, q[fields.CLIPPED], _SKEW_MARK)
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
    if sums[patch.N] < 12.0 or np.sqrt(max(half - turn, 0.0) / (half + turn)) > q[fields.MIN_ELONGATION] or turn <= 0.0:
        return 0.0, 0.0, 0.0
    excess = unit * unit
    return excess * (turn + 0.5 * (uu - vv)), excess * uv, excess * (turn - 0.5 * (uu - vv))


@njit(cache=True)
def _is_known(spots: Array, n: int) -> bool:
    for k in range(n):
        if np.hypot(spots[k, fields.U] - spots[n, fields.U], spots[k, fields.V] - spots[n, fields.V]) < max(
            0.7 * spots[k, fields.RADIUS], 1.5
        ):
            return True
    return False
