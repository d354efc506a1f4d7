"""A grown spot described: its centre and covariance, radius, flux and shape."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import fast_part, part
from lumidock._kernels.detection import fields, gauss, patch, region, samples
from lumidock._kernels.detection.patch import CloseUp
from lumidock._kernels.detection.samples import Picture
from lumidock.datatypes import Array, Image

FILTER_PX = 1.2  # width of the window that judges a small spot ...
_FILTERED_PX = 3.0  # ... up to this radius
_GRID, _GRID_OF_MOSAIC = 0.015, 0.05  # 1 sigma, of a sample's side, that the grid leaves to a small spot's balance
_GRID_OF_FIELD = 0.1  # px, the same of the way between fields, of which each has every other row
_WIDTHS = 3  # times the width of what stands over the noise, from which a fit is tried: faint flanks are not seen
_WIDTH, _LEAST_WIDTH = 1.0 / 1.18, 0.8  # of a Gaussian, in radii at half its height; px
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
_NO, _YES = np.float32(0.0), np.float32(1.0)
Center = tuple[float, float]
Cov = tuple[float, float, float]  # uu, uv, vv


@part
def describe(
    picture: Picture, close: CloseUp, u: int, v: int, share: float, shared: float, q: Array, spots: Array, n: int
) -> bool:
    """Fill `spots[n]` from the grown region; False for what is too faint, or a spot that is there already."""
    spot, sums, ground, where, mosaic = spots[n], close.sums, close.ground, close.where, picture.planes == 4
    floor, top = ground[patch.LEVEL], close.part[where[patch.START_Y], where[patch.START_X]]
    level = floor + share * (top - floor)
    _size(close, level, shared, spot)
    if spot[fields.SNR] < q[fields.MIN_SNR] or _is_known(spots, n):
        return False
    spot[fields.LEVEL] = share
    radius, halo = spot[fields.RADIUS], _around(close) / (top - floor)
    merged = _unresolved(sums, q, float(where[patch.UNIT]))
    small = radius <= q[fields.SMALL_PX] * (1.6 if mosaic else 1.0)
    if where[patch.UNIT] > (2 if mosaic else 1):  # again, as finely as the room allows
        room = gauss.REACH + 3.0 if small else 0.0
        patch.cut(picture, v, u, max(1.6 * radius + 3.0, room), patch.SIDE, close)
        peak_value(close)
        region.grow(picture, close, level, q[fields.CLIPPED])
    variance = ground[patch.NOISE] ** 2 + q[fields.SIGNAL_NOISE] * max(sums[region.W] / sums[region.N], 0.0)
    cut_off = sums[region.EDGE] > 0.0
    edge = _edge(close, floor + _PLATEAU * (top - floor))
    lower = level - _SOFT * (top - floor) * min(max(_BROAD_PX - edge, 0.0), 1.0)
    between_u, between_v = region.soften(close, lower)
    center, cov = _balanced(close, variance * gauss.averaging(ground[patch.SHARED], radius), mosaic, lower)
    grid = _GRID_OF_MOSAIC if mosaic else _GRID
    noise_of_balance = cov[0] + cov[2] + 2.0 * (grid * where[patch.UNIT]) ** 2
    width = 0.0
    if small and not cut_off:
        width, fine, fine_cov = _fitted(picture.planes, close, center, radius, q)
        if width > 0.0:
            merged = _disagreement(fine[0] - center[0], fine[1] - center[1], noise_of_balance)
            spot[fields.RADIUS] = width / _WIDTH
            center, cov = fine, fine_cov
    if width == 0.0:
        steep = _steepness(picture.planes, edge) if spot[fields.CORE] > _BURNT * q[fields.CLIPPED] else 1.0
        haze = _HAZE * min(max(halo, 0.0), 1.0) * min(radius / _HAZE_PX, 1.0)
        on_grid = q[fields.SATURATED_PX] * steep * where[patch.UNIT]
        astray = on_grid**2 * where[patch.UNIT] / radius + haze**2
        cov = _with_skew(picture, close, center, cov, level + 0.5 * (top - level), level - lower, astray, q)
    apart = _disagreement(_BETWEEN * between_u, _BETWEEN * between_v, noise_of_balance + 2.0 * _GRID_OF_FIELD**2)
    spot[fields.U], spot[fields.V] = center
    least = _floor(picture.planes, close.weight, spot, cut_off, q)
    least += (q[fields.TEXTURE] * ground[patch.MOVES] * radius / (top - floor)) ** 2
    spot[fields.VAR_UU] = cov[0] + least + merged[0] + apart[0]
    spot[fields.VAR_UV] = spot[fields.VAR_VU] = cov[1] + merged[1] + apart[1]
    spot[fields.VAR_VV] = cov[2] + least + merged[2] + apart[2]
    return not _is_known(spots, n)


@part
def _balanced(close: CloseUp, variance: float, mosaic: bool, lower: float) -> tuple[Center, Cov]:
    """The balance of the region with its soft edge, over `lower`, and its covariance by noise of a `variance`."""
    where, unit = close.where, float(close.where[patch.UNIT])
    x, y, xx, xy, yy = region.balance(close.sums, variance)
    shift_u, shift_v = _plane_shift(close, lower) if mosaic else (0.0, 0.0)
    u = where[patch.LEFT] + unit * (where[patch.START_X] + x) + shift_u
    v = where[patch.TOP] + unit * (where[patch.START_Y] + y) + shift_v
    return (u, v), (unit * unit * xx, unit * unit * xy, unit * unit * yy)


@part
def _fitted(planes: int, close: CloseUp, center: Center, radius: float, q: Array) -> tuple[float, Center, Cov]:
    """Width, centre and covariance of the Gaussian that fits best, from the width that the radius gives or a wider."""
    noise = close.ground[patch.NOISE]
    if planes == 4:
        rim = close.ground[patch.RIM] / np.sqrt(samples.square(close.weight))
        noise = max(rim, _LEAST_NOISE * q[fields.MIN_NOISE])
    coarse, width = _is_coarse(planes, close.weight), max(_WIDTH * radius, _LEAST_WIDTH)
    for times in range(1, _WIDTHS + 1):
        s, u, v, uu, uv, vv = gauss.fit(
            close, planes, center, width * times, noise, q[fields.SIGNAL_NOISE], coarse, q[fields.CLIPPED]
        )
        if s > 0.0:
            return s, (u, v), (uu, uv, vv)
    return 0.0, center, (0.0, 0.0, 0.0)


@part
def _with_skew(
    picture: Picture, close: CloseUp, center: Center, cov: Cov, higher: float, soft: float, astray: float, q: Array
) -> Cov:
    """Covariance of a balance with what an uneven halo or a glint does to it, and any way the variance `astray`.

    That is how far the centre moves when the spot is cut out higher.
    """
    region.grow(picture, close, higher, q[fields.CLIPPED])
    unit, skewed = float(close.where[patch.UNIT]), (0.0, 0.0, 0.0)
    if close.sums[region.N] >= 4.0:
        region.soften(close, higher - soft)
        other, _ = _balanced(close, 1.0, picture.planes == 4, higher - soft)
        # the higher region is a part of the lower one, so that half of their noise is common
        common = 0.5 * (cov[0] + cov[2] + 2.0 * (_GRID * unit) ** 2)
        skewed = _disagreement(other[0] - center[0], other[1] - center[1], common)
    # half of it along the skew, half of it any way: a grid skews a spot one way and displaces it another
    astray += 0.25 * (skewed[0] + skewed[2])
    return cov[0] + 0.5 * skewed[0] + astray, cov[1] + 0.5 * skewed[1], cov[2] + 0.5 * skewed[2] + astray


@part
def _size(close: CloseUp, level: float, shared: float, spot: Array) -> None:
    """What the region grown at `level` says of a spot: all but its exact centre and covariance."""
    sums, where, ground, unit = close.sums, close.where, close.ground, float(close.where[patch.UNIT])
    area = sums[region.N]
    x, y = where[patch.START_X] + sums[region.X] / area, where[patch.START_Y] + sums[region.Y] / area
    spot[fields.U], spot[fields.V] = where[patch.LEFT] + unit * x, where[patch.TOP] + unit * y
    spot[fields.RADIUS] = np.sqrt(area / np.pi) * unit
    flux = sums[region.W] + area * (level - ground[patch.LEVEL])
    spot[fields.FLUX] = flux * unit * unit
    spot[fields.SNR] = flux / (area * np.sqrt(shared * ground[patch.NOISE] ** 2 / area + ground[patch.HIDES] ** 2))
    if spot[fields.RADIUS] < _FILTERED_PX:
        spot[fields.SNR] = small_snr(close, x, y, max(FILTER_PX / unit, 0.7), shared)
    spot[fields.ELONGATION], spot[fields.FILL] = region.shape(sums)
    spot[fields.SATURATED], spot[fields.CUT] = sums[region.CLIPPED] / area, sums[region.EDGE] / area


@part
def _floor(planes: int, weight: Array, spot: Array, cut_off: bool, q: Array) -> float:
    """Variance of a centre that has no noise."""
    variance = q[fields.FLOOR_PX] ** 2
    if _is_coarse(planes, weight):  # along a longer outline the error of a sample averages out
        variance = q[fields.COARSE_PX] ** 2 * min(q[fields.SMALL_PX] / spot[fields.RADIUS], 1.0)
    if cut_off:
        variance += (q[fields.CUT_SHARE] * spot[fields.RADIUS]) ** 2
    return float(variance)


@part
def _is_coarse(planes: int, weight: Array) -> bool:
    """Whether a spot shows most in a colour that has half of the samples: blue or red."""
    return bool(planes == 3 and weight[1] < max(weight[0], weight[2]))


@part
def small_snr(close: CloseUp, x: float, y: float, width: float, shared: float) -> float:
    """How far a Gaussian window stands out of noise, which averages out in it, and texture, which does not."""
    ground = close.ground
    amplitude, averaged = patch.filtered(close, x, y, width, ground[patch.LEVEL])
    return float(amplitude / np.sqrt(shared * ground[patch.NOISE] ** 2 / averaged + ground[patch.HIDES] ** 2))


@part
def peak_value(close: CloseUp) -> float:
    """Largest sample around the start of a spot, which becomes its start."""
    where, best = close.where, -1e9
    left, top = max(where[patch.START_X] - 1, 0), max(where[patch.START_Y] - 1, 0)
    right, bottom = (
        min(where[patch.START_X] + 2, where[patch.COLUMNS]),
        min(where[patch.START_Y] + 2, where[patch.ROWS]),
    )
    for y in range(top, bottom):
        for x in range(left, right):
            if close.part[y, x] > best:
                best = close.part[y, x]
                where[patch.START_X], where[patch.START_Y] = x, y
    return best


@part
def holds_another(close: CloseUp, spots: Array, n: int) -> bool:
    """Whether the grown region covers the centre of a spot found before."""
    where, unit = close.where, float(close.where[patch.UNIT])
    for k in range(n):
        x = int((spots[k, fields.U] - where[patch.LEFT]) / unit + 0.5)
        y = int((spots[k, fields.V] - where[patch.TOP]) / unit + 0.5)
        inside = 0 <= x < where[patch.COLUMNS] and 0 <= y < where[patch.ROWS]
        if inside and close.stamp[y + 1, x + 1] == where[patch.MARK]:
            return True
    return False


@part
def _around(close: CloseUp) -> float:
    """Mean level over the floor on a circle around a region's centre, of twice its radius."""
    sums, where, total, count = close.sums, close.where, 0.0, 0
    radius = 2.0 * np.sqrt(sums[region.N] / np.pi) + 1.0
    x = where[patch.START_X] + sums[region.X] / sums[region.N]
    y = where[patch.START_Y] + sums[region.Y] / sums[region.N]
    for k in range(0, samples.RING, 2):
        a, b = int(x + radius * samples.COS[k] + 0.5), int(y + radius * samples.SIN[k] + 0.5)
        if 0 <= a < where[patch.COLUMNS] and 0 <= b < where[patch.ROWS]:
            total += close.part[b, a] - close.ground[patch.LEVEL]
            count += 1
    return total / max(count, 1)


@part
def _plane_shift(close: CloseUp, level: float) -> Center:
    """Where the samples of a mosaic's cell lie on the average: its planes stand a pixel apart.

    A plane counts by its share of what the region holds over the contour at `level`, which lies between the samples
    inside that have a neighbour outside and the reverse. It follows from the derivative of the balance by a plane's
    place.
    """
    weight, sums, where, mark = close.weight, close.sums, close.where, np.int32(close.where[patch.MARK])
    left = max(int(sums[region.FIRST_COLUMN]) - 1, 1)
    right = min(int(sums[region.LAST_COLUMN]) + 2, where[patch.COLUMNS] - 1)
    upper = max(int(sums[region.FIRST_ROW]) - 1, 1)
    down = min(int(sums[region.LAST_ROW]) + 2, where[patch.ROWS] - 1)
    t = close.rings  # rows: planes; columns: all inside, those of them at the rim, those outside at the rim
    t[:5, :3] = 0.0
    ones = close.lines[0, : max(right - left, 0)]
    ones[:] = 1.0
    for i in range(upper, down):
        above, below = close.taken[i, left + 1 : right + 1], close.taken[i + 2, left + 1 : right + 1]
        here = close.taken[i + 1, left : right + 2]
        _add_rims(ones, above, here, below, mark, t[4])
        for p in range(4):
            _add_rims(close.stack[p, i, left:right], above, here, below, mark, t[p])
    inside, inner_rim, outer_rim = max(t[4, 0], _YES), t[4, 1], t[4, 2]
    part = 0.0
    if inner_rim > 0.0 and outer_rim > 0.0:
        inner_mean, outer_mean = 0.0, 0.0
        for p in range(4):
            inner_mean += weight[p] * t[p, 1] / inner_rim
            outer_mean += weight[p] * t[p, 2] / outer_rim
        part = min(max((inner_mean - level) / max(inner_mean - outer_mean, 1e-6), 0.0), 1.0)
    total, x, y = 0.0, 0.0, 0.0
    for p in range(4):
        share = weight[p]
        if inner_rim > 0.0 and outer_rim > 0.0:
            contour = t[p, 1] / inner_rim + part * (t[p, 2] / outer_rim - t[p, 1] / inner_rim)
            share *= max(t[p, 0] / inside - contour, 0.0)
        total, x, y = total + share, x + share * (p & 1), y + share * (p >> 1)
    if total <= 0.0:
        return weight[1] + weight[3], weight[2] + weight[3]
    return x / total, y / total


@fast_part
def _add_rims(values: Array, above: Image, here: Image, below: Image, mark: np.int32, sums: Array) -> None:
    """Add a row's samples inside of a region, those of them beside one outside, and those outside beside one inside."""
    inside, inner_rim, outer_rim = _NO, _NO, _NO
    for k in range(len(values)):
        mine = here[k + 1] == mark
        beside = (above[k] == mark) | (below[k] == mark) | (here[k] == mark) | (here[k + 2] == mark)
        whole = (above[k] == mark) & (below[k] == mark) & (here[k] == mark) & (here[k + 2] == mark)
        inside += values[k] if mine else _NO
        inner_rim += values[k] if mine & (not whole) else _NO
        outer_rim += values[k] if beside & (not mine) else _NO
    sums[0] += inside
    sums[1] += inner_rim
    sums[2] += outer_rim


@fast_part
def _edge(close: CloseUp, high: float) -> float:
    """Width px of a spot's edge, from its region, grown last, to its inside over the `high` level.

    In the picture as it is, for the close-up may be smoothed. Infinite for a wide spot.
    """
    sums, where, mark = close.sums, close.where, np.int32(close.where[patch.MARK])
    area, unit, inside = sums[region.N], float(where[patch.UNIT]), _NO
    if area * unit * unit > _WIDEST_PX2:
        return np.inf
    left, right = int(sums[region.FIRST_COLUMN]), int(sums[region.LAST_COLUMN]) + 1
    w0, w1 = np.float32(close.weight[0]), np.float32(close.weight[1])
    w2, w3, limit = np.float32(close.weight[2]), np.float32(close.weight[3]), np.float32(high)
    for i in range(int(sums[region.FIRST_ROW]), int(sums[region.LAST_ROW]) + 1):
        marks, a, b = (
            close.stamp[i + 1, left + 1 : right + 1],
            close.stack[0, i, left:right],
            close.stack[1, i, left:right],
        )
        c, d = close.stack[2, i, left:right], close.stack[3, i, left:right]
        for j in range(right - left):
            mixed = w0 * a[j] + w1 * b[j] + w2 * c[j] + w3 * d[j]
            inside += _YES if (marks[j] == mark) & (mixed > limit) else _NO
    return float((np.sqrt(area / np.pi) - np.sqrt(inside / np.pi)) * unit)


@part
def _steepness(planes: int, edge: float) -> float:
    """How many times the error that the grid leaves to a smooth spot is that of one with an edge so wide.

    That of an overexposed light is narrower than a sample, whose values then hardly tell where it is.
    """
    wide = edge * (1.0 if planes == 3 else _FINER)
    return float(min(1.0 + _STEEP * np.exp((_STEEP_PX - wide) / _NARROW_PX), _STEEPEST))


@part
def _disagreement(du: float, dv: float, expected: float) -> Cov:
    """Covariance by two estimates of a centre, for what they differ beyond two sigma: its profile is uneven."""
    square = du * du + dv * dv
    share = max(1.0 - 4.0 * expected / max(square, 1e-12), 0.0)
    return share * du * du, share * du * dv, share * dv * dv


@part
def _unresolved(sums: Array, q: Array, unit: float) -> Cov:
    """Covariance of a region too long for one light: two that are not told apart, and either may be the one meant."""
    uu, uv, vv = region.moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    if (
        sums[region.N] < 12.0
        or np.sqrt(max(half - turn, 0.0) / (half + turn)) > q[fields.MIN_ELONGATION]
        or turn <= 0.0
    ):
        return 0.0, 0.0, 0.0
    excess = unit * unit
    return excess * (turn + 0.5 * (uu - vv)), excess * uv, excess * (turn - 0.5 * (uu - vv))


@part
def _is_known(spots: Array, n: int) -> bool:
    for k in range(n):
        du, dv = spots[k, fields.U] - spots[n, fields.U], spots[k, fields.V] - spots[n, fields.V]
        near = max(0.7 * spots[k, fields.RADIUS], 1.5)
        if abs(du) < near and abs(dv) < near and np.hypot(du, dv) < near:
            return True
    return False
