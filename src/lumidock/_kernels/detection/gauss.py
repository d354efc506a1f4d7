"""The maximum-likelihood centre of a small light: a round Gaussian on each colour's own samples."""

from __future__ import annotations

import numpy as np

from lumidock._kernels.compiling import fast_part, part
from lumidock._kernels.detection import patch, samples
from lumidock._kernels.detection.patch import CloseUp
from lumidock.datatypes import Array

ROUNDS, REACH = 6, 9
_PRIOR_DOF = 6.0  # how much the expected noise counts beside the residuals of a fit
_PROFILE = 0.07  # share of the signal by which a spot's profile is no Gaussian
_TELLING = 0.35  # of its height, at the samples that tell most of a spot's place
_LEFT = 0.3  # share of the degrees of freedom that a fit leaves at least
_FITTED = 2.0  # of the residuals' degrees of freedom, that the position takes up where noise is not shared
# lines of scratch: along the window's two sides, of the samples of one plane, and of those of each of four
_EX, _EY, _X, _Y, _G, _VARIANCE, _WEIGHT, _SIGNAL, _VALUE, _USED = 0, 1, 2, 3, 4, 5, 6, 7, 8, 12
_AMPLITUDE, _GROUND = 0, 1
_FIRST, _ALONE, _ZERO = 0, -1, np.float32(0.0)
Window = tuple[int, int, int, int, int, int]  # left, top, columns and rows of its samples, their planes and distance
Step = tuple[np.float32, np.float32, np.float32]  # column and row of the first sample, and of the next ones, in widths
Six = tuple[float, float, float, float, float, float]
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@part
def fit(
    close: CloseUp,
    planes: int,
    center: tuple[float, float],
    width: float,
    noise: float,
    signal_noise: float,
    coarse: bool,
    clipped: float,
) -> Six:
    """The width, maximum-likelihood place u, v and covariance uu, uv, vv of a round Gaussian, sought from `center` on.

    Position and width are common, amplitude and background are of each plane and eliminated (variable projection), so
    that a mosaic's coarse planes bias nothing; saturated samples are left out, which is how the wings of a small
    clipped light give its centre. The residuals scale the covariance, and so does how many samples have the same noise,
    where the signal is `coarse` that of the signal too. Width 0 where the fit does not settle.
    """
    reach = min(max(int(np.ceil(2.2 * width)) + 1, 3 if planes < 4 else 4), REACH)
    window, whole = _read(close, planes, center, reach, clipped)
    if window[2] < 3 or window[3] < 3:
        return _NOTHING
    u, v, s, S, du, dv = center[0], center[1], width, _NOTHING, 1.0, 1.0
    close.fitted[:] = 0.0
    for turn in range(ROUNDS):
        S, side = _normal_equations(close, window, u, v, s, noise * noise, signal_noise)
        du, dv, ds, solved = _solve(S, side)
        if not solved or du * du + dv * dv > width * width:
            return _NOTHING
        u, v = u + du, v + dv
        s = min(max(s + ds, 0.7 * s), 1.4 * s)
        if du * du + dv * dv < 1e-4 and turn > 0:
            break
    gone = np.hypot(u - center[0], v - center[1])
    uu, uv, vv, solved = _top_left_of_inverse(S)
    if du * du + dv * dv > 1e-2 or gone > width or not 0.4 < s < 2.0 * width or not solved:
        return _NOTHING
    scale_up = averaging(close.ground[patch.SHARED], s)
    if not coarse:  # what the signal adds is of each sample; of a coarse colour they share that as well
        height = samples.largest(close.fitted[_AMPLITUDE])
        scale_up = 1.0 + (scale_up - 1.0) / (1.0 + _TELLING * signal_noise * max(height, 0.0) / noise**2)
    scale_up *= _misfit(close, window, u, v, s, noise * noise, signal_noise, _FITTED * scale_up, whole)
    return s, u, v, uu * scale_up, uv * scale_up, vv * scale_up


@part
def averaging(shared: float, width: float) -> float:
    """Variance of a centre by noise that neighbours share, over that by as much noise of each sample on its own.

    Of a Gaussian spot of `width` px, 1 sigma, in noise of a Gaussian spectrum; a wide region has `shared` times it.
    """
    return float(shared / (1.0 + (shared - 1.0) / (4.0 * np.pi * width * width)) ** 2)


@part
def _read(close: CloseUp, planes: int, center: tuple[float, float], reach: int, clipped: float) -> tuple[Window, bool]:
    """Write the samples around `center`, row by row, without their level and slope, to the lines of scratch.

    With those that are used, which saturated ones are not, and the column and row of each; returns whether all are.
    """
    where, stack, weight, lines = close.where, close.stack, close.weight, close.lines
    left, top, unit, parts = where[patch.LEFT], where[patch.TOP], where[patch.UNIT], 4 if planes == 4 else 1
    u, v = int(np.floor(center[0] + 0.5)), int(np.floor(center[1] + 0.5))
    j, i = max(u - reach - left, 0) // unit, max(v - reach - top, 0) // unit
    n = min((u + reach - left) // unit + 1, where[patch.COLUMNS]) - j
    m = min((v + reach - top) // unit + 1, where[patch.ROWS]) - i
    w0, w1, w2 = np.float32(weight[0]), np.float32(weight[1]), np.float32(weight[2])
    most, level, count = np.float32(clipped), np.float32(close.ground[patch.LEVEL]), np.float32(0.0)
    gu = np.float32(close.ground[patch.SLOPE_U] if planes < 4 else 0.0)
    gv = np.float32(close.ground[patch.SLOPE_V] if planes < 4 else 0.0)
    for p in range(parts):
        value, used = lines[_VALUE + p], lines[_USED + p]
        for y in range(m):
            a, b, c = stack[p, i + y, j:], stack[1, i + y, j:], stack[2, i + y, j:]
            base = level + gv * np.float32(top + unit * (i + y) - v) + gu * np.float32(left + unit * j - u)
            k = y * n
            if planes == 3:
                for x in range(n):
                    low = (a[x] < most) | (w0 == _ZERO)
                    low &= ((b[x] < most) | (w1 == _ZERO)) & ((c[x] < most) | (w2 == _ZERO))
                    used[k + x] = np.float32(low)
                    value[k + x] = w0 * a[x] + w1 * b[x] + w2 * c[x] - base - gu * np.float32(x)
            else:
                for x in range(n):
                    used[k + x] = np.float32(a[x] < most)
                    value[k + x] = a[x] - base - gu * np.float32(unit * x)
        for k in range(m * n):
            count += used[k]
        for k in range(m * n, patch.wide(m * n)):
            value[k] = used[k] = _ZERO
    for y in range(m):
        for x in range(n):
            lines[_X, y * n + x], lines[_Y, y * n + x] = x, y
    for k in range(m * n, patch.wide(m * n)):
        lines[_X, k] = lines[_Y, k] = lines[_G, k] = _ZERO
    return (left + unit * j, top + unit * i, n, m, parts, unit), int(count) == parts * m * n


@part
def _normal_equations(
    close: CloseUp, window: Window, u: float, v: float, s: float, variance: float, signal_noise: float
) -> tuple[Six, tuple[float, float, float]]:
    """Upper triangle of the Schur complement (3, 3) of position and width, and its side; the planes are fitted anew."""
    left, top, n, m, parts, unit = window
    lines, fitted = close.lines, close.fitted
    s00, s01, s02, s11, s12, s22, r0, r1, r2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    count = patch.wide(n * m)
    g, x, y = lines[_G, :count], lines[_X, :count], lines[_Y, :count]
    for p in range(parts):
        a, b = left + ((p & 1) if parts == 4 else 0) - u, top + (p >> 1) - v
        _profile(lines, a, b, float(unit), s, n, m)
        value, used = lines[_VALUE + p, :count], lines[_USED + p, :count]
        shot = np.float32(signal_noise * max(fitted[_AMPLITUDE, p], 0.0))
        amplitude, ground = _amplitude(value, used, g, np.float32(variance), shot)
        fitted[_AMPLITUDE, p], fitted[_GROUND, p] = amplitude, ground
        shot = np.float32(signal_noise * max(amplitude, 0.0))
        at = (np.float32(a / s), np.float32(b / s), np.float32(unit / s))
        S, side = _equations(
            value, used, g, x, y, at, np.float32(variance), shot, np.float32(amplitude), np.float32(ground)
        )
        per_width = amplitude / s
        square = per_width * per_width
        s00, s01, s02 = s00 + square * S[0], s01 + square * S[1], s02 + square * S[2]
        s11, s12, s22 = s11 + square * S[3], s12 + square * S[4], s22 + square * S[5]
        r0, r1, r2 = r0 + per_width * side[0], r1 + per_width * side[1], r2 + per_width * side[2]
    return (s00, s01, s02, s11, s12, s22), (r0, r1, r2)


@part
def _profile(lines: Array, a: float, b: float, step: float, s: float, n: int, m: int) -> None:
    """Write the profile of one plane's samples, row by row, the first one `a`, `b` from the centre."""
    ex, ey, g = lines[_EX], lines[_EY], lines[_G]
    patch.bell(a, step, s, n, ex)
    patch.bell(b, step, s, m, ey)
    for i in range(m):
        e, row = ey[i], g[i * n : i * n + n]
        for j in range(n):
            row[j] = ex[j] * e


@fast_part
def _amplitude(z: Array, used: Array, g: Array, variance: np.float32, shot: np.float32) -> tuple[float, float]:
    """Least-squares amplitude and background of one plane under the present profile, of the samples `used`.

    `shot` is the variance that the profile adds to the noise's where it is 1.
    """
    gg, g1, n, gz, z1 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(len(z)):
        w = used[k] / (variance + shot * g[k])
        wg = w * g[k]
        gg += wg * g[k]
        g1 += wg
        n += w
        gz += wg * z[k]
        z1 += w * z[k]
    a, b, c, d, e = float(gg), float(g1), float(n), float(gz), float(z1)
    det = a * c - b * b
    if c > 0.0 and det > 1e-5 * a * c:
        return (c * d - b * e) / det, (a * e - b * d) / det
    return 0.0, e / max(c, 1e-12)


@fast_part
def _equations(
    z: Array,
    used: Array,
    profile: Array,
    x: Array,
    y: Array,
    at: Step,
    variance: np.float32,
    shot: np.float32,
    amplitude: np.float32,
    ground: np.float32,
) -> tuple[Six, tuple[float, float, float]]:
    """One plane's share of the normal equations, for an amplitude of one width; `at`: place of sample 0, and a step."""
    s00, s01, s02, s11, s12, s22, r0, r1, r2 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    gg, g1, n, g_0, g_1, g_2, j_0, j_1, j_2 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    a0, b0, step = at
    for k in range(len(z)):
        g, a, b = profile[k], a0 + step * x[k], b0 + step * y[k]
        w = used[k] / (variance + shot * g)
        j0, j1, j2 = g * a, g * b, g * (a * a + b * b)
        wr, w0, w1, w2, wg = w * (z[k] - ground - amplitude * g), w * j0, w * j1, w * j2, w * g
        s00 += w0 * j0
        s01 += w0 * j1
        s02 += w0 * j2
        s11 += w1 * j1
        s12 += w1 * j2
        s22 += w2 * j2
        r0 += wr * j0
        r1 += wr * j1
        r2 += wr * j2
        gg += wg * g
        g1 += wg
        n += w
        g_0 += wg * j0
        g_1 += wg * j1
        g_2 += wg * j2
        j_0 += w0
        j_1 += w1
        j_2 += w2
    side = (float(r0), float(r1), float(r2))
    S = (float(s00), float(s01), float(s02), float(s11), float(s12), float(s22))
    return _without_plane(
        S, (float(gg), float(g1), float(n)), (float(g_0), float(g_1), float(g_2)), (float(j_0), float(j_1), float(j_2))
    ), side


@part
def _without_plane(
    S: Six, own: tuple[float, float, float], of_g: tuple[float, float, float], of_1: tuple[float, float, float]
) -> Six:
    """The Schur complement of amplitude and background, whose own equations are `own`."""
    gg, g1, n = own
    det = gg * n - g1 * g1
    if not det > 1e-5 * gg * n:
        return S
    a, b, c = n / det, -g1 / det, gg / det
    (g0, g1, g2), (k0, k1, k2) = of_g, of_1
    return (
        S[0] - (a * g0 * g0 + 2.0 * b * g0 * k0 + c * k0 * k0),
        S[1] - (a * g0 * g1 + b * (g0 * k1 + k0 * g1) + c * k0 * k1),
        S[2] - (a * g0 * g2 + b * (g0 * k2 + k0 * g2) + c * k0 * k2),
        S[3] - (a * g1 * g1 + 2.0 * b * g1 * k1 + c * k1 * k1),
        S[4] - (a * g1 * g2 + b * (g1 * k2 + k1 * g2) + c * k1 * k2),
        S[5] - (a * g2 * g2 + 2.0 * b * g2 * k2 + c * k2 * k2),
    )


@part
def _misfit(
    close: CloseUp,
    window: Window,
    u: float,
    v: float,
    s: float,
    variance: float,
    signal_noise: float,
    fitted: float,
    whole: bool,
) -> float:
    """How much larger the residuals are than noise, counted where they move the centre.

    What is even about the centre displaces nothing: opposite residuals are compared, and a share of the signal is
    allowed for, as no lens draws a Gaussian and no grid holds one evenly. Where saturated samples are left out there is
    no such balance, and every residual counts.
    """
    left, top, n, m, parts, unit = window
    lines = close.lines
    total, least, weight, square = 0.0, 0.0, 0.0, 0.0
    for p in range(parts):
        column, row = left + ((p & 1) if parts == 4 else 0), top + (p >> 1)
        _profile(lines, column - u, row - v, float(unit), s, n, m)
        at = (np.float32((column - u) / s), np.float32((row - v) / s), np.float32(unit / s))
        amplitude, ground = np.float32(close.fitted[_AMPLITUDE, p]), np.float32(close.fitted[_GROUND, p])
        _residuals(lines, p, n * m, at, amplitude, ground, np.float32(variance), np.float32(signal_noise))
        if whole:
            x, y = 2 * (int(np.floor(u + 0.5)) - column) // unit, 2 * (int(np.floor(v + 0.5)) - row) // unit
            for i in range(max(y - m + 1, 0), y // 2 + 1):  # rows that have an opposite one below, or are that
                first, last = max(x - n + 1, 0), min(x + 1, n) if 2 * i < y else (x + 1) // 2
                a, b, c, d = _odd(lines, p, i * n + first, (y - i) * n + x - first, last - first)
                total, least, weight, square = total + a, least + b, weight + c, square + d
        else:
            a, b, c, d = _odd(lines, p, _FIRST, _ALONE, n * m)
            total, least, weight, square = total + a, least + b, weight + c, square + d
    if weight <= 0.0:
        return 1.0
    dof, found, granted = weight * weight / square, total / weight, least / weight
    at_least = min(found + granted, 1.0)  # a spot that is a Gaussian after all has noise as well
    return max((_PRIOR_DOF + dof * found) / (_PRIOR_DOF + max(dof - fitted, _LEFT * dof)), at_least)


@fast_part
def _residuals(
    lines: Array,
    p: int,
    count: int,
    at: Step,
    amplitude: np.float32,
    ground: np.float32,
    variance: np.float32,
    signal_noise: np.float32,
) -> None:
    """Write a plane's residuals over its values, their variance, what they say of the place, and the signal."""
    value, g, x, y = lines[_VALUE + p], lines[_G], lines[_X], lines[_Y]
    var, info, signal, used = lines[_VARIANCE], lines[_WEIGHT], lines[_SIGNAL], lines[_USED + p]
    a0, b0, step = at
    for k in range(count):
        a, b, h = a0 + step * x[k], b0 + step * y[k], amplitude * g[k]
        value[k] = value[k] - ground - h
        var[k] = variance + signal_noise * max(h, _ZERO)
        info[k] = used[k] * h * h * (a * a + b * b) / var[k]
        signal[k] = h


@fast_part
def _odd(lines: Array, p: int, first: int, last: int, count: int) -> tuple[float, float, float, float]:
    """Sums over samples from `first` on, less those from `last` back, or alone if that is negative; see `_misfit`.

    Of squared residuals and of what is allowed for, either over their variance and weighted, of weights and squares.
    """
    value, var, info, signal = lines[_VALUE + p], lines[_VARIANCE], lines[_WEIGHT], lines[_SIGNAL]
    total, least, weight, square, profile = _ZERO, _ZERO, _ZERO, _ZERO, np.float32(_PROFILE * _PROFILE)
    for k in range(first, first + count):
        odd, share, expected, allowed = value[k], info[k], var[k], _ZERO
        if last >= 0:
            m = first + last - k
            odd, share, expected = odd - value[m], share + info[m], expected + var[m]
            allowed = profile * (signal[k] * signal[k] + signal[m] * signal[m])
        by_variance = share / (expected + allowed)
        total += by_variance * odd * odd
        least += by_variance * allowed
        weight += share
        square += share * share
    return float(total), float(least), float(weight), float(square)


@part
def _solve(S: Six, b: tuple[float, float, float]) -> tuple[float, float, float, bool]:
    """Solution of S x = b, of a symmetric S by its upper triangle, by the adjugate."""
    s00, s01, s02, s11, s12, s22 = S
    c0, c1, c2 = s11 * s22 - s12 * s12, s12 * s02 - s01 * s22, s01 * s12 - s11 * s02
    det = s00 * c0 + s01 * c1 + s02 * c2
    if not det > 1e-9 * s00 * s11 * s22:
        return 0.0, 0.0, 0.0, False
    d1, d2, e2 = s00 * s22 - s02 * s02, s01 * s02 - s00 * s12, s00 * s11 - s01 * s01
    return (
        (c0 * b[0] + c1 * b[1] + c2 * b[2]) / det,
        (c1 * b[0] + d1 * b[1] + d2 * b[2]) / det,
        (c2 * b[0] + d2 * b[1] + e2 * b[2]) / det,
        True,
    )


@part
def _top_left_of_inverse(S: Six) -> tuple[float, float, float, bool]:
    """The entries uu, uv, vv of the inverse of S (3, 3), by its upper triangle."""
    a, b, c = S[0] - S[2] ** 2 / S[5], S[1] - S[2] * S[4] / S[5], S[3] - S[4] ** 2 / S[5]
    det = a * c - b * b
    if not (det > 1e-9 * a * c and a > 0.0):
        return 0.0, 0.0, 0.0, False
    return c / det, -b / det, a / det, True
