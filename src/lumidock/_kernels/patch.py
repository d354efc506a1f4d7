"""One light in a small window: cut out, flattened, grown at the level where it is round and alone, and its centre.

Samples come as (H, W, C) of an unsigned type, 1 or 3 channels, or one channel that is a Bayer mosaic. A window is one
plane of floats in 8-bit grey levels: the planes (colours) weighted by how far the light stands out in each. Large
windows are thinned out.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lumidock.datatypes import Array, Image

COARSE_SIDE, SIDE = 32, 48  # samples a side of the window that finds a spot's level, and of the one that measures it
_ROOM = SIDE + 16
_RING = 24  # samples on a ring
_COS, _SIN = np.cos(np.arange(_RING) * 2.0 * np.pi / _RING), np.sin(np.arange(_RING) * 2.0 * np.pi / _RING)
_ROOT_TWO = np.sqrt(2.0)
_FIT_ROUNDS, _FIT_REACH = 6, 9
_PRIOR_DOF = 20.0  # how much the expected noise counts beside the residuals of a fit
# entries of `sums`, see `grow`; weights w are over the level
N, X, Y, XX, XY, YY, W, WX, WY, CLIPPED, EDGE, OPEN = range(12)
# the window's geometry, see `cut`
LEFT, TOP, UNIT, COLUMNS, ROWS, SLOPE_U, SLOPE_V = range(7)
Window = tuple[Array, NDArray[np.int16], NDArray[np.int32], Array]


@njit(cache=True)
def sample(image: Image, planes: int, p: int, v: int, u: int) -> float:
    """One sample of plane `p` at pixel or, on a mosaic, in the 2 x 2 cell of a pixel."""
    if planes == 1:
        return float(image[v, u, 0])
    if planes == 3:
        return float(image[v, u, p])
    return float(image[min((v & -2) + (p >> 1), image.shape[0] - 1), min((u & -2) + (p & 1), image.shape[1] - 1), 0])


@njit(cache=True)
def weigh(image: Image, planes: int, scale: float, v: int, u: int, radius: float, weight: Array) -> None:
    """Write each plane's `weight` (4,), their sum 1, for a light of about `radius` px at a pixel.

    Planes count by how far they stand out of a ring, as in the best filter for equal noise.
    """
    weight[:] = 0.0
    if planes == 1:
        weight[0] = 1.0
        return
    for p in range(planes):
        dark = ring_mean(image, planes, scale, p, v, u, 3.0 * radius)
        weight[p] = max(core_mean(image, planes, scale, p, v, u) - dark, 0.0)
    total = weight.sum()
    if total <= 0.0:
        weight[:planes], total = 1.0, float(planes)
    weight /= total


@njit(cache=True)
def weigh_clipped(
    image: Image, planes: int, scale: float, v: int, u: int, least: float, largest: float, weight: Array
) -> float:
    """The same for a saturated light: only the planes in which it is smallest count. Returns its radius there, or 0.

    A saturated core in its halo is small where its colour is weak: the red of a blue lamp. The radius is that of the
    first ring at half height over the ring three times as wide; a plane must stand out by `least`.
    """
    weight[:] = 0.0
    radii = np.full(4, np.inf)
    for p in range(planes):
        top, radius = core_mean(image, planes, scale, p, v, u), 3.0
        while radius < largest:
            dark = ring_mean(image, planes, scale, p, v, u, 3.0 * radius)
            if top - dark >= least and ring_mean(image, planes, scale, p, v, u, radius) <= 0.5 * (top + dark):
                radii[p] = radius
                break
            radius *= 1.25
    smallest = radii.min()
    if not np.isfinite(smallest):
        return 0.0
    for p in range(planes):
        weight[p] = 1.0 if radii[p] <= 1.3 * smallest else 0.0
    weight /= weight.sum()
    return float(smallest)


@njit(cache=True)
def core_mean(image: Image, planes: int, scale: float, p: int, v: int, u: int) -> float:
    """Mean of a plane over 3 x 3 of its samples around a pixel."""
    pitch = 2 if planes == 4 else 1
    total, count = 0.0, 0
    for y in range(max(v - pitch, 0), min(v + pitch + 1, image.shape[0]), pitch):
        for x in range(max(u - pitch, 0), min(u + pitch + 1, image.shape[1]), pitch):
            total += sample(image, planes, p, y, x)
            count += 1
    return scale * total / count


@njit(cache=True)
def ring_mean(image: Image, planes: int, scale: float, p: int, v: int, u: int, radius: float) -> float:
    """Mean of the second quarter of twelve samples of a plane on a circle around a pixel, 0 where it is outside.

    So nearly half of the circle may lie on something brighter.
    """
    ordered, count = np.empty(12), 0
    for k in range(0, _RING, 2):
        x, y = int(u + radius * _COS[k] + 0.5), int(v + radius * _SIN[k] + 0.5)
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            count = _insert(ordered, count, sample(image, planes, p, y, x))
    if count == 0:
        return 0.0
    return float(scale * ordered[count // 4 : count // 2 + 1].mean())


@njit(cache=True)
def stands_out(
    image: Image, planes: int, scale: float, p: int, v: int, u: int, radius: float, noise: float, least: float
) -> bool:
    """Whether 3 x 3 samples clear a ring by `least` times its scatter or the noise: cheap enough for every candidate.

    Of opposite samples, whose mean no slope moves.
    """
    means, count = np.empty(_RING // 4), 0
    for k in range(0, _RING // 2, 2):
        x, y = int(np.floor(radius * _COS[k] + 0.5)), int(np.floor(radius * _SIN[k] + 0.5))
        if min(u - abs(x), v - abs(y)) < 0 or u + abs(x) >= image.shape[1] or v + abs(y) >= image.shape[0]:
            continue
        both = sample(image, planes, p, v + y, u + x) + sample(image, planes, p, v - y, u - x)
        count = _insert(means, count, 0.5 * scale * both)
    if count < len(means):
        return True
    level = means[1:5].mean()
    spread = _ROOT_TWO * (means[4] - means[1]) / 1.35
    over = core_mean(image, planes, scale, p, v, u) - level
    return over >= least * max(noise, spread)


@njit(cache=True)
def _insert(ordered: Array, count: int, value: float) -> int:
    """Insert into the first `count` of the sorted values; returns the new count."""
    k = count
    while k > 0 and ordered[k - 1] > value:
        ordered[k] = ordered[k - 1]
        k -= 1
    ordered[k] = value
    return count + 1


@njit(cache=True)
def cut(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    v: int,
    u: int,
    reach: float,
    side: int,
    patch: Array,
    where: Array,
) -> None:
    """Fill `patch` with the window of `reach` px around a pixel, thinned out to about `side` samples a side.

    `where` becomes its left, top, unit, columns, rows.
    """
    pitch = 2 if planes == 4 else 1
    unit = pitch * max(int(np.ceil(2.0 * reach / (pitch * side))), 1)
    left, top = max(u - int(reach), 0) // pitch * pitch, max(v - int(reach), 0) // pitch * pitch
    columns = min((min(u + int(reach) + 1, image.shape[1]) - left) // unit, _ROOM)
    rows = min((min(v + int(reach) + 1, image.shape[0]) - top) // unit, _ROOM)
    where[0], where[1], where[2], where[3], where[4] = left, top, unit, max(columns, 1), max(rows, 1)
    for i in range(max(rows, 1)):
        y = top + i * unit
        for j in range(max(columns, 1)):
            x = left + j * unit
            if planes == 1:
                patch[i, j] = scale * image[y, x, 0]
            elif planes == 3:
                mixed = weight[0] * image[y, x, 0] + weight[1] * image[y, x, 1] + weight[2] * image[y, x, 2]
                patch[i, j] = scale * mixed
            else:
                total = 0.0
                for p in range(4):
                    total += weight[p] * sample(image, planes, p, y, x)
                patch[i, j] = scale * total


@njit(cache=True)
def flatten(patch: Array, where: Array, x: float, y: float, radius: float) -> tuple[float, float]:
    """Level and spread (1 sigma) of the ring of `radius` around a sample, whose slope is taken out of the patch.

    The slope is what a neighbour's halo adds: by least squares, from opposite samples within Tukey's fences. The level
    is the mean of the middle half, the spread from the quartiles.
    """
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    values, ordered = np.empty(_RING), np.empty(_RING)
    count = 0
    for k in range(_RING):
        a, b = int(np.floor(x + radius * _COS[k] + 0.5)), int(np.floor(y + radius * _SIN[k] + 0.5))
        values[k] = np.nan
        if 0 <= a < columns and 0 <= b < rows:
            values[k] = patch[b, a]
            count = _insert(ordered, count, patch[b, a])
    if count == 0:
        return 0.0, 0.0
    quarter = count // 4
    low, high = ordered[quarter], ordered[count - 1 - quarter]
    fence = 1.5 * (high - low)
    gx, gy, opposite = 0.0, 0.0, 0
    where[SLOPE_U], where[SLOPE_V] = 0.0, 0.0
    for k in range(_RING // 2):
        a, b = values[k], values[k + _RING // 2]
        if low - fence <= a <= high + fence and low - fence <= b <= high + fence:
            gx += (a - b) * _COS[k]
            gy += (a - b) * _SIN[k]
            opposite += 1
    if opposite < _RING // 3:
        return ordered[quarter : count - quarter].mean(), (high - low) / 1.35
    gx, gy = gx / opposite, gy / opposite
    count = 0
    for k in range(_RING):
        if not np.isnan(values[k]):
            count = _insert(ordered, count, values[k] - gx * _COS[k] - gy * _SIN[k])
    level, spread = ordered[quarter : count - quarter].mean(), (ordered[count - 1 - quarter] - ordered[quarter]) / 1.35
    gx, gy = gx / radius, gy / radius
    if max(abs(gx), abs(gy)) * radius > 0.3 * spread:
        where[SLOPE_U], where[SLOPE_V] = gx / where[UNIT], gy / where[UNIT]
        for i in range(rows):
            for j in range(columns):
                patch[i, j] -= gx * (j - x) + gy * (i - y)
    return level, spread


@njit(cache=True)
def smooth(patch: Array, where: Array) -> None:
    """Average with the neighbours by 1 2 1 in either direction: a clipped core is torn by noise, and by interlacing."""
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    for i in range(rows):
        before = patch[i, 0]
        for j in range(columns - 1):
            here = patch[i, j]
            patch[i, j] = 0.25 * (before + 2.0 * here + patch[i, j + 1])
            before = here
        patch[i, columns - 1] = 0.25 * (before + 3.0 * patch[i, columns - 1])
    above = patch[0, :columns].copy()
    for i in range(rows - 1):
        for j in range(columns):
            here = patch[i, j]
            patch[i, j] = 0.25 * (above[j] + 2.0 * here + patch[i + 1, j])
            above[j] = here
    for j in range(columns):
        patch[rows - 1, j] = 0.25 * (above[j] + 3.0 * patch[rows - 1, j])


@njit(cache=True)
def rim_noise(patch: Array, where: Array) -> float:
    """1 sigma of a sample, from second differences along the outer rows of a window; large ones, of edges, left out."""
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    if columns < 5 or rows < 3:
        return 0.0
    limit, sigma = 1e9, 0.0
    for _ in range(2):
        total, count = 0.0, 0
        for i in (0, 1, rows - 2, rows - 1):
            for j in range(columns - 4):
                d = abs(patch[i, j] - 2.0 * patch[i, j + 2] + patch[i, j + 4])
                if d <= limit:
                    total += d
                    count += 1
        sigma = 0.5117 * total / max(count, 1)
        limit = 8.0 * sigma
    return sigma


@njit(cache=True)
def filtered(patch: Array, where: Array, x: float, y: float, width: float, level: float) -> tuple[float, float]:
    """Amplitude of a Gaussian of `width` samples at a place, and how many samples' worth of averaging is in it."""
    reach = int(np.ceil(2.5 * width))
    total, power = 0.0, 1e-12
    for i in range(max(int(y) - reach, 0), min(int(y) + reach + 2, int(where[ROWS]))):
        b = np.exp(-0.5 * (i - y) ** 2 / (width * width))
        for j in range(max(int(x) - reach, 0), min(int(x) + reach + 2, int(where[COLUMNS]))):
            window = b * np.exp(-0.5 * (j - x) ** 2 / (width * width))
            total += window * (patch[i, j] - level)
            power += window * window
    return total / power, power


@njit(cache=True)
def grow(window: Window, where: Array, image: Image, x: int, y: int, level: float, clipped: float, mark: int) -> None:
    """Sum up the connected samples over `level` around one, coordinates relative to it, into the window's sums.

    `CLIPPED` counts saturated samples, `EDGE` those at the picture's edge, `OPEN` those at the window's.
    """
    patch, stamp, stack, sums = window
    columns, rows = int(where[COLUMNS]), int(where[ROWS])
    at_left, at_top = where[LEFT] <= 1.0, where[TOP] <= 1.0
    at_right = where[LEFT] + where[UNIT] * columns >= image.shape[1] - 1
    at_bottom = where[TOP] + where[UNIT] * rows >= image.shape[0] - 1
    sums[:] = 0.0
    stack[0, 0], stack[0, 1] = x, y
    stamp[y, x] = mark
    top = 1
    while top:
        top -= 1
        j, i = stack[top, 0], stack[top, 1]
        a, b, weight = float(j - x), float(i - y), patch[i, j] - level
        sums[N] += 1.0
        sums[X] += a
        sums[Y] += b
        sums[XX] += a * a
        sums[XY] += a * b
        sums[YY] += b * b
        sums[W] += weight
        sums[WX] += weight * a
        sums[WY] += weight * b
        sums[CLIPPED] += patch[i, j] >= clipped
        if j == 0 or i == 0 or j == columns - 1 or i == rows - 1:
            cut_off = (j == 0 and at_left) or (i == 0 and at_top)
            cut_off = cut_off or (j == columns - 1 and at_right) or (i == rows - 1 and at_bottom)
            sums[EDGE if cut_off else OPEN] += 1.0
        for k in range(4):
            c, d = j + (k == 0) - (k == 1), i + (k == 2) - (k == 3)
            if 0 <= c < columns and 0 <= d < rows and stamp[d, c] != mark and patch[d, c] > level:
                stamp[d, c] = mark
                stack[top, 0], stack[top, 1] = c, d
                top += 1


@njit(cache=True)
def shape(sums: Array) -> tuple[float, float]:
    """Ratio of the axes of the ellipse with the region's second moments, and the region's area over the ellipse's."""
    n = sums[N]
    uu, uv, vv = moments(sums)
    half, turn = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    area = 4.0 * np.pi * np.sqrt(max(uu * vv - uv * uv, 1e-12))
    return np.sqrt(max(half - turn, 1e-12) / (half + turn)), n / area


@njit(cache=True)
def moments(sums: Array) -> tuple[float, float, float]:
    """Second central moments of the region, of samples that are unit squares."""
    n = sums[N]
    uu = (sums[XX] - sums[X] ** 2 / n) / n + 1.0 / 12.0
    vv = (sums[YY] - sums[Y] ** 2 / n) / n + 1.0 / 12.0
    return uu, (sums[XY] - sums[X] * sums[Y] / n) / n, vv


@njit(cache=True)
def balance(sums: Array, variance: float, center: Array, cov: Array) -> None:
    """Write a region's weighted centre (2,), relative to its start, and its covariance (3,) by noise of `variance`."""
    x, y = sums[WX] / sums[W], sums[WY] / sums[W]
    center[0], center[1] = x, y
    cov[0] = sums[XX] - 2.0 * x * sums[X] + sums[N] * x * x
    cov[1] = sums[XY] - x * sums[Y] - y * sums[X] + sums[N] * x * y
    cov[2] = sums[YY] - 2.0 * y * sums[Y] + sums[N] * y * y
    cov *= variance / sums[W] ** 2


@njit(cache=True)
def fit(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    slope: tuple[float, float],
    center: Array,
    width: float,
    noise: float,
    signal_noise: float,
    clipped: float,
    cov: Array,
) -> float:
    """Move `center` (2,) to the maximum-likelihood position of a round Gaussian; its covariance goes to `cov` (3,).

    Position and width are common, amplitude and background are of each plane and eliminated (variable projection), so
    that a mosaic's coarse planes bias nothing; saturated samples are left out, which is how the wings of a small
    clipped light give its centre. The residuals scale the covariance. Returns the width, 0 where the fit does not
    settle, which leaves everything as it was.
    """
    reach = min(max(int(np.ceil(2.2 * width)) + 1, 3 if planes < 4 else 4), _FIT_REACH)
    u0, v0 = int(np.floor(center[0] + 0.5)), int(np.floor(center[1] + 0.5))
    left, right = max(u0 - reach, 0), min(u0 + reach + 1, image.shape[1])
    top, bottom = max(v0 - reach, 0), min(v0 + reach + 1, image.shape[0])
    parts = 4 if planes == 4 else 1
    ex, ey = np.empty(right - left), np.empty(bottom - top)
    z = np.empty((bottom - top, right - left))
    for i in range(bottom - top):
        for j in range(right - left):
            if planes == 3:
                mixed, most = 0.0, 0.0
                for p in range(3):
                    mixed += weight[p] * image[top + i, left + j, p]
                    most = max(most, float(image[top + i, left + j, p]) if weight[p] > 0.0 else 0.0)
            else:
                mixed = most = float(image[top + i, left + j, 0])
            z[i, j] = scale * mixed - slope[0] * (left + j - u0) - slope[1] * (top + i - v0)
            if scale * most >= clipped:
                z[i, j] = np.nan
    u, v, s = center[0], center[1], width
    amplitude, ground = np.zeros(4), np.zeros(4)
    dx, dy = 1.0, 1.0
    S = np.zeros((3, 3))
    for turn in range(_FIT_ROUNDS):
        for j in range(right - left):
            ex[j] = np.exp(-0.5 * ((left + j - u) / s) ** 2)
        for i in range(bottom - top):
            ey[i] = np.exp(-0.5 * ((top + i - v) / s) ** 2)
        _amplitudes(z, ex, ey, left, top, parts, noise, signal_noise, turn > 0, amplitude, ground)
        right_side = _normal_equations(z, ex, ey, left, top, parts, noise, signal_noise, amplitude, ground, u, v, s, S)
        step, solved = _solve(S, right_side)
        if not solved:
            return 0.0
        dx, dy = step[0], step[1]
        if np.hypot(dx, dy) > width:
            return 0.0
        u, v = u + dx, v + dy
        s = min(max(s + step[2], 0.7 * s), 1.4 * s)
        if dx * dx + dy * dy < 1e-5 and turn > 0:
            break
    if dx * dx + dy * dy > 1e-2 or np.hypot(u - center[0], v - center[1]) > width or not 0.4 < s < 2.0 * width:
        return 0.0
    inverse, solved = _top_left_of_inverse(S)
    if not solved:
        return 0.0
    center[0], center[1] = u, v
    misfit = _odd_misfit(z, ex, ey, left, top, parts, noise, signal_noise, amplitude, u, v)
    cov[0], cov[1], cov[2] = inverse[0] * misfit, inverse[1] * misfit, inverse[2] * misfit
    return s


@njit(cache=True)
def _odd_misfit(
    z: Array,
    ex: Array,
    ey: Array,
    left: int,
    top: int,
    parts: int,
    noise: float,
    signal_noise: float,
    amplitude: Array,
    u: float,
    v: float,
) -> float:
    """How much more the residuals differ between opposite sides than noise would: what is even displaces nothing."""
    center_i, center_j = int(np.floor(v + 0.5)) - top, int(np.floor(u + 0.5)) - left
    total, pairs = 0.0, 0
    for i in range(center_i + 1):
        for j in range(len(ex)):
            k, m = 2 * center_i - i, 2 * center_j - j
            if not (i < k or j < m) or k >= len(ey) or m < 0 or m >= len(ex):
                continue
            a, b = z[i, j], z[k, m]
            if np.isnan(a) or np.isnan(b):
                continue
            p = ((top + i) & 1) * 2 + ((left + j) & 1) if parts == 4 else 0
            g, h = amplitude[p] * ex[j] * ey[i], amplitude[p] * ex[m] * ey[k]
            odd = a - g - b + h
            total += odd * odd / (2.0 * noise * noise + signal_noise * (max(g, 0.0) + max(h, 0.0)))
            pairs += 1
    return (_PRIOR_DOF + total) / (_PRIOR_DOF + pairs)


@njit(cache=True)
def _amplitudes(
    z: Array,
    ex: Array,
    ey: Array,
    left: int,
    top: int,
    parts: int,
    noise: float,
    signal_noise: float,
    weighted: bool,
    amplitude: Array,
    ground: Array,
) -> None:
    """Least-squares amplitude and background of each plane under the present profile."""
    gg, g1, n, gz, z1 = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    for i in range(len(ey)):
        for j in range(len(ex)):
            value = z[i, j]
            if np.isnan(value):
                continue
            p = ((top + i) & 1) * 2 + ((left + j) & 1) if parts == 4 else 0
            g = ex[j] * ey[i]
            w = 1.0
            if weighted:
                w = 1.0 / (noise * noise + signal_noise * max(amplitude[p], 0.0) * g)
            gg[p] += w * g * g
            g1[p] += w * g
            n[p] += w
            gz[p] += w * g * value
            z1[p] += w * value
    for p in range(parts):
        det = gg[p] * n[p] - g1[p] ** 2
        if n[p] > 0.0 and det > 1e-9 * gg[p] * n[p]:
            amplitude[p] = (n[p] * gz[p] - g1[p] * z1[p]) / det
            ground[p] = (gg[p] * z1[p] - g1[p] * gz[p]) / det
        else:
            amplitude[p], ground[p] = 0.0, z1[p] / max(n[p], 1e-12)


@njit(cache=True)
def _normal_equations(
    z: Array,
    ex: Array,
    ey: Array,
    left: int,
    top: int,
    parts: int,
    noise: float,
    signal_noise: float,
    amplitude: Array,
    ground: Array,
    u: float,
    v: float,
    s: float,
    S: Array,
) -> Array:
    """Schur complement `S` (3, 3) of position and width; returns its right side (3,)."""
    M, B, right_side = np.zeros((4, 3)), np.zeros((4, 2, 3)), np.zeros(3)
    S[:] = 0.0
    for i in range(len(ey)):
        b = (top + i - v) / s
        for j in range(len(ex)):
            value = z[i, j]
            if np.isnan(value):
                continue
            p = ((top + i) & 1) * 2 + ((left + j) & 1) if parts == 4 else 0
            g, a = ex[j] * ey[i], (left + j - u) / s
            A = amplitude[p]
            w = 1.0 / (noise * noise + signal_noise * max(A, 0.0) * g)
            r = value - ground[p] - A * g
            scaled = A * g / s
            j0, j1, j2 = scaled * a, scaled * b, scaled * (a * a + b * b)
            S[0, 0] += w * j0 * j0
            S[0, 1] += w * j0 * j1
            S[0, 2] += w * j0 * j2
            S[1, 1] += w * j1 * j1
            S[1, 2] += w * j1 * j2
            S[2, 2] += w * j2 * j2
            right_side[0] += w * j0 * r
            right_side[1] += w * j1 * r
            right_side[2] += w * j2 * r
            M[p, 0] += w * g * g
            M[p, 1] += w * g
            M[p, 2] += w
            for k, jk in enumerate((j0, j1, j2)):
                B[p, 0, k] += w * g * jk
                B[p, 1, k] += w * jk
    for p in range(parts):
        det = M[p, 0] * M[p, 2] - M[p, 1] ** 2
        if not det > 1e-9 * M[p, 0] * M[p, 2]:
            continue
        for k in range(3):
            for m in range(k, 3):
                S[k, m] -= (
                    M[p, 2] * B[p, 0, k] * B[p, 0, m]
                    - M[p, 1] * (B[p, 0, k] * B[p, 1, m] + B[p, 1, k] * B[p, 0, m])
                    + M[p, 0] * B[p, 1, k] * B[p, 1, m]
                ) / det
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
    return right_side


@njit(cache=True)
def _solve(S: Array, b: Array) -> tuple[Array, bool]:
    """Solution (3,) of S x = b by the adjugate."""
    c0 = S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1]
    c1 = S[1, 2] * S[2, 0] - S[1, 0] * S[2, 2]
    c2 = S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0]
    det = S[0, 0] * c0 + S[0, 1] * c1 + S[0, 2] * c2
    x = np.zeros(3)
    if not det > 1e-12 * S[0, 0] * S[1, 1] * S[2, 2]:
        return x, False
    x[0] = (
        c0 * b[0] + (S[0, 2] * S[2, 1] - S[0, 1] * S[2, 2]) * b[1] + (S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]) * b[2]
    ) / det
    x[1] = (
        c1 * b[0] + (S[0, 0] * S[2, 2] - S[0, 2] * S[2, 0]) * b[1] + (S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2]) * b[2]
    ) / det
    x[2] = (
        c2 * b[0] + (S[0, 1] * S[2, 0] - S[0, 0] * S[2, 1]) * b[1] + (S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]) * b[2]
    ) / det
    return x, True


@njit(cache=True)
def _top_left_of_inverse(S: Array) -> tuple[tuple[float, float, float], bool]:
    """The entries uu, uv, vv of the inverse of S (3, 3)."""
    a = S[0, 0] - S[0, 2] ** 2 / S[2, 2]
    b = S[0, 1] - S[0, 2] * S[1, 2] / S[2, 2]
    c = S[1, 1] - S[1, 2] ** 2 / S[2, 2]
    det = a * c - b * b
    if not (det > 1e-12 * a * c and a > 0.0):
        return (0.0, 0.0, 0.0), False
    return (c / det, -b / det, a / det), True
